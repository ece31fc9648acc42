"""The ELM: its formula, its statistics, its derivatives and its manners as an estimator."""

import joblib
import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import LinAlgWarning
from sklearn.exceptions import NotFittedError
from sklearn.linear_model import Ridge
from sklearn.utils.estimator_checks import parametrize_with_checks

from hybridkin import ELMRegressor

BOUNDS = np.array([[0.1] * 9, [0.3] * 9])
VARIANTS = [
    {},
    {"fit_intercept": True},
    {"activation": "tanh", "direct_link": True},
    {"activation": "sin", "direct_link": True, "fit_intercept": True, "input_scaling": "standard"},
    {"input_scaling": None, "weight_scale": 5.0},
]
variants = pytest.mark.parametrize("params", VARIANTS, ids=lambda p: "-".join(p) or "paper")


def trunk(n=300, seed=0, noise=0.01):
    """Lengths in [0.1, 0.3] m and a smooth three-dimensional target with noise."""
    rng = np.random.default_rng(seed)
    X = rng.uniform(0.1, 0.3, (n, 9))
    A = np.random.default_rng(99).standard_normal((9, 3))
    return X, np.sin(5 * X @ A) + 0.5 + noise * rng.standard_normal((n, 3))


def elm(n_hidden=30, alpha=0.1, **params):
    return ELMRegressor(n_hidden, alpha, random_state=0, **params)


def features(model, X):
    """What the readout sees, written out independently of the module."""
    u = (X - model.input_center_) / model.input_scale_
    a = u @ model.input_weights_.T + model.input_bias_
    sigma = {"logistic": lambda a: 1 / (1 + np.exp(-a)), "tanh": np.tanh, "sin": np.sin}
    phi = sigma[model.activation](a)
    return np.hstack([phi, u]) if model.direct_link else phi


def assert_same_model(a, b, rtol=1e-9):
    """Both have the same statistics (to rounding) and the same readout (to its conditioning)."""
    assert_allclose(a._stats.n, b._stats.n, rtol=1e-14)
    assert_allclose(a._stats.mean, b._stats.mean, rtol=1e-12, atol=1e-13)
    scale = np.sqrt(np.outer(*[b._stats.scatter.diagonal()] * 2))
    assert_allclose(a._stats.scatter / scale, b._stats.scatter / scale, rtol=0, atol=1e-12)
    atol = rtol * np.abs(b.output_weights_).max()
    assert_allclose(a.output_weights_, b.output_weights_, rtol=0, atol=atol)
    assert_allclose(a.noise_variance_, b.noise_variance_, rtol=1e-7)


@parametrize_with_checks(
    [
        ELMRegressor(),
        ELMRegressor(fit_intercept=True, direct_link=True, input_scaling="standard", block_size=7),
        ELMRegressor(n_hidden=20, alpha=1e-3, activation="tanh"),
    ]
)
def test_scikit_learn_checks(estimator, check):
    check(estimator)


# The formula


@pytest.mark.parametrize("n", [50, 300])
def test_paper_formula(n):
    X, Y = trunk(n)
    model = elm(20).fit(X, Y)
    H = features(model, X)
    expected = np.linalg.solve(H.T @ H + 0.1 * np.eye(20), H.T @ Y)
    assert_allclose(model.output_weights_, expected, rtol=0, atol=1e-12 * np.abs(expected).max())
    assert_allclose(model.predict(X), H @ expected, rtol=1e-12, atol=1e-12)
    assert_array_equal(model.intercept_, np.zeros(3))
    assert model.solver_ == "cholesky"


@variants
def test_equals_ridge_on_its_features(params):
    X, Y = trunk()
    weights = np.random.default_rng(1).uniform(0.1, 3, len(X))
    model = elm(**params).fit(X, Y, sample_weight=weights)
    phi = features(model, X)
    ridge = Ridge(0.1, fit_intercept=model.fit_intercept, solver="cholesky", tol=1e-12)
    ridge.fit(phi, Y, sample_weight=weights)
    atol = 1e-10 * np.abs(ridge.coef_).max()
    assert_allclose(model.output_weights_, ridge.coef_.T, rtol=0, atol=atol)
    assert_allclose(model.intercept_, np.broadcast_to(ridge.intercept_, 3), rtol=0, atol=atol)
    assert_allclose(model.predict(X), ridge.predict(phi), rtol=0, atol=1e-11)


