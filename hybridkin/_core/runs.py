"""Rows run after run: which rows follow each other, and the time between them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

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
