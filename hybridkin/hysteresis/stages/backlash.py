"""Backlash (also called play) of tendons: the classical play operator."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import real_array
from hybridkin._core.units import LogUnit
from hybridkin.hysteresis.stage import Stage
from hybridkin.hysteresis.stages.plays import Plays, half_widths


class Backlash(Stage):
    """Backlash of a width () or (n,) [unit of q], see `Hysteresis.backlash`."""

    kind = "backlash"
    kernel = "plays"
    names = ("width",)

    def __init__(self, width: ArrayLike) -> None:
        self.width = real_array(width, "width").astype(float)
        valid = np.isfinite(self.width) & (self.width >= 0)
        if self.width.ndim > 1 or not valid.all():
            raise ValueError(
                f"`width` must be one or (n,) finite numbers, zero or more, got {width!r:.200}."
            )

    @property
    def n_actuators(self) -> int:
        """Number of widths; 0: one for any actuators."""
        return self.width.size if self.width.ndim else 0

    @property
    def n_inside(self) -> int:
        """One play."""
        return 1

    def in_words(self, unit: LogUnit) -> str:
        """Return its largest width."""
        return f"backlash of {unit.in_words(float(self.width.max()))}"

    def numbers(self, n: int) -> tuple[NDArray, NDArray]:
        """Return half the width and the slope of one play, each (1, n)."""
        half = np.broadcast_to(half_widths(self.width), (1, n))
        return half, np.ones((1, n))

    def follower(self, state: NDArray, rounding: float) -> Plays:
        """Return the play in NumPy."""
        return Plays(*self.numbers(state.shape[1]), state)
