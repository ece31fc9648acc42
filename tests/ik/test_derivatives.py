"""Derivatives of solved configurations against the conditions of optimality, in closed form."""

import pytest
import torch
from torch.testing import assert_close

from hybridkin import InverseKinematics
from hybridkin.ik.tasks import PositionTask

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


def test_without_a_posture_nothing_moves_but_for_the_target():
    """The change is the smallest that follows the target: the pseudo-inverse."""
    ik = InverseKinematics(PositionTask(bent, size=2), weights=WEIGHTS)
    target = torch.tensor([0.9, 0.8], dtype=torch.float64, requires_grad=True)
    q = ik.solve(target, Q_PREF, differentiable=True).q
    slope = torch.stack([torch.autograd.grad(a, target, retain_graph=True)[0] for a in q])
    root = WEIGHTS.sqrt()
    J = torch.autograd.functional.jacobian(bent, q.detach())
    assert_close(slope, torch.linalg.pinv(J / root) / root[:, None], rtol=1e-9, atol=1e-12)
