"""What a fit chooses, against brute force: kernel, blend, drift, noise, and who gets the groups."""

import dataclasses
from math import inf

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.stats import multivariate_normal
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold

from hybridkin import ConstantCurvatureChain, HybridForwardModel, load_model, save_model
from hybridkin.hybrid import _radius, _selection
from hybridkin.hybrid._adapt import _Problem
from hybridkin.hybrid._drift import MISFITS, SWITCH, Drift
from hybridkin.hybrid._error_models import (
    _LEAST,
    KernelModel,
    NamedFeatures,
    NoCorrection,
    RegressorModel,
    Residuals,
)
from hybridkin.hybrid._features import Features
from hybridkin.hybrid._fit import Spec, fit_hybrid
from hybridkin.hybrid._kernel import _ALPHAS, _GAMMAS, folds_of, tuned_kernel
from hybridkin.hybrid._linearised import choose
from hybridkin.hybrid._pose import WithPose
from hybridkin.hybrid._readout_fit import _Problem as ReadoutProblem
from hybridkin.hybrid._readout_fit import fit_readout
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import _chosen, _HeldOut, select
from hybridkin.hybrid._settings import check_settings

CHAIN = ConstantCurvatureChain([0.05])


def log(n, seed=0, noise=1e-4):
    """Return rows of a robot whose tip is off by a linear and a bent error."""
    rng = np.random.default_rng(seed)
    q = rng.uniform(0.18, 0.26, (n, 3))
    x = CHAIN(torch.from_numpy(q)).numpy() + 0.1 * (q - 0.2) + 2.0 * (q[:, ::-1] - 0.22) ** 2
    return q, x + noise * rng.standard_normal(x.shape)


# Kernel


def kernel_scores(X, y, weights):
    """Return the sum of held-out distances of every width and penalty, by solved systems."""
    squares = ((X[:, None] - X) ** 2).sum(-1) / X.var(axis=0).mean()
    scores = np.zeros((len(_GAMMAS), len(_ALPHAS)))
    for i, gamma in enumerate(_GAMMAS):
        K = np.exp(-gamma * squares)
        for train, test in folds_of(X, None):
            for j, alpha in enumerate(_ALPHAS):
                system = K[np.ix_(train, train)] + alpha * np.diag(1.0 / weights[train])
                found = K[np.ix_(test, train)] @ np.linalg.solve(system, y[train])
                scores[i, j] += weights[test] @ np.linalg.norm(found - y[test], axis=1)
    return scores


@pytest.mark.parametrize("frequency", [0.1, 0.5, 1.0, 1.5, 2.0, 2.5])
def test_the_kernel_is_better_than_all_its_neighbours(frequency):
    rng = np.random.default_rng(0)
    X = rng.uniform(-3.0, 3.0, (30, 1))
    y = np.sin(frequency * X + [0.0, 1.0]) + 0.02 * rng.standard_normal((30, 2))
    weights = rng.integers(1, 4, 30).astype(float)
    found, scores = tuned_kernel(X, y, weights, None), kernel_scores(X, y, weights)
    i = int(np.argmin(np.abs(np.log(np.array(_GAMMAS) / (found.gamma * X.var())))))
    j = _ALPHAS.index(found.alpha)
    assert found.gamma == pytest.approx(_GAMMAS[i] / X.var())
    near = scores[max(i - 1, 0) : i + 2, max(j - 1, 0) : j + 2]
    assert scores[i, j] <= near.min() * (1.0 + 1e-9)


def test_the_kernel_does_not_depend_on_the_unit_of_its_inputs():
    q, x = log(40)
    ones = np.ones(40)
    plain, scaled = (tuned_kernel(unit * q, x, ones, None) for unit in (1.0, 1024.0))
    assert scaled.alpha == plain.alpha
    assert scaled.gamma == pytest.approx(plain.gamma / 1024.0**2)


def test_folds_of_groups_are_drawn():
    X, groups = np.zeros((60, 2)), np.repeat(np.arange(12), 5)
    expected = GroupKFold(10, shuffle=True, random_state=0).split(X, groups=groups)
    for pair, (train, test) in zip(folds_of(X, groups), expected, strict=True):
        assert_array_equal(pair[0], train)
        assert_array_equal(pair[1], test)


# Blend


def held_out(errors, n, groups=None, counts=None):
    """Return predictions off by errors (K, N + M, 3); every fourth of N rows is an outer one."""
    rng = np.random.default_rng(0)
    y, outer = rng.standard_normal((n, 3)), np.arange(0, n, 4)
    rows = Rows(np.zeros((n, 2)), y, counts, groups)
    predicted = np.concatenate([y, y[outer]]) + errors
    return _HeldOut.of(predicted, rows, np.arange(n) % 5, outer), rows


