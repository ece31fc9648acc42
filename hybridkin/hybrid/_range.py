"""The ranges in the rows of a fit: of the actuators, and of the states of hysteresis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.runs import RunOrder
from hybridkin.hybrid._rows import Rows

_MARGIN = 0.1  # of states beyond those of the log, relative to the range of a command
TESTED = 0.98  # share of the rows of the log that are in the range, held out


class TrainingRange(NamedTuple):
    """The least and the largest actuator vector, or states (R, n), of a fit [unit of q].

    Attributes
    ----------
    low, high : ndarray of shape (n,) or (R, n)
        Equal for an actuator that never moved.
    """

    low: NDArray
    high: NDArray

    @classmethod
    def of(cls, q: NDArray) -> Self:
        """Return the range of rows q (N, n)."""
        return cls(q.min(axis=0).astype(float), q.max(axis=0).astype(float))

    def shifted(self, way: NDArray) -> Self:
        """Return the range after a change of all actuator vectors by `way` (n,)."""
        return type(self)(self.low + way, self.high + way)

    def beyond(self, q: NDArray) -> NDArray:
        """Return how far rows (N, ...) are outside, zero inside, for each entry."""
        return np.maximum(np.maximum(self.low - q, q - self.high), 0.0)


def state_range(states: NDArray, measured: Rows, size: NDArray) -> TrainingRange:
    """Return the range of states of hysteresis in which a log has tested a model.

    It is that of the measured rows with a margin: a tenth of the range of the commands, or as far
    as 98 % of the rows are from the states of other groups.

    Parameters
    ----------
    states : ndarray of shape (K, R, n)
        What is inside of the hysteresis after each row that counts [unit of q].
    measured : Rows
        These rows.
    size : ndarray of shape (n,)
        Range of the commands [unit of q].
    """
    size = np.where(size > 0.0, size, 1.0)
    margin = _MARGIN
    others = ranges_of_others(states, measured.groups_or_runs)
    if states.size and others.low.size:
        beyond = (others.beyond(states) / size).max(axis=(1, 2))
        margin = max(margin, np.quantile(beyond, TESTED))
    low, high = TrainingRange.of(states)
    return TrainingRange(low - margin * size, high + margin * size)


def ranges_of_others(states: NDArray, names: NDArray) -> TrainingRange:
    """Return for each row (K, ...) the range of the rows of other groups; empty for one group.

    Parameters
    ----------
    states : ndarray of shape (K, ...)
        States, or other numbers, of the rows.
    names : ndarray of shape (K,)
        Group of every row.
    """
    groups = RunOrder.of(names)
    if len(groups.starts) < 2:
        return TrainingRange(states[:0], states[:0])
    group = np.empty(len(states), dtype=int)
    group[groups.order] = np.cumsum(groups.first) - 1
    in_order = states[groups.order]
    low = np.minimum.reduceat(in_order, groups.starts)
    high = np.maximum.reduceat(in_order, groups.starts)
    return TrainingRange(_least_of_others(low)[group], -_least_of_others(-high)[group])


def _least_of_others(values: NDArray) -> NDArray:
    """Return for each of G groups the least value (G, ...) of the others."""
    two = np.partition(values, 1, axis=0)[:2]
    return np.where(values == two[0], two[1], two[0])
