"""Regressors of another library: the unit of length has no effect, and no one makes a model worse
without a warning."""

import pickle
import warnings

import numpy as np
import pytest
import torch
from sklearn.base import BaseEstimator, RegressorMixin
from sklearn.dummy import DummyRegressor
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, WhiteKernel
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import ElasticNet, LinearRegression, Ridge
from sklearn.multioutput import MultiOutputRegressor
from sklearn.neighbors import KNeighborsRegressor
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import PolynomialFeatures, StandardScaler
from sklearn.svm import SVR

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    HybridForwardModel,
    InverseKinematics,
)
from hybridkin.hybrid.description import restorer
from hybridkin.learning.regressor_modules import (
    AffineModule,
    KernelModule,
    RescaledModule,
)

pytestmark = pytest.mark.filterwarnings("ignore:Stochastic Optimizer")


def scaled(*steps):
    return make_pipeline(StandardScaler(), *steps)


GAUSSIAN = GaussianProcessRegressor(RBF() + WhiteKernel(1e-2), optimizer=None)
BOOSTED = HistGradientBoostingRegressor(max_iter=10, min_samples_leaf=5)
REGRESSORS = {
    "MLP": scaled(MLPRegressor(hidden_layer_sizes=(20,), max_iter=100, random_state=0)),
    "SVR": scaled(MultiOutputRegressor(SVR())),
    "KernelRidge": scaled(KernelRidge(0.1, kernel="rbf")),
    "GaussianProcess": scaled(GAUSSIAN),
    "RandomForest": RandomForestRegressor(5, random_state=0),
    "KNeighbors": scaled(KNeighborsRegressor()),
    "HistGradientBoosting": MultiOutputRegressor(BOOSTED),
    "Ridge": scaled(PolynomialFeatures(2), Ridge(0.1)),
    "ElasticNet": scaled(ElasticNet(0.01)),
    "ElasticNet of squares": scaled(PolynomialFeatures(2), ElasticNet(0.01)),
}
STEPS = ("RandomForest", "KNeighbors", "HistGradientBoosting")  # rounding may decide a branch


def model(regressor, unit=1.0, **options):
    chain = ConstantCurvatureChain([0.06 * unit], lengths=None)
    return HybridForwardModel(chain, regressor, **options)


def log(n=120, seed=0):
    rng = np.random.default_rng(seed)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (n, 3))
    x = ConstantCurvatureChain([0.05])(torch.from_numpy(q)).numpy() + 0.02 * np.sin(20 * q)
    return q, x + np.array([0.3, 0.0, 0.0])


@pytest.mark.parametrize("unit", [1e3, 1024.0, 0.125])
@pytest.mark.parametrize("name", REGRESSORS)
def test_the_unit_of_length_has_no_effect(name, unit):
    """In other units the fit is the same; powers of two change no digit."""
    if name in STEPS and unit == 1e3:
        unit = 2048.0
    q, x = log()
    with warnings.catch_warnings():  # such a robot is of another size
        warnings.simplefilter("ignore")
        usual = model(REGRESSORS[name]).fit(q, x)
        found = model(REGRESSORS[name], unit).fit(unit * q, unit * x)
        new = log(30, 1)[0]
        tolerance = {"rtol": 0, "atol": 1e-7 if unit == 1e3 else 1e-10}
        np.testing.assert_allclose(
            found.predict(unit * new) / unit, usual.predict(new), **tolerance
        )
        if name not in STEPS:
            J = found.jacobian(unit * new)
            np.testing.assert_allclose(J, usual.jacobian(new), rtol=0, atol=1e-5)


@pytest.mark.parametrize("name", ["MLP", "SVR", "GaussianProcess", "ElasticNet of squares"])
def test_jacobian_updates_and_copies_are_those_of_the_prediction(name):
    q, x = log()
    fitted = model(REGRESSORS[name], output="position").fit(q, x)
    near = q[:5]
    J = fitted.jacobian(near)
    for k, step in enumerate(1e-6 * np.eye(3)):
        slope = (fitted.predict(near + step) - fitted.predict(near - step)) / 2e-6
        np.testing.assert_allclose(J[:, :, k], slope, rtol=0, atol=1e-4)
    learned = fitted.predict_mechanical(q) + fitted.error_model_.predict(q)
    weight = fitted.error_weight(q) == 1.0
    np.testing.assert_allclose(fitted.predict(q)[weight], learned[weight], rtol=0, atol=1e-10)
    copied = pickle.loads(pickle.dumps(fitted))
    np.testing.assert_array_equal(copied.predict(q), fitted.predict(q))
    moved = x + np.array([0.01, 0.0, 0.0])
    fitted.partial_fit(q, moved)
    assert np.linalg.norm(fitted.predict(q) - moved, axis=1).mean() < 0.008
    fitted.adapt(q, moved)
    assert fitted.change_.motion[0, 3] == pytest.approx(0.01, abs=5e-3)


