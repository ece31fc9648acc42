"""A model that changes after its inverse kinematics was made: what uses it from which moment."""

import copy
import sys
import threading

import numpy as np
import pytest
import torch
from torch import nn

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    load_model,
    native,
    save_model,
)
from hybridkin._core.plan import Plan
from hybridkin.ik.tasks import PoseTask

BASE, ELSEWHERE = torch.eye(4).double(), torch.eye(4).double()
BASE[:3, :3] = torch.tensor([[0.0, 0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, -0.6]])
ELSEWHERE[:3] = torch.tensor([[0.0, 1.0, 0.0, 0.05], [-1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]])
CHAIN = ConstantCurvatureChain([0.02, 0.018], base=BASE)
DRAW = np.random.default_rng(0)
Q = DRAW.uniform(0.1, 0.12, (60, 6))
X = CHAIN(torch.from_numpy(Q)).numpy() + 0.004 * np.sin(120.0 * Q[:, :3])
NOW, TARGET = Q[7].copy(), X[8].copy()
MOVED = [0.05, 0.0, 0.0]


def fitted():
    return HybridForwardModel(CHAIN, ELMRegressor(6, random_state=0)).fit(Q, X)


def module_of(model):
    return model if isinstance(model, nn.Module) else model.module_


class Uses:
    """One model in everything that evaluates it; arrays are NumPy or torch."""

    def __init__(self, model, kind, folder):
        self.model, self.kind, self.folder = model, kind, folder
        self.ik = InverseKinematics(model, q_min=0.05, q_max=0.2)
        self.running = self.ik.tracker(self.array(NOW))

    def array(self, a):
        return torch.tensor(a) if self.kind == "torch" else np.array(a)

    def predict(self):
        if isinstance(self.model, nn.Module) or self.kind == "torch":
            return module_of(self.model)(torch.from_numpy(Q[:3]))
        return self.model.predict(Q[:3])

    def jacobian(self):
        if isinstance(self.model, nn.Module) or self.kind == "torch":
            return module_of(self.model).jacobian(torch.from_numpy(Q[:3]))
        return self.model.jacobian(Q[:3])

    def step(self):
        return self.ik.step(self.array(NOW), self.array(TARGET)).dq

    def solve(self):
        return self.ik.solve(self.array(TARGET), self.array(NOW), max_iter=8, restarts=0).q

    def track(self):
        return self.ik.track(self.array(X[8:10]), q0=self.array(NOW)).q

    def stored(self):
        return Plan(self.ik.stored()).data

    def tracker(self):
        return self.ik.tracker(self.array(NOW)).step(self.array(TARGET))

    def reset(self):
        self.running.reset(self.array(NOW))
        return self.running.step(self.array(TARGET))

    def tick(self):
        """A step of the tracker that ran before the change."""
        return self.running.step(self.array(TARGET))

    def export_c(self):
        native.export_c(self.model, self.folder)
        return [*(self.folder / "model.c").read_bytes()]

    def save_model(self):
        path = self.folder / "model.safetensors"
        save_model(self.model, path)
        with torch.no_grad():
            return module_of(load_model(path))(torch.from_numpy(Q[:3]))


def partial_fit(model):
    model.partial_fit(Q[:20], X[:20] + MOVED)


def adapt(model):
    model.adapt(Q[:8], X[:8] + MOVED)


def fit(model):
    model.fit(Q, X + MOVED)


def set_params(model):
    model.set_params(error_model="quadratic").fit(Q, X)


REFITS = [fit, set_params, partial_fit, adapt]


def chain_of(model):
    return getattr(model, "mechanical", model)


def in_place(model):
    chain_of(model).base[0, 3] += 0.05
    chain_of(model).base[:3, :2] *= -1.0


def without_grad(model):
    with torch.no_grad():
        chain_of(model).base.copy_(ELSEWHERE)


def data(model):
    chain_of(model).base.data[:] = ELSEWHERE


def new_data(model):
    chain_of(model).base.data = ELSEWHERE.clone()


def transposed_data(model):
    chain_of(model).base.data = chain_of(model).base.data.T


