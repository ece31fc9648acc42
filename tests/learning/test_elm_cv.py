"""The ELM that chooses its complexity: its errors on held-out rows, its choices."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.datasets import make_friedman1
from sklearn.model_selection import (
    KFold,
    ShuffleSplit,
    TimeSeriesSplit,
)
from sklearn.utils.estimator_checks import parametrize_with_checks

from hybridkin import ELMRegressor, ELMRegressorCV

ALPHAS = np.logspace(-3, 2, 6)


def data(n=60, d=3, m=2, seed=0, noise=0.05):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, d))
    A = np.random.default_rng(99).standard_normal((d, m))
    return X, np.sin(2 * X @ A) + 0.3 + noise * rng.standard_normal((n, m))


def quick(n_hidden=20, alphas=ALPHAS, weight_scales=(0.7,), **params):
    params = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0, **params}
    return ELMRegressorCV(n_hidden, alphas, weight_scales, **params)


def refitted(model, alpha, X, y, train, test, sample_weight=None):
    """Errors of a fresh fit to the training rows, in the hidden layer of all rows."""
    fitted = model.best_estimator_
    half = fitted.input_scale_
    bounds = [fitted.input_center_ - half, fitted.input_center_ + half]
    fresh = ELMRegressor(**{**model.best_params_, "alpha": alpha, "input_scaling": bounds})
    weights = None if sample_weight is None else sample_weight[train]
    return y[test] - fresh.fit(X[train], y[train], weights).predict(X[test])


@pytest.mark.slow
@parametrize_with_checks(
    [
        ELMRegressorCV(n_hidden=20, max_hidden=40),
        ELMRegressorCV(
            n_hidden=[5, 10], alphas=[0.01, 1.0], weight_scales=[1.0], cv=2, max_hidden=0
        ),
    ]
)
def test_scikit_learn_checks(estimator, check):
    check(estimator)


# Errors on held-out rows


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("n", [12, 24, 40])  # fewer rows than features, about as many, more
def test_each_row_alone_equals_brute_force(n, fit_intercept):
    X, y = data(n)
    model = quick(fit_intercept=fit_intercept).fit(X, y)
    brute = np.empty((len(ALPHAS), *y.shape))
    for i in range(n):
        rest = np.delete(np.arange(n), i)
        for j, alpha in enumerate(ALPHAS):
            brute[j, i] = refitted(model, alpha, X, y, rest, [i])[0]
    expected = np.mean(brute**2, axis=(1, 2))
    assert_allclose(model.cv_results_["mean_squared_error"][0], expected, rtol=1e-10)
    best = expected.argmin()
    assert model.alpha_ == ALPHAS[best]
    assert_allclose(model.left_out_errors_, brute[best], rtol=0, atol=1e-10)
    assert_allclose(model.best_score_, -expected[best], rtol=1e-10)


@pytest.mark.parametrize("fit_intercept", [False, True])
@pytest.mark.parametrize("sizes", [[3, 1, 8, 5, 13], [30, 40, 50], [70, 2, 4]])
def test_groups_equal_refits(sizes, fit_intercept):
    groups = np.random.default_rng(0).permutation(np.repeat(np.arange(len(sizes)), sizes))
    X, y = data(len(groups))
    other = np.flatnonzero(groups != groups[0])[0]
    X[other], y[other] = X[0], y[0]  # a row of two groups
    weights = np.random.default_rng(1).uniform(0.2, 3.0, len(groups))
    model = quick(fit_intercept=fit_intercept).fit(X, y, weights, groups)
    brute = np.empty((len(ALPHAS), *y.shape))
    for group in np.unique(groups):
        train, test = np.flatnonzero(groups != group), np.flatnonzero(groups == group)
        for j, alpha in enumerate(ALPHAS):
            brute[j, test] = refitted(model, alpha, X, y, train, test, weights)
    expected = np.average(brute**2, axis=1, weights=weights).mean(axis=1)
    assert_allclose(model.cv_results_["mean_squared_error"][0], expected, rtol=1e-10)
    assert_allclose(model.left_out_errors_, brute[expected.argmin()], rtol=0, atol=1e-10)


@pytest.mark.parametrize(
    "cv",
    [
        KFold(4),
        KFold(2),
        ShuffleSplit(5, test_size=0.1, train_size=0.5, random_state=0),
        TimeSeriesSplit(4),
    ],
    ids=lambda cv: type(cv).__name__,
)
@pytest.mark.parametrize("n", [15, 90])
def test_any_splitter_equals_refits(cv, n):
    X, y = data(n)
    model = quick(cv=cv).fit(X, y)
    total, count = np.zeros(len(ALPHAS)), np.zeros(n)
    sums = np.zeros((len(ALPHAS), *y.shape))
    for train, test in cv.split(X):
        for j, alpha in enumerate(ALPHAS):
            errors = refitted(model, alpha, X, y, train, test)
            total[j] += np.sum(errors**2)
            sums[j, test] += errors
        count[test] += 1
    assert_allclose(
        model.cv_results_["mean_squared_error"][0], total / (2 * count.sum()), rtol=1e-10
    )
    seen = count > 0
    found = model.left_out_errors_
    assert_allclose(
        found[seen], (sums[total.argmin()] / np.maximum(count, 1)[:, None])[seen], atol=1e-10
    )
    assert np.isnan(found[~seen]).all()


@pytest.mark.parametrize("n", [10, 60])
def test_weights_are_repetitions_that_are_left_out_together(n):
    X, y = data(n)
    weights = np.random.default_rng(0).integers(0, 4, n)
    repeated = np.repeat(np.arange(n), weights)
    weighed = quick().fit(X, y, sample_weight=weights)
    longhand = quick().fit(X[repeated], y[repeated])
    by_row = quick().fit(X[repeated], y[repeated], groups=repeated)
    for other in (longhand, by_row):
        assert_allclose(
            weighed.cv_results_["mean_squared_error"],
            other.cv_results_["mean_squared_error"],
            rtol=1e-9,
        )
        assert_allclose(weighed.predict(X), other.predict(X), rtol=0, atol=1e-9)
        left_out = np.repeat(weighed.left_out_errors_, weights, axis=0)
        assert_allclose(other.left_out_errors_, left_out, rtol=0, atol=1e-9)
    assert_array_equal(np.isnan(weighed.left_out_errors_).any(axis=1), weights == 0)


@pytest.mark.parametrize("scaling", ["minmax", "standard"])
@pytest.mark.parametrize("n", [12, 60])
def test_weights_are_repetitions_that_stay_apart(n, scaling):
    """Targets that differ by 1e-9 are not merged; held out together, they are one row."""
    X, y = data(n)
    weights = np.random.default_rng(0).integers(0, 4, n)
    repeated = np.repeat(np.arange(n), weights)
    params = {"relevance_rounds": 2, "max_hidden": 40, "input_scaling": scaling}
    weighed = quick(**params).fit(X, y, sample_weight=weights)
    many = y[repeated] + 1e-9 * np.arange(len(repeated))[:, None]
    by_row = quick(**params).fit(X[repeated], many, groups=repeated)
    # Targets up to 1e-7 apart change squared errors of 1e-3 by 1e-5 of them at most.
    for name in ("mean_squared_error", "relevance", "n_hidden", "weight_scale"):
        assert_allclose(by_row.cv_results_[name], weighed.cv_results_[name], rtol=1e-5)
    assert by_row.alpha_ == weighed.alpha_
    assert_allclose(by_row.predict(X), weighed.predict(X), rtol=0, atol=1e-6)
    assert_allclose(by_row.noise_variance_, weighed.noise_variance_, rtol=1e-5)
    left_out = np.repeat(weighed.left_out_errors_, weights, axis=0)
    assert_allclose(by_row.left_out_errors_, left_out, rtol=0, atol=1e-6)


@pytest.mark.parametrize("cv", [None, 3])
def test_names_of_groups_units_and_order_do_not_matter(cv):
    X, y = data(60)
    groups = np.random.default_rng(0).integers(0, 6, 60)
    weights = np.random.default_rng(1).uniform(0.5, 2.0, 60)
    params = {"relevance_rounds": 1, "cv": cv}
    model = quick(**params).fit(X, y, weights, groups)
    order = np.random.default_rng(2).permutation(60)
    names = np.array([*"abcdef"])[groups]  # in the same order: GroupKFold follows it in ties
    unit = np.array([1e-3, 1.0, 30.0])
    other = quick(**params).fit(unit * X[order], 3 * y[order], weights[order], names[order])
    errors = model.cv_results_["mean_squared_error"]
    assert_allclose(other.cv_results_["mean_squared_error"], 9 * errors, rtol=1e-7)
    assert other.alpha_ == model.alpha_
    assert_allclose(other.left_out_errors_, 3 * model.left_out_errors_[order], rtol=0, atol=1e-7)


# Choices


@pytest.mark.slow
def test_irrelevant_and_linear_inputs_cost_nothing():
    # Friedman's first: five of ten inputs do nothing, two act linearly.
    X, y = make_friedman1(1000, noise=1.0, random_state=0)
    X_test, y_test = make_friedman1(4000, random_state=1)
    plain, relevant = (
        ELMRegressorCV(200, relevance_rounds=rounds, max_hidden=0, random_state=0).fit(X, y)
        for rounds in (0, 5)
    )
    error, reduced = (np.std(model.predict(X_test) - y_test) for model in (plain, relevant))
    assert reduced < 0.7 * error
    best = relevant.cv_results_["mean_squared_error"].min(axis=1).argmin()
    relevance = relevant.cv_results_["relevance"][best]
    assert relevance[:3].min() > 10 * relevance[3:].max()


@pytest.mark.slow
def test_groups_protect_from_leaking_motions():
    # Ten rows of a motion share its offset: row by row it can be memorised, by groups it cannot.
    rng = np.random.default_rng(0)
    motion = np.repeat(np.arange(30), 10)
    X = rng.uniform(-1, 1, (30, 4))[motion] + 0.01 * rng.standard_normal((300, 4))
    y = X[:, 0] + 0.5 * rng.standard_normal(30)[motion]
    by_rows = ELMRegressorCV(100, max_hidden=0, random_state=0).fit(X, y)
    by_motions = ELMRegressorCV(100, max_hidden=0, random_state=0).fit(X, y, groups=motion)
    assert by_rows.best_score_ > 0.1 * by_motions.best_score_
    X_new = rng.uniform(-1, 1, (2000, 4))
    rms = [np.sqrt(np.mean((m.predict(X_new) - X_new[:, 0]) ** 2)) for m in (by_rows, by_motions)]
    assert rms[1] < 0.5 * rms[0]


# Numbers


@pytest.mark.parametrize("m", [2])
def test_return_std_covers_new_measurements(m):
    """90 % intervals on 2000 new rows of the noise model, means over four draws."""
    covered = []
    for seed in range(4):
        X, y = data(400, m=m, seed=seed, noise=0.1)
        X_new, y_new = data(2000, m=m, seed=1000 + seed, noise=0.1)
        mean, std = (
            ELMRegressorCV(60, max_hidden=0, random_state=seed).fit(X, y).predict(X_new, True)
        )
        covered.append(np.mean(np.abs(y_new - mean) < 1.6449 * std))
    assert 0.87 < np.mean(covered) < 0.93


# Manners


@pytest.mark.parametrize(
    ("params", "fit", "message"),
    [
        ({"n_hidden": [5, 0]}, {}, "`n_hidden` must be one or more positive integers"),
        ({"alphas": [0.0, 1.0]}, {}, "`alphas` must be one or more positive numbers"),
        ({"weight_scales": [np.nan]}, {}, "`weight_scales` must be one or more positive numbers"),
        ({}, {"groups": np.zeros(7)}, r"`groups` must have shape \(60,\)"),
        ({}, {"groups": ["a"] * 60}, "contains fewer than 2 unique groups"),
        ({"cv": 2}, {"groups": ["a"] * 60}, "greater than the number of groups: 1"),
        ({"cv": [(np.arange(60), np.arange(5))]}, {}, "must not test on rows that it trains on"),
        ({}, {"sample_weight": np.eye(60)[0]}, "at least 2 different rows of positive weight"),
    ],
)
def test_clear_errors(params, fit, message):
    X, y = data(60)
    with pytest.raises(ValueError, match=message):
        quick(**params).fit(X, y, **fit)


def test_neurons_are_doubled_while_that_pays():
    rng = np.random.default_rng(0)
    X = rng.uniform(-1, 1, (800, 4))
    bent = np.sin(6 * X[:, 0] * X[:, 1]) + np.cos(5 * X[:, 2] * X[:, 3])
    plain = X @ np.arange(4.0) + 0.1 * rng.standard_normal(800)
    many, few = (
        ELMRegressorCV(50, relevance_rounds=0, max_hidden=400, random_state=0).fit(X, y)
        for y in (bent, plain)
    )
    assert many.best_params_["n_hidden"] == 400
    assert few.best_params_["n_hidden"] == 50
    fixed = ELMRegressorCV(50, relevance_rounds=0, max_hidden=0, random_state=0).fit(X, bent)
    assert many.best_score_ > 0.5 * fixed.best_score_
