"""The hysteresis of least error on held-out motions: none, backlash, smooth friction, creep."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybridkin.calibration.hysteresis_fit import HysteresisLog, HysteresisProblem
from hybridkin.chains.hysteresis import HysteresisOperator

_CLOSE = 0.002  # tolerance of a refined width, relative to it
_LEAST = 0.0025  # first width, relative to the stroke
_LEAST_GAIN = 0.01  # relative to the error
_CERTAIN = 2.0  # standard errors of the gain over no hysteresis
# Standard deviations of the priors of slopes and gains, from few to many free weights.
_NONE = 0.0, 0.0
_CREEP = 0.0, 0.2
_SMOOTH = (0.2, 0.0), (1.0, 0.0)
_SMOOTH_AND_CREEP = (0.2, 0.2), (1.0, 0.2)


@dataclass(frozen=True)
class WidthSearch:
    """Backlash (also called play) with the least held-out error.

    Attributes
    ----------
    width : float
        The width of least error [unit of q].
    widths : ndarray of shape (W,)
        Widths tried, ascending from zero, including doubled ones if the largest was the best.
    cv_distance : ndarray of shape (W,)
        Mean tip distance on held-out motions for each width [m], with a linear correction inside
        the model.
    gain : float
        Mean reduction of the distances of motions by the best width [m].
    gain_std_error : float
        Standard error of `gain` over the motions [m].
    kept : bool
        Whether the play lowers the error: `gain` is above `gain_std_error` and 1 % of the error.
    """

    width: float
    widths: NDArray
    cv_distance: NDArray
    gain: float
    gain_std_error: float
    kept: bool


def search_width(
    log: HysteresisLog, widths: list[float], *, refine: bool = False
) -> WidthSearch:
    """Return the width of one backlash with the least held-out error.

    Parameters
    ----------
    log : HysteresisLog
        The measured rows.
    widths : list of float
        Widths to try, ascending from zero. While the largest is the best, twice that width is tried
        too, up to the largest range of q.
    refine : bool, default=False
        Whether to minimise the error between the neighbours of the best width.
    """
    widest = float(np.ptp(log.q, axis=0).max())

    @cache
    def errors_of(width: float) -> NDArray:
        return _Candidate.of(log, width, _NONE).errors

    def error(width: float) -> float:
        return float(errors_of(width).mean())

    widths = list(widths)
    best = min(widths, key=error)
    while 0.0 < best == widths[-1] < widest:
        widths.append(min(2.0 * best, widest))
        best = min(widths, key=error)
    if refine and best > 0.0:
        place = widths.index(best)
        bounds = widths[place - 1], widths[min(place + 1, len(widths) - 1)]
        options = {"xatol": _CLOSE * best}
        minimum = minimize_scalar(
            error, bounds=bounds, method="bounded", options=options
        )
        best = min(best, float(minimum.x), key=error)
    gain = _gain(errors_of(0.0), errors_of(best))
    return WidthSearch(
        best,
        np.array(widths),
        np.array([error(width) for width in widths]),
        gain.mean,
        gain.std_error,
        gain.clear,
    )


def find_hysteresis(log: HysteresisLog) -> HysteresisOperator | None:
    """Return the hysteresis of the actuators; None if none lowers the error on held-out groups.

    Tried are no friction, one backlash of the best width, and Prandtl-Ishlinskii operators about
    this width, each with and without creep. The one of least error must be better than none with
    certainty: its mean gain over the groups is above twice the standard error, and above 1 % of the
    error, which the linear correction can feign. Then the simplest is taken to which it has no
    clear gain, above one standard error and 1 %.

    Parameters
    ----------
    log : HysteresisLog
        The measured rows.
    """
    strokes = np.subtract(*np.percentile(log.q, (95, 5), axis=0))
    widest = float(np.ptp(log.q, axis=0).max())
    widths = [0.0, widest]
    if strokes.any():
        # The error can have several minima over the width, so widths of all sizes are tried.
        least = _LEAST * np.median(strokes[strokes > 0.0])
        doubled = least * 2.0 ** np.arange(20)
        widths[1:1] = doubled[doubled < widest].tolist()
    width = search_width(log, widths, refine=True).width

    none = _Candidate.of(log, 0.0, _NONE)
    creep = _Candidate.of(log, 0.0, _CREEP)
    candidates = [creep]
    if width > 0.0:
        backlash = _Candidate.of(log, width, _NONE)
        if _gain(none.errors, backlash.errors).clear:
            candidates = [backlash, creep, *_with_friction(log, backlash)]
    least = min(candidates, key=_Candidate.error)
    if not _gain(none.errors, least.errors).certain:
        return None
    as_good = (c for c in candidates if not _gain(c.errors, least.errors).clear)
    return next(as_good).operator


class _Candidate(NamedTuple):
    """A kind of hysteresis, and its errors on held-out groups."""

    width: float
    operator: HysteresisOperator | None
    errors: NDArray

    @classmethod
    def of(
        cls, log: HysteresisLog, width: float, spreads: tuple[float, float]
    ) -> _Candidate:
        """Return the candidate of the width of a backlash and of the spreads of the weights."""
        problem = HysteresisProblem(log, width, creep=spreads[1] > 0.0)
        fit = problem.fitted(*spreads)
        return cls(width, problem.operator(fit), log.by_group(fit.distances))

    def error(self) -> float:
        """Return the mean error [m]."""
        return float(self.errors.mean())


def _with_friction(log: HysteresisLog, backlash: _Candidate) -> list[_Candidate]:
    """Return candidates with friction other than one backlash, from few to many free weights."""
    width = backlash.width
    with_creep = _Candidate.of(log, width, _CREEP)
    if _gain(backlash.errors, with_creep.errors).clear:
        with_creep = _with_width_again(log, with_creep)
    smooth = [_Candidate.of(log, width, spreads) for spreads in _SMOOTH]
    smooth_creep = [_Candidate.of(log, width, both) for both in _SMOOTH_AND_CREEP]
    return [with_creep, *smooth, *smooth_creep]


def _with_width_again(log: HysteresisLog, candidate: _Candidate) -> _Candidate:
    """Return backlash and creep with the width of least error, for a width without creep."""
    tried = [candidate]

    def error(width: float) -> float:
        tried.append(_Candidate.of(log, width, _CREEP))
        return tried[-1].error()

    width = candidate.width
    options = {"xatol": _CLOSE * width}
    minimize_scalar(
        error, bounds=(0.25 * width, 1.5 * width), method="bounded", options=options
    )
    return min(tried, key=_Candidate.error)


class _Gain(NamedTuple):
    """Mean reduction of the errors of groups [m], and its standard error."""

    mean: float
    std_error: float
    clear: bool  # above the standard error, and above 1 % of the error
    certain: bool  # and above twice the standard error


def _gain(before: NDArray, after: NDArray) -> _Gain:
    """Return the gain of errors of groups (G,) over those before."""
    gains = before - after
    mean = float(gains.mean())
    std_error = float(gains.std(ddof=1) / np.sqrt(len(gains)))
    clear = mean > max(std_error, _LEAST_GAIN * float(before.mean()))
    return _Gain(mean, std_error, clear, clear and mean > _CERTAIN * std_error)
