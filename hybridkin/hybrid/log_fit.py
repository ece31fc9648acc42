"""The fit to a log as a pure function: geometry, hysteresis, hybrid and estimated error radius."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.digests import row_digests
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._fit import few_rows, fit_hybrid, fit_messages
from hybridkin.hybrid._hysteresis import moved_without
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pace import Pace, PaceRange, each_pace, pace_range
from hybridkin.hybrid._radius import Radius, conformal_radius
from hybridkin.hybrid._range import TrainingRange, state_range
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import UNREFINED, FitStart, FittedError, Refinement, Spec
from hybridkin.hybrid._worse import worse_than_mechanical
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.held_out import MEAN_LENGTH
from hybridkin.hysteresis.value import NO_HYSTERESIS, Hysteresis


@dataclass(frozen=True, eq=False)
class HybridFit:
    """What a fit found, and a `HybridForwardModel` keeps; files do not contain all of it.

    Attributes
    ----------
    module, error
        As in `FittedHybrid`.
    kind : str or None
        Class of the fitted error model.
    fitted_rows : ndarray of shape (N,)
        Their digests.
    single_output : bool
        Whether y had one dimension.
    training_range, state_range : TrainingRange
        Of what the actuators did, and of the states of hysteresis.
    pace : PaceRange or None
        How fast the commands moved, with creep.
    no_drift : Drift
        The drift before any measurement.
    calibration, hysteresis, radius
        The attributes of the model.
    geometry : GeometryChoice or None
        How the parameters to calibrate were chosen.
    refinement : Refinement
        What was learned of the calibrated model before its residual.
    messages : tuple of str
        Warnings, which were not issued.
    """

    module: Hybrid
    error: FittedError
    kind: str | None
    fitted_rows: NDArray
    single_output: bool
    training_range: TrainingRange
    no_drift: Drift
    calibration: CalibrationResult | None = None
    geometry: GeometryChoice | None = None
    refinement: Refinement = UNREFINED
    hysteresis: Hysteresis = NO_HYSTERESIS
    state_range: TrainingRange | None = None
    pace: PaceRange | None = None
    radius: Radius | None = None
    messages: tuple[str, ...] = ()

    @property
    def start(self) -> FitStart:
        """Where the choices of fits to parts of the log start."""
        return FitStart(self.error.settled, self.geometry, self.refinement)

    def expecting(self, distance: float) -> Self:
        """Return the same with the mean error of a comparison, which "auto" expects [m]."""
        comparison = self.error.comparison
        if comparison is None:
            return self
        expected: CvResults = {**comparison, "expected_distance": distance}
        noise = distance / MEAN_LENGTH
        return replace(
            self, error=replace(self.error, comparison=expected, noise=noise)
        )

    def of_all_rows(self, q: NDArray, x: NDArray) -> Self:
        """Return the same for a log of more rows, all of which count as fitted."""
        return replace(self, fitted_rows=np.unique(row_digests(q, x)))


def fit_to_log(
    spec: Spec, log: Rows, geometry: GeometryChoice | None = None
) -> HybridFit:
    """Return what a fit finds; it changes no argument.

    Parameters
    ----------
    spec : Spec
        The settings.
    log : Rows
        The rows as they were measured.
    geometry : GeometryChoice, optional
        What to calibrate. Default: chosen on the rows.
    """
    commands = log.distinct()
    messages = few_rows(commands, spec)
    chosen = spec.with_geometry_chosen(commands, geometry)
    hysteresis, of_hysteresis = chosen.hysteresis.of(chosen, log.in_runs())
    rows = commands
    measured = commands
    states = None
    pace = None
    moved = None
    if hysteresis:
        spec = replace(spec, commanded=commands.directions)
        chosen = replace(chosen, commanded=commands.directions)
        measured = log.take(log.counted)
        states = state_range(_states(hysteresis, log), measured, np.ptp(log.X, axis=0))
        pace = _pace(hysteresis, log, measured)
        moved = partial(moved_without, chosen, log)
        rows = log.effective(hysteresis).distinct()
    fitted = fit_hybrid(chosen, rows)
    fitted.take_low_rank(rows.q)
    radius, of_radius = conformal_radius(spec, measured, moved)
    messages += [*of_hysteresis, *of_radius, *fit_messages(fitted.spec, rows)]
    messages += worse_than_mechanical(fitted, _by_motion(log, rows, hysteresis))
    return HybridFit(
        module=fitted.module.behind(hysteresis),
        error=fitted.error,
        kind=fitted.error.kind,
        fitted_rows=commands.digests(),
        single_output=log.y.ndim == 1,
        training_range=TrainingRange.of(rows.X),
        no_drift=Drift.of_range(rows.q, rows.tips.shape[1]),
        calibration=fitted.spec.calibration,
        geometry=chosen.geometry,
        refinement=chosen.refinement,
        hysteresis=hysteresis,
        state_range=states,
        pace=pace,
        radius=radius,
        messages=tuple(dict.fromkeys(messages)),
    )


def _states(hysteresis: Hysteresis, log: Rows) -> NDArray:
    """Return the inner states (K, R, n) of hysteresis after the rows that count."""
    states = [np.empty((len(log.counted), 0, log.X.shape[1]))]
    for state in hysteresis.each_inner_state(log.X, log.run_of_rows, log.time):
        states.append(state[log.counted, None])
    return np.concatenate(states, axis=1)


def _pace(hysteresis: Hysteresis, log: Rows, measured: Rows) -> PaceRange | None:
    """Return the range of paces of the rows that count; None without creep."""
    if log.time is None or not hysteresis.needs_time:
        return None
    paces = []
    times = hysteresis.time_constants
    for pace in each_pace(log.X, log.run_of_rows, log.time, times):
        paces.append(Pace(pace.speeds[log.counted], pace.shown[log.counted]))
    return pace_range(paces, measured)


def _by_motion(log: Rows, rows: Rows, hysteresis: Hysteresis) -> Rows:
    """Return the rows of a fit with the groups to hold out: those of the log, else its runs."""
    if log.groups is not None or log.runs is None:
        return rows
    by_run = replace(log, groups=log.runs)
    return by_run.effective(hysteresis).distinct()
