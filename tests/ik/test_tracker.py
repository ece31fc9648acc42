import gc
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge
from sklearn.tree import DecisionTreeRegressor

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    datasets,
    robots,
)
from hybridkin._core.model import forward_and_jacobian
from hybridkin.ik._realtime import Controller, numpy_function
from hybridkin.ik.solver import IKStatus
from hybridkin.ik.tasks import PoseTask
from hybridkin.ik.trajectories import figure_eight

CHAIN = robots.bionic_handling_assistant()
DATA = datasets.load_trunk()
LOW, HIGH = DATA.q.min(0), DATA.q.max(0)


@pytest.fixture
def draw():
    return np.random.default_rng(0)


def hybrid(error_model=None, mechanical=CHAIN, **settings):
    model = ELMRegressor(random_state=0) if error_model is None else error_model
    return HybridForwardModel(mechanical, model, **settings).fit(DATA.q, DATA.x)


class Linear(torch.nn.Module):
    """x = A q + b, in torch only."""

    def __init__(self, A, b=(0.0, 0.0, 0.0)):
        super().__init__()
        self.register_buffer("A", torch.tensor(A))
        self.register_buffer("b", torch.tensor(b).double())

    def forward(self, q):
        return q @ self.A.T + self.b


def assert_same(function, module, rows):
    for q in rows:
        before = q.copy()
        x, J = function(q)
        expected = forward_and_jacobian(module, torch.from_numpy(q)[None])
        for value, tensor in zip((x, J), expected, strict=True):
            assert value.dtype == np.float64
            np.testing.assert_allclose(value, tensor[0].numpy(), rtol=1e-12, atol=1e-12)
        np.testing.assert_array_equal(q, before)


# ---------------------------------------------------------------- one configuration of a model


ERROR_MODELS = {
    "elm": ELMRegressor(random_state=0),
    "elm, direct link": ELMRegressor(
        activation="tanh", direct_link=True, fit_intercept=True, random_state=0
    ),
    "elm, sine": ELMRegressor(activation="sin", weight_scale=2.0, random_state=0),
    "ridge": Ridge(),
    "tree": DecisionTreeRegressor(random_state=0),
    "drop": "drop",
}


@pytest.mark.parametrize("guard", ["leverage", "box", None])
@pytest.mark.parametrize("error_model", ERROR_MODELS.values(), ids=ERROR_MODELS)
def test_hybrid_in_numpy_is_the_hybrid(error_model, guard, draw):
    module = hybrid(error_model, guard=guard).module_
    rows = [*DATA.q[::200], *(LOW + (HIGH - LOW) * draw.uniform(-0.4, 1.4, (40, 9)))]
    rows += [*(LOW + (HIGH - LOW) * draw.uniform(0.0, 1.0, (20, 9)))]
    if module.guard is not None:
        weight = module.guard(torch.from_numpy(np.array(rows)))
        assert (weight == 1.0).any()
        assert ((weight > 0.01) & (weight < 0.99)).any()
    assert_same(module.numpy_function(), module, rows)


@pytest.mark.parametrize("guard", ["leverage", "box"])
def test_shortened_corrections_in_numpy(guard, draw):
    module = hybrid(guard=guard).module_
    module.guard.largest.mul_(0.3)
    rows = LOW + (HIGH - LOW) * draw.uniform(-0.2, 1.2, (50, 9))
    long = module.error(torch.from_numpy(rows)).norm(dim=-1) > module.guard.largest
    assert long.any()
    assert not long.all()
    assert_same(module.numpy_function(), module, rows)


def test_error_model_alone_and_the_estimator_in_numpy():
    model = hybrid(mechanical=None)
    assert_same(model.numpy_function(), model.module_, DATA.q[::300])
    with pytest.raises(ValueError, match="not fitted"):
        HybridForwardModel(CHAIN).numpy_function()


def test_any_module_goes_through_torch(draw):
    module = Linear(draw.standard_normal((3, 5)))
    assert_same(numpy_function(module), module, draw.standard_normal((3, 5)))
    single = Linear(draw.standard_normal((3, 5))).float()
    x, J = numpy_function(lambda q: single(q.float()))(np.ones(5))
    assert x.dtype == J.dtype == np.float64
    np.testing.assert_allclose(J, single.A.numpy(), rtol=1e-6)


