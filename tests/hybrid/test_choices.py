"""What a fit chooses, against brute force: kernel, blend, drift, noise, and who gets the groups."""

from dataclasses import replace
from math import inf

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal
from sklearn.base import BaseEstimator, RegressorMixin

from hybridkin import ConstantCurvatureChain, HybridForwardModel
from hybridkin._core.groups import Groups
from hybridkin.hybrid._adapt import _ChangeProblem
from hybridkin.hybrid._drift import MISFITS, SWITCH, Drift
from hybridkin.hybrid._error_models import NoCorrection
from hybridkin.hybrid._features import Features
from hybridkin.hybrid._readout_fit import _ReadoutProblem, fit_readout
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import _is_small
from hybridkin.hybrid._spec import Spec
from hybridkin.hybrid._wrapped import PoseRows, WithPose
from hybridkin.hybrid.held_out import CrossFit, Outer
from hybridkin.hybrid.log_fit import fit_to_log

CHAIN = ConstantCurvatureChain([0.05])
N, M = 40, 10  # held-out and outer rows
NAMES = ["mechanical", "left", "right"]


def log(n, seed=0, noise=1e-4):
    """Return rows of a robot whose tip is off by a linear and a bent error."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.18, 0.26, (n, 3))
    x = CHAIN(torch.from_numpy(q)).numpy() + 0.1 * (q - 0.2) + 2.0 * (q[:, ::-1] - 0.22) ** 2
    return q, x + noise * rng.standard_normal(x.shape)


# Kernel


# Blend


def table_of(tips, y, counts, groups, fold, outer_tips, outer):
    """Return a table of predicted tips, with outer rows at places of the others."""
    names = NAMES[: len(tips)]
    inside = np.ones(tips.shape[:2], dtype=bool)
    beyond = Outer(outer_tips, y[outer], counts[outer], outer)
    motions = Groups.of(groups, len(y))
    return CrossFit(names, tips, inside, y, y, counts, motions, fold, beyond)


def held_out(errors, counts=None, groups=None):
    """Return predictions that are off by errors (K, N + M, 3), of tips at random."""
    rng = np.random.default_rng(0)
    y = rng.standard_normal((N, 3))
    counts = np.ones(N) if counts is None else counts
    outer = np.arange(0, N, N // M)
    fold = np.arange(N) % 5
    return table_of(y + errors[:, :N], y, counts, groups, fold, y[outer] + errors[:, N:], outer)


def random_errors(*sizes):
    rng = np.random.default_rng(1)
    return np.array(sizes)[:, None, None] * rng.standard_normal((len(sizes), N + M, 3))


def picked(table, rows):
    """Return the weights that some of the held-out and the outer rows pick."""
    return table._all_rows.picked(rows)


def test_shares_are_tenths_and_the_first_of_equals_is_taken():
    every = np.ones(N + M, dtype=bool)
    noise = random_errors(1.0)[0]
    found = held_out(np.stack([noise, 0.1 * noise, 0.1 * noise]))
    assert_array_equal(picked(found, every), [0.0, 1.0, 0.0])
    found = held_out(np.stack([noise, 0.5 * noise, -0.5 * noise]))
    assert_array_equal(picked(found, every), [0.0, 0.5, 0.5])  # their errors cancel
    found = held_out(np.stack([noise, 0.25 * noise, -0.5 * noise]))
    shares = picked(found, every)
    assert_allclose(shares.sum(), 1.0)
    assert_allclose(shares, [0.0, 0.7, 0.3])  # 2/3 and 1/3
    only = np.arange(N + M) < 7  # of some rows
    errors = np.stack([noise, 0.1 * noise, 0.1 * noise])
    errors[1, 7:] *= 100.0
    assert_array_equal(picked(held_out(errors), only), [0.0, 1.0, 0.0])
    assert_array_equal(picked(held_out(errors), ~only), [0.0, 0.0, 1.0])


@pytest.mark.parametrize("groups", [None, np.arange(N) // 4])
def test_a_blend_is_taken_where_it_gains(groups):
    noise = random_errors(1.0)[0]
    found = held_out(np.stack([noise, 0.5 * noise, -0.5 * noise]), groups=groups)
    results = found.results()
    assert_array_equal(found.weights, [0.0, 0.5, 0.5])
    assert results["chosen"] == "blend"
    assert results["candidate"] == [*NAMES, "blend"]
    assert results["weights"] == {"mechanical": 0.0, "left": 0.5, "right": 0.5}
    off = np.linalg.norm(found.tips - found.y, axis=2)
    outside = np.linalg.norm(found.outer.tips - found.outer.y, axis=2)
    assert_allclose(results["mean_distance"], [*off.mean(1), 0.0], atol=1e-15)
    assert_allclose(results["io_distance"], [*outside.mean(1), 0.0], atol=1e-15)
    assert results["expected_distance"] == results["mean_distance"][-1]
    by_fold = [off[0][np.arange(N) % 5 == k].mean() for k in range(5)]
    assert_allclose(results["std_distance"][0], np.std(by_fold, ddof=1))


def test_a_gain_in_one_motion_alone_is_not_sure():
    """Every fold has rows of the one motion that gains: only motions show that others do not."""
    groups = np.arange(40) // 10
    errors = np.random.default_rng(0).standard_normal((2, 50, 3))
    errors[1] = (
        errors[0] * np.where(np.concatenate([groups, groups[::4]]) == 0, 0.01, 1.05)[:, None]
    )
    assert held_out(errors).results()["chosen"] == "left"
    assert held_out(errors, groups=groups).results()["chosen"] == "mechanical"


def test_a_blend_is_scored_on_each_fold_with_weights_of_the_others():
    """Each of two models is exact in half of the folds; the other half chooses the wrong one."""
    fold = np.arange(N) % 2
    y = np.zeros((N, 3))
    off = np.stack([np.full(N, 3.0), 0.8 * fold, 1.0 - fold])[..., None] * [1.0, 0.0, 0.0]
    both = table_of(y + off, y, np.ones(N), None, fold, y + off, np.arange(N))
    results = both.results()
    assert_array_equal(both.weights, [0.0, 1.0, 0.0])
    assert_array_equal(both.fold_weights, [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0]])
    assert_allclose(np.linalg.norm(both.chosen.tips, axis=1).mean(), both.expected_error)
    assert_allclose(results["mean_distance"], [3.0, 0.4, 0.5, 0.9])
    assert_allclose(results["io_distance"], [3.0, 0.4, 0.5, 0.9])
    assert results["expected_distance"] == pytest.approx(0.9)


@pytest.mark.parametrize("grouped", [False, True])
def test_weights_of_predictions_are_repetitions(grouped):
    rng = np.random.default_rng(2)
    counts = rng.integers(1, 6, N).astype(float)
    groups = np.arange(N) // 4 if grouped else None
    errors = random_errors(1.2, 1.0, 0.9) + rng.uniform(-1.0, 1.0, (3, 1, 3))
    y = rng.standard_normal((N, 3))
    outer = np.arange(0, N, N // M)
    fold = np.arange(N) % 5
    tips = y + errors[:, :N]
    outer_tips = y[outer] + errors[:, N:]
    weighed = table_of(tips, y, counts, groups, fold, outer_tips, outer)
    many = np.repeat(np.arange(N), counts.astype(int))
    further = np.repeat(np.arange(M), counts[outer].astype(int))
    twice = table_of(
        tips[:, many],
        y[many],
        np.ones(len(many)),
        groups[many] if grouped else None,
        fold[many],
        outer_tips[:, further],
        np.searchsorted(many, outer[further]),
    )
    renamed = np.array([f"motion {k}" for k in groups]) if grouped else None
    scaled = table_of(tips, y, 7.0 * counts, renamed, fold, outer_tips, outer)
    shares, results = weighed.weights, weighed.results()
    assert 0.0 < shares[1] < 1.0
    for other in (twice, scaled):
        other_results = other.results()
        assert_allclose(other.weights, shares)
        assert other_results["chosen"] == results["chosen"]
        for name in ("mean_distance", "std_distance", "io_distance", "expected_distance"):
            assert_allclose(other_results[name], results[name], rtol=1e-12)


def test_the_gain_of_a_blend_is_weighted():
    """In every motion a row that counts often gains, and one that counts once loses more."""
    often = np.arange(N) % 2 == 0
    outer = np.arange(0, N, N // M)
    noise = random_errors(1.0)[0]
    noise /= np.linalg.norm(noise, axis=1, keepdims=True)
    factor = np.where(np.append(often, often[outer]), 0.5, 2.0)[:, None]
    errors = np.stack([noise, factor * noise])
    counts = np.where(often, 9.0, 1.0)
    found = held_out(errors, counts, np.arange(N) // 4)
    results = found.results()
    assert results["weights"]["left"] > 0.5
    assert_allclose(results["mean_distance"][:2], [1.0, (9.0 * 0.5 + 2.0) / 10.0])
    found = held_out(errors, None, np.arange(N) // 4)
    assert found.results()["chosen"] == "mechanical"


class Recorded(NoCorrection):
    """No correction; records to how many rows it was fitted."""

    def __init__(self):
        self.lengths = []

    def fit_tip(self, rows, spec):
        self.lengths.append(len(rows))
        return super().fit_tip(rows, spec)


def test_the_radius_chooses_the_error_model_without_the_held_out_rows():
    model = Recorded()
    found = fit_to_log(Spec(CHAIN, model, coverage=0.5), Rows.of(*log(30)))
    assert model.lengths == [30] + [24] * 5
    assert found.messages == ()
    assert 0.0 < found.radius.inside < inf


@pytest.mark.parametrize(
    ("n_rows", "motions", "small"),
    [(60, None, True), (2, None, False), (120, None, False), (120, 12, True), (90, 45, False)],
)
def test_a_log_is_small_by_its_motions(n_rows, motions, small):
    groups = None if motions is None else np.arange(n_rows) % motions
    assert _is_small(Rows.of(*log(n_rows), groups=groups)) == small


# Who gets what


class OffsetByGroup(RegressorMixin, BaseEstimator):
    """Predicts the mean of the targets; keeps the groups that it was given."""

    def fit(self, X, y, groups=None):
        self.groups_, self.mean_ = groups, np.mean(y, axis=0)
        return self

    def predict(self, X):
        return np.tile(self.mean_, (len(X), 1))


@pytest.mark.parametrize("groups", [None, np.arange(30) // 5])
def test_a_regressor_that_takes_groups_gets_them(groups):
    model = HybridForwardModel(CHAIN, OffsetByGroup(), guard=None).fit(*log(30), groups=groups)
    if groups is None:
        assert model.error_model_.regressor_.groups_ is None
    else:
        assert_array_equal(model.error_model_.regressor_.groups_, groups)


# Noise, and changes of the robot


@pytest.mark.parametrize("size", [0.0, 2.0, 4.0])
def test_the_evidence_of_a_drift_is_that_of_normal_residuals(size):
    """A change has a cost; so has every doubling of the variance of what it does not explain."""
    for seed in range(3):
        rng = np.random.default_rng(seed)
        q, noise = rng.uniform(-1, 1, (12, 2)), 0.01
        new = Drift.of_range(torch.from_numpy(q), 3)
        phi = np.column_stack([np.ones(12), (q - new.center) / new.scale])
        residual = noise * (rng.normal(size=(12, 3)) + 0.3 * size * rng.normal(size=3))

        def evidence(alpha, misfit, phi=phi, residual=residual, noise=noise):
            covariance = misfit * noise**2 * (np.eye(12) + phi @ phi.T / alpha)
            density = multivariate_normal(cov=covariance).logpdf(residual.T).sum()
            return density - np.log2(misfit) - 2.0 * SWITCH * (alpha < inf)

        alphas = [inf, *10.0 ** np.arange(3.0, -6.1, -0.5)]
        best = max(alphas, key=lambda a: max(evidence(a, misfit) for misfit in MISFITS))
        found = new.learned(q, residual, np.ones(12), 1.0).likeliest_alpha(noise)
        assert found == pytest.approx(best)


def test_the_likeliest_noise_is_that_of_the_normal_density():
    """Covariance dx/dq dx/dq' + ratio, but for a factor, over rows that count several times."""
    q = torch.from_numpy(log(30)[0])
    generator = torch.Generator().manual_seed(0)
    counts = torch.randint(1, 4, (30,), generator=generator).double()
    J = CHAIN.forward_and_jacobian(q)[1]
    groups = Groups.rows(len(q))
    problem = _ReadoutProblem(CHAIN, Features.of_range(q), q, q[:, :3], counts, groups, True)
    spread = torch.linalg.eigvalsh(J @ J.mT)
    mean = float((counts[:, None] * spread).sum() / (3.0 * counts.sum()))
    ratios = mean * np.logspace(-2, 4, 25)
    for actuators, tip in ((1e-3, 0.3e-3), (1e-3, 1e-3), (1e-3, 1e-5), (0.0, 1e-3)):
        moved = (J @ torch.randn(30, 3, 1, generator=generator).double())[..., 0]
        residual = actuators * moved + tip * torch.randn(30, 3, generator=generator).double()
        found = problem.likeliest_ratio(residual)

        def density(ratio, residual=residual):
            C = (J @ J.mT + ratio * torch.eye(3)) if ratio < inf else torch.eye(3).expand(30, 3, 3)
            C = C.double()
            level = (residual * torch.linalg.solve(C, residual)).sum(1) @ counts / counts.sum() / 3
            sizes = torch.linalg.slogdet(level * C)[1]  # at this level the squares sum up to one
            return -float(counts @ sizes)

        assert found == pytest.approx(max([inf, *ratios], key=density))


