"""Plays and a weighted sum of them, in NumPy."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.arrays import LARGEST
from hybridkin.hysteresis.stage import Follower


class Plays(Follower):
    """A sum of plays with half the widths and the slopes (K, n), as in stage_plays.h."""

    def __init__(self, half: NDArray, slopes: NDArray, state: NDArray) -> None:
        super().__init__(state)
        self.half = half
        self.slopes = slopes
        self.weights = np.diff(slopes, axis=0, prepend=0.0)
        self.lag = (self.weights * half).sum(axis=0)

    def follow(self, seconds: float) -> None:
        """Follow the command."""
        self._move(self.command)
        self.result[:] = (self.weights * self.inside).sum(axis=0)

    def lead(self, goal: NDArray, seconds: float) -> NDArray:
        """Return the command (n,) for a result (n,), and follow it.

        Along a direction play k moves from the command ``begins[k]`` on, at the result
        ``levels[k]``. Both ascend, also after rounding: then the piece that holds the goal has a
        slope, and the command is within it.
        """
        side = np.sign(goal - self.result)
        to = side * goal
        begins = side * self.inside + self.half
        begins[0] = np.maximum(begins[0], side * self.command)
        begins = np.maximum.accumulate(begins, axis=0)
        rises = self.slopes[:-1] * np.diff(begins, axis=0)
        levels = np.cumsum(np.vstack([[side * self.result], rises]), axis=0)
        n_moving = (levels < to).sum(axis=0)
        at = n_moving - 1, np.arange(len(goal))
        ends = np.vstack([begins[1:], np.full_like(goal, np.inf)])
        with np.errstate(divide="ignore", invalid="ignore"):  # where nothing is to move
            ahead = begins[at] + (to - levels[at]) / self.slopes[at]
        ahead = np.where(n_moving == len(levels), to + self.lag, ahead)
        ahead = np.clip(ahead, begins[at], ends[at])
        command = np.where(n_moving == 0, self.command, side * ahead)
        self._move(command)
        self.result[:] = goal
        return command

    def _move(self, command: NDArray) -> None:
        low = command - self.half
        self.inside[:] = np.clip(self.inside, low, command + self.half)


def half_widths(widths: NDArray) -> NDArray:
    """Return half of the widths of plays, as far as they count: no command moves wider ones."""
    return np.minimum(0.5 * widths, 2.0 * LARGEST)
