"""Inverse kinematics of any torch module q -> x: one control step, batched solving, tracking."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from hybridkin._numerics import forward_and_jacobian
from hybridkin._outcomes import IKSolution, IKStatus, Step, Track, as_array
from hybridkin._solvers import (
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    row_gram,
    strict_box_step,
)

__all__ = ["IKSolution", "IKStatus", "InverseKinematics", "Step", "Track"]

_HEALTHY = 0.02  # sigma_min / sigma_max above which the pseudo-inverse needs no damping
_FIRST_DAMPING = 0.1  # lambda^2 / sigma_max^2 of the first iteration of `solve`
_LAST_DAMPING = 1e8  # no descent even with this one: the point is as good as it gets
_STATIONARY = 1e-4  # sine of the angle between the error and what the limits leave free
_SLOW_STEPS = 8  # iterations in a row that gain less than 1 % of tol
_POSTURE_STEPS = 10  # iterations of the null-space descent that follows convergence
_POSTURE_SLIP = 0.3  # tip error per tip-sized motion that a posture step may leave to the next


class InverseKinematics:
    """Resolved-rate inverse kinematics with a null-space posture and hard limits.

    The law is eq. (1) of the paper in discrete time: with the wanted tip change
    ``v = dx dt + gain dt e`` and the posture step ``p = beta dt (q_pref - q)``,
    ``dq = J^T (J J^T + lambda^2 1)^-1 v + (1 - J+ J) p``. lambda is zero, and the inverse the
    pseudo-inverse, unless J is nearly singular. The posture goes through the undamped
    projector, so that it never moves the tip to first order.

    Parameters
    ----------
    model : nn.Module or callable
        Maps q ``(..., n)`` to tips ``(..., 3)`` [m], torch to torch, row by row. Its
        ``forward_and_jacobian(q)`` is used where it has one, else reverse mode; its
        ``in_domain(q)``, where it has one, feeds the status OUT_OF_DOMAIN. A fitted estimator
        is unwrapped to its ``module_``.
    q_min, q_max : float or array-like of shape (n,), optional
        Limits of q, in the unit of q.
    dq_max : float or array-like of shape (n,), optional
        Largest speed of every actuator [unit of q per second]: a step is at most ``dq_max dt``.
    q_pref : float, array-like of shape (n,) or callable, optional
        Preferred configuration, or a function that gives it for configurations (..., n), torch to
        torch, as `ElasticTendonChain.taut_posture`. Default: the middle of the limits where both
        are finite, else there is no posture term.
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
    `dq_max`. Limits hold to the last bit for ``q + dq``, in the dtype of q.

    References
    ----------
    Reinhart & Steil (2016), eq. (1); Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108
    (1986), for the damped inverse.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import ConstantCurvatureChain
    >>> from hybridkin.ik import InverseKinematics
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
    ) -> None:
        self.model = model
        self._module = getattr(model, "module_", model)
        if not callable(self._module):
            raise TypeError(
                f"`model` must be a torch module or callable q -> x, got {type(model).__name__}; "
                "an estimator must be fitted first."
            )
        self.q_min = _bound(q_min, "q_min", -math.inf)
        self.q_max = _bound(q_max, "q_max", math.inf)
        self.dq_max = _bound(dq_max, "dq_max", math.inf)
        fixed_pref = None if q_pref is None or callable(q_pref) else _bound(q_pref, "q_pref", 0.0)
        sizes = {
            name: len(value)
            for name, value in (
                ("q_min", self.q_min),
                ("q_max", self.q_max),
                ("dq_max", self.dq_max),
                ("q_pref", fixed_pref),
            )
            if value is not None and value.ndim == 1
        }
        n_actuators: Any = getattr(self._module, "n_actuators", None)
        if n_actuators is not None:
            sizes["model"] = int(n_actuators)
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

    def __repr__(self) -> str:
        """Return the settings."""
        name = type(self._module).__name__
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
            Velocities of the targets [m/s]. Default: at rest.
        x_measured : array-like of shape (..., 3), optional
            Measured tips [m], to close the loop on. Default: the model's tips.

        Returns
        -------
        Step
            `dq` and what came with it. A row with a NaN or infinite input holds still.
        """
        as_numpy = not isinstance(q, Tensor)
        q = self._configurations(q, "q")
        target = self._points(x_target, "x_target", q)
        velocity = None if dx is None else self._points(dx, "dx", q)
        tip = None if x_measured is None else self._points(x_measured, "x_measured", q)
        given = [a for a in (q, target, velocity, tip) if a is not None]
        lead = _lead(given)
        q, target = _flat(q, lead), _flat(target, lead)
        x, J = self._evaluate(q)
        e = target - (x if tip is None else _flat(tip, lead))
        gain, beta = self._rates(self.dt)
        v = gain * e
        if velocity is not None:
            v = v + self.dt * _flat(velocity, lead)
        move = self._advance(q, J, v, beta, self.dt)
        results = (move.dq, x, e.norm(dim=-1), move.sigma_min, move.damping, move.saturated)
        return Step(*_give_back(results, lead, as_numpy))

    @torch.no_grad()
    def solve(
        self,
        x_target: Any,
        q0: Any = None,
        *,
        tol: float = 1e-4,
        max_iter: int = 50,
        restarts: int = 0,
        random_state: Any = None,
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
        tol : float, default=1e-4
            Error that counts as reached [m].
        max_iter : int, default=50
            Iterations per start.
        restarts : int, default=0
            Further starts for rows that failed: `q_pref` first where `q0` was given, then drawn
            in the limits, the same for every row.
        random_state : int, Generator or None, default=None
            Seed of the restarts.

        Returns
        -------
        IKSolution
            Never raises for an unreachable target; a NaN target marks only its own row.
        """
        if not tol > 0:
            raise ValueError(f"`tol` must be positive [m], got {tol!r}.")
        if max_iter < 1 or restarts < 0:
            raise ValueError(
                f"`max_iter` must be at least 1 and `restarts` at least 0, got {max_iter} and "
                f"{restarts}."
            )
        as_numpy = not isinstance(x_target, Tensor)
        target = self._points(x_target, "x_target", None)
        q = self._start(target) if q0 is None else self._configurations(q0, "q0", target)
        target = target.to(q.dtype)
        lead = _lead([q, target])
        q, target = self._inside(_flat(q, lead)), _flat(target, lead)
        found = self._search(q, target, tol, max_iter)
        gram = row_gram(found.J)
        singular = gram.sigma_min < _HEALTHY * gram.sigma_max
        lost = found.stationary & (found.error > tol) & singular
        self._try_again(found, lost, self._nudged(found), target, tol, max_iter)
        for point in self._restarts(q, restarts, random_state, q0 is not None):
            failed = found.error > tol
            self._try_again(found, failed, point.expand_as(q), target, tol, max_iter)
        self._settle(found, target, tol)
        x, J = self._evaluate(found.q)
        error, gram = (target - x).norm(dim=-1), row_gram(J)
        singular = gram.sigma_min < _HEALTHY * gram.sigma_max
        status = self._statuses(found.q, error, tol, found.held, singular)
        nearest = found.stationary & (error > tol) & torch.isfinite(error)
        status[nearest] = IKStatus.UNREACHABLE
        results = (found.q, x, error, status, found.n_iter, gram.sigma_min)
        return IKSolution(*_give_back((*results, self._margin(found.q)), lead, as_numpy))

    @torch.no_grad()
    def track(
        self,
        path: Any,
        t: Any = None,
        *,
        q0: Any = None,
        plant: Callable[[Any], Any] | None = None,
        feedback: str | None = "model",
        tol: float = 1e-4,
        progress: Callable[[int, int], None] | None = None,
    ) -> Track:
        """Return the motion that follows a path, one step per point, eq. (1).

        The feed-forward is the difference to the next point. With gain 1 / dt and feedback the
        error is of second order in the period, without feedback of first order.

        Parameters
        ----------
        path : array-like of shape (T, 3) or Trajectory
            Points to pass [m]; an object with `x` and `t` brings its own times.
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
        if feedback not in ("model", "measured", None):
            raise ValueError(f'`feedback` must be "model", "measured" or None, got {feedback!r}.')
        if feedback == "measured" and plant is None:
            raise ValueError('`feedback="measured"` needs `plant`, a callable q -> measured tip.')
        if hasattr(path, "x") and hasattr(path, "t"):
            path, t = path.x, path.t if t is None else t
        as_numpy = not isinstance(path, Tensor)
        target = self._points(path, "path", None)
        if target.ndim != 2 or len(target) == 0:
            raise ValueError(f"`path` must have shape (T, 3), got {tuple(target.shape)}.")
        times, periods = self._times(t, target)
        if q0 is None:
            q = _tensor(self.solve(target[0], tol=tol).q, "q0")[None]
        else:
            q = self._configurations(q0, "q0", target)
            if q.ndim != 1:
                raise ValueError(f"`q0` must have shape (n,), got {tuple(q.shape)}.")
            q, target = q[None], target.to(q.dtype)
        points: list[_Point] = []
        held = damped = target.new_zeros(1, dtype=torch.bool)
        for i in range(len(target)):
            if progress is not None:
                progress(i, len(target))
            x, J = self._evaluate(q)
            measured = x if plant is None else _measure(plant, q, i, as_numpy)
            points.append(_Point(q, x, measured, row_gram(J).sigma_min, held, damped))
            if i + 1 == len(target):
                break
            gain, beta = self._rates(periods[i])
            v = _known(target[i + 1] - target[i])[None]
            if feedback is not None:
                v = v + gain * _known(target[i] - (measured if feedback == "measured" else x))
            move = self._advance(q, J, v, beta, periods[i])
            q = q + move.dq
            held, damped = move.saturated.any(-1), move.damping > 0.0
        q, x, measured, sigma_min, held, damped = (torch.cat(a) for a in zip(*points, strict=True))
        error = (target - measured).norm(dim=-1)
        judged = error if feedback == "measured" else (target - x).norm(dim=-1)
        status = self._statuses(q, judged, tol, held, damped)
        status[~torch.isfinite(error)] = IKStatus.INVALID_INPUT
        results = (q, x, measured, target, error, status, sigma_min, self._margin(q))
        times, *results = _give_back((times, *results), (len(target),), as_numpy)
        if plant is None:
            results[2] = None
        return Track(times, *results)

    def _advance(self, q: Tensor, J: Tensor, v: Tensor, beta: float, period: float) -> _Move:
        """Return eq. (1) for one period; rows that are not finite hold still."""
        fine = torch.isfinite(q).all(-1) & torch.isfinite(J).all(-1).all(-1)
        fine = (fine & torch.isfinite(v).all(-1))[:, None]
        at = torch.where(fine, q, 0.0)
        posture = None
        if self.q_pref is not None and beta > 0.0:
            posture = torch.where(fine, beta * (self._preferred(at) - at), 0.0)
        bounds = self._step_bounds(q, self.dq_max.to(q) * period)
        J, v = torch.where(fine[..., None], J, 0.0), torch.where(fine, v, 0.0)
        move = self._resolve(J, v, posture, *bounds)
        return move._replace(
            dq=torch.where(torch.isnan(q), 0.0, move.dq),
            sigma_min=torch.where(fine[:, 0], move.sigma_min, math.nan),
        )

    def _resolve(
        self,
        J: Tensor,
        v: Tensor,
        posture: Tensor | None,
        lower: Tensor,
        upper: Tensor,
        extra_sq: Tensor | float = 0.0,
    ) -> _Move:
        """Return the step for the task v and the posture step, within the bounds."""
        gram = row_gram(J)
        if self.damping == "adaptive":
            damping_sq = adaptive_damping(gram, _HEALTHY) + extra_sq * gram.sigma_max.square()
        else:
            damping_sq = (float(self.damping) ** 2 + extra_sq) * gram.sigma_max.square()
        dq = apply_columns(J, damped_solve(gram, v, damping_sq))
        z = torch.zeros_like(dq)
        if posture is not None:
            z = null_projection(J, gram, posture)
            dq = dq + z
        if self.limits != "off":
            clipped = torch.clamp(dq, lower, upper)
            over = (clipped != dq).any(-1).nonzero()[:, 0]
            if self.limits == "saturate" and over.numel() > 0:
                problem = (a[over] for a in (J, v, z, lower, upper, damping_sq))
                clipped[over] = strict_box_step(*problem)
            dq = clipped
        saturated = (dq <= lower) | (dq >= upper)
        return _Move(dq, gram.sigma_min, damping_sq.sqrt(), saturated)

    def _search(self, q: Tensor, target: Tensor, tol: float, max_iter: int) -> _Found:
        """Lower the tip error from one start until it is within tol or cannot be lowered."""
        found = _Found.at(q, *self._evaluate(q), target)
        rows = torch.arange(len(q), device=q.device)
        nu = q.new_full((len(q),), _FIRST_DAMPING)  # lambda^2 / sigma_max^2 of the whole error
        start = [a.clone() for a in (q, found.x, found.J, found.error, target, found.error)]
        live = [*start, nu, torch.full_like(nu, 2.0), torch.zeros_like(nu)]
        held = found.held.clone()
        for iteration in range(max_iter + 1):
            q, x, J, error, aim, first, nu, growth, slow = live
            still = self._blocked(q, J, aim - x) | (nu > _LAST_DAMPING) | (slow >= _SLOW_STEPS)
            found.put(rows, q, x, J, error, still, held)
            found.n_iter[rows] = iteration
            going = ((error > tol) & ~still).nonzero()[:, 0]
            if going.numel() == 0 or iteration == max_iter:
                break
            rows, live = rows[going], [a[going] for a in live]
            q, x, J, error, aim, first, nu, growth, slow = live
            bounds = self._step_bounds(q, None)
            e = aim - x
            # Error-proportional, so that the last iterations are Gauss-Newton's.
            move = self._resolve(J, e, None, *bounds, nu * (error / first))
            new = q + move.dq
            x_new, J_new = self._evaluate(new)
            error_new = (aim - x_new).norm(dim=-1)
            predicted = (e - apply_rows(J, move.dq)).norm(dim=-1)
            gained = error.square() - error_new.square()
            quality = gained / (error.square() - predicted.square()).clamp_min(1e-30)
            better = error_new < error
            held = move.saturated.any(-1)
            nu = torch.where(
                better, nu * (1.0 - (2.0 * quality - 1.0) ** 3).clamp(1.0 / 3.0, 2.0), nu * growth
            )
            growth = torch.where(better, 2.0, 2.0 * growth)
            slow = torch.where(better & (error - error_new < 0.01 * tol), slow + 1.0, 0.0)
            pick = better[:, None]
            live = [
                *(torch.where(pick, new, q), torch.where(pick, x_new, x)),
                *(torch.where(pick[..., None], J_new, J), torch.where(better, error_new, error)),
                *(aim, first, nu, growth, slow),
            ]
        return found

    def _try_again(
        self, found: _Found, rows: Tensor, q: Tensor, target: Tensor, tol: float, max_iter: int
    ) -> None:
        """Search some rows from another start, and keep what came nearer."""
        rows = rows.nonzero()[:, 0]
        if rows.numel() == 0:
            return
        again = self._search(self._inside(q[rows]), target[rows], tol, max_iter)
        found.n_iter[rows] += again.n_iter
        better = again.error < found.error[rows]
        found.put(rows[better], *(part[better] for part in again.parts()))

    def _nudged(self, found: _Found) -> Tensor:
        """Return starts beside singular points, where the first-order motion is blind.

        A straight backbone asked to shorten, or a stretched arm: the error is stationary without
        being smallest. The way out is of second order, hence not short where the error is small:
        5 % of the limits, or what moves a healthy tip by a tenth of the error.
        """
        n = found.q.shape[-1]
        size = found.J.flatten(1).norm(dim=-1, keepdim=True)
        size = torch.where(size > 0.0, 0.1 * found.error[:, None] / size, 0.0).expand_as(found.q)
        span = 0.05 * (self.q_max - self.q_min).to(found.q)
        size = torch.where(torch.isfinite(span), torch.maximum(size, span), size)
        # Unequal shares, because equal ones may cancel in a symmetric robot.
        return found.q + size * torch.cos(torch.arange(1.0, n + 1.0).to(found.q))

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

    def _settle(self, found: _Found, target: Tensor, tol: float) -> None:
        """Slide converged rows along their null space towards q_pref, then polish the tip.

        On the way the error may exceed tol by a share of the motion, for the next step takes it
        back; only what has converged is recorded.
        """
        rows = (found.error <= tol).nonzero()[:, 0]
        if self.q_pref is None or self.beta == 0.0 or rows.numel() == 0:
            return
        all_rows, nearest = rows, (self._preferred(found.q) - found.q).norm(dim=-1)
        live = [a[rows] for a in (found.q, found.x, found.J, target, nearest)]
        share = torch.ones_like(live[-1])
        for iteration in range(_POSTURE_STEPS):
            q, x, J, aim, gap = live
            task_only = iteration == _POSTURE_STEPS - 1
            posture = None if task_only else share[:, None] * (self._preferred(q) - q)
            move, new, x_new, J_new, error_new = self._try_step(q, x, J, aim, posture)
            gap_new = (self._preferred(new) - new).norm(dim=-1)
            loose = _POSTURE_SLIP * J.flatten(1).norm(dim=-1) * move.dq.norm(dim=-1)
            ok = (error_new <= loose.clamp_min(tol)) & (gap_new < gap) | task_only
            error = (aim - x).norm(dim=-1)
            ok |= (error > tol) & (error_new < 0.5 * error)
            record = ok & (error_new <= tol) & (gap_new < nearest[rows])
            nearest[rows[record]] = gap_new[record]
            found.put(rows[record], *(a[record] for a in (new, x_new, J_new, error_new)))
            found.n_iter[rows] += 1
            going = torch.where(
                ok, (gap - gap_new > 1e-3 * gap) | (error_new > tol) | (error > tol), share > 0.01
            )
            share = torch.where(ok, (2.0 * share).clamp_max(1.0), 0.25 * share)[going]
            new, x_new, J_new, gap_new = (
                torch.where(ok.view(-1, *[1] * (b.ndim - 1)), b, a)
                for a, b in ((q, new), (x, x_new), (J, J_new), (gap, gap_new))
            )
            rows, live = rows[going], [a[going] for a in (new, x_new, J_new, aim, gap_new)]
            if rows.numel() == 0:
                break
        q, x, J, aim = (a[all_rows] for a in (found.q, found.x, found.J, target))
        _, *ended, error_new = self._try_step(q, x, J, aim, None)
        better = error_new < found.error[all_rows]
        found.put(all_rows[better], *(a[better] for a in (*ended, error_new)))

    def _try_step(
        self, q: Tensor, x: Tensor, J: Tensor, target: Tensor, posture: Tensor | None
    ) -> tuple[_Move, Tensor, Tensor, Tensor, Tensor]:
        """Return a step, and q, x, J and the error after it."""
        move = self._resolve(J, target - x, posture, *self._step_bounds(q, None))
        new = q + move.dq
        x_new, J_new = self._evaluate(new)
        return move, new, x_new, J_new, (target - x_new).norm(dim=-1)

    def _statuses(
        self, q: Tensor, error: Tensor, tol: float, held: Tensor, singular: Tensor
    ) -> Tensor:
        status = torch.full(error.shape, IKStatus.MAX_ITER.value, device=error.device)
        status[singular] = IKStatus.SINGULAR
        status[held] = IKStatus.AT_LIMITS
        status[error <= tol] = IKStatus.CONVERGED
        in_domain = getattr(self._module, "in_domain", None)
        if in_domain is not None and len(q) > 0:
            inside = torch.as_tensor(in_domain(q), device=q.device)
            status[(error <= tol) & ~inside] = IKStatus.OUT_OF_DOMAIN
        status[~torch.isfinite(error)] = IKStatus.INVALID_INPUT
        return status

    def _blocked(self, q: Tensor, J: Tensor, e: Tensor) -> Tensor:
        """Return where no motion within the limits lowers the error to first order."""
        lower, upper = self._box(q)
        pull = apply_columns(J, e)
        out = ((q >= upper) & (pull > 0.0)) | ((q <= lower) & (pull < 0.0))
        left = torch.where(out, 0.0, pull).norm(dim=-1)
        return left <= _STATIONARY * J.flatten(1).norm(dim=-1) * e.norm(dim=-1)

    def _box(self, q: Tensor) -> tuple[Tensor, Tensor]:
        if self.limits == "off":
            return q.new_tensor(-math.inf), q.new_tensor(math.inf)
        return self.q_min.to(q), self.q_max.to(q)

    def _inside(self, q: Tensor) -> Tensor:
        return torch.clamp(q, *self._box(q))

    def _step_bounds(self, q: Tensor, largest: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the bounds of dq: position and speed intersected, never empty.

        From outside the limits both bounds meet at the way back, at most the largest step. The
        nextafter makes q + upper <= q_max hold after rounding, and with it q + dq for every dq.
        """
        q_min, q_max = self._box(q)
        lower, upper = q_min - q, q_max - q
        up, down = torch.full_like(q, math.inf), torch.full_like(q, -math.inf)
        upper = torch.where(q + upper > q_max, torch.nextafter(upper, down), upper)
        lower = torch.where(q + lower < q_min, torch.nextafter(lower, up), lower)
        if self.limits != "off" and largest is not None:
            lower = torch.clamp(lower, -largest, largest)
            upper = torch.clamp(upper, -largest, largest)
        return lower, upper

    def _margin(self, q: Tensor) -> Tensor:
        return torch.minimum(q - self.q_min.to(q), self.q_max.to(q) - q).amin(-1)

    def _rates(self, period: float) -> tuple[float, float]:
        """Return gain dt and beta dt, both at most 1."""
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
        return min(gain, 1.0), min(beta, 1.0)

    def _evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = forward_and_jacobian(self._module, q)
        if x.shape != (*q.shape[:-1], 3):
            raise ValueError(
                f"`model` must map q of shape {tuple(q.shape)} to tips of shape "
                f"{(*q.shape[:-1], 3)}, got {tuple(x.shape)}."
            )
        return x.to(q), J.to(q)

    def _preferred(self, q: Tensor) -> Tensor:
        """Return the preferred configurations, of shape (n,) or that of q."""
        wanted: Any = self.q_pref(q) if callable(self.q_pref) else self.q_pref
        return wanted.to(q)

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
        return self._preferred(start) if callable(self.q_pref) else start

    def _configurations(self, value: Any, name: str, like: Tensor | None = None) -> Tensor:
        q = _tensor(value, name, self._device() if like is None else like.device)
        if q.ndim == 0 or self._size not in (None, q.shape[-1]):
            n = "n" if self._size is None else self._size
            raise ValueError(
                f"`{name}` must have shape (..., {n}), got {tuple(q.shape)}; the last axis is the "
                "actuators."
            )
        return q if like is None else q.to(torch.promote_types(q.dtype, like.dtype))

    def _points(self, value: Any, name: str, like: Tensor | None) -> Tensor:
        x = _tensor(value, name, self._device())
        if x.ndim == 0 or x.shape[-1] != 3:
            raise ValueError(
                f"`{name}` must have shape (..., 3) [m], got {tuple(x.shape)}; one tip per row."
            )
        return x if like is None else x.to(like)

    def _times(self, t: Any, target: Tensor) -> tuple[Tensor, list[float]]:
        n = len(target)
        if t is None:
            steps = torch.arange(n, dtype=target.dtype, device=target.device)
            return self.dt * steps, [self.dt] * (n - 1)
        times = _tensor(t, "t", target.device)
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

    def _device(self) -> torch.device:
        if isinstance(self._module, nn.Module):
            for tensor in (*self._module.parameters(), *self._module.buffers()):
                return tensor.device
        return torch.device("cpu")


