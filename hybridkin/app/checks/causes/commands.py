"""Causes in the actuators: what they did is not what their commands say."""

from __future__ import annotations

import itertools
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.app.checks.causes.cause import Cause
from hybridkin.app.checks.causes.evidence import Evidence

_STILL = 1e-3  # of the largest range: an actuator that moves less does not move
_LARGER = 1.5  # least factor by which bends are of another size
_LEAST_GAIN = 0.2  # an actuator that moves less is dead
_AWAY = 0.05  # of the range: values at the first row this far from the rest are not at rest


def _moved_actuators(evidence: Evidence) -> list[int]:
    """Return the actuators that move."""
    span = evidence.motion.span
    scale = np.maximum(span, np.finfo(float).tiny)
    moved = span > _STILL * np.abs(evidence.actuators.per_unit) * np.max(
        scale / np.abs(evidence.actuators.per_unit)
    )
    return np.flatnonzero(moved).tolist()


class ActuatorCause(Cause):
    """A cause that changes what the actuators did."""

    moves_actuators = True

    @abstractmethod
    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return what the actuators did (N, n) with these parameters (P,) [unit of q]."""

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) with these parameters (P,) [m]."""
        return evidence.at(self.changed(evidence, parameters))


class Reading(ActuatorCause):
    """Another way to read the columns of the actuators: their order and their signs."""

    @abstractmethod
    def way(self, evidence: Evidence) -> NDArray:
        """Return the matrix (n, n) of 1, -1 and 0 that takes the columns to the true ones."""

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the motion (N, n) in the true columns [unit of q]."""
        actuators = evidence.actuators
        moved = (evidence.q - actuators.rest) / actuators.per_unit
        return actuators.rest + moved @ self.way(evidence) * actuators.per_unit


@dataclass(frozen=True)
class OneActuator(ActuatorCause):
    """A cause in one actuator."""

    actuator: int

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return one cause for each actuator that moves."""
        return [cls(i) for i in _moved_actuators(evidence)]

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return what the actuators did (N, n) with these parameters (P,) [unit of q]."""
        q = evidence.q.copy()
        q[:, self.actuator] = self.motion(evidence, q[:, self.actuator], parameters)
        return q

    @abstractmethod
    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return what the actuator did (N,) where the model takes q (N,) [unit of q]."""

    def steps(self, evidence: Evidence) -> NDArray:
        """Return the natural size of a change: the range of the actuator."""
        return evidence.motion.span[[self.actuator]]


