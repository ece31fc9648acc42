import warnings

import numpy as np
import pytest
import rounding
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures
from sklearn.utils.estimator_checks import parametrize_with_checks

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    jacobian,
    robots,
)


class SmallSum(torch.nn.Module):
    """A mechanical model of any number of actuators and one output."""

    def forward(self, q):
        return 0.01 * q.sum(-1, keepdim=True)


def expected_failures(estimator):
    if estimator.mechanical_model is None:
        return {}
    failures = {"check_regressor_multioutput": "this mechanical model has one output"}
    if isinstance(estimator.error_model, str):
        failures["check_regressors_train"] = "a mechanical model alone learns nothing"
    return failures


@pytest.mark.filterwarnings("ignore:`X` holds .* different rows")  # its logs are small
@pytest.mark.filterwarnings("ignore:`error_model` makes the mechanical model worse")  # and random
@parametrize_with_checks(
    [
        HybridForwardModel(),
        HybridForwardModel(error_model=LinearRegression()),
        HybridForwardModel(SmallSum()),
        HybridForwardModel(SmallSum(), KernelRidge()),
        HybridForwardModel(SmallSum(), "drop"),
    ],
    expected_failed_checks=expected_failures,
)
def test_scikit_learn_contract(estimator, check):
    check(estimator)


@pytest.fixture(scope="module")
def log():
    """Tips of a chain plus a smooth error, in 12 motions."""
    rng = np.random.default_rng(0)
    q = 0.25 + 0.06 * rng.uniform(-1, 1, (360, 9))
    x = robots.bionic_handling_assistant()(torch.from_numpy(q)).numpy()
    x += 0.02 * np.sin(20 * q[:, :3]) + 0.05 * (q[:, 3:6] - 0.25) + [0.01, 0.0, -0.02]
    x += 0.0005 * rng.standard_normal(x.shape)
    return q, x, np.repeat(np.arange(12), 30)


def bha():
    return robots.bionic_handling_assistant()


def quadratic():
    return make_pipeline(MinMaxScaler((-1, 1)), PolynomialFeatures(2), LinearRegression())


def test_the_sum_of_the_paper(log):
    q, x, _ = log
    elm = ELMRegressor(random_state=0)
    model = HybridForwardModel(bha(), elm, guard=None).fit(q, x)
    tips = bha()(torch.from_numpy(q)).numpy()
    expected = tips + elm.fit(q, x - tips).predict(q)
    assert_allclose(model.predict(q), expected, rtol=0, atol=1e-12)
    assert_allclose(model.predict_mechanical(q), tips, rtol=0, atol=1e-15)
    assert_allclose(
        model.predict_mechanical(q) + model.predict_error(q), model.predict(q), atol=1e-14
    )


@pytest.mark.parametrize("guard", ["leverage", None])
@pytest.mark.parametrize(
    "error_model",
    [
        None,
        "drop",
        LinearRegression(),
        quadratic(),
        KernelRidge(kernel="rbf", gamma=10.0, alpha=1e-3),
        GaussianProcessRegressor(RBF(1.0), alpha=1e-4, optimizer=None),
    ],
    ids=["elm", "drop", "linear", "quadratic", "kernel ridge", "gaussian process"],
)
def test_jacobian_is_that_of_the_whole_sum(log, error_model, guard):
    q, x, _ = log
    model = HybridForwardModel(bha(), error_model, guard=guard, random_state=0).fit(q, x)
    # inside the domain, at its edge, and far outside, where the guard is at work
    points = 0.25 + np.outer([0.5, 1.05, 1.6, 3.0], q[0] - 0.25)
    prediction, J = model.predict_and_jacobian(points)
    # Without the core, tips alone and tips with J are computed by other operations: sums of up to
    # a hundred terms.
    close = 100.0 * rounding.EPS
    assert_allclose(
        prediction, model.predict(points), rtol=0, atol=close * np.abs(prediction).max()
    )
    assert_array_equal(J, model.jacobian(points))
    step = 1e-5
    moves = step * np.eye(9)
    columns = [(model.predict(points + m) - model.predict(points - m)) / (2 * step) for m in moves]
    assert_allclose(np.stack(columns, -1), J, rtol=0, atol=1e-6 * np.abs(J).max())
    reverse = jacobian(lambda q: model.module_(q), torch.from_numpy(points)).numpy()
    assert_allclose(reverse, J, rtol=0, atol=1e-7 * np.abs(J).max())


