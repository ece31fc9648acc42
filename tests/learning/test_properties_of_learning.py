"""Networks fitted to, and asked for, hostile numbers: finite answers, or an error that names why.

Where scikit-learn checks an argument its message names it without backticks.
"""

import numpy as np
import rounding
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from strategies import answer, arrays, named

from hybridkin import ELMRegressor, ELMRegressorCV

LAYERS = {
    "n_hidden": st.integers(1, 12),
    "activation": st.sampled_from(["logistic", "tanh", "sin"]),
    "input_scaling": st.sampled_from(["minmax", "standard", None, [[-1.0], [1.0]]]),
    "fit_intercept": st.booleans(),
    "direct_link": st.booleans(),
    "block_size": st.sampled_from([None, 1, 3]),
    "random_state": st.integers(0, 3),
}
ALPHAS = st.sampled_from([0.1, 0.0, 1e-11, 5e-324, 1e-300, 1e300])
WEIGHTS = (0.0, 0.0, 0.0, 1.0, np.nan, -1.0, np.inf, 5e-324, 1e300)


def scaling(params, d):
    bounds = isinstance(params["input_scaling"], list)
    return {**params, "input_scaling": np.tile(params["input_scaling"], d)} if bounds else params


@st.composite
def rows(draw, special=(1e300, -1e300, 1e-300, 5e-324, -0.0, 1e30, np.nan, np.inf)):
    """X, y and weights of a few rows, some of them equal, some columns constant."""
    n, d, m = draw(st.integers(1, 9)), draw(st.integers(1, 3)), draw(st.integers(0, 2))
    X = np.array(draw(arrays((n, d), special=special)))
    y = np.array(draw(arrays((n, m) if m else (n,), special=special)))
    weights = draw(st.none() | arrays((n,), 0.0, 2.0, WEIGHTS))
    if draw(st.booleans()):
        X[:, 0] = X[0, 0]
    if draw(st.booleans()):
        X[n // 2 :], y[n // 2 :] = X[0], y[0]
    return X, y, weights


def check_answers(model, X, shape):
    """What a fitted network says of rows is of their precision and shape, and of each row alone."""
    n, d = X.shape
    for method, one in (("predict", ()), ("jacobian", (d,)), ("leverage", None)):
        value, error = answer(named(getattr(model, method)), X)
        if error is not None:
            assert not np.isfinite(X).all() or not n
            continue
        assert value.dtype == X.dtype
        assert value.shape == ((n,) if one is None else (n, *shape, *one))
        order = np.arange(n)[::-1]
        backwards = getattr(model, method)(X[order])[order]
        assert_allclose(backwards, value, rtol=1e-6 if X.dtype == np.float32 else 1e-12)
        size = min(float(np.abs(value).max(initial=1e-300)), 1e300)
        tol = 1e-5 if X.dtype == np.float32 else 1e-11
        atol = tol * size + rounding_of_sums(model, method)
        for i in range(n):
            alone = getattr(model, method)(X[i : i + 1])[0]
            with np.errstate(over="ignore"):
                assert_allclose(alone, value[i], rtol=tol, atol=atol)


def rounding_of_sums(model, method):
    """Return the rounding of sums over neurons: without a penalty large numbers cancel in them.

    A leverage is the squared length of such sums, and that of a row of the fit is at most 1.
    """
    parts = {"predict": "output_weights", "jacobian": "tangent", "leverage": "leverage_factor"}
    terms = getattr(model.module_, parts[method]).abs().numpy()
    with np.errstate(over="ignore"):
        largest = terms.sum(axis=0).max(initial=0.0)
    return 100.0 * rounding.EPS * min(float(largest), 1e300)


@given(rows(), st.fixed_dictionaries(LAYERS), ALPHAS, st.sampled_from([1.0, 1e-300, 1e3]))
def test_a_network_is_finite_or_its_rows_are_refused(given_rows, params, alpha, scale):
    X, y, weights = given_rows
    params = scaling(params, X.shape[1])
    model = ELMRegressor(alpha=alpha, weight_scale=scale, **params)
    fitted, error = answer(named(model.fit), X, y, weights)
    if error is not None:
        return
    assert np.isfinite(fitted.output_weights_).all()
    assert np.isfinite(fitted.intercept_).all()
    check_answers(fitted, X, y.shape[1:])
    at = fitted.leverage(X)
    assert (at >= 0.0).all()  # infinite where weights are next to nothing
    both, error = answer(named(fitted.predict), X, return_std=True)
    assert error is None
    assert both[1].shape == y.shape


@given(
    rows(), rows(), st.fixed_dictionaries(LAYERS), st.sampled_from([1.0, 0.5, 5e-324, 0.0, np.nan])
)
def test_further_rows_are_added_or_refused(first, second, params, decay):
    params = scaling(params, first[0].shape[1])
    model = ELMRegressor(**params)
    if answer(named(model.fit), *first)[1] is not None:
        return
    other = ELMRegressor(**params)
    before = model.output_weights_.copy()
    _, error = answer(named(model.partial_fit), *second, decay=decay)
    if error is not None:
        np.testing.assert_array_equal(model.output_weights_, before)
    assert np.isfinite(model.output_weights_).all()
    if answer(named(other.fit), *second)[1] is None:
        before = model.output_weights_.copy()
        _, error = answer(named(model.merge), other)
        if error is not None:
            np.testing.assert_array_equal(model.output_weights_, before)
        assert np.isfinite(model.output_weights_).all()


@given(st.data(), rows())
def test_networks_that_choose_are_finite_or_refuse(data, given_rows):
    X, y, weights = given_rows
    params = {k: data.draw(LAYERS[k]) for k in ("n_hidden", "fit_intercept", "direct_link")}
    cv = data.draw(st.sampled_from([None, 2, 3, 50, 1, 0]))
    alphas = data.draw(st.sampled_from(["auto", [0.1], [1e300], [5e-324], [1e-74], [0.0], [], "a"]))
    model = ELMRegressorCV(
        alphas=alphas, cv=cv, weight_scales=(0.4, 1.6), max_hidden=20, random_state=0, **params
    )
    groups = data.draw(st.none() | st.just(np.arange(len(X)) // 2) | st.just(np.zeros(len(X))))
    fitted, error = answer(named(model.fit), X, y, weights, groups)
    if error is None:
        assert np.isfinite(fitted.module_.output_weights.numpy()).all()
        assert fitted.best_score_ <= 0.0
        check_answers(fitted, X, y.shape[1:])
