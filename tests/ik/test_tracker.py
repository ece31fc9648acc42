from itertools import pairwise

import numpy as np
import pytest
import torch

from hybridkin import (
    InverseKinematics,
    robots,
)
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask

CHAIN = robots.bionic_handling_assistant()
NAN = np.full(3, np.nan)


@pytest.fixture
def draw():
    return np.random.default_rng(0)


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


@pytest.mark.parametrize("feedback", ["model", "measured", None])
def test_steps_follow_a_path_as_track_does(feedback):
    def plant(q):
        return tip_of(1.02 * q)

    path, ik = closed_path(50)[:12], InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dt=0.02)
    track = ik.track(path, q0=np.full(9, 0.25), plant=plant, feedback=feedback)
    tracker = ik.tracker(track.q[0])
    for i, (here, ahead) in enumerate(pairwise(path)):
        np.testing.assert_allclose(tracker.q, track.q[i], rtol=0.0, atol=1e-12)
        measured = plant(tracker.q) if feedback == "measured" else None
        target = tip_of(tracker.q) if feedback is None else here
        tracker.step(target, (ahead - here) / 0.02, x_measured=measured)
        np.testing.assert_allclose(tracker.x, track.x[i], rtol=0.0, atol=1e-12)


def test_without_a_reading_the_step_is_that_of_the_model():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, beta=0.0)
    q, target, dx = 0.25 + 0.01 * np.cos(np.arange(9.0)), np.array([0.1, 0.0, 0.7]), np.ones(3)
    tracker = ik.tracker(q)
    new = tracker.step(target, dx, x_measured=NAN)
    np.testing.assert_array_equal(new, q + ik.step(q, target, dx).dq)
    assert tracker.status is IKStatus.INVALID_INPUT


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


def test_a_posture_in_numpy_is_refused_by_name():
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, q_pref=lambda q: np.asarray(q))
    with pytest.raises(TypeError, match="`q_pref` must map torch tensors to torch tensors, got nd"):
        ik.tracker(np.full(9, 0.25)).step([0.0, 0.0, 0.7])
