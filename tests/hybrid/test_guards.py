"""How far a correction is trusted: domain, weight, and the bound that stays."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin.hybrid._guards import BoxGuard, LeverageGuard, QuadraticLeverage

LONGEST = torch.tensor(0.01).double()


def rows(n_rows, n=4, seed=0):
    return torch.from_numpy(np.random.default_rng(seed).uniform(-1.0, 1.0, (n_rows, n)))


def leverage_guard(n=4):
    q = rows(50, n)
    model = QuadraticLeverage.fit(q)
    return LeverageGuard.fit(model, q, LONGEST, torch.ones(50).double())


def test_weight_of_a_leverage_is_full_up_to_three_times_the_limit():
    """The domain ends at distance 1; the weight is 1/2 at six times the limit."""
    guard = leverage_guard()
    ray = torch.linspace(0.0, 6.0, 4000).double()[:, None] * rows(1, seed=1)
    distance, weight = guard.domain_distance(ray), guard(ray)[:, 0]
    assert (distance[1:] > distance[:-1]).sum() > 3000
    assert (weight[distance <= 3.0] == 1.0).all()
    assert (weight[distance > 3.01] < 1.0).all()
    half = (distance - 6.0).abs().argmin()
    assert_close(weight[half], torch.tensor(0.5).double(), rtol=0, atol=0.01)
    assert weight[-1] < 1e-3


def test_weight_of_a_box_fades_from_its_edge():
    guard = BoxGuard(-torch.ones(2).double(), torch.ones(2).double(), LONGEST)
    q = torch.tensor(
        [[1.0, -1.0], [1.2, 0.0], [1.4, 0.0]], dtype=torch.float64
    )  # a tenth and two of 2
    expected = torch.tensor([[1.0], [1 / 2], [1 / 65]], dtype=torch.float64)
    assert_close(guard(q), expected, rtol=1e-12, atol=0)


@pytest.mark.parametrize("factor", [2.9, 3.0, 3.3, 8.0])
def test_weight_is_smooth_at_the_limit(factor):
    guard = leverage_guard(2)
    ray = rows(1, 2, seed=2)
    at = ray * torch.linspace(0.5, 9.0, 20001).double()[:, None]
    q = at[(guard.domain_distance(at) - factor).abs().argmin()][None].requires_grad_()
    assert torch.autograd.gradcheck(guard, q, atol=1e-7)
    assert torch.autograd.gradgradcheck(guard, q, atol=1e-4)
