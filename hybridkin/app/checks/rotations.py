"""The rotations and rigid motions that bring points nearest to others."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def nearest_turn(moments: NDArray) -> tuple[NDArray, NDArray]:
    """Return the rotations R (..., 3, 3) of largest trace(R^T M), and that trace (...,).

    For centred points a and b (N, 3) and moments M = b^T a, R brings a nearest to b; the trace over
    the sum of squares of a is then the best scale.

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991): least squares over rotations without mirror images.
    """
    left, stretch, right = np.linalg.svd(moments)
    # The least stretched axis is reversed where the product would be a mirror image.
    sign = np.ones_like(stretch)
    sign[..., 2] = np.sign(np.linalg.det(left @ right))
    turn = (left * sign[..., None, :]) @ right
    return turn, (stretch * sign).sum(axis=-1)


def rigid_motion(points: NDArray, targets: NDArray, weights: NDArray) -> NDArray:
    """Return the motion (4, 4) that brings points (N, 3) nearest to their targets (N, 3).

    `weights` (N,) are those of the squared distances.
    """
    normalised = weights / weights.sum()
    center = normalised @ points
    target_center = normalised @ targets
    moments = (normalised[:, None] * (targets - target_center)).T @ (points - center)
    turn, _ = nearest_turn(moments)
    motion = np.eye(4)
    motion[:3, :3] = turn
    motion[:3, 3] = target_center - turn @ center
    return motion


def angle_of(turn: NDArray) -> float:
    """Return the angle of a rotation (3, 3) [rad], from 0 to a half turn."""
    skew = 0.5 * (turn - turn.T)
    sine = np.linalg.norm(skew[[2, 0, 1], [1, 2, 0]])
    cosine = 0.5 * (np.trace(turn) - 1.0)
    return float(np.arctan2(sine, cosine))