def by_numpy(model):
    chain_of(model).base.numpy()[:] = ELSEWHERE


def reassigned(model):
    chain_of(model).base = ELSEWHERE.clone()


def state(model):
    name = next(name for name in model.state_dict() if name.endswith("base"))
    model.load_state_dict({**model.state_dict(), name: ELSEWHERE})


def other_dtype(model):
    model.to(torch.float32)
    in_place(model)
    model.double()


def attribute(model):
    chain_of(model)._set_markers([(1.5, 0.0, 0.0, 0.0)])


def part(model):
    model.mechanical = model.mechanical.with_geometry(offsets=torch.tensor([0.0, 0.03]).double())


def learned(model):
    model.corrections[0].module.output_weights.numpy()[:] *= -2.0


def weight(model):
    model.weights.data *= 0.5


EDITS = [in_place, without_grad, data, new_data, transposed_data, by_numpy, reassigned]
EDITS += [state, other_dtype, attribute]
EDITS_OF_HYBRIDS = [part, learned, weight]
USES = ["predict", "jacobian", "stored", "step", "solve", "track", "tracker", "reset", "tick"]
USES += ["save_model"]
KINDS = ["numpy", pytest.param("torch", marks=pytest.mark.slow)]


RUNNING = "tick"


def as_numpy(a):
    return a.numpy(force=True) if isinstance(a, torch.Tensor) else np.array(a)


def answer(uses, use):
    return as_numpy(getattr(uses, use)())


def told(model, change, uses, kind, folder):
    """Return for each use of a changed model whether its answer is that of the new or of the old.

    The new answer is that of a copy of the changed model, in new inverse kinematics.
    """
    model = copy.deepcopy(model)
    present = Uses(model, kind, folder)
    before = {}
    for use in uses:
        present.running.reset(present.array(NOW))
        before[use] = answer(present, use)
    present.running.reset(present.array(NOW))
    change(model if change in REFITS else module_of(model))
    # The running tracker first: each of the others could make it read the model.
    found = {use: answer(present, use) for use in sorted(uses, key=RUNNING.__ne__)}
    later = Uses(copy.deepcopy(model), kind, folder)
    outcomes = {}
    for use in uses:
        later.running.reset(later.array(NOW))
        after = answer(later, use)
        assert not np.array_equal(before[use], after)
        is_new, is_old = (np.array_equal(found[use], a) for a in (after, before[use]))
        outcomes[use] = "new" if is_new else "old" if is_old else "neither"
    return outcomes


@pytest.fixture(scope="module")
def hybrid():
    return fitted()


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", REFITS)
def test_a_refit_reaches_all_that_was_made_before(hybrid, change, kind, tmp_path):
    assert told(hybrid, change, USES, kind, tmp_path) == dict.fromkeys(USES, "new")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", EDITS + EDITS_OF_HYBRIDS)
def test_an_edit_reaches_all_but_a_running_tracker(hybrid, change, kind, tmp_path):
    expected = {**dict.fromkeys(USES, "new"), RUNNING: "old"}
    assert told(hybrid, change, USES, kind, tmp_path) == expected


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("change", EDITS)
def test_so_does_an_edit_of_a_chain(change, kind, tmp_path):
    uses = [use for use in USES if use not in ("predict", "jacobian")]  # by torch, for a module
    expected = {**dict.fromkeys(uses, "new"), RUNNING: "old"}
    assert told(CHAIN, change, uses, kind, tmp_path) == expected


@pytest.mark.slow
@pytest.mark.needs_core
@pytest.mark.parametrize("change", [adapt, by_numpy])
def test_exported_code_holds_the_present_model(hybrid, change, tmp_path):
    assert told(hybrid, change, ["export_c"], "numpy", tmp_path) == {"export_c": "new"}


