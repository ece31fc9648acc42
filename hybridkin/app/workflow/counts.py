"""Commands of motors that take whole counts: the steps in which a log moves its actuators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

_MOST = 2.0**53  # larger floats are whole numbers all
_WHOLE = 1e-6  # largest distance of a whole number from the next integer
_INSIDE = 1e-9  # limits are met to this share of a step


@dataclass(frozen=True)
class Counts:
    """Whole numbers that the columns of a log can hold, in the unit of the log; `Counts()`: any.

    Attributes
    ----------
    steps : sequence of float
        Distance between two numbers of each column (n,); 0: any number.
    zeros : sequence of float
        One of these numbers (n,).
    """

    steps: Sequence[float] = ()
    zeros: Sequence[float] = ()

    def __bool__(self) -> bool:
        """Return whether a column has steps."""
        return any(self.steps)

    @classmethod
    def of_log(cls, columns: NDArray) -> Self:
        """Return the steps of columns (N, n): the largest on which all their numbers lie.

        A column that has other than whole numbers, or does not move, has no steps.
        """
        nearest = np.rint(columns)
        counted = (np.abs(columns - nearest) <= _WHOLE) & (np.abs(columns) < _MOST)
        whole = counted.all(axis=0)
        from_first = np.where(whole, nearest - nearest[0], 0.0).astype(np.int64)
        steps = np.where(whole, np.gcd.reduce(from_first, axis=0), 0)
        zeros = np.where(steps > 0, nearest[0] % np.maximum(steps, 1), 0.0)
        return cls(steps.astype(float).tolist(), zeros.tolist())

    @classmethod
    def read(cls, notes: Mapping[str, Any]) -> Self:
        """Return the steps in the notes of a fit, none if they are not known."""
        return cls(**(notes.get("counts") or {}))

    @property
    def whole(self) -> NDArray[np.bool_]:
        """Which columns hold whole numbers alone (n,)."""
        steps = np.array(self.steps)
        return (steps > 0.0) & (steps % 1.0 == 0.0) & (np.mod(self.zeros, 1.0) == 0.0)

    def rounded(self, columns: NDArray, low: NDArray, high: NDArray) -> NDArray:
        """Return the nearest of these numbers to columns (N, n), within limits (n,)."""
        moves = np.array(self.steps) > 0.0
        step = np.where(moves, self.steps, 1.0)
        least = np.ceil((low - self.zeros) / step - _INSIDE)
        most = np.floor((high - self.zeros) / step + _INSIDE)
        numbers = np.rint((columns - self.zeros) / step).clip(least, most)
        return np.where(moves, self.zeros + step * numbers, columns)
