"""The ranges in the rows of a fit: of the actuators, and of the states of hysteresis."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.hybrid._rows import Rows

_MARGIN = 0.1  # of states beyond those of the log, relative to the range of a command
_TESTED = 0.98  # share of the rows of the log that are in the range, held out


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

    def moved(self, way: NDArray) -> Self:
        """Return the range after a change of all actuator vectors by `way` (n,)."""
        return type(self)(self.low + way, self.high + way)

    def beyond(self, q: NDArray) -> NDArray:
        """Return how far rows (N, ...) are outside, zero inside, for each entry."""
        return np.maximum(np.maximum(self.low - q, q - self.high), 0.0)


def state_range(states: NDArray, log: Rows) -> TrainingRange:
    """Return the range of states of hysteresis (N, R, n) in which a log has tested a model.

    It is that of the measured rows with a margin: a tenth of the range of the commands, or as far
    as 98 % of the rows are from the states of other groups.
    """
    measured = log.counts > 0.0
    size = np.ptp(log.X, axis=0)
    size = np.where(size > 0.0, size, 1.0)
    margin = _MARGIN
    names = log.run_of_rows if log.groups is None else log.groups
    distances = []
    for name in np.unique(names):
        group = names == name
        other_rows = states[measured & ~group]
        if len(other_rows) and states.size:
            beyond = TrainingRange.of(other_rows).beyond(states[measured & group])
            distances.append((beyond / size).max(axis=(1, 2)))
    if distances:
        margin = max(margin, np.quantile(np.concatenate(distances), _TESTED))
    low, high = TrainingRange.of(states[measured])
    return TrainingRange(low - margin * size, high + margin * size)
