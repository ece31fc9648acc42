"""The ELM against scikit-learn on the same features, and the choosing ELM against kernel ridge."""

import numpy as np
import pytest
from learners import LEARNERS, make_arm
from numpy.testing import assert_allclose
from scipy.special import expit
from sklearn.datasets import make_friedman1
from sklearn.linear_model import Ridge, RidgeCV

from hybridkin import ELMRegressor, ELMRegressorCV

N_HIDDEN = 1000


def features(elm, X):
    u = (X - elm.input_center_) / elm.input_scale_
    return expit(u @ elm.input_weights_.T + elm.input_bias_)


@pytest.mark.slow
def test_fit_against_ridge_on_the_same_features(race, draw, timed):
    """Nine inputs, three outputs; the peer's time includes its features."""
    rows = 100_000 if timed else 200
    X = draw(rows).numpy()
    y = np.sin(40 * X[:, :3]) + 0.1 * np.random.default_rng(0).standard_normal((rows, 3))
    ours = ELMRegressor(N_HIDDEN, random_state=0).fit(X, y)
    ridge = Ridge(ours.alpha, fit_intercept=False, solver="cholesky")
    phi = features(ours, X)
    expected = ridge.fit(phi, y).coef_.T
    condition = 1 + np.sum(phi**2) / ours.alpha
    del phi
    error = np.linalg.norm(ours.output_weights_ - expected) / np.linalg.norm(expected)
    assert error < condition * np.finfo(float).eps
    race(
        f"ELM: fit, H = {N_HIDDEN}",
        "expit + Ridge(cholesky)",
        lambda: ELMRegressor(N_HIDDEN, random_state=0).fit(X, y),
        lambda: ridge.fit(features(ours, X), y),
        rows=rows,
        at_least=1.5,
    )


@pytest.mark.slow
def test_exact_leave_one_out_against_ridge_cv(race, timed):
    """Forty penalties, one hidden layer; both times include the features."""
    rows, n_hidden = (4000, N_HIDDEN) if timed else (200, 50)
    X, y = make_arm(rows)
    alphas = np.logspace(-4, 4, 40)
    ours = ELMRegressorCV(
        n_hidden, alphas, (1.0,), relevance_rounds=0, direct_link=False, random_state=0
    ).fit(X, y)
    layer, ridge = ours.best_estimator_, RidgeCV(alphas)
    ridge.fit(features(layer, X), y)
    assert ours.alpha_ == ridge.alpha_
    assert alphas[0] < ours.alpha_ < alphas[-1]
    assert_allclose(ours.best_score_, ridge.best_score_, rtol=1e-6)
    race(
        f"ELM: leave-one-out, 40 alphas, H = {n_hidden}",
        "expit + RidgeCV",
        lambda: ours.fit(X, y),
        lambda: ridge.fit(features(layer, X), y),
        rows=rows,
        at_least=1,
    )


@pytest.mark.slow
def test_choosing_elm_against_tuned_kernel_ridge(race, timed):
    """Defaults against 7 x 7 values of alpha and gamma by 5 folds; ours must err less, too."""
    rows = 2000 if timed else 300
    X, y = make_friedman1(rows, noise=1.0, random_state=0)
    X_new, y_new = make_friedman1(1000, random_state=1)
    ours, peer = ELMRegressorCV(random_state=0), LEARNERS["KernelRidge"](X.shape[1], 0)
    error, peer_error = (
        np.sqrt(np.mean((model.fit(X, y).predict(X_new) - y_new) ** 2)) for model in (ours, peer)
    )
    assert error < peer_error
    race(
        "ELMRegressorCV: fit, all chosen",
        "KernelRidge, tuned",
        lambda: ours.fit(X, y),
        lambda: peer.fit(X, y),
        rows=rows,
        at_least=1,
    )
