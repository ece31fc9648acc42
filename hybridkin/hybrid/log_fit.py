"""The fit to a log as a pure function: geometry, hysteresis, hybrid and estimated error radius."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.digests import row_digests
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.hybrid._drift import Drift
from hybridkin.hybrid._fit import few_rows, fit_hybrid, fit_messages
from hybridkin.hybrid._hysteresis import moved_without, play_of
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._radius import Radius, conformal_radius
from hybridkin.hybrid._range import TrainingRange, state_range
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, Learned, Spec
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.held_out import MEAN_LENGTH, Predictions


class Start(NamedTuple):
    """Where the choices of a fit to a part of a log start: those of the fit to the whole log."""

    error_model: ErrorModel
    geometry: GeometryChoice | None


@dataclass(frozen=True)
class Settings:
    """The checked settings of a HybridForwardModel."""

    spec: Spec
    play: ArrayLike | HysteresisOperator | str | None
    coverage: float | None

    def starting_at(self, start: Start) -> Self:
        """Return the settings of a fit to a part of the log, whose choices start at those of all.

        Errors on held-out rows that predictions do not need are then not computed. "auto" fits only
        its candidates.
        """
        error_model = self.spec.error_model.starting_at(start.error_model)
        starts = ()
        if start.geometry is not None:
            starts = start.geometry.starts
        spec = replace(
            self.spec, error_model=error_model, held_out=False, starts=starts
        )
        return replace(self, spec=spec)


@dataclass(frozen=True, eq=False)
class HybridFit:
    """What a fit found, and a `HybridForwardModel` keeps.

    Attributes
    ----------
    module, learned, noise, error_model
        As in `FittedHybrid` and `FittedError`.
    fitted_rows : ndarray of shape (N,)
        Their digests.
    single_output : bool
        Whether y had one dimension.
    training_range, state_range : TrainingRange
        Of what the actuators did, and of the states of hysteresis.
    no_drift : Drift
        The drift before any measurement.
    calibration, comparison, candidates, play, radius
        The attributes of the model; the comparison is its ``cv_results_``.
    """

    module: Hybrid
    learned: Learned
    noise: float
    fitted_rows: NDArray
    single_output: bool
    training_range: TrainingRange
    no_drift: Drift
    error_model: object = None
    calibration: CalibrationResult | None = None
    comparison: CvResults | None = None
    candidates: dict[str, Hybrid] | None = None
    play: HysteresisOperator | None = None
    state_range: TrainingRange | None = None
    radius: Radius | None = None

    def expecting(self, distance: float) -> Self:
        """Return the same with the mean error of a comparison, which "auto" expects [m]."""
        if self.comparison is None:
            return self
        comparison: CvResults = {**self.comparison, "expected_distance": distance}
        return replace(self, comparison=comparison, noise=distance / MEAN_LENGTH)

    def of_all_rows(self, q: NDArray, x: NDArray) -> Self:
        """Return the same for a log of more rows, all of which count as fitted."""
        return replace(self, fitted_rows=np.unique(row_digests(q, x)))


class LogFit(NamedTuple):
    """A fit to a log, and what fits to parts of the log need."""

    hybrid: HybridFit
    messages: list[str]  # warnings, which were not issued
    start: Start
    outside: Predictions | None  # with a start: of the candidates of "auto"


def fit_to_log(
    settings: Settings, log: Rows, geometry: GeometryChoice | None = None
) -> LogFit:
    """Return what a fit finds; it changes no argument.

    Parameters
    ----------
    settings : Settings
        The settings.
    log : Rows
        The rows as they were measured.
    geometry : GeometryChoice, optional
        What to calibrate. Default: chosen on the rows.
    """
    spec = settings.spec
    rows = log.distinct()
    digests = rows.digests()
    messages = few_rows(rows, spec, settings.coverage)
    chosen = spec.with_geometry_chosen(rows, geometry)
    play, of_play = play_of(settings.play, chosen, log.in_runs())
    states = None
    if play is not None:
        commanded = rows.directions
        spec = replace(spec, commanded=commanded)
        chosen = replace(chosen, commanded=commanded)
        states = state_range(play.inner_states(log.X, log.run_of_rows, log.time), log)
        rows = log.effective(play).distinct()
    fitted = fit_hybrid(chosen, rows)
    fitted.take_low_rank(rows.q)
    radius = None
    of_radius = []
    if settings.coverage is not None:
        measured = rows
        moved = None
        if play is not None:
            measured = log.take(np.flatnonzero(log.counts > 0.0))
            moved = partial(moved_without, settings.play, chosen, log)
        radius, of_radius = conformal_radius(spec, measured, settings.coverage, moved)
    messages += [*of_play, *of_radius, *fit_messages(fitted.spec, rows)]
    error = fitted.error
    hybrid = HybridFit(
        module=fitted.module,
        learned=error.learned,
        noise=error.noise,
        fitted_rows=digests,
        single_output=log.y.ndim == 1,
        training_range=TrainingRange.of(rows.X),
        no_drift=Drift.of_range(rows.q, rows.tips.shape[1]),
        error_model=error.result,
        calibration=fitted.spec.calibration,
        comparison=error.comparison,
        candidates=error.candidates,
        play=play,
        state_range=states,
        radius=radius,
    )
    start = Start(error.settled, chosen.geometry)
    return LogFit(hybrid, [*dict.fromkeys(messages)], start, error.outside)
