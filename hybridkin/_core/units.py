"""Units of length and angle, and warnings if numbers look like millimetres or degrees."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line imports this module without loading torch
    from torch import Tensor

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
"""Metres per unit, for the units of length that logs, paths and options accept."""

UNITS = {**METRES, "rad": 1.0, "deg": math.pi / 180, "1": 1.0}
"""Metres or radians per unit of actuators; "1" keeps the values as they are."""

LONGEST_PULL = 4.0
"""Largest plausible tendon displacement, in backbone lengths."""

_TURNS = 4.0 * math.pi  # [rad]; larger joint angles are more likely in degrees
_SPANS = 10.0  # tips span at most 2 robot lengths; in millimetres it would be 2000


def span_message(
    name: str, tips: Tensor, reach: float, spans: float = _SPANS
) -> str | None:
    """Return a warning if tips (N, 3) span more than `spans` times the reach of the robot."""
    span = _span(tips)
    if span <= spans * reach:
        return None
    return (
        f"`{name}` spans {span:.4g} m, but the robot is only {reach:.3g} m long; hybridkin "
        "works in metres: divide millimetres by 1000, or read the log with x_unit='mm'."
    )


def motion_message(
    name: str, tips: Tensor, predicted: Tensor, reach: float
) -> str | None:
    """Return a warning if tips (N, 3) span 20 times what a model predicts, and two reaches."""
    moved = 20.0 * _span(predicted) / reach
    return span_message(name, tips, reach, min(_SPANS, max(2.0, moved)))


def _span(tips: Tensor) -> float:
    """Return the largest side of the box around tips (N, 3) [m]."""
    sides = tips.amax(dim=0) - tips.amin(dim=0)
    return float(sides.detach().max())


def millimetres_message(name: str, value: Tensor, limit: float) -> str | None:
    """Return a warning if values are too large to be metres."""
    looks = ", which looks like millimetres; hybridkin works in metres: divide by 1000."
    return _too_large(name, value, limit, looks)


def warn_millimetres(name: str, value: Tensor, limit: float) -> None:
    """Warn if values are too large to be metres."""
    message = millimetres_message(name, value, limit)
    if message is not None:
        warnings.warn(message, stacklevel=3)


def degrees_message(name: str, turns: Tensor, factor: float = 1.0) -> str | None:
    """Return a warning if joint angles are too large to be radians."""
    looks = (
        " on a revolute joint, which looks like degrees; hybridkin works in radians."
    )
    return _too_large(name, turns, factor * _TURNS, looks)


def _too_large(name: str, value: Tensor, limit: float, looks: str) -> str | None:
    if not (value > limit).any():
        return None
    return f"`{name}` reaches {float(value.max()):.4g}{looks}"
