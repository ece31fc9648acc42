"""The fit of a hybrid as a pure function of a specification and measured rows."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from math import inf
from typing import Any, NamedTuple, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.utils.validation import has_fit_parameter
from torch import Tensor

from hybridkin._core.arrays import countable
from hybridkin._core.blocks import in_blocks
from hybridkin._core.directions import moved_directions
from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin._core.model import ForwardModel, PoseModel
from hybridkin._core.turns import TURNS
from hybridkin._core.units import motion_message
from hybridkin.calibration.calibrate import CalibrationResult, fit_geometry, refitted
from hybridkin.calibration.choice import GeometryChoice, choose_geometry, unmoved
from hybridkin.calibration.measured import points
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._features import (
    Features,
    HiddenFeatures,
    PoseFeatures,
    Projected,
    QuadraticFeatures,
)
from hybridkin.hybrid._guards import GroupDistance, Plane, fit_guard
from hybridkin.hybrid._kernel import tuned_kernel
from hybridkin.hybrid._linearised import Pair
from hybridkin.hybrid._marked import MarkedHybridModule
from hybridkin.hybrid._module import Correction, HybridModule, InnerCorrection, TipCorrection
from hybridkin.hybrid._pose import PoseHybridModule, pose_errors
from hybridkin.hybrid._readout_fit import ReadoutFit, fit_readout
from hybridkin.learning.elm import ELMRegressor, draw_layer
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.regressor_modules import error_module

_NEVER = 1e-9  # part of an actuator in the moved directions, if it never moves
_COUNTS = 1e12  # largest ratio of weights; a smaller weight is lost in a float64 sum


class Rows(NamedTuple):
    """Measured rows in the form that an estimator gets."""

    X: NDArray  # (N, n) actuator vectors, float64 or float32
    y: NDArray  # (N, m) or (N,) [m]
    weights: NDArray | None = None  # (N,), number of times each row counts
    groups: NDArray | None = None  # (N,), motion of every row

    @property
    def q(self) -> Tensor:
        """Actuator vectors (N, n) in double precision."""
        return torch.from_numpy(self.X.astype(np.float64))

    @property
    def tips(self) -> NDArray:
        """Measured tips as a matrix (N, m) [m]."""
        return self.y.reshape(len(self.y), -1)

    @property
    def counts(self) -> NDArray:
        """Number of times each row counts, (N,)."""
        return np.ones(len(self.X)) if self.weights is None else self.weights

    def take(self, rows: NDArray) -> Rows:
        """Return some of the rows."""
        return Rows(*(None if part is None else part[rows] for part in self))  # pyright: ignore

    def marker(self, k: int) -> Rows:
        """Return the rows in which marker k was measured, with only its positions as tips."""
        tips = self.tips[:, 3 * k : 3 * k + 3]
        measured = np.flatnonzero(~np.isnan(tips[:, 0]))
        if not len(measured):
            raise _rare_marker(k)
        return self._replace(y=tips).take(measured)

    def distinct(self, runs: bool = False) -> tuple[Rows, NDArray]:
        """Return the different rows, and the place of every row in them, see `distinct_rows`."""
        first, weights, place = distinct_rows(self.X, self.y, self.weights, self.groups, runs)
        return self.take(first)._replace(weights=weights), place


def _rare_marker(k: int) -> ValueError:
    """Return the error for a marker that too few rows hold."""
    return ValueError(f"`y` must hold marker {k} in at least 2 rows; remove that marker.")


class NamedFeatures(NamedTuple):
    """An error model by the name of its features, with its penalties if they are chosen."""

    kind: str  # "linear", "quadratic" or "pose"
    alphas: Pair | None = None
    noise_ratio: float = inf


class Part(NamedTuple):
    """One error model of a hybrid, its coupling and its weight."""

    weight: float
    coupling: str  # "parallel" or "serial"
    # Names are "drop" and "kernel". A fitted readout is used unchanged. With several markers and
    # parallel coupling, a tuple holds one error model per marker.
    error_model: NamedFeatures | BaseEstimator | str | ReadoutFit | tuple[Any, ...]


class Blend(NamedTuple):
    """Several fitted error models; the result is the weighted mean of their hybrids."""

    weights: tuple[float, ...]
    error_models: tuple[Any, ...]


@dataclass(frozen=True)
class Spec:
    """Specification of a fit: the resolved settings of a HybridForwardModel."""

    mechanical: ForwardModel | None
    parts: tuple[Part, ...]  # empty: not chosen yet, see `select`
    calibrate: tuple[str, ...] | str = ()  # geometry to calibrate, or "auto"
    guard: str | None = "leverage"
    output: str = "position"
    random_state: int | np.random.RandomState | None = None
    geometry: GeometryChoice | None = None  # how `calibrate` was chosen
    calibration: CalibrationResult | None = None  # how `mechanical` was calibrated
    messages: tuple[str, ...] = ()  # warnings of that choice and calibration
    left_out: bool = True  # whether held-out residuals are computed as well


class FittedHybrid(NamedTuple):
    """Result of a fit; its warnings are in `messages` and were not issued."""

    mechanical: ForwardModel | None
    calibration: CalibrationResult | None
    error_model: Any  # fitted estimator, ReadoutFit, Blend or None
    module: HybridModule
    messages: tuple[str, ...]

    def predict(self, X: NDArray) -> NDArray:
        """Return the tips (N, m) at actuator vectors (N, n) [m]."""
        with torch.no_grad():
            return self.module.rows()(torch.from_numpy(X.astype(np.float64))).numpy()


def fit_hybrid(spec: Spec, rows: Rows) -> FittedHybrid:
    """Return the hybrid: the calibrated mechanical model and error models of its residuals.

    A pure function: it does not change its arguments and issues no warning.
    """
    spec = calibrated(spec, rows, rows.groups)
    distinct, place = rows.distinct()
    error = residuals(spec.mechanical, distinct.q, distinct.y, spec.output)
    tips = spec.mechanical.tips() if isinstance(spec.mechanical, ArcChain) else []
    if spec.mechanical is None and np.isnan(error).any():
        tips = [None] * points(error).shape[1]
    if len(tips) > 1:
        return _fit_markers(spec, tips, rows)
    errors = distinct._replace(y=error)
    fits = [_fit_part(part, spec, rows, errors, place) for part in spec.parts]
    weights = tuple(part.weight for part in spec.parts)
    error_model = fits[0][0] if len(fits) == 1 else Blend(weights, tuple(one for one, _ in fits))
    shares = [w for w, (_, found) in zip(weights, fits, strict=True) if found is not None]
    corrections = [found for _, found in fits if found is not None]
    kind = PoseHybridModule if spec.output == "pose" else HybridModule
    tested = plane = None
    directions = moved_directions(errors.X)
    if not directions.moved.size or any(part.error_model != "drop" for part in spec.parts):
        guarded = any(found.guard is not None for found in corrections)
        plane = Plane.of_log(spec.mechanical, errors.q, directions)
        groups = errors.groups if guarded else None
        tested = GroupDistance.of_log(errors.q, groups, directions, plane)
    weights = rows.q.new_tensor(shares)
    module = kind(spec.mechanical, corrections, weights, None, tested, plane)
    return FittedHybrid(spec.mechanical, spec.calibration, error_model, module, spec.messages)


def _fit_markers(spec: Spec, tips: Sequence[ArcChain | None], rows: Rows) -> FittedHybrid:
    """Return the hybrid of several markers, each fitted to the rows in which it was measured.

    A serial error model is learned once from all markers, a parallel one for each marker.
    """
    joint: list[Part] = []
    for part in spec.parts:
        if spec.mechanical is not None and part.coupling == "serial" and part.error_model != "drop":
            own = part._replace(error_model=_of_marker(part.error_model, 0))
            q = rows.distinct()[0].q
            found = _fit_features(own, spec.mechanical, rows, q, spec.left_out)
            part = part._replace(error_model=found)
        joint.append(part)
    fits = []
    for k, tip in enumerate(tips):
        parts = tuple(p._replace(error_model=_of_marker(p.error_model, k, tip)) for p in joint)
        fits.append(fit_hybrid(replace(spec, mechanical=tip, parts=parts), rows.marker(k)))
    errors = tuple(one.error_model for one in fits)
    module = MarkedHybridModule(spec.mechanical, [one.module for one in fits])
    error_model = None if errors[0] is None else errors
    return FittedHybrid(spec.mechanical, spec.calibration, error_model, module, spec.messages)


def _of_marker(error_model: Any, k: int, tip: ArcChain | None = None) -> Any:
    """Return the error model of marker k; a serial one is cut to the arcs of the marker's chain."""
    if isinstance(error_model, ReadoutFit) and tip is not None:
        return error_model._replace(readout=error_model.readout.up_to(tip))
    return error_model[k] if type(error_model) is tuple else error_model


