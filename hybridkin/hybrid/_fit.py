"""The fit of a hybrid as a pure function of a specification and measured rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from hybridkin._core.progress import Progress, quiet
from hybridkin.calibration.choice import unmoved
from hybridkin.calibration.measured import points
from hybridkin.hybrid._guards import GroupDistance, Plane, fit_guard
from hybridkin.hybrid._module import Hybrid, HybridModule, TipCorrection
from hybridkin.hybrid._rows import Rows, rare_marker
from hybridkin.hybrid._spec import (
    FittedError,
    FittedHybrid,
    Spec,
    Weighted,
    residuals,
)
from hybridkin.hybrid._wrapped import Stacked, WithPose

_NEVER = 1e-9  # part of an actuator in the moved directions, if it never moves
_COUNTS = 1e12  # largest ratio of weights; a smaller weight is lost in a float64 sum


def fit_hybrid(spec: Spec, rows: Rows, progress: Progress = quiet) -> FittedHybrid:
    """Return the hybrid: the calibrated mechanical model and the error model of its residual.

    A pure function: it does not change its arguments and issues no warning.

    Parameters
    ----------
    spec : Spec
        The settings.
    rows : Rows
        Different rows.
    progress : callable, optional
        See `ErrorModel.reporting`.
    """
    spec = spec.calibrated(rows)
    residual = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    rows = replace(rows, residual=residual)
    error = spec.error_model.reporting(progress).fit(rows, spec)
    return FittedHybrid(spec, error, module_of(spec, rows, error))


def module_of(spec: Spec, rows: Rows, error: FittedError) -> Hybrid:
    """Return the hybrid of a fitted error model; rows give its guards and its domain."""
    modules = []
    within = spec
    if error.refined is not None:
        within = replace(spec, mechanical=error.refined)
    markers = within.by_marker(rows)
    for part, corrections in zip(markers, error.corrections, strict=True):
        modules.append(_module(*part, corrections))
    if len(modules) > 1:
        return Stacked(spec.mechanical, modules)
    return modules[0]


def _module(rows: Rows, spec: Spec, weighted: Weighted) -> HybridModule | WithPose:
    """Return the hybrid of one tip, with guarded corrections and its domain."""
    corrections: list[TipCorrection] = []
    weights = rows.q.new_tensor([weight for weight, _ in weighted])
    # Without a mechanical model nothing would remain.
    guarded = bool(weighted) and None not in (spec.mechanical, spec.guard)
    for _, correction in weighted:
        guard = None
        if guarded:
            alone = HybridModule(spec.mechanical, [correction], weights.new_ones(1))
            with torch.no_grad():
                values = alone.error_part(rows.q)
            guard = fit_guard(spec.guard, values, correction.module, rows.q, rows.counts)
        corrections.append(type(correction)(correction.module, guard))
    directions = rows.directions
    tested = plane = None
    if spec.error_model.learns or not directions.moved.size:
        # Backlash moves actuators off the plane of their commands, but only by its width.
        plane = Plane.of_log(spec.mechanical, rows.q, rows.commanded or directions)
        held_out = guarded and rows.groups.whole
        tested = GroupDistance.of_log(rows, held_out, plane)
    if spec.output == "pose":
        assert spec.mechanical is not None  # checked with the settings
        return WithPose.of(spec.mechanical, corrections, weights, tested, plane)
    return HybridModule(spec.mechanical, corrections, weights, None, tested, plane)


def few_rows(rows: Rows, spec: Spec) -> list[str]:
    """Return warnings for rows that are too few or alike; raise an error below the least number.

    The rms of 20 held-out errors has a relative standard error of about one sixth.
    """
    n_rows, n = rows.X.shape
    learned = spec.error_model.learns
    least = 1 + bool(learned or spec.calibrate) + (spec.coverage is not None)
    if n_rows < least:
        raise ValueError(
            f"`X` must hold at least {least} different rows of positive weight, got "
            f"n_samples={n_rows}; record at least {10 * (n + 1)}."
        )
    low = rows.counts.min()
    high = rows.counts.max()
    if not (low > high / _COUNTS and 1.0 / _COUNTS < high < _COUNTS):
        raise ValueError(
            f"`sample_weight` must lie within a factor of {_COUNTS:g} of the other weights and "
            f"of 1, or be 0 (row not used), got {low:g} to {high:g}; scale the weights."
        )
    measured = (~np.isnan(points(rows.tips)[:, :, 0])).sum(axis=0)
    if measured.min() < min(2, n_rows):
        raise rare_marker(int(measured.argmin()))
    if not learned:
        return []
    messages = []
    moved = rows.directions.moved
    # Tendons that are commanded in balance leave some directions out, which is usual.
    usual = 2 * moved.shape[1] >= n and (np.linalg.norm(moved, axis=1) > _NEVER).all()
    if not usual:
        messages += unmoved(spec.mechanical, rows.q)
    if n_rows < max(20, 2 * (n + 1)):
        messages.append(
            f"`X` holds {n_rows} different rows of {n} actuators, too few to rely on: an affine "
            f"function alone has {n + 1} coefficients for each output, and held-out errors of so "
            f"few rows do not predict the error on new ones. Record at least {10 * (n + 1)}, in "
            "several motions."
        )
    return messages


def fit_messages(spec: Spec, rows: Rows) -> tuple[str, ...]:
    """Return the warnings of a fit: of its calibration, or of rows for an uncalibrated chain."""
    robot = spec.mechanical
    if spec.calibration is not None or robot is None:
        return spec.messages
    return (
        *spec.messages,
        *robot.check_actuators(rows.q, "X"),
        *robot.contradictions(rows.q, "X"),
        *robot.tip_messages(rows.q, torch.from_numpy(rows.tips), "y"),
    )
