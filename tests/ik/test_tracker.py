import gc
from itertools import pairwise

import numpy as np
import pytest
import torch

from hybridkin import (
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    robots,
)
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask
from hybridkin.ik.trajectories import figure_eight

CHAIN = robots.bionic_handling_assistant()
DATA = datasets.load_trunk()
LOW, HIGH = DATA.q.min(0), DATA.q.max(0)
NAN = np.full(3, np.nan)


@pytest.fixture
def draw():
    return np.random.default_rng(0)


@pytest.fixture(scope="module")
def hybrids():
    def fitted(guard):
        return HybridForwardModel(CHAIN, ELMRegressor(random_state=0), guard=guard)

    return {guard: fitted(guard).fit(DATA.q, DATA.x) for guard in ("leverage", "box", None)}


def tip_of(q):
    return CHAIN(torch.from_numpy(q)).numpy()


class Linear(torch.nn.Module):
    """x = A q + b, in torch only."""

    def __init__(self, A, b=(0.0, 0.0, 0.0)):
        super().__init__()
        self.register_buffer("A", torch.tensor(A))
        self.register_buffer("b", torch.tensor(b).double())

    def forward(self, q):
        return q @ self.A.T + self.b


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
        "limits": str(draw.choice(["saturate", "off"], p=[0.8, 0.2])),
        "beta": draw.choice([0.0, 1.0, 100.0]),
        "gain": draw.choice([None, 50.0]),
        "damping": "adaptive" if draw.random() < 0.8 else 0.05,
        "weights": None if draw.random() < 0.7 else draw.uniform(0.2, 5.0, n),
    }
    dx = None if draw.random() < 0.5 else size * draw.standard_normal(3)
    measured = None if draw.random() < 0.7 else 0.1 * size * draw.standard_normal(3)
    return Linear(J, -J @ q), settings, q, target, dx, measured


@pytest.mark.slow
def test_step_is_that_of_inverse_kinematics():
    draw, kinds = np.random.default_rng(1), set()
    for _ in range(300):
        module, settings, q, target, dx, measured = random_case(draw)
        ik = InverseKinematics(module, **settings)
        step = ik.step(q, target, dx, x_measured=measured)
        tracker = ik.tracker(q)
        new = tracker.step(target, dx, x_measured=measured)
        np.testing.assert_array_equal(new, q + step.dq)
        for name in ("error", "damping", "sigma_min", "x", "saturated"):
            np.testing.assert_array_equal(getattr(tracker, name), getattr(step, name))
        if settings["limits"] != "off":
            inside = np.clip(q, settings["q_min"], settings["q_max"]) == q
            assert (new >= settings["q_min"])[inside].all()
            assert (new <= settings["q_max"])[inside].all()
        kinds.add((bool(step.saturated.any()), bool(step.damping > 0), bool(np.isnan(step.error))))
    assert len(kinds) >= 5


@pytest.mark.slow
def test_one_step_reaches_the_target_of_a_linear_model(draw):
    A, target = draw.standard_normal((3, 7)), draw.standard_normal(3)
    ik = InverseKinematics(Linear(A), q_pref=0.5, beta=20.0)
    tracker = ik.tracker(draw.standard_normal(7))
    np.testing.assert_allclose(A @ tracker.step(target), target, atol=1e-12)
    for _ in range(150):
        q = tracker.step(target)
    pinv = np.linalg.pinv(A)
    np.testing.assert_allclose(q, pinv @ target + 0.5 * (1 - pinv @ A @ np.ones(7)), atol=1e-10)


def test_posture_as_a_function(draw):
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, q_pref=lambda q: 0.9 * q + 0.02)
    q, target = np.full(9, 0.25) + 0.02 * draw.standard_normal(9), [0.1, 0.0, 0.7]
    np.testing.assert_array_equal(ik.tracker(q).step(target), q + ik.step(q, target).dq)


