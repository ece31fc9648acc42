"""A model that changes after its inverse kinematics was made: what uses it from which moment."""

import copy

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
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


def as_numpy(a):
    return a.numpy(force=True) if isinstance(a, torch.Tensor) else np.array(a)


def as_torch(a):
    return torch.tensor(a)


class Uses:
    """One model in all that evaluates it; arrays are NumPy or torch."""

    def __init__(self, model, array):
        self.model, self.array = model, array
        self.ik = InverseKinematics(model, q_min=0.05, q_max=0.2)
        self.tracker = self.ik.tracker(array(NOW))

    def tick(self):
        return as_numpy(self.tracker.step(self.array(TARGET)))

    def answers(self):
        now, target, ik = self.array(NOW), self.array(TARGET), self.ik
        results = {
            "step": ik.step(now, target).dq,
            "solve": ik.solve(target, now, max_iter=8, restarts=0).q,
            "track": ik.track(self.array(X[8:10]), q0=now).q,
            "tracker": ik.tracker(now).step(target),
            "stored": Plan(ik.settings.write_plan).data,
        }
        self.tracker.reset(now)
        results["reset"] = self.tick()
        if isinstance(self.model, HybridForwardModel):
            results["predict"] = self.model.predict(Q[:3])
            results["jacobian"] = self.model.jacobian(Q[:3])
        return {name: as_numpy(a) for name, a in results.items()}


def check(model, change, array, running):
    """Check that all uses of a changed model are those of a copy made afterwards.

    `running` says whether the change reaches the tracker that runs.
    """
    model = copy.deepcopy(model)
    uses = Uses(model, array)
    before = uses.answers()
    uses.tracker.reset(array(NOW))
    change(model if change in REFITS else getattr(model, "module_", model))
    tick, after = uses.tick(), uses.answers()
    expected = Uses(copy.deepcopy(model), array).answers()
    for name, answer in after.items():
        np.testing.assert_array_equal(answer, expected[name], err_msg=name)
        assert not np.array_equal(answer, before[name])
    np.testing.assert_array_equal(tick, (expected if running else before)["reset"])


def partial_fit(model):
    model.partial_fit(Q[:20], X[:20] + MOVED)


def adapt(model):
    model.adapt(Q[:8], X[:8] + MOVED)


def fit(model):
    model.fit(Q, X + MOVED)


def chain_of(model):
    return getattr(model, "mechanical", model)


def in_place(model):
    chain_of(model).base[0, 3] += 0.05
    chain_of(model).base[:3, :2] *= -1.0


def data(model):
    chain_of(model).base.data[:] = ELSEWHERE


def transposed_data(model):
    chain_of(model).base.data = chain_of(model).base.data.T


def by_numpy(model):
    chain_of(model).base.numpy()[:] = ELSEWHERE


def reassigned(model):
    chain_of(model).base = ELSEWHERE.clone()


def state(model):
    name = next(name for name in model.state_dict() if name.endswith("base"))
    model.load_state_dict({**model.state_dict(), name: ELSEWHERE})


def attribute(model):
    chain_of(model)._set_markers([(1.5, 0.0, 0.0, 0.0)])


def learned(model):
    model.corrections[0].module.output_weights.numpy()[:] *= -2.0


def weight(model):
    model.weights.data *= 0.5


REFITS = [fit, partial_fit, adapt]
EDITS = [in_place, data, transposed_data, by_numpy, reassigned, state, attribute]
KINDS = [as_numpy, pytest.param(as_torch, marks=pytest.mark.slow)]
IN_TORCH = pytest.param(adapt, as_torch, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def hybrid():
    return fitted()


@pytest.mark.parametrize(("change", "array"), [*((refit, as_numpy) for refit in REFITS), IN_TORCH])
def test_a_refit_reaches_all_that_was_made_before(hybrid, change, array):
    check(hybrid, change, array, running=True)


@pytest.mark.parametrize("change", [*EDITS, learned, weight])
def test_an_edit_reaches_all_but_a_running_tracker(hybrid, change):
    check(hybrid, change, as_numpy, running=False)


@pytest.mark.parametrize("change", EDITS)
def test_so_does_an_edit_of_a_chain(change):
    check(CHAIN, change, as_numpy, running=False)


@pytest.mark.parametrize("array", KINDS)
def test_a_refit_changes_neither_place_nor_speed(array):
    """Limits of speed and acceleration hold over the refit."""
    model = copy.deepcopy(fitted())
    limits = {"q_min": 0.05, "q_max": 0.2, "dq_max": 0.02, "ddq_max": 0.2, "dt": 0.01}
    ik = InverseKinematics(model, **limits)
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


@pytest.mark.parametrize("array", KINDS)
def test_a_refit_makes_a_tracker_forget_the_offset(array):
    """The offset was between the measured tip and the earlier model."""
    uses = Uses(fitted(), array)
    nowhere, target = uses.array(np.full(3, np.nan)), uses.array(TARGET)
    for refit in (lambda model: None, adapt):
        tracker = uses.ik.tracker(uses.array(NOW), memory=10.0)
        tracker.step(target, x_measured=uses.array(as_numpy(tracker.x) + 0.001))
        refit(uses.model)
        for _ in range(6):
            tracker.step(target, x_measured=nowhere)
        missed = np.linalg.norm(as_numpy(tracker.x) - TARGET)
        assert (missed < 1e-5) == (refit is adapt)


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


def test_limits_that_the_model_gives_are_those_of_its_present_zeros():
    """Chambers are longer than nothing: `q_min` moves with the zeros that `adapt` finds."""
    model = HybridForwardModel(CHAIN, "linear", guard=None).fit(Q, X)
    ik = InverseKinematics(model, q_max=0.2)
    base = np.zeros(3)  # all chambers as short as they can be
    shortest = ik.solve(base, NOW).q
    model.adapt(Q[:40] + 0.03, X[:40], parameters=["actuator_zeros"])
    q_min = as_numpy(InverseKinematics(model, q_max=0.2).settings.q_min)
    np.testing.assert_allclose(q_min, 0.03, atol=0.01)
    assert (shortest < q_min).any()
    assert (ik.solve(base, NOW + 0.03).q >= q_min).all()
    assert (ik.tracker(NOW + 0.03).step(base) >= q_min).all()