def test_hidden_layer_is_the_papers():
    X, Y = trunk()
    model = elm(1000).fit(X, Y)
    W, b = model.input_weights_, model.input_bias_
    assert W.shape == (1000, 9)
    assert b.shape == (1000,)
    for draw in (W, b):
        assert np.abs(draw).max() <= 1
        assert draw.min() < -0.97
        assert draw.max() > 0.97
        assert_allclose(draw.mean(), 0, atol=4 / np.sqrt(3 * draw.size))
    # One seed used twice would make the bias the first weights again.
    assert not np.isin(b, W).any()
    assert np.abs(np.corrcoef(W.T, b)[-1, :-1]).max() < 0.15
    assert_allclose(model.input_center_ - model.input_scale_, X.min(0), rtol=1e-14)
    assert_allclose(model.input_center_ + model.input_scale_, X.max(0), rtol=1e-14)
    wide = elm(1000, weight_scale=3.0).fit(X, Y)
    assert_allclose(wide.input_weights_, 3 * W, rtol=1e-15, atol=1e-15)
    assert_allclose(wide.input_bias_, 3 * b, rtol=1e-15, atol=1e-15)


def test_input_scalings():
    X, Y = trunk()
    given_bounds = elm(input_scaling=BOUNDS.tolist()).fit(X, Y)
    assert_allclose(given_bounds.input_center_, [0.2] * 9, rtol=1e-15)
    assert_allclose(given_bounds.input_scale_, [0.1] * 9, rtol=1e-15)
    standard = elm(input_scaling="standard").fit(X, Y)
    assert_allclose(standard.input_center_, X.mean(0), rtol=1e-14)
    assert_allclose(standard.input_scale_, X.std(0), rtol=1e-13)
    read = elm(input_scaling="".join(["stan", "dard"])).fit(X, Y)  # as read from a file
    assert_array_equal(read.input_scale_, standard.input_scale_)
    raw = elm(input_scaling=None).fit(X, Y)
    assert_array_equal(raw.input_center_, np.zeros(9))
    assert_array_equal(raw.input_scale_, np.ones(9))