class Zero(OneActuator):
    """The zero of one actuator is another one, as after a slip or another pretension."""

    name = "zero of one actuator"
    remedy = (
        "set its zero again (home the motor, check the clamp of the tendon, the zero of the "
        "valve), or call `model.adapt(q, x)`"
    )
    n_parameters = 1

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return the zero of the model."""
        return [np.zeros(1)]

    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return the shifted motion of the actuator (N,) [unit of q]."""
        return q + parameters[0]

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator and its shift in words."""
        actuators = evidence.actuators
        return (
            f"{actuators.names[self.actuator]} is off by "
            f"{actuators.amount(self.actuator, parameters[0])}"
        )


@dataclass(frozen=True)
class Slip(OneActuator):
    """The zero of one actuator jumps during the motion: a slip, a lost step."""

    row: int

    name = "slip of one actuator"
    remedy = "check clamp, spool and coupling of this actuator; home it, and repeat the motion"
    n_parameters = 2

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return slips of each actuator that moves at the rows where the residual changes."""
        residual = evidence.x - evidence.tips
        along = np.einsum("nij,ni->nj", evidence.jacobian, residual)
        squares = np.square(evidence.jacobian).sum(axis=1)
        after = np.cumsum(along[::-1], axis=0)[::-1]
        weight = np.cumsum(squares[::-1], axis=0)[::-1]
        gain = np.square(after) / np.maximum(weight, np.finfo(float).tiny)
        slips = []
        for i in _moved_actuators(evidence):
            slips += [cls(i, row) for row in evidence.sudden_rows(gain[:, i])]
        return slips

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no slip."""
        return [np.zeros(1)]

    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return the motion of the actuator (N,), shifted after the slip [unit of q]."""
        return q + parameters[0] * (evidence.rows >= self.row)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator, the row and the shift in words."""
        actuators = evidence.actuators
        return (
            f"{actuators.names[self.actuator]} by "
            f"{actuators.amount(self.actuator, parameters[0])} at row {self.row}"
        )


class Gain(OneActuator):
    """One actuator moves by another factor: a spool of another radius, a leak."""

    name = "gain of one actuator"
    remedy = "check the radius of its spool, its driver's steps or its pressure, and fit again"
    n_parameters = 1

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return the gain of the model."""
        return [np.ones(1)]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return one."""
        return np.ones(1)

    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return the scaled motion of the actuator (N,) about its rest [unit of q]."""
        rest = evidence.actuators.rest[self.actuator]
        return rest + self._factor(parameters) * (q - rest)

    def _factor(self, parameters: NDArray) -> float:
        return float(np.clip(parameters[0], _LEAST_GAIN, 1.0 / _LEAST_GAIN))

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator and the factor in words."""
        name = evidence.actuators.names[self.actuator]
        return f"{name} moves {self._factor(parameters):.3g} times as far"


class Dead(OneActuator):
    """One actuator does not move at all."""

    name = "dead actuator"
    remedy = "check its driver, tendon, valve or hose"
    n_parameters = 1

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return the first position of the actuator, and its middle."""
        q = evidence.motion.q[:, self.actuator]
        return [q[:1], q.mean(keepdims=True)]

    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return the position at which the actuator stands (N,) [unit of q]."""
        return np.full(len(q), parameters[0])

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator and where it stands in words."""
        actuators = evidence.actuators
        rest = actuators.rest[self.actuator]
        return (
            f"{actuators.names[self.actuator]} stands at "
            f"{actuators.amount(self.actuator, parameters[0] - rest)}"
        )


@dataclass(frozen=True)
class Sign(Reading):
    """One actuator moves in the other direction."""

    actuator: int

    name = "sign of one actuator"
    remedy = "reverse its sign (`q_sign` in [log], or the wiring of the motor)"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return one cause for each actuator that moves and is no length."""
        signed = evidence.actuators.signed
        return [cls(i) for i in _moved_actuators(evidence) if signed[i]]

    def way(self, evidence: Evidence) -> NDArray:
        """Return the identity (n, n) with one sign reversed."""
        signs = np.ones(evidence.n_actuators)
        signs[self.actuator] = -1.0
        return np.diag(signs)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator in words."""
        return evidence.actuators.names[self.actuator]


class GainOfAll(ActuatorCause):
    """All actuators move by another factor: another pressure of the supply, another spool."""

    name = "gain of all actuators"
    remedy = "check the supply, the unit and the radius of the spools, and fit again"
    n_parameters = 1

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return the gain of the model."""
        return [np.ones(1)]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return one."""
        return np.ones(1)

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the scaled motion (N, n) about the rest [unit of q]."""
        rest = evidence.actuators.rest
        return rest + parameters[0] * (evidence.q - rest)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the factor in words."""
        return f"all move {parameters[0]:.3g} times as far"


@dataclass(frozen=True)
class Swap(Reading):
    """Two actuators are connected to each other's place."""

    first: int
    second: int

    name = "two actuators swapped"
    remedy = "swap their cables or hoses, or their columns"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return one cause for each pair of actuators of which one moves."""
        moved = {*_moved_actuators(evidence)}
        pairs = itertools.combinations(range(evidence.n_actuators), 2)
        return [cls(i, j) for i, j in pairs if moved & {i, j}]

    def way(self, evidence: Evidence) -> NDArray:
        """Return the identity (n, n) with two columns swapped."""
        order = np.arange(evidence.n_actuators)
        order[[self.first, self.second]] = [self.second, self.first]
        return np.eye(evidence.n_actuators)[:, order]

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return both actuators in words."""
        names = evidence.actuators.names
        return f"{names[self.first]} and {names[self.second]}"


