"""Motions of a steered robot: a wiggle, a path, and the rows of a log."""

from __future__ import annotations

import itertools
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hybridkin import trajectories
from hybridkin.app.viewer.steered import RATE, SteeredRobot
from hybridkin.datasets import Log

_SWING = 0.3  # of a wiggle, relative to the range of the actuator
_LAP = 8.0  # time of one lap on a path [s]
_WIDTH = 0.12  # half the width of a path, relative to the size of the robot


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
        low = robot.limits.q_min
        high = robot.limits.q_max
        home = np.clip(robot.domain.preferred, low, high)
        self._robot = robot
        self._names = robot.model.description_.log.q
        self._steps = [home]
        for j in range(len(home)):
            there = home.copy()
            has_more_room_above = high[j] - home[j] > home[j] - low[j]
            there[j] += (_SWING if has_more_room_above else -_SWING) * robot.span[j]
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
    """A path of the target, again and again."""

    def __init__(self, robot: SteeredRobot, path: trajectories.Trajectory) -> None:
        self._robot = robot
        n_ticks = max(2, round(RATE * path.duration))
        times = np.linspace(path.t[0], path.t[-1], n_ticks)
        places = [np.interp(times, path.t, column) for column in path.x.T]
        self._targets = itertools.cycle(np.stack(places, axis=1))
        self.label = "the target"

    def __call__(self) -> bool:
        """Move the target on; it never ends."""
        self._robot.follow(next(self._targets))
        return True


def circle(robot: SteeredRobot) -> trajectories.Trajectory:
    """Return a horizontal circle through the present tip."""
    radius = _WIDTH * robot.size
    center = robot.x - [radius, 0.0, 0.0]
    return trajectories.spiral(
        center, radius, turns=1.0, duration=_LAP, dt=1.0 / RATE, timing="uniform"
    )


def figure_eight(robot: SteeredRobot) -> trajectories.Trajectory:
    """Return a horizontal figure eight about the present tip."""
    width = 2.0 * _WIDTH * robot.size
    return trajectories.figure_eight(
        robot.x, (width, 0.5 * width), duration=_LAP, dt=1.0 / RATE, timing="uniform"
    )


class Replay:
    """The rows of a log in their order, with the measured tip beside the model's."""

    def __init__(self, robot: SteeredRobot, log: Log, mark: Any) -> None:
        self._robot = robot
        self._mark = mark
        self._rows = iter(zip(*robot.measured_rows(log), strict=True))
        self._goal: NDArray | None = None
        self._count = 0
        self.label = ""

    def __call__(self) -> bool:
        """Go to the next row where the last one is reached."""
        limits = self._robot.limits
        if self._goal is None or np.array_equal(self._robot.q, self._goal):
            following = next(self._rows, None)
            self._mark.visible = following is not None
            if following is None:
                return False
            (row, self._mark.position) = following
            goal = np.clip(row, limits.q_min, limits.q_max)
            self._goal = goal
            self._count += 1
            self.label = f"row {self._count} of the log"
            self._robot.go_to(goal)
        return True
