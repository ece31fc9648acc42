"""Following targets one step per period: tick by tick, or a whole path at once."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, as_tensor, is_numpy
from hybridkin.ik._gram import row_gram
from hybridkin.ik._settings import Array, StepSettings, require
from hybridkin.ik._step import StepRows, control_step
from hybridkin.ik.results import IKStatus, statuses
from hybridkin.ik.tasks import Tolerance

Plant = Callable[["NDArray | Tensor"], Array]


class Tracker:
    """Inverse kinematics tick by tick: a target goes in, the next command comes out.

    The law is that of `InverseKinematics.step`, for one configuration. It follows any task. Made
    by `InverseKinematics.tracker`; arrays are of the kind of its `q0`, NumPy or torch.

    Attributes
    ----------
    x : array of shape (3,)
        The model's tip at the configuration that the last step started from [m], in the shape of
        the task.
    error : float
        Distance from the tip, the measured one where it was given, to the target before the last
        step [m]; NaN where it is not known.
    saturated : bool array of shape (n,)
        Actuators that the last step held at a limit of position or speed.
    sigma_min : float
        Smallest singular value of the Jacobian there, NaN where an input was not finite.
    damping : float
        Damping lambda of the last step, in the unit of `sigma_min`.
    backend : str
        What computes: "torch".

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import InverseKinematics, robots
    >>> ik = InverseKinematics(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4)
    >>> tracker = ik.tracker(np.full(9, 0.25))
    >>> for _ in range(5):
    ...     q = tracker.step([0.1, 0.05, 0.7])  # x_measured= closes the loop; send q
    >>> tracker.status.name, int(tracker.saturated.sum())
    ('CONVERGED', 0)
    """

    backend = "torch"

    def __init__(
        self, settings: StepSettings, q0: Array, tol: Tolerance, memory: float | None
    ) -> None:
        good = memory is None or 0.0 < memory < math.inf
        require(good, f"`memory` must be a positive time [s], got {memory!r}.")
        self._settings, self._tol, self._memory = settings, tol, memory
        self._as_numpy = is_numpy(q0)
        self.reset(q0)

    def __repr__(self) -> str:
        """Return a one-line summary."""
        n = self._q.shape[1]
        return f"Tracker({n} actuators, {self.status.name}, error {self.error:.3g} m)"

    @property
    def q(self) -> NDArray | Tensor:
        """The present command, shape (n,): what the last `step` returned, or `reset` was given."""
        return self._given_back(self._q)

    @property
    def status(self) -> IKStatus:
        """Outcome of the last step.

        CONVERGED where `error` is within the tolerance (OUT_OF_DOMAIN where the model is not in its
        domain there); else AT_LIMITS where a limit held the step, SINGULAR where it was damped,
        MAX_ITER where it was free. INVALID_INPUT where the target, the measured tip or the model's
        answer was not finite, and before the first step.
        """
        task, e, last = self._settings.task, self._e, self._last
        error = e.norm(dim=-1) + 0.0 * last.sigma_min  # NaN where either is
        parts = (task.reached(e, self._tol), last.saturated.any(-1), last.damping > 0.0)
        with torch.no_grad():
            return IKStatus(int(statuses(task, self._before, error, *parts)))

    def reset(self, q: Array) -> None:
        """Start anew from an actuator vector, as read from the robot.

        Parameters
        ----------
        q : array-like of shape (n,)
            Actuator vector, in the unit of q. Outside the limits it is led back at `dq_max`.
        """
        given, settings = as_tensor(q, "q", self._settings.task.device), self._settings
        n = settings.n_actuators
        good = given.ndim == 1 and n in (None, len(given)) and torch.isfinite(given).all()
        need = f"finite and of shape ({n or 'n'},)"
        require(good, f"`q` must be {need}, got {given.tolist()}; read it from the robot.")
        self._q = given.clone()[None]
        with torch.no_grad():
            x, _ = settings.evaluate(self._q)
        self._offset = x.new_zeros(1, sum(settings.task.parts))  # of the model at the last reading
        unknown, none = torch.full_like(self._offset, math.nan), torch.zeros_like(self._q)
        self._note(x, unknown, StepRows(none, unknown[:, 0], none[:, 0], none > 0.0))

    def step(
        self, x_target: Array, dx: Array | None = None, *, x_measured: Array | None = None
    ) -> NDArray | Tensor:
        """Return the actuator vector to command next, one period ahead, eq. (1).

        Parameters
        ----------
        x_target : array-like of shape (3,)
            Present target [m], in the shape of the task.
        dx : array-like of shape (3,), optional
            Velocity of the target [m/s], one for every row of the task; (next target - target) / dt
            for second order in dt. Default: at rest.
        x_measured : array-like of shape (3,), optional
            Measured tip [m], to close the loop on. NaN is no reading: the step is feed-forward
            alone, or with `memory` goes by the model's tip, moved by the last measured offset.
            Default: the model's tip.

        Returns
        -------
        array of shape (n,)
            The command, within the limits to the last bit; the caller's to keep. Where `x_target`
            or `dx` is not finite the robot holds still.
        """
        settings, like = self._settings, self._q
        target = settings.points(x_target, "x_target", like, lead="")[None]
        feed_forward, tip = 0.0, None
        if dx is not None:
            rows = (sum(settings.task.parts),)
            feed_forward = settings.dt * settings.points(dx, "dx", like, lead="", shape=rows)
        if x_measured is not None:
            tip = settings.points(x_measured, "x_measured", like, lead="")[None]
        self._advance(target, feed_forward, tip)
        return self.q

    @torch.no_grad()
    def _advance(
        self,
        target: Tensor | None,
        feed_forward: Tensor | float,
        tip: Tensor | None,
        period: float | None = None,
    ) -> Tensor:
        """Take one step towards a target (1, ...), and return the Jacobian before it.

        A tip of None stands for the model's. Without a target the step is feed-forward alone.
        """
        settings, task = self._settings, self._settings.task
        x, J = settings.evaluate(self._q)
        error, used = torch.full_like(self._offset, math.nan), torch.zeros_like(self._offset)
        if target is not None:
            error = used = task.difference(x, target)
            if tip is not None:
                # Without a reading the model's error counts, moved by the offset that is
                # remembered; without memory no error counts.
                error = task.difference(tip, target)
                offset = used - error
                seen = torch.isfinite(offset).all(-1, keepdim=True)
                remembered = used if self._memory is None else self._offset
                used = torch.where(seen, error, used - remembered)
                self._offset = torch.where(seen, offset, self._offset)
        step = control_step(settings, self._q, J, used, feed_forward, period)
        if self._memory is not None:
            self._offset = math.exp(-(period or settings.dt) / self._memory) * self._offset
        self._note(x, error, step)
        self._q = self._q + step.dq
        return J

    def _note(self, x: Tensor, e: Tensor, step: StepRows) -> None:
        """Keep what is known of the last step: what is shown to the user is their own copy."""
        self._before, self._x, self._e, self._last = self._q, x, e, step
        self.x, self.saturated = self._given_back(x), self._given_back(step.saturated)
        self.error, self.sigma_min = float(e.norm(dim=-1)), float(step.sigma_min)
        self.damping = float(step.damping)

    def _given_back(self, row: Tensor) -> NDArray | Tensor:
        return as_array(row[0]).copy() if self._as_numpy else row[0].clone()

    def follow(
        self,
        targets: Tensor,
        periods: list[float],
        plant: Plant | None,
        feedback: str | None,
        progress: Callable[[int, int], None] | None,
    ) -> list[Tensor]:
        """Return q, x, the measured tip, sigma_min, and whether limits or damping held the step.

        Rows are the points of the path (T, ...), with what was seen before the step that leaves
        them; held and damped is the step that led there.
        """
        task, n = self._settings.task, len(targets)
        ahead = task.difference(targets, torch.cat([targets[1:], targets[-1:]]))
        ahead = torch.where(torch.isfinite(ahead).all(-1, keepdim=True), ahead, 0.0)
        known = torch.isfinite(targets.flatten(1)).all(-1).tolist()
        unread = torch.full_like(targets[:1], math.nan)
        held = damped = torch.zeros(1, dtype=torch.bool, device=targets.device)
        rows = []
        for i, target in enumerate(targets.split(1)):
            if progress is not None:
                progress(i, n)
            tip = None if plant is None else self._measured(plant, i)
            used = {"model": None, "measured": tip, None: unread}[feedback]
            q = self._q
            J = self._advance(target if known[i] else None, ahead[i : i + 1], used, periods[i])
            seen = self._x if tip is None else tip
            rows.append((q, self._x, seen, row_gram(J).sigma_min, held, damped))
            held, damped = self._last.saturated.any(-1), self._last.damping > 0.0
        return [torch.cat(parts) for parts in zip(*rows, strict=True)]

    def _measured(self, plant: Plant, i: int) -> Tensor:
        """Return the plant's tip (1, ...), NaN where the plant raises.

        The plant is the user's robot, and may fail with any exception: the motion goes on, so that
        the rows before it are not lost.
        """
        try:
            return self._settings.points(plant(self.q), "tip", self._q, lead="")[None]
        except Exception as error:
            warnings.warn(
                f"`plant` failed at point {i}: {error!r}; it counts as NaN.", stacklevel=6
            )
            return self._q.new_full((1, *self._settings.task.shape), math.nan)