def few_rows(rows: Rows, spec: Spec, coverage: float | None) -> list[str]:
    """Return warnings for rows that are too few or alike; raise an error below the least number.

    The rms of 20 held-out errors has a relative standard error of about one sixth.
    """
    n_rows, n = rows.X.shape
    learned = not spec.parts or spec.parts[0].error_model != "drop"
    least = 1 + bool(learned or spec.calibrate) + (coverage is not None)
    if n_rows < least:
        raise ValueError(
            f"`X` must hold at least {least} different rows of positive weight, got "
            f"n_samples={n_rows}; record at least {10 * (n + 1)}."
        )
    low, high = rows.counts.min(), rows.counts.max()
    if not (low > high / _COUNTS and 1.0 / _COUNTS < high < _COUNTS):
        raise ValueError(
            f"`sample_weight` must lie within a factor of {_COUNTS:g} of the other weights and "
            f"of 1, or be 0 (row not used), got {low:g} to {high:g}; scale the weights."
        )
    measured = (~np.isnan(points(rows.tips)[:, :, 0])).sum(axis=0)
    if measured.min() < min(2, n_rows):
        raise _rare_marker(int(measured.argmin()))
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


def with_geometry_chosen(spec: Spec, rows: Rows, geometry: GeometryChoice | None = None) -> Spec:
    """Return the specification with the parameters to calibrate, chosen on the rows or given.

    For a list and error_model="auto", the choice is between a plain chain and elastic tendons.
    """
    if not spec.calibrate or (spec.parts and spec.calibrate != "auto"):
        return spec
    if geometry is None:
        geometry = choose_geometry(
            cast(Chain, spec.mechanical),
            rows.q,
            _positions(spec, rows),
            groups=rows.groups,
            weights=rows.weights,
            outside=not spec.parts or spec.parts[0].error_model != "drop",
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
        spec, mechanical=result.chain, calibrate=(), calibration=result, messages=messages
    )


