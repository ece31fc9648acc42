"""Following targets with one step per period: step by step, or a whole path at once."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, as_tensor, is_numpy, number
from hybridkin._core.model import Portable
from hybridkin.ik._compiled import Follower, Tick, core_of, why_torch
from hybridkin.ik._gram import row_gram
from hybridkin.ik._hysteresis import Lead
from hybridkin.ik._settings import Array, StepSettings, require
from hybridkin.ik._step import StepRows, control_step
from hybridkin.ik.results import IKStatus, statuses
from hybridkin.ik.tasks import Tolerance

Plant = Callable[["NDArray | Tensor"], Array]


class Tracker(Portable):
    """Inverse kinematics step by step: each target gives the next command.

    The law is that of `InverseKinematics.step`, for one configuration and any task. Trackers are
    made by `InverseKinematics.tracker`; arrays are NumPy or torch, like its `q0`. It keeps a copy
    of the model from `reset`, but a refit of an estimator reaches it at the next `step`: `q` and
    its speed stay, a remembered offset is forgotten. Threads that share it wait for each other.

    With the hysteresis of a `HybridForwardModel` (`play_`) commands lead what the actuators do. All
    limits are those of commands. After a reversal the command crosses the width of the hysteresis,
    with `dq_max` in several periods, in which the actuator moves little or not and the others do
    what they can. With `ddq_max` it brakes before it gets to where the actuator moves. A motion of
    less than 1e-6 of the way of its command is left out, as it may be rounding. A refit with
    another operator starts without hysteresis at `q`.

    Attributes
    ----------
    q : array of shape (n,)
        The present command: the result of the last `step`, or the argument of `reset`.
    effective : array of shape (n,)
        What the actuators do, where the model is evaluated [unit of q]: `q` without hysteresis.
    state : array of shape (R, n) or None
        State of the hysteresis after that command, for `reset` [unit of q]; None without.
    x : array of shape (3,)
        The model's tip at the start of the last step [m], in the shape of the task.
    error : float
        Distance from the tip, the measured one if it was given, to the target before the last step
        [m]; NaN if unknown.
    saturated : bool array of shape (n,)
        Actuators that the last step held at a limit of position, speed or acceleration.
    sigma_min : float
        Smallest singular value of the Jacobian there, NaN if an input was not finite.
    damping : float
        Damping lambda of the last step, in the unit of `sigma_min`.
    backend : str
        "compiled" for NumPy and models that have kernels, else "torch: " and the reason.

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

    def __init__(
        self,
        settings: StepSettings,
        q0: Array,
        tol: Tolerance,
        memory: float | None,
        state: Any = None,
    ) -> None:
        if memory is not None:
            memory = number(memory, "memory")
        good = memory is None or 0.0 < memory < math.inf
        require(good, f"`memory` must be a positive time [s], got {memory!r}.")
        self._settings = settings
        self._tol = tol
        self._memory = memory
        self._as_numpy = is_numpy(q0)
        self._lock = Lock()  # of the state, for threads that share the tracker
        self._reset(q0, state)

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._lock = Lock()

    def __repr__(self) -> str:
        """Return a one-line summary."""
        n = len(self.q)
        return f"Tracker({n} actuators, {self.status.name}, error {self.error:.3g} m)"

    @property
    def backend(self) -> str:
        """What computes the steps: "compiled", or "torch: " and the reason."""
        return self._robot.backend

    @property
    def q(self) -> NDArray | Tensor:
        """The present command, shape (n,)."""
        with self._lock:
            return self._robot.command()

    @property
    def effective(self) -> NDArray | Tensor:
        """What the actuators do at the present command, shape (n,)."""
        with self._lock:
            return self._robot.effective()

    @property
    def state(self) -> Any:
        """State of the hysteresis after the present command, as from `apply` of `play_`."""
        with self._lock:
            return self._robot.hysteresis

    @property
    def x(self) -> NDArray | Tensor:
        """The model's tip before the last step [m], in the shape of the task."""
        return _given_back(self._last().x, self._as_numpy)

    @property
    def saturated(self) -> NDArray | Tensor:
        """Actuators that the last step held at a limit, bool (n,)."""
        return _given_back(self._last().step.saturated, self._as_numpy)

    @property
    def error(self) -> float:
        """Distance from the tip, measured or the model's, to the target [m]."""
        return float(self._last().e.norm())

    @property
    def sigma_min(self) -> float:
        """Smallest singular value of the Jacobian before the last step."""
        return float(self._last().step.sigma_min)

    @property
    def damping(self) -> float:
        """Damping lambda of the last step, in the unit of `sigma_min`."""
        return float(self._last().step.damping)

    def _last(self) -> Tick:
        with self._lock:
            return self._robot.last()

    @property
    def status(self) -> IKStatus:
        """Outcome of the last step.

        CONVERGED if `error` is within the tolerance, or OUT_OF_DOMAIN if the configuration is
        outside the model's domain. Else AT_LIMITS if a limit restricted the step, SINGULAR if it
        was damped or no motion is possible, MAX_ITER otherwise. INVALID_INPUT before the first
        step, and if the target, the measured tip or the model's output was not finite.
        """
        last = self._last()
        step = last.step
        with torch.no_grad():
            status = statuses(
                self._robot.task,
                last.q,
                last.e,
                self._tol,
                known=torch.isfinite(step.sigma_min),
                held=step.held,
                singular=step.damped,
            )
        return IKStatus(int(status))

    def reset(self, q: Array, state: Any = None) -> None:
        """Restart at rest from an actuator vector, as read from the robot.

        Parameters
        ----------
        q : array-like of shape (n,)
            Command, in the unit of q. From outside the limits it returns at `dq_max`.
        state : array of shape (R, n), optional
            State of the hysteresis [unit of q]: `state` of a tracker, or as from `apply` of the
            model's `play_` with the commands until now. Default: without hysteresis at q.
        """
        self._reset(q, state)
        for message in self._settings.posture_messages(as_tensor(q, "q"), "q"):
            warnings.warn(message, stacklevel=2)

    def _reset(self, q: Array, state: Any) -> None:
        start = as_tensor(q, "q", self._settings.task.device)
        n = self._settings.n_actuators
        right_shape = start.ndim == 1 and n in (None, len(start))
        require(
            right_shape and torch.isfinite(start).all(),
            f"`q` must be finite and of shape ({n or 'n'},), got {start.tolist()}; read it from "
            "the robot.",
        )
        with self._lock:
            self._like = start.clone()
            self._unseen = {"x_target", "x_measured"}
            self._start(self._like, torch.zeros_like(start), state)

    def _start(self, q: Tensor, dq: Tensor, hysteresis: Any) -> None:
        """Read the model, and start at q (n,) after a step dq (n,)."""
        self._settings = settings = self._settings.present()
        core = core_of(settings)
        task = settings.task
        if core is None:
            reason = why_torch(settings)
            robot = _InTorch(settings, self._memory, self._as_numpy, reason)
        elif self._as_numpy and q.dtype == torch.float64:
            robot = Follower(core, self._memory)
        else:
            reason = "`q0` is no float64 array of NumPy"
            robot = _InTorch(settings, self._memory, self._as_numpy, reason)
        require(
            hysteresis is None or task.hysteresis is not None,
            "`state` is that of a hysteresis, but the model has none; leave it out.",
        )
        robot.start(q[None], dq[None], hysteresis)
        self._estimator = task.estimator
        self._module = task.module
        self._robot = robot

    def step(
        self,
        x_target: Array,
        dx: Array | None = None,
        *,
        x_measured: Array | None = None,
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
            Measured tip [m] for feedback. NaN means no measurement: the step is then feed-forward
            only, or with `memory` uses the model's tip plus the last measured offset. Default: the
            model's tip.

        Returns
        -------
        array of shape (n,)
            The command, exactly within the limits; a new array. If `x_target` or `dx` is not
            finite, the robot stops (with `ddq_max` it brakes first).
        """
        with self._lock:
            estimator = self._estimator
            if estimator is not None and estimator.module_ is not self._module:
                robot = self._robot
                before = robot.task.hysteresis
                state = robot.hysteresis
                if getattr(estimator, "play_", None) is not before:
                    state = None
                q = as_tensor(robot.command(), "q")
                self._start(q, robot.last().step.dq[0], state)
            if "x_target" in self._unseen:
                self._look("x_target", x_target)
            if x_measured is not None and self._unseen:
                self._look("x_measured", x_measured)
            robot = self._robot
            if not robot.tick(x_target, dx, x_measured):
                self._step(x_target, dx, x_measured)
            return robot.command()

    def _look(self, name: str, value: Array) -> None:
        """Warn if the first target or tip after `reset` has another unit than the robot."""
        points = self._settings.points(value, name, lead="")
        if not torch.isfinite(points).all():
            return
        self._unseen.discard(name)
        for message in self._settings.far_messages(points, name):
            warnings.warn(message, stacklevel=3)

    def _step(
        self, x_target: Array, dx: Array | None, x_measured: Array | None
    ) -> None:
        """Do a step with arguments that need full checks."""
        settings = self._settings
        like = self._like
        target = settings.points(x_target, "x_target", like, lead="")
        feed_forward = None
        if dx is not None:
            shape = (sum(settings.task.parts),)
            velocity = settings.points(dx, "dx", like, lead="", shape=shape)
            feed_forward = settings.dt * velocity[None]
        tip = None
        if x_measured is not None:
            tip = settings.points(x_measured, "x_measured", like, lead="")[None]
        self._robot.advance(None, target[None], feed_forward, tip)

    def follow(
        self,
        targets: Tensor,
        periods: list[float],
        plant: Plant | None,
        feedback: str | None,
        progress: Callable[[int, int], None] | None,
    ) -> list[Tensor]:
        """Return commands, what the actuators do, x, the measured tip, sigma_min, held and damped.

        Rows are the points of the path (T, ...). The last two are whether the step to the point was
        held or damped, all others refer to the state at the point.
        """
        task = self._settings.task
        n = len(targets)
        following = torch.cat([targets[1:], targets[-1:]])
        ahead = task.difference(targets, following)
        countable = torch.isfinite(ahead).all(-1, keepdim=True)
        ahead = torch.where(countable, ahead, 0.0)
        finite = torch.isfinite(targets.flatten(1)).all(-1).tolist()
        unread = torch.full_like(targets[:1], math.nan)
        held = damped = torch.zeros(1, dtype=torch.bool, device=targets.device)
        rows = []
        for i, target in enumerate(targets.split(1)):
            if progress is not None:
                progress(i, n)
            tip = None
            if plant is not None:
                tip = self._measured(plant, i)
            used = {"model": None, "measured": tip, None: unread}[feedback]
            command = torch.as_tensor(self._robot.command())[None]  # a copy
            if not finite[i]:
                target = None
            tick = self._robot.advance(periods[i], target, ahead[i : i + 1], used)
            if tip is None:
                tip = tick.x
            rows.append((command, tick.q, tick.x, tip, tick.J, held, damped))
            held = tick.step.held
            damped = tick.step.damped
        *states, J, held, damped = map(torch.cat, zip(*rows, strict=True))
        return [*states, row_gram(J).sigma_min, held, damped]

    def _measured(self, plant: Plant, i: int) -> Tensor:
        """Return the plant's tip (1, ...), NaN if the plant raises.

        The plant is the user's robot and may raise any exception. The motion continues, so that
        earlier rows are not lost.
        """
        try:
            tip = plant(self.q)
            return self._settings.points(tip, "tip", self._like, lead="")[None]
        except Exception as error:
            warnings.warn(
                f"`plant` failed at point {i}: {error!r}; its tip is NaN.", stacklevel=7
            )
            return self._like.new_full((1, *self._settings.task.shape), math.nan)


class _InTorch:
    """The torch counterpart of `Follower`, for any task."""

    def __init__(
        self, settings: StepSettings, memory: float | None, as_numpy: bool, reason: str
    ) -> None:
        self._memory = memory
        self._as_numpy = as_numpy
        self.backend = f"torch: {reason}"
        self.task = settings.task.frozen()
        self._settings = replace(settings, task=self.task)
        self._lead: Lead | None = None

    @property
    def hysteresis(self) -> Any:
        """State of the hysteresis, None without."""
        if self._lead is None:
            return None
        return _given_back(self._lead.state[None], self._as_numpy)

    @torch.no_grad()
    def start(self, q: Tensor, dq: Tensor, hysteresis: Any) -> None:
        """Set the initial command (1, n), the step to it, and the state of hysteresis before it."""
        self._command = q
        if self.task.hysteresis is not None:
            self._lead = Lead(self._settings, self.task.hysteresis, q, hysteresis)
            q = self._lead.effective
        self._q = q
        x, J = self._settings.evaluate(q)
        self._offset = x.new_zeros(1, sum(self.task.parts))  # last measured minus model
        unknown = torch.full_like(self._offset, math.nan)
        undamped = torch.zeros_like(q[:, 0])
        free = torch.zeros_like(q, dtype=torch.bool)
        step = StepRows(dq, unknown[:, 0], undamped, free)
        self._period = self._settings.dt  # of the last step
        self._last = Tick(q, x, J, unknown, step)

    def tick(self, target: Array, dx: Array | None, tip: Array | None) -> bool:
        """Return False: all arguments need full checks."""
        return False

    @torch.no_grad()
    def advance(
        self,
        period: float | None,
        target: Tensor | None,
        feed_forward: Tensor | None,
        tip: Tensor | None,
    ) -> Tick:
        """Take one step towards a target (1, ...), and return its results.

        If `tip` is None the model's is used. Without a target the step is feed-forward only.
        """
        settings = self._settings
        task = self.task
        x, J = settings.evaluate(self._q)
        error = torch.full_like(self._offset, math.nan)
        used = torch.zeros_like(self._offset)
        if target is not None:
            error = used = task.difference(x, target)
            if tip is not None:
                # Without a measurement, use the model's error corrected by the remembered offset;
                # without memory, use no error.
                error = task.difference(tip, target)
                offset = used - error
                finite = torch.isfinite(offset).all(-1, keepdim=True)
                remembered = used if self._memory is None else self._offset
                used = torch.where(finite, error, used - remembered)
                self._offset = torch.where(finite, offset, self._offset)
        seconds = period or settings.dt
        last = self._last.step.dq * (seconds / self._period)
        at = None
        if settings.tip_limits is not None:
            at = x + self._offset
        control = partial(
            control_step, settings, self._q, J, used, feed_forward, seconds, last, at
        )
        effective = self._q
        if self._lead is not None:
            step = self._lead.step(control, seconds, last)
            self._command = self._lead.command
            self._q = self._lead.effective
        else:
            step = control()
            self._command = self._q = effective + step.dq
        if self._memory is not None:
            self._offset = math.exp(-seconds / self._memory) * self._offset
        self._last = Tick(effective, x, J, error, step)
        self._period = seconds
        return self._last

    def last(self) -> Tick:
        """Return the results of the last tick."""
        return self._last

    def command(self) -> NDArray | Tensor:
        """Return the present command (n,)."""
        return _given_back(self._command, self._as_numpy)

    def effective(self) -> NDArray | Tensor:
        """Return what the actuators do (n,)."""
        return _given_back(self._q, self._as_numpy)


def _given_back(rows: Tensor, as_numpy: bool) -> NDArray | Tensor:
    """Return a copy of a single row (1, ...) in the type of the caller's arrays."""
    return as_array(rows[0]).copy() if as_numpy else rows[0].clone()
