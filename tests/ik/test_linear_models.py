"""Truths in closed form: of x = A q every step, track and solution is known."""

import warnings

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, InverseKinematics
from hybridkin.ik._starts import even_starts
from hybridkin.ik.solver import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask, PositionTask
from hybridkin.ik.trajectories import Trajectory

A = torch.randn(3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
MODEL = (lambda q: q @ A.T, lambda q: A.expand(*q.shape[:-1], 3, 5))
TENDONS = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2)


def test_a_trajectory_brings_its_times_and_t_goes_before_them():
    x = np.linspace(0.0, 0.03, 4)[:, None] * np.ones(3)
    path, ik = Trajectory([0.0, 0.02, 0.05, 0.06], x), InverseKinematics(MODEL)
    track = ik.track(path, q0=np.zeros(5))
    np.testing.assert_array_equal(track.t, path.t)
    np.testing.assert_array_equal(track.target, x)
    np.testing.assert_allclose(track.x, x, rtol=0.0, atol=1e-12)  # feed-forward is exact
    assert (track.status == IKStatus.CONVERGED).all()
    np.testing.assert_array_equal(ik.track(path, path.t + 1.0, q0=np.zeros(5)).t, path.t + 1.0)
    np.testing.assert_allclose(ik.track(x, q0=np.zeros(5)).t, [0.0, 0.01, 0.02, 0.03])
    with pytest.raises(ValueError, match="`t` must be finite and increasing"):
        ik.track(x, [0.0, 0.01, 0.01, 0.02], q0=np.zeros(5))


def test_the_first_step_starts_at_rest():
    """With a limit of acceleration, and by default as if the step before were zero."""
    ik = InverseKinematics(MODEL, ddq_max=torch.arange(1.0, 6.0, dtype=torch.float64))
    q, far = torch.zeros(2, 5, dtype=torch.float64), 9.0 * torch.ones(2, 3, dtype=torch.float64)
    step = ik.step(q, far)
    assert_close(step.dq, ik.step(q, far, dq=q).dq, rtol=0.0, atol=0.0)
    change = 1e-4 * torch.arange(1.0, 6.0, dtype=torch.float64)
    assert (step.dq.abs() <= change).all()
    assert (step.dq.abs() == change).any(-1).all()
    assert step.saturated.any(-1).all()
    again = ik.step(q, far, dq=step.dq).dq
    assert ((again - step.dq).abs() <= change * (1.0 + 1e-12)).all()
    assert (again.abs().amax(-1) > step.dq.abs().amax(-1)).all()


@pytest.mark.parametrize("low", [-torch.inf, -0.4])
def test_starts_fill_a_range_around_the_first_one_where_there_are_no_limits(low):
    ik = InverseKinematics(MODEL, q_min=low)
    q = [[1.0, 0.0, -1.0, 0.5, 2.0], [-0.3, 0.0, 0.1, -0.4, 5.0]]
    q = torch.tensor(q, dtype=torch.float64)
    size = torch.tensor([0.25, 2.0], dtype=torch.float64)
    starts = even_starts(ik.settings, q, size, 500)
    assert starts.shape == (2, 500, 5)
    lowest = q - size[:, None] if low == -torch.inf else torch.full_like(q, low)
    highest = q.clamp(min=low) + size[:, None]
    assert_close(starts.amin(1), lowest, rtol=0.0, atol=1e-12)  # its faces too
    assert_close(starts.amax(1), highest, rtol=0.0, atol=1e-12)
    middle = 0.5 * (lowest + highest)
    assert ((starts.mean(1) - middle).abs() <= 0.05 * (highest - lowest)).all()


def test_rows_without_limits_start_again_each_around_itself():
    """A model that is flat at the first start: only further starts, around it, reach the target."""

    def flat(q):
        return torch.relu(q.abs() - 0.3)

    ik = InverseKinematics(PositionTask(flat, size=2))
    q0 = torch.zeros(3, 2, dtype=torch.float64)
    target = torch.tensor([[0.4, 0.2], [0.1, 0.3], [0.0, 0.0]], dtype=torch.float64)
    found = ik.solve(target, q0)
    assert found.converged.all()
    assert_close(flat(found.q), target, rtol=0.0, atol=1e-4)
    assert (found.n_starts[:2] > 1).all()
    assert found.n_starts[2] == 1


def test_poses_in_millimetres_are_noticed_by_their_position():
    pose = np.eye(4)
    pose[2, 3] = 190.0
    ik = InverseKinematics(PoseTask(TENDONS), q_pref=0.0)
    with pytest.warns(UserWarning, match=r"`x_target` spans 190 m.*metres"):
        ik.solve(pose, max_iter=1, restarts=0)
    with pytest.warns(UserWarning, match=r"`path` spans 190 m"):
        ik.track(pose[None], q0=np.zeros(6))
    points = InverseKinematics(PointsTask(TENDONS, [1.0, 2.0]), q_pref=0.0)
    with pytest.warns(UserWarning, match=r"`x_target` spans 150 m"):
        points.solve([[0.0, 0.0, 0.1], [0.0, 0.0, 150.0]], max_iter=1, restarts=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        pose[2, 3] = 0.19
        ik.solve(pose, max_iter=1, restarts=0)


def test_parts_of_a_task_have_their_own_tolerances():
    """An error of two parts is reached where each is within its own, in its own unit."""
    task = PoseTask(TENDONS, radian=0.5)
    error = torch.tensor([[3e-3, 0.0, 4e-3, 0.0, 1e-2, 0.0]] * 3, dtype=torch.float64)
    error[1, 0], error[2, 4] = 3.1e-3, 1.1e-2
    assert task.reached(error, (5e-3, 2e-2)).tolist() == [True, False, False]
    assert task.reached(error[:1], 0.5e-2).tolist() == [False]
    assert task.reached(error[:1], 1.2e-2).tolist() == [True]
    with pytest.raises(ValueError, match="`radian` must be positive metres, got 0"):
        PoseTask(TENDONS, radian=0)
    with pytest.raises(ValueError, match=r"`weights` must be positive.*for 2 points"):
        PointsTask(TENDONS, [1.0, 2.0], weights=[1.0])


def test_distances_between_poses_are_those_of_the_error_for_small_turns():
    draw = torch.Generator().manual_seed(1)
    q = 1e-3 * torch.randn(5, 6, generator=draw, dtype=torch.float64)
    poses, targets, task = TENDONS.pose(q), TENDONS.pose(q.flip(0))[:3], PoseTask(TENDONS, 0.3)
    expected = torch.stack(
        [task.difference(poses, t.expand(5, 4, 4)).norm(dim=-1) for t in targets]
    )
    assert_close(task.distances(poses[None], targets), expected, rtol=1e-2, atol=1e-9)
    rows = poses.expand(3, 5, 4, 4)
    assert_close(task.distances(rows, targets), expected, rtol=1e-2, atol=1e-9)
    half = torch.diag(torch.tensor([-1.0, -1.0, 1.0, 1.0], dtype=torch.float64))
    far = task.distances(torch.eye(4, dtype=torch.float64)[None, None], half[None])
    assert_close(far, far.new_full((1, 1), 0.3 * 2.0))  # the chord of half a turn is 2
