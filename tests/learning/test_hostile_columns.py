"""Columns that never moved: nothing is known of them, and nothing is predicted from them."""

import numpy as np
import pytest

from hybridkin import ELMRegressor, ELMRegressorCV


def rows(seed, still):
    rng = np.random.default_rng(seed)
    X = rng.uniform(-1.0, 1.0, (60, 4))
    X[:, still] = rng.choice([0.0, 0.2, -5.0, 300.0, 1e-6])
    return X, np.sin(2.0 * X[:, [(still + 1) % 4]] + [0.0, 1.0]) * X[:, [(still + 2) % 4]]


@pytest.mark.parametrize("scaling", ["minmax", "standard", None, [[-1.0] * 4, [1.0] * 4]])
def test_a_column_that_never_moved_has_no_effect(scaling):
    for seed in range(4):
        still = seed % 4
        X, y = rows(seed, still)
        elm = ELMRegressorCV(
            20, (1e-8, 1e-2), (0.8,), max_hidden=0, input_scaling=scaling, random_state=seed
        ).fit(X, y)
        moved = X.copy()
        moved[:, still] += np.random.default_rng(seed).choice([0.1, -1.0, 100.0])
        np.testing.assert_allclose(elm.predict(moved), elm.predict(X), rtol=0, atol=1e-9)
        assert np.abs(elm.jacobian(X)[:, :, still]).max() < 1e-9
        assert np.abs(elm.predict(moved) - y).max() < 0.5
        chosen = ELMRegressor(**elm.best_params_).fit(X, y)
        np.testing.assert_allclose(chosen.predict(moved), elm.predict(moved), rtol=0, atol=1e-9)


def test_no_column_moves():
    X = np.ones((10, 3))
    y = np.arange(10.0)
    elm = ELMRegressorCV(5, max_hidden=0, random_state=0).fit(X, y)
    np.testing.assert_allclose(elm.predict(X + 1.0), np.full(10, 4.5), rtol=0, atol=1e-6)
