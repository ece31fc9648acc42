"""What can be drawn of a robot: its backbone, actuators and disks, as plain arrays."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

_RIM = 1.15  # radius of a disk over that of the actuator circle
_CORNERS = 17  # points of a disk's rim


class Body(NamedTuple):
    """The body of a robot in K configurations, in the measuring frame [m].

    Attributes
    ----------
    points : ndarray of shape (K, P, 3)
        Points along the backbone, base to end.
    actuators : list of ndarray of shape (K, P_i, 3)
        The path of every actuator; empty if they have none beside the backbone.
    segments : list of int
        The segment at which every actuator ends.
    disks : ndarray of shape (K, D, C, 3)
        Rims of disks, at the base and at every segment's end.
    is_rigid : bool
        Whether the points are joints, with straight links between them.
    """

    points: NDArray
    actuators: list[NDArray]
    segments: list[int]
    disks: NDArray
    is_rigid: bool

    @classmethod
    def of_links(cls, points: NDArray) -> Self:
        """Return the body of straight links between points (K, P, 3), without actuators."""
        return cls(points, [], [], np.empty((len(points), 0, _CORNERS, 3)), True)


def actuator_path(frames: NDArray, passed: slice, radius: float, angle: float) -> NDArray:
    """Return points (K, P, 3) of an actuator at its place in the frames (K, S, P, 4, 4)."""
    place = radius * np.array([np.cos(angle), np.sin(angle), 0.0])
    points = frames[:, passed, :, :3, 3] + frames[:, passed, :, :3, :3] @ place
    return points.reshape(len(points), -1, 3)


def disk(frame: NDArray, radius: float) -> NDArray:
    """Return the rim (K, C, 3) of a disk about actuators at a radius, in frames (K, 4, 4)."""
    corner = np.linspace(0.0, 2.0 * np.pi, _CORNERS)
    circle = np.stack([np.cos(corner), np.sin(corner), 0.0 * corner])
    rim = frame[:, :3, :3] @ (_RIM * radius * circle)
    return frame[:, None, :3, 3] + rim.swapaxes(-1, -2)
