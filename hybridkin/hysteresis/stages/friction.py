"""Friction whose loops have no sharp corners: a weighted sum of plays (Prandtl-Ishlinskii)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import LARGEST, countable, real_array
from hybridkin._core.units import LogUnit
from hybridkin.hysteresis.follow import followed
from hybridkin.hysteresis.stage import Stage
from hybridkin.hysteresis.stages.backlash import Backlash
from hybridkin.hysteresis.stages.plays import Plays, half_widths


class Friction(Stage):
    """Plays of widths (K,) [unit of q] with slopes (K - 1,) or (K - 1, n), see `Hysteresis`."""

    kind = "friction"
    kernel = "plays"
    names = ("widths", "slopes")

    def __init__(self, widths: ArrayLike, slopes: ArrayLike) -> None:
        self.widths = real_array(widths, "widths").astype(float)
        self.slopes = real_array(slopes, "slopes").astype(float)
        ascending = _are_valid(self.widths, (1,)) and len(self.widths) > 0
        if not ascending or not (np.diff(self.widths) > 0.0).all():
            raise ValueError(
                f"`widths` must be ascending finite numbers, zero or more, got {widths!r:.200}."
            )
        shape = f"({len(self.widths) - 1},)"
        valid = _are_valid(self.slopes, (1, 2)) and countable(self.slopes).all()
        if not valid or len(self.slopes) + 1 != len(self.widths):
            raise ValueError(
                f"`slopes` must have shape {shape}, or one such column for each actuator, and be "
                f"zero or more and below {LARGEST:g}, got {slopes!r:.200}."
            )

        # Bounds y = P_1 + sum_k (s_k - 1) (P_k - P_{k+1}).
        self.width = self.widths[0] + np.diff(self.widths) @ np.abs(self.slopes - 1.0)

    @property
    def n_actuators(self) -> int:
        """Number of columns of the slopes; 0: one for any actuators."""
        return self.slopes.shape[1] if self.slopes.ndim == 2 else 0

    @property
    def n_inside(self) -> int:
        """Number of plays."""
        return len(self.widths)

    def in_words(self, unit: LogUnit) -> str:
        """Return its largest width."""
        return f"friction of {unit.in_words(float(self.width.max()))}"

    def numbers(self, n: int) -> tuple[NDArray, NDArray]:
        """Return half the widths and the slopes of the plays, each (K, n)."""
        slopes = np.ones((len(self.widths), n))  # the last are 1
        slopes[:-1] = self.slopes if self.slopes.ndim == 2 else self.slopes[:, None]
        half = np.broadcast_to(half_widths(self.widths)[:, None], slopes.shape)
        return half, slopes

    def follower(self, state: NDArray, rounding: float) -> Plays:
        """Return the plays in NumPy."""
        return Plays(*self.numbers(state.shape[1]), state)

    def each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the plays (N, n)."""
        for width in self.widths:
            yield followed([Backlash(width)], rows, steps)


def _are_valid(numbers: NDArray, dimensions: tuple[int, ...]) -> bool:
    """Return whether numbers are finite, zero or more, and have so many dimensions."""
    positive = np.isfinite(numbers) & (numbers >= 0.0)
    return numbers.ndim in dimensions and bool(positive.all())