def test_guard_leaves_the_training_rows_and_falls_back_to_mechanics(log):
    q, x, _ = log
    far = 0.25 + 40.0 * (q - 0.25)
    model = HybridForwardModel(bha(), LinearRegression()).fit(q, x)
    free = HybridForwardModel(bha(), LinearRegression(), guard=None).fit(q, x)
    assert model.in_domain(q).all()
    assert_allclose(model.predict(q), free.predict(q), rtol=0, atol=1e-15)
    assert not model.in_domain(far).any()
    assert np.abs(model.predict_error(far)).max() < 0.01 * np.abs(free.predict_error(far)).max()
    assert free.in_domain(far).all()


@pytest.mark.parametrize("coupling", ["parallel", "serial"])
def test_networks_without_a_seed_have_that_of_the_hybrid(log, coupling):
    q, x, _ = (part[:120] for part in log)

    def tips(*args, seed=0, **params):
        model = HybridForwardModel(bha(), *args, coupling=coupling, random_state=seed)
        return clone(model).set_params(**params).fit(q, x).predict(q[:3])

    expected = tips(ELMRegressor(20, random_state=0))
    assert_array_equal(tips(ELMRegressor(20)), expected)
    assert_array_equal(tips(error_model__n_hidden=20), expected)
    assert_array_equal(tips(seed=3, error_model__n_hidden=20, random_state=0), expected)
    assert_array_equal(tips(error_model="elm", error_model__n_hidden=20), expected)
    assert np.abs(tips(seed=1, error_model__n_hidden=20) - expected).max() > 1e-6
    assert_array_equal(tips(ELMRegressor(20, random_state=0), seed=1), expected)
    given = ELMRegressorCV(8, cv=2, relevance_rounds=0, max_hidden=0)
    assert_array_equal(tips(given), tips(given))
    assert given.random_state is None


def test_names_of_error_models_have_no_nested_parameters():
    for model in (HybridForwardModel(bha(), "quadratic"), HybridForwardModel(bha())):
        with pytest.raises(ValueError, match=r"`error_model__alpha` needs an estimator.*quadratic"):
            model.set_params(error_model="quadratic", error_model__alpha=0.1)
    with pytest.raises(ValueError, match=r"`error_model__alpha` needs an estimator.*'auto'"):
        HybridForwardModel(bha(), "auto").set_params(error_model__alpha=0.1)


@pytest.mark.parametrize("size", [1e30, 1e74, -1e74, 1e154, 1e300])
def test_numbers_too_large_for_a_model_leave_the_other_rows_alone(log, size):
    """Trees compute in float32 and refused the whole array."""
    q, x, _ = (part[:60] for part in log)
    far = q[:3].copy()
    far[1, 2] = size
    for error_model in ("linear", "kernel", RandomForestRegressor(3, random_state=0)):
        model = HybridForwardModel(bha(), error_model).fit(q, x)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", "`X` reaches")
            found = model.predict(far)
        assert_allclose(found[[0, 2]], model.predict(q[[0, 2]]), rtol=0, atol=1e-12)
        assert not model.in_domain(far)[1]
        weights = model.error_weight(far)
        assert weights[0] == weights[2] == 1.0
        assert weights[1] < 1e-12


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"error_model": "cubic"}, "'error_model'"),
        ({"mechanical_model": None, "error_model": "drop"}, "mechanical_model"),
        ({"mechanical_model": None, "coupling": "serial"}, "mechanical_model"),
        ({"calibrate": ("radius",)}, "parameters"),
        ({"mechanical_model": SmallSum(), "calibrate": ("radii",)}, "must be a chain"),
        ({"mechanical_model": SmallSum(), "error_model": "pose"}, "of arcs"),
        ({"error_model": "kernel", "coupling": "serial"}, "`error_model` must be"),
        (
            {"error_model": ELMRegressor(alpha=np.ones(3)), "coupling": "serial"},
            "`alpha` of the error model",
        ),
    ],
)
def test_bad_settings(log, settings, message):
    model = HybridForwardModel(bha()).set_params(**settings)
    y = log[1] if isinstance(model.mechanical_model, ConstantCurvatureChain) else log[1][:, 0]
    with pytest.raises((ValueError, TypeError), match=message):
        model.fit(log[0], y)