class Waves(RegressorMixin, BaseEstimator):
    """A regressor with a torch module; its readout keeps the scale of its targets."""

    def fit(self, X, y):
        self.module_ = torch.nn.Linear(X.shape[1], y.shape[1]).double()
        solution = np.linalg.lstsq(np.column_stack([X, np.ones(len(X))]), y, rcond=None)[0].T
        with torch.no_grad():
            self.module_.weight.copy_(torch.from_numpy(solution[:, :-1]))
            self.module_.bias.copy_(torch.from_numpy(solution[:, -1]))
        self.largest_ = np.abs(y).max()
        return self

    def predict(self, X):
        with torch.no_grad():
            return self.module_(torch.from_numpy(X)).numpy()


def test_modules_of_others_are_scaled_back():
    q, x = log()
    fitted = model(Waves(), guard=None).fit(q, x)
    line = model(Ridge(1e-12), guard=None).fit(q, x)
    np.testing.assert_allclose(fitted.predict(q), line.predict(q), rtol=0, atol=1e-7)
    np.testing.assert_allclose(fitted.jacobian(q), line.jacobian(q), rtol=0, atol=1e-5)
    assert 1.0 < fitted.error_model_.regressor_.largest_ < 10.0


@pytest.mark.parametrize("name", REGRESSORS)
def test_the_module_of_scaled_residuals_is_in_metres(name):
    q, x = log()
    regressor = model(REGRESSORS[name]).fit(q, x).error_model_
    if not hasattr(regressor, "regressor_"):  # it sees metres
        return
    tolerance = {"rtol": 0, "atol": 1e-9}
    learned = regressor.module_(torch.from_numpy(q)).numpy()
    np.testing.assert_allclose(learned, regressor.predict(q), **tolerance)
    assert np.abs(learned).max() < 0.5


@pytest.mark.slow
def test_closed_forms_stay_closed_and_compiled():
    """Also a model from a file, for a regressor whose module has a layout."""
    q, x = log()
    fitted = model(REGRESSORS["ElasticNet"]).fit(q, x)
    assert InverseKinematics(fitted, q_min=0.1).tracker(q[0]).backend == "compiled"
    rng = np.random.default_rng(0)
    mean, spread = torch.from_numpy(rng.normal(size=3)), torch.tensor(0.01).double()
    kernel = KernelModule(rng.normal(size=(5, 3)), rng.normal(size=(5, 3)), 0.1, q[0], q[1])
    affine = AffineModule(rng.normal(size=(3, 3)), 0.3)
    rows = torch.from_numpy(q)
    for module in (kernel, affine):
        folded = module.rescaled(mean, spread).forward_and_jacobian(rows)
        around = RescaledModule(module, mean, spread)
        for one, other in zip(folded, around.forward_and_jacobian(rows), strict=True):
            torch.testing.assert_close(one, other, rtol=0.0, atol=1e-12)
        again = RescaledModule.from_stored(around.stored(), restorer())
        torch.testing.assert_close(again(rows), around(rows), rtol=0.0, atol=1e-15)


def test_weights_are_repetitions_for_the_scale():
    q, x = log(40)
    weights = np.random.default_rng(0).integers(0, 4, 40)
    many = np.repeat(np.arange(40), weights)
    weighed = model(REGRESSORS["SVR"]).fit(q, x, weights)
    repeated = model(REGRESSORS["SVR"]).fit(q[many], x[many])
    np.testing.assert_allclose(weighed.predict(q), repeated.predict(q), rtol=0, atol=1e-12)


def test_a_column_that_never_moves_has_a_mean_alone():
    q, x = log()
    x = ConstantCurvatureChain([0.06])(torch.from_numpy(q)).numpy() + np.array([0.1, 0.2, 0.3])
    for name in ("MLP", "SVR", "ElasticNet"):
        fitted = model(REGRESSORS[name]).fit(q, x)
        np.testing.assert_allclose(fitted.predict(q), x, rtol=0, atol=1e-9)


class Noise(RegressorMixin, BaseEstimator):
    """Predicts numbers of the right size, which have nothing to do with the rows."""

    def __init__(self, learns=False):
        self.learns = learns

    def fit(self, X, y):
        self.n_fits_ = 1
        self.rows_ = {tuple(q): x for q, x in zip(X, y, strict=True)} if self.learns else {}
        self.spread_ = np.std(y, axis=0)
        return self

    def predict(self, X):
        rng = np.random.default_rng(0)
        random = rng.normal(size=(len(X), 3)) * 5.0 * self.spread_
        return np.array([self.rows_.get(tuple(q), x) for q, x in zip(X, random, strict=True)])


