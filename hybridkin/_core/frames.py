"""Frames along a robot, and how its end follows the inner coordinates before them."""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor

Marker = tuple[float, float, float, float]
"""Place on the backbone [segments from the base], and offset in the frame at that place [m]."""


class Frames(NamedTuple):
    """Frames after all segments and their offsets, in the base frame; the batch N comes last."""

    axes: Tensor  # (3, 3, S, N): axis, component
    points: Tensor  # (3, S, N) origins [m]
    # Velocity and angular velocity of the robot's end by the lengths, x- and y-bendings.
    moves: Tensor  # (3, 3, S, N)
    spins: Tensor  # (3, 3, S, N)
    arcs: Tensor  # lengths [m], then x-, then y-bendings, (3 S, N)
    slope: Tensor  # d arcs / dq, (3 S, n) or (3 S, n, N)
