"""Causes in the measuring frame: units and axes of the tips, a base that moved."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.app.checks.causes.cause import (
    Cause,
    LinearCause,
    distances,
    robust_weights,
)
from hybridkin.app.checks.causes.evidence import Evidence
from hybridkin.rotations import rigid_motion, rotation_angle

_ROUNDS = 4  # of the weights of a rigid motion
_UNITS = {
    10.0: "centimetres and millimetres, or metres and decimetres, are mixed up",
    100.0: "centimetres were read as metres",
    1000.0: "millimetres were read as metres",
    1.0 / 10.0: "millimetres and centimetres are mixed up",
    1.0 / 100.0: "metres were read as centimetres",
    1.0 / 1000.0: "metres were read as millimetres",
    1.0 / 25.4: "inches were read as millimetres",
    1.0 / 2.54: "inches were read as centimetres",
    2.54: "centimetres were read as inches",
    25.4: "millimetres were read as inches",
}


@dataclass(frozen=True)
class Units(Cause):
    """The tips are in another unit."""

    factor: float

    name = "unit of the tips"
    remedy = "check `x_unit` in [log] of the robot description or --x-unit"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return one cause for each ratio of two units."""
        return [cls(factor) for factor in _UNITS]

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) in the other unit."""
        return self.factor * evidence.tips

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the factor in words."""
        return f"{self.factor:.4g} times as large; {_UNITS[self.factor]}"


@dataclass(frozen=True)
class Axes(Cause):
    """The coordinates of the tips are in another order, or some are reversed."""

    order: tuple[int, ...]
    signs: tuple[int, ...]

    name = "axes of the tips"
    remedy = "check order and signs of the columns of x; axes must be right-handed"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return all other orders and signs, those with the fewest changes first."""
        readings = []
        for order in itertools.permutations(range(3)):
            for signs in itertools.product((1, -1), repeat=3):
                readings.append(cls(order, signs))
        return sorted(readings, key=lambda axes: axes.n_changes)[1:]

    @property
    def n_changes(self) -> int:
        """Number of axes that are not what they should be."""
        moved = sum(axis != place for place, axis in enumerate(self.order))
        return moved + sum(sign < 0 for sign in self.signs)

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) with these axes [m]."""
        return evidence.tips[:, self.order] * self.signs

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return what the measured coordinates are, in words."""
        words = []
        for axis, sign in zip(self.order, self.signs, strict=True):
            words.append("-"[: sign < 0] + "xyz"[axis])
        return f"the columns x, y, z hold {', '.join(words)}"


class MovedBase(Cause):
    """The base, or the camera, stands elsewhere than in the log."""

    name = "moved base"
    remedy = "measure where the base is, or call `model.adapt(q, x)` with this log"
    n_parameters = 6

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def moved_rows(self, evidence: Evidence) -> NDArray:
        """Return the rows (N,) of bool that are measured from the other place."""
        return np.ones(len(evidence.rows), dtype=bool)

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no motion: the matrix (3, 4), row by row."""
        return [np.eye(3, 4).ravel()]

    def fit(self, evidence: Evidence, used: NDArray, start: NDArray, rounds: int) -> NDArray:
        """Return the rigid motion (12,) that brings some rows nearest to the measured tips."""
        rows = used & self.moved_rows(evidence)
        if rows.sum() < 3:
            return start
        tips = evidence.tips[rows]
        x = evidence.x[rows]
        weights = np.ones(len(x))
        motion = np.eye(4)
        for _ in range(_ROUNDS):
            motion = rigid_motion(tips, x, weights)
            far = distances(tips @ motion[:3, :3].T + motion[:3, 3], x)
            weights = robust_weights(far)
        return motion[:3].ravel()

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) after the rigid motion [m]."""
        motion = parameters.reshape(3, 4)
        tips = evidence.tips
        moved = tips @ motion[:, :3].T + motion[:, 3]
        return np.where(self.moved_rows(evidence)[:, None], moved, tips)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the angle, and how far the middle of the tips moves, in words."""
        motion = parameters.reshape(3, 4)
        turn = rotation_angle(motion[:, :3])
        middle = evidence.tips.mean(axis=0)
        shift = motion[:, :3] @ middle + motion[:, 3] - middle
        return (
            f"turned by {np.degrees(turn):.3g} degrees, the tips moved by "
            f"{1e3 * np.linalg.norm(shift):.3g} mm"
        )


@dataclass(frozen=True)
class Bump(MovedBase):
    """The base, or the camera, was pushed during the motion."""

    row: int

    name = "bump"
    remedy = "use the rows before it; measure where the base is, or repeat the motion"
    n_parameters = 7

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return a bump for each row where the residual changes suddenly."""
        residual = evidence.x - evidence.tips
        weights = robust_weights(np.linalg.norm(residual, axis=1))
        after = np.cumsum((weights[:, None] * residual)[::-1], axis=0)[::-1]
        total = np.cumsum(weights[::-1])[::-1]
        gain = np.square(after).sum(axis=1) / total
        return [cls(row) for row in evidence.sudden_rows(gain)]

    def moved_rows(self, evidence: Evidence) -> NDArray:
        """Return the rows (N,) of bool after the bump."""
        return evidence.rows >= self.row

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the row and the motion in words."""
        return f"at row {self.row}: {super().amount(evidence, parameters)}"


class Drift(LinearCause):
    """The tips drift during the motion: a camera that moves, a body that warms up."""

    name = "drift"
    remedy = "find out whether base or camera move, or the robot becomes warm"
    n_parameters = 6

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no drift."""
        return [np.zeros(6)]

    def columns(self, evidence: Evidence) -> NDArray:
        """Return the derivatives (N, 3, 6) by a shift and a small turn that grow with time."""
        motion = evidence.motion
        passed = (motion.time[evidence.rows] - motion.time[0]) / motion.duration
        arm = evidence.tips - evidence.tips.mean(axis=0)
        turned = np.cross(np.eye(3), arm[:, None, :]).transpose(0, 2, 1)
        shifted = np.broadcast_to(np.eye(3), turned.shape)
        return passed[:, None, None] * np.concatenate([shifted, turned], axis=2)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return how far the tips drift, in words."""
        return f"{1e3 * np.linalg.norm(parameters[:3]):.3g} mm from begin to end"
