"""What held-out motions may not change in the comparison of models, with the starts of its fits."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

from hybridkin import ConstantCurvatureChain, HybridForwardModel, datasets, robots
from hybridkin.app.workflow import FitSettings
from hybridkin.app.workflow.choices import choices_by_fold
from hybridkin.app.workflow.compare import (
    AUTO,
    _models_for,
    compare,
    mechanical_of,
    models_of,
    with_hysteresis_detected,
)
from hybridkin.app.workflow.log import checked
from hybridkin.hybrid.cross_fit import _held_out_anew, _WeightedLog
from hybridkin.hybrid.log_fit import fit_once


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
    """Return the calibration to all rows, the comparison, and its settings."""
    settings = FitSettings(**settings)
    mechanical = mechanical_of(robot, rows, settings.loss)
    settings = with_hysteresis_detected(settings, rows, robot, mechanical)
    return mechanical, compare(rows, robot, settings, mechanical, n_jobs=1), settings


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings", [{}, {"hysteresis": 1e-3}, {"auto": False}, {"loss": "soft_l1"}]
)
def test_a_held_out_motion_does_not_change_its_own_predictions(settings):
    """Only the starts of the searches know it; the blend has its own test."""
    robot, rows = measured(6)
    mechanical, before, settings = compared(robot, rows, n_folds=3, **settings)
    held_out = before.fold == 0
    train, test = np.flatnonzero(~held_out), np.flatnonzero(held_out)
    x = rows.x.copy()
    x[held_out] += [0.3, -0.2, 0.5]
    starts = {}
    for name, model in models_of(robot, mechanical, settings).items():
        fit = fit_once(*_WeightedLog(rows, rows.counts).prepared(model))
        starts[name] = (fit.fitted.error.settled, fit.starts)
    of_fold = partial(_models_for, robot, settings, mechanical)
    found = []
    for log in (rows, replace(rows, x=x)):
        weighted = _WeightedLog(log, log.counts)
        found.append(_held_out_anew(of_fold, weighted, starts, train, test))
    for name, predictions in found[0].items():
        assert_allclose(predictions.tips, found[1][name].tips, rtol=0.0, atol=1e-12)
        assert_allclose(
            predictions.tips, before.tables[name].tips[:, held_out], rtol=0.0, atol=1e-12
        )
    assert before.names[-1] == AUTO or not settings.auto
    words = choices_by_fold(before, rows.q_unit)
    if settings.auto:
        assert all(AUTO in choice for choice in words)


@pytest.mark.slow
@pytest.mark.parametrize(("n_motions", "n_folds"), [(3, 5), (4, 2)])
def test_few_motions_are_compared(n_motions, n_folds):
    robot, rows = measured(n_motions)
    _, comparison, _ = compared(robot, rows, n_folds=n_folds)
    errors = {name: e.mean for name, e in comparison.errors.items()}
    assert all(np.isfinite(error) for error in errors.values())
    assert errors[AUTO] <= 1.05 * errors["mechanical, calibrated"]


@pytest.mark.slow
def test_a_fit_near_another_one_chooses_as_from_nothing():
    """On the same rows, the penalties and their score are those of the fit to all of them."""
    robot, rows = measured(6)
    for error_model in ("linear", "quadratic"):
        model = HybridForwardModel(robot.chain, error_model, coupling="serial")
        spec, log = model.prepared(rows.q, rows.x, groups=rows.motions)
        fitted = fit_once(spec, log)
        near = fit_once(spec.starting_at(fitted.fitted.error.settled, ()), log)
        assert near.fitted.error.result.alphas == fitted.fitted.error.result.alphas
        x = fitted.fitted.predict(rows.q)
        assert_allclose(near.fitted.predict(rows.q), x, rtol=0.0, atol=1e-7)
