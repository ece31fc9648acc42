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
    lower, upper : Tensor of shape (N, n)
        Bounds of the step, lower <= upper.
    """

    J: Tensor
    v: Tensor
    z: Tensor
    lower: Tensor
    upper: Tensor

    def take(self, rows: Tensor) -> BoxProblem:
        """Return the problems of some rows."""
        return BoxProblem(*(a[rows] for a in self))

    def at(self, mu: Tensor) -> tuple[Tensor, Tensor]:
        """Return y = z + J^T mu, and dq, which is y clipped to the box."""
        y = self.z + apply_columns(self.J, mu)
        return y, torch.clamp(y, self.lower, self.upper)


def box_limited_step(
    problem: BoxProblem, damping_sq: Tensor, mu: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Return the exact minimiser of |dq - z|^2 + |J dq - v|^2 / lambda^2 in the box.

    The minimiser is dq(mu) = clip(z + J^T mu, lower, upper), where mu in R^m is the root of
    F(mu) = J dq(mu) + lambda^2 mu - v. F is the gradient of a strongly convex, piecewise
    quadratic function. Newton's method on its active pieces, with an exact line search along the
    few breakpoints, therefore reaches the optimum after a finite number of steps.

    Parameters
    ----------
    problem : BoxProblem
        Jacobians, desired and preferred steps, bounds.
    damping_sq : Tensor of shape (N,)
        lambda^2 > 0, in the unit of J J^T; not much below 1e-6 of its largest eigenvalue in
        float64.
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
    settled = torch.zeros(len(mu), dtype=torch.bool, device=mu.device)
    noise = 4.0 * torch.finfo(mu.dtype).eps
    for _ in range(IK_NEWTON):
        # The residual F(mu) of eq. (20), and the size of what is summed up in it.
        y, dq = live.at(mu)
        pull = damping_sq[:, None] * mu
        residual = apply_rows(live.J, dq) + pull - live.v
        size = apply_rows(live.J.abs(), dq.abs()) + pull.abs() + live.v.abs()
        best[rows] = mu
        # Go on with the rows that are not solved up to rounding.
        going = ~settled & (residual.abs() > noise * size).any(-1)
        if not going.all():
            left = going.nonzero()[:, 0]
            live = live.take(left)
            rows = rows[left]
            mu = mu[left]
            damping_sq = damping_sq[left]
            y = y[left]
            residual = residual[left]
        if rows.numel() == 0:
            break
        # Newton's step of F on the linear piece of y: actuators at a limit stay there.
        lower = live.lower
        upper = live.upper
        free = (y > lower) & (y < upper)
        newton = -solve_rows(live.J * free[:, None], residual, damping_sq)
        slope = apply_columns(live.J, newton)
        # A full step that stays on its linear piece has solved the problem.
        end = y + slope
        same = ((end > lower) == (y > lower)) & ((end < upper) == (y < upper))
        settled = (same | (lower == upper)).all(-1)
        # Else the step ends where the objective is least along it: there its derivative,
        # F(mu + t newton) . newton, is zero.
        at_start = (newton * residual).sum(-1)
        curvature = damping_sq * newton.square().sum(-1)
        moved = (slope * _moved(y, end, lower, upper)).sum(-1)
        too_far = ((at_start + curvature + moved > 0.0) & ~settled).nonzero()[:, 0]
        length = torch.ones_like(damping_sq)
        if too_far.numel() > 0:
            line = (y, slope, at_start, curvature, lower, upper)
            length[too_far] = _exact_line_search(*(a[too_far] for a in line))
        mu = mu + length[:, None] * newton
    best[rows] = mu
    return problem.at(best)[1], best


def strict_box_step(problem: BoxProblem, damping_sq: Tensor) -> Tensor:
    """Return the box-limited step whose task part does not depend on the preferred step z.

    Without damping, z only chooses among the steps that reach v, or come nearest to it. Damping
    would be a compromise between v and z. Therefore the damped task is first solved in the box for
    z = 0; z then chooses among the steps with the same tip motion.

    Parameters
    ----------
    problem : BoxProblem
        Jacobians, desired and preferred steps, bounds.
    damping_sq : Tensor of shape (N,)
        lambda^2 >= 0. Below 1e-6 of sigma_max^2 (float64) the box-limited step is solved with this
        minimum, and proximal rounds on the multipliers remove its task error.

    Returns
    -------
    Tensor of shape (N, n)
        Steps within the box.
    """
    J = problem.J
    size_sq = torch.linalg.matrix_norm(J @ J.mT)  # about sigma_max^2
    # If J is zero the floor only has to be positive.
    relative = max(1e-6, math.sqrt(torch.finfo(J.dtype).eps))
    floor = torch.where(size_sq > 0.0, relative * size_sq, 1.0)
    centre = torch.zeros_like(problem.v)
    rows = ((damping_sq > 0.0) & (problem.z != 0.0).any(-1)).nonzero()[:, 0]
    if rows.numel() > 0:
        # The damped task without posture; its tip motion replaces v.
        damped = problem._replace(z=torch.zeros_like(problem.z)).take(rows)
        dq, mu = _proximal_box_step(damped, damping_sq[rows], floor[rows], centre[rows])
        v = problem.v.index_put((rows,), apply_rows(damped.J, dq))
        problem = problem._replace(v=v)
        # Start from these multipliers: they keep the active limits, also if v is out of reach.
        centre[rows] = mu
        damping_sq = damping_sq.index_fill(0, rows, 0.0)
    return _proximal_box_step(problem, damping_sq, floor, centre)[0]


def _proximal_box_step(
    problem: BoxProblem, damping_sq: Tensor, floor: Tensor, centre: Tensor
) -> tuple[Tensor, Tensor]:
    """Return `box_limited_step` for any lambda^2 >= 0, without the effect of the floor.

    Every round solves J dq + used mu = v + (used - lambda^2) mu_last. At the fixed point
    J dq + lambda^2 mu = v.
    """
    used = torch.maximum(damping_sq, floor)
    excess = (used - damping_sq)[:, None]
    dq = problem.z
    mu = centre
    for _ in range(1 + IK_PROXIMAL):
        dq, mu = box_limited_step(problem._replace(v=problem.v + excess * mu), used, mu)
    return dq, mu


def _moved(y: Tensor, end: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Return the motion from y to its end, both clipped to the box."""
    return torch.clamp(end, lower, upper) - torch.clamp(y, lower, upper)


