"""What a calibration can change of a chain: parts of its geometry, and their natural scales."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self


class Part(NamedTuple):
    """A parameter of `calibrate`: an entry of the geometry, or some directions of it.

    Attributes
    ----------
    entry : str
        The entry of ``chain.geometry()`` that it changes.
    directions : ndarray of shape (size of the entry, k)
        How the numbers of the entry follow those of the parameter.
    shown : ndarray of shape (k,)
        Places in the flat entry of the numbers that a user sees.
    shape : tuple of int
        Shape of the parameter.
    """

    entry: str
    directions: NDArray
    shown: NDArray
    shape: tuple[int, ...]

    @classmethod
    def whole(cls, entry: str, shape: tuple[int, ...]) -> Self:
        """Return the parameter that is the whole entry of this shape."""
        size = math.prod(shape)
        return cls(entry, np.eye(size), np.arange(size), shape)

    @classmethod
    def unit_vectors(cls, entry: str, vectors: NDArray) -> Self:
        """Return the parameter that turns the unit vectors (n, 3) of an entry.

        Each has two directions, perpendicular to it and to each other: towards the two coordinate
        axes that are farthest from it. A user sees these coordinates.
        """
        n = len(vectors)
        directions = np.zeros((n, 3, n, 2))
        shown = np.zeros((n, 2), dtype=int)
        for k, vector in enumerate(vectors):
            first, second = np.sort(np.argsort(np.abs(vector), kind="stable")[:2])
            towards_first = np.eye(3)[first] - vector[first] * vector
            towards_first /= np.linalg.norm(towards_first)
            aside = np.cross(vector, towards_first)
            directions[k, :, k, 0] = towards_first
            directions[k, :, k, 1] = aside * np.copysign(1.0, aside[second])
            shown[k] = 3 * k + first, 3 * k + second
        return cls(entry, directions.reshape(3 * n, 2 * n), shown.ravel(), (n, 2))


class Scale(NamedTuple):
    """How far the numbers of an entry of a geometry may change in a calibration.

    Attributes
    ----------
    unit : array-like
        Natural unit [m], [rad], [unit of q], or [-] as a fraction of the start.
    kind : str or list of str
        Kind of this unit: "m", "rad", "q" or "-".
    low, high : float
        Physical limits of the numbers; of the factor, if they keep their sign.
    keeps_sign : bool
        Whether the numbers change by a factor.
    turns : bool
        Whether the rows of the entry are unit vectors, which turn.
    """

    unit: ArrayLike
    kind: str | list[str]
    low: float = -math.inf
    high: float = math.inf
    keeps_sign: bool = False
    turns: bool = False

    @classmethod
    def of_unit_vectors(cls) -> Self:
        """Return the scale of unit vectors, which may turn as far as they must."""
        return cls(1.0, "rad", turns=True)

    @classmethod
    def factor(cls, most: float) -> Self:
        """Return the scale of numbers that keep their sign and change at most by a factor."""
        return cls(1.0, "-", 1.0 / most, most, keeps_sign=True)
