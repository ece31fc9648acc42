"""The fit to a log as a pure function: geometry, hysteresis, hybrid and estimated error radius."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import starmap
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import folds
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.hybrid._drift import Drift, too_far
from hybridkin.hybrid._fit import few_rows, fit_hybrid, fit_messages
from hybridkin.hybrid._hysteresis import play_of
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pace import Pace, PaceRange, each_pace, pace_range
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._range import TrainingRange, state_range
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import (
    Settled,
    decided,
    expected_with_new_choices,
)
from hybridkin.hybrid._spec import (
    FittedError,
    FittedHybrid,
    Spec,
    Starts,
)
from hybridkin.hybrid._worse import worse_than_mechanical
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hybrid.held_out import (
    MEAN_LENGTH,
    CrossFit,
    FoldChoice,
    Outer,
    Predictions,
)


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
    calibration, play, radius
        The attributes of the model.
    geometry : GeometryChoice or None
        How the parameters to calibrate were chosen.
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
    play: HysteresisOperator | None = None
    state_range: TrainingRange | None = None
    pace: PaceRange | None = None
    radius: Radius | None = None
    messages: tuple[str, ...] = ()

    def with_play(self, play: HysteresisOperator | None) -> Self:
        """Return the same with another hysteresis, whose states the log does not show."""
        return replace(self, play=play, state_range=None, pace=None)

    @property
    def candidates(self) -> dict[str, Hybrid] | None:
        """The candidates of "auto", fitted to all rows; None for other error models."""
        fits = self.error.candidates
        return {name: fit.module for name, fit in fits.items()} or None


@dataclass(frozen=True, eq=False)
class FitOnce:
    """A fit to a log, without what a table of held-out predictions tells.

    Attributes
    ----------
    spec : Spec
        The settings, with the chosen geometry.
    log, rows : Rows
        The log, and its different rows with what the actuators do.
    play : HysteresisOperator or None
        The hysteresis.
    fitted : FittedHybrid
        The hybrid of these rows.
    messages : list of str
        Warnings about the hysteresis.
    radius : Radius or None
        The estimated error radius; None: not asked for, or not known yet.
    """

    spec: Spec
    log: Rows
    rows: Rows
    play: HysteresisOperator | None
    fitted: FittedHybrid
    messages: list[str]
    radius: Radius | None = None

    @property
    def starts(self) -> Starts:
        """Where the choice of what to calibrate starts in parts of the log."""
        if self.spec.geometry is None:
            return ()
        return self.spec.geometry.starts

    def effective(self, log: Rows) -> Tensor:
        """Return what the actuators do at the rows of a log (N, n)."""
        if self.play is None:
            return log.q
        return log.effective(self.play).q

    @property
    def names(self) -> list[str]:
        """Names of the candidates of "auto"; of other error models the one name "model"."""
        return [*self.fitted.error.candidates] or ["model"]

    def settled(self) -> Settled:
        """Return the models with their choices, for fits to some of the rows that count."""
        moved = self.log if self.play is None else self.log.effective(self.play)
        return Settled.of(self.fitted, moved.take(self.log.counted))

    def outer(self) -> Outer | None:
        """Return what the candidates predict for the outer rows that count; None without any."""
        if not self.fitted.error.candidates:
            return None
        outer = Settled.of(self.fitted, self.rows).outer()
        assert self.rows.place is not None
        place = self.rows.place[self.log.counted]
        _, first = np.unique(place, return_index=True)
        return outer._replace(rows=first[outer.rows])

    def decided(self, table: CrossFit) -> Self:
        """Return the fit with the blend of its candidates, and the radius, of a table."""
        fitted = self.fitted
        if fitted.error.candidates:
            fitted = decided(fitted, self.rows, table)
        radius = None
        messages = self.messages
        if self.spec.coverage is not None:
            radius = table.radius(self.spec.coverage)
            n_groups = len(np.unique(table.groups_inside))
            messages = [*messages, *radius.doubts(n_groups)]
        return replace(self, fitted=fitted, radius=radius, messages=messages)

    def expecting(self, distance: float) -> Self:
        """Return the fit with another mean distance to expect on new motions [m]."""
        error = self.fitted.error
        assert error.comparison is not None
        comparison: CvResults = {**error.comparison, "expected_distance": distance}
        error = replace(error, comparison=comparison, noise=distance / MEAN_LENGTH)
        return replace(self, fitted=self.fitted._replace(error=error))

    def found(self) -> HybridFit:
        """Return what a `HybridForwardModel` keeps of the fit."""
        log = self.log
        rows = self.rows
        play = self.play
        fitted = self.fitted
        states = None
        pace = None
        if play is not None:
            measured = log.take(log.counted)
            size = np.ptp(log.X, axis=0)
            states = state_range(_states(play, log), measured, size)
            pace = _pace(play, log, measured)
        fitted.take_low_rank(rows.q)
        messages = [*self.messages, *fit_messages(fitted.spec, rows)]
        return HybridFit(
            module=fitted.module,
            error=fitted.error,
            kind=fitted.error.kind,
            fitted_rows=log.distinct().digests(),
            single_output=log.y.ndim == 1,
            training_range=TrainingRange.of(rows.X),
            no_drift=Drift.of_range(rows.q, rows.tips.shape[1]),
            calibration=fitted.spec.calibration,
            geometry=self.spec.geometry,
            play=play,
            state_range=states,
            pace=pace,
            radius=self.radius,
            messages=tuple(dict.fromkeys(messages)),
        )


def fit_once(spec: Spec, log: Rows) -> FitOnce:
    """Return the hybrid of a log, after the choices of its geometry and its hysteresis."""
    commands = log.distinct()
    chosen = spec.with_geometry_chosen(commands)
    play, messages = play_of(chosen, log.in_runs())
    rows = commands
    if play is not None:
        rows = log.effective(play).distinct()
        rows = replace(rows, commanded=commands.directions)
    return FitOnce(chosen, log, rows, play, fit_hybrid(chosen, rows), messages)


class Anew(NamedTuple):
    """A specification for fits to parts of a log, each of which makes its own choices."""

    spec: Spec
    log: Rows

    def held_out(self, train: NDArray, test: NDArray) -> Predictions:
        """Return what a fit to training rows predicts for test rows, of the rows that count."""
        log = self.log
        counted = log.counted
        fit = fit_once(self.spec, log.counting(counted[train]))
        modules = [fit.fitted.module]
        if fit.fitted.error.candidates:
            modules = [part.module for part in fit.fitted.error.candidates.values()]
        q = fit.effective(log)[counted[test]]
        tips = []
        inside = []
        with torch.no_grad():
            for module in modules:
                tips.append(module(q).numpy())
                inside.append(module.in_domain(q).numpy())
        if not np.isfinite(tips).all():
            raise too_far()
        choice = FoldChoice(fit.spec.geometry, fit.play, fit.fitted.error.result)
        return Predictions(np.array(tips), np.array(inside), choice)


def fit_to_log(spec: Spec, log: Rows) -> HybridFit:
    """Return what a fit finds; it changes no argument.

    Parameters
    ----------
    spec : Spec
        The settings.
    log : Rows
        The rows as they were measured.
    """
    messages = few_rows(log.distinct(), spec)
    fit = fit_once(spec, log)
    if spec.coverage is not None:
        fit = fit.decided(_table_anew(spec, fit))
    elif fit.fitted.error.candidates:
        table = Settled.of(fit.fitted, fit.rows).table()
        expected = expected_with_new_choices(fit.fitted, fit.rows, table)
        fit = fit.decided(table).expecting(expected)
    by_motion = _by_motion(log, fit.rows, fit.play)
    worse = worse_than_mechanical(fit.fitted, by_motion)
    found = fit.found()
    return replace(found, messages=(*messages, *found.messages, *worse))


def _table_anew(spec: Spec, fit: FitOnce) -> CrossFit:
    """Return the predictions of five folds of a log, which make the choices of a fit anew."""
    if fit.play is None:
        spec = replace(spec, play=None)
        fit = replace(fit, log=fit.log.distinct())
    log = fit.log
    if fit.fitted.error.candidates:
        spec = spec.starting_at(fit.fitted.error.settled, fit.starts)
    anew = Anew(spec.without_errors(), log)
    measured = log.take(log.counted)
    splits = folds(measured.X, measured.groups)
    held_out = starmap(anew.held_out, splits)
    return CrossFit.of(fit.names, measured, splits, held_out, fit.outer())


def _states(play: HysteresisOperator, log: Rows) -> NDArray:
    """Return the inner states (K, R, n) of hysteresis after the rows that count."""
    states = [np.empty((len(log.counted), 0, log.X.shape[1]))]
    for state in play.each_inner_state(log.X, log.run_of_rows, log.time):
        states.append(state[log.counted, None])
    return np.concatenate(states, axis=1)


def _pace(play: HysteresisOperator, log: Rows, measured: Rows) -> PaceRange | None:
    """Return the range of paces of the rows that count; None without creep."""
    if log.time is None or not play.creeps:
        return None
    paces = []
    for pace in each_pace(log.X, log.run_of_rows, log.time, play.time_constants):
        paces.append(Pace(pace.speeds[log.counted], pace.shown[log.counted]))
    return pace_range(paces, measured)


def _by_motion(log: Rows, rows: Rows, play: HysteresisOperator | None) -> Rows:
    """Return the rows of a fit with the groups to hold out: those of the log, else its runs."""
    if log.groups is not None or log.runs is None:
        return rows
    by_run = replace(log, groups=log.runs)
    if play is not None:
        by_run = by_run.effective(play)
    return by_run.distinct()
