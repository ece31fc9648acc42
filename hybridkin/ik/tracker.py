"""Following a path, one step per point: for a whole path at once, or tick by tick."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import as_array, as_tensor, give_back
from hybridkin.ik._gram import row_gram
from hybridkin.ik._step import Law, Move
from hybridkin.ik.results import Step

FEEDBACKS = ("model", "measured", None)
_Rates = Callable[["float | None"], "tuple[float, float, float]"]


class _Look(NamedTuple):
    """What is known of one point before the step that leaves it."""

    q: Tensor
    x: Tensor
    measured: Tensor
    sigma_min: Tensor
    held: Tensor
    damped: Tensor


class Tracker:
    """A path followed tick by tick, for controllers; made by `InverseKinematics.tracker`.

    Attributes
    ----------
    q : array of shape (n,)
        The configuration to command now.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, robots
    >>> ik = InverseKinematics(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4, dt=0.02)
    >>> path = np.linspace([0.0, 0.0, 0.75], [0.1, 0.0, 0.75], 50)
    >>> tracker = ik.tracker(path[0])
    >>> for point in path[1:]:
    ...     step = tracker.tick(point)  # give x_measured= to close the loop; send tracker.q
    >>> bool(np.linalg.norm(step.x - path[-2]) < 1e-4)
    True
    """

    def __init__(
        self,
        law: Law,
        rates: _Rates,
        q: Tensor,
        target: Tensor,
        feedback: str | None,
        memory: float | None,
        as_numpy: bool,
    ) -> None:
        self._law, self._rates, self._feedback, self._as_numpy = law, rates, feedback, as_numpy
        self._q, self._target, self._memory = q, target, memory
        self._missed: Any = 0.0  # by the model, at the last reading or what is left of it
        no = torch.zeros(1, dtype=torch.bool, device=q.device)
        self._held, self._damped = no, no

    @property
    def q(self) -> Any:
        """The configuration to command now, shape (n,)."""
        return as_array(self._q[0]).copy() if self._as_numpy else self._q[0].clone()

    @torch.no_grad()
    def tick(self, x_next: Any, x_measured: Any = None, period: float | None = None) -> Step:
        """Move `q` on by one period, eq. (1), towards the next point of the path.

        Parameters
        ----------
        x_next : array-like of shape (3,)
            The point of the next tick [m]; the difference to the present one is the feed-forward.
        x_measured : array-like of shape (3,), optional
            Tip measured at `q` [m], needed for feedback="measured"; NaN is no reading.
        period : float, optional
            Time to the next tick [s]. Default: `dt`.

        Returns
        -------
        Step
            With x and the error at `q` before the step, with respect to the present point.
        """
        if self._feedback == "measured" and x_measured is None:
            raise ValueError(
                '`x_measured` must be given for feedback="measured"; NaN says no reading.'
            )
        goal, tip = (self._point(a, name) for a, name in ((x_next, "x_next"), (x_measured, "tip")))
        assert goal is not None
        look, error, move = self._tick(goal, tip, period)
        parts = (move.dq, look.x, error, look.sigma_min, move.damping, move.saturated, move.scale)
        return Step(*give_back(parts, (), self._as_numpy))

    def _point(self, value: Any, name: str) -> Tensor | None:
        if value is None:
            return None
        point, shape = as_tensor(value, name, self._q.device), self._law.task.shape
        if point.shape != shape:
            raise ValueError(f"`{name}` must have shape {shape}, got {tuple(point.shape)}.")
        return point.to(self._q)[None]

    def _tick(
        self, goal: Tensor | None, tip: Tensor | None, period: float | None
    ) -> tuple[_Look, Tensor, Move]:
        """Look, then step; without a goal the error is all that is wanted."""
        task, law = self._law.task, self._law
        x, J = law.evaluate(self._q)
        seen = x if tip is None else tip
        gram = row_gram(J)
        look = _Look(self._q, x, seen, gram.sigma_min, self._held, self._damped)
        goal = self._target if goal is None else goal
        e = task.difference(seen if self._feedback == "measured" else x, self._target)
        error = e.norm(dim=-1)
        v = _known(task.difference(self._target, goal))
        gain, beta, seconds = self._rates(period)
        if self._memory is not None:
            e = self._remembered(e, task.difference(x, self._target), seconds, self._memory)
        if self._feedback is not None:
            v = v + gain * _known(e)
        move = law.advance(self._q, J, v, beta, seconds)
        self._q, self._target = self._q + move.dq, goal
        self._held, self._damped = move.saturated.any(-1), move.damping > 0.0
        return look, error, move

    def _remembered(self, e: Tensor, e_model: Tensor, seconds: float, memory: float) -> Tensor:
        """Return the error by the reading, or by the model moved as far as the last one told."""
        seen = torch.isfinite(e).all(-1, keepdim=True)
        missed = _known(torch.where(seen, e_model - e, self._missed))
        self._missed = math.exp(-seconds / memory) * missed
        return torch.where(seen, e, e_model - missed)

    def follow(
        self,
        targets: Tensor,
        periods: list[float],
        plant: Callable[[Any], Any] | None,
        progress: Callable[[int, int], None] | None,
    ) -> tuple[Tensor, ...]:
        """Return what was seen at every point of a path (T, ...): the fields of a look, stacked."""
        looks: list[_Look] = []
        for i in range(len(targets)):
            if progress is not None:
                progress(i, len(targets))
            tip = None if plant is None else self._measure(plant, i)
            end = i + 1 == len(targets)
            goal = None if end else targets[i + 1 : i + 2].to(self._q)
            looks.append(self._tick(goal, tip, None if end else periods[i])[0])
        return tuple(torch.cat(parts) for parts in zip(*looks, strict=True))

    def _measure(self, plant: Callable[[Any], Any], i: int) -> Tensor:
        """Return the plant's tip (1, ...), NaN where it fails: what was done must not be lost."""
        shape = self._law.task.shape
        try:
            tip = as_tensor(plant(self.q), "tip", self._q.device)
            if tip.shape != shape:
                raise ValueError(
                    f"the measured tip must have shape {shape}, got {tuple(tip.shape)}"
                )
        except Exception as error:
            message = f"`plant` failed at point {i}: {error!r}; it counts as NaN."
            warnings.warn(message, stacklevel=5)
            return self._q.new_full((1, *shape), math.nan)
        return tip.to(self._q)[None]


def _known(v: Tensor) -> Tensor:
    """Return v, or zero where the target or the measured tip is not known."""
    return torch.where(torch.isfinite(v).all(-1, keepdim=True), v, 0.0)
