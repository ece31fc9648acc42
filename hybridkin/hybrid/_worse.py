"""A warning if learned corrections make the mechanical model worse."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.groups import Groups
from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import points
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

    A mean square counts as larger if it exceeds that of the mechanical model by more than one
    standard error of the latter over all groups, or rows. The spread of the differences would
    excuse a few corrections that are far off.

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
    if len(rows) < _FEW:  # which have a warning of their own
        return []
    squares, corrected = _squares(spec, fitted.module, rows)
    chance = _standard_error(squares, rows.groups)
    before = squares.sum()
    after = corrected.sum()
    where = "on the training rows"
    if after <= before + chance and model.knows_held_out_error(rows):
        after = max(after, _tip(fitted.error.noise, rows) ** 2)
        where = "on held-out rows"
    elif after <= before + chance and _can_hold_out(rows):
        train, test = rows.groups.folds()[0]
        settled = replace(spec, error_model=fitted.error.settled).without_errors()
        with TURNS.filters, warnings.catch_warnings():  # the full fit has given them
            warnings.simplefilter("ignore")
            module = fit_hybrid(settled, rows.take(train)).module
        squares, corrected = _squares(spec, module, rows.take(test))
        before = squares.sum()
        after = corrected.sum()
        chance *= (rows.counts.sum() / rows.counts[test].sum()) ** 0.5  # of fewer rows
        where = "on a fifth of the rows, held out"
    if after <= before + chance:
        return []
    return [
        f"`error_model` makes the mechanical model worse: its error {where} is "
        f"{1e3 * after**0.5:.3g} mm (rms), that of the mechanical model alone "
        f"{1e3 * before**0.5:.3g} mm. Use another regressor, more rows, "
        'error_model="auto", which compares, or "drop".'
    ]


def _can_hold_out(rows: Rows) -> bool:
    """Return whether a fifth of the rows, or of their groups, can be held out."""
    if np.isnan(rows.tips).any():
        return False
    return rows.groups.several


def _squares(spec: Spec, module: Hybrid, rows: Rows) -> tuple[NDArray, NDArray]:
    """Return the parts (N,) of the mean squared tip error: mechanical model and hybrid [m^2]."""
    residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    before = residual.reshape(rows.tips.shape)
    with torch.no_grad():
        after = before - module.error_part(rows.q).numpy()
    return _parts(before, rows.counts), _parts(after, rows.counts)


def _parts(residual: NDArray, counts: NDArray) -> NDArray:
    """Return what each row adds to the mean squared length of residuals (N, m), NaN left out."""
    squares = np.square(points(residual)).sum(2)
    weights = np.where(np.isnan(squares), 0.0, counts[:, None])
    return (np.nan_to_num(squares) * weights / weights.sum(0)).mean(1)


def _standard_error(parts: NDArray, groups: Groups) -> float:
    """Return the standard error of a sum over independent groups; over rows if it is one group."""
    _, place = np.unique(groups.divided().labels, return_inverse=True)
    parts = np.bincount(place, parts)
    return float(len(parts) ** 0.5 * parts.std(ddof=1))


def _tip(noise: float, rows: Rows) -> float:
    """Return the rms tip error for the standard deviation of one coordinate [m]."""
    return noise * points(rows.tips).shape[2] ** 0.5
