"""Weights are repetitions: with every error model, coupling, guard, coverage and with play.

A fit merges equal rows. Where that would hide a mistake, repetitions differ by a nanometre, or the
expected result is that of another library.
"""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupKFold, KFold
from sklearn.neighbors import KNeighborsRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    calibrate,
)
from hybridkin.calibration.choice import choose_geometry
from hybridkin.calibration.measured import inner_and_outer
from hybridkin.hybrid._error_models import NoCorrection, RegressorModel
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import Auto
from hybridkin.hybrid._spec import Mechanics, Spec
from hybridkin.hybrid.held_out import CrossFit, Outer, Predictions
from hybridkin.hybrid.log_fit import fit_to_log

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


def assert_equal_models(weighed, repeated, weights, new, atol=1e-10):
    assert_allclose(weighed.predict(new), repeated.predict(new), rtol=0, atol=atol)
    assert_allclose(weighed.error_weight(new), repeated.error_weight(new), rtol=0, atol=1e-8)
    assert weighed.radius_ == pytest.approx(repeated.radius_)
    noise = weighed._fit.error.noise
    assert noise == pytest.approx(repeated._fit.error.noise, rel=0, abs=atol, nan_ok=True)
    for name in ("residual", "left_out_errors_"):
        if hasattr(weighed.error_model_, name):
            one, many = (getattr(model.error_model_, name) for model in (weighed, repeated))
            assert np.isnan(one[weights == 0]).all()
            assert_allclose(np.repeat(one, weights, axis=0), many, rtol=0, atol=atol)


RADIUS = {"calibrate": ("radii",), "coverage": 0.8}
WITH_RADIUS = [("parallel", "elm"), ("serial", "quadratic"), ("parallel", "kernel")]