@pytest.mark.parametrize("seed", range(4))
def test_a_blend_adds_ten_times_the_candidate_that_lowers_its_score_most(seed):
    rng = np.random.default_rng(seed)
    sizes = rng.uniform(0.5, 1.5, (4, 1, 1))
    counts = rng.uniform(0.5, 2.0, 40)
    found, rows = held_out(sizes * rng.standard_normal((4, 50, 3)), 40, counts=counts)
    weights = np.concatenate([counts, counts[::4]])
    far = np.linalg.norm(found.predicted - found.y, axis=2)
    weights[:40] *= 0.9 / (counts @ far[0, :40])
    weights[40:] *= 0.1 / (counts[::4] @ far[0, 40:])
    picked = []
    for _ in range(10):
        scores = []
        for k in range(4):
            mean = np.mean([found.predicted[i] for i in (*picked, k)], axis=0)
            scores.append(float(weights @ np.linalg.norm(mean - found.y, axis=1)))
        picked.append(int(np.argmin(scores)))
    expected = np.bincount(picked, minlength=4) / 10.0
    assert 1 < (expected > 0.0).sum()
    assert_allclose(found.shares(np.ones(50, dtype=bool)), expected, atol=1e-15)
    assert_allclose(found.weights, weights)
    assert rows.groups is None


def test_a_gain_in_one_motion_alone_is_not_sure():
    """Every fold has rows of the one motion that gains: only motions show that others do not."""
    n, groups = 40, np.arange(40) // 10
    errors = np.random.default_rng(0).standard_normal((2, 50, 3))
    errors[1] = (
        errors[0] * np.where(np.concatenate([groups, groups[::4]]) == 0, 0.01, 1.05)[:, None]
    )
    names = ["mechanical", "learned"]
    assert _chosen(names, *held_out(errors, n))[1]["chosen"] == "learned"
    assert _chosen(names, *held_out(errors, n, groups))[1]["chosen"] == "mechanical"


def few_candidates(_):
    return {
        "mechanical": NoCorrection(),
        "parallel linear": NamedFeatures("linear", "parallel"),
        "parallel kernel": KernelModel(),
    }


def test_the_kernel_is_tried_on_logs_that_are_not_large(monkeypatch):
    monkeypatch.setattr(_selection, "_candidates", few_candidates)
    rows = Rows(*log(30))
    candidates = [*few_candidates(None), "blend"]
    monkeypatch.setattr(_selection, "_MOST", 31)
    assert select(Spec(CHAIN), rows)[1]["candidate"] == candidates
    monkeypatch.setattr(_selection, "_MOST", 29)
    candidates.remove("parallel kernel")
    assert select(Spec(CHAIN), rows)[1]["candidate"] == candidates