@pytest.mark.parametrize("kinds", ["rrrrrrr", "rprprrp", "p"])
def test_rigid_chain_in_numpy(kinds, draw):
    n = len(kinds)
    turns = np.linalg.qr(draw.standard_normal((n, 3, 3)))[0]
    turns *= np.linalg.det(turns)[:, None, None]
    origins = np.tile(np.eye(4), (n, 1, 1))
    origins[:, :3, :3], origins[:, :3, 3] = turns, draw.uniform(-0.3, 0.3, (n, 3))
    axes = draw.standard_normal((n, 3))
    axes[0] = [0.0, 0.0, -1.0]
    arm = RigidChain(
        origins,
        axes,
        kinds=["revolute" if kind == "r" else "prismatic" for kind in kinds],
        tip=origins[0],
        tool=[0.1, 0.0, -0.2],
        base=origins[-1],
    )
    assert_same(arm.numpy_function(), arm, draw.uniform(-3.0, 3.0, (20, n)))


def test_functions_keep_what_they_were_made_of_and_results_are_the_callers():
    model = hybrid()
    function = model.numpy_function()
    x, J = (part.copy() for part in function(DATA.q[0]))
    for name in ("output_weights", "leverage_factor", "tangent"):
        getattr(model.module_.error, name).zero_()
    again = function(DATA.q[0])
    function(DATA.q[1])
    np.testing.assert_array_equal(again[0], x)
    np.testing.assert_array_equal(again[1], J)


# ---------------------------------------------------------------- the law


def random_case(draw):
    n = int(draw.choice([3, 4, 7, 9, 12]))
    J = draw.standard_normal((3, n)) * 10.0 ** draw.uniform(-2, 2)
    kind = draw.choice(["plain", "near", "singular", "zero"], p=[0.6, 0.2, 0.15, 0.05])
    if kind == "near":
        J[2] = J[0] - J[1] + 10.0 ** draw.uniform(-3, -1) * J[2]
    elif kind == "singular":
        J[2] = draw.choice([0.0, 1.0]) * J[0]
    elif kind == "zero":
        J *= 0.0
    low, high = -draw.uniform(0, 1, n), draw.uniform(0, 1, n)
    if draw.random() < 0.1:
        high[0] = low[0]  # locked
    q = draw.uniform(-1, 1, n) * draw.choice([0.3, 1.0])
    if draw.random() < 0.8:
        q = np.clip(q, low, high)
    size = max(np.abs(J).max(), 1e-3)
    target = size * draw.standard_normal(3) * 10.0 ** draw.uniform(-3, 1)
    if draw.random() < 0.03:
        target[1] = draw.choice([np.nan, np.inf])
    settings = {
        "q_min": low,
        "q_max": high,
        "dq_max": draw.choice([np.inf, 30.0, 5.0]),
        "limits": str(draw.choice(["saturate", "clip", "off"], p=[0.8, 0.1, 0.1])),
        "beta": draw.choice([0.0, 1.0, 100.0]),
        "gain": draw.choice([None, 50.0]),
        "damping": "adaptive" if draw.random() < 0.8 else 0.05,
        "weights": None if draw.random() < 0.7 else draw.uniform(0.2, 5.0, n),
    }
    dx = None if draw.random() < 0.5 else size * draw.standard_normal(3)
    measured = None if draw.random() < 0.7 else 0.1 * size * draw.standard_normal(3)
    return Linear(J, -J @ q), settings, q, target, dx, measured, size


def test_step_is_that_of_inverse_kinematics():
    draw, kinds = np.random.default_rng(1), set()
    for _ in range(1500):
        module, settings, q, target, dx, measured, size = random_case(draw)
        ik = InverseKinematics(module, **settings)
        step = ik.step(q, target, dx, x_measured=measured)
        controller = Controller(ik, q)
        new = controller.step(target, dx, measured)
        largest = max(1.0, np.abs(step.dq).max())
        np.testing.assert_allclose(new, q + step.dq, rtol=0.0, atol=3e-9 * largest)
        np.testing.assert_allclose(controller.error, step.error, rtol=1e-12, atol=1e-12 * size)
        np.testing.assert_allclose(controller.damping, step.damping, rtol=1e-4, atol=1e-6 * size)
        np.testing.assert_allclose(
            controller.sigma_min, step.sigma_min, rtol=1e-6, atol=1e-6 * size
        )
        np.testing.assert_allclose(controller.x, step.x, atol=1e-12 * size)
        if settings["weights"] is None:  # there a batch is held to rounding only
            np.testing.assert_array_equal(controller.saturated, step.saturated)
        if settings["limits"] != "off":
            inside = np.clip(q, settings["q_min"], settings["q_max"]) == q
            assert (new >= settings["q_min"])[inside].all()
            assert (new <= settings["q_max"])[inside].all()
        kinds.add((bool(step.saturated.any()), bool(step.damping > 0), bool(np.isnan(step.error))))
    assert len(kinds) >= 5


