"""What held-out motions may not change in the comparison of models, with the starts of its fits."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import ConstantCurvatureChain, HybridForwardModel, datasets, robots
from hybridkin.app.workflow import FitSettings
from hybridkin.app.workflow.compare import (
    AUTO,
    Mechanical,
    _AutoOfFold,
    _blended,
    compare_by_group,
    fit_to_all,
    with_hysteresis_detected,
)
from hybridkin.app.workflow.log import checked
from hybridkin.hybrid.estimator import prepared, with_fit
from hybridkin.hybrid.held_out import Predictions
from hybridkin.hybrid.log_fit import fit_to_log


def measured(n_motions, n_rows=14):
    """A robot of one segment, and a log of it with a bent error and 1 mm of noise."""
    rng = np.random.default_rng(0)
    motions = np.repeat(np.arange(n_motions), n_rows)
    q = 0.2 + 0.03 * rng.uniform(-1.0, 1.0, (len(motions), 3))
    chain = ConstantCurvatureChain([0.05])
    with torch.no_grad():
        x = chain(torch.from_numpy(q)).numpy()
    x += 4.0 * (q[:, ::-1] - 0.2) ** 2 + 1e-3 * rng.standard_normal(x.shape)
    robot = robots.RobotDescription("robot", chain, "auto", None)
    return robot, checked(datasets.Log(q, x, motions), chain, base_is_free=True)


def compared(robot, rows, **settings):
    """Return the fit to all rows, the comparison, and its settings."""
    settings = FitSettings(**settings)
    mechanical = Mechanical.of(robot, rows, settings.loss)
    settings = with_hysteresis_detected(settings, rows, mechanical)
    fitted = fit_to_all(rows, robot, settings, mechanical)
    return fitted, compare_by_group(rows, robot, settings, fitted, n_jobs=1), settings


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{}, {"hysteresis": 1e-3}, {"auto": False}, {"loss": "soft_l1"}]
)
def test_a_held_out_motion_does_not_change_its_own_predictions(settings):
    """Only the starts of the searches know it; the blend has its own test."""
    robot, rows = measured(6)
    fitted, before, settings = compared(robot, rows, n_folds=3, **settings)
    x = rows.x.copy()
    x[before.fold == 0] += [0.3, -0.2, 0.5]
    after = compare_by_group(replace(rows, x=x), robot, settings, fitted, n_jobs=1)
    held_out = before.fold == 0
    assert before.tips.keys() == after.tips.keys()
    for name in before.tips.keys() - {AUTO}:
        assert_allclose(
            before.tips[name][held_out], after.tips[name][held_out], rtol=0.0, atol=1e-12
        )
        assert np.abs(before.tips[name] - after.tips[name])[~held_out].max() > 1e-3
    if settings.auto:
        assert AUTO in before.tips
        assert all(AUTO in choice for choice in before.choices)


def test_the_weights_of_a_fold_are_chosen_by_the_other_folds():
    """The model that is exact in the first fold, and wrong elsewhere, gets no weight there."""
    _, rows = measured(6)
    fold = np.arange(len(rows.q)) // 28
    rng = np.random.default_rng(1)
    predicted = rows.x + 1e-4 * rng.standard_normal((3, *rows.x.shape))
    predicted[0] += 0.01  # as mechanical
    predicted[1, fold != 0] += 0.005
    predicted[1, fold == 0] = rows.x[fold == 0]
    autos = []
    for k in range(3):
        places = np.flatnonzero(fold != k)[::4]
        outside = Predictions(
            predicted[:, places], rows.x[places], np.ones(len(places)), rows.motions[places]
        )
        autos.append(_AutoOfFold(["mechanical", "first", "all"], outside, None, ""))
    blend, words = _blended(rows, fold, predicted, autos)
    assert words[0] == "all"
    assert_array_equal(blend[fold == 0], predicted[2, fold == 0])
    x = rows.x.copy()
    x[fold == 0] += rng.standard_normal(3)
    again, _ = _blended(replace(rows, x=x), fold, predicted, autos)
    assert_array_equal(blend[fold == 0], again[fold == 0])


@pytest.mark.slow
@pytest.mark.parametrize(("n_motions", "n_folds"), [(3, 5), (4, 2)])
def test_few_motions_are_compared(n_motions, n_folds):
    robot, rows = measured(n_motions)
    _, comparison, _ = compared(robot, rows, n_folds=n_folds)
    errors = {name: e.mean() for name, e in comparison.errors.items()}
    assert all(np.isfinite(error) for error in errors.values())
    assert errors[AUTO] <= 1.05 * errors["mechanical, calibrated"]


@pytest.mark.slow
def test_a_fit_near_another_one_chooses_as_from_nothing():
    """On the same rows, the penalties and their score are those of the fit to all of them."""
    robot, rows = measured(6)
    for error_model in ("linear", "quadratic"):
        model = HybridForwardModel(robot.chain, error_model, coupling="serial")
        spec, log = prepared(model, rows.q, rows.x, rows.motions)
        fitted = fit_to_log(spec, log)
        near = fit_to_log(spec.starting_at(fitted.start), log)
        assert near.error.result.alphas == fitted.error.result.alphas
        x = with_fit(model, fitted).predict(rows.q)
        x_near = with_fit(model, near).predict(rows.q)
        assert_allclose(x_near, x, rtol=0.0, atol=1e-7)
