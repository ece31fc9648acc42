"""Rotations and rigid motions that bring points nearest to others, for tools on hybridkin."""

from __future__ import annotations

import torch
from numpy.typing import NDArray

from hybridkin._core import rotations

__all__ = ["nearest_rotation", "rigid_motion", "rotation_angle"]


def nearest_rotation(moments: NDArray) -> tuple[NDArray, NDArray]:
    """Return the rotations R of largest trace(R^T M), and that trace.

    Parameters
    ----------
    moments : ndarray of shape (..., 3, 3)
        ``M = b^T a`` of centred points a and b (N, 3): R brings a nearest to b, and the trace over
        the sum of squares of a is the best scale, in any unit of length, squared [m^2].

    Returns
    -------
    R : ndarray of shape (..., 3, 3)
        Rotations without mirror images [1].
    trace : ndarray of shape (...)
        The trace, in the unit of the moments [m^2].

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991).
    """
    R, trace = rotations.nearest_rotation(torch.from_numpy(moments))
    return R.numpy(), trace.numpy()


def rigid_motion(points: NDArray, targets: NDArray, weights: NDArray) -> NDArray:
    """Return the motion that brings points nearest to their targets.

    Parameters
    ----------
    points, targets : ndarray of shape (N, 3)
        Points before and after the motion [m].
    weights : ndarray of shape (N,)
        Those of the squared distances.

    Returns
    -------
    ndarray of shape (4, 4)
        Rotation, and translation [m].
    """
    columns = map(torch.from_numpy, (points, targets, weights))
    return rotations.rigid_motion(*columns).numpy()


def rotation_angle(R: NDArray) -> float:
    """Return the angle of a rotation, from 0 to a half turn [rad].

    Parameters
    ----------
    R : ndarray of shape (3, 3)
        The rotation [1].
    """
    return float(rotations.rotation_vector(torch.from_numpy(R)).norm())
