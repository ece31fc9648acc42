import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, InverseKinematics, RigidChain
from hybridkin.ik.solver import IKStatus
from hybridkin.ik.tasks import PoseTask

TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
AS = {
    "numpy": lambda a: np.asarray(a, dtype=float),
    "torch": lambda a: torch.tensor(a, dtype=torch.float64),
}


def planar(*lengths, **options):
    """Return an arm of links in the plane z = 0."""
    origins = np.tile(np.eye(4), (len(lengths), 1, 1))
    origins[1:, 0, 3] = lengths[:-1]
    axes = np.tile([0.0, 0.0, 1.0], (len(lengths), 1))
    return RigidChain(origins, axes, tool=[lengths[-1], 0.0, 0.0], **options)


def elbows(x, y, a=0.3, b=0.2):
    """Both solutions of the planar arm with two links."""
    bend = math.acos((x * x + y * y - a * a - b * b) / (2.0 * a * b))
    return [
        [math.atan2(y, x) - math.atan2(b * math.sin(s), a + b * math.cos(s)), s]
        for s in (bend, -bend)
    ]


@pytest.mark.parametrize("kind", AS)
def test_both_elbows_nearest_first_and_no_third(kind):
    make = AS[kind]
    ik = InverseKinematics(planar(0.3, 0.2), q_min=-math.pi, q_max=math.pi)
    target = make([[[0.3, 0.2, 0.0], [0.9, 0.0, 0.0]], [[np.nan, 0.0, 0.0], [0.1, -0.3, 0.0]]])
    q0 = make([0.5, -1.0])
    solution = ik.solve(target, q0, tol=1e-6, n_solutions=3)
    names = [[IKStatus(int(s)).name for s in row] for row in solution.status.reshape(4, 3)]
    assert names[0] == names[3] == ["CONVERGED", "CONVERGED", "NO_FURTHER"]
    assert names[1] == ["UNREACHABLE", "NO_FURTHER", "NO_FURTHER"]
    assert names[2] == ["INVALID_INPUT", "NO_FURTHER", "NO_FURTHER"]
    assert solution.q.shape == (2, 2, 3, 2)
    for place, (x, y) in (((0, 0), (0.3, 0.2)), ((1, 1), (0.1, -0.3))):
        both = sorted(elbows(x, y), key=lambda q: math.dist(q, [0.5, -1.0]))
        found = torch.as_tensor(solution.q[place])
        assert_close(found[:2], torch.tensor(both).double(), rtol=0.0, atol=1e-4)
        assert found[2].isnan().all()
    single = ik.solve(target, q0, tol=1e-6)
    assert_close(single.error[0, 1], solution.error[0, 1, 0])
    assert single.q.shape == (2, 2, 2)
    first = ik.solve(target[0, 0], q0, tol=1e-6, n_solutions=1)
    assert_close(first.q, solution.q[0, 0, :1], rtol=0.0, atol=1e-9)


def test_turns_of_a_joint_are_one_configuration_near_the_start():
    ik = InverseKinematics(planar(0.3, 0.2), q_min=-2.0 * math.pi, q_max=2.0 * math.pi)
    q0 = np.array([2.5, -2.0])
    solution = ik.solve(np.array([0.3, 0.2, 0.0]), q0, n_solutions=4)
    assert solution.converged.tolist() == [True, True, False, False]
    assert (np.abs(solution.q[:2] - q0) <= math.pi + 1e-9).all()
    assert len({tuple(row.round(3)) for row in np.mod(solution.q[:2], 2.0 * math.pi)}) == 2


def test_several_are_refused_where_they_cannot_be():
    ik, x = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4), torch.tensor([0.0, 0.0, 0.7])
    with pytest.raises(ValueError, match="`n_solutions` must be 1 to"):
        ik.solve(x, n_solutions=0)
    with pytest.raises(ValueError, match="`n_solutions` must be None for differentiable=True"):
        ik.solve(x, n_solutions=2, differentiable=True)
    with pytest.raises(ValueError, match="finite `q_min` and `q_max`"):
        InverseKinematics(TRUNK).solve(x, q0=[0.2] * 9, n_solutions=2)


@pytest.mark.parametrize("kind", AS)
@pytest.mark.parametrize("task", [lambda arm: arm, PoseTask], ids=["position", "pose"])
def test_a_joint_turns_on_beyond_its_limit(kind, task):
    """From 3 rad to -3 rad the short way leads through the limit, as of one that is at 3.1."""
    arm, make = planar(0.3, 0.2), AS[kind]
    goal = torch.tensor([-3.0, 0.7]).double()
    target = arm.pose(goal) if task is PoseTask else arm(goal)
    for limit, converged in ((math.pi, True), (2.0 * math.pi, True), (3.1, False)):
        ik = InverseKinematics(task(arm), q_min=-limit, q_max=limit, beta=0.0)
        solution = ik.solve(make(target.tolist()), make([3.0, 0.7]), restarts=0, max_iter=30)
        q = torch.as_tensor(solution.q)
        assert bool(solution.converged) == converged
        assert (q.abs() <= limit).all()
        if converged:
            assert_close(torch.cos(q - goal), torch.ones(2).double(), rtol=0.0, atol=1e-5)


def test_reached_parts_stay_reached_to_the_end(rng):
    """A last step may lower the whole error and raise that of the position above its tolerance."""
    arm = planar(0.3, 0.2, 0.1)
    target = arm.pose(2.0 * torch.rand(400, 3, generator=rng).double() - 1.0)
    ik = InverseKinematics(PoseTask(arm), q_min=-1.5, q_max=1.5)
    for poses in (target, target.numpy()):
        solution = ik.solve(poses, tol=(1e-3, 1e-2), n_solutions=None)
        assert solution.converged.all()
