"""What is unknown of the frame in which tips are measured."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin.rotations import nearest_rotation


class Alignment:
    """The measuring frame is known: tips are compared as they are."""

    def aligned(self, tips: NDArray, x: NDArray, weights: NDArray) -> NDArray:
        """Return tips (N, 3) in the frame of x (N, 3), by rows with weights (N,) [m]."""
        return tips


class FreeOrigin(Alignment):
    """The origin of the measuring frame is unknown."""

    def aligned(self, tips: NDArray, x: NDArray, weights: NDArray) -> NDArray:
        """Return tips (N, 3) shifted to x (N, 3), by rows with weights (N,) [m]."""
        return tips + weights @ (x - tips) / weights.sum()


class FreeBase(Alignment):
    """The pose of the base is unknown, and the size of the robot is rough."""

    def aligned(self, tips: NDArray, x: NDArray, weights: NDArray) -> NDArray:
        """Return tips (N, 3) moved, turned and scaled to x (N, 3), by rows with weights (N,)."""
        normalised = weights / weights.sum()
        center = normalised @ tips
        target = normalised @ x
        centred = tips - center
        turn, trace = nearest_rotation((normalised[:, None] * (x - target)).T @ centred)
        size = max(normalised @ np.square(centred).sum(axis=1), np.finfo(float).tiny)
        return trace / size * centred @ turn.T + target
