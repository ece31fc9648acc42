"""The scores that choose a blend and a kernel, as pure functions of predictions."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import PlayOperator
from hybridkin._core.model import FunctionModel
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._error_models import NoCorrection
from hybridkin.hybrid._fit import Spec
from hybridkin.hybrid._play import choose_play
from hybridkin.hybrid._radius import Radius, _quantile
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import _OUTSIDE, _chosen, _HeldOut

N, M = 40, 10  # held-out and outer rows
NAMES = ["mechanical", "left", "right"]


def held_out(errors, counts=None, groups=None):
    """Return predictions that are off by errors (K, N + M, 3), of tips at random."""
    rng = np.random.default_rng(0)
    y = rng.standard_normal((N, 3))
    rows = Rows(np.zeros((N, 2)), y, counts, groups)
    outer = np.arange(0, N, N // M)
    predicted = np.concatenate([y, y[outer]]) + errors
    return _HeldOut.of(predicted, rows, np.arange(N) % 5, outer), rows


def random_errors(*sizes):
    rng = np.random.default_rng(1)
    return np.array(sizes)[:, None, None] * rng.standard_normal((len(sizes), N + M, 3))


def test_outer_rows_have_a_tenth_of_the_score_of_the_mechanical_model():
    counts = np.random.default_rng(2).uniform(0.5, 2.0, N)
    found, _ = held_out(random_errors(1.0, 0.3), counts)
    off = np.linalg.norm(found.predicted[0] - found.y, axis=1)
    assert found.weights[:N] @ off[:N] == pytest.approx(1.0 - _OUTSIDE)
    assert found.weights[N:] @ off[N:] == pytest.approx(_OUTSIDE)
    assert_allclose(found.weights[:N] / counts, found.weights[0] / counts[0])
    assert_array_equal(found.counts[N:], counts[:: N // M])
    assert_array_equal(found.fold[N:], found.fold[: N : N // M])


def test_shares_are_tenths_and_the_first_of_equals_is_taken():
    every = np.ones(N + M, dtype=bool)
    noise = random_errors(1.0)[0]
    found, _ = held_out(np.stack([noise, 0.1 * noise, 0.1 * noise]))
    assert_array_equal(found.shares(every), [0.0, 1.0, 0.0])
    found, _ = held_out(np.stack([noise, 0.5 * noise, -0.5 * noise]))
    assert_array_equal(found.shares(every), [0.0, 0.5, 0.5])  # their errors cancel
    found, _ = held_out(np.stack([noise, 0.25 * noise, -0.5 * noise]))
    shares = found.shares(every)
    assert_allclose(shares.sum(), 1.0)
    assert_allclose(shares, [0.0, 0.7, 0.3])  # 2/3 and 1/3
    only = np.arange(N + M) < 7  # of some rows
    errors = np.stack([noise, 0.1 * noise, 0.1 * noise])
    errors[1, 7:] *= 100.0
    assert_array_equal(held_out(errors)[0].shares(only), [0.0, 1.0, 0.0])
    assert_array_equal(held_out(errors)[0].shares(~only), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("groups", [None, np.arange(N) // 4])
def test_a_blend_is_taken_where_it_gains(groups):
    noise = random_errors(1.0)[0]
    found, rows = held_out(np.stack([noise, 0.5 * noise, -0.5 * noise]), groups=groups)
    shares, results = _chosen(NAMES, found, rows)
    assert_array_equal(shares, [0.0, 0.5, 0.5])
    assert results["chosen"] == "blend"
    assert results["candidate"] == [*NAMES, "blend"]
    assert results["weights"] == {"mechanical": 0.0, "left": 0.5, "right": 0.5}
    off = np.linalg.norm(found.predicted - found.y, axis=2)
    assert_allclose(results["mean_distance"], [*off[:, :N].mean(1), 0.0], atol=1e-15)
    assert_allclose(results["io_distance"], [*off[:, N:].mean(1), 0.0], atol=1e-15)
    assert_array_equal(results["rank"][[0, -1]], [4, 1])
    assert results["expected_distance"] == results["mean_distance"][-1]
    by_fold = [off[0, :N][np.arange(N) % 5 == k].mean() for k in range(5)]
    assert_allclose(results["fold_distance"][0], by_fold)
    assert_allclose(results["std_distance"][0], np.std(by_fold, ddof=1))


def test_a_blend_without_a_sure_gain_is_left_alone():
    errors = random_errors(1.0, 1.0, 1.0)
    errors[0] *= 0.8
    found, rows = held_out(errors)
    shares, results = _chosen(NAMES, found, rows)
    gains = results["fold_distance"][0] - results["fold_distance"][-1]
    sure = gains.mean() > gains.std(ddof=1) / np.sqrt(5)
    assert (shares[0] == 1.0) == (not sure)
    errors[1:] *= 5.0
    shares, results = _chosen(NAMES, *held_out(errors))
    assert_array_equal(shares, [1.0, 0.0, 0.0])
    assert results["expected_distance"] == results["mean_distance"][0]
    assert results["chosen"] == "mechanical"


def test_the_quantile_of_groups_and_its_least_number():
    """Of single rows the rank ceil((n + 1) coverage); infinite where that exceeds n."""
    values, groups = np.arange(1.0, 20.0), np.arange(19)
    ones = np.ones(19)
    assert _quantile(values, groups, ones, 0.9) == 18.0
    assert _quantile(values, groups, ones, 0.95) == 19.0
    assert _quantile(values, groups, ones, 0.96) == np.inf
    assert _quantile(values[::-1], groups, ones, 0.5) == 10.0
    assert Radius(1.0, 2.0, 0.95, 19).least_groups == 19
    assert Radius(1.0, 2.0, 0.9, 19).least_groups == 9
    # One group of many rows has the mass of one.
    many = np.concatenate([np.zeros(100, dtype=int), groups[1:]])
    rows = np.concatenate([np.full(100, 50.0), values[:-1]])
    assert _quantile(rows, many, np.ones(118), 0.9) == 18.0
    assert _quantile(rows, many, np.ones(118), 0.95) == 50.0
    assert_array_equal(Radius(1.0, 2.0, 0.9, 9).at(np.array([True, False])), [1.0, 2.0])


def test_a_drift_is_emptied_and_learns_anew():
    rng = np.random.default_rng(0)
    q = rng.uniform(0.1, 0.4, (50, 2))
    new = Drift.of_range(torch.from_numpy(q), 3)
    shift = np.array([0.01, 0.0, -0.02])
    moved = new.learned(q, shift + 1e-4 * rng.standard_normal((50, 3)), np.ones(50), 1.0)
    for part, found in zip(new, moved.emptied(), strict=True):
        assert_array_equal(found, part)
    assert new.likeliest_alpha(1e-4) == np.inf
    alpha = moved.likeliest_alpha(1e-4)
    assert alpha < np.inf
    at = moved.correction(alpha)(torch.from_numpy(q)).numpy()
    assert_allclose(at, np.broadcast_to(shift, at.shape), rtol=0, atol=2e-4)
    # Noise alone is no change: an offset and a slope would not pay.
    rest = new.learned(q, 1e-4 * rng.standard_normal((50, 3)), np.ones(50), 1.0)
    assert rest.likeliest_alpha(1e-4) == np.inf
    assert_array_equal(rest.correction(np.inf)(torch.from_numpy(q)).numpy(), 0.0)


@pytest.mark.slow
@pytest.mark.parametrize("motions", [1, 3])
def test_the_width_of_backlash_is_found_in_the_residuals(motions):
    """Of a robot whose tip follows q behind a play of 4 cm; without groups all is one motion."""
    t = np.linspace(0.0, 4.0 * np.pi, 40 * motions)
    X = 0.1 * np.stack([np.sin(t), np.cos(1.3 * t)], axis=1)
    groups = None if motions == 1 else np.arange(len(t)) // 40
    moved = PlayOperator(0.04).apply_by_group(X, np.zeros(len(t)) if groups is None else groups)
    noise = 1e-4 * np.random.default_rng(0).standard_normal((len(t), 3))
    y = np.column_stack([moved, moved.sum(axis=1)]) + noise
    model = FunctionModel(lambda q: torch.cat([q, q.sum(-1, keepdim=True)], -1))
    spec = Spec(model, NoCorrection())
    found = choose_play(spec, Rows(X, y, None, groups))
    assert found.width == pytest.approx(0.04, rel=0.1)
    assert choose_play(spec, Rows(moved, y, None, groups)) is None