NUMBERS = r"is [\d.e+]+ mm \(rms\), that of the mechanical model alone [\d.e+]+ mm"


@pytest.mark.parametrize("grouped", [False, True])
def test_corrections_that_make_the_model_worse_are_named(grouped):
    q, x = log()
    x -= [0.3, 0.0, 0.0]
    groups = np.arange(len(q)) // 12 if grouped else None
    with pytest.warns(UserWarning, match=rf"worse: its error on the training rows {NUMBERS}"):
        model(Noise()).fit(q, x, groups=groups)
    with pytest.warns(UserWarning, match=rf"worse: its error on a fifth of the rows.* {NUMBERS}"):
        model(Noise(learns=True)).fit(q, x, groups=groups)


def test_whole_groups_and_runs_are_held_out_for_the_comparison():
    """What one motion shows of itself is no error on another one: the nearest rows mislead."""
    rng = np.random.default_rng(0)
    groups = np.arange(120) // 4  # six motions are held out; of two, the difference is chance
    centre = rng.uniform(-1, 1, (30, 3))
    q = 0.25 + 0.05 * centre[groups] + 1e-4 * rng.normal(size=(120, 3))
    x = ConstantCurvatureChain([0.06])(torch.from_numpy(q)).numpy()
    x += 0.02 * rng.normal(size=(30, 3))[groups]  # an offset for each motion
    nearest = KNeighborsRegressor(1)
    model(nearest).fit(q, x)  # by rows it looks good
    for options in ({"groups": groups}, {}):
        commands = q if options else Commands(q, groups)
        with pytest.warns(UserWarning, match="a fifth of the rows, held out"):
            model(nearest).fit(commands, x, **options)


class FarOff(RegressorMixin, BaseEstimator):
    """Corrects nothing, except the row of largest first command, by a kilometre."""

    def fit(self, X, y):
        self.largest_ = X[:, 0].max()
        return self

    def predict(self, X):
        return np.where(X[:, :1] == self.largest_, 1e3, 0.0) * np.ones(3)


def test_a_single_row_far_off_is_no_chance():
    q, x = log()
    with pytest.warns(UserWarning, match=rf"worse: its error on the training rows {NUMBERS}"):
        model(FarOff(), guard=None).fit(q, x)


def test_differences_of_chance_are_not_named():
    """The linear part of pure noise: held-out errors are larger or smaller by a few percent."""
    named = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        q = 0.25 + 0.05 * rng.uniform(-1, 1, (120, 3))
        x = ConstantCurvatureChain([0.06])(torch.from_numpy(q)).numpy()
        x += 0.005 * rng.normal(size=(120, 3))
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            model(LinearRegression()).fit(q, x)
        named += any("makes the mechanical model worse" in str(w.message) for w in caught)
    assert named <= 2


def test_useful_corrections_and_few_rows_pass():
    for seed in range(5):
        q, x = log(60, seed)
        model(DummyRegressor()).fit(q, x)
        model(REGRESSORS["Ridge"]).fit(q, x, groups=np.arange(60) // 6)


@pytest.mark.parametrize("regressor", [BOOSTED, SVR(), scaled(SVR())])
def test_a_regressor_of_one_output_is_refused_with_the_way_out(regressor):
    q, x = log()
    with pytest.raises(ValueError, match=r"`error_model` must learn all columns.*MultiOutput"):
        model(regressor).fit(q, x)
    model(MultiOutputRegressor(regressor)).fit(q, x)


@pytest.mark.parametrize("name", [*STEPS, "MLP", "SVR", "Ridge", "constant"])
def test_inverse_kinematics_warns_of_regressors_without_derivatives(name):
    """Only of those that change from row to row; without mechanics they leave q where it is."""
    q, x = log()
    regressor = REGRESSORS.get(name, DummyRegressor())
    fitted = model(regressor).fit(q, x)
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        InverseKinematics(fitted, q_min=0.1, q_max=0.4)
    messages = [str(warning.message) for warning in seen]
    assert any("is zero almost everywhere" in message for message in messages) == (name in STEPS)
    if name not in STEPS:
        return
    alone = HybridForwardModel(None, regressor).fit(q, x)
    with pytest.warns(UserWarning, match="derivative is zero almost everywhere"):
        ik = InverseKinematics(alone, q_min=0.1, q_max=0.4, beta=0.0)
    tracker = ik.tracker(q[0])
    for target in x[1:4]:
        tracker.step(target)
    np.testing.assert_allclose(tracker.q, q[0], atol=1e-9)
