"""Following a change of the robot measurement by measurement, without forgetting the fit."""

import copy

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import Ridge

from hybridkin import HybridForwardModel, datasets, load_model, robots, save_model

PAYLOAD = np.array([[0.1, -0.2, 0.0], [0.0, 0.1, 0.3], [0.05, 0.0, -0.1]])


def changed(q):
    """What a payload adds to the tip [m], simulated as an affine function of the first segment."""
    return 0.01 + (q[:, :3] - 0.25) @ PAYLOAD.T


@pytest.fixture(scope="module")
def trunk():
    data = datasets.load_trunk()
    return data.q[::4], data.x[::4]


@pytest.fixture(params=[None, "drop", Ridge(1e-3)], ids=["elm", "drop", "ridge"])
def fitted(request, trunk):
    chain = robots.bionic_handling_assistant()
    return HybridForwardModel(chain, request.param, random_state=0).fit(*trunk)


def rms(model, q, x):
    return np.sqrt(np.mean(np.sum((model.predict(q) - x) ** 2, axis=1)))


def test_one_row_at_a_time_equals_many(fitted, trunk):
    q, x = trunk
    at_once, one_by_one = copy.deepcopy(fitted), copy.deepcopy(fitted)
    weights = np.random.default_rng(0).uniform(0, 2, 30)
    at_once.partial_fit(q[:30], x[:30] + 0.01, weights, decay=0.9)
    for i in range(30):
        one_by_one.partial_fit(q[i : i + 1], x[i : i + 1] + 0.01, weights[i : i + 1], decay=0.9)
    assert_allclose(at_once.predict(q), one_by_one.predict(q), rtol=0, atol=1e-12)


def test_the_drift_is_the_weighted_ridge_of_the_residuals(fitted, trunk):
    q, x = trunk
    model = copy.deepcopy(fitted).partial_fit(q[:80], x[:80] + changed(q[:80]), decay=0.95, alpha=2)
    residual = x[:80] + changed(q[:80]) - fitted.predict(q[:80])
    low, high = q.min(0), q.max(0)
    u = (2 * q - low - high) / (high - low)
    phi = np.column_stack([np.ones(len(q)), u])
    weights = 0.95 ** np.arange(79, -1, -1)
    ridge = Ridge(2.0, fit_intercept=False).fit(phi[:80], residual, sample_weight=weights)
    assert_allclose(model.predict(q) - fitted.predict(q), ridge.predict(phi), rtol=0, atol=1e-10)


def test_unfitted_it_fits_and_goes_on_from_a_file(tmp_path, trunk):
    q, x = trunk
    model = HybridForwardModel(robots.bionic_handling_assistant(), random_state=0)
    first = copy.deepcopy(model).fit(q, x).predict(q)
    assert_array_equal(model.partial_fit(q, x).predict(q), first)
    model.partial_fit(q[:9], x[:9] + 0.03)
    save_model(model, tmp_path / "model.safetensors")
    back = load_model(tmp_path / "model.safetensors").partial_fit(q[9:12], x[9:12])
    assert_array_equal(back.predict(q), model.partial_fit(q[9:12], x[9:12]).predict(q))


@pytest.mark.parametrize(
    "settings", [{"decay": 0.0}, {"decay": 1.1}, {"alpha": -1.0}, {"alpha": 0}]
)
def test_clear_errors(fitted, trunk, settings):
    with pytest.raises(ValueError, match=f"`{next(iter(settings))}` must lie in"):
        fitted.partial_fit(*trunk, **settings)


def test_a_robot_that_has_not_changed_is_left_alone():
    data = datasets.load_trunk()
    order = np.random.default_rng(0).permutation(len(data.q))
    q, x = data.q[order[:1500]], data.x[order[:1500]]
    model = HybridForwardModel(robots.bionic_handling_assistant(), "quadratic", coupling="serial")
    model.fit(q[:500], x[:500])
    before = rms(model, q[1000:], x[1000:])
    for n_rows in (5, 200):
        new = slice(500, 500 + n_rows)
        same = copy.deepcopy(model).partial_fit(q[new], x[new])
        assert rms(same, q[1000:], x[1000:]) < 1.1 * before
    moved = copy.deepcopy(model).partial_fit(q[new], x[new] + 0.1)
    assert rms(moved, q[1000:], x[1000:] + 0.1) < 0.06