class _Move(NamedTuple):
    dq: Tensor
    sigma_min: Tensor
    damping: Tensor
    saturated: Tensor


class _Point(NamedTuple):
    q: Tensor
    x: Tensor
    measured: Tensor
    sigma_min: Tensor
    held: Tensor
    damped: Tensor


@dataclass
class _Found:
    """The best points so far of every row, owned by `solve` and updated in place."""

    q: Tensor
    x: Tensor
    J: Tensor
    error: Tensor
    stationary: Tensor
    held: Tensor
    n_iter: Tensor

    @classmethod
    def at(cls, q: Tensor, x: Tensor, J: Tensor, target: Tensor) -> _Found:
        no = torch.zeros(len(q), dtype=torch.bool, device=q.device)
        error = (target - x).norm(dim=-1)
        return cls(q.clone(), x.clone(), J.clone(), error, no, no.clone(), no.long().clone())

    def put(self, rows: Tensor, *parts: Tensor) -> None:
        """Overwrite rows of the leading fields."""
        for whole, part in zip(self.parts(), parts, strict=False):
            whole[rows] = part

    def parts(self) -> tuple[Tensor, ...]:
        return self.q, self.x, self.J, self.error, self.stationary, self.held


def _measure(plant: Callable[[Any], Any], q: Tensor, i: int, as_numpy: bool) -> Tensor:
    """Return the plant's tip (1, 3), NaN where it fails: what was done must not be lost."""
    try:
        tip = _tensor(plant(as_array(q[0]).copy() if as_numpy else q[0].clone()), "tip", q.device)
        if tip.shape != (3,):
            raise ValueError(f"the measured tip must have shape (3,), got {tuple(tip.shape)}")
    except Exception as error:
        warnings.warn(f"`plant` failed at point {i}: {error!r}; it counts as NaN.", stacklevel=4)
        return q.new_full((1, 3), math.nan)
    return tip.to(q)[None]