@pytest.mark.parametrize("input_scaling", ["minmax", "standard"])
@pytest.mark.parametrize("unit", [1e-150, 1e3, np.logspace(-3, 3, 9)])
def test_units_of_the_data_do_not_matter(unit, input_scaling):
    """Nor those of single columns."""
    X, Y = trunk()
    params = {"input_scaling": input_scaling}
    base, other = elm(**params).fit(X, Y), elm(**params).fit(unit * X, 3 * Y)
    assert_allclose(other.predict(unit * X), 3 * base.predict(X), rtol=1e-8)
    assert_allclose(other.jacobian(unit * X) * unit, 3 * base.jacobian(X), rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize("activation", ["logistic", "tanh", "sin"])
@pytest.mark.parametrize("direct_link", [False, True])
def test_features_of_a_fit_are_those_of_the_module(activation, direct_link):
    """Also where they saturate, and near zero; the functions themselves round by about eps."""
    X, Y = trunk()
    params = {"activation": activation, "direct_link": direct_link, "input_scaling": BOUNDS}
    module = elm(40, **params).fit(X, Y).module_
    scales = np.array([0.0, 1e-12, 1e-3, 1.0, 30.0, 1e4, 1e300])
    q = torch.from_numpy(np.repeat(X[:5], len(scales), axis=0) * np.tile(scales, 5)[:, None])
    with torch.no_grad():
        module.input_bias[0] = 0.0
        expected = module.features(q)
        written = torch.empty_like(expected)
        module.write_features(q, written)
    torch.testing.assert_close(written, expected, rtol=1e-15, atol=1e-15)


# Statistics: add, merge, weigh


@variants
def test_partial_fit_equals_fit(params):
    X, Y = trunk()
    params = params | ({} if params.get("input_scaling", 0) is None else {"input_scaling": BOUNDS})
    whole, parts = elm(**params).fit(X, Y), elm(**params)
    for rows in np.split(np.arange(300), [1, 2, 50, 120, 299]):
        parts.partial_fit(X[rows], Y[rows])
    assert_same_model(parts, whole)
    assert parts.n_samples_seen_ == 300


def test_merge_of_seven_shards_equals_fit():
    X, Y = trunk()
    w = np.random.default_rng(1).integers(0, 4, 300).astype(float)
    params = {"input_scaling": BOUNDS, "fit_intercept": True}
    whole = elm(**params).fit(X, Y, sample_weight=w)
    shards = [
        elm(**params).fit(X[i::7], Y[i::7], sample_weight=w[i::7]) for i in (3, 0, 6, 1, 5, 2, 4)
    ]
    before = joblib.hash(shards[1])
    merged = shards[0]
    for shard in shards[1:]:
        assert merged.merge(shard) is merged
    assert_same_model(merged, whole)
    assert joblib.hash(shards[1]) == before


@pytest.mark.parametrize("input_scaling", ["minmax", "standard"])
@pytest.mark.parametrize("fit_intercept", [False, True])
def test_sample_weight_is_repetition(fit_intercept, input_scaling):
    X, Y = trunk(120)
    X[0], X[1] = 10.0, -10.0  # absent rows at the edge of the range
    w = np.random.default_rng(2).integers(0, 4, 120)
    w[:2] = 0
    params = {"fit_intercept": fit_intercept, "input_scaling": input_scaling}
    weighted = elm(**params).fit(X, Y, sample_weight=w)
    repeated = elm(**params).fit(np.repeat(X, w, axis=0), np.repeat(Y, w, axis=0))
    assert_same_model(weighted, repeated)
    Z = X[2:]
    assert_allclose(weighted.leverage(Z), repeated.leverage(Z), rtol=1e-7)
    assert weighted.n_samples_seen_ == w.sum()


@pytest.mark.parametrize("fit_intercept", [False, True])
def test_all_weights_and_the_penalty_times_a_number_are_the_same_model(fit_intercept):
    X, Y = trunk(120)
    w = np.random.default_rng(2).uniform(0.5, 2.0, 120)
    order = np.random.default_rng(3).permutation(120)
    params = {"fit_intercept": fit_intercept, "input_scaling": "standard"}
    one = elm(**params).fit(X, Y, sample_weight=w)
    tenfold = elm(alpha=1.0, **params).fit(X[order], Y[order], sample_weight=10.0 * w[order])
    # The condition of the readout is below 1e6.
    assert_allclose(tenfold.predict(X), one.predict(X), rtol=0, atol=1e-9)
    assert_allclose(tenfold.leverage(X), 0.1 * one.leverage(X), rtol=1e-7)


# Derivatives


@variants
@pytest.mark.parametrize("m", [0, 3])
def test_jacobian(params, m):
    X, Y = trunk()
    model = elm(alpha=1e-2, **params).fit(X, Y[:, 0] if m == 0 else Y[:, :m])
    J = model.jacobian(X[:6])
    q = torch.tensor(X[:6])
    auto = torch.func.vmap(torch.func.jacrev(model.module_))(q).numpy()
    assert_allclose(J, auto[:, 0] if m == 0 else auto, rtol=1e-11, atol=1e-11)
    step = 1e-6 * np.eye(9)
    columns = [(model.predict(X[:6] + h) - model.predict(X[:6] - h)) / 2e-6 for h in step]
    assert_allclose(J, np.stack(columns, -1), rtol=1e-6, atol=1e-6)
    y, J_both = model.predict_and_jacobian(X[:6])
    assert_array_equal(J_both, J)
    assert_array_equal(y, model.predict(X[:6]))
    assert y.shape == ((6,) if m == 0 else (6, m))


@variants
def test_gradcheck(params):
    X, Y = trunk(60)
    module = elm(8, **params).fit(X, Y).module_
    q = torch.tensor(X[:2], requires_grad=True)
    for function in (module, module.jacobian, module.leverage):
        assert torch.autograd.gradcheck(function, (q,), eps=1e-7, atol=1e-5)
    assert torch.autograd.gradgradcheck(module, (q,), eps=1e-7, atol=1e-4)


# Uncertainty


@pytest.mark.filterwarnings("ignore::scipy.linalg.LinAlgWarning")
@pytest.mark.parametrize("activation", ["logistic", "tanh", "sin"])
def test_equal_rows_without_penalty_have_the_leverage_of_their_mean(activation):
    """Their features differ from the mean by rounding alone, which is not the same in a batch."""
    for n_rows in (2, 3, 7):
        X = np.full((n_rows, 1), 0.27392337)
        model = elm(
            5, alpha=0.0, activation=activation, input_scaling=None, fit_intercept=True
        ).fit(X, X)
        single = [model.leverage(X[k : k + 1])[0] for k in range(n_rows)]
        assert_allclose(model.leverage(X), 1 / n_rows, rtol=1e-12)
        assert_allclose(single, 1 / n_rows, rtol=1e-12)


@variants
def test_leverage_and_std_equal_dense_formulas(params):
    X, Y = trunk()
    model = elm(alpha=0.5, **params).fit(X, Y)
    phi, new = features(model, X), features(model, X[:20] + 0.03)
    A = 0.5 * np.eye(phi.shape[1])
    if model.fit_intercept:  # an unpenalised column of ones
        phi, new = (np.hstack([f, np.ones((len(f), 1))]) for f in (phi, new))
        A = np.pad(A, (0, 1))
    A += phi.T @ phi
    leverage = np.sum(new * np.linalg.solve(A, new.T).T, axis=1)
    assert_allclose(model.leverage(X[:20] + 0.03), leverage, rtol=1e-8)
    hat = phi @ np.linalg.solve(A, phi.T)
    assert_allclose(model.leverage(X), hat.diagonal(), rtol=1e-8)
    assert model.leverage(X).max() < 1
    noise = np.sum((Y - hat @ Y) ** 2, axis=0) / (300 - np.trace(hat))
    assert_allclose(model.noise_variance_, noise, rtol=1e-8)
    y, std = model.predict(X[:20] + 0.03, return_std=True)
    assert_array_equal(y, model.predict(X[:20] + 0.03))
    assert_allclose(std, np.sqrt(noise * (1 + leverage[:, None])), rtol=1e-8)


@pytest.mark.parametrize("fit_intercept", [False, True])
def test_std_covers_new_measurements(fit_intercept):
    rng = np.random.default_rng(3)
    X, new = rng.uniform(-1, 1, (2, 2000, 3))
    model = elm(40, alpha=1.0, fit_intercept=fit_intercept).fit(X, X[:, 0])
    phi, phi_new = features(model, X), features(model, new)
    hits, variances = [], []
    for _ in range(20):  # answers known by construction: weights from the prior, noise 0.2
        w = 0.2 * rng.standard_normal(40)
        model.fit(X, phi @ w + 7 * fit_intercept + 0.2 * rng.standard_normal(2000))
        y, std = model.predict(new, return_std=True)
        t = phi_new @ w + 7 * fit_intercept + 0.2 * rng.standard_normal(2000)
        hits.append(np.mean(np.abs(t - y) < 1.96 * std))
        variances.append(model.noise_variance_[0])
    assert_allclose(np.mean(hits), 0.95, atol=0.006)
    assert_allclose(np.mean(variances), 0.04, rtol=0.02)


# Hard data


@pytest.mark.parametrize("input_scaling", ["minmax", "standard", None])
def test_constant_and_repeated_columns(input_scaling):
    X, Y = trunk()
    X[:, 2], X[:, 5] = 0.1 + 0.2, X[:, 4]
    model = elm(input_scaling=input_scaling, direct_link=True).fit(X, Y)
    assert model.solver_ == "cholesky"
    if input_scaling is not None:
        assert model.input_scale_[2] == 1
    assert model.score(X, Y) > 0.5
    assert np.isfinite(model.jacobian(X)).all()
    X[:, 2] += np.spacing(0.3) * np.random.default_rng(0).integers(0, 2, 300)
    model.fit(X, Y)  # constant up to rounding
    assert np.ptp(X[:, 2]) > 0
    if input_scaling is not None:
        assert model.input_scale_[2] == 1


@pytest.mark.parametrize("fit_intercept", [False, True])
def test_alpha_zero(fit_intercept):
    X, Y = trunk(400)
    model = elm(6, alpha=0, fit_intercept=fit_intercept).fit(X, Y)
    assert model.solver_ == "cholesky"
    phi = np.hstack([features(model, X), np.ones((400, 1))])[:, : 6 + fit_intercept]
    expected = np.linalg.lstsq(phi, Y, rcond=None)[0]
    assert_allclose(model.output_weights_, expected[:6], rtol=1e-9)
    X[:, 1] = X[:, 0]  # the direct link now sees one column twice
    model.set_params(direct_link=True)
    with pytest.warns(LinAlgWarning, match="singular at alpha=0"):
        model.fit(X, Y)
    assert model.solver_ == "eigh"
    phi = features(model, X)
    mean = phi.mean(0) * fit_intercept
    expected = np.linalg.pinv(phi - mean, rcond=1e-10) @ (Y - Y.mean(0) * fit_intercept)
    assert_allclose(model.output_weights_, expected, rtol=0, atol=1e-8 * np.abs(expected).max())
    assert_allclose(model.leverage(X).sum(), 14 + fit_intercept, rtol=1e-8)
    inside, split = X[:1], X[:1] + 0.1 * np.eye(9)[1]  # no row separates the two columns
    assert model.leverage(inside) < 1
    assert model.leverage(split) > 1e3


# Manners


def test_clear_errors():
    X, Y = trunk()
    fitted = elm(input_scaling=BOUNDS).fit(X, Y)
    with pytest.raises(ValueError, match=r"shape \(2, 9\) with low <= high, got .* \(2, 8\)"):
        elm(input_scaling=BOUNDS[:, :8]).fit(X, Y)
    for bad in (BOUNDS[::-1], BOUNDS * np.nan):
        with pytest.raises(ValueError, match="`input_scaling` given as bounds must be"):
            elm(input_scaling=bad).fit(X, Y)
    with pytest.raises(ValueError, match="'alpha' parameter"):
        elm(alpha=-1).fit(X, Y)
    with pytest.raises(ValueError, match="NaN"):
        elm().fit(np.where(X > 0.29, np.nan, X), Y)
    with pytest.raises(ValueError, match="Negative"):
        elm().fit(X, Y, sample_weight=np.linspace(-0.1, 1.0, len(X)))
    for width in (8, 10):
        with pytest.raises(ValueError, match=f"has {width} features, but ELMRegressor is expect"):
            fitted.predict(np.zeros((2, width)))
    with pytest.raises(ValueError, match="`y` must have 3 columns as in earlier calls, got 2"):
        fitted.partial_fit(X, Y[:, :2])
    with pytest.raises(ValueError, match="overflow"):
        elm(direct_link=True, input_scaling=None).fit(X * 1e200, Y)
    with pytest.raises(NotFittedError):
        elm().merge(fitted)
    with pytest.raises(NotFittedError):
        elm().predict(X, return_std=True)
    with pytest.raises(TypeError, match="must be a fitted ELMRegressor, got Ridge"):
        fitted.merge(Ridge())
    for other, name in (
        (elm(input_scaling=BOUNDS * 2).fit(X, Y), "input_center differs"),
        (elm(31, input_scaling=BOUNDS).fit(X, Y), "input_weights differs"),
        (elm(input_scaling=BOUNDS, activation="sin").fit(X, Y), "activation differs"),
        (elm(input_scaling=BOUNDS, direct_link=True).fit(X, Y), "output_weights_"),
        (elm(input_scaling=BOUNDS).fit(X, Y[:, 0]), "output_weights_"),
    ):
        with pytest.raises(ValueError, match=name):
            fitted.merge(other)
    assert_same_model(fitted, elm(input_scaling=BOUNDS).fit(X, Y))


def test_sums_that_overflow_are_refused_and_leave_the_model():
    X, y = np.linspace(0.0, 1.0, 12).reshape(6, 2), np.linspace(0.0, 1.0, 6)
    model = ELMRegressor(3, random_state=0).fit(X, y)
    before = model.predict(X)
    for bad in (np.full((6, 2), 1e300), np.full(6, 1e300)):
        with pytest.raises(ValueError, match="`X` and `y` must give finite sums"):
            model.partial_fit(X, bad.reshape(6, -1)[:, 0])
        with pytest.raises(ValueError, match="`X` and `y` must give finite sums"):
            model.fit(X, bad)
        np.testing.assert_array_equal(model.predict(X), before)
    both = np.array([[np.inf, 0.0], [-np.inf, 0.0]])
    with pytest.raises(ValueError, match="infinity"):
        model.predict(both)
    wide = ELMRegressor(3, direct_link=True, random_state=0).fit(X, 1e30 * y)
    assert np.isinf(wide.predict(np.full((1, 2), 1e30, dtype=np.float32))).all()


def test_missing_values_are_named_by_row():
    X = np.random.default_rng(0).uniform(-1.0, 1.0, (30, 2))
    model = ELMRegressor(n_hidden=5, random_state=0).fit(X, X[:, 0])
    spoilt = X.copy()
    spoilt[7] = np.nan
    for call in (model.predict, lambda rows: model.fit(rows, X[:, 0])):
        with pytest.raises(ValueError, match=r"`X` must be finite, .* in 1 of 30 rows .*: row 7"):
            call(spoilt)
