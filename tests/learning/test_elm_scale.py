"""The ELM at scale: streams of chunks, dask, processes, searches over frames, metadata."""

import numpy as np
import pandas as pd
import polars as pl
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.model_selection import GridSearchCV, cross_val_score

from hybridkin import (
    ELMRegressor,
    ELMRegressorCV,
)

BOUNDS = [[-1.0] * 4, [1.0] * 4]
SEARCH = {"alpha": [1e-4, 1e-1, 1e2], "n_hidden": [10, 20]}


def data(n=200, seed=0):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1, 1, (n, 4))
    A = np.random.default_rng(99).standard_normal((4, 2))
    return X, np.sin(X @ A) + 0.3 + 0.05 * rng.standard_normal((n, 2))


def elm(n_hidden=20, alpha=0.1, **params):
    return ELMRegressor(n_hidden, alpha, **{"random_state": 0, **params})


def elm_cv(alphas=(1e-3, 0.1), **params):
    quick = {"weight_scales": (0.5, 1.0), "relevance_rounds": 0, "random_state": 0}
    return ELMRegressorCV(15, alphas, **{**quick, **params})


def assert_same_predictions(a, b, X, rtol=1e-10):
    expected = b.predict(X)
    assert_allclose(a.predict(X), expected, rtol=0, atol=rtol * np.abs(expected).max())


# Streams


def stream(sizes=(7, 1, 150, 40, 2, 300), seed=0):
    """Yield chunks of any size, in both precisions, as a logger might."""
    for k, n in enumerate(sizes):
        X, y = data(n, seed=100 * seed + k)
        dtypes = (np.float32, np.float64) if k % 2 == 0 else (np.float64, np.float32)
        yield X.astype(dtypes[0]), y.astype(dtypes[1])


def together(chunks):
    """Return all rows in float64, and the number of the chunk of each."""
    Xs, ys = zip(*chunks, strict=True)
    chunk = np.repeat(np.arange(len(Xs)), [len(X) for X in Xs])
    return np.vstack(Xs, dtype=np.float64), np.vstack(ys, dtype=np.float64), chunk


@pytest.mark.parametrize("fit_intercept", [False, True])
def test_decay_is_a_weight_that_falls_with_age(fit_intercept):
    params = {"input_scaling": BOUNDS, "fit_intercept": fit_intercept}
    decay, forgetful = 0.7, elm(**params)
    own = iter(np.random.default_rng(1).uniform(0.5, 2.0, 500))
    weights = []
    for X, y in stream():
        weights.append([next(own) for _ in X])
        forgetful.partial_fit(X, y, weights[-1], decay=decay)
    X, y, chunk = together(stream())
    age = chunk.max() - chunk
    w = np.concatenate(weights) * decay**age
    whole = elm(**params).fit(X, y, sample_weight=w)
    assert_allclose(forgetful.n_samples_seen_, w.sum(), rtol=1e-13)
    assert_same_predictions(forgetful, whole, X)
    assert_allclose(forgetful.noise_variance_, whole.noise_variance_, rtol=1e-10)
    # The formula itself, written out.
    phi = whole.module_.features(torch.from_numpy(X)).numpy()
    phi = np.hstack([phi, np.ones((500, int(fit_intercept)))])
    penalty = np.diag([0.1] * 20 + [0.0] * fit_intercept)
    expected = phi @ np.linalg.solve(phi.T * w @ phi + penalty, phi.T * w @ y)
    assert_allclose(forgetful.predict(X), expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    assert np.abs(forgetful.predict(X) - elm(**params).fit(X, y).predict(X)).max() > 1e-3


# Dask


# Frames, pipelines, pictures, metadata


def as_frames(library, X, y):
    columns = {f"q{i}": column for i, column in enumerate(X.T)}
    return library.DataFrame(columns), library.DataFrame({"x": y[:, 0], "z": y[:, 1]})


@pytest.mark.slow
@pytest.mark.parametrize("library", [pd, pl], ids=["pandas", "polars"])
def test_frames_through_a_search(library):
    X, y = data()
    X_frame, y_frame = as_frames(library, X, y)
    expected = GridSearchCV(elm(), SEARCH, cv=3).fit(X, y)
    search = GridSearchCV(elm(), SEARCH, cv=3).fit(X_frame, y_frame)
    assert list(search.best_estimator_.feature_names_in_) == ["q0", "q1", "q2", "q3"]
    assert search.best_params_ == expected.best_params_
    scores = expected.cv_results_["mean_test_score"]
    assert_allclose(search.cv_results_["mean_test_score"], scores, rtol=1e-9)
    assert_allclose(search.predict(X_frame), expected.predict(X), rtol=1e-9)
    column = GridSearchCV(elm(), SEARCH, cv=3).fit(X_frame, y_frame["x"])
    assert column.predict(X_frame).shape == (200,)
    choosing = elm_cv()
    scores = cross_val_score(choosing, X, y[:, 0])
    assert_allclose(cross_val_score(choosing, X_frame, y_frame["x"]), scores, rtol=1e-9)
