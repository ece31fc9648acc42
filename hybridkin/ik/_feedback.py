"""How readings of the tip are used: an offset between robot and model, learned from each of them.

The law of the step knows nothing of readings. It gets the error of the model's tip moved by the
offset, so that a late reading cannot make the loop unstable: what the model does know of the motion
since then is in the error at once (internal model control).

References
----------
Morari & Zafiriou, "Robust Process Control" (1989), chapter 2.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from hybridkin._core.arrays import number
from hybridkin._core.kernel_numbers import (
    IK_AGREEING,
    IK_ON_TIME,
    IK_RECENT,
    IK_RING,
)

if TYPE_CHECKING:
    from hybridkin.ik._settings import StepSettings

MOST_PERIODS = IK_RING - 1  # that a reading may be late

# An innovation up to this is expected; the motion of the model's tip in the last periods comes on
# top. It is the change of the model's error since the readings before, and noise: calibrated models
# err by 1 to 3 % of the length of the robot, and by a few degrees.
_SHARE = 0.03  # of the reach
_TURN = 0.2  # [rad]
_RADII = 2.0  # if that is more, in error radii of the model: from one end of the ball to the other
_SAMPLES = 64  # configurations whose tips tell the size of a robot without geometry


@dataclass(frozen=True)
class Feedback:
    """How readings are used.

    Attributes
    ----------
    delay : float
        Age of a reading when it comes [s].
    memory : float
        Time constant with which the offset decays without readings [s]; infinite: it stays.
    """

    delay: float = 0.0
    memory: float = math.inf

    @classmethod
    def checked(cls, delay: float, memory: float, shortest: float) -> Feedback:
        """Return the arguments of a caller, checked; `shortest` is the time that is kept [s]."""
        delay = number(delay, "delay")
        memory = number(memory, "memory")
        if not memory > 0.0:
            raise ValueError(
                f"`memory` must be a positive time [s], got {memory!r}; inf keeps the offset."
            )
        if not 0.0 <= delay <= (1.0 + IK_ON_TIME) * shortest:
            raise ValueError(
                f"`delay` must be a time from 0 to {shortest:.6g} s, the last {MOST_PERIODS} "
                f"periods, got {delay!r} s; use a longer period."
            )
        return cls(delay, memory)


def expected_innovation(settings: StepSettings) -> tuple[Tensor, float]:
    """Return the innovations to expect in every row of a task, and the largest possible size.

    The rows (m,) are in the units of the task; infinite if neither the model has a size nor q
    finite limits. The size of an offset is the norm of its rows divided by these. No two tips are
    farther apart than twice the reach.
    """
    task = settings.task
    reach = _reach(settings)
    length = _SHARE * reach
    radius = getattr(task.estimator, "radius_", None)
    if radius is not None and math.isfinite(radius.inside):
        length = max(length, _RADII * radius.inside)
    most = 2.0 * reach / length if math.isfinite(length) else math.inf
    rows: list[float] = []
    for unit, count, turns in zip(task.units, task.parts, task.angular, strict=True):
        rows += [(_TURN if turns else length) * unit] * count
        most += math.pi / _TURN if turns else 0.0
    return torch.tensor(rows, dtype=torch.float64, device="cpu"), most


def _reach(settings: StepSettings) -> float:
    """Return the size of the robot [m]: of its geometry, else of the tips within the limits."""
    task = settings.task
    reach = task.models[0].robot.size
    n = settings.n_actuators
    if math.isfinite(reach) or n is None:
        return reach
    draws = SobolEngine(n).draw(_SAMPLES, dtype=torch.float64).to(task.device)
    box = settings.box(draws)
    q = box.lower + (box.upper - box.lower) * draws
    if not torch.isfinite(q).all():
        return math.inf
    with torch.no_grad():
        x, _ = settings.evaluate(q)
    tips = task.positions(x)
    sizes = (tips - tips.mean(0)).flatten(1).norm(dim=1)
    largest = float(sizes.max())
    return largest if 0.0 < largest < math.inf else math.inf


class Readings:
    """What readings have shown; the torch counterpart of `feedback.h`.

    Parameters
    ----------
    settings : StepSettings
        Task, and the fraction of an innovation that is taken.
    like : Tensor
        A tensor with the dtype and device of q.
    at_rest : bool
        Whether the robot stood still until now; else nothing is known of its past.

    Attributes
    ----------
    offset : Tensor of shape (1, m)
        Measured minus model, in the rows of the task.
    rejected : bool
        Whether the last reading was not used.
    """

    def __init__(self, settings: StepSettings, like: Tensor, at_rest: bool) -> None:
        expected, self._most = expected_innovation(settings)
        self._task = settings.task
        self._expected = expected.to(like)
        self._largest_weight = 1.0 / settings.fraction
        self.offset = torch.zeros_like(self._expected)[None]
        self.rejected = False
        self._since = math.inf if at_rest else 0.0  # the tip of the model before [s]
        self._past: deque[tuple[float, Tensor]] = deque(maxlen=IK_RING)
        self._weight = 0.0  # of the readings in the offset, in readings
        self._doubted: deque[Tensor] = deque(maxlen=IK_AGREEING)

    def record(self, x: Tensor) -> None:
        """Remember the present tip of the model (1, ...)."""
        self._past.appendleft((self._since, x))

    def passed(self, seconds: float) -> None:
        """Say how much later the next tip will be."""
        self._since = seconds

    def take(self, tip: Tensor | None, age: float, memory: float) -> Tensor:
        """Take a reading (1, ...) of some age [s] or none, and return the offset that it shows."""
        self.rejected = False
        shown = self.offset
        used = False
        if tip is not None:
            shown = self._shown(tip, age)
            known = torch.isfinite(shown)
            if known.any():
                used = self._accept(shown, known)
                self.rejected = not used
                shown = torch.where(known, shown, self.offset)
        if not used and math.isfinite(memory):
            kept = math.exp(-self._past[0][0] / memory)
            self._weight *= kept
            self.offset = kept * self.offset
        return self.offset if tip is None else shown

    def _shown(self, tip: Tensor, age: float) -> Tensor:
        """Return a tip minus that of the model at its time, linear between two; NaN if unknown."""
        left = age
        back = 0
        oldest = len(self._past) - 1
        while back < oldest and left > self._past[back][0]:
            left -= self._past[back][0]
            back += 1
        since, x = self._past[back]
        shown = self._task.difference(x, tip)
        if left <= IK_ON_TIME * since:
            return shown
        if back == oldest:
            return torch.full_like(shown, math.nan)
        _, before = self._past[back + 1]
        return torch.lerp(shown, self._task.difference(before, tip), left / since)

    def _accept(self, shown: Tensor, known: Tensor) -> bool:
        """Move the offset towards what a reading shows, or doubt it."""
        innovation = torch.where(known, shown - self.offset, 0.0)
        bound = 1.0 + self._motion()
        if self._size(innovation) <= bound:
            self._doubted.clear()
            # The first ones count alike, as there was no offset before.
            self._weight = min(self._weight + 1.0, self._largest_weight)
            fraction = 1.0 / self._weight
            mean = (1.0 - fraction) * self.offset + fraction * shown
            self.offset = torch.where(known, mean, self.offset)
            return True
        if not self._size(torch.where(known, shown, 0.0)) <= self._most:
            return False
        self._doubted.append(torch.where(known, shown, self.offset))
        doubted = torch.cat([*self._doubted])
        middle = doubted.median(0, keepdim=True).values
        sizes = [self._size(row) for row in doubted - middle]
        if len(sizes) < IK_AGREEING or max(sizes) > bound:
            return False
        # The robot has moved, or is another one than the model.
        self._doubted.clear()
        self._weight = self._largest_weight
        self.offset = middle
        return True

    def _motion(self) -> float:
        """Return the size of the motion of the model's tip in the last periods.

        A reading may be late by so much without anybody knowing.
        """
        recent = [x for _, x in self._past][: IK_RECENT + 1]
        now = recent[0].expand(len(recent), *recent[0].shape[1:])
        moved = self._task.difference(torch.cat(recent), now)
        sizes = (self._size(row) for row in moved)
        return max((size for size in sizes if math.isfinite(size)), default=0.0)

    def _size(self, row: Tensor) -> float:
        """Return the size of rows of the task, 1 for what is expected."""
        return float((row / self._expected).norm())