def _bound(value: Any, name: str, default: float) -> Tensor:
    """Return a limit or posture as a float64 tensor of shape () or (n,)."""
    bound = _tensor(default if value is None else value, name).cpu().double()
    if bound.ndim > 1 or bound.numel() == 0 or torch.isnan(bound).any():
        raise ValueError(
            f"`{name}` must be a number or of shape (n,), without NaN, got {bound.tolist()}."
        )
    return bound


def _tensor(value: Any, name: str, device: Any = None) -> Tensor:
    """Return a floating tensor that shares no memory with a caller's array."""
    if not isinstance(value, Tensor):
        try:
            value = torch.tensor(np.asarray(value), device=device)
        except (TypeError, ValueError) as error:
            raise ValueError(f"`{name}` must be numeric, got {value!r}.") from error
    value = value.detach()
    return value if value.is_floating_point() else value.double()


def _known(v: Tensor) -> Tensor:
    """Return v, or zero where the target or the measured tip is not known."""
    return torch.where(torch.isfinite(v).all(-1, keepdim=True), v, 0.0)


def _lead(tensors: list[Tensor]) -> tuple[int, ...]:
    shapes = [tuple(a.shape[:-1]) for a in tensors]
    try:
        return tuple(torch.broadcast_shapes(*shapes))
    except RuntimeError as error:
        raise ValueError(
            f"configurations and targets must agree in their batch shapes, got {shapes}."
        ) from error


def _flat(a: Tensor, lead: tuple[int, ...]) -> Tensor:
    return a.expand(*lead, a.shape[-1]).reshape(math.prod(lead), a.shape[-1])


def _give_back(results: Any, lead: tuple[int, ...], as_numpy: bool) -> list[Any]:
    shaped = [a.reshape((*lead, *a.shape[1:])) for a in results]
    return [as_array(a) for a in shaped] if as_numpy else shaped
