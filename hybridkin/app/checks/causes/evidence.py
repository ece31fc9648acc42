"""The evidence of which cause an error has: a motion, a model, and the tips that were measured."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin import ForwardModel, robots
from hybridkin.app.checks.causes.alignment import Alignment
from hybridkin.app.checks.causes.motion import Motion
from hybridkin.native import evaluate

_ENDS = 0.05  # of the rows: nothing changes this near to an end
_STEPS = 3  # largest steps of the residual that are tried
_FAR = 0.5  # domain distances beyond 1 over which the mechanical model takes over


class Actuators(NamedTuple):
    """The actuators of a robot, and the words for their changes.

    Attributes
    ----------
    names : sequence of str
        Names of the n actuators.
    unit : str
        Unit of their changes in words, "" for numbers.
    per_unit : ndarray of shape (n,)
        Change of q for a change of one such unit.
    layout : ActuatorLayout
        Rest, kind and segment of every actuator.
    """

    names: Sequence[str]
    unit: str
    per_unit: NDArray
    layout: robots.ActuatorLayout

    @property
    def rest(self) -> NDArray:
        """The q (n,) without any effect [unit of q]."""
        return self.layout.rest

    @property
    def absolute(self) -> NDArray:
        """Which actuators (n,) have lengths in place of changes of length, bool."""
        return self.layout.absolute

    @property
    def signed(self) -> NDArray:
        """Which actuators (n,) can be read with a wrong sign, bool."""
        return self.layout.signed

    @property
    def segments(self) -> list[list[int]]:
        """The actuators of every segment, in order of their angles."""
        return self.layout.segments

    def amount(self, i: int, change: float) -> str:
        """Return a change of actuator i [unit of q] in words."""
        return f"{change / self.per_unit[i]:+.3g} {self.unit}".rstrip()


@dataclass(frozen=True, eq=False, kw_only=True)
class Evidence:
    """A motion of the actuators, a model of the robot, and the tips that were measured.

    Attributes
    ----------
    motion : Motion
        What the actuators did, by all that is known.
    rows : ndarray of shape (N,) of int
        Row of the motion at which each tip was measured, ascending.
    x : ndarray of shape (N, 3)
        The measured tips [m].
    model : ForwardModel
        Motion of the actuators -> tip [m].
    path : ndarray of shape (T, 3)
        Tips of the model along the whole motion [m].
    bodies : sequence of ForwardModel
        The mechanical part of the model, for commands far from its training rows, then robots that
        do alike for such rows and not elsewhere.
    body : int
        Number of the one to use.
    actuators : Actuators
        Names, unit and rest of the actuators.
    inside : ndarray of shape (N,) of bool
        Whether the model knows commands like these.
    off_plane : ndarray of shape (N, n)
        Part of the motion along directions of which the model knows nothing [unit of q].
    promised : float
        Mean error that the model promises [m]; 0 if it does not say.
    low, high : ndarray of shape (n,)
        The range of the actuators' motion, for motions that separate two causes [unit of q].
    alignment : Alignment
        What is unknown of the measuring frame.
    """

    motion: Motion
    rows: NDArray
    x: NDArray
    model: ForwardModel
    path: NDArray
    bodies: Sequence[ForwardModel]
    actuators: Actuators
    inside: NDArray
    off_plane: NDArray
    promised: float
    low: NDArray
    high: NDArray
    alignment: Alignment = field(default_factory=Alignment)
    body: int = 0

    @property
    def mechanical(self) -> ForwardModel:
        """The mechanical model for commands far from the training rows."""
        return self.bodies[self.body]

    @property
    def n_actuators(self) -> int:
        """Number of actuators."""
        return self.motion.q.shape[1]

    @cached_property
    def q(self) -> NDArray:
        """What the actuators did at the measured tips, (N, n)."""
        return self.motion.q[self.rows]

    @property
    def tips(self) -> NDArray:
        """Tips (N, 3) of the model [m]."""
        return self.path[self.rows]

    @cached_property
    def jacobian(self) -> NDArray:
        """Derivative (N, 3, n) of the tips by the motion [m / unit of q]."""
        model = self.mechanical if self.body > 0 else self.model
        return evaluate(model, self.q, jacobian=True)[1]

    @cached_property
    def compliance(self) -> NDArray:
        """How the tip gives way to a force at it (N, 3, 3), up to a factor."""
        with torch.no_grad():
            columns = self.bodies[0].compliance_columns(torch.from_numpy(self.q))
        columns = columns.numpy()
        return columns @ columns.transpose(0, 2, 1)

    @cached_property
    def _mechanical_tips(self) -> NDArray:
        return evaluate(self.mechanical, self.q)[0]

    @cached_property
    def size(self) -> float:
        """Rms distance of the model's tips from their mean [m]."""
        return float(np.sqrt(self.tips.var(axis=0).sum()))

    def at(self, q: NDArray) -> NDArray:
        """Return the tips (N, 3) if the actuators had done q (N, n) in place of `self.q` [m].

        Far from its training rows a learned part knows nothing: there the mechanical model says how
        the tips change.
        """
        if self.body > 0:
            return self.tips + evaluate(self.mechanical, q)[0] - self._mechanical_tips
        if self.model is self.mechanical:
            return evaluate(self.model, q)[0]
        tips, distance = evaluate(self.model, q, distance=True)
        if (distance <= 1.0).all():
            return tips
        change = evaluate(self.mechanical, q)[0] - self._mechanical_tips
        far = np.clip((distance[:, None] - 1.0) / _FAR, 0.0, 1.0)
        return (1.0 - far) * tips + far * (self.tips + change)

    def sudden_rows(self, gain: NDArray) -> list[int]:
        """Return the rows of the motion at which something may have changed for good.

        They are the place of the largest gain (N,), and those of the largest steps of the residual,
        not near an end.
        """
        n_rows = len(self.rows)
        first = max(1, int(_ENDS * n_rows))
        inner = np.arange(first, n_rows - first)
        if not len(inner):
            return []
        residual = self.x - self.tips
        steps = np.linalg.norm(residual[inner] - residual[inner - 1], axis=1)
        places = [inner[gain[inner].argmax()], *inner[np.argsort(steps)[-_STEPS:]]]
        return sorted({int(self.rows[place]) for place in places})

    def with_body(self, body: int) -> Self:
        """Return the evidence with another mechanical model."""
        return replace(self, body=body)

    def some(self, chosen: NDArray) -> Self:
        """Return the evidence of some of the measured tips: places or a mask (N,)."""
        return replace(
            self,
            rows=self.rows[chosen],
            x=self.x[chosen],
            inside=self.inside[chosen],
            off_plane=self.off_plane[chosen],
        )

    def followed_by(self, q: NDArray, period: float) -> Self:
        """Return the evidence of a further motion q (K, n), one row each `period`, without tips."""
        before = self.motion
        n_rows = len(q)
        n_before = len(before.q)
        later = before.time[-1] + period * (1.0 + np.arange(n_rows))
        motion = Motion(
            np.concatenate([before.q, q]),
            np.concatenate([before.time, later]),
            np.concatenate([before.runs, np.repeat(before.runs[-1:], n_rows)]),
            before.clock,
        )
        tips, *_ = evaluate(self.model, q)
        return replace(
            self,
            motion=motion,
            path=np.concatenate([self.path, tips]),
            rows=n_before + np.arange(n_rows),
            x=np.zeros((n_rows, 3)),
            inside=np.ones(n_rows, dtype=bool),
            off_plane=np.zeros_like(q),
        )
