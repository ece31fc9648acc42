"""The pace of commands: how fast the log moved, over the time constants of creep."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.runs import RunOrder
from hybridkin.hybrid._range import TESTED, ranges_of_others
from hybridkin.hybrid._rows import Rows
from hybridkin.hysteresis.follow import followed
from hybridkin.hysteresis.stages.creep import Creep

_TOLERANCE = 1.1  # least factor by which a pace may be beyond those of the log
_TINY = 1e-9  # pace that counts as rest, relative to the largest
_SHOWN = 0.39  # part of a time constant; before, a run does not show the pace over it


class PaceRange(NamedTuple):
    """The paces at which a log has tested a model with creep.

    A pace is the mean speed of an actuator, in which the past fades with a time constant of creep.

    Attributes
    ----------
    low : ndarray of shape (J,)
        The least pace of the fastest actuator for each time constant, relative to `high` [1].
    high : ndarray of shape (J, n)
        The largest pace of each actuator [unit of q / s].
    """

    low: NDArray
    high: NDArray

    def holds(self, paces: Iterator[Pace], n_rows: int) -> NDArray[np.bool_]:
        """Return which rows (N,) are in the range, of their paces by time constant.

        Where a run does not show the pace over a time constant yet, its mean speed so far is
        compared with the largest pace over the last time constant that it shows.
        """
        inside = np.ones(n_rows, dtype=bool)
        bound = self.high[:1]
        for low, high, pace in zip(self.low, self.high, paces, strict=True):
            bound = np.where(pace.shown[:, None], high, bound)
            relative = _relative(pace.speeds, bound)
            inside &= (relative <= 1.0) & (~pace.shown | (relative >= low))
        return inside


class Pace(NamedTuple):
    """The pace of the commands over one time constant.

    Attributes
    ----------
    speeds : ndarray of shape (N, n)
        Mean speed of each actuator, in which the past fades; of the first row of a run zero [unit
        of q / s].
    shown : ndarray of shape (N,)
        Whether the run shows it: it has gone on for half of the time constant.
    """

    speeds: NDArray
    shown: NDArray[np.bool_]


def each_pace(q: NDArray, runs: NDArray, time: NDArray, time_constants: NDArray) -> Iterator[Pace]:
    """Yield the pace of commands for each time constant.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Commands [unit of q].
    runs, time : ndarray of shape (N,)
        Run and time of every row [s].
    time_constants : ndarray of shape (J,)
        Time constants of creep [s].
    """
    order = RunOrder.of(runs)
    rows = q[order.order].astype(np.float64)
    steps = order.steps(time)
    moved = np.abs(np.diff(rows, axis=0, prepend=rows[:1]))
    new = np.column_stack([steps, moved])
    new[order.first] = 0.0
    before = np.zeros_like(new)  # what fades in each step
    before[1:] = new[:-1]
    before[order.first] = 0.0
    sums = np.cumsum(before, axis=0)
    for time_constant in time_constants:
        creep = Creep([0.5], [time_constant])
        recent = new + 2.0 * (sums - followed([creep], sums, steps))
        duration = recent[:, :1]
        speeds = np.empty_like(rows)
        speeds[order.order] = recent[:, 1:] / np.where(duration > 0.0, duration, 1.0)
        shown = np.empty(len(rows), dtype=bool)
        shown[order.order] = (duration[:, 0] >= _SHOWN * time_constant) & ~order.first
        yield Pace(speeds, shown)


def pace_range(paces: list[Pace], measured: Rows) -> PaceRange:
    """Return the range of paces of the rows that count.

    It is wider by a tenth, or as far as 98 % of the rows are from the paces of other groups.

    Parameters
    ----------
    paces : list of Pace
        Paces of these rows by time constant.
    measured : Rows
        The rows.
    """
    names = measured.groups_or_runs
    shown = np.stack([pace.shown for pace in paces], axis=1)
    speeds = np.stack([pace.speeds for pace in paces], axis=1)
    fastest = np.where(shown[:, :, None], speeds, 0.0)
    high = fastest.max(axis=0)
    faster = _TOLERANCE
    others = ranges_of_others(fastest, names)
    if others.high.size:
        beyond = _relative(fastest, others.high).max(axis=1, initial=0.0)
        faster = max(faster, np.quantile(beyond, TESTED))
    relative = np.where(shown, _relative(fastest, high), np.inf)
    low = relative.min(axis=0)
    slower = _TOLERANCE
    others = ranges_of_others(relative, names)
    if others.low.size:
        tested = shown & np.isfinite(others.low)
        least = np.where(tested, np.maximum(relative, _TINY), 1.0)
        ratio = np.where(tested, others.low, 1.0) / least
        slower = max(slower, np.quantile(ratio.max(axis=1, initial=1.0), TESTED))
    low = np.where(np.isfinite(low), low, 0.0)
    return PaceRange(low / (slower * faster), faster * high)


def _relative(pace: NDArray, high: NDArray) -> NDArray:
    """Return the largest ratio (...) of paces (..., n) to others; none to zero."""
    return np.where(high > 0.0, pace / np.where(high > 0.0, high, 1.0), 0.0).max(axis=-1)