def test_any_task_is_followed(draw):
    limits, q = {"q_min": 0.1, "q_max": 0.4}, 0.25 + 0.02 * draw.standard_normal(9)
    start = torch.from_numpy(q)
    cases = [
        (PoseTask(CHAIN), CHAIN.pose(start)),
        (PointsTask(CHAIN, [1.5, 3.0]), torch.stack([CHAIN.with_tip(1.5)(start), CHAIN(start)])),
    ]
    for task, target in cases:
        ik = InverseKinematics(task, **limits)
        tol = [1e-4] * len(task.parts)
        tracker = ik.tracker(torch.full((9,), 0.25, dtype=torch.float64), tol=tol)
        for _ in range(15):
            expected = tracker.q + ik.step(tracker.q, target).dq
            torch.testing.assert_close(tracker.step(target), expected, rtol=0.0, atol=0.0)
        assert tracker.status is IKStatus.CONVERGED
        assert tracker.x.shape == target.shape


# ---------------------------------------------------------------- streams


def closed_path(n):
    phase = 2.0 * np.pi * np.arange(n + 1) / n
    height = 0.75 + 0.05 * np.cos(phase)
    return np.stack([0.1 * np.sin(phase), 0.06 * np.sin(2.0 * phase), height], axis=1)


@pytest.mark.slow
@pytest.mark.parametrize("feedback", ["model", "measured", None])
def test_steps_follow_a_path_as_track_does(feedback):
    def plant(q):
        return tip_of(1.02 * q)

    path, ik = closed_path(50), InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dt=0.02)
    track = ik.track(path, plant=plant, feedback=feedback)
    tracker = ik.tracker(track.q[0])
    for i, (here, ahead) in enumerate(pairwise(path)):
        np.testing.assert_allclose(tracker.q, track.q[i], rtol=0.0, atol=1e-12)
        measured = {"model": None, "measured": plant(tracker.q), None: NAN}[feedback]
        tracker.step(here, (ahead - here) / 0.02, x_measured=measured)
        np.testing.assert_allclose(tracker.x, track.x[i], rtol=0.0, atol=1e-12)
        if feedback == "measured":
            assert tracker.error == pytest.approx(track.error[i], abs=1e-12)


def test_without_a_reading_the_step_is_feed_forward():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, beta=0.0)
    q, target, dx = 0.25 + 0.01 * np.cos(np.arange(9.0)), np.array([0.1, 0.0, 0.7]), np.ones(3)
    tracker = ik.tracker(q)
    np.testing.assert_array_equal(tracker.step(target, x_measured=NAN), q)
    assert tracker.status is IKStatus.INVALID_INPUT
    new = tracker.step(target, dx, x_measured=NAN)
    np.testing.assert_array_equal(new, q + ik.step(q, target, dx, x_measured=target).dq)


def test_what_is_remembered_fades():
    ik, target, q = (
        InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dt=0.02),
        np.array([0.0, 0.0, 0.75]),
        np.full(9, 0.25),
    )
    offset = np.array([0.02, 0.0, 0.0])
    for age in (0, 1, 5):
        tracker = ik.tracker(q, memory=0.1)
        tracker.step(target, x_measured=tip_of(q) + offset)
        for _ in range(age):
            tracker.step(target, x_measured=NAN)
        moved = tip_of(tracker.q) - target
        # The model's tip goes to where the robot's would be right, and comes back with time.
        np.testing.assert_allclose(moved, -np.exp(-0.02 * age / 0.1) * offset, atol=2e-3)
    tracker.reset(q)
    tracker.step(target, x_measured=NAN)
    np.testing.assert_array_equal(tracker.q, q + ik.step(q, target).dq)


def test_a_remembered_offset_outlives_a_target_that_is_not_known():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, beta=0.0)
    q, target, offset = np.full(9, 0.25), np.array([0.0, 0.02, 0.75]), np.array([0.02, 0.0, 0.0])
    tracker = ik.tracker(q, memory=1e9)
    held = tracker.step(target, x_measured=tip_of(q) + offset)
    np.testing.assert_array_equal(tracker.step(NAN, x_measured=tip_of(held) + offset), held)
    expected = held + ik.step(held, target, x_measured=tip_of(held) + offset).dq
    np.testing.assert_allclose(tracker.step(target, x_measured=NAN), expected, rtol=0.0, atol=1e-9)


