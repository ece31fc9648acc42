"""Rows through the stages of an operator of hysteresis in NumPy, as hysteresis.h does it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin.native.hysteresis import DOUBLE_ROUNDING, Stage


def follow_in_numpy(
    stages: list[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float = DOUBLE_ROUNDING,
) -> NDArray:
    """Return rows (T, n) after the hysteresis; the state becomes that after the last row.

    The arguments are those of `native.hysteresis.follow`.
    """
    parts = []
    first = 0
    for stage in stages:
        last = first + abs(stage.size) + 1
        inside = state[first : last + 1]
        if stage.size > 0:
            parts.append(_Plays(stage, inside))
        else:
            parts.append(_Creep(stage, inside, rounding))
        first = last
    results = np.empty_like(rows)
    passed = np.maximum(steps, 0.0)
    for t, row in enumerate(rows):
        if steps[t] < 0.0:
            state[:] = row
        if lead:
            for part in parts[::-1]:
                row = part.lead(row, passed[t])
            state[0] = row
            results[t] = row
        else:
            state[0] = row
            for part in parts:
                part.follow(passed[t])
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
        self.half, self.slopes = stage.numbers
        self.weights = np.diff(self.slopes, axis=0, prepend=0.0)
        self.lag = (self.weights * self.half).sum(axis=0)

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


class _Creep(_Part):
    """Creep with the gains (J, n) and the time constants (J,); see `follow` for `rounding`."""

    def __init__(self, stage: Stage, state: NDArray, rounding: float) -> None:
        super().__init__(state)
        self.gains, self.times = stage.numbers
        self.rounding = rounding

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
        slow = (shares * self.inside).sum(axis=0)
        # Rounding is no reversal, after which a backlash before this stage would jump, and a share
        # at once that is only rounding moves nothing.
        size = np.abs(goal) + (shares * np.abs(self.inside)).sum(axis=0)
        change = goal - slow - at_once * self.command
        moves = (np.abs(change) > self.rounding * size) & (at_once > self.rounding)
        command = np.where(moves, (goal - slow) / at_once, self.command)
        self.result[:] = np.where(moves, goal, at_once * command + slow)
        self._move(command, late)
        return command

    def _late(self, seconds: float) -> NDArray:
        """Return what is left (J, 1) of a change after some seconds."""
        with np.errstate(over="ignore", under="ignore"):  # far longer or shorter times
            late = np.exp(-seconds / self.times)
        return late[:, None]

    def _move(self, command: NDArray, late: NDArray) -> None:
        self.inside[:] = command + late * (self.inside - command)
