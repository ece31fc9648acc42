"""Following targets with one step per period: step by step, or a whole path at once."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from threading import Lock
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, as_tensor, is_numpy, number
from hybridkin._core.kernel_numbers import IK_ON_TIME
from hybridkin._core.portable import Portable
from hybridkin.ik._compiled import Follower, Tick, own_core_of, why_torch
from hybridkin.ik._feedback import MOST_PERIODS, Feedback, Readings
from hybridkin.ik._gram import row_gram
from hybridkin.ik._hysteresis import lead_of
from hybridkin.ik._rest import at_start
from hybridkin.ik._settings import Array, StepSettings, require
from hybridkin.ik._step import StepRows, control_step
from hybridkin.ik.obstacles import Obstacle, as_numbers, as_scene
from hybridkin.ik.results import IKStatus, statuses
from hybridkin.ik.tasks import Tolerance

Plant = Callable[["NDArray | Tensor"], Array]


class Tracker(Portable):
    """Inverse kinematics step by step: each target gives the next command.

    The law is that of `InverseKinematics.step`, for one configuration and any task. Trackers are
    made by `InverseKinematics.tracker`; arrays are NumPy or torch, like its `q0`. It keeps a copy
    of the model from `reset`, but a refit of an estimator reaches it at the next `step`: `q` and
    its speed stay, the offset is forgotten. Threads that share it wait for each other.

    A measured tip (`x_measured`) is compared with the model's tip of its own time, and the model's
    present tip moved by the resulting offset is what goes to the target. With the default gain the
    offset takes a fifth of what each reading shows beyond it, which is stable for readings up to
    four periods late that nobody knows of, and averages noise. With a `gain` it takes all: give
    `delay`, or the time of each reading (`at`), if they are late. Readings that are not plausible
    are not used (`rejected`): those farther off than 3 % of the reach (or two error radii of a
    model with `coverage`), 0.2 rad, and the motion of the last eight periods. Five in a row that
    agree are believed, unless they are more than twice the reach away. (Without a chain the tips
    within the limits of q give the reach; where q has none either, all readings are used.)

    With a `hysteresis` of the model commands lead what the actuators do. All
    limits are those of commands. After a reversal the command crosses the width of the hysteresis,
    with `dq_max` in several periods, in which the actuator moves little or not and the others do
    what they can. With `ddq_max` it brakes before it gets to where the actuator moves. A motion of
    less than 1e-6 of the way of its command is left out, as it may be rounding. A refit with
    another one starts without hysteresis at `q`.

    Attributes
    ----------
    q : array of shape (n,)
        The present command: the result of the last `step`, or the argument of `reset`.
    effective : array of shape (n,)
        What the actuators do, where the model is evaluated [unit of q]: `q` without hysteresis.
    state : array of shape (R, n)
        State of the hysteresis after that command, for `reset` [unit of q]; no rows without one.
    x : array of shape (3,)
        The model's tip at the start of the last step [m], in the shape of the task.
    error : float
        Distance from the tip, the measured one if it was given, to the target before the last step
        [m]; NaN if unknown. A late tip is moved by what the model moved since then.
    time : float
        Time of the present command since `reset` [s]: the clock of `at`.
    rejected : bool
        Whether the measured tip of the last step was not used, because it is not plausible.
    saturated : bool array of shape (n,)
        Actuators that the last step held at a limit of position, speed or acceleration.
    sigma_min : float
        Smallest singular value of the Jacobian there, NaN if an input was not finite.
    damping : float
        Damping lambda of the last step, in the unit of `sigma_min`.
    obstacles : tuple of Obstacle
        The obstacles where they are now. Set as many others before a `step` to move them.
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
        feedback: Feedback,
        state: Any = None,
    ) -> None:
        self._settings = settings
        self._tol = tol
        self._feedback = feedback
        self._as_numpy = is_numpy(q0)
        self._obstacles = settings.obstacles
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
        """State of the hysteresis after the present command, as from its `apply`."""
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
    def time(self) -> float:
        """Time of the present command since `reset` [s]."""
        return self._time

    @property
    def rejected(self) -> bool:
        """Whether the last step did not use its measured tip, as it is not plausible."""
        return self._last().rejected

    @property
    def sigma_min(self) -> float:
        """Smallest singular value of the Jacobian before the last step."""
        return float(self._last().step.sigma_min)

    @property
    def damping(self) -> float:
        """Damping lambda of the last step, in the unit of `sigma_min`."""
        return float(self._last().step.damping)

    @property
    def obstacles(self) -> tuple[Obstacle, ...]:
        """The obstacles where they are now; set as many others to move them."""
        return self._obstacles

    @obstacles.setter
    def obstacles(self, value: Sequence[Obstacle]) -> None:
        obstacles = as_scene(value)
        before = len(self._settings.obstacles)
        require(
            len(obstacles) == before,
            f"`obstacles` must be as many as before, {before}, got {len(obstacles)}; give "
            "InverseKinematics as many as there may be, those not needed far away.",
        )
        with self._lock:
            self._place(obstacles)

    def _place(self, obstacles: tuple[Obstacle, ...]) -> None:
        """Take obstacles to where they are now."""
        self._obstacles = obstacles
        self._scene = as_numbers(obstacles)
        self._robot.scene = self._scene

    def _last(self) -> Tick:
        with self._lock:
            return self._robot.last()

    @property
    def status(self) -> IKStatus:
        """Outcome of the last step.

        CONVERGED if `error` is within the tolerance, or OUT_OF_DOMAIN if the configuration is
        outside the model's domain. Else AT_LIMITS if a limit restricted the step, SINGULAR if it
        was damped or no motion is possible, MAX_ITER otherwise. INVALID_INPUT before the first
        step, and if the target, the measured tip or the model's output was not finite, or the
        measured tip was rejected.
        """
        last = self._last()
        step = last.step
        known = torch.isfinite(step.sigma_min) & (not last.rejected)
        with torch.no_grad():
            status = statuses(
                self._robot.task,
                last.q,
                last.e,
                self._tol,
                known=known,
                held=step.held,
                singular=step.damped,
                blocked=step.blocked,
                inside=self._settings.clear.is_inside(last.q, self._scene),
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
            model's hysteresis with the commands until now. Default: without hysteresis at q.
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
        known = bool(self._settings.present().task.hysteresis)
        require(
            known or state is None or not len(state),
            "`state` is that of a hysteresis, but the model has none; leave it out.",
        )
        with self._lock:
            self._like = start.clone()
            self._unseen = {"x_target", "x_measured"}
            self._time = 0.0
            self._start(self._like, None, state)

    def _start(self, q: Tensor, dq: Tensor | None, hysteresis: Any) -> None:
        """Read the model, and start at q (n,), after a step dq (n,) or at rest."""
        self._settings = settings = self._settings.present()
        core = own_core_of(settings)
        task = settings.task
        if core is None:
            reason = why_torch(settings)
            robot = _InTorch(settings, self._feedback, self._as_numpy, reason)
        elif self._as_numpy and q.dtype == torch.float64:
            robot = Follower(core, self._feedback)
        else:
            reason = "`q0` is no float64 array of NumPy"
            robot = _InTorch(settings, self._feedback, self._as_numpy, reason)
        robot.start(q[None], None if dq is None else dq[None], hysteresis)
        self._estimator = task.estimator
        self._module = task.module
        self._robot = robot
        self._place(self._obstacles)

    def step(
        self,
        x_target: Array,
        dx: Array | None = None,
        *,
        x_measured: Array | None = None,
        at: float | None = None,
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
            Measured tip [m] for feedback; of a pose or axis the position alone, (3,), is enough.
            Without one (default), or where it is NaN, the offset between robot and model stays as
            it is, or decays with `memory`; before the first reading it is zero.
        at : float, optional
            Time of the measured tip [s], on the clock of `time`: for a tip of a given age,
            ``at=tracker.time - age``. Default: `delay` before `time`.

        Returns
        -------
        array of shape (n,)
            The command, exactly within the limits; a new array. If `x_target` or `dx` is not
            finite, the robot stops (with `ddq_max` it brakes first).

        Raises
        ------
        ValueError
            If `at` lies in the future, or more than 63 periods ago.
        """
        with self._lock:
            age = self._feedback.delay
            if at is not None:
                age = self._age(at)
            estimator = self._estimator
            if estimator is not None and estimator.module_ is not self._module:
                robot = self._robot
                before = robot.task.hysteresis
                state = robot.hysteresis
                self._settings = self._settings.present()
                if self._settings.task.hysteresis != before:
                    state = None
                q = as_tensor(robot.command(), "q")
                self._start(q, robot.last().step.dq[0], state)
            if "x_target" in self._unseen:
                self._look("x_target", x_target)
            if x_measured is not None and self._unseen:
                self._look("x_measured", x_measured)
            robot = self._robot
            if not robot.tick(x_target, dx, x_measured, age):
                self._step(x_target, dx, x_measured, age)
            self._time += self._settings.dt
            return robot.command()

    def _age(self, at: float) -> float:
        """Return the age of a reading [s]."""
        at = number(at, "at")
        oldest = self._time - MOST_PERIODS * self._settings.dt
        if oldest <= 0.0:
            oldest = -math.inf  # before the start it stood still
        close = IK_ON_TIME * self._settings.dt
        require(
            oldest - close <= at <= self._time + close,
            f"`at` must be a time [s] from {max(oldest, 0.0):.6g} to {self._time:.6g}, which is "
            f"`time` of the tracker, {MOST_PERIODS} periods later at most; got {at!r}.",
        )
        return max(self._time - at, 0.0)

    def _look(self, name: str, value: Array) -> None:
        """Warn if the first target or tip after `reset` has another unit than the robot."""
        points = self._settings.readings(value, name, lead="")
        if not torch.isfinite(self._settings.task.positions(points)).all():
            return
        self._unseen.discard(name)
        for message in self._settings.far_messages(points, name):
            if name == "x_measured":
                message += " Such readings are not used (`rejected`)."
            warnings.warn(message, stacklevel=3)

    def _step(
        self,
        x_target: Array,
        dx: Array | None,
        x_measured: Array | None,
        age: float,
    ) -> None:
        """Do a step with arguments that need full checks."""
        settings = self._settings
        like = self._like
        target = settings.points(x_target, "x_target", like, lead="")
        feed_forward = like.new_zeros(1, sum(settings.task.parts))
        if dx is not None:
            shape = (sum(settings.task.parts),)
            velocity = settings.points(dx, "dx", like, lead="", shape=shape)
            feed_forward = settings.dt * velocity[None]
        tip = None
        if x_measured is not None:
            tip = settings.readings(x_measured, "x_measured", like, lead="")[None]
        self._robot.advance(None, target[None], feed_forward, tip, age)

    def follow(
        self,
        targets: Tensor,
        periods: list[float],
        plant: Plant | None,
        feedback: str | None,
        progress: Callable[[int, int], None],
    ) -> list[Tensor]:
        """Return columns with a row for every point of the path (T, ...).

        They are the command, what the actuators do, x, the measured tip, the error of the loop,
        whether the reading was rejected, sigma_min, and whether the step to the point was held,
        damped or blocked; all others refer to the state at the point.
        """
        task = self._settings.task
        n = len(targets)
        following = torch.cat([targets[1:], targets[-1:]])
        ahead = task.difference(targets, following)
        countable = torch.isfinite(ahead).all(-1, keepdim=True)
        ahead = torch.where(countable, ahead, 0.0)
        finite = torch.isfinite(targets.flatten(1)).all(-1).tolist()
        held = damped = blocked = torch.zeros(1, dtype=torch.bool, device=targets.device)
        rows = []
        for i, target in enumerate(targets.split(1)):
            progress(i, n)
            tip = None
            if plant is not None:
                tip = self._measured(plant, i)
            reading = tip if feedback == "measured" else None
            copied = self._robot.command()
            command = torch.as_tensor(copied, device=self._like.device)[None]
            if not finite[i] or feedback is None:
                target = None
            tick = self._robot.advance(
                periods[i], target, ahead[i : i + 1], reading, self._feedback.delay
            )
            self._time += periods[i]
            if tip is None:
                tip = tick.x
            rejected = torch.full_like(held, tick.rejected)
            state = command, tick.q, tick.x, tip, tick.e, rejected
            rows.append((*state, tick.J, held, damped, blocked))
            held = tick.step.held
            damped = tick.step.damped
            blocked = held.new_zeros(1) | tick.step.blocked
        *states, J, held, damped, blocked = map(torch.cat, zip(*rows, strict=True))
        return [*states, row_gram(J, task.n_free).sigma_min, held, damped, blocked]

    def _measured(self, plant: Plant, i: int) -> Tensor:
        """Return the plant's tip (1, ...), NaN if the plant raises.

        The plant is the user's robot and may raise any exception. The motion continues, so that
        earlier rows are not lost.
        """
        try:
            tip = plant(self.q)
            return self._settings.readings(tip, "tip", self._like, lead="")[None]
        except Exception as error:
            warnings.warn(f"`plant` failed at point {i}: {error!r}; its tip is NaN.", stacklevel=7)
            return self._like.new_full((1, *self._settings.task.shape), math.nan)


class _InTorch:
    """The torch counterpart of `Follower`, for any task."""

    def __init__(
        self, settings: StepSettings, feedback: Feedback, as_numpy: bool, reason: str
    ) -> None:
        self._memory = feedback.memory
        self._as_numpy = as_numpy
        self.backend = f"torch: {reason}"
        self.task = settings.task.frozen()
        self._settings = replace(settings, task=self.task)
        self.scene = settings.clear.scene

    @property
    def hysteresis(self) -> Any:
        """State of the hysteresis; no rows without one."""
        return _given_back(self._lead.state[None], self._as_numpy)

    @torch.no_grad()
    def start(self, q: Tensor, dq: Tensor | None, hysteresis: Any) -> None:
        """Set the initial command (1, n), the step to it, and the state of hysteresis before it.

        Without a step the robot is at rest.
        """
        self._lead = lead_of(self._settings, q, hysteresis)
        q = self._lead.effective
        x, J = self._settings.evaluate(q)
        self._readings = Readings(self._settings, x, at_rest=dq is None)
        unknown = torch.full_like(self._readings.offset, math.nan)
        undamped = torch.zeros_like(q[:, 0])
        free = torch.zeros_like(q, dtype=torch.bool)
        if dq is None:
            dq = torch.zeros_like(q)
        step = StepRows(dq, unknown[:, 0], undamped, free, unknown)
        self._rest = at_start(self.task, unknown)
        self._period = self._settings.dt  # of the last step
        self._last = Tick(q, x, J, unknown, step)

    def tick(self, target: Array, dx: Array | None, tip: Array | None, age: float) -> bool:
        """Return False: all arguments need full checks."""
        return False

    @torch.no_grad()
    def advance(
        self,
        period: float | None,
        target: Tensor | None,
        feed_forward: Tensor,
        tip: Tensor | None,
        age: float,
    ) -> Tick:
        """Take one step towards a target (1, ...), and return its results.

        A measured `tip` is `age` seconds old. Without a target the step is feed-forward only.
        """
        settings = self._settings
        task = self.task
        effective = self._lead.effective
        x, J = settings.evaluate(effective)
        readings = self._readings
        readings.record(x)
        shown = readings.take(tip, age, self._memory)
        error = torch.full_like(shown, math.nan)
        used = before = torch.zeros_like(shown)
        if target is not None:
            model_error = task.difference(x, target)
            error = model_error - shown
            used = model_error - readings.offset
            before = used + task.difference(self._last.x, target) - model_error
        seconds = period or settings.dt
        last = self._last.step.dq * (seconds / self._period)
        at = x
        if settings.tip_limits.n > 0:
            at = x + readings.offset
        rest = self._rest.seen(settings, before, used, J)
        control = partial(
            control_step,
            settings,
            effective,
            J,
            used,
            at,
            seconds,
            feed_forward,
            last,
            least=rest.least(used),
            scene=self.scene,
        )
        step = self._lead.step(control, J, seconds, last, self.scene)
        readings.passed(seconds)
        moved = self._lead.effective - effective
        self._rest = rest.after(settings, moved, step.promised, used)
        self._last = Tick(effective, x, J, error, step, readings.rejected)
        self._period = seconds
        return self._last

    def last(self) -> Tick:
        """Return the results of the last tick."""
        return self._last

    def command(self) -> NDArray | Tensor:
        """Return the present command (n,)."""
        return _given_back(self._lead.command, self._as_numpy)

    def effective(self) -> NDArray | Tensor:
        """Return what the actuators do (n,)."""
        return _given_back(self._lead.effective, self._as_numpy)


def _given_back(rows: Tensor, as_numpy: bool) -> NDArray | Tensor:
    """Return a copy of a single row (1, ...) in the type of the caller's arrays."""
    return as_array(rows[0]).copy() if as_numpy else rows[0].clone()
