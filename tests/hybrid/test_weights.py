"""Weights are repetitions: with every error model, coupling, guard, coverage and with play."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.linear_model import Ridge
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    PlayOperator,
)

SERIAL = ("elm", "linear", "quadratic", "pose", "network")
PAIRS = [(("parallel", kind), ()) for kind in (*SERIAL, "drop", "ridge")]
PAIRS += [(("serial", kind), ()) for kind in SERIAL]
PAIRS += [(("parallel", "kernel"), pytest.mark.slow)]


def hybrid(kind, coupling="parallel", **options):
    model = kind
    if kind == "network":
        plain = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}
        model = ELMRegressorCV(15, (0.01, 1.0), (0.4,), **plain)
    elif kind == "elm":
        model = ELMRegressor(15, random_state=0)
    elif kind == "ridge":
        model = Ridge(0.1)
    chain = ConstantCurvatureChain([0.06])
    return HybridForwardModel(chain, model, coupling=coupling, random_state=0, **options)


@pytest.fixture(scope="module")
def log():
    """Rows with noise, how many times each counts, motions, and new rows."""
    rng = np.random.default_rng(0)
    q, new = 0.25 + 0.05 * rng.uniform(-1, 1, (2, 48, 3))
    x = ConstantCurvatureChain([0.05])(torch.from_numpy(q)).numpy() + 0.02 * np.sin(20 * q)
    weights = rng.integers(0, 6, len(q))
    weights[:2] = 0, 5
    return q, x + 0.003 * rng.normal(size=x.shape), weights, np.arange(len(q)) // 8, new


def assert_equal_models(weighed, repeated, weights, new):
    assert_allclose(weighed.predict(new), repeated.predict(new), rtol=0, atol=1e-10)
    assert_allclose(weighed.error_weight(new), repeated.error_weight(new), rtol=0, atol=1e-8)
    assert weighed.radius_ == pytest.approx(repeated.radius_)
    for name in ("residual", "left_out_errors_"):
        if hasattr(weighed.error_model_, name):
            one, many = (getattr(model.error_model_, name) for model in (weighed, repeated))
            assert np.isnan(one[weights == 0]).all()
            assert_allclose(np.repeat(one, weights, axis=0), many, rtol=0, atol=1e-10)


RADIUS = {"calibrate": ("radii",), "coverage": 0.8}
WITH_RADIUS = [("parallel", "elm"), ("serial", "quadratic"), ("parallel", "kernel")]


@pytest.mark.parametrize(
    ("by_motion", "options", "coupling", "kind"),
    [
        *[pytest.param(False, {}, *pair, marks=marks) for pair, marks in PAIRS],
        *[pytest.param(True, {"guard": "box"}, *pair, marks=marks) for pair, marks in PAIRS],
        *[pytest.param(True, RADIUS, *pair, marks=pytest.mark.slow) for pair in WITH_RADIUS],
    ],
)
def test_weights_are_repetitions(coupling, kind, by_motion, options, log):
    q, x, weights, motions, new = log
    many, groups = np.repeat(np.arange(len(q)), weights), motions if by_motion else None
    own = None if groups is None else groups[many]
    weighed = hybrid(kind, coupling, **options).fit(q, x, weights, groups)
    repeated = hybrid(kind, coupling, **options).fit(q[many], x[many], groups=own)
    assert_equal_models(weighed, repeated, weights, new)


@pytest.mark.slow
def test_weights_are_repetitions_in_the_selection(log):
    q, x, weights, _, new = log
    many = np.repeat(np.arange(len(q)), weights)
    weighed = hybrid("auto").fit(q, x, weights)
    repeated = hybrid("auto").fit(q[many], x[many])
    one, two = weighed.cv_results_, repeated.cv_results_
    assert_allclose(one["mean_distance"], two["mean_distance"], atol=1e-12)
    assert one["weights"] == two["weights"]
    assert_equal_models(weighed, repeated, weights, new)


def test_a_row_of_weight_zero_still_moves_the_actuators(log):
    q, x, weights, _, new = log
    kept = weights > 0
    effective = PlayOperator(0.02).apply_by_group(q, np.zeros(len(q)))
    weighed = hybrid("linear", play=0.02).fit(q, x, kept)
    plain = hybrid("linear").fit(effective[kept], x[kept])
    assert_allclose(
        weighed.module_(torch.from_numpy(new)).numpy(), plain.predict(new), rtol=0, atol=1e-10
    )


def test_rows_of_a_later_fit_fade_once_for_each_repetition(log):
    q, x, weights, _, new = log
    fitted = hybrid("linear").fit(q, x)
    many = np.repeat(np.arange(6), weights[:6])
    one, two = (hybrid("linear").fit(q, x) for _ in range(2))
    one.partial_fit(q[:6], x[:6] + 0.02, weights[:6], decay=0.9)
    two.partial_fit(q[many], x[many] + 0.02, decay=0.9)
    assert_allclose(one.predict(new), two.predict(new), rtol=0, atol=1e-12)
    assert np.abs(one.predict(new) - fitted.predict(new)).max() > 1e-3


def test_regressors_of_others_get_the_rows_as_they_were_given(log):
    q, x, _, _, new = log
    twice = np.append(np.arange(len(q)), [3, 3, 7])
    pipeline = make_pipeline(StandardScaler(), Ridge(0.1))  # takes no sample_weight
    chain = ConstantCurvatureChain([0.06])
    model = HybridForwardModel(chain, pipeline, guard=None).fit(q[twice], x[twice])
    with torch.no_grad():
        error = x - chain(torch.from_numpy(q)).numpy()
    expected = pipeline.fit(q[twice], error[twice]).predict(new)
    assert_allclose(model.predict_error(new), expected, rtol=0, atol=1e-10)