def test_one_step_reaches_the_target_of_a_linear_model(draw):
    A, target = draw.standard_normal((3, 7)), draw.standard_normal(3)
    controller = Controller(InverseKinematics(Linear(A), q_pref=0.5), draw.standard_normal(7))
    np.testing.assert_allclose(A @ controller.step(target), target, atol=1e-12)
    for _ in range(3000):
        q = controller.step(target)
    pinv = np.linalg.pinv(A)
    np.testing.assert_allclose(q, pinv @ target + 0.5 * (1 - pinv @ A @ np.ones(7)), atol=1e-10)


def test_posture_as_a_function(draw):
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, q_pref=lambda q: 0.9 * q + 0.02)
    q, target = np.full(9, 0.25) + 0.02 * draw.standard_normal(9), [0.1, 0.0, 0.7]
    np.testing.assert_allclose(
        Controller(ik, q).step(target), q + ik.step(q, target).dq, atol=1e-12
    )


# ---------------------------------------------------------------- streams


@pytest.mark.parametrize("dq_max", [None, 0.05, 0.01])
@pytest.mark.parametrize("guard", ["leverage", None])
def test_a_streamed_lap_is_the_loop_over_steps(guard, dq_max):
    """Warm starts of the limits change nothing: free, held now and then, held all the time."""
    ik = InverseKinematics(hybrid(guard=guard), q_min=0.17, q_max=0.32, dq_max=dq_max)
    path = figure_eight(DATA.x.mean(0), (0.12, 0.06), duration=2.0).x
    q = ik.solve(path[0]).q
    controller, held, worst = Controller(ik, q), 0, 0.0
    for here, ahead in pairwise(path):
        step = ik.step(q, here, (ahead - here) / ik.dt)
        q = q + step.dq
        new = controller.step(here, (ahead - here) / ik.dt)
        worst, held = max(worst, np.abs(new - q).max()), held + int(step.saturated.any())
        np.testing.assert_array_equal(controller.saturated, step.saturated)
        assert ((new >= 0.17) & (new <= 0.32)).all()
        q = new
    assert worst < 1e-9
    assert {None: held == 0, 0.05: 10 < held < 100, 0.01: held > 150}[dq_max], held


def test_from_outside_the_limits_it_walks_back_at_the_largest_speed():
    ik = InverseKinematics(CHAIN, q_min=0.2, q_max=0.3, dq_max=1.0)
    controller = Controller(ik, np.full(9, 0.25) + 0.1 * (np.arange(9) == 4))
    for i in range(1, 6):
        q = controller.step([0.0, 0.0, 0.75])
        assert q[4] == pytest.approx(0.35 - 0.01 * i)
    for _ in range(20):
        q = controller.step([0.3, 0.0, 0.9])
        assert q.max() <= 0.3
        assert q.min() >= 0.2


def test_closed_loop_on_measured_tips():
    """A robot with an offset that the model does not know: the measured tip arrives."""
    offset, target = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.05, 0.75])
    plant = CHAIN.numpy_function()
    controller = Controller(InverseKinematics(CHAIN, q_min=0.1, q_max=0.4), np.full(9, 0.25))
    for _ in range(20):
        controller.step(target, x_measured=plant(controller.q)[0] + offset)
    assert controller.error < 1e-9
    assert controller.status is IKStatus.CONVERGED
    np.testing.assert_allclose(controller.x, target - offset, atol=1e-9)


