"""Where actuators reverse: all that hysteresis without creep depends on."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.runs import BEGINS, RunOrder
from hybridkin.hysteresis.follow import followed
from hybridkin.hysteresis.stages.backlash import Backlash

_SEEN = 0.02  # smallest way back that is no jitter, relative to the range of an actuator
_MOST_REVERSALS = 1.0 / 3.0  # of the rows; postures at random have two thirds


def behind(q: NDArray, order: RunOrder, sizes: NDArray) -> NDArray:
    """Return commands without the ways back that are smaller than some sizes (N, n).

    They are what a backlash of that width does, which no hysteresis that follows them
    misses by more.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Commands, in that order, run after run [unit of q].
    order : RunOrder
        Where runs begin.
    sizes : ndarray of shape (n,)
        Smallest way back that counts, zero or more [unit of q].
    """
    steps = np.where(order.first, BEGINS, 0.0)
    return followed([Backlash(sizes)], q, steps)


def reversals(q: NDArray, order: RunOrder) -> NDArray[np.bool_]:
    """Return the rows after which actuators go back (N, n), without those that rest in between.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Commands, in that order, or what is `behind` them: then the rows at which the commands
        reverse by more [unit of q].
    order : RunOrder
        Where runs begin.
    """
    run = np.cumsum(order.first)
    turns = np.zeros(q.shape, dtype=bool)
    for actuator, column in enumerate(q.T):
        change = np.diff(column, prepend=0.0)
        moving = np.flatnonzero((change != 0.0) & ~order.first)
        up = change[moving] > 0.0
        run_of_moving = run[moving]
        turned = (up[1:] != up[:-1]) & (run_of_moving[1:] == run_of_moving[:-1])
        turns[moving[:-1][turned], actuator] = True
    return turns


class Coarseness(NamedTuple):
    """How coarsely the rows of a log show the reversals of actuators.

    Attributes
    ----------
    reversing : ndarray of shape (n,)
        Share of the rows within runs at which an actuator reverses, by more than 2 % of its range.
    missed : ndarray of shape (n,)
        Median way beyond these rows, if actuators move smoothly: an eighth of the change of their
        step there [unit of q].
    """

    reversing: NDArray
    missed: NDArray

    @classmethod
    def of(cls, q: NDArray, runs: NDArray) -> Coarseness:
        """Return that of commands (N, n) with the runs (N,) of the rows."""
        order = RunOrder.of(runs)
        rows = q[order.order].astype(np.float64)
        turns = reversals(behind(rows, order, _SEEN * np.ptp(rows, axis=0)), order)
        within = ~order.first
        within[:-1] &= ~order.first[1:]
        within[-1:] = False
        turns &= within[:, None]
        bend = np.zeros_like(rows)
        bend[1:-1] = np.abs(np.diff(rows, 2, axis=0)) / 8.0
        missed = np.zeros(rows.shape[1])
        for actuator, turned in enumerate(turns.T):
            if turned.any():
                missed[actuator] = np.median(bend[turned, actuator])
        return cls(turns.sum(axis=0) / max(1, within.sum()), missed)

    @property
    def shows_reversals(self) -> bool:
        """Whether at most a third of the rows are reversals of any one actuator."""
        return bool((self.reversing <= _MOST_REVERSALS).all())