def test_the_derivative_of_a_pose_by_a_change_of_the_robot():
    """Against differences, where the residual is zero and so linear in the change."""
    q = torch.from_numpy(log(4)[0])
    fitted = WithPose.of(CHAIN, [], q.new_zeros(0))
    rows = Rows.of(q.numpy(), np.zeros((4, 6)))
    rng = np.random.default_rng(0)
    theta = rng.uniform(-0.2, 0.2, 9)
    scale = np.full(3, 0.01)
    with torch.no_grad():
        change = _ChangeProblem(fitted, rows, scale).change(theta)
        y = PoseRows(change.after(fitted))(q).numpy()
    problem = _ChangeProblem(fitted, replace(rows, y=y), scale)
    residual, A = problem.linearised(theta)
    assert_allclose(residual, 0.0, atol=1e-9)
    for k in range(9):
        move = 1e-5 * np.eye(9)[k]
        high, low = (problem.linearised(theta + sign * move)[0] for sign in (1.0, -1.0))
        assert_allclose(A[..., k], (low - high) / 2e-5, rtol=0, atol=1e-8)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_actuators_alone_is_found_and_allowed_for(seed):
    rng, chain = np.random.default_rng(seed), ConstantCurvatureChain([0.03])
    q = torch.from_numpy(rng.uniform(0.15, 0.25, (100, 3)))
    off, noise = 0.1 * (q - 0.22), 1e-3 * torch.from_numpy(rng.standard_normal((100, 3)))
    features, x = Features.of_range(q), chain(q + off + noise)
    moved = chain.coordinates(q + off)[0] - chain.coordinates(q)[0]
    rows = Rows.of(q.numpy(), x.numpy())
    found = fit_readout(chain, features, rows)
    ignored = fit_readout(chain, features, rows, alphas=found.alphas)
    assert found.noise_ratio < inf == ignored.noise_ratio
    assert (found.readout(q) - moved).norm() < (ignored.readout(q) - moved).norm()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("noisy", "coupling"), [("actuators", "serial"), ("tips", "serial"), ("tips", "parallel")]
)
def test_weights_of_a_readout_are_repetitions(noisy, coupling):
    """Every score of the search, in metres or in units of the actuators' noise."""
    rng = np.random.default_rng(2)
    q = torch.from_numpy(rng.uniform(0.15, 0.25, (60, 3)))
    noise = 1e-3 * torch.from_numpy(rng.standard_normal((60, 3)))
    chain = ConstantCurvatureChain([0.03])
    off = 0.1 * (q - 0.22) + (noise if noisy == "actuators" else 0.0)
    x = (chain(q + off) + (noise if noisy == "tips" else 0.0)).numpy()
    counts = rng.integers(1, 4, 60)
    places = np.arange(60)
    many = np.repeat(places, counts)
    features = Features.of_range(q)
    weighed = Rows.of(q.numpy(), x, counts.astype(float), places)
    repeated = Rows.of(q.numpy()[many], x[many], None, places[many])
    one, two = (fit_readout(chain, features, rows, coupling) for rows in (weighed, repeated))
    assert (one.noise_ratio < inf) == (noisy == "actuators")
    assert two.noise_ratio == pytest.approx(one.noise_ratio)
    assert two.alphas == one.alphas
    for penalties, score in one.scores.items():
        assert two.scores[penalties] == pytest.approx(score, rel=1e-6)
    assert_allclose(two.residual, one.residual[many], rtol=0, atol=1e-8)
    assert two.rmse == pytest.approx(one.rmse)
    assert_allclose(two.readout(q).numpy(), one.readout(q).numpy(), rtol=0, atol=1e-8)
