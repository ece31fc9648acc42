"""A warning if learned corrections make the mechanical model worse."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import folds, points
from hybridkin.hybrid._error_models import HiddenLayer, RegressorModel
from hybridkin.hybrid._fit import FittedHybrid, fit_hybrid
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec, residuals

_FEW = 20  # rows below which errors of held-out rows mean little


def worse_than_mechanical(fitted: FittedHybrid, rows: Rows) -> list[str]:
    """Return a warning if the errors of a regressor exceed those of the mechanical model alone.

    Models that choose by held-out errors compare by themselves. Of other regressors the training
    errors are compared; if these are smaller, the errors on a fifth of the groups, or rows, after
    one more fit to the other rows with the same geometry.

    Parameters
    ----------
    fitted : FittedHybrid
        The fit to all rows.
    rows : Rows
        Its rows; their groups are held out.
    """
    spec = fitted.spec
    model = spec.error_model
    if spec.mechanical is None or not isinstance(model, (RegressorModel, HiddenLayer)):
        return []
    if spec.compared or len(rows) < _FEW:  # which have warnings of their own
        return []
    before, after = _errors(spec, fitted.module, rows)
    where = "on the training rows"
    if after <= before and model.knows_held_out_error(rows):
        after = max(after, _tip(fitted.error.noise, rows))
        where = "on held-out rows"
    elif after <= before and _can_hold_out(rows):
        train, test = folds(rows.X, rows.groups)[0]
        settled = replace(spec, error_model=fitted.error.settled, held_out=False)
        with TURNS.filters, warnings.catch_warnings():  # the full fit has given them
            warnings.simplefilter("ignore")
            module = fit_hybrid(settled, rows.take(train)).module
        before, after = _errors(spec, module, rows.take(test))
        where = "on a fifth of the rows, held out"
    if after <= before:
        return []
    return [
        f"`error_model` makes the mechanical model worse: its error {where} is {1e3 * after:.3g} "
        f"mm (rms), that of the mechanical model alone {1e3 * before:.3g} mm. Use another "
        'regressor, more rows, error_model="auto", which compares, or "drop".'
    ]


def _can_hold_out(rows: Rows) -> bool:
    """Return whether a fifth of the rows, or of their groups, can be held out."""
    if np.isnan(rows.tips).any():
        return False
    return rows.groups is None or len(np.unique(rows.groups)) > 1


def _errors(spec: Spec, module: Hybrid, rows: Rows) -> tuple[float, float]:
    """Return the rms tip errors of the mechanical model and of the hybrid [m]."""
    residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    before = residual.reshape(rows.tips.shape)
    with torch.no_grad():
        after = before - module.error_part(rows.q).numpy()
    return _rms(before, rows.counts), _rms(after, rows.counts)


def _rms(residual: NDArray, counts: NDArray) -> float:
    """Return the root mean square length (of points) of residuals (N, m), NaN left out."""
    lengths = np.linalg.norm(points(residual), axis=2) ** 2
    squares = np.ma.average(np.ma.masked_invalid(lengths), axis=0, weights=counts)
    return float(squares.mean() ** 0.5)


def _tip(noise: float, rows: Rows) -> float:
    """Return the rms tip error for the standard deviation of one coordinate [m]."""
    return noise * points(rows.tips).shape[2] ** 0.5
