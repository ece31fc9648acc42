"""Hybrids fitted to, and asked for, hostile numbers: an answer, or an error that names why.

Where scikit-learn checks an argument its message names it without backticks.
"""

import copy

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from saved_models import trunk, trunk_log
from sklearn.linear_model import LinearRegression
from strategies import answer, arrays, named

from hybridkin import ELMRegressor, HybridForwardModel

Q, X, GROUPS = trunk_log()
SMALL = ELMRegressor(3, random_state=0)
ERROR_MODELS = ["linear", "quadratic", "pose", "kernel", "drop", SMALL, LinearRegression()]
INSIDE = ["linear", "quadratic", "pose", SMALL]
SPECIAL = (np.nan, np.inf, 5e-324, -0.0, 0.0, 1e300, -1e300, 1e-300, 1e30)
METHODS = (
    "predict",
    "predict_mechanical",
    "predict_error",
    "jacobian",
    "in_domain",
    "error_weight",
)


def hybrid(error_model="linear", **options):
    options = {"random_state": 0, **options}
    return HybridForwardModel(trunk(), error_model, **options)


FITTED = {
    "linear": hybrid().fit(Q, X, groups=GROUPS),
    "network": hybrid(SMALL, coverage=0.5).fit(Q, X, groups=GROUPS),
    "quadratic": hybrid("quadratic").fit(Q, X),
    "serial": hybrid("quadratic", coupling="serial").fit(Q, X, groups=GROUPS),
    "kernel": hybrid("kernel", guard=None).fit(Q, X),
    "regression": hybrid(LinearRegression()).fit(Q, X),
    "pose": hybrid(SMALL, output="pose").fit(Q, np.hstack([X, 5 * (Q - 0.25)])),
    "data": HybridForwardModel(None, SMALL).fit(Q, X),
}


@st.composite
def logs(draw):
    """Actuators, tips, weights and motions of a few rows, some of them equal or constant."""
    n = draw(st.integers(1, 24))
    q, x = (
        np.array(draw(arrays((n, 3), low, high, SPECIAL))) for low, high in ((0.2, 0.3), (0, 0.3))
    )
    if draw(st.booleans()):
        q[:, 0] = q[0, 0]
    if draw(st.booleans()):
        q[n // 2 :], x[n // 2 :] = q[0], x[0]
    weights = draw(st.none() | arrays((n,), 0.0, 2.0, (0.0, 0.0, np.nan, -1.0, 5e-324, 1e300)))
    groups = draw(st.sampled_from([None, np.arange(n) // 4, np.zeros(n), np.arange(n)]))
    return q, x, weights, groups


@given(st.data(), logs())
def test_a_fit_is_finite_or_its_rows_are_refused(data, log):
    serial = data.draw(st.booleans())
    model = hybrid(
        data.draw(st.sampled_from(INSIDE if serial else ERROR_MODELS)),
        coupling="serial" if serial else "parallel",
        guard=data.draw(st.sampled_from(["leverage", None])),
        hysteresis=data.draw(st.sampled_from([None, None, 0.001, 0.0, [0.0, 0.01, 5e-324], 1e300])),
        coverage=data.draw(st.sampled_from([None, None, 0.5])),
        calibrate=data.draw(st.sampled_from([None, None, ["radii"], ["base"]])),
    )
    fitted, error = answer(named(model.fit), *log)
    if error is not None:
        return
    q = log[0]
    for method in METHODS:
        value, error = answer(getattr(fitted, method), q)
        assert error is None
        assert len(value) == len(q)
        sizes = np.abs(q).max(axis=1) < 1e3
        assert np.isfinite(value[sizes]).all()


@given(st.sampled_from(sorted(FITTED)), arrays((4, 3), 0.1, 0.4), st.sampled_from(METHODS))
def test_rows_are_answered_each_alone_or_refused(name, q, method):
    model = FITTED[name]
    value, error = answer(named(getattr(model, method)), q)
    if error is not None:
        assert not np.isfinite(q).all()
        return
    assert value.dtype in (q.dtype, bool)
    usual = np.abs(q).max(axis=1) < 1e3
    assert np.isfinite(value[usual]).all()
    plain = np.where(usual[:, None], q, q.dtype.type(0.25)).astype(q.dtype)
    tol = 1e-12 if q.dtype == float else 1e-5
    for rows in (slice(None), slice(None, None, -1)):
        found = getattr(model, method)(plain[rows])[rows]
        if value.dtype == bool:
            assert_array_equal(found[usual], value[usual])
        else:
            assert_allclose(found[usual], value[usual], rtol=tol, atol=tol)


@given(st.data(), logs())
def test_a_stream_follows_or_is_refused(data, log):
    model = copy.deepcopy(
        FITTED[data.draw(st.sampled_from(["linear", "network", "quadratic", "serial"]))]
    )
    before = model.predict(Q)
    odd = st.sampled_from([0.98, 1.0, 0.0, 5e-324, 1e-300, np.nan, -1.0, 1e300, "a", None])
    q, x, weights, groups = log
    given = {"decay": data.draw(odd), "alpha": data.draw(st.none() | odd)}
    _, error = answer(named(model.partial_fit), q, x, weights, **given)
    after = model.predict(Q)
    assert np.isfinite(after).all()
    if error is not None:
        assert_array_equal(after, before)
    names = data.draw(st.sampled_from([("base",), ("actuator_zeros",), ("base", "actuator_zeros")]))
    before = after
    _, error = answer(named(model.adapt), q, x, parameters=names, groups=groups)
    after = model.predict(Q)
    assert np.isfinite(after).all()
    if error is not None:
        assert_array_equal(after, before)