def test_from_outside_the_limits_it_walks_back_at_the_largest_speed():
    ik = InverseKinematics(CHAIN, q_min=0.2, q_max=0.3, dq_max=1.0)
    tracker = ik.tracker(np.full(9, 0.25) + 0.1 * (np.arange(9) == 4))
    for i in range(1, 6):
        q = tracker.step([0.0, 0.0, 0.75])
        assert q[4] == pytest.approx(0.35 - 0.01 * i)
    for _ in range(20):
        q = tracker.step([0.3, 0.0, 0.9])
        assert q.max() <= 0.3
        assert q.min() >= 0.2


def test_closed_loop_on_measured_tips():
    """A robot with an offset that the model does not know: the measured tip arrives."""
    offset, target = np.array([0.01, -0.02, 0.005]), np.array([0.1, 0.05, 0.75])
    tracker = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4).tracker(np.full(9, 0.25))
    for _ in range(20):
        tracker.step(target, x_measured=tip_of(tracker.q) + offset)
    assert tracker.error < 1e-9
    assert tracker.status is IKStatus.CONVERGED
    np.testing.assert_allclose(tracker.x, target - offset, atol=1e-9)


def test_status_of_a_tick():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dq_max=1.0)
    tracker = ik.tracker(np.full(9, 0.25) + 0.01 * np.cos(np.arange(9)))
    assert tracker.status is IKStatus.INVALID_INPUT  # nothing done yet
    target = tracker.x + np.array([0.002, 0.0, 0.0])
    tracker.step(target)
    assert tracker.status is IKStatus.MAX_ITER
    assert not tracker.saturated.any()
    tracker.step(target)
    assert tracker.status is IKStatus.CONVERGED
    tracker.step(target + np.array([0.1, 0.0, 0.0]))
    assert tracker.status is IKStatus.AT_LIMITS
    assert tracker.saturated.any()
    before = tracker.q
    for bad in ([np.nan, 0.0, 0.7], [0.0, np.inf, 0.7]):
        np.testing.assert_array_equal(tracker.step(bad), before)
        assert tracker.status is IKStatus.INVALID_INPUT
        np.testing.assert_array_equal(tracker.step(target, bad), before)
        assert tracker.status is IKStatus.INVALID_INPUT
        np.testing.assert_array_equal(tracker.step(bad, x_measured=NAN), before)
    tracker.reset(np.full(9, 0.25))  # straight up: it cannot get longer at first
    tracker.step([0.0, 0.0, 0.76])
    assert tracker.error == pytest.approx(0.01)
    flat = InverseKinematics(Linear(np.eye(3, 4) * [[1.0], [1.0], [1e-3]])).tracker(np.zeros(4))
    flat.step([1.0, 0.0, 0.0])
    assert flat.status is IKStatus.SINGULAR
    assert "SINGULAR" in repr(flat)
    assert flat.backend.startswith("torch: ")


@pytest.mark.parametrize("guard", ["leverage", "box"])
def test_status_shows_where_the_error_model_is_not_trusted(hybrids, guard):
    model = hybrids[guard]
    far = HIGH + 0.3 * (HIGH - LOW)
    for q, status in ((DATA.q[0], IKStatus.CONVERGED), (far, IKStatus.OUT_OF_DOMAIN)):
        tracker = InverseKinematics(model).tracker(q)
        tracker.step(tracker.x)
        assert tracker.status is status
        assert model.in_domain(q[None])[0] == (status is IKStatus.CONVERGED)


