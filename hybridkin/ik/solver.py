"""Inverse kinematics of any forward model: one control step, batched solving, tracking."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from inspect import signature

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import (
    as_array,
    give_back,
    is_numpy,
    leading,
    number,
    one_of,
    rows_of,
    whole,
)
from hybridkin._core.stored import Stored
from hybridkin.ik._compiled import Core, core_of
from hybridkin.ik._gram import row_gram
from hybridkin.ik._implicit import differentiable as with_derivatives
from hybridkin.ik._search import Search
from hybridkin.ik._settings import Array, Posture, StepSettings, bound, half_spaces, require
from hybridkin.ik._step import control_step
from hybridkin.ik.results import IKSolution, IKStatus, Step, Track, statuses
from hybridkin.ik.tasks import as_task
from hybridkin.ik.tracker import Plant, Tracker
from hybridkin.ik.trajectories import Trajectory


class InverseKinematics:
    """Resolved-rate inverse kinematics with a null-space posture and hard limits.

    The law is eq. (1) of the paper in discrete time: with the wanted tip change
    ``v = dx dt + gain dt e`` and the posture step ``p = beta dt (q_pref - q)``,
    ``dq = J^T (J J^T + lambda^2 1)^-1 v + (1 - J+ J) p``. lambda is zero, and the inverse the
    pseudo-inverse, unless J is nearly singular. The posture goes through the undamped
    projector, so that it never moves the tip to first order.

    Parameters
    ----------
    model : ForwardModel, fitted estimator, nn.Module, callable, (callable, callable) or Task
        Maps q ``(..., n)`` to tips ``(..., 3)`` [m], row by row, torch to torch; a pair is such a
        function and its Jacobian, see `as_forward_model`. Its `in_domain` decides between CONVERGED
        and OUT_OF_DOMAIN. Poses, several points and NumPy functions are tasks, see
        `hybridkin.tasks`; then x has the shape of their targets.
    q_min, q_max : float or array-like of shape (n,), optional
        Limits of q, in the unit of q. Default: those of the model, as the joint limits of a
        `RigidChain` and 0 as `q_min` of extensible segments; infinite ones switch them off.
    dq_max : float or array-like of shape (n,), optional
        Largest speed of every actuator [unit of q per second]: a step is at most ``dq_max dt``.
        Default: that of the model, as of a URDF; infinity switches it off.
    ddq_max : float or array-like of shape (n,), optional
        Largest acceleration of every actuator [unit of q per second squared]: the speed changes by
        at most ``ddq_max dt`` from step to step, and always lets it stop within `q_min` and
        `q_max`.
    q_pref : float, array-like of shape (n,) or callable, optional
        Preferred configuration, or a function that gives it for configurations (..., n), torch to
        torch, such as a step against a gradient. Default: the middle of the limits where both are
        finite, else there is no posture term.
    beta : float, default=1.0
        Rate of the posture [1/s], with 0 <= beta dt <= 1.
    gain : float, optional
        Feedback gain [1/s], with 0 < gain dt <= 1. Default: 1 / dt, the whole error is taken
        back in one period.
    damping : "adaptive" or float, default="adaptive"
        "adaptive": lambda grows smoothly from zero where sigma_min / sigma_max < 0.02. A number
        is lambda / sigma_max everywhere; 0.0 is the plain pseudo-inverse of the paper.
    limits : {"saturate", "off"}, default="saturate"
        "saturate": the limits are part of the step, and the free actuators take over what the
        held ones cannot do; "off": the plain law.
    dt : float, default=0.01
        Control period [s].
    weights : float or array-like of shape (n,), optional
        What a unit of every actuator's motion costs: steps minimise ``sum_i weights_i dq_i^2``,
        and the preferred configuration is the nearest one in that measure. Default: all alike.
    tip_limits : tuple of array-like of shape (k, 3) and (k,), optional
        Half-spaces (A, b) in which the tip must stay, ``A x <= b`` [m], in the frame of x; of a
        position task only. A box ``low <= x <= high`` is
        ``(np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -low]))``.

    Attributes
    ----------
    model : object
        The model that was given.
    settings : StepSettings
        The other arguments, checked; limits, weights and a fixed posture as float64 tensors.

    Notes
    -----
    With limits="saturate" a step that meets no limit is the unlimited one exactly. Otherwise it
    minimises ``|dq - z|^2 + |J dq - v|^2 / lambda^2`` in the box, z the projected posture step.
    The task must stay strict there too, so (a) lambda^2 is only 1e-6 of sigma_max^2 in float64
    and two proximal rounds take the remaining task error (a relative 1e-6, squared and cubed)
    out again where v can be reached; (b) near a singularity, where lambda is larger, the
    damped task is solved in the box without posture first, and the posture then only chooses
    among the steps that move the tip the same way (to 1e-8 of the step; where v is also out of
    reach, up to 1e-3 was seen). A start outside the limits walks back at
    `dq_max`. Limits hold to the last bit for ``q + dq``, in the dtype of q. With `ddq_max` a step
    that could not be stopped within the limits is not taken; where the speed that is given cannot
    be stopped, the step brakes as hard as it may, beyond a limit if it must.

    References
    ----------
    Reinhart & Steil (2016), eq. (1); Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108
    (1986), for the damped inverse.

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
        q_pref: Array | Posture | None = None,
        beta: float = 1.0,
        gain: float | None = None,
        damping: str | float = "adaptive",
        limits: str = "saturate",
        dt: float = 0.01,
        weights: Array | None = None,
        tip_limits: Sequence[Array] | None = None,
    ) -> None:
        self.model, task = model, as_task(model)
        own, given = task.models[0].robot.limits, {"q_min": q_min, "q_max": q_max, "dq_max": dq_max}
        good = 0 not in np.shape(own["q_min"])
        require(good, "`model` must have an actuator, but its joints are all fixed: a constant.")
        bounds = {
            name: bound(own[name] if value is None else value, name, positive=name == "dq_max")
            for name, value in given.items()
        }
        self.settings = StepSettings(
            task,
            bounds["q_min"],
            bounds["q_max"],
            bounds["dq_max"],
            bound(np.inf if ddq_max is None else ddq_max, "ddq_max", positive=True),
            q_pref if q_pref is None or callable(q_pref) else bound(q_pref, "q_pref", finite=True),
            number(beta, "beta"),
            None if gain is None else number(gain, "gain"),
            damping if isinstance(damping, str) else number(damping, "damping"),
            one_of(limits, "limits", ("saturate", "off")),
            number(dt, "dt"),
            None if weights is None else bound(weights, "weights", finite=True, positive=True),
            tuple(name for name, value in given.items() if value is None),
            None if tip_limits is None or limits == "off" else half_spaces(tip_limits, task),
        )
        for message in self.settings.unit_messages():
            warnings.warn(message, stacklevel=2)

    def __repr__(self) -> str:
        """Return the model's name, the limits, and the settings that are not the default ones."""
        parts = [type(self.model).__name__]
        for name, default in signature(type(self)).parameters.items():
            value = vars(self.settings).get(name)
            if isinstance(value, Tensor):
                ends = dict.fromkeys(f"{float(end):.4g}" for end in (value.min(), value.max()))
                whose = " of the model" if name in self.settings.of_model else ""
                parts += [f"{name}={' to '.join(ends)}{whose}"] * bool(torch.isfinite(value).any())
            elif value not in (None, default.default):
                parts.append(f"{name}={value!r}")
        return f"InverseKinematics({', '.join(parts)})"

    def stored(self) -> Stored:
        """Return how the solver describes itself, with its model as a part, for kernels.

        Raises
        ------
        TypeError
            Where it could only be stored as code: a posture that is a function.
        """
        return self.settings.stored()

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
            Measured tips [m], to close the loop on. Default: the model's tips.
        dq : array-like of shape (..., n), optional
            The steps before, from which `ddq_max` counts. Default: at rest.

        Returns
        -------
        Step
            `dq` and what came with it. A row with a NaN, infinite or overflowing input holds still,
            with `ddq_max` after it has braked; outside the limits its known actuators walk back.
        """
        core = core_of(self.settings)
        found = None if core is None or dq is not None else core.step(q, x_target, dx, x_measured)
        if found is None:
            return self._steps(core, q, x_target, dx, x_measured, dq)
        step = object.__new__(Step)  # its constructor takes longer than the step
        vars(step)["_row"] = found
        return step

    @torch.no_grad()
    def _steps(self, core: Core | None, q: Array, x_target: Array, *more: Array | None) -> Step:
        settings, task, (dx, tip, last) = self.settings, self.settings.task, more
        as_numpy, axes = is_numpy(q), len(task.shape)
        rows = settings.configurations(q, "q")
        given = [(rows, 1), (settings.points(x_target, "x_target", rows), axes)]
        if tip is not None:
            given.append((settings.points(tip, "x_measured", rows), axes))
        if dx is not None:
            given.append((settings.points(dx, "dx", rows, shape=(sum(task.parts),)), 1))
        if last is not None:
            given.append((settings.configurations(last, "dq").to(rows), 1))
        lead = leading(given)
        rows, target, *others = (rows_of(a, lead, trailing) for a, trailing in given)
        before = None if last is None else others.pop()
        before = before if settings.accelerates else None
        feed_forward = None if dx is None else settings.dt * others.pop()
        measured = others.pop() if others else None
        if core is not None and as_numpy and rows.dtype == torch.float64:
            parts = core.steps(rows, target, feed_forward, measured, before)
            return Step(*give_back(parts, lead, as_numpy))
        x, J = settings.evaluate(rows)
        seen = x if measured is None else measured
        e = task.difference(seen, target)
        step = control_step(settings, rows, J, e, feed_forward, last=before, tip=seen)
        parts = (step.dq, x, e.norm(dim=-1), step.sigma_min, step.damping, step.saturated)
        return Step(*give_back(parts, lead, as_numpy))

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

        Levenberg-Marquardt on the error with the box-limited step; a joint that can turn all the
        way round turns on beyond its limit. Targets that one start missed are searched again from
        up to `restarts` further ones, a few at first. Rows that have converged leave the work, and
        then slide along their null space towards `q_pref`. `dq_max` plays no part here.

        Parameters
        ----------
        x_target : array-like of shape (..., 3)
            Targets [m].
        q0 : array-like of shape (..., n), optional
            Start, moved into the limits first. Default: `q_pref`.
        tol : float or sequence of floats, default=1e-4
            Error that counts as reached [m], or one for every part of the task, as ([m], [rad])
            for a pose.
        max_iter : int, default=50
            Iterations per start.
        restarts : int, default=32
            Further starts for targets that the first one missed, or reached only outside the
            model's domain: of an even sample of the limits, the same in every call, those whose
            tips lie nearest to the target. Without limits the sample lies around the start. 0:
            none.
        n_solutions : int, optional
            Return up to this many configurations per target, in an axis of this length, nearest to
            `q0`, or else to `q_pref`, first. They differ by more than 1 % of the range of an
            actuator, whole turns left out. Places that are left have NaN as q and NO_FURTHER.
        differentiable : bool, default=False
            Keep the graph from q to `x_target`, and to parameters of the model that require
            gradients, by the implicit function theorem at the solution.

        Returns
        -------
        IKSolution
            Never raises for an unreachable target; a NaN target or start marks only its own row.

        Notes
        -----
        The derivatives are those of the configuration nearest to `q_pref` among the solutions
        around the one found, with the actuators that lie at a limit held there; without posture
        they are J+. They are exact where that configuration is unique and the set of held
        actuators does not change nearby; rows that have not converged get none. The model must be
        twice differentiable by torch.
        """
        settings, task = self.settings, self.settings.task
        tolerance = settings.tolerance(tol)
        max_iter = whole(max_iter, "max_iter", 1, 1_000_000)
        restarts = whole(restarts, "restarts", 0, 1_000_000)
        as_numpy, axes = is_numpy(x_target), len(task.shape)
        places = settings.places(n_solutions, differentiable)
        good = isinstance(x_target, Tensor) or not differentiable
        require(good, "`x_target` must be a torch tensor for differentiable=True.")
        target = settings.points(x_target, "x_target")
        for message in settings.far_messages(target, "x_target"):
            warnings.warn(message, stacklevel=3)
        q = settings.start(target) if q0 is None else settings.configurations(q0, "q0", target)
        target = target.to(q.dtype)
        lead = leading([(q, 1), (target, axes)])
        q, target = rows_of(q, lead), rows_of(target, lead, axes)
        q = torch.where(torch.isfinite(q), q, torch.nan)  # or the limits would make it finite
        core = core_of(settings, search=True) if as_numpy and q.dtype == torch.float64 else None
        search = Search(settings, tolerance, max_iter)
        if core is not None:
            search, settings = core.search(tolerance, max_iter), core.settings
            task = settings.task
        found = search.solve(q, target, q0 is None, restarts)
        if n_solutions is not None:
            found, lead = search.several(found, q, restarts, places), (*lead, places)
            target = target.repeat_interleave(places, 0)
        q, moved = found.q, (found.target != target).flatten(1).any(-1)  # by limits of the tip
        if differentiable:
            with torch.enable_grad():
                goal = rows_of(torch.as_tensor(x_target, device=q.device).to(q), lead, axes)
                q = with_derivatives(settings, q, goal, found.reached & ~moved)
        # The error and the status are those of the q that is returned.
        x, J = settings.evaluate(q.detach())
        e = task.difference(x, target)
        error, gram = e.norm(dim=-1), row_gram(J)
        reached = task.reached(e, tolerance)
        status = statuses(task, q.detach(), error, reached, found.held, gram.is_singular)
        ended = found.stationary | (found.reached & moved)
        status[ended & ~reached & torch.isfinite(error)] = IKStatus.UNREACHABLE
        further = torch.arange(len(q), device=q.device) % places > 0
        status[further & q.isnan().all(-1)] = IKStatus.NO_FURTHER
        margin = settings.margin(q.detach())
        results = (q, x, error, status, found.n_iter, found.n_starts, gram.sigma_min, margin)
        with torch.set_grad_enabled(differentiable):
            return IKSolution(*give_back(results, lead, as_numpy))

    @torch.no_grad()
    def track(
        self,
        path: Array | Trajectory,
        t: Array | None = None,
        *,
        q0: Array | None = None,
        plant: Plant | None = None,
        feedback: str | None = "model",
        memory: float | None = None,
        tol: float = 1e-4,
        progress: Callable[[int, int], None] | None = None,
    ) -> Track:
        """Return the motion that follows a path, one step per point, eq. (1).

        The feed-forward is the difference to the next point. With gain 1 / dt and feedback the
        error is of second order in the period, without feedback of first order.

        Parameters
        ----------
        path : array-like of shape (T, 3) or Trajectory
            Points to pass [m]; a `Trajectory` brings its own times.
        t : array-like of shape (T,), optional
            Times of the points [s], increasing. Default: multiples of `dt`.
        q0 : array-like of shape (n,), optional
            Start. Default: solved for the first point.
        plant : callable, optional
            The robot: takes a commanded q of shape (n,), returns the measured tip of shape (3,)
            [m]. It gets numpy or torch, as the path is.
        feedback : {"model", "measured"} or None, default="model"
            Where the error comes from: the model's tip (with a plant: the paper's feed-forward
            control), the measured tip, or nowhere.
        memory : float, optional
            Time constant [s] with which the last measured offset between tip and model decays while
            measurements are NaN. Make it several times longer than the gaps: a short one soon goes
            back to the model's tip, which may be worse than the default, to go on by feed-forward
            without a reading.
        tol : float, default=1e-4
            Error up to which a point counts as CONVERGED [m].
        progress : callable, optional
            Called as ``progress(i, T)`` before point i.

        Returns
        -------
        Track
            Where the plant raises, the point is NaN in `x_measured` with status INVALID_INPUT,
            a warning is given and the motion goes on by feed-forward.
        """
        settings, task = self.settings, self.settings.task
        good = feedback in ("model", "measured", None)
        require(good, f'`feedback` must be "model", "measured" or None, got {feedback!r}.')
        good = feedback != "measured" or plant is not None
        require(good, '`feedback="measured"` needs `plant`, a callable q -> measured tip.')
        good = memory is None or feedback == "measured"
        require(good, '`memory` must be a positive time [s], with feedback="measured" only.')
        points = path.x if isinstance(path, Trajectory) else path
        if isinstance(path, Trajectory) and t is None:
            t = path.t
        as_numpy, tolerance = is_numpy(points), settings.tolerance(tol)
        target = settings.points(points, "path", lead="T")
        require(len(target) > 0, f"`path` must hold at least one point, got {tuple(target.shape)}.")
        for message in [] if q0 is None else settings.far_messages(target, "path"):
            warnings.warn(message, stacklevel=3)
        times, periods = settings.times(t, target)
        start = self.solve(target[0], tol=tol).q if q0 is None else q0
        q = settings.configurations(start, "q0", target)
        target = target.to(q.dtype)
        tracker = Tracker(settings, as_array(q) if as_numpy else q, tolerance, memory)
        parts = tracker.follow(target, periods, plant, feedback, progress)
        q, x, measured, sigma_min, held, damped = parts
        e_model, e = (task.difference(a, target) for a in (x, measured))
        judged, error = e if feedback == "measured" else e_model, e.norm(dim=-1)
        reached = task.reached(judged, tolerance)
        status = statuses(task, q, judged.norm(dim=-1), reached, held, damped)
        status[~torch.isfinite(error)] = IKStatus.INVALID_INPUT
        results = (times, q, x, measured, target, error, status, sigma_min, settings.margin(q))
        results = give_back(results, (len(target),), as_numpy)
        if plant is None:
            results[3] = None
        return Track(*results)

    def tracker(
        self, q0: Array, *, tol: float | Sequence[float] = 1e-4, memory: float | None = None
    ) -> Tracker:
        """Return what follows targets tick by tick, for one robot at its control rate.

        Parameters
        ----------
        q0 : array-like of shape (n,)
            Present actuator vector, in the unit of q. NumPy or torch: commands are of its kind.
        tol : float or sequence of floats, default=1e-4
            Error that counts as reached [m], or one for every part of the task, for `status`.
        memory : float, optional
            As for `track` [s].

        Returns
        -------
        Tracker
            Its `step` takes a target, and the measured tip if there is one, and gives the next
            command.
        """
        return Tracker(self.settings, q0, self.settings.tolerance(tol), memory)
