"""How late the readings of a camera are, from a recorded motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from hybridkin.arguments import real_array

_MOST = 0.25  # of the duration: else the ends of the motion decide
_PERIODS = 63  # at most, as in a control loop
_CLEAR = 0.8  # of the error without delay, if the delay explains it
_LEAST = 0.5  # of a period


class Delay(NamedTuple):
    """The most likely delay of readings.

    Attributes
    ----------
    seconds : float
        The delay [s].
    error, without : float
        Root mean square distances between readings and model, with this delay and without one [m].
        A constant offset does not count.
    is_clear : bool
        Whether it is at least half a period, and the error is at most 0.8 times that without.
    """

    seconds: float
    error: float
    without: float
    is_clear: bool


def estimated_delay(t: ArrayLike, x: ArrayLike, x_measured: ArrayLike) -> Delay:
    """Return the delay with which readings agree best with the tips of a model.

    Backlash and hysteresis of the actuators that the model does not know look like a delay.

    Parameters
    ----------
    t : array-like of shape (N,)
        Times [s], increasing.
    x : array-like of shape (N, 3)
        Tips of the model for the commands at these times [m].
    x_measured : array-like of shape (N, 3)
        Tips that were read at these times [m]; rows of NaN are not used.

    Returns
    -------
    Delay
        The delay, in fractions of a period too, at most 63 periods and a quarter of the duration.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin.app import workflow
    >>> t = 0.01 * np.arange(300)
    >>> def tip(t):
    ...     return np.stack([np.sin(3 * t), np.cos(2 * t), t], axis=1)
    >>> round(workflow.estimated_delay(t, tip(t), tip(t - 0.034)).seconds, 4)
    0.034
    """
    times = real_array(t, "t").astype(float)
    tips = real_array(x, "x").astype(float)
    readings = real_array(x_measured, "x_measured").astype(float)
    n = len(times)
    good = tips.shape == readings.shape == (n, 3) and n > 3
    if not (good and np.isfinite(times).all() and (np.diff(times) > 0.0).all()):
        raise ValueError(
            "`t` must be at least 4 increasing times [s], `x` and `x_measured` tips (N, 3) then, "
            f"got the shapes {times.shape}, {tips.shape} and {readings.shape}."
        )
    known = np.isfinite(readings).all(axis=1) & np.isfinite(tips).all(axis=1)
    if known.sum() < 4:
        raise ValueError(f"`x_measured` must hold at least 4 tips, got {known.sum()}.")
    period = float(np.median(np.diff(times)))
    most = min(_PERIODS * period, _MOST * float(times[-1] - times[0]))
    # Every delay is judged by the same rows.
    used = known & (times - times[0] >= most)

    def error(seconds: float) -> float:
        residual = readings[used] - at_times(times - seconds, times, tips)[used]
        residual = residual - residual.mean(axis=0)
        return float(np.sqrt(np.square(residual).sum(axis=1).mean()))

    grid = np.arange(0.0, most + 0.5 * period, period)
    best = grid[np.argmin([error(seconds) for seconds in grid])]
    around = (max(best - period, 0.0), min(best + period, most))
    found = minimize_scalar(
        error, bounds=around, method="bounded", options={"xatol": 1e-4 * period}
    )
    least = float(found.fun)  # pyright: ignore[reportAttributeAccessIssue]
    seconds = float(found.x)  # pyright: ignore[reportAttributeAccessIssue]
    without = error(0.0)
    if without <= least:
        return Delay(0.0, without, without, False)
    is_clear = seconds >= _LEAST * period and least <= _CLEAR * without
    return Delay(seconds, least, without, is_clear)


def at_times(times: NDArray, t: NDArray, rows: NDArray) -> NDArray:
    """Return rows (N, k) of times t (N,) at other times, linear between two, constant outside."""
    columns = [np.interp(times, t, column) for column in rows.T]
    return np.stack(columns, axis=1)