def test_arrays_are_not_shared():
    q0 = np.full(9, 0.25)
    tracker = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4).tracker(q0)
    q0[:] = np.nan
    first = tracker.step([0.05, 0.0, 0.75])
    kept = first.copy()
    first[:], tracker.q[:], tracker.saturated[:], tracker.x[:] = np.nan, np.nan, True, np.nan
    np.testing.assert_array_equal(tracker.q, kept)
    assert np.isfinite(tracker.step([0.05, 0.0, 0.75])).all()
    tracker.reset(kept)
    assert np.isnan(tracker.error)
    np.testing.assert_array_equal(tracker.q, kept)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_commands_are_of_the_kind_of_the_start(dtype):
    ik, q0 = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4), torch.full((9,), 0.25, dtype=dtype)
    tracker, arrays = ik.tracker(q0), ik.tracker(q0.numpy())
    q = tracker.step([0.05, 0.0, 0.75])
    q0[:], kept = torch.nan, q.clone()
    assert q.dtype == tracker.x.dtype == dtype
    np.testing.assert_array_equal(arrays.step([0.05, 0.0, 0.75]), q.numpy())
    assert arrays.q.dtype == q.numpy().dtype
    q[:] = torch.nan
    torch.testing.assert_close(tracker.q, kept, rtol=0.0, atol=0.0)
    assert isinstance(InverseKinematics(CHAIN).tracker([0.25] * 9).q, np.ndarray)


@pytest.mark.slow
def test_memory_does_not_grow(hybrids):
    ik = InverseKinematics(hybrids["leverage"], q_min=0.17, q_max=0.32, dq_max=0.05)
    tracker = ik.tracker(np.full(9, 0.25), memory=1.0)

    def tensors_after(n):
        for point in figure_eight(DATA.x.mean(0), (0.12, 0.06), duration=0.01 * n).x:
            tracker.step(point, x_measured=point)
        gc.collect()
        return sum(type(a) is torch.Tensor for a in gc.get_objects())

    before = tensors_after(20)
    assert tensors_after(50) == before


def test_bad_input_says_what_is_needed():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4)
    for q0 in (np.full(8, 0.25), np.full((1, 9), 0.25), np.full(9, np.nan)):
        with pytest.raises(ValueError, match=r"`q` must be finite and of shape \(9,\)"):
            ik.tracker(q0)
    with pytest.raises(ValueError, match="`tol` must be positive"):
        ik.tracker(np.full(9, 0.25), tol=0.0)
    for memory in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="`memory` must be a positive time"):
            ik.tracker(np.full(9, 0.25), memory=memory)
    tracker = ik.tracker(np.full(9, 0.25))
    with pytest.raises(ValueError, match=r"`x_target` must have shape \(3,\)"):
        tracker.step([0.0, 0.7])
    with pytest.raises(ValueError, match=r"`x_measured` must have shape \(3,\)"):
        tracker.step([0.0, 0.0, 0.7], x_measured=np.zeros((1, 3)))
    with pytest.raises(ValueError, match=r"`dx` must have shape \(6,\)"):
        InverseKinematics(PoseTask(CHAIN)).tracker(tracker.q).step(np.eye(4), np.zeros(3))
    with pytest.raises(ValueError, match="`model` must map"):
        InverseKinematics(lambda q: q[..., :2]).tracker(np.zeros(4))
    with pytest.raises(ValueError, match=r"shape \(4,\)"):
        InverseKinematics(Linear(np.ones((3, 4))), q_min=np.zeros(4)).tracker(np.zeros(5))


@pytest.mark.parametrize("as_array", [np.array, torch.tensor])
def test_a_number_too_large_for_a_float_is_refused(as_array):
    tracker = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4).tracker(as_array([0.25] * 9))
    with pytest.raises(ValueError, match="`x_target` must be numeric"):
        tracker.step([10**400, 0, 0])
    assert np.isfinite(np.asarray(tracker.step([0.0, 0.0, 0.7]))).all()


def test_a_posture_in_numpy_is_refused_by_name():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, q_pref=lambda q: np.asarray(q))
    with pytest.raises(TypeError, match="`q_pref` must map torch tensors to torch tensors, got nd"):
        ik.tracker(np.full(9, 0.25)).step([0.0, 0.0, 0.7])
