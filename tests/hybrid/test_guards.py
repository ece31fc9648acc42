"""How far a correction is trusted: domain, weight, and the bound that stays."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import LinearRegression
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ELMRegressor, HybridForwardModel
from hybridkin.hybrid._guards import GroupDistance, LeverageGuard, QuadraticLeverage
from hybridkin.native import evaluate

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
    ray = torch.linspace(0.0, 6.0, 500).double()[:, None] * rows(1, seed=1)
    distance, weight = guard.domain_distance(ray), guard(ray)[:, 0]
    assert (distance[1:] > distance[:-1]).sum() > 400
    assert (weight[distance <= 3.0] == 1.0).all()
    assert (weight[distance > 3.01] < 1.0).all()
    half = (distance - 6.0).abs().argmin()
    assert_close(weight[half], torch.tensor(0.5).double(), rtol=0, atol=0.05)
    assert weight[-1] < 1e-3


@pytest.mark.parametrize("factor", [2.9, 3.0, 3.3, 8.0])
def test_weight_is_smooth_at_the_limit(factor):
    guard = leverage_guard(2)
    ray = rows(1, 2, seed=2)
    at = ray * torch.linspace(0.5, 9.0, 2001).double()[:, None]
    q = at[(guard.domain_distance(at) - factor).abs().argmin()][None].requires_grad_()
    assert torch.autograd.gradcheck(guard, q, atol=1e-7)
    assert torch.autograd.gradgradcheck(guard, q, atol=1e-4)


def network_guard(alpha, n_rows=200, n=3):
    q = rows(n_rows, n)
    elm = ELMRegressor(120, alpha=alpha, random_state=0).fit(q.numpy(), q.numpy())
    return q, LeverageGuard.fit(elm.module_, q, LONGEST, torch.ones(n_rows).double())


@pytest.mark.parametrize("alpha", [1.0, 0.1, 1e-3])
def test_a_leverage_of_low_rank_keeps_distances_and_weights(alpha):
    q, full = network_guard(alpha)
    guard = full.of_low_rank(q)
    n_features, n_columns = guard.model.leverage_factor.shape
    assert n_columns <= 0.6 * n_features
    assert_close(guard.model(q), full.model(q), rtol=0, atol=0)
    far = q + 3.0 * torch.rand(len(q), 1).double() * rows(len(q), 3, seed=5)
    for at in (q, far, rows(500, 3, seed=6) * 2.5):
        distance = full.domain_distance(at)
        change = (guard.domain_distance(at) - distance) / distance.clamp(min=1.0)
        # Columns that are left out only reduced the leverage.
        assert -1e-9 < change.min()
        assert change.max() < 1e-3
        assert_close(guard(at), full(at), rtol=0, atol=1e-3)
    assert distance.min() < 1.0
    assert distance.max() > 6.0


def test_a_leverage_whose_low_rank_would_cancel_digits_stays_as_it_is():
    q, full = network_guard(1e-9)
    assert full.of_low_rank(q) is full


@pytest.mark.needs_core
def test_the_domain_needs_no_exact_distance_inside():
    q = rows(300, 9).numpy()
    chain = ConstantCurvatureChain([0.05] * 3)
    model = HybridForwardModel(chain, ELMRegressor(120, random_state=0), random_state=0)
    lengths = 0.2 + 0.05 * q
    model.fit(lengths, chain(torch.from_numpy(lengths)).numpy() + 0.01 * q[:, :3] ** 2)
    at = 0.2 + 0.08 * rows(400, 9, seed=3).numpy()
    at = at[model.module_.domain_distance(torch.from_numpy(at)).argsort()]
    exact = evaluate(model.module_, at, value=False, distance=True)[0]
    (enough,) = evaluate(model.module_, at, value=False, distance=True, enough=1.0)
    inside = exact <= 1.0
    assert 40 < inside.sum() < 360
    assert_array_equal(enough <= 1.0, inside)
    assert_allclose(enough[~inside], exact[~inside], rtol=1e-12)
    assert (enough[inside] >= exact[inside] - 1e-12).all()
    assert (enough[inside] > 1.01 * exact[inside]).any()
    assert_array_equal(model.in_domain(at), inside)
    assert_array_equal([model.in_domain(row[None])[0] for row in at], inside)


def two_lines(n_rows=11):
    """Two motions along x, at y = 0 and y = 1; the ranges of both actuators become 2."""
    along = torch.linspace(0.0, 4.0, n_rows).double().repeat(2)
    q = torch.stack([along, torch.zeros(n_rows).double().repeat(2)], 1)
    q[n_rows:, 1] = 1.0
    return q, np.repeat(["a", "b"], n_rows)


def test_group_distance_is_one_as_far_from_the_rows_as_the_other_groups_are():
    q, groups = two_lines()
    found = GroupDistance.fit(q, groups)
    assert_close(found.domain_distance(q), torch.zeros(22).double(), rtol=0, atol=0)
    at = torch.tensor([[2.0, 0.5], [2.0, 2.0], [2.0, -2.0], [8.0, 0.0]], dtype=torch.float64)
    expected = torch.tensor([0.25, 1.0, 4.0, 1.0], dtype=torch.float64)
    assert_close(found.domain_distance(at), expected, rtol=1e-12, atol=0)


def test_group_distance_has_no_units_and_no_order():
    q, groups = rows(60), np.arange(60) // 6
    new, order = rows(20, seed=3), torch.randperm(60, generator=torch.Generator().manual_seed(0))
    expected = GroupDistance.fit(q, groups).domain_distance(new)
    assert expected.min() > 0.0
    scales = torch.tensor([1e-3, 1.0, 7.0, 1e3]).double()
    other = GroupDistance.fit((q * scales)[:, [2, 0, 3, 1]], groups)
    assert_close(other.domain_distance((new * scales)[:, [2, 0, 3, 1]]), expected)
    other = GroupDistance.fit(q[order], groups[order.numpy()])
    assert_close(other.domain_distance(new), expected)


def test_group_distance_of_repeated_motions_is_a_tenth_of_the_range():
    """Held-out repetitions test no distance at all, but the domain must not be empty."""
    q = two_lines()[0].repeat(3, 1)
    found = GroupDistance.fit(q, np.arange(66) // 22)
    assert len(found.rows) == 22
    at = torch.tensor([[2.0, 0.0999], [2.0, 0.1001], [2.0, 0.5]], dtype=torch.float64)
    assert (found.domain_distance(at) <= 1.0).tolist() == [True, False, False]
    assert (found.domain_distance(q) == 0.0).all()


def test_group_distance_ignores_directions_without_data():
    """Balanced tendons: their common pull is no part of the distance."""
    bend = rows(40, 2)
    q = torch.cat([bend, -bend.sum(1, keepdim=True)], 1)
    found = GroupDistance.fit(q, np.arange(40) // 4)
    assert found.axes.shape == (3, 2)
    across = (q.amax(0) - q.amin(0)) ** 2  # of what the rows move along, per range
    pulled = found.domain_distance(q + 0.3 * across)
    assert_close(pulled, found.domain_distance(q), rtol=0, atol=1e-12)


def test_a_long_log_is_fitted_block_by_block(monkeypatch):
    """Its leverages and distances took 6 kB for each row: 6 GB for a million rows."""
    sizes, cdist, leverage = [], torch.cdist, QuadraticLeverage.leverage
    monkeypatch.setattr(
        QuadraticLeverage, "leverage", lambda model, q: sizes.append(len(q)) or leverage(model, q)
    )
    monkeypatch.setattr(torch, "cdist", lambda a, b: sizes.append(len(b)) or cdist(a, b))
    q = 0.25 + 0.05 * rows(9000, 3)
    groups = np.arange(9000) // 90
    chain = ConstantCurvatureChain([0.05])
    model = HybridForwardModel(chain, LinearRegression()).fit(q, chain(q) + 0.1 * q, groups=groups)
    assert 2 * 9000 <= sum(sizes)
    assert max(sizes) <= 4096
    guard, tested = model.module_.corrections[0].guard, model.module_.tested
    h = guard.model.leverage(q)
    assert_close((h / (1.0 - h)).max(), guard.limit, rtol=1e-9, atol=0)
    assert len(tested.rows) == 128
    assert tested.domain_distance(q).max() < 1.0


def test_slope_of_the_group_distance():
    q = rows(1, seed=5).requires_grad_()
    found = GroupDistance.fit(rows(60), np.arange(60) // 6)
    assert torch.autograd.gradcheck(found.domain_distance, q)
    (slope,) = torch.autograd.grad(found.domain_distance(q), q)
    assert slope.abs().min() > 0.0


def corner_log():
    """Single actuators from the shortest configuration, whose error has products of actuators."""
    u = np.zeros((12, 20, 3))
    ends = np.random.default_rng(0).uniform(0.6, 1.0, 12)
    u[np.arange(12), :, np.arange(12) % 3] = ends[:, None] * np.linspace(0.0, 1.0, 20)
    q = 0.16 + 0.1 * u.reshape(-1, 3)
    return q, bent_tips(q), np.arange(240) // 20


def bent_tips(q):
    u = (q - 0.16) / 0.1
    error = np.stack([u[:, 0] * u[:, 1], u[:, 1] * u[:, 2], np.sin(3 * u[:, 2])], 1)
    return ConstantCurvatureChain([0.05])(torch.from_numpy(q)).numpy() + 0.01 * error


def test_motions_of_single_actuators_do_not_vouch_for_what_lies_between():
    q, x, groups = corner_log()
    model = HybridForwardModel(ConstantCurvatureChain([0.05]), LinearRegression())
    new = 0.16 + 0.1 * np.random.default_rng(1).random((500, 3))
    without = model.fit(q, x).in_domain(new).mean()
    weight = model.error_weight(new)
    model.fit(q, x, groups=groups)
    assert model.in_domain(q).all()
    assert without > 0.4
    assert model.in_domain(new).mean() < 0.25
    assert_array_equal(model.error_weight(new), weight)  # that of the guard alone