@pytest.mark.needs_core
@pytest.mark.parametrize("change", [data, new_data, transposed_data, by_numpy, attribute])
def test_core_and_torch_agree_after_a_write_that_leaves_no_trace(change):
    chain = copy.deepcopy(CHAIN)
    native.library.evaluate(chain, Q[:3])
    change(chain)
    compiled = native.library.evaluate(chain, Q[:3], jacobian=True)
    for core, torch_ in zip(compiled, chain.forward_and_jacobian(torch.tensor(Q[:3])), strict=True):
        np.testing.assert_allclose(core, torch_.numpy(), rtol=0.0, atol=1e-14)
    program = native.library.program_of(chain)
    assert native.library.program_of(chain) is program


def test_functions_are_called_as_they_are():
    chain = copy.deepcopy(CHAIN)
    tracker = InverseKinematics(lambda q: chain(q), q_min=0.05, q_max=0.2).tracker(NOW)
    before = tracker.step(TARGET)
    tracker.reset(NOW)
    in_place(chain)
    assert np.abs(tracker.step(TARGET) - before).max() > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_a_refit_changes_neither_place_nor_speed(kind, tmp_path):
    """Limits of speed and acceleration hold over the refit."""
    model = copy.deepcopy(fitted())
    limits = {"q_min": 0.05, "q_max": 0.2, "dq_max": 0.02, "ddq_max": 0.2, "dt": 0.01}
    ik = InverseKinematics(model, **limits)
    array = Uses(model, kind, tmp_path).array
    tracker = ik.tracker(array(NOW), memory=1.0)
    commands = [NOW]
    for k in range(20):
        if k == 10:
            adapt(model)
        measured = X[8] + 0.02 if k < 10 else np.full(3, np.nan)
        commands.append(as_numpy(tracker.step(array(TARGET), x_measured=array(measured))))
    steps = np.diff(commands, axis=0)
    assert np.abs(steps).max() <= 0.02 * 0.01 * (1.0 + 1e-9)
    assert np.abs(np.diff(steps, axis=0)).max() <= 0.2 * 0.01**2 * (1.0 + 1e-9)
    assert np.abs(steps[10]).max() > 0.2 * 0.01**2  # from rest it could not be that fast


@pytest.mark.parametrize("kind", KINDS)
def test_a_refit_makes_a_tracker_forget_the_offset(kind, tmp_path):
    """The offset was between the measured tip and the earlier model."""
    uses = Uses(fitted(), kind, tmp_path)
    nowhere, target = uses.array(np.full(3, np.nan)), uses.array(TARGET)
    for refit in (lambda model: None, adapt):
        tracker = uses.ik.tracker(uses.array(NOW), memory=10.0)
        tracker.step(target, x_measured=uses.array(X[7] + 0.004))
        refit(uses.model)
        for _ in range(6):
            tracker.step(target, x_measured=nowhere)
        missed = np.linalg.norm(as_numpy(tracker.x) - TARGET)
        assert (missed < 1e-5) == (refit is adapt)


def test_limits_of_the_model_are_those_of_the_refit():
    model = HybridForwardModel(ConstantCurvatureChain([0.02, 0.018]), "drop")
    q = DRAW.uniform(0.1, 0.14, (30, 6))
    x = model.mechanical_model(torch.from_numpy(q)).numpy()
    ik = InverseKinematics(model.fit(q, x))
    given = InverseKinematics(model, q_min=0.05)
    assert float(ik.settings.q_min.max()) == 0.0
    model.set_params(mechanical_model=ConstantCurvatureChain([0.02, 0.018], actuator_zeros=0.01))
    model.fit(q, x)
    np.testing.assert_array_equal(ik.settings.q_min.numpy(), np.full(6, 0.01))
    assert given.settings.q_min.tolist() == 0.05


def test_a_refit_for_another_robot_is_refused():
    model, n = fitted(), "must keep its 6 actuators, but now has 3"
    ik = InverseKinematics(model, q_min=0.05, q_max=0.2)
    tracker = ik.tracker(NOW)
    one = ConstantCurvatureChain([0.02])
    model.set_params(mechanical_model=one).fit(Q[:, :3], X)
    for use in (lambda: tracker.step(TARGET), lambda: ik.step(NOW, TARGET), lambda: ik.settings):
        with pytest.raises(ValueError, match=n):
            use()


