"""A quick test that rows need no warning about their units."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.arrays import LARGEST

_BLOCK = 2048  # rows, whose temporary arrays stay in the cache
_FLOAT64 = np.dtype(np.float64)


@dataclass(frozen=True, eq=False)
class PlausibleRows:
    """Linear bounds of rows that no check of a chain warns about: ``|W (q - rest)| <= 1``.

    Rows outside may still be right. The chain itself then checks them, which takes longer.

    Attributes
    ----------
    rest : ndarray of shape (n,)
        The q at which no actuator is displaced.
    weights : ndarray of shape (K, n)
        The matrix W.
    """

    rest: NDArray
    weights: NDArray

    @classmethod
    def all_of(cls, n: int) -> Self:
        """Return bounds that hold all rows of n numbers that count as finite."""
        return cls(np.zeros(n), np.eye(n) / LARGEST)

    def hold(self, q: NDArray) -> bool:
        """Return whether all rows of q (N, n) lie within the bounds."""
        for first in range(0, len(q), _BLOCK):
            block = q[first : first + _BLOCK]
            with np.errstate(all="ignore"):  # numbers too large for float64 are outside
                largest = np.abs((block - self.rest) @ self.weights.T).max(initial=0.0)
            if not largest <= 1.0:
                return False
        return True

    def hold_row(self, q: object) -> TypeGuard[NDArray]:
        """Return whether q is an array of one row (1, n) of small numbers, within the bounds."""
        return (
            type(q) is np.ndarray
            and q.dtype == _FLOAT64
            and q.shape == self._shape
            and q.flags.c_contiguous
            and math.hypot(*q.tolist()[0]) <= self.small
        )

    @cached_property
    def _shape(self) -> tuple[int, int]:
        return 1, len(self.rest)

    @cached_property
    def small(self) -> float:
        """A length of q up to which any row lies within the bounds."""
        lengths = np.linalg.norm(self.weights, axis=1)
        largest = float(lengths.max(initial=np.finfo(float).tiny))
        return 1.0 / largest - math.hypot(*self.rest.tolist())


class UnknownRows(PlausibleRows):
    """No bounds: they are not known, so the model itself checks all rows."""

    @classmethod
    def of(cls, n: int) -> Self:
        """Return the bounds of rows of n actuators."""
        return cls(np.zeros(n), np.zeros((0, n)))

    def hold(self, q: NDArray) -> bool:
        """Return False: the model has to look."""
        return False

    def hold_row(self, q: object) -> TypeGuard[NDArray]:
        """Return False: the model has to look."""
        return False

    @cached_property
    def small(self) -> float:
        """Infinite: no length of q is known to be too large."""
        return math.inf
