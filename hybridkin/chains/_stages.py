"""Rows through the stages of an operator of hysteresis in NumPy, as hysteresis.h does it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.kernel_numbers import HK_CREEP_ROUNDING
from hybridkin.native.hysteresis import Stage


def follow_in_numpy(
    stages: list[Stage], rows: NDArray, steps: NDArray, state: NDArray, lead: bool
) -> NDArray:
    """Return rows (T, n) after the hysteresis; the state becomes that after the last row.

    The arguments are those of `native.hysteresis.follow`, in the precision of the rows.
    """
    parts = []
    first = 0
    for stage in stages:
        last = first + abs(stage.size) + 1
        kind = _Plays if stage.size > 0 else _Creep
        parts.append(kind(stage, state[first : last + 1]))
        first = last
    results = np.empty_like(rows)
    for t, row in enumerate(rows):
        if lead:
            for part in parts[::-1]:
                row = part.lead(row, steps[t])
            state[0] = row
            results[t] = row
        else:
            state[0] = row
            for part in parts:
                part.follow(steps[t])
            results[t] = state[-1]
    return results


class _Part:
    """A stage, and views of the state: its command (n,), what is inside, and its result (n,)."""

    def __init__(self, state: NDArray) -> None:
        self.command = state[0]
        self.inside = state[1:-1]
        self.result = state[-1]


class _Plays(_Part):
    """A sum of plays with half the widths, the slopes and the weights (K, n)."""

    def __init__(self, stage: Stage, state: NDArray) -> None:
        super().__init__(state)
        most = np.finfo(state.dtype).max / 4  # wider ones never move a tendon
        half, slopes = stage.numbers
        self.half = np.minimum(half, most).astype(state.dtype)
        self.slopes = slopes.astype(state.dtype)
        self.weights = np.diff(self.slopes, axis=0, prepend=0.0).astype(state.dtype)

    def follow(self, seconds: float) -> None:
        """Follow the command."""
        self._move(self.command)
        self.result[:] = (self.weights * self.inside).sum(axis=0)

    def lead(self, goal: NDArray, seconds: float) -> NDArray:
        """Return the command (n,) for a result (n,), and follow it.

        Along a direction play k moves from the command ``begins[k]`` on, at the result
        ``levels[k]``.
        """
        side = np.sign(goal - self.result)
        begins = side * self.inside + self.half
        levels = np.empty_like(begins)
        levels[0] = side * self.result
        levels[1:] = levels[0] + np.cumsum(
            self.slopes[:-1] * np.diff(begins, axis=0), 0
        )
        moving = (levels < side * goal).sum(axis=0) - 1  # the widest one
        at = moving, np.arange(len(goal))
        beyond = (side * goal - levels[at]) / self.slopes[at]
        ahead = side * (begins[at] + beyond)
        with_all = goal + side * (self.weights * self.half).sum(axis=0)
        ahead = np.where(moving == len(levels) - 1, with_all, ahead)
        command = np.where(side == 0.0, self.command, ahead)
        self._move(command)
        self.result[:] = goal
        return command

    def _move(self, command: NDArray) -> None:
        low = command - self.half
        self.inside[:] = np.clip(self.inside, low, command + self.half)


class _Creep(_Part):
    """Creep with the gains (J, n) and the time constants (J,)."""

    def __init__(self, stage: Stage, state: NDArray) -> None:
        super().__init__(state)
        gains, self.times = stage.numbers
        self.gains = gains.astype(state.dtype)

    def follow(self, seconds: float) -> None:
        """Follow the command after some seconds."""
        self._move(self.command, self._late(seconds))
        behind = self.inside - self.command
        self.result[:] = self.command + (self.gains * behind).sum(axis=0)

    def lead(self, goal: NDArray, seconds: float) -> NDArray:
        """Return the command (n,) for a result (n,) after some seconds, and follow it."""
        late = self._late(seconds)
        # y = (1 - sum of shares) q + shares @ slow, with the shares that have not come yet.
        shares = self.gains * late
        at_once = 1.0 - shares.sum(axis=0)
        moved = (goal - (shares * self.inside).sum(axis=0)) / at_once
        # Rounding is no reversal, after which a backlash before this stage would jump.
        size = np.abs(goal) + (shares * np.abs(self.inside)).sum(axis=0)
        rounding = HK_CREEP_ROUNDING * np.finfo(goal.dtype).eps * size / at_once
        still = np.abs(moved - self.command) <= rounding
        command = np.where(still, self.command, moved)
        self._move(command, late)
        self.result[:] = goal
        return command

    def _late(self, seconds: float) -> NDArray:
        """Return what is left (J, 1) of a change after some seconds."""
        with np.errstate(over="ignore", under="ignore"):  # far longer or shorter times
            late = np.exp(-seconds / self.times)
        return late[:, None].astype(self.gains.dtype)

    def _move(self, command: NDArray, late: NDArray) -> None:
        self.inside[:] = command + late * (self.inside - command)
