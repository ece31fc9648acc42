"""The range of the actuators in the rows of a fit."""

from __future__ import annotations

from typing import NamedTuple

from numpy.typing import NDArray
from typing_extensions import Self


class TrainingRange(NamedTuple):
    """The least and the largest actuator vector of a fit [unit of q].

    Attributes
    ----------
    low, high : ndarray of shape (n,)
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
