"""Inverse kinematics of any forward model: one control step, batched solving, tracking."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from inspect import signature
from operator import attrgetter
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import (
    as_array,
    as_tensor,
    give_back,
    is_numpy,
    leading,
    number,
    one_of,
    rows_of,
    whole,
)
from hybridkin._core.html import html_table
from hybridkin._core.progress import quiet
from hybridkin.ik._clear import BodyPoints, KeptClear
from hybridkin.ik._clear import body_points as body_points_of
from hybridkin.ik._compiled import Core, core_of
from hybridkin.ik._feedback import MOST_PERIODS, Feedback
from hybridkin.ik._gram import apply_columns, row_gram
from hybridkin.ik._half_spaces import everywhere, half_spaces
from hybridkin.ik._implicit import differentiable as with_derivatives
from hybridkin.ik._level_search import search_of
from hybridkin.ik._posture import Function
from hybridkin.ik._rates import beta_of, gain_of
from hybridkin.ik._settings import (
    RATES,
    Array,
    StepSettings,
    bound,
    limits_of,
    require,
)
from hybridkin.ik._starts import nearest_starts
from hybridkin.ik._step import control_step
from hybridkin.ik._tracks import Loop, Path, followed
from hybridkin.ik.limits import Limit, functions
from hybridkin.ik.obstacles import Obstacle, as_numbers, as_scene
from hybridkin.ik.results import IKSolution, IKStatus, Step, Track, statuses
from hybridkin.ik.tasks import as_task
from hybridkin.ik.tracker import Plant, Tracker
from hybridkin.ik.trajectories import Trajectory

# Default tolerances of points of a path, by the model and measured [m].
_TOL = 1e-4
_MEASURED = 1e-3
_GUESSES = 16  # configurations from which the first point of a path is solved


class InverseKinematics:
    """Resolved-rate inverse kinematics with a null-space posture and hard limits.

    The law is eq. (1) of the paper in discrete time: with the desired tip change
    ``v = dx dt + gain dt e`` and the posture step ``p = beta dt (q_pref - q)``,
    ``dq = J^T (J J^T + lambda^2 1)^-1 v + (1 - J+ J) p``. lambda is zero, and the inverse is the
    pseudo-inverse, unless J is nearly singular. The projector of the posture is undamped, so the
    posture does not move the tip, to first order.

    Parameters
    ----------
    model : ForwardModel, fitted estimator, nn.Module, callable, (callable, callable) or Task
        Maps q ``(..., n)`` to tips ``(..., 3)`` [m], row by row, torch to torch; a pair is such a
        function and its Jacobian, see `as_forward_model`. Its `in_domain` separates CONVERGED from
        OUT_OF_DOMAIN. For poses, axes, several points and NumPy functions pass a task, see
        `hybridkin.tasks`; then x has the shape of its targets.
    q_min, q_max : float or array-like of shape (n,), optional
        Limits of q, in the unit of q; infinity means none. Default: those of the model, e.g. the
        joint limits of a `RigidChain`, or ``q_min=0`` for extensible segments.
    dq_max : float or array-like of shape (n,), optional
        Largest speed of every actuator [unit of q per second]: a step is at most ``dq_max dt``.
        Default: that of the model, e.g. from a URDF; infinity means none.
    ddq_max : float or array-like of shape (n,), optional
        Largest acceleration of every actuator [unit of q per second squared]: the speed changes by
        at most ``ddq_max dt`` per step, and every actuator can stop within `q_min` and `q_max`.
        Default: that of the model, e.g. from a URDF; infinity means none.
    q_pref : float, array-like of shape (n,) or callable, optional
        Preferred configuration, or a function that returns it for configurations (..., n), torch
        to torch, e.g. a gradient step. Default: the middle of the limits if they are finite, else
        there is no posture term.
    beta : float, optional
        Rate of the posture [1/s], with 0 <= beta dt <= 1. Default: 1, or 1 / dt if that is less.
    gain : float, optional
        Feedback gain [1/s], with 0 < gain dt <= 1. Default: 1 / dt, the whole error in one period.
    damping : "adaptive" or float, default="adaptive"
        "adaptive": lambda grows smoothly from zero if sigma_min / sigma_max < 0.02. A number is
        lambda / sigma_max everywhere; 0.0 is the plain pseudo-inverse of the paper.
    limits : {"saturate", "off"} or sequence of callables, default="saturate"
        "saturate": limits are part of the step: if some actuators are at a limit, the others
        provide the missing motion. "off": the plain law without limits. Functions
        ``limit(q, x, J)`` add limits of your own to each step, see `hybridkin.ik.limits`; they
        work in torch, and not in `solve`.
    dt : float, default=0.01
        Control period [s].
    weights : float or array-like of shape (n,), optional
        Cost of the motion of every actuator: steps minimise ``sum_i weights_i dq_i^2``, and the
        distance to the preferred configuration is weighted in the same way. Default: all equal.
    tip_limits : tuple of array-like of shape (k, 3) and (k,), optional
        Half-spaces (A, b) in which the tip must stay, ``A x <= b`` [m], in the frame of x; for
        position tasks only. A box ``low <= x <= high`` is
        ``(np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))``.
    obstacles : sequence of Obstacle, default=()
        What the whole body keeps clear of, in the frame of x: `obstacles.Sphere`,
        `obstacles.HalfSpace`, `obstacles.Capsule`, `obstacles.Box`.
    clearance : float, default=0.0
        Least distance between the body and obstacles [m]. The expected error of the model comes on
        top where its estimator knows it (`radius_`).
    body_points : int or sequence of (place, radius), optional
        Points along the body whose balls keep clear of obstacles and of each other: their number,
        or for each its place in segments from the base, the last one the tip, and the radius of its
        ball [m]. Default: so many that their balls are 25 % larger than the body, at most 24. With
        `body_points` and without obstacles the body only keeps clear of itself.

    Attributes
    ----------
    model : object
        The model as given.
    settings : StepSettings
        The other arguments, checked and copied; limits, weights and a fixed posture as float64
        tensors.

    Notes
    -----
    Every call of `step`, `solve` and `track` uses the model as it is then, whatever has changed it.
    A `Tracker` keeps a copy from its `reset`; only a refit of an estimator (`fit`, `partial_fit`,
    `adapt`) reaches it, at its next step. Functions, and modules that are not `ForwardModel`, are
    called as they are.

    With limits="saturate" a step within all limits is exactly the unlimited step. Otherwise it
    minimises ``|dq - z|^2 + |J dq - v|^2 / lambda^2`` in the box, with the projected posture step
    z. The task keeps priority: (a) lambda^2 is only 1e-6 of sigma_max^2 in float64, and two
    proximal rounds remove the remaining task error (a relative 1e-6, squared and cubed) if v can be
    reached; (b) near a singularity the damped task is first solved in the box without posture. The
    posture then only chooses among steps with the same tip motion (to 1e-8 of the step; up to 1e-3
    was seen if v was also out of reach). ``q + dq`` meets the limits exactly, in the dtype of q;
    from outside, q returns at `dq_max`. With `ddq_max` every step can be stopped within the limits;
    if the given speed cannot, the step brakes as hard as possible and may cross a limit.

    References
    ----------
    Reinhart & Steil (2016), eq. (1); Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108 (1986).

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import ConstantCurvatureChain
    >>> from hybridkin.ik.solver import InverseKinematics
    >>> ik = InverseKinematics(ConstantCurvatureChain([0.10, 0.093, 0.079]), q_min=0.1, q_max=0.4)
    >>> solution = ik.solve(np.array([[0.2, 0.1, 0.7], [0.0, 0.0, 1.5]]))
    >>> [IKStatus(s).name for s in solution.status]
    ['CONVERGED', 'UNREACHABLE']
    >>> round(float(solution.error[1]), 6)
    0.3
    """

    def __init__(
        self,
        model: object,
        *,
        q_min: Array | None = None,
        q_max: Array | None = None,
        dq_max: Array | None = None,
        ddq_max: Array | None = None,
        q_pref: Array | Function | None = None,
        beta: float | None = None,
        gain: float | None = None,
        damping: str | float = "adaptive",
        limits: str | Sequence[Limit] = "saturate",
        dt: float = 0.01,
        weights: Array | None = None,
        tip_limits: Sequence[Array] | None = None,
        obstacles: Sequence[Obstacle] = (),
        clearance: float = 0.0,
        body_points: BodyPoints = None,
    ) -> None:
        self.model = model
        task = as_task(model)
        require(
            0 not in np.shape(task.models[0].robot.limits["q_min"]),
            "`model` must have an actuator, but all its joints are fixed.",
        )
        box = {"q_min": q_min, "q_max": q_max, "dq_max": dq_max, "ddq_max": ddq_max}
        of_model = tuple(name for name, value in box.items() if value is None)
        bounds = limits_of(task, of_model)
        for name, value in box.items():
            if value is not None:
                bounds[name] = bound(value, name, positive=name in RATES)
        if q_pref is not None and not callable(q_pref):
            q_pref = bound(q_pref, "q_pref", finite=True)
        if not isinstance(damping, str):
            damping = number(damping, "damping")
        if weights is None:
            weights = 1.0
        own_limits: tuple[Limit, ...] = ()
        if not isinstance(limits, str):
            own_limits = functions(limits)
            limits = "saturate"
        one_of(limits, "limits", ("saturate", "off"))
        spaces = everywhere()
        if tip_limits is not None and limits != "off":
            spaces = half_spaces(tip_limits, task)
        self._settings = StepSettings(
            task,
            **bounds,
            q_pref=q_pref,
            beta=beta_of(beta),
            gain=gain_of(gain),
            damping=damping,
            limits=limits,
            own_limits=own_limits,
            dt=number(dt, "dt"),
            weights=bound(weights, "weights", finite=True, positive=True),
            of_model=of_model,
            tip_limits=spaces,
            obstacles=as_scene(obstacles),
            clearance=_length(clearance, "clearance"),
            body_points=body_points_of(body_points),
        )
        settings = self.settings
        for message in [*settings.unit_messages(), *settings.derivative_messages()]:
            warnings.warn(message, stacklevel=2)

    @property
    def settings(self) -> StepSettings:
        """The arguments, checked, and the model of the task that they are for."""
        self._settings = self._settings.present()
        return self._settings

    def __repr__(self) -> str:
        """Return the model's name, the limits, and the settings that differ from their defaults."""
        arguments = signature(type(self)).parameters
        words = [type(self.model).__name__]
        for name, text in self.settings.in_words().items():
            if text != repr(arguments[name].default):
                words.append(f"{name}={text}")
        return f"InverseKinematics({', '.join(words)})"

    def _repr_html_(self) -> str:
        settings = self.settings
        rows: dict[str, object] = {"task": type(settings.task).__name__}
        rows.update(settings.in_words())
        for model in settings.task.models:
            rows[f"model: {type(model).__name__}"] = model.html_rows()
        return html_table(type(self).__name__, rows)

    def step(
        self,
        q: Array,
        x_target: Array,
        dx: Array | None = None,
        *,
        x_measured: Array | None = None,
        dq: Array | None = None,
    ) -> Step:
        """Return the change of q for one period, eq. (1).

        Parameters
        ----------
        q : array-like of shape (..., n)
            Present configurations.
        x_target : array-like of shape (..., 3)
            Present targets [m].
        dx : array-like of shape (..., 3), optional
            Velocities of the targets [m/s], one for every row of the task. Default: at rest.
        x_measured : array-like of shape (..., 3), optional
            Measured tips [m] for feedback. Default: the model's tips. Of poses and axes positions
            (..., 3) are enough, or NaN rotations: these stay with the model.
        dq : array-like of shape (..., n), optional
            The previous steps, to which `ddq_max` refers. Default: at rest.

        Returns
        -------
        Step
            `dq` and further results. A row with a NaN, infinite or overflowing input stops (with
            `ddq_max` it brakes first); outside the limits its known actuators return to them.
        """
        core = core_of(self.settings)
        if core is not None and dq is None:
            result = core.step(q, x_target, dx, x_measured)
            if result is not None:
                step = object.__new__(Step)  # its constructor takes longer than the step
                vars(step)["_row"] = result
                settings = self._settings
                row, places = result
                too_long = math.hypot(*q.tolist()) > settings.longest_usual  # pyright: ignore
                if too_long or row[places["error"]] > settings.farthest:
                    self._warn_of_units(q, x_target, x_measured)
                return step
        step = self._steps(core, q, x_target, dx, x_measured, dq)
        settings = self._settings
        q_rows = settings.configurations(q, "q")
        too_long = q_rows.norm(dim=-1) > settings.longest_usual
        too_far = torch.as_tensor(step.error, device=q_rows.device) > settings.farthest
        if too_long.any() | too_far.any():
            self._warn_of_units(q, x_target, x_measured)
        return step

    def _warn_of_units(self, q: Array, x_target: Array, x_measured: Array | None) -> None:
        """Warn where arguments of a step whose error is too large have another unit."""
        settings = self._settings
        messages = settings.posture_messages(settings.configurations(q, "q"), "q")
        tips = {"x_target": settings.points(x_target, "x_target")}
        if x_measured is not None:
            tips["x_measured"] = settings.readings(x_measured, "x_measured")
        for name, points in tips.items():
            messages += settings.far_messages(points, name)
        for message in messages:
            warnings.warn(message, stacklevel=3)

    @torch.no_grad()
    def _steps(
        self,
        core: Core | None,
        q: Array,
        x_target: Array,
        dx: Array | None,
        x_measured: Array | None,
        dq: Array | None,
    ) -> Step:
        """Return a batch of steps, with full checks of the arguments."""
        settings = self.settings
        task = settings.task
        axes = len(task.shape)
        rows = settings.configurations(q, "q")
        target = settings.points(x_target, "x_target", rows)
        arguments = {"q": (rows, 1), "x_target": (target, axes)}
        if dx is not None:
            m = sum(task.parts)
            arguments["dx"] = (settings.points(dx, "dx", rows, shape=(m,)), 1)
        if x_measured is not None:
            tip = settings.readings(x_measured, "x_measured", rows)
            arguments["x_measured"] = (tip, axes)
        if dq is not None:
            arguments["dq"] = (settings.configurations(dq, "dq").to(rows), 1)
        # All of them with the same rows.
        lead = leading([*arguments.values()])
        in_rows = {name: rows_of(a, lead, k) for name, (a, k) in arguments.items()}
        rows = in_rows["q"]
        target = in_rows["x_target"]
        feed_forward = in_rows.get("dx")
        if feed_forward is not None:
            feed_forward = settings.dt * feed_forward
        measured = in_rows.get("x_measured")
        last = in_rows.get("dq")
        if not settings.accelerates:
            last = None
        as_numpy = is_numpy(q)
        if core is not None and as_numpy and rows.dtype == torch.float64:
            parts = core.steps(rows, target, feed_forward, measured, last)
            return Step(*give_back(parts, lead, as_numpy))
        x, J = settings.evaluate(rows)
        tip = x
        if measured is not None:
            tip = task.completed(measured, x)
        e = task.difference(tip, target)
        step = control_step(
            settings,
            rows,
            J,
            e,
            tip,
            settings.dt,
            torch.zeros_like(e) if feed_forward is None else feed_forward,
            torch.zeros_like(rows) if last is None else last,
        )
        results = (
            step.dq,
            x,
            e.norm(dim=-1),
            step.sigma_min,
            step.damping,
            step.saturated,
        )
        return Step(*give_back(results, lead, as_numpy))

    @torch.no_grad()
    def solve(
        self,
        x_target: Array,
        q0: Array | None = None,
        *,
        tol: float | Sequence[float] = 1e-4,
        max_iter: int = 50,
        restarts: int = 32,
        n_solutions: int | None = None,
        differentiable: bool = False,
    ) -> IKSolution:
        """Return configurations that reach the targets, or come as near as the limits allow.

        This is Levenberg-Marquardt with box-limited steps. A joint with a range of a whole turn can
        pass its limit and continue at the other one. Targets missed from one start are searched
        again from up to `restarts` further starts, a few at first. Converged rows then move along
        their null space towards `q_pref`. `dq_max` is not used.

        Parameters
        ----------
        x_target : array-like of shape (..., 3)
            Targets [m].
        q0 : array-like of shape (..., n), optional
            Start; it is first moved into the limits. Default: `q_pref`.
        tol : float or sequence of floats, default=1e-4
            Largest error of a reached target [m], or one for every part, ([m], [rad]) for a pose.
        max_iter : int, default=50
            Iterations per start.
        restarts : int, default=32
            Largest number of further starts for targets that are not reached, or only outside the
            domain. They are the configurations with the nearest tips in an even sample of the
            limits, which is the same in every call. Without limits the sample is around the start.
        n_solutions : int, optional
            Return up to this many configurations per target, in an axis of this length, those
            nearest to `q0` (else to `q_pref`) first. They differ by more than 1 % of the range of
            an actuator, not counting whole turns. Unused places have NaN as q and NO_FURTHER.
        differentiable : bool, default=False
            Keep the graph from q to `x_target`, and to parameters of the model that require
            gradients, by the implicit function theorem at the solution.

        Returns
        -------
        IKSolution
            An unreachable target does not raise; a NaN target or start affects only its own row.

        Notes
        -----
        The derivatives are those of the solution nearest to `q_pref` near the one found, with
        actuators at a limit fixed there; without posture they are J+. They are exact if that
        solution is unique and the set of fixed actuators does not change nearby. They are zero in
        directions in which the free actuators cannot move the tip, e.g. across the plane of a
        planar arm. Rows that have not converged have no derivatives; nor have, with a warning,
        those where such a direction exists only at the solution, e.g. a stretched arm. The model
        must be twice differentiable by torch.
        """
        settings = self.settings
        target = settings.points(x_target, "x_target")
        messages = settings.far_messages(target, "x_target")
        if q0 is not None:
            start = settings.configurations(q0, "q0", target)
            messages += settings.posture_messages(start, "q0")
        for message in messages:
            warnings.warn(message, stacklevel=3)
        return self._solved(
            x_target,
            q0,
            tol=tol,
            max_iter=max_iter,
            restarts=restarts,
            n_solutions=n_solutions,
            differentiable=differentiable,
        )

    @torch.no_grad()
    def _solved(
        self,
        x_target: Array,
        q0: Array | None = None,
        *,
        tol: float | Sequence[float] = 1e-4,
        max_iter: int = 50,
        restarts: int = 32,
        n_solutions: int | None = None,
        differentiable: bool = False,
    ) -> IKSolution:
        """Return what `solve` does, without warnings about units."""
        settings = self.settings
        task = settings.task
        axes = len(task.shape)
        tolerance = settings.tolerance(tol)
        max_iter = whole(max_iter, "max_iter", 1, 1_000_000)
        restarts = whole(restarts, "restarts", 0, 1_000_000)
        as_numpy = is_numpy(x_target)
        places = self._places(n_solutions, differentiable)
        require(
            not (differentiable and settings.clear),
            "`differentiable` must be False with obstacles: they change which solution is found.",
        )
        require(
            isinstance(x_target, Tensor) or not differentiable,
            "`x_target` must be a torch tensor for differentiable=True.",
        )
        target = settings.points(x_target, "x_target")
        if q0 is None:
            start = settings.start(target)
        else:
            start = settings.configurations(q0, "q0", target)
        target = target.to(start.dtype)
        lead = leading([(start, 1), (target, axes)])
        target = rows_of(target, lead, axes)
        start = rows_of(start, lead)
        # Limits must not make it finite.
        start = torch.where(torch.isfinite(start), start, torch.nan)
        search = search_of(settings, tolerance, max_iter)
        if as_numpy and start.dtype == torch.float64:
            core = core_of(settings)
            if core is not None and not settings.clear:
                search = core.search(tolerance, max_iter)
                settings = core.settings
                task = settings.task
        solution = search.solve(start, target, q0 is None, restarts)
        if n_solutions is not None:
            solution = search.several(solution, start, restarts, places)
            lead = (*lead, places)
            target = target.repeat_interleave(places, 0)
        # Tip limits or obstacles have moved these targets.
        in_obstacle = settings.is_in_obstacle(target)
        moved = (solution.target != target).flatten(1).any(-1)
        q = solution.q
        if differentiable:
            with torch.enable_grad():
                goal = torch.as_tensor(x_target, device=q.device).to(q)
                goal = rows_of(goal, lead, axes)
                solved = solution.reached & ~moved
                q = with_derivatives(settings, q, goal, solved, tolerance)
        # Error and status refer to the returned q.
        q_plain = q.detach()
        x, J = settings.evaluate(q_plain)
        e = task.difference(x, target)
        error = e.norm(dim=-1)
        singular = row_gram(J, task.n_free)
        status = statuses(
            task,
            q_plain,
            e,
            tolerance,
            known=torch.isfinite(error),
            held=solution.held,
            singular=singular.is_singular,
            blocked=settings.clear.stops(q_plain, apply_columns(J, e)) | in_obstacle,
            inside=settings.clear.is_inside(q_plain, settings.clear.scene),
            resting=solution.stationary,
            beyond=(moved & ~in_obstacle) | (settings.misses(target) > np.max(tolerance)),
        )
        place = torch.arange(len(q), device=q.device) % places
        status[(place > 0) & q.isnan().all(-1)] = IKStatus.NO_FURTHER
        results = (
            q,
            x,
            error,
            status,
            solution.n_iter,
            solution.n_starts,
            singular.sigma_min,
            settings.margin(q_plain),
        )
        with torch.set_grad_enabled(differentiable):
            return IKSolution(*give_back(results, lead, as_numpy))

    def _places(self, n_solutions: int | None, differentiable: bool) -> int:
        """Return the number of configurations per target."""
        if n_solutions is None:
            return 1
        require(not differentiable, "`n_solutions` must be None for differentiable=True.")
        require(
            torch.isfinite(self.settings.spans).all(),
            "`n_solutions` needs finite ranges of q to compare configurations; give finite `q_min` "
            "and `q_max`.",
        )
        return whole(n_solutions, "n_solutions", 1, 10_000)

    @torch.no_grad()
    def track(
        self,
        path: Array | Trajectory,
        t: Array | None = None,
        *,
        q0: Array | None = None,
        plant: Plant | None = None,
        feedback: str | None = "model",
        delay: float = 0.0,
        memory: float = math.inf,
        tol: float | None = None,
        progress: Callable[[int, int], None] = quiet,
        state: Any = None,
    ) -> Track:
        """Return the motion that follows a path, one step per point, eq. (1).

        The feed-forward is the difference to the next point. With feedback and gain 1 / dt the
        error is of second order in the period; without feedback it is of first order.

        Parameters
        ----------
        path : array-like of shape (T, 3) or Trajectory
            Points to follow [m]; a `Trajectory` includes its times.
        t : array-like of shape (T,), optional
            Times of the points [s], increasing. Default: multiples of `dt`.
        q0 : array-like of shape (n,) or (K, n), optional
            Start; or configurations, e.g. rows of the log, from which the first point is solved.
            Then two solutions are tried on the model: that of the first row, and, if it misses
            points or leaves the domain, the most regular one in the domain of the rows with the
            nearest tips. The track that reaches most points in the domain is kept. Default: as with
            `q_pref` and an even sample of the limits.
        plant : callable, optional
            The robot: maps a commanded q (n,) to the measured tip (3,) [m]; NumPy or torch as path.
            Of a pose or axis its position is enough; the rotation in `x_measured` is then NaN.
        feedback : {"model", "measured"} or None, default="model"
            Source of the error: the model's tip (with a plant: the paper's feed-forward control),
            the measured tip, or none.
        delay : float, default=0.0
            Age [s] of a measured tip when the plant returns it, fractions of a period too; at most
            63 periods. It is compared with the model's tip of that time. Without a `gain` a delay
            of up to four periods may stay unknown.
        memory : float, default=inf
            Time constant [s] with which the offset between measured tip and model decays while
            measurements are NaN or rejected; make it several times longer than the gaps. Default:
            the offset stays.
        tol : float, optional
            Largest error of a CONVERGED point [m], with feedback="measured" of its measured error.
            Default: 1e-4, with feedback="measured" 1e-3, because a step removes neither the noise
            of its measurement nor the change of the model's error since the measurements before.
        progress : callable, optional
            Called as ``progress(i, T)`` before point i.
        state : array of shape (R, n), optional
            State of the hysteresis at one start, see `Tracker.reset` [unit of q]. Default: without
            hysteresis.

        Returns
        -------
        Track
            If the plant raises, the point is NaN in `x_measured` with status INVALID_INPUT, a
            warning is given, and the motion continues without a reading.
        """
        settings = self.settings
        one_of(feedback or "model", "feedback", ("model", "measured"), " or None")
        require(
            feedback != "measured" or plant is not None,
            '`feedback="measured"` needs `plant`, a callable q -> measured tip.',
        )
        for name, value, unused in (
            ("memory", memory, math.inf),
            ("delay", delay, 0.0),
        ):
            require(
                value == unused or feedback == "measured",
                f'`{name}` requires feedback="measured"; set it, or remove `{name}`.',
            )
        if tol is None:
            tol = _MEASURED if feedback == "measured" else _TOL
        if isinstance(path, Trajectory):
            points: Array = path.x
            if t is None:
                t = path.t
        else:
            points = path
        target = settings.points(points, "path", lead="T")
        require(len(target) > 0, "`path` must hold at least one point, got none.")
        starts = None
        messages = settings.far_messages(target, "path")
        if q0 is not None:
            starts = settings.configurations(q0, "q0", target)
            messages += settings.posture_messages(starts, "q0")
            require(
                starts.ndim < 3 and starts.numel() > 0,
                f"`q0` must have shape (n,) or (K, n), got {tuple(starts.shape)}.",
            )
        times, periods = settings.times(t, target)
        tolerance = settings.tolerance(tol)
        timed = Path(target, times, periods, tolerance, is_numpy(points))
        kept = math.inf  # of shorter paths everything, as it stood still before
        if len(times) > MOST_PERIODS:
            kept = float((times[MOST_PERIODS:] - times[:-MOST_PERIODS]).min())
        readings = Feedback.checked(delay, memory, kept)
        loop = Loop(plant, feedback, readings, progress)
        for message in messages:
            warnings.warn(message, stacklevel=3)
        if starts is not None and starts.ndim == 1:
            return followed(settings, starts, timed, loop, state)
        require(state is None, "`state` requires `q0` of shape (n,), one start.")
        # The start is chosen on the model alone: the robot moves once.
        alone = plant is None and feedback == "model"
        on_model = Loop(progress=progress if alone else quiet)
        tracks: list[Track] = []
        for start in self._starts(target[:1], starts, timed.as_numpy):
            tracks.append(followed(settings, start, timed, on_model))
            if tracks[-1].score == (len(target), len(target)):
                break
        best = max(tracks, key=attrgetter("score"))  # of equal tracks the first
        if alone:
            return best
        return followed(settings, torch.as_tensor(best.q[0], device=target.device), timed, loop)

    def judged(self, track: Track, *, tol: float | Sequence[float] = _TOL) -> Track:
        """Return a track with the errors and statuses of its tips, after a change of its commands.

        Parameters
        ----------
        track : Track
            A track of this solver with other `q`, and the `effective` and `x` of these.
        tol : float or sequence of floats, default=1e-4
            Largest error of a reached point, as for `track`.

        Returns
        -------
        Track
            With new `error` and `status`; points that were AT_LIMITS or SINGULAR and are missed
            stay so.
        """
        task = self.settings.task
        motion = as_tensor(track.effective, "effective")
        x = as_tensor(track.x, "x")
        target = as_tensor(track.target, "target")
        before = as_tensor(track.status, "status")
        clear = self.settings.clear
        e = task.difference(x, target)
        status = statuses(
            task,
            motion,
            e,
            self.settings.tolerance(tol),
            known=before != IKStatus.INVALID_INPUT,
            held=before == IKStatus.AT_LIMITS,
            singular=before == IKStatus.SINGULAR,
            blocked=before == IKStatus.BLOCKED,
            inside=clear.is_inside(motion, clear.scene),
        )
        clearance = clear.smallest(motion, clear.scene)
        rows = [e.norm(dim=-1), status, clearance]
        error, status, clearance = give_back(rows, (len(e),), is_numpy(track.q))
        return replace(track, error=error, status=status, clearance=clearance)

    @torch.no_grad()
    def body_balls(self, q: Array) -> tuple[Array, Array]:
        """Return the balls that cover the body: their middles, and their radii.

        Parameters
        ----------
        q : array-like of shape (..., n)
            Configurations; with hysteresis, what the actuators do.

        Returns
        -------
        points : array of shape (..., P, 3)
            Points along the backbone, the last one the tip of the model [m].
        radii : array of shape (P,)
            Radii of the balls [m].

        Raises
        ------
        ValueError
            If the solver was made without obstacles: it then has no points along the body.
        """
        clear = self._body()
        rows = self.settings.configurations(q, "q")
        points = clear.points(rows.reshape(-1, rows.shape[-1]))
        middles = give_back([points], rows.shape[:-1], is_numpy(q))[0]
        return middles, give_back([clear.radii.to(rows)], clear.radii.shape, is_numpy(q))[0]

    @torch.no_grad()
    def body_distances(self, q: Array, obstacles: Sequence[Obstacle] | None = None) -> Array:
        """Return the distance from the body to every obstacle.

        Parameters
        ----------
        q : array-like of shape (..., n)
            Configurations; with hysteresis, what the actuators do.
        obstacles : sequence of K Obstacle, optional
            Default: those of the solver.

        Returns
        -------
        array of shape (..., K)
            Least distances [m] from the balls along the body to the surfaces, negative inside. They
            are those of the model, without `clearance` and expected error. Balls that no
            configuration can free, where the robot is mounted, do not count.

        Raises
        ------
        ValueError
            If the solver was made without obstacles: it then has no points along the body.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import InverseKinematics, obstacles, robots
        >>> wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.3)
        >>> trunk = robots.bionic_handling_assistant()
        >>> ik = InverseKinematics(trunk, q_min=0.1, q_max=0.4, obstacles=[wall])
        >>> ik.body_distances(np.full(9, 0.25)).round(2)
        array([0.18])
        """
        clear = self._body()
        rows = self.settings.configurations(q, "q")
        scene = clear.scene if obstacles is None else as_numbers(as_scene(obstacles))
        distances = clear.distances(rows.reshape(-1, rows.shape[-1]), scene)
        return give_back([distances], rows.shape[:-1], is_numpy(q))[0]

    def _body(self) -> KeptClear:
        """Return the body of the robot, with what it keeps clear of."""
        clear = self.settings.clear
        require(
            bool(clear),
            "`obstacles` or `body_points` must be given to the solver itself; without them it has "
            "no points along the body.",
        )
        return clear

    def _starts(self, target: Tensor, q0: Tensor | None, as_numpy: bool) -> Iterator[Tensor]:
        """Yield two configurations (n,) at a target (1, ...): of the first start, a regular one."""
        settings = self.settings
        # Arrays of NumPy are solved by the compiled core.
        goal = as_array(target[0]) if as_numpy else target[0]
        guesses = q0
        if guesses is None:
            yield as_tensor(self._solved(goal).q, "q")
            start = settings.start(target)[None]
            guesses = nearest_starts(settings, start, start[:, 0], target, _GUESSES)[0]
        # The nearest ones, and always the first.
        x, _ = settings.evaluate(guesses)
        distances = settings.task.distances(x[None], target)[0]
        distances[0] = -1.0
        guesses = guesses[distances.argsort()[: _GUESSES + 1]]
        solution = self._solved(goal, as_array(guesses) if as_numpy else guesses, max_iter=200)
        q = as_tensor(solution.q, "q")
        status = as_tensor(solution.status, "status")
        sigma_min = as_tensor(solution.sigma_min, "sigma_min")
        if q0 is not None:
            yield q[0]
        for wanted in (IKStatus.CONVERGED, IKStatus.OUT_OF_DOMAIN):
            regular = torch.where(status == wanted, sigma_min, -1.0)
            if regular.max() >= 0.0:
                yield q[regular.argmax()]
                return

    def tracker(
        self,
        q0: Array,
        *,
        tol: float | Sequence[float] = 1e-4,
        delay: float = 0.0,
        memory: float = math.inf,
    ) -> Tracker:
        """Return a tracker that follows targets step by step, for one robot at its control rate.

        Parameters
        ----------
        q0 : array-like of shape (n,)
            Present actuator vector, in the unit of q. Commands are NumPy or torch, like this.
        tol : float or sequence of floats, default=1e-4
            Largest error of a reached target [m], or one for every part of the task, for `status`.
        delay : float, default=0.0
            Age of a measured tip when `step` gets it, as for `track` [s].
        memory : float, default=inf
            As for `track` [s].

        Returns
        -------
        Tracker
            Its `step` takes a target, and optionally the measured tip, and returns the command.
        """
        settings = self.settings
        readings = Feedback.checked(delay, memory, MOST_PERIODS * settings.dt)
        tracker = Tracker(settings, q0, settings.tolerance(tol), readings)
        start = as_tensor(q0, "q0")
        for message in settings.posture_messages(start, "q0"):
            warnings.warn(message, stacklevel=2)
        return tracker


def _length(value: float, name: str) -> float:
    """Return a caller's length that is not negative [m]."""
    length = number(value, name)
    require(
        0.0 <= length < math.inf,
        f"`{name}` must be a length that is not negative [m], got {length!r}.",
    )
    return length
