"""The fit of a hybrid as a pure function of a specification and measured rows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import countable
from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.model import ForwardModel, PoseModel
from hybridkin._core.units import motion_message
from hybridkin.calibration.calibrate import CalibrationResult, fit_geometry, refitted
from hybridkin.calibration.choice import GeometryChoice, choose_geometry, unmoved
from hybridkin.calibration.measured import points
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._error_models import ErrorModel, FittedError, PerMarker, Residuals
from hybridkin.hybrid._guards import GroupDistance, Plane
from hybridkin.hybrid._module import Hybrid, HybridModule
from hybridkin.hybrid._rows import Rows, rare_marker
from hybridkin.hybrid._wrapped import Stacked, WithPose, pose_errors

_NEVER = 1e-9  # part of an actuator in the moved directions, if it never moves
_COUNTS = 1e12  # largest ratio of weights; a smaller weight is lost in a float64 sum


@dataclass(frozen=True)
class Spec:
    """Specification of a fit: the resolved settings of a HybridForwardModel."""

    mechanical: ForwardModel | None
    error_model: ErrorModel | None = None  # None: not chosen yet, see `select`
    calibrate: tuple[str, ...] | str = ()  # geometry to calibrate, or "auto"
    guard: str | None = "leverage"
    output: str = "position"
    random_state: int | np.random.RandomState | None = None
    geometry: GeometryChoice | None = None  # how `calibrate` was chosen
    calibration: CalibrationResult | None = None  # how `mechanical` was calibrated
    messages: tuple[str, ...] = ()  # warnings of that choice and calibration
    left_out: bool = True  # whether held-out residuals are computed as well
    commanded: Directions | None = (
        None  # of the commands, with backlash between them and rows
    )

    @property
    def learns(self) -> bool:
        """Whether anything is learned beside the calibration."""
        return self.error_model is None or self.error_model.learns


class FittedHybrid(NamedTuple):
    """Result of a fit; its warnings are in `messages` and were not issued."""

    mechanical: ForwardModel | None
    calibration: CalibrationResult | None
    error: FittedError
    module: Hybrid
    messages: tuple[str, ...]

    def predict(self, X: NDArray) -> NDArray:
        """Return the tips (N, m) at actuator vectors (N, n) [m]."""
        with torch.no_grad():
            return self.module(torch.from_numpy(X.astype(np.float64))).numpy()


def fit_hybrid(spec: Spec, rows: Rows) -> FittedHybrid:
    """Return the hybrid: the calibrated mechanical model and the error model of its residual.

    A pure function: it does not change its arguments and issues no warning.

    Parameters
    ----------
    spec : Spec
        With an error model.
    rows : Rows
        Different rows.
    """
    spec = calibrated(spec, rows, rows.groups)
    error = residuals(spec.mechanical, rows.q, rows.y, spec.output)
    left = Residuals(rows, error, spec.mechanical, spec.guard, spec.left_out)
    tips = spec.mechanical.tips() if isinstance(spec.mechanical, ArcChain) else []
    if spec.mechanical is None and np.isnan(error).any():
        tips = [None] * points(error).shape[1]
    if len(tips) > 1:
        return _fit_markers(spec, tips, left)
    assert spec.error_model is not None
    fitted = spec.error_model.fit(left)
    corrections = [correction for _, correction in fitted.corrections]
    tested = plane = None
    directions = left.directions
    if spec.learns or not directions.moved.size:
        guarded = any(correction.guard is not None for correction in corrections)
        # Backlash moves actuators off the plane of their commands, but only by its width.
        plane = Plane.of_log(spec.mechanical, rows.q, spec.commanded or directions)
        groups = rows.groups if guarded else None
        tested = GroupDistance.of_log(rows.q, groups, directions, plane)
    weights = rows.q.new_tensor([weight for weight, _ in fitted.corrections])
    if spec.output == "pose":
        mechanical = cast(PoseModel, spec.mechanical)
        module = WithPose.of(mechanical, corrections, weights, tested, plane)
    else:
        module = HybridModule(
            spec.mechanical, corrections, weights, None, tested, plane
        )
    return FittedHybrid(
        spec.mechanical, spec.calibration, fitted, module, spec.messages
    )


def _fit_markers(
    spec: Spec, tips: Sequence[ArcChain | None], left: Residuals
) -> FittedHybrid:
    """Return the hybrid of several markers, each fitted to the rows in which it was measured."""
    assert spec.error_model is not None
    models = spec.error_model.for_markers(left, tips)
    fits = []
    for k, (tip, model) in enumerate(zip(tips, models, strict=True)):
        marker = replace(spec, mechanical=tip, error_model=model)
        fits.append(fit_hybrid(marker, left.rows.marker(k)))
    module = Stacked(spec.mechanical, [fit.module for fit in fits])
    results = tuple(fit.error.result for fit in fits)
    fitted = FittedError(
        None if results[0] is None else results,
        (),
        PerMarker([fit.error.settled for fit in fits]),
        float(np.sqrt(np.mean([fit.error.noise**2 for fit in fits]))),
    )
    return FittedHybrid(
        spec.mechanical, spec.calibration, fitted, module, spec.messages
    )


def few_rows(rows: Rows, spec: Spec, coverage: float | None) -> list[str]:
    """Return warnings for rows that are too few or alike; raise an error below the least number.

    The rms of 20 held-out errors has a relative standard error of about one sixth.
    """
    n_rows, n = rows.X.shape
    learned = spec.learns
    least = 1 + bool(learned or spec.calibrate) + (coverage is not None)
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
    moved = moved_directions(rows.X).moved
    # Tendons that are commanded in balance leave some directions out, which is usual.
    usual = 2 * moved.shape[1] >= n and (np.linalg.norm(moved, axis=1) > _NEVER).all()
    still = () if usual else unmoved(spec.mechanical, rows.q)
    if n_rows >= max(20, 2 * (n + 1)):
        return [*still]
    return [
        *still,
        f"`X` holds {n_rows} different rows of {n} actuators, too few to rely on: an affine "
        f"function alone has {n + 1} coefficients for each output, and held-out errors of so few "
        f"rows do not predict the error on new ones. Record at least {10 * (n + 1)}, in several "
        "motions.",
    ]


def with_geometry_chosen(
    spec: Spec, rows: Rows, geometry: GeometryChoice | None = None
) -> Spec:
    """Return the specification with the parameters to calibrate, chosen on the rows or given.

    For a list and error_model="auto", the choice is between a plain chain and elastic tendons.
    """
    if not spec.calibrate or (
        spec.error_model is not None and spec.calibrate != "auto"
    ):
        return spec
    if geometry is None:
        geometry = choose_geometry(
            cast(Chain, spec.mechanical),
            rows.q,
            _positions(spec, rows),
            groups=rows.groups,
            weights=rows.weights,
            outside=spec.learns,
            parameters=None if spec.calibrate == "auto" else spec.calibrate,
        )
    return replace(
        spec,
        mechanical=geometry.chain,
        calibrate=geometry.parameters,
        geometry=geometry,
        messages=geometry.messages,
    )


def calibrated(spec: Spec, rows: Rows, groups: NDArray | None = None) -> Spec:
    """Return the specification with the model calibrated; its `cv_rmse` holds out `groups`."""
    if not spec.calibrate:
        return spec
    if spec.calibrate == "auto":
        return calibrated(with_geometry_chosen(spec, rows), rows, groups)
    start = None if spec.geometry is None else spec.geometry.start
    x = _positions(spec, rows)
    if start is not None and not spec.left_out:
        chain = refitted(start, rows.q, x, torch.from_numpy(rows.counts))
        return replace(spec, mechanical=chain, calibrate=())
    result, messages = fit_geometry(
        cast(Chain, spec.mechanical),
        rows.q,
        x,
        spec.calibrate,
        groups=groups,
        sample_weight=rows.weights,
        start=start,
    )
    messages = (*spec.messages, *messages)
    return replace(
        spec,
        mechanical=result.chain,
        calibrate=(),
        calibration=result,
        messages=messages,
    )


def _positions(spec: Spec, rows: Rows) -> Tensor:
    """Return the tip positions (N, 3) of rows, which may be poses [m]."""
    return torch.from_numpy(rows.tips[:, :3] if spec.output == "pose" else rows.tips)


def residuals(
    mechanical: ForwardModel | None, q: Tensor, y: NDArray, output: str
) -> NDArray:
    """Return the residual, measured minus mechanical model, in the form that is learned [m]."""
    if mechanical is None:
        return y
    if output == "pose":
        return pose_errors(cast(PoseModel, mechanical), q, y)
    with torch.no_grad():
        tips = mechanical(q).numpy()
    if not countable(tips).all():
        raise too_far()
    if tips.shape != (y.shape if y.ndim == 2 else (len(y), 1)):
        raise ValueError(
            f"`y` must have {tips.shape[1]} columns, as many as `mechanical_model` gives, got "
            f"shape {y.shape}."
        )
    return y - tips.reshape(y.shape)


def known_tips(chain: Chain, rows: Rows) -> tuple[Tensor, Tensor]:
    """Return tips (N, m), measured (if missing: of the chain), and those of the chain [m]."""
    predicted = chain(rows.q).detach()
    tips = torch.from_numpy(rows.tips[:, : chain.n_outputs])
    return torch.where(tips.isnan(), predicted, tips), predicted


def fit_messages(fitted: FittedHybrid, rows: Rows) -> tuple[str, ...]:
    """Return the warnings of a fit: of its calibration, or of rows for an uncalibrated chain."""
    chain = fitted.mechanical
    if fitted.calibration is not None or not isinstance(chain, Chain):
        return fitted.messages
    motion = motion_message("y", *known_tips(chain, rows), float(chain.reach))
    messages = [*fitted.messages, *chain.check_actuators(rows.q, "X")]
    doubts = chain.contradiction(rows.q, "X"), motion
    return (*messages, *(message for message in doubts if message is not None))
