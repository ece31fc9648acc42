"""Rows run after run: which rows follow each other, and the time between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # its multiples, modulo 1, are evenly spread
_ROWS_OF_RUN = 10  # of some rows, if there are runs enough
BEGINS = -1.0  # step in time of the first row of a run, for the kernels of hysteresis


def numbered(names: NDArray) -> NDArray[np.intp]:
    """Return names (N,) as whole numbers from 0, in their alphabetic or numeric order."""
    differs = np.ones(len(names), dtype=bool)
    differs[1:] = names[1:] != names[:-1]
    firsts = np.flatnonzero(differs)  # of rows with the same name; far fewer than rows
    _, numbers = np.unique(names[firsts], return_inverse=True)
    return np.repeat(numbers, np.diff(firsts, append=len(names)))


class RunOrder(NamedTuple):
    """The order of rows in which runs come one after the other.

    Attributes
    ----------
    order : ndarray of int of shape (N,)
        The rows, run after run; those of a run as they are.
    first : ndarray of bool of shape (N,)
        Whether a row, in that order, begins a run.
    """

    order: NDArray[np.intp]
    first: NDArray[np.bool_]

    @classmethod
    def of(cls, names: NDArray) -> RunOrder:
        """Return the order of rows whose runs have names (N,)."""
        numbers = numbered(names)
        order = np.argsort(numbers, kind="stable")
        first = np.ones(len(names), dtype=bool)
        first[1:] = numbers[order][1:] != numbers[order][:-1]
        return cls(order, first)

    @property
    def starts(self) -> NDArray[np.intp]:
        """Places in the order at which runs begin (K,)."""
        return np.flatnonzero(self.first)

    @property
    def ends(self) -> NDArray[np.intp]:
        """Places in the order of the last rows of runs (K,)."""
        return np.append(self.starts[1:], len(self.order)) - 1

    def steps(self, time: NDArray) -> NDArray:
        """Return the time since the row before (N,), in the order; `BEGINS` where a run begins."""
        in_order = time[self.order]
        return np.where(self.first, BEGINS, np.diff(in_order, prepend=0.0))

    def late(self, time: NDArray) -> NDArray[np.intp]:
        """Return the rows that are earlier than the row before of their run."""
        in_order = time[self.order]
        earlier = np.diff(in_order, prepend=-np.inf) < 0.0
        return self.order[earlier & ~self.first]

    def up_to(self, rows: NDArray) -> NDArray[np.intp]:
        """Return the rows that move the actuators of some rows (K,): those before in their runs."""
        counts = np.zeros(len(self.order), dtype=int)
        counts[rows] = 1
        in_order = counts[self.order]
        run = np.cumsum(self.first) - 1
        until = np.cumsum(in_order)  # rows that count, up to each row
        before = (until - in_order)[self.starts]
        of_run = np.bincount(run, in_order)
        still_to_come = before[run] + of_run[run] - (until - in_order)
        return np.sort(self.order[still_to_come > 0])

    def spread_rows(self, most: int) -> NDArray[np.intp]:
        """Return at most `most` rows, ascending: of some of the runs, some rows of each.

        All runs are used if each can have ten rows, or all of fewer, else a part of them, spread
        over all. Each has rows in proportion to its length.
        """
        n_rows = len(self.order)
        if n_rows <= most:
            return np.arange(n_rows)
        starts = self.starts
        lengths = np.diff(starts, append=n_rows)
        by_time = np.argsort(self.order[starts], kind="stable")
        needed = np.minimum(lengths, _ROWS_OF_RUN).mean()
        chosen = by_time[spread(len(starts), max(1, int(most / needed)))]
        part = (most - len(chosen)) / lengths[chosen].sum()
        rows = []
        for run in chosen.tolist():
            length = int(lengths[run])
            places = spread(length, max(1, min(length, int(part * length))), len(rows))
            rows.append(self.order[starts[run] + places])
        return np.sort(np.concatenate(rows))


def spread(n: int, most: int, first: int = 0) -> NDArray[np.intp]:
    """Return the places of at most `most` of n rows, one in each of equal parts.

    Steps between them differ, so that they do not repeat with a periodic motion. Other numbers
    `first` give other places.
    """
    parts = np.arange(min(most, n) + 1) * n // max(1, min(most, n))
    within = (first + np.arange(1, len(parts))) * _GOLDEN % 1.0
    return parts[:-1] + (within * np.diff(parts)).astype(np.intp)
