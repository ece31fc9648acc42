"""Units of length, and warnings where numbers look like millimetres instead of metres."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

if TYPE_CHECKING:  # the command line reads the table before torch is loaded
    from torch import Tensor

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3}
"""Metres in each unit of length that logs, paths and options are given in."""

_SPANS = 10.0  # a tip moves within two lengths of its robot; millimetres look like 2000


def warn_span(name: str, tips: Tensor, reach: float) -> None:
    """Warn where tips (N, 3) of a log lie further apart than a robot of that size can reach."""
    span = float((tips.amax(dim=0) - tips.amin(dim=0)).max())
    if span > _SPANS * reach:
        warnings.warn(
            f"`{name}` spans {span:.4g} m, but the robot is only {reach:.3g} m long; hybridkin "
            "works in metres: divide millimetres by 1000, or read the log with x_unit='mm'.",
            stacklevel=4,
        )


def warn_millimetres(name: str, value: Tensor, limit: float) -> None:
    """Warn where values are too large to be metres."""
    if value.numel() and float(value.max()) > limit:
        warnings.warn(
            f"`{name}` reaches {float(value.max()):.4g}, which looks like millimetres; hybridkin "
            "works in metres.",
            stacklevel=3,
        )
