"""The log by which hysteresis is found: rows that count, and rows that only move the actuators."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.groups import Groups
from hybridkin._core.model import ForwardModel
from hybridkin._core.runs import RunOrder
from hybridkin.hysteresis.reversals import behind, reversals

_MOST_COUNTED = 10_000  # rows whose errors are computed
_MOST_FOLLOWED = 20_000  # rows that the stages follow, if few enough reverse
_FINEST = 6e-4  # reversals that are always followed, relative to the range of an actuator
_COARSEST = 1e-2  # smaller ones can be left out of long logs
_RATIO = 4.0  # largest ratio of two time constants, if they are enough
_FEWEST_TIMES = 4
_MOST_TIMES = 6
_WAY = 4.0  # largest way between two followed rows, relative to those reversals


@dataclass(frozen=True)
class HysteresisLog:
    """Commands in order of time, and the measured tips by which their hysteresis is found.

    Attributes
    ----------
    model : ForwardModel
        The mechanical model, calibrated without hysteresis.
    q : ndarray of shape (N, n)
        Commands, the rows of each run in order of time [unit of q].
    x : ndarray of shape (N, m)
        Measured tips, NaN where a marker is missing [m].
    counts : ndarray of shape (N,)
        How many times each row counts.
    groups : ndarray of shape (N,)
        Which rows are held out together.
    runs : ndarray of shape (N,)
        Which rows follow each other in time.
    time : ndarray of shape (N,)
        Times, ascending in each run [s].
    spans : ndarray of shape (N,) or ()
        Number of rows of the recorded log from the row before to each row, along a straight line.
    """

    model: ForwardModel
    q: NDArray
    x: NDArray
    counts: NDArray
    groups: NDArray
    runs: NDArray
    time: NDArray
    spans: NDArray = field(default_factory=lambda: np.ones(()))

    @cached_property
    def rows(self) -> NDArray:
        """The rows whose errors count."""
        return np.flatnonzero(which_count(self.x, self.counts))

    @cached_property
    def folds(self) -> list[tuple[NDArray, NDArray]]:
        """Training and held-out rows, as places in `rows`."""
        return Groups(self.groups[self.rows]).folds()

    @cached_property
    def order(self) -> RunOrder:
        """The order in which runs come one after the other."""
        return RunOrder.of(self.runs)

    @cached_property
    def ranges(self) -> NDArray:
        """Range of every actuator (n,), one for an actuator that never moves [unit of q]."""
        ranges = np.ptp(self.q, axis=0)
        return np.where(ranges > 0.0, ranges, 1.0)

    @cached_property
    def times(self) -> NDArray:
        """Time constants to try [s], up to the median length of a run.

        They are four, from the median step on; of a log of short steps up to six, each at most four
        times the next, and the shortest of them is longer than a step.
        """
        in_order = self.time[self.order.order]
        steps = self.order.steps(self.time) / self.recorded
        positive = steps[steps > 0.0]
        if not len(positive):
            return np.empty(0)
        lengths = in_order[self.order.ends] - in_order[self.order.starts]
        least = np.median(np.repeat(positive, self.recorded[steps > 0.0].astype(int)))
        longest = max(np.median(lengths), 2.0 * least)
        steps_of_four = np.log(longest / least) / np.log(_RATIO)
        n_times = int(np.clip(1 + np.ceil(steps_of_four), _FEWEST_TIMES, _MOST_TIMES))
        least = max(least, longest / _RATIO ** (n_times - 1))
        return np.geomspace(least, longest, n_times)

    @property
    def recorded(self) -> NDArray:
        """The `spans` of the rows (N,), in the order of runs."""
        return np.broadcast_to(self.spans, len(self.q))[self.order.order]

    def by_group(self, distances: NDArray) -> NDArray:
        """Return the mean distance of every group, of the distances of `rows`."""
        _, group = np.unique(self.groups[self.rows], return_inverse=True)
        counts = self.counts[self.rows]
        return np.bincount(group, counts * distances) / np.bincount(group, counts)

    def thinned(self) -> HysteresisLog:
        """Return the same with fewer rows, if there are many; their actuators move alike.

        At most 10 000 rows count. Of the others those remain at which an actuator reverses, and
        some in between: reversals of less than 1 % of the range, and 0.06 % if there are few
        enough, can be left out. A `spans` beyond one says how many rows were left out before.
        """
        log = self
        if len(self.rows) > _MOST_COUNTED:
            counts = np.zeros(len(self.q))
            motions = RunOrder.of(self.groups[self.rows])
            chosen = self.rows[motions.spread_rows(_MOST_COUNTED)]
            counts[chosen] = self.counts[chosen]
            log = replace(self, counts=counts)
        needed = self.order.up_to(log.rows)
        if len(needed) < len(self.q):
            log = log._take(needed)
        size = _FINEST
        while len(log.q) > _MOST_FOLLOWED and size < _COARSEST:
            log = log._take(log._followed(size))
            size *= 2.0
        return log

    def _followed(self, size: float) -> NDArray:
        """Return the rows that count, and those that show reversals of a relative size."""
        order = self.order
        moved = behind(self.q[order.order], order, size * self.ranges)
        kept = order.first | reversals(moved, order).any(axis=1)
        way = np.abs(np.diff(moved / self.ranges, axis=0, prepend=0.0)).max(axis=1)
        way[order.first] = 0.0
        parts = np.floor(np.cumsum(way) / (_WAY * size))
        kept |= np.diff(parts, prepend=0.0) > 0.0
        needed = np.zeros(len(self.q), dtype=bool)
        needed[order.order] = kept
        needed[self.rows] = True
        return np.flatnonzero(needed)

    def _take(self, rows: NDArray) -> HysteresisLog:
        """Return some of the rows, in order; the steps between them span those left out."""
        place = np.empty(len(self.q))
        place[self.order.order] = np.cumsum(self.recorded)
        chosen = replace(
            self,
            q=self.q[rows],
            x=self.x[rows],
            counts=self.counts[rows],
            groups=self.groups[rows],
            runs=self.runs[rows],
            time=self.time[rows],
        )
        in_order = chosen.order.order
        spans = np.ones(len(rows))
        steps = np.diff(place[rows][in_order], prepend=0.0)
        spans[in_order] = np.where(chosen.order.first, 1.0, steps)
        return replace(chosen, spans=spans)


def which_count(x: NDArray, counts: NDArray) -> NDArray:
    """Return which rows (N,) count: not zero times, and with a marker that was measured.

    Parameters
    ----------
    x, counts : ndarray of shapes (N, m) and (N,)
        As in `HysteresisLog`.
    """
    return (counts > 0.0) & ~np.isnan(x).all(axis=1)