def test_a_pose_task_follows_its_estimator():
    poses = CHAIN.pose(torch.from_numpy(Q))
    y = np.hstack([X, np.zeros_like(X)])
    model = HybridForwardModel(CHAIN, ELMRegressor(6, random_state=0), output="pose").fit(Q, y)
    ik = InverseKinematics(PoseTask(model), q_min=0.05, q_max=0.2)
    tracker = ik.tracker(NOW)
    tracker.step(poses[8].numpy())
    before = ik.step(NOW, poses[8].numpy()).dq
    model.fit(Q, y + 0.05 * np.eye(6)[0])
    tracker.step(poses[8].numpy())
    fresh = InverseKinematics(PoseTask(model), q_min=0.05, q_max=0.2)
    after = ik.step(NOW, poses[8].numpy()).dq
    assert np.abs(after - before).max() > 1e-4
    np.testing.assert_array_equal(after, fresh.step(NOW, poses[8].numpy()).dq)


def test_arguments_are_copied():
    given = {name: torch.full((6,), a).double() for name, a in [("q_min", 0.1), ("q_max", 0.2)]}
    given |= {name: torch.ones(6).double() for name in ("dq_max", "ddq_max", "weights")}
    given["q_pref"] = torch.full((6,), 0.15).double()
    normals, offsets = torch.eye(3).double(), torch.ones(3).double()
    ik = InverseKinematics(CHAIN, **given, tip_limits=(normals, offsets))
    limits = ik.settings.tip_limits
    before = [getattr(ik.settings, name).clone() for name in given]
    before += [limits.normals.clone(), limits.offsets.clone()]
    for a in (*given.values(), normals, offsets):
        a += 1.0
    after = [getattr(ik.settings, name) for name in given] + [limits.normals, limits.offsets]
    for was, now in zip(before, after, strict=True):
        np.testing.assert_array_equal(was, now)


def test_several_threads_share_a_tracker():
    limits = {"q_min": 0.1, "q_max": 0.12, "dq_max": 0.5}
    tracker = InverseKinematics(CHAIN, **limits).tracker(NOW)
    interval, commands, seen = sys.getswitchinterval(), [], []

    def work(first):
        for k in range(first, 3000, 3):
            commands.append(tracker.step(X[k % 60]))
            seen.append(tracker.q)

    threads = [threading.Thread(target=work, args=(first,)) for first in range(3)]
    try:
        sys.setswitchinterval(1e-6)
        [thread.start() for thread in threads]
        [thread.join() for thread in threads]
    finally:
        sys.setswitchinterval(interval)
    assert len(commands) == len(seen) == 3000
    both = np.array(commands + seen)
    assert both.min() >= 0.1
    assert both.max() <= 0.12


def test_a_thread_waits_until_another_one_has_done_its_step():
    inside, go_on, done = threading.Event(), threading.Event(), []

    def slow(q):
        if threading.current_thread() is first:
            inside.set()
            go_on.wait(10.0)
        return CHAIN(q)

    first = threading.Thread()  # not yet
    tracker = InverseKinematics(slow, q_min=0.05, q_max=0.2).tracker(NOW)
    first = threading.Thread(target=lambda: done.append(tracker.step(TARGET)), daemon=True)
    second = threading.Thread(target=lambda: done.append(tracker.step(X[9])), daemon=True)
    first.start()
    assert inside.wait(10.0)
    second.start()
    second.join(0.05)
    assert second.is_alive()
    assert not done
    twin = copy.deepcopy(tracker)  # it has a turn of its own
    assert twin.step(TARGET).shape == (6,)
    go_on.set()
    [thread.join(10.0) for thread in (first, second)]
    assert len(done) == 2


def test_an_error_in_a_step_gives_the_turn_back():
    tracker = InverseKinematics(CHAIN, q_min=0.05, q_max=0.2).tracker(NOW)
    for _ in range(2):
        with pytest.raises(ValueError, match="x_target"):
            tracker.step([1.0, 2.0])
    assert tracker.step(TARGET).shape == (6,)
