"""The hysteresis of least error on held-out motions: none, backlash, smooth friction, creep."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybridkin.hysteresis.fit import HysteresisProblem
from hybridkin.hysteresis.log import HysteresisLog
from hybridkin.hysteresis.value import NO_HYSTERESIS, Hysteresis

_CLOSE = 0.002  # tolerance of a refined width, relative to it
_LEAST = 0.0025  # first width, relative to the stroke
_LEAST_GAIN = 0.01  # relative to the error
_CERTAIN = 2.0  # standard errors of the gain over no hysteresis
# Standard deviations of the priors of slopes and gains, from few to many free weights.
_NONE = 0.0, 0.0
_CREEP = 0.0, 0.2
_SMOOTH = (0.2, 0.0), (1.0, 0.0)
_SMOOTH_AND_CREEP = (0.2, 0.2), (1.0, 0.2)


class WidthSearch(NamedTuple):
    """One backlash of every width tried.

    Attributes
    ----------
    tried : list of Candidate
        Those of the widths asked for, ascending from no backlash.
    best : Candidate
        The one with the least held-out error.
    """

    tried: list[Candidate]
    best: Candidate

    @property
    def gain(self) -> Gain:
        """The gain of the best width over no backlash."""
        return gain(self.tried[0], self.best)


def search_width(log: HysteresisLog, widths: list[float]) -> WidthSearch:
    """Return one backlash of several widths, and the one with the least held-out error.

    Parameters
    ----------
    log : HysteresisLog
        The measured rows.
    widths : list of float
        Widths to try, ascending from zero. The error is minimised between the neighbours of the
        best one.
    """
    tried = [Candidate.of(log, width, _NONE) for width in widths]
    best = min(tried, key=Candidate.error)
    if best.width > 0.0:
        place = tried.index(best)
        following = tried[min(place + 1, len(tried) - 1)]
        bounds = tried[place - 1].width, following.width
        best = _with_best_width(log, best, _NONE, bounds)
    return WidthSearch(tried, best)


def find_hysteresis(log: HysteresisLog) -> Hysteresis:
    """Return the hysteresis of the actuators; empty if none lowers the error on held-out groups.

    Tried are no friction, one backlash of the best width, and friction of plays about this width,
    each with and without creep. The one of least error must be better than none with
    certainty: its mean gain over the groups is above twice the standard error, and above 1 % of the
    error, which the linear correction can feign. Then the simplest is taken to which it has no
    clear gain, above one standard error and 1 %.

    Parameters
    ----------
    log : HysteresisLog
        The measured rows.
    """
    log = log.thinned()
    strokes = np.subtract(*np.percentile(log.q, (95, 5), axis=0))
    widest = float(np.ptp(log.q, axis=0).max())
    widths = [0.0, widest]
    if strokes.any():
        # The error can have several minima over the width, so widths of all sizes are tried.
        least = _LEAST * np.median(strokes[strokes > 0.0])
        doubled = least * 2.0 ** np.arange(20)
        widths[1:1] = doubled[doubled < widest].tolist()
    search = search_width(log, widths)
    none = search.tried[0]
    creep = Candidate.of(log, 0.0, _CREEP)
    candidates = [creep]
    if search.gain.clear:
        candidates = [search.best, creep, *_with_friction(log, search.best)]
    least = min(candidates, key=Candidate.error)
    if not gain(none, least).certain:
        return NO_HYSTERESIS
    as_good = (c for c in candidates if not gain(c, least).clear)
    return next(as_good).hysteresis


@dataclass(frozen=True, eq=False)
class Candidate:
    """A kind of hysteresis, and its errors on held-out groups.

    Attributes
    ----------
    width : float
        Width of the backlash [unit of q]; 0 without friction.
    hysteresis : Hysteresis
        Fitted to all rows; maybe empty.
    errors : ndarray of shape (G,)
        Mean tip distance of every group, of fits without it [m].
    """

    width: float
    hysteresis: Hysteresis
    errors: NDArray

    @classmethod
    def of(cls, log: HysteresisLog, width: float, spreads: tuple[float, float]) -> Candidate:
        """Return the candidate of the width of a backlash and of the spreads of the weights."""
        problem = HysteresisProblem(log, width, creep=spreads[1] > 0.0)
        fit = problem.fitted(*spreads)
        return cls(width, problem.hysteresis(fit), log.by_group(fit.distances))

    def error(self) -> float:
        """Return the mean error [m]."""
        return float(self.errors.mean())


def _with_friction(log: HysteresisLog, backlash: Candidate) -> list[Candidate]:
    """Return candidates with friction other than one backlash, from few to many free weights."""
    width = backlash.width
    with_creep = Candidate.of(log, width, _CREEP)
    if gain(backlash, with_creep).clear:
        bounds = 0.25 * width, 1.5 * width
        with_creep = _with_best_width(log, with_creep, _CREEP, bounds)
    smooth = [Candidate.of(log, width, spreads) for spreads in _SMOOTH]
    smooth_creep = [Candidate.of(log, width, both) for both in _SMOOTH_AND_CREEP]
    return [with_creep, *smooth, *smooth_creep]


def _with_best_width(
    log: HysteresisLog,
    start: Candidate,
    spreads: tuple[float, float],
    bounds: tuple[float, float],
) -> Candidate:
    """Return the candidate of least error with a width within bounds, or the start."""
    tried = [start]

    def error(width: float) -> float:
        tried.append(Candidate.of(log, width, spreads))
        return tried[-1].error()

    options = {"xatol": _CLOSE * start.width}
    minimize_scalar(error, bounds=bounds, method="bounded", options=options)
    return min(tried, key=Candidate.error)


class Gain(NamedTuple):
    """Mean reduction of the errors of groups [m], and its standard error.

    Attributes
    ----------
    mean, std_error : float
        Over the groups [m].
    clear : bool
        Whether the mean is above the standard error, and above 1 % of the error.
    certain : bool
        Whether it is above twice the standard error as well.
    """

    mean: float
    std_error: float
    clear: bool
    certain: bool


def gain(before: Candidate, after: Candidate) -> Gain:
    """Return the gain of a candidate over another one."""
    gains = before.errors - after.errors
    mean = float(gains.mean())
    std_error = float(gains.std(ddof=1) / np.sqrt(len(gains)))
    clear = mean > max(std_error, _LEAST_GAIN * before.error())
    return Gain(mean, std_error, clear, clear and mean > _CERTAIN * std_error)
