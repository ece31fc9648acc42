"""Derivatives of solved configurations against the conditions of optimality, in closed form."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, InverseKinematics, RigidChain
from hybridkin.ik.tasks import PoseTask, PositionTask

Q_PREF = torch.tensor([0.3, -0.2, 0.1, 0.4], dtype=torch.float64)
WEIGHTS = torch.tensor([1.0, 4.0, 0.5, 2.0], dtype=torch.float64)


def bent(q):
    """Map four actuators to two coordinates, none of them alone nor straight."""
    a, b, c, d = q.unbind(-1)
    return torch.stack([a + 0.4 * b * c + 0.3 * d**2, b - 0.5 * a * d + 0.2 * c**2 + c], dim=-1)


def optimality(q, weights, free):
    """Return dq/dx from the derivatives of W (q - q_pref) = J' mu and f(q) = x."""
    J = torch.autograd.functional.jacobian(bent, q)[:, free]
    wish = (weights * (q - Q_PREF))[free]
    mu = torch.linalg.lstsq(J.T, wish[:, None]).solution[:, 0]
    assert_close(J.T @ mu, wish, rtol=0.0, atol=1e-9)  # the solution is optimal
    curved = torch.autograd.functional.hessian(lambda q: mu @ bent(q), q)[free][:, free]
    n = len(wish)
    system = torch.zeros(n + 2, n + 2, dtype=torch.float64)
    system[:n, :n] = torch.diag(weights[free]) - curved
    system[:n, n:], system[n:, :n] = -J.T, J
    right = torch.zeros(n + 2, 2, dtype=torch.float64)
    right[n:] = torch.eye(2)
    return torch.linalg.solve(system, right)[:n]


@pytest.mark.parametrize("weights", [None, WEIGHTS], ids=["alike", "weighted"])
@pytest.mark.parametrize("held", [False, True])
def test_derivatives_obey_the_conditions_of_optimality(weights, held):
    options = {"q_pref": Q_PREF, "weights": weights, "q_min": -2.0, "q_max": 2.0}
    if held:  # the second actuator would like to go further
        options["q_max"] = torch.tensor([2.0, -0.15, 2.0, 2.0], dtype=torch.float64)
    ik = InverseKinematics(PositionTask(bent, size=2), **options)
    target = torch.tensor([[0.9, 0.8], [0.7, 1.1]], dtype=torch.float64, requires_grad=True)
    solution = ik.solve(target, tol=1e-6, differentiable=True)
    assert solution.converged.all()
    assert_close(bent(solution.q), target, rtol=0.0, atol=1e-13)  # polished
    rows = [torch.autograd.grad(a.sum(), target, retain_graph=True)[0] for a in solution.q.mT]
    slope = torch.stack(rows, dim=1)
    free = torch.tensor([True, not held, True, True])
    assert (slope[:, ~free] == 0.0).all()
    for q, found in zip(solution.q.detach(), slope, strict=True):
        assert (q[~free] == -0.15).all()
        expected = optimality(q, torch.ones(4) if weights is None else weights, free)
        assert_close(found[free], expected, rtol=1e-7, atol=1e-9)


# J of full rank is the exception: planar arms, pairs of tendons, locked actuators, five joints.


def arm(links, axes):
    origins = np.stack([np.eye(4)] * len(links))
    origins[1:, 0, 3] = links[:-1]
    return RigidChain(origins, axes, tool=[links[-1], 0.0, 0.0])


PLANAR = arm([0.3, 0.25, 0.2], [[0, 0, 1]] * 3)
FIVE = arm([0.1, 0.3, 0.25, 0.1, 0.1], [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [1, 0, 0]])
PAIRS = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3, n_actuators=2)
TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
BEND = [0.3, 0.5, -0.4]
PULLS = [0.004, -0.004, 0.003, -0.003, -0.002, 0.002]
LENGTHS = [0.2, 0.25, 0.3, 0.22, 0.24, 0.3, 0.21, 0.27, 0.25]
TURNS = {"q_min": -2.0, "q_max": 2.0}
PULLED = {"q_min": -0.02, "q_max": 0.02}
LOCKED = {"q_min": [0.1, 0.1, *LENGTHS[2:]], "q_max": [0.4, 0.4, *LENGTHS[2:]]}
DEFICIENT = {
    "planar arm": (PLANAR, BEND, TURNS, 1e-4),
    "no posture": (arm([0.3, 0.25], [[0, 0, 1]] * 2), BEND[:2], {**TURNS, "beta": 0.0}, 1e-4),
    "pose of five joints": (PoseTask(FIVE), [*BEND, 0.6, 0.2], TURNS, 1e-4),
    "pairs of tendons": (PAIRS, PULLS, {**PULLED, "q_pref": PULLS[::-1]}, 1e-5),
    "locked": (TRUNK, LENGTHS, LOCKED, 1e-5),
    "limits": (TRUNK, LENGTHS, {"q_min": 0.1, "q_max": 0.27, "q_pref": 0.27}, 1e-5),
}


def slope_of(q, t):
    """Return dq/dt of a solution by a scalar."""
    return torch.stack([torch.autograd.grad(a, t, retain_graph=True)[0] for a in q])


def difference(solve, start, h):
    """Return dq/dt at 0 from differences of solutions, to the fourth order."""
    ends = {}
    for k in (-2, -1, 1, 2):
        solution = solve(torch.tensor(k * h, dtype=torch.float64), start)
        assert solution.converged
        ends[k] = solution.q.detach()
    return (8.0 * (ends[1] - ends[-1]) - (ends[2] - ends[-2])) / (12.0 * h)


@pytest.mark.slow
@pytest.mark.parametrize("name", DEFICIENT)
def test_derivatives_in_reachable_directions_are_those_of_the_solutions(name):
    task, q, options, h = DEFICIENT[name]
    ik = InverseKinematics(task, **options)
    settings = ik.settings
    start = settings.inside(torch.tensor(q, dtype=torch.float64))
    x = settings.evaluate(start[None])[0][0].requires_grad_()
    start = ik.solve(x, start, tol=1e-9, differentiable=True).q.detach()
    low, high = settings.box(start)
    free = (start > low) & (start < high)
    way = torch.where(free, torch.cos(2.0 * torch.arange(len(start)).double()), 0.0)

    def solve(t, q0):
        moving = settings.evaluate((start + t * way)[None])[0][0]
        moving = moving if moving.requires_grad else moving.requires_grad_()
        return ik.solve(moving, q0, tol=1e-9, differentiable=True)

    t = torch.zeros((), dtype=torch.float64, requires_grad=True)
    expected = difference(solve, start, h)
    assert expected.abs().max() > 0.1
    assert_close(slope_of(solve(t, start).q, t), expected, rtol=1e-8, atol=1e-8)


def test_singular_solutions_have_no_derivatives_and_say_so():
    tendons = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2, routing="base")
    bent = torch.tensor([0.004, -0.002, 0.001, 0.003, -0.004, 0.002]).double()
    target = tendons(torch.stack([0.0 * bent, bent])).requires_grad_()
    ik = InverseKinematics(tendons, **PULLED)
    with pytest.warns(UserWarning, match="1 of 2 solutions"):
        solution = ik.solve(target, differentiable=True)
    assert solution.converged.all()
    (slope,) = torch.autograd.grad(solution.q.sum(), target)
    assert (slope[0] == 0.0).all()
    assert (slope[1] != 0.0).all()
