"""Inverse kinematics of any torch module q -> x: one control step, batched solving, tracking."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import as_tensor, bound, give_back, is_numpy, leading, rows_of
from hybridkin.ik._gram import row_gram
from hybridkin.ik._implicit import differentiable as with_derivatives
from hybridkin.ik._realtime import Controller
from hybridkin.ik._search import Search
from hybridkin.ik._step import HEALTHY, Law
from hybridkin.ik.results import IKSolution, IKStatus, Step, Track
from hybridkin.ik.tasks import as_task, device_of
from hybridkin.ik.tracker import FEEDBACKS, Tracker

__all__ = ["Controller", "IKSolution", "IKStatus", "InverseKinematics", "Step", "Track", "Tracker"]


class InverseKinematics:
    """Resolved-rate inverse kinematics with a null-space posture and hard limits.

    The law is eq. (1) of the paper in discrete time: with the wanted tip change
    ``v = dx dt + gain dt e`` and the posture step ``p = beta dt (q_pref - q)``,
    ``dq = J^T (J J^T + lambda^2 1)^-1 v + (1 - J+ J) p``. lambda is zero, and the inverse the
    pseudo-inverse, unless J is nearly singular. The posture goes through the undamped
    projector, so that it never moves the tip to first order.

    Parameters
    ----------
    model : nn.Module, callable, (callable, callable) or Task
        Maps q ``(..., n)`` to tips ``(..., 3)`` [m], row by row. Its ``forward_and_jacobian(q)``
        is used where it has one, else reverse mode; a pair is such a function and its Jacobian,
        for torch or for NumPy. A fitted estimator is unwrapped to its ``module_``. Its
        ``in_domain(q)``, where it has one, feeds the status OUT_OF_DOMAIN. Poses, several points
        and priorities are tasks, see `hybridkin.tasks`; then x stands for what they steer, in the
        shape of their targets.
    q_min, q_max : float or array-like of shape (n,), optional
        Limits of q, in the unit of q.
    dq_max : float or array-like of shape (n,), optional
        Largest speed of every actuator [unit of q per second]: a step is at most ``dq_max dt``.
    q_pref : float, array-like of shape (n,) or callable, optional
        Preferred configuration, or a function that gives it for configurations (..., n), torch to
        torch: `tasks.away_from_limits`, or `tasks.downhill` of any gradient. Default: the middle of
        the limits where both are finite, else there is no posture term.
    beta : float, default=1.0
        Rate of the posture [1/s], with 0 <= beta dt <= 1.
    gain : float, optional
        Feedback gain [1/s], with 0 < gain dt <= 1. Default: 1 / dt, the whole error is taken
        back in one period.
    damping : "adaptive" or float, default="adaptive"
        "adaptive": lambda grows smoothly from zero where sigma_min / sigma_max < 0.02. A number
        is lambda / sigma_max everywhere; 0.0 is the plain pseudo-inverse of the paper.
    limits : {"saturate", "clip", "off"}, default="saturate"
        "saturate": the limits are part of the step, and the free actuators take over what the
        held ones cannot do; "clip": the plain law, clipped afterwards; "off": the plain law.
    dt : float, default=0.01
        Control period [s].
    weights : float or array-like of shape (n,), optional
        What a unit of every actuator's motion costs: steps minimise ``sum_i weights_i dq_i^2``,
        and the preferred configuration is the nearest one in that measure. Default: all alike.
    mode : {"least_squares", "direction"}, default="least_squares"
        What `step` and `track` do where the limits leave less than the wanted motion of the tip.
        "least_squares": come as near to it as possible; "direction": keep its direction and go the
        largest share of it, the `scale` of the step. For limits="saturate".

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
    `dq_max`. Limits hold to the last bit for ``q + dq``, in the dtype of q. Of two prioritised
    tasks the first is exact where no limit is met; otherwise the second may cost it 1e-7 of the
    step where it can be reached, and up to 1e-3 where it is out of reach too.

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
        model: Any,
        *,
        q_min: Any = None,
        q_max: Any = None,
        dq_max: Any = None,
        q_pref: Any = None,
        beta: float = 1.0,
        gain: float | None = None,
        damping: str | float = "adaptive",
        limits: str = "saturate",
        dt: float = 0.01,
        weights: Any = None,
        mode: str = "least_squares",
    ) -> None:
        self.model = model
        self.task = as_task(model)
        self.q_min = bound(q_min, "q_min", -math.inf)
        self.q_max = bound(q_max, "q_max", math.inf)
        self.dq_max = bound(dq_max, "dq_max", math.inf)
        fixed_pref = None if q_pref is None or callable(q_pref) else bound(q_pref, "q_pref", 0.0)
        self.weights = None if weights is None else bound(weights, "weights", 1.0)
        sizes = {
            name: len(value)
            for name, value in (
                ("q_min", self.q_min),
                ("q_max", self.q_max),
                ("dq_max", self.dq_max),
                ("q_pref", fixed_pref),
                ("weights", self.weights),
            )
            if value is not None and value.ndim == 1
        }
        if self.task.n_actuators is not None:
            sizes["model"] = self.task.n_actuators
        if len(set(sizes.values())) > 1:
            raise ValueError(
                f"limits and posture must agree in the number of actuators, got {sizes}; give "
                "scalars or one value per actuator."
            )
        self._size = next(iter(sizes.values()), None)
        if (self.q_min > self.q_max).any():
            raise ValueError(
                f"`q_min` must not exceed `q_max`, got {self.q_min.tolist()} and "
                f"{self.q_max.tolist()}; swap them."
            )
        if not (self.dq_max > 0).all():
            raise ValueError(
                f"`dq_max` must be positive [unit of q per second], got {self.dq_max.tolist()}; "
                "to lock an actuator give it equal limits."
            )
        middle = 0.5 * (self.q_min + self.q_max)
        self._middle = middle if torch.isfinite(middle).all() else None
        self.q_pref: Any = q_pref
        if not callable(q_pref):
            self.q_pref = self._middle if fixed_pref is None else fixed_pref
            if fixed_pref is not None and not torch.isfinite(fixed_pref).all():
                raise ValueError(f"`q_pref` must be finite, got {fixed_pref.tolist()}.")
        if not (dt > 0 and math.isfinite(dt)):
            raise ValueError(f"`dt` must be a positive period [s], got {dt!r}.")
        self.dt = float(dt)
        self.beta = float(beta)
        self.gain = None if gain is None else float(gain)
        self._rates(self.dt)
        if limits not in ("saturate", "clip", "off"):
            raise ValueError(f'`limits` must be "saturate", "clip" or "off", got {limits!r}.')
        self.limits = limits
        adaptive = isinstance(damping, str) and damping == "adaptive"
        if not adaptive and (isinstance(damping, str) or not 0.0 <= damping < math.inf):
            raise ValueError(
                f'`damping` must be "adaptive" or a number >= 0 (lambda / sigma_max), got '
                f"{damping!r}."
            )
        self.damping = damping
        if (
            self.weights is not None
            and not ((self.weights > 0.0) & torch.isfinite(self.weights)).all()
        ):
            raise ValueError(
                f"`weights` must be positive, got {self.weights.tolist()}; to lock an actuator "
                "give it equal limits."
            )
        if mode not in ("least_squares", "direction"):
            raise ValueError(f'`mode` must be "least_squares" or "direction", got {mode!r}.')
        self.mode = mode

    def __repr__(self) -> str:
        """Return the settings."""
        shown = self.model if self.model is self.task else self.task.models[0]
        name = type(shown).__name__
        return (
            f"InverseKinematics({name}, beta={self.beta}, gain={self.gain}, "
            f"damping={self.damping!r}, limits={self.limits!r}, dt={self.dt})"
        )

    @torch.no_grad()
    def step(self, q: Any, x_target: Any, dx: Any = None, *, x_measured: Any = None) -> Step:
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

        Returns
        -------
        Step
            `dq` and what came with it. A row with a NaN or infinite input holds still.
        """
        as_numpy = is_numpy(q)
        q = self._configurations(q, "q")
        target = self._points(x_target, "x_target", q)
        tip = None if x_measured is None else self._points(x_measured, "x_measured", q)
        velocity = None
        if dx is not None:
            velocity = self._points(dx, "dx", q, (sum(self.task.parts),))
        axes = len(self.task.shape)
        given = [(q, 1), (target, axes), (tip, axes), (velocity, 1)]
        lead = leading([(a, trailing) for a, trailing in given if a is not None])
        q, target = rows_of(q, lead), rows_of(target, lead, axes)
        x, J = self._law.evaluate(q)
        e = self.task.difference(x if tip is None else rows_of(tip, lead, axes), target)
        gain, beta, _ = self._rates(self.dt)
        v = gain * e
        if velocity is not None:
            v = v + self.dt * rows_of(velocity, lead)
        move = self._law.advance(q, J, v, beta, self.dt)
        error = e.norm(dim=-1)
        parts = (move.dq, x, error, move.sigma_min, move.damping, move.saturated, move.scale)
        return Step(*give_back(parts, lead, as_numpy))

    @torch.no_grad()
    def solve(
        self,
        x_target: Any,
        q0: Any = None,
        *,
        tol: float | Sequence[float] = 1e-4,
        max_iter: int = 50,
        restarts: int = 0,
        random_state: Any = None,
        differentiable: bool = False,
    ) -> IKSolution:
        """Return configurations that reach the targets, or come as near as the limits allow.

        Levenberg-Marquardt on the tip error with the box-limited step; a step is taken only
        where it lowers the error. Rows that have converged leave the work, and then slide
        along their null space towards `q_pref`. `dq_max` plays no part here: this
        is where to go, not how fast.

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
        restarts : int, default=0
            Further starts for rows that failed: `q_pref` first where `q0` was given, then drawn
            in the limits, the same for every row.
        random_state : int, Generator or None, default=None
            Seed of the restarts.
        differentiable : bool, default=False
            Keep the graph from q to `x_target`, and to parameters of the model that require
            gradients, by the implicit function theorem at the solution.

        Returns
        -------
        IKSolution
            Never raises for an unreachable target; a NaN target marks only its own row.

        Notes
        -----
        The derivatives are those of the configuration nearest to `q_pref` among the solutions
        around the one found, with the actuators that lie at a limit held there; without posture
        they are J+. They are exact where that configuration is unique and the set of held
        actuators does not change nearby; rows that have not converged get none. The model must be
        twice differentiable by torch.
        """
        tol = self._tolerance(tol)
        if max_iter < 1 or restarts < 0:
            raise ValueError(
                f"`max_iter` must be at least 1 and `restarts` at least 0, got {max_iter} and "
                f"{restarts}."
            )
        as_numpy, axes = is_numpy(x_target), len(self.task.shape)
        if differentiable and as_numpy:
            raise ValueError("`x_target` must be a torch tensor for differentiable=True.")
        target = self._points(x_target, "x_target", None)
        q = self._start(target) if q0 is None else self._configurations(q0, "q0", target)
        target = target.to(q.dtype)
        lead = leading([(q, 1), (target, axes)])
        q, target = rows_of(q, lead), rows_of(target, lead, axes)
        starts = self._restarts(q, restarts, random_state, q0 is not None)
        found = Search(self._law, tol, max_iter).solve(q, target, q0 is None, starts)
        q = found.q
        if differentiable:
            with torch.enable_grad():
                goal = rows_of(x_target.to(q), lead, axes)
                q = with_derivatives(self._law, q, goal, found.reached)
        x, J = self._law.evaluate(q.detach())
        e = self.task.difference(x, target)
        error, gram = e.norm(dim=-1), row_gram(J)
        singular = gram.sigma_min < HEALTHY * gram.sigma_max
        reached = self.task.reached(e, tol)
        status = self._statuses(q.detach(), error, reached, found.held, singular)
        nearest = found.stationary & ~reached & torch.isfinite(error)
        status[nearest] = IKStatus.UNREACHABLE
        margin = self._law.margin(q.detach())
        results = (q, x, error, status, found.n_iter, gram.sigma_min, margin)
        with torch.set_grad_enabled(differentiable):
            return IKSolution(*give_back(results, lead, as_numpy))

    @torch.no_grad()
    def track(
        self,
        path: Any,
        t: Any = None,
        *,
        q0: Any = None,
        plant: Callable[[Any], Any] | None = None,
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
        path : array-like of shape (T, 3), Trajectory or callable
            Points to pass [m]; an object with `x` and `t` brings its own times; a function of
            time is asked for the point at every entry of `t`, a number [s].
        t : array-like of shape (T,), optional
            Times of the points [s], increasing; needed for a function. Default: multiples of `dt`.
        q0 : array-like of shape (n,), optional
            Start. Default: solved for the first point.
        plant : callable, optional
            The robot: takes a commanded q of shape (n,), returns the measured tip of shape (3,)
            [m]. It gets numpy or torch, as the path is.
        feedback : {"model", "measured"} or None, default="model"
            Where the error comes from: the model's tip (with a plant: the paper's feed-forward
            control), the measured tip, or nowhere.
        memory : float, optional
            For how long a reading counts where the next ones are missing (NaN) [s]: the model's tip
            is moved by what it missed there, less by exp(-age / memory). Let it be several times
            longer than the gaps: a short one goes back to the model's tip, which may be worse than
            the default, to go on by feed-forward without a reading.
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
        if feedback == "measured" and plant is None:
            raise ValueError('`feedback="measured"` needs `plant`, a callable q -> measured tip.')
        if hasattr(path, "x") and hasattr(path, "t"):
            path, t = path.x, path.t if t is None else t
        elif callable(path):
            if t is None:
                raise ValueError("`t` must be given for a path that is a function of time.")
            points: list[Any] = [path(float(time)) for time in t]
            path = torch.stack(points) if isinstance(points[0], Tensor) else np.stack(points)
        as_numpy = is_numpy(path)
        target = self._points(path, "path", None)
        if target.ndim != 1 + len(self.task.shape) or len(target) == 0:
            raise ValueError(
                f"`path` must have shape {self._shape('T')}, got {tuple(target.shape)}."
            )
        times, periods = self._times(t, target)
        tracker = self._tracker(target[0], q0, feedback, memory, tol, as_numpy)
        q, x, measured, sigma_min, held, damped = tracker.follow(target, periods, plant, progress)
        target = target.to(q)
        e_model, e = (self.task.difference(a, target) for a in (x, measured))
        judged, error = e if feedback == "measured" else e_model, e.norm(dim=-1)
        reached = self.task.reached(judged, self._tolerance(tol))
        status = self._statuses(q, judged.norm(dim=-1), reached, held, damped)
        status[~torch.isfinite(error)] = IKStatus.INVALID_INPUT
        results = (q, x, measured, target, error, status, sigma_min, self._law.margin(q))
        times, *results = give_back((times, *results), (len(target),), as_numpy)
        if plant is None:
            results[2] = None
        return Track(times, *results)

    def tracker(
        self,
        x_target: Any,
        q0: Any = None,
        *,
        feedback: str | None = "model",
        memory: float | None = None,
        tol: float | Sequence[float] = 1e-4,
    ) -> Tracker:
        """Return what follows a path tick by tick, for a controller that is given it as it goes.

        Parameters
        ----------
        x_target : array-like of shape (3,)
            First point of the path [m].
        q0 : array-like of shape (n,), optional
            Start. Default: solved for the first point.
        feedback : {"model", "measured"} or None, default="model"
            As for `track`; "measured" takes the tip with every tick.
        memory : float, optional
            As for `track` [s].
        tol : float or sequence of floats, default=1e-4
            For the start.

        Returns
        -------
        Tracker
            Command its `q`, then call its `tick`.
        """
        target = self._points(x_target, "x_target", None)
        if target.shape != self.task.shape:
            raise ValueError(
                f"`x_target` must have shape {self.task.shape}, got {tuple(target.shape)}."
            )
        return self._tracker(target, q0, feedback, memory, tol, is_numpy(x_target))

    def controller(self, q0: Any, *, tol: float = 1e-4) -> Controller:
        """Return the law tick by tick in NumPy, for one robot at its control rate.

        Parameters
        ----------
        q0 : array-like of shape (n,)
            Present actuator vector, in the unit of q.
        tol : float, default=1e-4
            Error that counts as reached [m].

        Returns
        -------
        Controller
            Its `step` takes a target, and the measured tip if there is one, and gives the next
            command, some fifty times faster than `step` here. It steers tip positions; `tracker`
            follows every task.
        """
        return Controller(self, q0, tol=tol)

    def _tracker(
        self,
        target: Tensor,
        q0: Any,
        feedback: str | None,
        memory: float | None,
        tol: Any,
        as_numpy: bool,
    ) -> Tracker:
        if feedback not in FEEDBACKS:
            raise ValueError(f'`feedback` must be "model", "measured" or None, got {feedback!r}.')
        if memory is not None and not (memory > 0.0 and feedback == "measured"):
            raise ValueError(
                f'`memory` must be a positive time [s] with feedback="measured", got {memory!r} '
                f"with feedback={feedback!r}."
            )
        if q0 is None:
            q = as_tensor(self.solve(target, tol=tol).q, "q0")
        else:
            q = self._configurations(q0, "q0", target)
            if q.ndim != 1:
                raise ValueError(f"`q0` must have shape (n,), got {tuple(q.shape)}.")
        target = target.to(q.dtype)
        parts = self._law, self._rates, q[None], target[None], feedback, memory, as_numpy
        return Tracker(*parts)

    @property
    def _law(self) -> Law:
        return Law(
            *(self.task, self.q_min, self.q_max, self.dq_max),
            self.q_pref if self.beta > 0.0 else None,
            *(self.weights, self.damping, self.limits, self.mode),
        )

    def _statuses(
        self, q: Tensor, error: Tensor, reached: Tensor, held: Tensor, singular: Tensor
    ) -> Tensor:
        status = torch.full(error.shape, IKStatus.MAX_ITER.value, device=error.device)
        status[singular] = IKStatus.SINGULAR
        status[held] = IKStatus.AT_LIMITS
        status[reached] = IKStatus.CONVERGED
        if len(q) > 0:
            status[reached & ~self.task.in_domain(q)] = IKStatus.OUT_OF_DOMAIN
        status[~torch.isfinite(error)] = IKStatus.INVALID_INPUT
        return status

    def _restarts(
        self, q: Tensor, restarts: int, random_state: Any, from_preferred: bool
    ) -> list[Tensor]:
        n = q.shape[-1]
        points: list[Tensor] = []
        if from_preferred and restarts > 0 and self.q_pref is not None:
            points = [self._start(q)]
        draws = max(restarts - len(points), 0)
        if draws == 0:
            return points
        low, span = self.q_min.expand(n), (self.q_max - self.q_min).expand(n)
        if not torch.isfinite(span).all():
            raise ValueError("`restarts` draws starts in the limits: give finite `q_min`, `q_max`.")
        shares = np.random.default_rng(random_state).random((draws, n))
        return points + list((low + span * torch.as_tensor(shares)).to(q))

    def _tolerance(self, tol: Any) -> float | tuple[float, ...]:
        given = np.atleast_1d(np.asarray(tol, dtype=float))
        if not (given > 0.0).all():
            raise ValueError(f"`tol` must be positive [m], got {tol!r}.")
        if np.ndim(tol) == 0:
            return float(given[0])
        if given.shape != (len(self.task.parts),):
            raise ValueError(
                f"`tol` must be one number [m] or {len(self.task.parts)}, one for every part of "
                f"the task, got {tol!r}."
            )
        return tuple(given.tolist())

    def _rates(self, period: float | None) -> tuple[float, float, float]:
        """Return gain dt and beta dt, both at most 1, and dt."""
        period = self.dt if period is None else float(period)
        gain = 1.0 if self.gain is None else self.gain * period
        if not 0.0 < gain <= 1.0 + 1e-9:
            raise ValueError(
                f"`gain` times the period must lie in (0, 1], got {self.gain} 1/s x {period:.6g} "
                f"s = {gain:.4g}; take a gain up to {1.0 / period:.4g} 1/s or a shorter period."
            )
        beta = self.beta * period
        if not 0.0 <= beta <= 1.0 + 1e-9:
            raise ValueError(
                f"`beta` times the period must lie in [0, 1], got {self.beta} 1/s x {period:.6g} "
                f"s = {beta:.4g}; take a beta up to {1.0 / period:.4g} 1/s or a shorter period."
            )
        return min(gain, 1.0), min(beta, 1.0), period

    def _start(self, target: Tensor) -> Tensor:
        start = self._middle if callable(self.q_pref) else self.q_pref
        if start is None:
            raise ValueError(
                "a start is needed: give `q0`, `q_pref` of shape (n,), or finite `q_min`, `q_max`."
            )
        n = self._size
        if n is None:
            raise ValueError(
                "the number of actuators is not known from scalar limits and this model; give "
                "`q0`, or `q_pref` of shape (n,)."
            )
        start = start.to(target).expand(n)
        return self._law.preferred(start) if callable(self.q_pref) else start

    def _configurations(self, value: Any, name: str, like: Tensor | None = None) -> Tensor:
        q = as_tensor(value, name, device_of(self.task) if like is None else like.device)
        if q.ndim == 0 or self._size not in (None, q.shape[-1]):
            n = "n" if self._size is None else self._size
            raise ValueError(
                f"`{name}` must have shape (..., {n}), got {tuple(q.shape)}; the last axis is the "
                "actuators."
            )
        return q if like is None else q.to(torch.promote_types(q.dtype, like.dtype))

    def _points(
        self, value: Any, name: str, like: Tensor | None, shape: tuple[int, ...] | None = None
    ) -> Tensor:
        x, kind = as_tensor(value, name, device_of(self.task)), shape or self.task.shape
        if tuple(x.shape[max(x.ndim - len(kind), 0) :]) != kind:
            raise ValueError(
                f"`{name}` must have shape {self._shape('...', kind)} [m], got {tuple(x.shape)}; "
                "one target per row."
            )
        if shape is None:
            self.task.check(x, name)
        return x if like is None else x.to(like)

    def _shape(self, lead: str, kind: tuple[int, ...] | None = None) -> str:
        return f"({', '.join([lead, *(str(size) for size in kind or self.task.shape)])})"

    def _times(self, t: Any, target: Tensor) -> tuple[Tensor, list[float]]:
        n = len(target)
        if t is None:
            steps = torch.arange(n, dtype=target.dtype, device=target.device)
            return self.dt * steps, [self.dt] * (n - 1)
        times = as_tensor(t, "t", target.device)
        if times.shape != (n,):
            raise ValueError(
                f"`t` must have shape ({n},), one time per point of `path`, got "
                f"{tuple(times.shape)}."
            )
        periods = times.diff()
        if not (torch.isfinite(times).all() and (periods > 0).all()):
            raise ValueError("`t` must be finite and increasing [s]; sort it, drop repeated times.")
        if n > 1:
            self._rates(float(periods.max()))
        return times, periods.tolist()