@pytest.mark.parametrize(
    ("by_motion", "options", "coupling", "kind"),
    [
        *[pytest.param(False, {}, *pair, marks=marks) for pair, marks in PAIRS],
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


@pytest.mark.parametrize(
    ("coupling", "kind"), [pytest.param(*pair, marks=marks) for pair, marks in PAIRS]
)
def test_weights_are_repetitions_that_are_not_merged(coupling, kind, log):
    """A nanometre at every tip moves predictions and held-out errors by a few nanometres."""
    q, x, weights, motions, new = log
    many = np.repeat(np.arange(len(q)), weights)
    apart = x[many] + 1e-9 * np.random.default_rng(1).standard_normal((len(many), 3))
    weighed = hybrid(kind, coupling, guard=None).fit(q, x, weights, motions)
    repeated = hybrid(kind, coupling, guard=None).fit(q[many], apart, groups=motions[many])
    if (coupling, kind) == ("parallel", "elm"):  # its noise is that of rows without all copies
        repeated._fit = weighed._fit
    assert_equal_models(weighed, repeated, weights, new, atol=3e-8)


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


def counted(log):
    """Return the rows that count, their weights and motions, and what the chain misses there."""
    q, x, weights, motions, _ = log
    kept = weights > 0
    with torch.no_grad():
        error = x - hybrid("drop").mechanical_model(torch.from_numpy(q)).numpy()
    return q[kept], x[kept], weights[kept].astype(float), motions[kept], error[kept]


def test_the_noise_and_the_guard_of_a_network_are_those_of_fits_without_each_row(log):
    """Without a row, however often it counts."""
    q, x, weights, _, error = counted(log)
    network = ELMRegressor(10, input_scaling=None, random_state=0)
    left_out = []
    leverage = []
    for row in range(len(q)):
        others = np.arange(len(q)) != row
        alone = network.fit(q[others], error[others], weights[others])
        left_out.append(error[row] - alone.predict(q[[row]])[0])
        leverage.append(alone.leverage(q[[row]])[0])
    model = HybridForwardModel(ConstantCurvatureChain([0.06]), network).fit(q, x, weights)
    variances = np.average(np.square(left_out), axis=0, weights=weights)
    assert model._fit.error.noise == pytest.approx(variances.mean() ** 0.5)
    assert model.module_.corrections[0].guard.limit.item() == pytest.approx(max(leverage))


def test_the_noise_of_a_regressor_that_overfits_is_a_part_of_what_it_learned(log):
    """A fifth of the spread about the mean, over rows as often as they count."""
    q, x, weights, _, error = counted(log)
    model = HybridForwardModel(ConstantCurvatureChain([0.06]), KNeighborsRegressor(1))
    noise = model.fit(q, x, weights)._fit.error.noise
    spread = np.repeat(error, weights.astype(int), axis=0).var(axis=0).mean() ** 0.5
    assert noise == pytest.approx(0.2 * spread)
    assert noise != pytest.approx(0.2 * error.var(axis=0).mean() ** 0.5, rel=1e-3)


def test_the_radius_is_that_of_weighted_fits_and_weighted_errors(log):
    """Every motion has the mass 1 / 7, shared by its rows by their weights."""
    q, x, weights, motions, error = counted(log)
    model = HybridForwardModel(ConstantCurvatureChain([0.06]), Ridge(0.1), guard=None, coverage=0.7)
    distances = np.empty(len(q))
    for train, test in GroupKFold(5).split(q, groups=motions):
        ridge = Ridge(0.1).fit(q[train], error[train], weights[train])
        distances[test] = np.linalg.norm(error[test] - ridge.predict(q[test]), axis=1)
    mass = weights / np.bincount(motions, weights)[motions] / 7.0
    order = np.argsort(distances)
    first = np.flatnonzero(np.cumsum(mass[order]) >= 0.7)[0]
    radius = model.fit(q, x, weights, motions).radius_.inside
    assert radius == pytest.approx(distances[order][first])
    assert model.fit(q, x, 3.0 * weights, motions).radius_.inside != radius  # ridge: more rows
    plain = HybridForwardModel(ConstantCurvatureChain([0.06]), "drop", guard=None, coverage=0.7)
    one, other = (plain.fit(q, x, w, motions).radius_.inside for w in (weights, 3.0 * weights))
    assert one == pytest.approx(other)


class Few(Auto):
    """The choice of "auto" among three models, each in closed form, on the plain chain."""

    def mechanics(self, spec, geometry, rows):
        return Mechanics(geometry)

    def _candidates(self, spec, n_rows):
        ridges = {f"ridge {alpha:g}": RegressorModel(Ridge(alpha)) for alpha in (1e-3, 0.1)}
        return {"mechanical": NoCorrection(), **ridges}


@pytest.mark.slow
@pytest.mark.parametrize("grouped", [False, True])
def test_the_selection_compares_weighted_fits_without_the_rows_that_it_predicts(grouped, log):
    """Every fold, and the inner rows, are fitted here: the chain first, then the ridges."""
    q, x, weights, motions, _ = counted(log)
    groups = motions if grouped else None
    nominal = ConstantCurvatureChain([0.06])
    rows = Rows.of(q, x, weights, groups)
    spec = Spec(nominal, Few(0), calibrate=("base",), guard=None)
    results = fit_to_log(spec, rows).error.comparison

    def predicted(train, test):
        """Return the tips of all candidates for test rows."""
        chain = calibrate(
            nominal, q[train], x[train], parameters=("base",), sample_weight=weights[train]
        ).chain
        tips = chain(torch.from_numpy(q)).detach().numpy()
        of_ridges = []
        for alpha in (1e-3, 0.1):
            ridge = Ridge(alpha).fit(q[train], x[train] - tips[train], weights[train])
            of_ridges.append(tips[test] + ridge.predict(q[test]))
        return np.array([tips[test], *of_ridges])

    if grouped:
        splits = [*GroupKFold(6, shuffle=True, random_state=0).split(q, groups=motions)]
    else:
        splits = [*KFold(10, shuffle=True, random_state=0).split(q)]
    inner, outer = inner_and_outer(q)
    inside = np.ones((3, 1), dtype=bool)
    held_out = [Predictions(predicted(*split), inside) for split in splits]
    beyond = Outer(predicted(inner, outer), x[outer], weights[outer], outer)
    both = CrossFit.of(results["candidate"][:-1], rows, splits, held_out, beyond)
    shares, expected = both.weights, both.results()
    # Calibrations of a comparison end at 1e-5 of its errors; a pick, 0.1, may be close.
    assert_allclose([*results["weights"].values()], shares, atol=0.11)
    for name in ("mean_distance", "std_distance", "io_distance"):
        assert_allclose(results[name], expected[name], rtol=5e-4)
    # These models choose no penalty, so the blend is fitted anew as it was.
    assert results["expected_distance"] == pytest.approx(results["mean_distance"][-1], rel=1e-9)
    assert 0.0 < shares.max() < 1.0


@pytest.mark.slow
def test_weights_and_motions_reach_the_choice_of_parameters(log, monkeypatch):
    q, x, weights, motions, _ = counted(log)
    chain = ConstantCurvatureChain([0.06])
    made = []

    def recorded(*args, **settings):
        made.append(choose_geometry(*args, **settings))
        return made[-1]

    monkeypatch.setattr("hybridkin.hybrid._spec.choose_geometry", recorded)
    HybridForwardModel(chain, "drop", calibrate="auto").fit(q, x, weights, motions)
    choice = choose_geometry(chain, q, x, groups=motions, weights=weights, outside=False)
    assert made[0].errors == choice.errors
    plain = choose_geometry(chain, q, x, groups=motions, outside=False)
    assert plain.errors["nothing"].cv != pytest.approx(choice.errors["nothing"].cv, rel=0.01)


def test_a_score_counts_rows_as_often_as_their_weights(log):
    q, x, weights, _, _ = log
    model = hybrid("drop")
    many = np.repeat(np.arange(len(q)), weights)
    score = model.fit(q, x).score(q, x, weights)
    assert score == pytest.approx(model.score(q[many], x[many]))
    assert score != pytest.approx(model.score(q, x), rel=1e-3)


def test_a_calibration_before_the_error_model_is_weighted(log):
    q, x, weights, motions, new = log
    motions = np.minimum(motions, 4)  # five, each of which is a fold
    many = np.repeat(np.arange(len(q)), weights)
    apart = x[many] + 1e-9 * np.random.default_rng(1).standard_normal((len(many), 3))
    weighed = hybrid("drop", calibrate=("base",)).fit(q, x, weights, motions)
    repeated = hybrid("drop", calibrate=("base",)).fit(q[many], apart, groups=motions[many])
    assert_allclose(weighed.predict(new), repeated.predict(new), rtol=0, atol=1e-7)
    assert weighed.calibration_.cv_rmse == pytest.approx(repeated.calibration_.cv_rmse, rel=1e-5)


def test_a_row_of_weight_zero_still_moves_the_actuators(log):
    q, x, weights, _, new = log
    kept = weights > 0
    effective = Hysteresis.backlash(0.02).apply_by_group(q, np.zeros(len(q)))
    weighed = hybrid("linear", hysteresis=0.02).fit(q, x, kept)
    plain = hybrid("linear").fit(effective[kept], x[kept])
    assert_allclose(
        weighed.module_(torch.from_numpy(new)).numpy(), plain.predict(new), rtol=0, atol=1e-10
    )


def test_rows_of_a_later_fit_fade_once_for_each_repetition(log):
    q, x, weights, _, new = log
    fitted = hybrid("linear").fit(q, x)
    one, two = (hybrid("linear").fit(q, x) for _ in range(2))
    for rows in (np.arange(6), np.arange(6, 12)):
        many = np.repeat(rows, weights[rows])
        one.partial_fit(q[rows], x[rows] + 0.02, weights[rows], decay=0.9)
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


def test_equal_commands_with_other_tips_are_other_rows(log):
    """Their mean counts as often as there are rows; a nanometre or a float32 is a difference."""
    q, x, _, _, new = log
    twice = np.append(np.arange(len(q)), [3, 3, 7])
    apart = x[twice] + np.append(np.zeros(len(q)), [1e-9, 0.02, -0.02])[:, None]
    chain = ConstantCurvatureChain([0.06])
    with torch.no_grad():
        error = apart - chain(torch.from_numpy(q[twice])).numpy()
    model = HybridForwardModel(chain, Ridge(0.1), guard=None).fit(q[twice], apart)
    expected = Ridge(0.1).fit(q[twice], error).predict(new)
    assert_allclose(model.predict_error(new), expected, rtol=0, atol=1e-12)
    assert len(Rows.of(q[twice], apart).distinct()) == len(twice)