def _exact_line_search(
    y: Tensor,
    slope: Tensor,
    at_start: Tensor,
    curvature: Tensor,
    lower: Tensor,
    upper: Tensor,
) -> Tensor:
    """Return t in (0, 1) where at_start + t curvature + slope . (clip(y + t slope) - clip(y)) = 0.

    The left side increases with t, is linear between the points where a coordinate reaches a bound,
    negative at 0 and positive at 1.
    """
    # These points, and both ends, in order.
    at_bounds = torch.cat([(lower - y) / slope, (upper - y) / slope], dim=-1)
    at_bounds = torch.nan_to_num(at_bounds, nan=1.0).clamp(0.0, 1.0)
    first = torch.zeros_like(at_start[:, None])
    t = torch.cat([first, at_bounds, first + 1.0], dim=-1).sort(-1).values
    # The left side there.
    y = y[:, None]
    slope = slope[:, None]
    end = y + t[..., None] * slope
    moved = _moved(y, end, lower[:, None], upper[:, None])
    value = at_start[:, None] + t * curvature[:, None] + (slope * moved).sum(-1)
    # The root lies on the linear part before the first positive value.
    right = (value > 0.0).to(torch.uint8).argmax(-1, keepdim=True).clamp_min(1)
    left = right - 1
    t_left = t.gather(-1, left)
    value_left = value.gather(-1, left)
    fall = value_left - value.gather(-1, right)
    fraction = torch.nan_to_num(value_left / fall, nan=1.0).clamp(0.0, 1.0)
    return (t_left + (t.gather(-1, right) - t_left) * fraction)[:, 0]
