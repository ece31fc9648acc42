"""A motion of actuators in order of time: what they did, when, and in which run."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin import Hysteresis


@dataclass(frozen=True, eq=False)
class Motion:
    """What the actuators did, in order of time.

    Attributes
    ----------
    q : ndarray of shape (T, n)
        Motion of the actuators [unit of q].
    time : ndarray of shape (T,)
        Times, increasing in every run [s]; without a clock the numbers of the rows.
    runs : ndarray of shape (T,) of int
        Run of every row; the rows of a run follow each other.
    clock : str
        Unit of the times: "s" or "rows".
    """

    q: NDArray
    time: NDArray
    runs: NDArray
    clock: str

    @classmethod
    def of(cls, q: NDArray, time: NDArray | None, runs: NDArray | None) -> Self:
        """Return the motion of rows q (T, n); times that do not increase are not used."""
        n_rows = len(q)
        changes = np.zeros(n_rows, dtype=bool)
        if runs is not None:
            changes[1:] = runs[1:] != runs[:-1]
        run_of_rows = np.cumsum(changes)
        numbers = np.arange(n_rows, dtype=float)
        if time is None:
            return cls(q, numbers, run_of_rows, "rows")
        steps = np.diff(time)[~changes[1:]]
        if not np.isfinite(time).all() or (steps <= 0.0).any():
            return cls(q, numbers, run_of_rows, "rows")
        return cls(q, np.asarray(time, dtype=float), run_of_rows, "s")

    @cached_property
    def period(self) -> float:
        """The usual time between two rows of a run."""
        same_run = self.runs[1:] == self.runs[:-1]
        steps = np.diff(self.time)[same_run]
        return float(np.median(steps)) if len(steps) else 1.0

    @cached_property
    def duration(self) -> float:
        """The time of the longest run, at least one period."""
        longest = self.period
        for rows in self._rows_of_runs:
            times = self.time[rows]
            longest = max(longest, float(times[-1] - times[0]))
        return longest

    @cached_property
    def span(self) -> NDArray:
        """The range of every actuator (n,)."""
        return np.ptp(self.q, axis=0)

    @cached_property
    def _rows_of_runs(self) -> list[slice]:
        """The rows of every run."""
        starts = np.flatnonzero(np.diff(self.runs, prepend=self.runs[0] - 1))
        ends = np.append(starts[1:], len(self.runs))
        return [slice(*ends_of_run) for ends_of_run in zip(starts, ends, strict=True)]

    @cached_property
    def _bounds(self) -> tuple[NDArray, NDArray]:
        """The first and the last time (T,) of the run of every row."""
        first = np.empty(len(self.time))
        last = np.empty(len(self.time))
        for rows in self._rows_of_runs:
            first[rows] = self.time[rows][0]
            last[rows] = self.time[rows][-1]
        return first, last

    def earlier(self, values: NDArray, rows: NDArray, delay: float) -> NDArray:
        """Return values (T, k) of the motion, `delay` before each of some rows, (N, k).

        Between two rows they are linear, outside a run constant; a negative delay is later.
        """
        first, last = self._bounds
        passed = np.clip(self.time[rows] - delay, first[rows], last[rows])
        # One axis of time for all runs: each begins after the end of the one before.
        length = np.array([last[r][0] - first[r][0] for r in self._rows_of_runs])
        begin = np.append(0.0, np.cumsum(length + self.period))[self.runs - self.runs[0]]
        places = begin + self.time - first
        passed = begin[rows] + passed - first[rows]
        columns = [np.interp(passed, places, column) for column in values.T]
        return np.stack(columns, axis=1)

    def after(self, hysteresis: Hysteresis) -> NDArray:
        """Return the motion (T, n) behind a hysteresis in which every run begins at rest."""
        effective = np.empty_like(self.q)
        for rows in self._rows_of_runs:
            times = self.time[rows]
            steps = np.diff(times, prepend=times[0])
            effective[rows], _ = hysteresis.apply(self.q[rows], dt=steps)
        return effective