@pytest.mark.parametrize("groups", [None, np.arange(30) // 2])
def test_penalties_are_settled_by_folds_of_motions(groups, monkeypatch):
    """On all rows, folds of motions are held out; without motions, single rows."""
    seen = []

    def fit(spec, rows):
        seen.append(rows.groups)
        return fit_hybrid(spec, rows)

    monkeypatch.setattr(_selection, "_candidates", few_candidates)
    monkeypatch.setattr(_selection, "fit_hybrid", fit)
    rows = Rows(*log(30), groups=groups)
    select(Spec(CHAIN), rows)
    of_all_rows = [labels for labels in seen if labels is not None and len(labels) == len(rows.X)]
    assert len(of_all_rows) == (0 if groups is None else 3)  # once for each candidate
    for labels in of_all_rows:
        for k, (_, test) in enumerate(folds_of(rows.X, groups)):
            assert_array_equal(labels[test], k)


def test_the_radius_chooses_the_error_model_without_the_held_out_rows(monkeypatch):
    lengths, spec = [], Spec(CHAIN, NoCorrection())

    def chosen(_, part):
        lengths.append(len(part))
        return spec, {}, {}

    monkeypatch.setattr(_radius, "select", chosen)
    rows = Rows(*log(30))
    found, message = _radius.conformal_radius(
        dataclasses.replace(spec, error_model=None), rows, 0.5
    )
    assert lengths == [24] * 5
    assert (found, message) == _radius.conformal_radius(spec, rows, 0.5)
    assert 0.0 < found.inside < inf


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
        assert model.error_model_.groups_ is None
    else:
        assert_array_equal(model.error_model_.groups_, groups)


def test_several_markers_have_an_error_model_each_or_none():
    chain = CHAIN.with_markers([(0, 0.5), (0, 1.0)])
    q, _ = log(30)
    x = chain(torch.from_numpy(q)).numpy() + 0.001
    assert HybridForwardModel(chain, "drop").fit(q, x).error_model_ is None
    found = HybridForwardModel(chain, "linear").fit(q, x).error_model_
    assert len(found) == 2
    assert found[0].rmse < 1e-6


def test_residuals_of_rows_left_out_are_computed_unless_they_are_not_wanted():
    spec = Spec(CHAIN, NamedFeatures("linear", "parallel", (1.0, 1.0)))
    rows = Rows(*log(30))
    assert np.isfinite(fit_hybrid(spec, rows).error.result.residual).all()
    spec = dataclasses.replace(spec, left_out=False)
    assert np.isnan(fit_hybrid(spec, rows).error.result.residual).all()


@pytest.mark.parametrize(
    ("settings", "kind", "message"),
    [
        ({"calibrate": "radii"}, ValueError, "`calibrate` must be a sequence of names"),
        ({"calibrate": 3}, ValueError, "`calibrate` must be a sequence of names"),
        ({"error_model": Ridge()}, TypeError, "inside the robot"),
        ({"error_model": "kernel"}, TypeError, "inside the robot"),
    ],
)
def test_settings_that_do_not_fit(settings, kind, message):
    with pytest.raises(kind, match=message):
        check_settings(HybridForwardModel(CHAIN, coupling="serial", **settings))
    check_settings(HybridForwardModel(CHAIN, coupling="serial", calibrate="auto"))


def test_a_radius_that_cannot_be_is_refused(tmp_path):
    model = HybridForwardModel(CHAIN, "drop", coverage=0.5).fit(*log(30))
    known = model.radius_
    for change in ({"coverage": 1.5}, {"coverage": 0.0}, {"n_rows": inf}):
        model.radius_ = known._replace(**change)
        save_model(model, tmp_path / "model.safetensors")
        with pytest.raises(ValueError, match="`radius` must hold"):
            load_model(tmp_path / "model.safetensors")


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
    problem = ReadoutProblem(CHAIN, Features.of_range(q), q, q[:, :3], counts, serial=True)
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


class Memory(RegressorMixin, BaseEstimator):
    """Predicts the targets of the rows it was fitted to, all of them off by a length."""

    def __init__(self, off):
        self.off = off

    def fit(self, X, y):
        self.X_, self.y_ = X, y
        return self

    def predict(self, X):
        nearest = ((X[:, None] - self.X_) ** 2).sum(-1).argmin(1)
        return self.y_[nearest] + self.off


def test_a_regressor_that_knows_its_rows_by_heart_has_some_noise():
    """Its errors are no less than a share of the spread before learning."""
    rng = np.random.default_rng(0)
    y = rng.standard_normal((50, 3)) * [1.0, 2.0, 3.0] + 5.0
    rows = Rows(rng.standard_normal((50, 2)), y)
    for off in (0.0, 10.0):
        fitted = RegressorModel(Memory(off)).fit(Residuals(rows, y, None))
        expected = max(off, _LEAST * y.var(axis=0).mean() ** 0.5)
        assert fitted.noise == pytest.approx(expected)


def test_the_derivative_of_a_pose_by_a_change_of_the_robot():
    """Against differences, where the residual is zero and so linear in the change."""
    q = torch.from_numpy(log(4)[0])
    fitted = WithPose.of(CHAIN, [], q.new_zeros(0))
    rows = Rows(q.numpy(), np.zeros((4, 6)))
    rng = np.random.default_rng(0)
    theta = rng.uniform(-0.2, 0.2, 9)
    scale = np.full(3, 0.01)
    with torch.no_grad():
        y = _Problem(fitted, rows, scale).model(theta).rows()(q).numpy()
    problem = _Problem(fitted, dataclasses.replace(rows, y=y), scale)
    residual, A = problem.linearised(theta)
    assert_allclose(residual, 0.0, atol=1e-9)
    for k in range(9):
        move = 1e-5 * np.eye(9)[k]
        high, low = (problem.linearised(theta + sign * move)[0] for sign in (1.0, -1.0))
        assert_allclose(A[..., k], (low - high) / 2e-5, rtol=0, atol=1e-8)


def test_a_choice_of_penalties_starts_where_it_is_asked_to():
    start, tried = (10.0**1.5, 10.0**-2.5), []

    def score(pair):
        tried.append(pair)
        return 1.0 + (np.log10(pair[0]) - 1.5) ** 2 + (np.log10(pair[1]) + 2.5) ** 2

    assert choose(score, start)[0] == pytest.approx(start)
    assert tried[0] == (inf, inf)
    assert tried[1] == pytest.approx(start)


@pytest.mark.parametrize("seed", range(4))
def test_noise_of_the_actuators_alone_is_found_and_allowed_for(seed):
    rng, chain = np.random.default_rng(seed), ConstantCurvatureChain([0.03])
    q = torch.from_numpy(rng.uniform(0.15, 0.25, (100, 3)))
    off, noise = 0.1 * (q - 0.22), 1e-3 * torch.from_numpy(rng.standard_normal((100, 3)))
    features, x = Features.of_range(q), chain(q + off + noise)
    moved = chain.coordinates(q + off)[0] - chain.coordinates(q)[0]
    rows = Rows(q.numpy(), x.numpy())
    found = fit_readout(chain, features, rows)
    ignored = fit_readout(chain, features, rows, alphas=found.alphas)
    assert found.noise_ratio < inf == ignored.noise_ratio
    assert (found.readout(q) - moved).norm() < (ignored.readout(q) - moved).norm()