class Numbering(Reading):
    """The actuators of every segment are numbered in the other direction."""

    name = "numbering in the other direction"
    remedy = "set clockwise in every [[segment]], or list the columns in the other order"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, where a segment has more than two actuators."""
        if max(map(len, evidence.actuators.segments), default=0) < 3:
            return []
        return [cls()]

    def way(self, evidence: Evidence) -> NDArray:
        """Return the identity (n, n) with the columns of every segment reversed."""
        order = np.arange(evidence.n_actuators)
        for first, *following in evidence.actuators.segments:
            order[[first, *following]] = [first, *reversed(following)]
        return np.eye(evidence.n_actuators)[:, order]

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return no words: there is one way."""
        return ""


class AllSigns(Reading):
    """All tendons count in the other direction."""

    name = "sign of all actuators"
    remedy = "set `q_sign` in [log] of the robot description"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, if no actuator has an absolute length."""
        return [] if evidence.actuators.absolute.any() else [cls()]

    def way(self, evidence: Evidence) -> NDArray:
        """Return the negative identity (n, n)."""
        return -np.eye(evidence.n_actuators)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return no words: there is one way."""
        return ""


class Size(ActuatorCause):
    """All bends are larger or smaller, as with wrong radii."""

    name = "size of the bends"
    remedy = "check `radius` of every [[segment]] and the unit of q"
    n_parameters = 1

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return smaller and larger bends; radii that are a bit off are no fault."""
        return [np.full(1, 0.4), np.full(1, 2.5)]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return one."""
        return np.ones(1)

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the motion (N, n) with scaled bends and the same lengths [unit of q]."""
        actuators = evidence.actuators
        straight = np.broadcast_to(actuators.rest, evidence.q.shape).copy()
        for columns in actuators.segments:
            if actuators.absolute[columns].all():
                straight[:, columns] = evidence.q[:, columns].mean(axis=1, keepdims=True)
        return straight + self._factor(parameters) * (evidence.q - straight)

    def _factor(self, parameters: NDArray) -> float:
        factor = float(parameters[0])
        return max(factor, _LARGER) if factor > 1.0 else min(factor, 1.0 / _LARGER)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the factor in words."""
        return f"its bends are {self._factor(parameters):.2g} times as large"


class ZeroDrift(OneActuator):
    """The zero of one actuator drifts with time: a slipping spool, a drifting sensor."""

    name = "drift of one actuator"
    remedy = "look for a slipping spool or sensor; fit the parts of the log separately"
    n_parameters = 2

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no drift."""
        return [np.zeros(1)]

    def motion(self, evidence: Evidence, q: NDArray, parameters: NDArray) -> NDArray:
        """Return the drifting motion of the actuator (N,) [unit of q]."""
        rows = evidence.rows
        passed = (rows - evidence.rows[0]) / max(len(evidence.motion.q), 1)
        return q + parameters[0] * passed

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the actuator and its drift in words."""
        actuators = evidence.actuators
        return (
            f"{actuators.names[self.actuator]} drifts by "
            f"{actuators.amount(self.actuator, parameters[0])}"
        )


class FirstRow(ActuatorCause):
    """The robot is straight at the first row: its values there are the zeros."""

    name = "zeros at the first row"
    remedy = "set `zeros` in every [[segment]] of the robot description"

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, if the actuators have zeros and start elsewhere."""
        actuators = evidence.actuators
        away = np.abs(evidence.motion.q[0] - actuators.rest)
        if actuators.absolute.any() or (away <= _AWAY * evidence.motion.span).all():
            return []
        return [cls()]

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the motion (N, n) with the first row at rest [unit of q]."""
        return evidence.q - evidence.motion.q[0] + evidence.actuators.rest

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return what is at rest, in words."""
        return "the robot is straight at the first row"