def test_status_of_a_tick():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dq_max=1.0)
    controller = Controller(ik, np.full(9, 0.25) + 0.01 * np.cos(np.arange(9)))
    assert controller.status is IKStatus.INVALID_INPUT  # nothing done yet
    target = controller.x + np.array([0.002, 0.0, 0.0])
    controller.step(target)
    assert controller.status is IKStatus.MAX_ITER
    assert not controller.saturated.any()
    controller.step(target)
    assert controller.status is IKStatus.CONVERGED
    controller.step(target + np.array([0.1, 0.0, 0.0]))
    assert controller.status is IKStatus.AT_LIMITS
    assert controller.saturated.any()
    before = controller.q
    for bad in ([np.nan, 0.0, 0.7], [0.0, np.inf, 0.7]):
        np.testing.assert_array_equal(controller.step(bad), before)
        assert controller.status is IKStatus.INVALID_INPUT
    np.testing.assert_array_equal(controller.step(target, x_measured=[np.nan] * 3), before)
    controller.reset(np.full(9, 0.25))  # straight up: it cannot get longer at first
    controller.step([0.0, 0.0, 0.76])
    assert controller.error == pytest.approx(0.01)
    flat = Controller(InverseKinematics(Linear(np.eye(3, 4) * [[1.0], [1.0], [1e-3]])), np.zeros(4))
    flat.step([1.0, 0.0, 0.0])
    assert flat.status is IKStatus.SINGULAR
    assert "SINGULAR" in repr(flat)


@pytest.mark.parametrize("guard", ["leverage", "box"])
def test_status_tells_where_the_error_model_is_not_trusted(guard):
    model = hybrid(guard=guard)
    far = HIGH + 0.3 * (HIGH - LOW)
    for q, status in ((DATA.q[0], IKStatus.CONVERGED), (far, IKStatus.OUT_OF_DOMAIN)):
        controller = Controller(InverseKinematics(model), q)
        controller.step(controller.x)
        assert controller.status is status
        assert model.in_domain(q[None])[0] == (status is IKStatus.CONVERGED)


def test_arrays_are_not_shared():
    q0 = np.full(9, 0.25)
    controller = Controller(InverseKinematics(CHAIN, q_min=0.1, q_max=0.4), q0)
    q0[:] = np.nan
    first = controller.step([0.05, 0.0, 0.75])
    kept = first.copy()
    first[:], controller.q[:], controller.saturated[:] = np.nan, np.nan, True
    np.testing.assert_array_equal(controller.q, kept)
    assert np.isfinite(controller.step([0.05, 0.0, 0.75])).all()
    controller.reset(kept)
    assert np.isnan(controller.error)
    np.testing.assert_array_equal(controller.q, kept)


def test_memory_does_not_grow():
    ik = InverseKinematics(hybrid(), q_min=0.17, q_max=0.32, dq_max=0.05)
    controller = Controller(ik, np.full(9, 0.25))
    path = figure_eight(DATA.x.mean(0), (0.12, 0.06), duration=2.0).x

    def lap():
        for point in path:
            controller.step(point)
        gc.collect()
        return tracemalloc.get_traced_memory()[0]

    tracemalloc.start()
    try:
        lap()
        before = lap()
        assert lap() - before < 2000
    finally:
        tracemalloc.stop()


def test_bad_input_says_what_is_needed():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4)
    for q0 in (np.full(8, 0.25), np.full((1, 9), 0.25), np.full(9, np.nan)):
        with pytest.raises(ValueError, match="`q"):
            Controller(ik, q0)
    with pytest.raises(ValueError, match="`tol` must be positive"):
        Controller(ik, np.full(9, 0.25), tol=0.0)
    with pytest.raises(ValueError, match="tip position"):
        Controller(InverseKinematics(PoseTask(CHAIN)), np.full(9, 0.25))
    with pytest.raises(ValueError, match="least_squares"):
        Controller(InverseKinematics(CHAIN, mode="direction"), np.full(9, 0.25))
    with pytest.raises(ValueError, match=r"`x_target` must have shape \(3,\)"):
        Controller(ik, np.full(9, 0.25)).step([0.0, 0.7])
    planar = InverseKinematics(lambda q: q[..., :2])
    with pytest.raises(ValueError, match="`model` must map"):
        Controller(planar, np.zeros(4))
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        Controller(InverseKinematics(Linear(np.ones((3, 4))), q_min=np.zeros(4)), np.zeros(5))


def test_many_segments_and_more_actuators(draw):
    """Nothing depends on nine actuators or three segments."""
    chain = ConstantCurvatureChain([0.1, 0.09, 0.08, 0.07, 0.06], n_actuators=4)
    ik = InverseKinematics(chain, q_min=0.1, q_max=0.4, dq_max=0.5)
    q = 0.25 + 0.02 * draw.standard_normal(20)
    controller = Controller(ik, q)
    for _ in range(20):
        target = controller.x + 0.05 * draw.standard_normal(3)
        expected = controller.q + ik.step(controller.q, target).dq
        np.testing.assert_allclose(controller.step(target), expected, atol=1e-9)