def _positions(spec: Spec, rows: Rows) -> Tensor:
    """Return the tip positions (N, 3) of rows, which may be poses [m]."""
    return torch.from_numpy(rows.tips[:, :3] if spec.output == "pose" else rows.tips)


def residuals(mechanical: ForwardModel | None, q: Tensor, y: NDArray, output: str) -> NDArray:
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


def _fit_part(
    part: Part, spec: Spec, rows: Rows, errors: Rows, place: NDArray
) -> tuple[Any, Correction | None]:
    """Return the fitted error model and its guarded correction."""
    model, mechanical, q = part.error_model, spec.mechanical, errors.q
    if model == "drop":
        return None, None
    directions = moved_directions(errors.X)
    if mechanical is not None and not directions.moved.size:
        return None, None
    matrix, offset = directions.projection()
    serial = part.coupling == "serial"
    if mechanical is not None and (serial or isinstance(model, NamedFeatures)):
        known = model if isinstance(model, ReadoutFit) else None  # of several markers
        fitted = known or _fit_features(part, mechanical, rows, q, spec.left_out)
        module: ForwardModel = fitted.readout
    else:
        seen = errors  # as the model sees them; random weights have a slope in all directions
        if directions.still.size:
            X = errors.X @ matrix + offset
            seen = errors._replace(X=X.astype(errors.X.dtype))
        fitted = _fit_regressor(model, rows, seen, place)
        module = error_module(fitted, seen.q)
    if directions.still.size:
        module = Projected(module, torch.from_numpy(matrix), torch.from_numpy(offset))
    if mechanical is None:
        # No guard: no mechanical model remains where eps fades out.
        return fitted, TipCorrection(module)
    correction = InnerCorrection(mechanical, module) if serial else TipCorrection(module)
    alone = HybridModule(mechanical, [correction], q.new_ones(1))
    with torch.no_grad():
        (found,) = in_blocks(lambda rows: (alone.error_part(rows),), q)
        correction.guard = fit_guard(spec.guard, found, module, q, errors.counts)
    return fitted, correction


