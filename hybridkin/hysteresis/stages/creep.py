"""Creep of actuators or of the body: part of a change comes only with time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import real_array
from hybridkin._core.kernel_numbers import HK_MAX_CREEPS
from hybridkin._core.units import LogUnit
from hybridkin.hysteresis.follow import followed
from hybridkin.hysteresis.stage import Follower, Stage


class Creep(Stage):
    """Creep with shares (J,) or (J, n) [1] and time constants (J,) [s], see `Hysteresis.creep`."""

    kind = "creep"
    kernel = "creep"
    names = ("shares", "times")
    needs_time = True

    def __init__(self, shares: ArrayLike, times: ArrayLike) -> None:
        self.shares = real_array(shares, "shares").astype(float)
        self.times = real_array(times, "times").astype(float)
        positive = np.isfinite(self.times) & (self.times > 0.0)
        some = self.times.ndim == 1 and 0 < self.times.size <= HK_MAX_CREEPS
        if not some or not positive.all():
            raise ValueError(
                f"`times` must be 1 to {HK_MAX_CREEPS} finite positive numbers, got {times!r:.200}."
            )
        shaped = self.shares.ndim in (1, 2) and len(self.shares) == len(self.times)
        if not shaped or not _leave_a_part(self.shares):
            raise ValueError(
                f"`shares` must have shape ({len(self.times)},), or one such column for each "
                f"actuator, and be zero or more with a sum below 1, got {shares!r:.200}."
            )
        self.width = np.zeros(())

    @property
    def n_actuators(self) -> int:
        """Number of columns of the shares; 0: one for any actuators."""
        return self.shares.shape[1] if self.shares.ndim == 2 else 0

    @property
    def n_inside(self) -> int:
        """Number of slow parts."""
        return len(self.times)

    @property
    def time_constants(self) -> NDArray:
        """The time constants (J,) [s]."""
        return self.times

    def in_words(self, unit: LogUnit) -> str:
        """Return the largest share of a change that comes late, and the time constants."""
        late = 100.0 * self.shares.sum(axis=0).max()
        times = [f"{time:.3g}" for time in np.unique(self.times[[0, -1]])]
        return f"creep (up to {late:.2g} % late, with {' to '.join(times)} s)"

    def numbers(self, n: int) -> tuple[NDArray, NDArray]:
        """Return the shares (J, n) and the time constants (J,)."""
        size = len(self.times)
        return np.broadcast_to(self.shares.reshape(size, -1), (size, n)), self.times

    def follower(self, state: NDArray, rounding: float) -> SlowParts:
        """Return the creep in NumPy."""
        return SlowParts(*self.numbers(state.shape[1]), state, rounding)

    def each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the slow parts (N, n)."""
        for time in self.times:
            half = Creep([0.5], [time])
            yield 2.0 * followed([half], rows, steps) - rows


class SlowParts(Follower):
    """Creep with shares (J, n) and time constants (J,), as in stage_creep.h."""

    def __init__(self, shares: NDArray, times: NDArray, state: NDArray, rounding: float) -> None:
        super().__init__(state)
        self.shares = shares
        self.times = times
        self.rounding = rounding

    def follow(self, seconds: float) -> None:
        """Follow the command after some seconds."""
        self._move(self.command, self._late(seconds))
        behind = self.inside - self.command
        self.result[:] = self.command + (self.shares * behind).sum(axis=0)

    def lead(self, goal: NDArray, seconds: float) -> NDArray:
        """Return the command (n,) for a result (n,) after some seconds, and follow it."""
        late = self._late(seconds)
        # y = (1 - sum of shares) q + shares @ slow, with the shares that have not come yet.
        shares = self.shares * late
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


def _leave_a_part(shares: NDArray) -> bool:
    """Return whether shares are zero or more and leave a part that comes at once."""
    return bool((shares >= 0.0).all() and (shares.sum(axis=0) < 1.0).all())
