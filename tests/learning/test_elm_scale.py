"""The ELM at scale: streams of chunks, dask, processes, searches over frames, metadata."""

import os
import pickle
import re
import subprocess
import sys
import weakref
from pathlib import Path

import joblib
import numpy as np
import pandas as pd
import polars as pl
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.model_selection import GridSearchCV, GroupKFold, cross_val_score

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
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


def test_a_stream_keeps_none_of_its_rows():
    model = elm(input_scaling=BOUNDS, fit_intercept=True)
    chunks, sizes = [], []
    for seed in range(20):
        X, y = data(500, seed)
        model.partial_fit(X, y, np.ones(500))
        chunks += [weakref.ref(X), weakref.ref(y)]
        sizes.append(len(pickle.dumps(model)))
    del X, y
    assert all(chunk() is None for chunk in chunks)
    assert len(set(sizes)) == 1


def test_a_long_stream_loses_no_digits():
    """Means and scatter of 300,000 rows, against sums in extended precision."""
    model = elm(8, input_scaling=BOUNDS, activation="tanh", fit_intercept=True)
    n, mean, products = 0, 0.0, 0.0
    for seed in range(30):
        X, y = data(10_000, seed)
        model.partial_fit(X, y)
        phi = model.module_.features(torch.from_numpy(X)).numpy()
        rows = np.hstack([phi, y]).astype(np.longdouble)
        n += len(rows)
        mean = mean + rows.sum(axis=0)
        products = products + rows.T @ rows
    mean = mean / n
    scatter = products - n * np.outer(mean, mean)
    spread = np.sqrt(scatter.diagonal())
    # Every one of 30 chunks rounds once; the features themselves by 2 eps.
    assert np.abs((model._stats.mean - mean) / spread).max() * np.sqrt(n) < 1e-14
    assert np.abs((model._stats.scatter - scatter) / np.outer(spread, spread)).max() < 1e-13


# Dask

EXAMPLE = Path(__file__).parents[2] / "examples" / "plot_elm_dask.py"


@pytest.mark.slow
def test_the_example_with_two_workers_runs_as_a_script(tmp_path):
    """Tree and loop agree, and it says how many rows a worker learns in a second."""
    pytest.importorskip("dask.distributed")
    source = EXAMPLE.read_text(encoding="utf-8")
    for long, short in (("range(0, 80, 5)", "range(0, 10, 5)"), ("N_ROWS = 8000", "N_ROWS = 500")):
        assert long in source
        source = source.replace(long, short)
    script = tmp_path / "example.py"
    script.write_text("import matplotlib\nmatplotlib.use('agg')\n" + source, encoding="utf-8")
    command = [sys.executable, str(script)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    assert done.returncode == 0, done.stderr
    (difference,) = re.findall(r"predictions: (\S+)", done.stdout)
    assert float(difference) < 1e-8
    rates = re.findall(r"workers: (\d); .* (\d+) thousand rows/s per worker", done.stdout)
    assert [n_workers for n_workers, _ in rates] == ["1", "2"]
    assert all(int(rate) > 0 for _, rate in rates)


@pytest.mark.slow
def test_a_search_of_hybrids_in_workers_of_dask_finds_the_same():
    distributed = pytest.importorskip("dask.distributed")
    q, x = data(120)
    q = 0.25 + 0.04 * q[:, :3]
    chain = ConstantCurvatureChain([0.06])
    groups = np.arange(120) // 10
    hybrid = HybridForwardModel(chain, elm(), calibrate=["base"])
    x = chain(torch.from_numpy(q)).numpy() + 0.01 * x[:, :1]

    def process(estimator, X, y):
        return os.getpid()

    search = GridSearchCV(
        hybrid,
        {"error_model__alpha": [1e-4, 1e2]},
        cv=GroupKFold(3),
        scoring={"r2": "r2", "process": process},
        refit="r2",
    )
    expected = search.fit(q, x, groups=groups).cv_results_["mean_test_r2"]
    options = {"n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.LocalCluster(**options) as cluster, distributed.Client(cluster):
        with joblib.parallel_config(backend="dask"):
            found = search.fit(q, x, groups=groups).cv_results_
    assert_allclose(found["mean_test_r2"], expected, rtol=1e-9)
    processes = {pid for k in range(3) for pid in found[f"split{k}_test_process"]}
    assert os.getpid() not in processes


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
