"""Nearest points of polyhedra: the conditions that only the optimum meets, on random problems."""

import math

import pytest
import torch
from scipy.optimize import linprog

from hybridkin.ik._nearest import Polyhedron, nearest


def drawn(rng, N, n, m, k, dtype=torch.float64):
    """Return points and polyhedra that hold at least one point each."""

    def normal(*shape):
        return torch.randn(*shape, generator=rng, dtype=dtype)

    def uniform(*shape):
        return torch.rand(*shape, generator=rng, dtype=dtype)

    middle, half = 0.3 * normal(N, n), uniform(N, n)
    lower, upper = middle - half, middle + half
    inside = lower + uniform(N, n) * (upper - lower)
    E, A = normal(N, m, n), normal(N, k, n)
    A = A / A.norm(dim=-1, keepdim=True)
    e = (E @ inside[..., None])[..., 0]
    b = (A @ inside[..., None])[..., 0] + uniform(N, k) * (uniform(N, k) < 0.5)
    lower[::7, 0], upper[::5, -1] = -math.inf, math.inf
    most = torch.full_like(b, math.inf)
    return normal(N, n), Polyhedron(E, e, lower, upper, A, b, most)


@pytest.mark.parametrize(("n", "m", "k"), [(3, 0, 4), (9, 3, 0), (9, 3, 12), (7, 2, 32)])
def test_the_way_to_the_nearest_point_is_a_push_of_what_holds_it(n, m, k):
    """No point of the polyhedron is farther along the way back: the optimum of a linear programme.

    For a convex set this holds at the nearest point, and at no other one.
    """
    rng = torch.Generator().manual_seed(n + k)
    points, within = drawn(rng, 60, n, m, k)
    x, _ = nearest(points, within)
    assert within.excess(x).max() < 1e-13
    way = points - x
    for i in range(len(x)):
        E, A = within.E[i].numpy(), within.A[i].numpy()
        bounds = torch.stack([within.lower[i], within.upper[i]], 1).numpy()
        farthest = linprog(
            -way[i].numpy(),
            A_ub=A if k else None,
            b_ub=within.b[i].numpy() if k else None,
            A_eq=E if m else None,
            b_eq=within.e[i].numpy() if m else None,
            bounds=bounds,
        )
        assert farthest.success
        assert -farthest.fun <= float(way[i] @ x[i]) + 1e-9
        if m:
            torch.testing.assert_close(within.E[i] @ x[i], within.e[i], rtol=0.0, atol=1e-12)
    assert (way.norm(dim=1) > 0.1).sum() > 50


def test_rows_that_contradict_are_relaxed_the_last_one_first_and_no_farther_than_told():
    unit = torch.eye(2, dtype=torch.float64)
    box = -torch.ones(2, 2).double(), torch.ones(2, 2).double()
    none = torch.zeros(2, 0).double()
    # x >= 2, which the box does not allow; then y >= 0.5 and y <= 0.
    A = torch.stack([-unit[0], -unit[1], unit[1]]).expand(2, -1, -1)
    b = torch.tensor([[-2.0, -0.5, 0.0]]).double().repeat(2, 1)
    most = torch.tensor([[math.inf] * 3, [math.inf, math.inf, 0.0]]).double()
    within = Polyhedron(none[..., None].expand(2, 0, 2), none, *box, A, b, most)
    x, _ = nearest(torch.zeros(2, 2).double(), within)
    torch.testing.assert_close(x, torch.tensor([[1.0, 0.5], [1.0, 0.0]]).double())


def test_a_problem_with_a_nan_touches_no_other_one():
    points, within = drawn(torch.Generator().manual_seed(0), 12, 6, 2, 5)
    expected, _ = nearest(points, within)
    points[3, 2] = math.nan
    found, _ = nearest(points, within)
    others = torch.arange(12) != 3
    torch.testing.assert_close(found[others], expected[others], rtol=0.0, atol=1e-12)


def test_single_precision_is_as_exact_as_it_can_be():
    points, within = drawn(torch.Generator().manual_seed(1), 50, 9, 3, 8)
    expected, _ = nearest(points, within)
    found, _ = nearest(points.float(), Polyhedron(*(a.float() for a in within)))
    assert (found - expected).abs().max() < 2e-4


def test_rows_that_meet_in_one_point_lead_there():
    """Two dozen rows that leave one point: what is missing by rounding is no contradiction."""
    rng = torch.Generator().manual_seed(5)
    points, within = drawn(rng, 300, 6, 0, 24)
    there = torch.clamp(torch.zeros_like(points), within.lower, within.upper)
    b = (within.A @ there[..., None])[..., 0]
    met = within._replace(b=b)
    x, _ = nearest(points, met)
    assert met.excess(x).max() < 1e-11