def _fit_regressor(model: Any, given_rows: Rows, rows: Rows, place: NDArray) -> Any:
    """Return the regressor fitted to the residuals of the different rows."""
    if isinstance(model, str):  # "kernel"
        model = tuned_kernel(rows.X, rows.y, rows.counts, rows.groups)
    elif not isinstance(model, (ELMRegressor, ELMRegressorCV)):  # is fitted to the given rows
        kept = np.flatnonzero(given_rows.counts)
        rows = rows.take(place[kept])._replace(weights=given_rows.take(kept).weights)
    given = {} if rows.weights is None else {"sample_weight": rows.weights}
    if rows.groups is not None and has_fit_parameter(model, "groups"):
        given["groups"] = rows.groups
    regressor: Any = clone(model)
    with TURNS.filters if isinstance(regressor, KernelRidge) else nullcontext():
        fitted = regressor.fit(rows.X, rows.y, **given)
    if isinstance(fitted, ELMRegressorCV):
        fitted.left_out_errors_ = at_place(fitted.left_out_errors_, place)
    return fitted


def _fit_features(
    part: Part, mechanical: ForwardModel, rows: Rows, q: Tensor, left_out: bool
) -> ReadoutFit:
    """Return the readout of named features, or of the hidden layer of an ELM.

    The `alpha` of an ELMRegressor is the penalty; for an ELMRegressorCV the penalties are chosen.
    """
    model = part.error_model
    if isinstance(model, NamedFeatures):
        features, alphas, noise_ratio = _named(model.kind, mechanical, q), *model[1:]
    else:
        features, alphas = _hidden(cast("ELMRegressor | ELMRegressorCV", model), q)
        noise_ratio = inf
    x = torch.from_numpy(rows.tips)
    weight = None if rows.weights is None else torch.from_numpy(rows.weights)
    given = rows.q, x, part.coupling, weight, rows.groups
    try:
        return fit_readout(mechanical, features, *given, alphas, noise_ratio, left_out)
    except torch.linalg.LinAlgError as error:  # pyright: ignore
        raise too_far() from error


def _named(kind: str, mechanical: ForwardModel, q: Tensor) -> Features:
    if kind != "pose":
        return (QuadraticFeatures if kind == "quadratic" else Features).of_range(q)
    if not isinstance(mechanical, ArcChain):
        raise TypeError(
            "`mechanical_model` must be a chain of arcs with error_model='pose', got "
            f"{type(mechanical).__name__}; use error_model='quadratic'."
        )
    return PoseFeatures.of_range(q, mechanical)


def _hidden(model: ELMRegressor | ELMRegressorCV, q: Tensor) -> tuple[Features, Pair | None]:
    params, alphas = model, None
    if isinstance(model, ELMRegressorCV):
        n_hidden, seed = int(np.max(model.n_hidden)), model.random_state
        params = ELMRegressor(n_hidden, activation=model.activation, random_state=seed)
    elif np.ndim(model.alpha):
        raise ValueError(
            "`alpha` of the error model must be one number with coupling='serial', got "
            f"{model.alpha!r}: coordinates inside the robot do not correspond to single outputs."
        )
    else:
        alphas = float(model.alpha), float(model.alpha)
    layer = draw_layer(params, q.numpy(), None)
    inner = layer.input_weights, layer.input_bias, layer.activation
    return HiddenFeatures.of_range(q, *inner), alphas


def known_tips(chain: Chain, rows: Rows) -> tuple[Tensor, Tensor]:
    """Return tips (N, m), measured (if missing: of the chain), and those of the chain [m]."""
    found = chain(rows.q).detach()
    tips = torch.from_numpy(rows.tips[:, : chain.n_outputs])
    return torch.where(tips.isnan(), found, tips), found


def fit_messages(fitted: FittedHybrid, rows: Rows) -> tuple[str, ...]:
    """Return the warnings of a fit: of its calibration, or of rows for an uncalibrated chain."""
    chain = fitted.mechanical
    if fitted.calibration is not None or not isinstance(chain, Chain):
        return fitted.messages
    motion = motion_message("y", *known_tips(chain, rows), float(chain.reach))
    found = [*fitted.messages, *chain.check_actuators(rows.q, "X")]
    more = chain.contradiction(rows.q, "X"), motion
    return (*found, *(message for message in more if message is not None))
