"""Exact least-squares steps within a box of limits."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import IK_NEWTON, IK_PROXIMAL
from hybridkin.ik._gram import apply_columns, apply_rows, solve_rows


class BoxProblem(NamedTuple):
    """Eq. (19): minimise |dq - z|^2 + |J dq - v|^2 / lambda^2 with lower <= dq <= upper, by rows.

    Attributes
    ----------
    J : Tensor of shape (N, m, n)
        Jacobians.
    v : Tensor of shape (N, m)
        Desired task steps J dq.
    z : Tensor of shape (N, n)
        Preferred steps; the optimum is as near to them as the task allows.
    damping_sq : Tensor of shape (N,)
        lambda^2, in the unit of J J^T.
    lower, upper : Tensor of shape (N, n)
        Bounds of the step, lower <= upper.
    """

    J: Tensor
    v: Tensor
    z: Tensor
    damping_sq: Tensor
    lower: Tensor
    upper: Tensor

    def take(self, rows: Tensor) -> BoxProblem:
        """Return the problems of some rows."""
        return BoxProblem(*(a[rows] for a in self))

    def clip(self, y: Tensor) -> Tensor:
        """Return steps clipped to the box."""
        return torch.clamp(y, self.lower, self.upper)

    def unlimited(self, mu: Tensor) -> Tensor:
        """Return y = z + J^T mu, the step for multipliers mu without the box."""
        return self.z + apply_columns(self.J, mu)


def box_limited_step(problem: BoxProblem, mu: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Return the exact minimiser of |dq - z|^2 + |J dq - v|^2 / lambda^2 in the box.

    The minimiser is dq(mu) = clip(z + J^T mu, lower, upper), where mu in R^m is the root of
    F(mu) = J dq(mu) + lambda^2 mu - v. F is the gradient of a strongly convex, piecewise
    quadratic function. Newton's method on its active pieces, with an exact line search along the
    few breakpoints, therefore reaches the optimum after a finite number of steps.

    Parameters
    ----------
    problem : BoxProblem
        With lambda^2 > 0, not much below 1e-6 of the largest eigenvalue of J J^T in float64.
    mu : Tensor of shape (N, m), optional
        Start of the iteration. Default: zero.

    Returns
    -------
    dq : Tensor of shape (N, n)
        The optimal steps, within the box.
    mu : Tensor of shape (N, m)
        Their multipliers, (v - J dq) / lambda^2.

    References
    ----------
    Hiriart-Urruty, Strodiot & Nguyen, Appl. Math. Optim. 11 (1984); Qi & Sun, Math. Program. 58
    (1993), for semismooth Newton methods.
    """
    if mu is None:
        mu = torch.zeros_like(problem.v)
    best = mu.clone()
    live = problem  # the rows that are not solved yet
    rows = torch.arange(len(mu), device=mu.device)
    settled = torch.zeros_like(rows, dtype=torch.bool)
    noise = 4.0 * torch.finfo(mu.dtype).eps
    for _ in range(IK_NEWTON):
        # The residual F(mu) of eq. (20), and the size of what is summed up in it.
        y = live.unlimited(mu)
        dq = live.clip(y)
        pull = live.damping_sq[:, None] * mu
        residual = apply_rows(live.J, dq) + pull - live.v
        size = apply_rows(live.J.abs(), dq.abs()) + pull.abs() + live.v.abs()
        best[rows] = mu

        # Go on with the rows that are not solved up to rounding.
        unsolved = (residual.abs() > noise * size).any(-1)
        # One question for each iteration: a device waits for the answer.
        left = (unsolved & ~settled).nonzero()[:, 0]
        if len(left) < len(rows):
            live = live.take(left)
            rows = rows[left]
            mu = mu[left]
            y = y[left]
            residual = residual[left]
        if rows.numel() == 0:
            break

        # Newton's step of F on the linear piece of y: actuators at a limit stay there.
        above = y > live.lower
        below = y < live.upper
        J_free = live.J * (above & below)[:, None]
        newton = -solve_rows(J_free, residual, live.damping_sq)
        slope = apply_columns(live.J, newton)

        # A full step that stays on its linear piece has solved the problem.
        end = y + slope
        same_lower = (end > live.lower) == above
        same_upper = (end < live.upper) == below
        fixed = live.lower == live.upper
        settled = (same_lower & same_upper | fixed).all(-1)

        # Else it ends where the objective is least along it.
        length = torch.ones_like(live.damping_sq)
        at_start = (newton * residual).sum(-1)
        curvature = live.damping_sq * newton.square().sum(-1)
        line = _Line(y, slope, at_start, curvature, live.lower, live.upper)
        at_end = line.derivative(length[:, None])[:, 0]
        too_far = ((at_end > 0.0) & ~settled).nonzero()[:, 0]
        if too_far.numel() > 0:
            length[too_far] = line.take(too_far).root()
        mu = mu + length[:, None] * newton
    best[rows] = mu
    return problem.clip(problem.unlimited(best)), best


