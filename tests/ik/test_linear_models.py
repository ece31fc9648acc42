"""Truths in closed form: of x = A q every step, track and solution is known."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import InverseKinematics, RigidChain
from hybridkin.ik.solver import IKStatus
from hybridkin.ik.tasks import PositionTask
from hybridkin.ik.trajectories import Trajectory

A = torch.randn(3, 5, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
MODEL = (lambda q: q @ A.T, lambda q: A.expand(*q.shape[:-1], 3, 5))


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
    lower, upper = ik.settings.step_bounds(q, 0.01)
    assert_close(upper, change.expand(2, 5), rtol=1e-12, atol=0.0)
    assert_close(lower, -upper, rtol=0.0, atol=0.0)
    again = ik.step(q, far, dq=step.dq).dq
    assert ((again - step.dq).abs() <= change * (1.0 + 1e-12)).all()
    assert (again.abs().amax(-1) > step.dq.abs().amax(-1)).all()


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


def test_angles_come_into_uneven_limits_by_whole_turns():
    origins = np.tile(np.eye(4), (2, 1, 1))
    arm = RigidChain(origins, [[0.0, 0.0, 1.0]] * 2, tool=[1.0, 0.0, 0.0])
    ik = InverseKinematics(arm, q_min=[0.0, -7.0], q_max=[2.0 * np.pi, 0.0])
    q = torch.tensor([[-0.5, 0.5], [7.0, -8.0], [20.0, -0.5], [3.0, 13.0]], dtype=torch.float64)
    found = ik.settings.inside(q)
    assert ((found >= ik.settings.q_min) & (found <= ik.settings.q_max)).all()
    turns = (found - q) / (2.0 * np.pi)
    assert_close(turns, turns.round(), rtol=0.0, atol=1e-12)
    assert_close(found[2:, 1], q.new_tensor([-0.5, 13.0 - 6.0 * np.pi]), atol=1e-9, rtol=0)


def test_a_gap_in_a_path_stops_the_feed_forward_only_there():
    path = np.linspace(0.0, 0.5, 6)[:, None] * np.array([0.1, -0.2, 0.3])
    path[2, 1] = np.nan
    track = InverseKinematics(MODEL).track(path, q0=np.zeros(5))
    known = [0, 1, 4, 5]  # after the gap one point is missed, because nothing led to it
    np.testing.assert_allclose(track.x[known], path[known], rtol=0.0, atol=1e-12)
    np.testing.assert_allclose(track.x[2:4], path[[1, 1]], rtol=0.0, atol=1e-12)
    assert track.status[2] == IKStatus.INVALID_INPUT


def test_a_posture_costs_no_accuracy():
    """The motion towards it may use up the tolerance; a last step then corrects the error."""

    def bent(q):
        return torch.stack([torch.sin(q[..., 0]) + q[..., 1] ** 2, q[..., 1] + q[..., 2].cos()], -1)

    ik = InverseKinematics(PositionTask(bent, 2), q_min=-1.0, q_max=[1.0] * 3)
    target = torch.tensor([[0.5, 0.9], [0.3, 1.2]], dtype=torch.float64)
    found = ik.solve(target, tol=1e-2)
    assert found.converged.all()
    assert ((found.q > -1.0) & (found.q < 1.0)).all()
    assert (found.error < 1e-4).all()
