"""What the actuators of a robot are: rest, kind, segments and balance."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray


class ActuatorLayout(NamedTuple):
    """What the actuators of a robot are.

    Attributes
    ----------
    rest : ndarray of shape (n,)
        The q at which they have no effect, for lengths of chambers zero [unit of q].
    absolute : ndarray of shape (n,) of bool
        Which have lengths in place of changes of length.
    signed : ndarray of shape (n,) of bool
        Which can be read with a wrong sign: all but lengths.
    segments : list of list of int
        The actuators of every segment, in order of their angles.
    balance : ndarray of shape (n, k)
        Directions along which tendons that do not pull against each other never move [1].
    tendons : ndarray of shape (n,) of bool
        Which are tendons of given length.
    """

    rest: NDArray
    absolute: NDArray
    signed: NDArray
    segments: list[list[int]]
    balance: NDArray
    tendons: NDArray

    @classmethod
    def independent(cls, n: int) -> ActuatorLayout:
        """Return the layout of n actuators of which nothing is known."""
        segments = [[i] for i in range(n)]
        none = np.zeros(n, dtype=bool)
        return cls(np.zeros(n), none, ~none, segments, np.zeros((n, 0)), none)