def proximal_box_step(problem: BoxProblem, centre: Tensor) -> tuple[Tensor, Tensor]:
    """Return `box_limited_step` for any lambda^2 >= 0.

    Below 1e-6 of sigma_max^2 (float64) this minimum is used, and proximal rounds from the
    multipliers `centre` (N, m) remove its effect. Every round solves
    J dq + used mu = v + (used - lambda^2) mu_last. At the fixed point J dq + lambda^2 mu = v.
    """
    J = problem.J
    size_sq = torch.linalg.matrix_norm(J @ J.mT)  # about sigma_max^2
    # If J is zero the floor only has to be positive.
    relative = max(1e-6, math.sqrt(torch.finfo(J.dtype).eps))
    floor = torch.where(size_sq > 0.0, relative * size_sq, 1.0)
    used = torch.maximum(problem.damping_sq, floor)
    excess = (used - problem.damping_sq)[:, None]
    dq = problem.z
    mu = centre
    for _ in range(1 + IK_PROXIMAL):
        v = problem.v + excess * mu
        damped = problem._replace(v=v, damping_sq=used)
        dq, mu = box_limited_step(damped, mu)
    return dq, mu


class _Line(NamedTuple):
    """The derivative of the objective along Newton steps, F(mu + t newton) . newton.

    It is at_start + t curvature + slope . (clip(y + t slope) - clip(y)). It increases with t, and
    is linear between the points where an actuator reaches a bound.
    """

    y: Tensor
    slope: Tensor
    at_start: Tensor
    curvature: Tensor
    lower: Tensor
    upper: Tensor

    def take(self, rows: Tensor) -> _Line:
        """Return the lines of some rows."""
        return _Line(*(a[rows] for a in self))

    def derivative(self, t: Tensor) -> Tensor:
        """Return the derivative at points t (N, k) of every line."""
        y = self.y[:, None]
        slope = self.slope[:, None]
        lower = self.lower[:, None]
        upper = self.upper[:, None]
        end = y + t[..., None] * slope
        moved = torch.clamp(end, lower, upper) - torch.clamp(y, lower, upper)
        free = self.at_start[:, None] + t * self.curvature[:, None]
        return free + (slope * moved).sum(-1)

    def root(self) -> Tensor:
        """Return t in (0, 1) of the root, for lines that are negative at 0 and positive at 1."""
        # The points where an actuator reaches a bound, and both ends, in order.
        to_lower = (self.lower - self.y) / self.slope
        to_upper = (self.upper - self.y) / self.slope
        at_bounds = torch.cat([to_lower, to_upper], dim=-1)
        at_bounds = at_bounds.nan_to_num(nan=1.0).clamp(0.0, 1.0)
        first = torch.zeros_like(at_bounds[:, :1])
        points = torch.cat([first, at_bounds, first + 1.0], dim=-1)
        t = points.sort(-1).values

        # The root lies on the linear part before the first positive value.
        value = self.derivative(t)
        positive = (value > 0.0).to(torch.uint8)
        right = positive.argmax(-1, keepdim=True).clamp_min(1)
        left = right - 1
        t_left = t.gather(-1, left)
        t_right = t.gather(-1, right)
        value_left = value.gather(-1, left)
        fall = value_left - value.gather(-1, right)
        fraction = (value_left / fall).nan_to_num(nan=1.0).clamp(0.0, 1.0)
        t = t_left + (t_right - t_left) * fraction
        return t[:, 0]
