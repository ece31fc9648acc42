"""The fit to a log as a pure function: geometry, hysteresis, hybrid and estimated error radius."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from itertools import starmap
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.groups import Groups
from hybridkin._core.progress import Progress, quiet
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import Starts
from hybridkin.hybrid._candidates import Settled
from hybridkin.hybrid._drift import Drift, too_far
from hybridkin.hybrid._fit import few_rows, fit_hybrid, fit_messages
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pace import Pace, PaceRange, each_pace, pace_range
from hybridkin.hybrid._radius import Radius
from hybridkin.hybrid._range import TrainingRange, state_range
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._selection import decided, expected_with_new_choices
from hybridkin.hybrid._spec import (
    FittedError,
    FittedHybrid,
    HysteresisChoice,
    Spec,
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
    hysteresis: Hysteresis = NO_HYSTERESIS
    state_range: TrainingRange | None = None
    pace: PaceRange | None = None
    radius: Radius | None = None
    messages: tuple[str, ...] = ()

    def with_hysteresis(self, hysteresis: Hysteresis) -> Self:
        """Return the same with another hysteresis, whose states the log does not show."""
        return replace(
            self,
            module=self.module.behind(hysteresis),
            hysteresis=hysteresis,
            state_range=None,
            pace=None,
        )

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
    hysteresis : Hysteresis
        The hysteresis; empty without one.
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
    hysteresis: Hysteresis
    fitted: FittedHybrid
    messages: list[str]
    radius: Radius | None = None

    @property
    def starts(self) -> Starts:
        """Where the choice of what to calibrate starts in parts of the log."""
        return self.spec.geometry.starts

    def effective(self, log: Rows) -> Tensor:
        """Return what the actuators do at the rows of a log (N, n)."""
        return log.effective(self.hysteresis).q

    @property
    def names(self) -> list[str]:
        """Names of the candidates of "auto"; of other error models the one name "model"."""
        return [*self.fitted.error.candidates] or ["model"]

    def settled(self) -> Settled:
        """Return the models with their choices, for fits to some of the rows that count."""
        moved = self.log.effective(self.hysteresis)
        return Settled.of(self.fitted, moved.take(self.log.counted))

    def outer(self) -> Outer | None:
        """Return what the candidates predict for the outer rows that count; None without any."""
        if not self.fitted.error.candidates:
            return None
        outer = self._outer_of_rows
        place = self.rows.place[self.log.counted]
        _, first = np.unique(place, return_index=True)
        return outer._replace(rows=first[outer.rows])

    @cached_property
    def _outer_of_rows(self) -> Outer:
        """What the candidates predict for the outer ones of the different rows."""
        return Settled.of(self.fitted, self.rows).outer()

    def settled_table(self) -> CrossFit:
        """Return what the candidates predict with their choices, for folds and outer rows."""
        settled = Settled.of(self.fitted, self.rows)
        return settled.table(self._outer_of_rows, settled.folds)

    def decided(self, table: CrossFit) -> Self:
        """Return the fit with the blend of its candidates by the weights of a table."""
        if not self.fitted.error.candidates:
            return self
        return replace(self, fitted=decided(self.fitted, self.rows, table))

    def with_settled_blend(self, table: CrossFit) -> Self:
        """Return the fit with a blend by settled choices, and the error of a table to expect.

        The penalties of all rows are those of the model, so its weights are chosen with them.
        """
        if not self.fitted.error.candidates:
            return self
        return self.decided(self.settled_table()).expecting(table.expected_error)

    def with_radius(self, table: CrossFit) -> Self:
        """Return the fit with the radius of a table of new choices, if it is asked for."""
        coverage = self.spec.coverage
        if coverage is None:
            return self
        radius = table.radius(coverage)
        doubts = radius.doubts(len(np.unique(table.groups_inside)))
        return replace(self, radius=radius, messages=[*self.messages, *doubts])

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
        hysteresis = self.hysteresis
        fitted = self.fitted
        states = None
        pace = None
        if hysteresis:
            measured = log.take(log.counted)
            size = np.ptp(log.X, axis=0)
            states = state_range(_states(hysteresis, log), measured, size)
            pace = _pace(hysteresis, log, measured)
        fitted.take_low_rank(rows.q)
        messages = [*self.messages, *fit_messages(fitted.spec, rows)]
        return HybridFit(
            module=fitted.module.behind(hysteresis),
            error=fitted.error,
            kind=fitted.error.kind,
            fitted_rows=log.distinct().digests(),
            single_output=log.y.ndim == 1,
            training_range=TrainingRange.of(rows.X),
            no_drift=Drift.of_range(rows.q, rows.tips.shape[1]),
            calibration=fitted.spec.calibration,
            hysteresis=hysteresis,
            state_range=states,
            pace=pace,
            radius=self.radius,
            messages=tuple(dict.fromkeys(messages)),
        )


def fit_once(spec: Spec, log: Rows, progress: Progress = quiet) -> FitOnce:
    """Return the hybrid of a log, after the choices of its geometry and its hysteresis.

    Parameters
    ----------
    spec : Spec
        The settings.
    log : Rows
        The rows as they were measured.
    progress : callable, optional
        Called with the number of candidates of "auto" that are fitted, and of all of them.
    """
    commands = log.distinct()
    chosen = spec.with_geometry_chosen(commands)
    hysteresis, messages = chosen.hysteresis.of(chosen, log.in_runs())
    rows = commands
    if hysteresis:
        rows = log.effective(hysteresis).distinct()
        rows = replace(rows, commanded=commands.directions)
    fitted = fit_hybrid(chosen, rows, progress)
    return FitOnce(chosen, log, rows, hysteresis, fitted, messages)


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
        choice = FoldChoice(fit.spec.geometry, fit.hysteresis, fit.fitted.error.result)
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
        table = _table_anew(spec, fit)
        fit = fit.decided(table).with_radius(table)
    elif fit.fitted.error.candidates:
        table = fit.settled_table()
        expected = expected_with_new_choices(fit.fitted, fit.rows, table)
        fit = fit.decided(table).expecting(expected)
    by_motion = _by_motion(log, fit.rows, fit.hysteresis)
    worse = worse_than_mechanical(fit.fitted, by_motion)
    found = fit.found()
    return replace(found, messages=(*messages, *found.messages, *worse))


def _table_anew(spec: Spec, fit: FitOnce) -> CrossFit:
    """Return the predictions of five folds of a log, which make the choices of a fit anew."""
    if not fit.hysteresis:
        spec = replace(spec, hysteresis=HysteresisChoice())
        rows = replace(fit.rows, place=np.arange(len(fit.rows)))
        fit = replace(fit, log=rows, rows=rows)
    log = fit.log
    if fit.fitted.error.candidates:
        spec = spec.starting_at(fit.fitted.error.settled, fit.starts)
    anew = Anew(spec.without_errors(), log)
    measured = log.take(log.counted)
    splits = measured.groups.folds()
    held_out = starmap(anew.held_out, splits)
    return CrossFit.of(fit.names, measured, splits, held_out, fit.outer())


def _states(hysteresis: Hysteresis, log: Rows) -> NDArray:
    """Return the inner states (K, R, n) of hysteresis after the rows that count."""
    states = [np.empty((len(log.counted), 0, log.X.shape[1]))]
    for state in hysteresis.each_inner_state(log.X, log.runs, log.clock):
        states.append(state[log.counted, None])
    return np.concatenate(states, axis=1)


def _pace(hysteresis: Hysteresis, log: Rows, measured: Rows) -> PaceRange | None:
    """Return the range of paces of the rows that count; None without creep."""
    if not (log.timed and hysteresis.needs_time):
        return None
    paces = []
    times = hysteresis.time_constants
    for pace in each_pace(log.X, log.runs, log.time, times):
        paces.append(Pace(pace.speeds[log.counted], pace.shown[log.counted]))
    return pace_range(paces, measured)


def _by_motion(log: Rows, rows: Rows, hysteresis: Hysteresis) -> Rows:
    """Return the rows of a fit with the groups to hold out: those of the log, else its runs."""
    runs = Groups(log.runs)
    if log.groups.whole or not runs.several:
        return rows
    by_run = replace(log, groups=runs)
    return by_run.effective(hysteresis).distinct()