def test_bad_data(log):
    q, x, _ = log
    with pytest.raises(ValueError, match=r"`X` must have shape \(..., 9\)"):
        HybridForwardModel(bha()).fit(q[:, :6], x)
    with pytest.raises(ValueError, match="`y` must have 3 columns"):
        HybridForwardModel(bha()).fit(q, x[:, :2])
    with pytest.raises(ValueError, match="positive actuator lengths"):
        HybridForwardModel(bha()).fit(q - 0.25, x)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        HybridForwardModel(bha()).fit(1000 * q, x)
    assert any("millimetres" in str(w.message) for w in caught)


SLACK = ".* pull the tendons of a segment together"


@pytest.fixture(scope="module")
def slack_log():
    """Tips of an elastic backbone whose tendons are pulled one by one or let go, in 12 motions."""
    rng = np.random.default_rng(1)
    truth = ElasticTendonChain(
        [0.005] * 2,
        [0.1, 0.1],
        bending_stiffness=1e-6,
        axial_stiffness=[2.0, 3.0],
        rest_bends=[[0.1, -0.1], [0.0, 0.1]],
        tendon_zeros=-2e-4,
    )
    q = 0.004 * rng.uniform(-1, 1, (240, 6))
    x = truth(torch.from_numpy(q)).numpy() + 2e-4 * rng.standard_normal((240, 3))
    return q, x, np.repeat(np.arange(12), 20)


def test_the_plain_chain_tells_of_slack_once_per_call(slack_log):
    q, x, _ = slack_log
    chain = ConstantCurvatureChain([0.005] * 2, lengths=[0.1, 0.1], routing="base")
    fitted = None
    for error_model, calibrated in ((None, ()), ("drop", ("base",))):
        model = HybridForwardModel(chain, error_model, calibrate=calibrated, random_state=0)
        with pytest.warns(UserWarning, match=SLACK) as caught:
            fitted = model.fit(q, x)
        assert len(caught) == 1
    for name in ("predict", "predict_mechanical", "jacobian", "predict_and_jacobian"):
        with pytest.warns(UserWarning, match=r"\d+ of 240 rows of `X` .* mm rms") as caught:
            getattr(fitted, name)(q)
        assert len(caught) == 1
    fitted.in_domain(q)
    fitted.predict_error(q)
    parts = q.reshape(-1, 2, 3)
    fitted.predict((parts - parts.mean(2, keepdims=True)).reshape(q.shape))


@pytest.mark.parametrize("as_table", [np.asarray, np.ndarray.tolist])
@pytest.mark.parametrize("method", ["predict", "jacobian", "in_domain", "effective"])
def test_missing_values_of_new_rows_are_named_by_row(log, method, as_table):
    q, x, _ = log
    model = HybridForwardModel(bha(), "linear").fit(q, x)
    rows = q[:8].copy()
    rows[3, 2] = np.nan
    rows[5, 0] = np.inf
    with pytest.raises(
        ValueError, match=r"`X` must be finite, .* in 2 of 8 rows .*: row 3"
    ) as said:
        getattr(model, method)(as_table(rows))
    assert "leave these rows out" in str(said.value)
    assert "HistGradientBoosting" not in str(said.value)


def test_a_score_names_rows_of_y_that_are_infinite_or_lacking(log):
    q, x, _ = log
    model = HybridForwardModel(bha(), "linear").fit(q, x)
    tips = x[:8].copy()
    tips[6, 1] = -np.inf
    with pytest.raises(ValueError, match=r"`y` must be finite, .* in 1 of 8 rows .*: row 6"):
        model.score(q[:8], tips)
    with pytest.raises(ValueError, match=r"`y` must have shape \(8, 3\), .* got \(7, 3\)"):
        model.score(q[:8], tips[:7])
