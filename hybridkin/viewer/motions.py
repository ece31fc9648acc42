"""Motions of a steered robot: a wiggle, a path, and the rows of a log."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridkin.datasets import Log
from hybridkin.viewer.steered import RATE, SteeredRobot

_SWING = 0.3  # of a wiggle, relative to the range of the actuator
_TURN = 8.0  # time of one turn on a path [s]


class Motion(Protocol):
    """A motion: called before every tick, until it returns False.

    Attributes
    ----------
    label : str
        What moves at present, for the page.
    """

    label: str

    def __call__(self) -> bool:
        """Steer for one tick, and return whether there is more to come."""
        ...


class Wiggle:
    """Every actuator moves out and back, one after another."""

    def __init__(self, robot: SteeredRobot) -> None:
        low, high = robot.limits.q_min, robot.limits.q_max
        home = np.clip(robot.domain.preferred, low, high)
        self._robot = robot
        self._names = robot.loaded.log_format().q
        self._steps = [home]
        for j in range(len(home)):
            there = home.copy()
            up = high[j] - home[j] > home[j] - low[j]
            there[j] += (_SWING if up else -_SWING) * robot.span[j]
            self._steps += [there, home]
        self._at = -1
        self.label = ""

    def __call__(self) -> bool:
        """Go to the next place where the last one is reached."""
        if self._at < 0 or np.array_equal(self._robot.q, self._steps[self._at]):
            self._at += 1
            if self._at == len(self._steps):
                return False
            self._robot.go_to(self._steps[self._at])
            self.label = self._names[max(self._at - 1, 0) // 2]
        return True


class Loop:
    """A circle (1, 0), a figure eight (0, 1) or their sum from the present tip, in turns."""

    def __init__(self, robot: SteeredRobot, kind: NDArray) -> None:
        self._robot = robot
        self._center = robot.x
        self._kind = kind
        self._tick = 0
        self.label = "the target"

    def __call__(self) -> bool:
        """Move the target on; it never ends."""
        phase = 2.0 * np.pi * self._tick / (RATE * _TURN)
        circle = np.array([np.cos(phase) - 1.0, np.sin(phase), 0.0])
        eight = np.array([np.sin(phase), np.sin(2.0 * phase), 0.0])
        shape = self._kind @ np.stack([circle, eight])
        self._robot.follow(self._center + 0.12 * self._robot.size * shape)
        self._tick += 1
        return True


class Replay:
    """The rows of a log in their order, with the measured tip beside the model's."""

    def __init__(self, robot: SteeredRobot, log: Log, mark: Any) -> None:
        self._robot = robot
        self._mark = mark
        effective = robot.loaded.effective(log.q, log.groups)
        fine = np.isfinite(effective).all(axis=1) & np.isfinite(log.x[:, -3:]).all(
            axis=1
        )
        self._rows = iter(zip(effective[fine], log.x[fine, -3:], strict=True))
        self._goal: NDArray | None = None
        self._count = 0
        self.label = ""

    def __call__(self) -> bool:
        """Go to the next row where the last one is reached."""
        limits = self._robot.limits
        if self._goal is None or np.array_equal(self._robot.q, self._goal):
            row, tip = next(self._rows, (None, None))
            self._mark.visible = row is not None
            if row is None or tip is None:
                return False
            goal = self._goal = np.clip(row, limits.q_min, limits.q_max)
            self._mark.position = tip
            self._count += 1
            self.label = f"row {self._count} of the log"
            self._robot.go_to(goal)
        return True
