"""Damped and box-limited solves with three task rows, batched and in closed form (torch only)."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

_PROXIMAL_ROUNDS = 2


class RowGram(NamedTuple):
    """G = J J^T of a Jacobian with three rows, and its singular values.

    The six entries of G are kept apart, so that a batch costs a few elementwise operations
    instead of a LAPACK call per matrix.
    """

    entries: tuple[Tensor, ...]  # g11, g21, g31, g22, g32, g33
    sigma_min: Tensor
    sigma_max: Tensor


def row_gram(J: Tensor) -> RowGram:
    """Return G = J J^T with the smallest and largest singular value of J, in closed form.

    The singular values are good to sqrt(eps) of the largest, because G holds their squares.

    Parameters
    ----------
    J : Tensor of shape (..., 3, n)
        Jacobians.

    Returns
    -------
    RowGram
        Entries and singular values, each of shape (...,).
    """
    entries = g11, g21, g31, g22, g32, g33 = _gram_entries(J)
    mean = (g11 + g22 + g33) / 3.0
    a, b, c = g11 - mean, g22 - mean, g33 - mean
    off = g21 * g21 + g31 * g31 + g32 * g32
    radius = ((a * a + b * b + c * c + 2.0 * off) / 6.0).sqrt()
    det = a * (b * c - g32 * g32) - g21 * (g21 * c - g32 * g31) + g31 * (g21 * g32 - b * g31)
    ratio = 0.5 * det / radius.pow(3).clamp_min(torch.finfo(J.dtype).tiny)
    angle = torch.acos(ratio.clamp(-1.0, 1.0)) / 3.0
    low = mean + 2.0 * radius * torch.cos(angle + 2.0 * math.pi / 3.0)
    high = mean + 2.0 * radius * torch.cos(angle)
    return RowGram(entries, low.clamp_min(0.0).sqrt(), high.clamp_min(0.0).sqrt())


def damped_solve(gram: RowGram, v: Tensor, damping_sq: Tensor | float = 0.0) -> Tensor:
    """Return mu with (J J^T + lambda^2 1) mu = v, so that J^T mu is the damped inverse step.

    A row of J that depends on the rows before it, to rounding, gets mu = 0: without damping the
    result still inverts the rest.

    Parameters
    ----------
    gram : RowGram
        From `row_gram`, batch shape (...,).
    v : Tensor of shape (..., 3)
        Right-hand sides.
    damping_sq : Tensor of shape (...,) or float, default=0.0
        lambda^2, in the unit of J J^T.

    Returns
    -------
    Tensor of shape (..., 3)
        Multipliers mu.
    """
    return _solve_3x3(gram.entries, v, damping_sq)


def null_projection(J: Tensor, gram: RowGram, step: Tensor) -> Tensor:
    """Return (1 - J+ J) step, the part of a step that does not move the tip.

    The projector is undamped: a damped one would leak lambda^2 / (sigma^2 + lambda^2) of the step
    into the task. Applied twice, which takes the rounding of an ill-conditioned J out again.

    Parameters
    ----------
    J : Tensor of shape (..., 3, n)
        Jacobians.
    gram : RowGram
        Their `row_gram`.
    step : Tensor of shape (..., n)
        Steps.

    Returns
    -------
    Tensor of shape (..., n)
        Projected steps.
    """
    for _ in range(2):
        mu = _solve_3x3(gram.entries, apply_rows(J, step), 0.0)
        step = step - apply_columns(J, mu)
    return step


def apply_rows(J: Tensor, step: Tensor) -> Tensor:
    """Return J step, shape (..., 3), for steps of shape (..., n)."""
    return (J @ step[..., None])[..., 0]


def apply_columns(J: Tensor, mu: Tensor) -> Tensor:
    """Return J^T mu, shape (..., n), for mu of shape (..., 3)."""
    return (mu[..., None, :] @ J)[..., 0, :]


def box_limited_step(
    J: Tensor,
    v: Tensor,
    z: Tensor,
    lower: Tensor,
    upper: Tensor,
    damping_sq: Tensor,
    mu: Tensor | None = None,
    *,
    max_iter: int = 60,
) -> tuple[Tensor, Tensor]:
    """Return the exact minimiser of |dq - z|^2 + |J dq - v|^2 / lambda^2 in the box.

    The minimiser is dq(mu) = clip(z + J^T mu, lower, upper) with mu in R^3 the root of
    F(mu) = J dq(mu) + lambda^2 mu - v. F is the gradient of a strongly convex, piecewise
    quadratic function, so that Newton's method on its active pieces, with an exact line search
    along the few breakpoints, ends after finitely many steps at the optimum.

    Parameters
    ----------
    J : Tensor of shape (N, 3, n)
        Jacobians.
    v : Tensor of shape (N, 3)
        Wanted task steps J dq.
    z : Tensor of shape (N, n)
        Preferred steps; the optimum is the one nearest to them.
    lower, upper : Tensor of shape (N, n)
        Bounds of the step, lower <= upper.
    damping_sq : Tensor of shape (N,)
        lambda^2 > 0, in the unit of J J^T; not below 1e-6 of its largest eigenvalue in float64.
    mu : Tensor of shape (N, 3), optional
        Start of the iteration. Default: zero.
    max_iter : int, default=60
        Cap on Newton steps; a handful is usual.

    Returns
    -------
    dq : Tensor of shape (N, n)
        The optimal steps, inside the box.
    mu : Tensor of shape (N, 3)
        Their multipliers, (v - J dq) / lambda^2.

    References
    ----------
    Hiriart-Urruty, Strodiot & Nguyen, Appl. Math. Optim. 11 (1984); Qi & Sun, Math. Program. 58
    (1993), for semismooth Newton methods.
    """
    mu = torch.zeros_like(v) if mu is None else mu
    best = mu.clone()
    J_all, z_all, lower_all, upper_all = J, z, lower, upper
    rows = torch.arange(len(J), device=J.device)
    noise = 4.0 * torch.finfo(J.dtype).eps
    settled = torch.zeros(len(J), dtype=torch.bool, device=J.device)
    for _ in range(max_iter):
        y = z + apply_columns(J, mu)
        dq = torch.clamp(y, lower, upper)
        pull = damping_sq[:, None] * mu
        residual = apply_rows(J, dq) + pull - v
        scale = apply_rows(J.abs(), dq.abs()) + pull.abs() + v.abs()
        best[rows] = mu
        going = ~settled & (residual.abs() > noise * scale).any(-1)
        if not going.all():
            keep = going.nonzero()[:, 0]
            rows, mu, J, v, z, damping_sq = (a[keep] for a in (rows, mu, J, v, z, damping_sq))
            lower, upper, y, residual = (a[keep] for a in (lower, upper, y, residual))
        if rows.numel() == 0:
            break
        free = (y > lower) & (y < upper)
        newton = -_solve_3x3(_gram_entries(J * free[:, None]), residual, damping_sq)
        slope = apply_columns(J, newton)
        full = y + slope
        # A full step that stays on its linear piece has solved it, and with it the problem.
        same = ((full > lower) == (y > lower)) & ((full < upper) == (y < upper))
        settled = (same | (lower == upper)).all(-1)
        start = (newton * residual).sum(-1)
        curvature = damping_sq * newton.square().sum(-1)
        end = start + curvature + (slope * _moved(y, full, lower, upper)).sum(-1)
        length = torch.ones_like(end)
        far = ((end > 0.0) & ~settled).nonzero()[:, 0]
        if far.numel() > 0:
            length[far] = _exact_line_search(
                *(a[far] for a in (y, slope, start, curvature, lower, upper))
            )
        mu = mu + length[:, None] * newton
    best[rows] = mu
    dq = torch.clamp(z_all + apply_columns(J_all, best), lower_all, upper_all)
    return dq, best


def adaptive_damping(gram: RowGram, healthy: float = 0.02) -> Tensor:
    """Return lambda^2, zero for a healthy J and growing smoothly from there.

    lambda = healthy sigma_max (1 - (sigma_min / (healthy sigma_max))^2) below
    sigma_min = healthy sigma_max: free of units, and once differentiable as a square.

    Parameters
    ----------
    gram : RowGram
        From `row_gram`.
    healthy : float, default=0.02
        Ratio sigma_min / sigma_max from which on no damping is needed.

    Returns
    -------
    Tensor of shape (...,)
        lambda^2, in the unit of J J^T.

    References
    ----------
    Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108 (1986).
    """
    threshold = healthy * gram.sigma_max
    ratio = gram.sigma_min / torch.where(threshold > 0.0, threshold, torch.ones_like(threshold))
    return (threshold * (1.0 - ratio.square()).clamp_min(0.0)).square()


def strict_box_step(
    J: Tensor, v: Tensor, z: Tensor, lower: Tensor, upper: Tensor, damping_sq: Tensor
) -> Tensor:
    """Return the box-limited step whose task part does not depend on the preferred step z.

    Without damping, z only chooses among the steps that reach v, or come nearest to it. Damping
    would trade v against z; therefore the damped task is solved in the box for z = 0 first, and
    z chooses among the steps that move the tip as that one does.

    Parameters
    ----------
    J, v, z, lower, upper : Tensor
        As for `box_limited_step`.
    damping_sq : Tensor of shape (N,)
        lambda^2 >= 0. Below 1e-6 of sigma_max^2 (float64) the box-limited step is solved with
        that much, and its task error is taken out by proximal rounds on the multipliers.

    Returns
    -------
    Tensor of shape (N, n)
        Steps inside the box.
    """
    sigma_sq = row_gram(J).sigma_max.square()
    # Without any Jacobian the floor only has to be positive.
    floor = torch.where(sigma_sq > 0.0, _box_floor(J.dtype) * sigma_sq, torch.ones_like(sigma_sq))
    centre = torch.zeros_like(v)
    rows = ((damping_sq > 0.0) & (z != 0.0).any(-1)).nonzero()[:, 0]
    if rows.numel() > 0:
        task = (J[rows], v[rows], torch.zeros_like(z[rows]), lower[rows], upper[rows])
        dq, mu = _proximal_box_step(*task, damping_sq[rows], floor[rows], centre[rows])
        v = v.index_put((rows,), apply_rows(task[0], dq))
        # These multipliers hold what the limits hold already, also where v is out of reach.
        centre = centre.index_put((rows,), mu)
        damping_sq = damping_sq.index_put((rows,), torch.zeros_like(damping_sq[rows]))
    return _proximal_box_step(J, v, z, lower, upper, damping_sq, floor, centre)[0]


def _proximal_box_step(
    J: Tensor,
    v: Tensor,
    z: Tensor,
    lower: Tensor,
    upper: Tensor,
    damping_sq: Tensor,
    floor: Tensor,
    centre: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return `box_limited_step` for any lambda^2 >= 0, what it lacks to the floor made up for.

    Every round solves J dq + used mu = v + (used - lambda^2) mu_last, whose fixed point has
    J dq + lambda^2 mu = v.
    """
    used = torch.maximum(damping_sq, floor)
    excess = (used - damping_sq)[:, None]
    dq, mu = box_limited_step(J, v + excess * centre, z, lower, upper, used, centre)
    weak = (excess[:, 0] > 0.0).nonzero()[:, 0]
    if weak.numel() > 0:
        J, v, z, lower, upper = (a[weak] for a in (J, v, z, lower, upper))
        again, last, excess, used = dq[weak], mu[weak], excess[weak], used[weak]
        for _ in range(_PROXIMAL_ROUNDS):
            again, last = box_limited_step(J, v + excess * last, z, lower, upper, used, last)
        dq, mu = dq.index_put((weak,), again), mu.index_put((weak,), last)
    return dq, mu


def _box_floor(dtype: torch.dtype) -> float:
    return max(1e-6, math.sqrt(torch.finfo(dtype).eps))


def _moved(y: Tensor, to: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    return torch.clamp(to, lower, upper) - torch.clamp(y, lower, upper)


def _exact_line_search(
    y: Tensor, slope: Tensor, start: Tensor, curvature: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Return t in (0, 1) where start + t curvature + slope . (clip(y + t slope) - clip(y)) = 0.

    The left side grows with t, is linear between the points where a coordinate meets a bound,
    negative at 0 and positive at 1.
    """
    t = torch.cat([(lower - y) / slope, (upper - y) / slope], dim=-1)
    t = torch.nan_to_num(t, nan=1.0).clamp(0.0, 1.0)
    ends = torch.stack([torch.zeros_like(start), torch.ones_like(start)], dim=-1)
    t = torch.cat([t, ends], dim=-1).sort(-1).values
    y, slope, lower, upper = (a[:, None] for a in (y, slope, lower, upper))
    moved = _moved(y, y + t[..., None] * slope, lower, upper)
    value = start[:, None] + t * curvature[:, None] + (slope * moved).sum(-1)
    right = (value > 0.0).to(torch.uint8).argmax(-1, keepdim=True).clamp_min(1)
    t0, t1 = t.gather(-1, right - 1)[:, 0], t.gather(-1, right)[:, 0]
    f0, f1 = value.gather(-1, right - 1)[:, 0], value.gather(-1, right)[:, 0]
    part = f0 / (f0 - f1)
    return t0 + (t1 - t0) * torch.nan_to_num(part, nan=1.0).clamp(0.0, 1.0)


def _gram_entries(J: Tensor) -> tuple[Tensor, ...]:
    G = J @ J.mT
    pairs = ((0, 0), (1, 0), (2, 0), (1, 1), (2, 1), (2, 2))
    return tuple(G[..., i, j] for i, j in pairs)


def _solve_3x3(entries: tuple[Tensor, ...], v: Tensor, damping_sq: Tensor | float) -> Tensor:
    """Solve a symmetric semidefinite 3 x 3 system plus damping by LDL^T without pivoting."""
    g11, g21, g31, g22, g32, g33 = entries
    v1, v2, v3 = v.unbind(-1)
    floor = 8.0 * torch.finfo(v.dtype).eps * (g11 + g22 + g33 + damping_sq)
    i1 = _reciprocal(g11 + damping_sq, floor)
    l21, l31 = g21 * i1, g31 * i1
    i2 = _reciprocal(g22 + damping_sq - l21 * g21, floor)
    t = g32 - l31 * g21
    l32 = t * i2
    i3 = _reciprocal(g33 + damping_sq - l31 * g31 - l32 * t, floor)
    v2 = v2 - l21 * v1
    v3 = v3 - l31 * v1 - l32 * v2
    x3 = v3 * i3
    x2 = v2 * i2 - l32 * x3
    x1 = v1 * i1 - l21 * x2 - l31 * x3
    return torch.stack([x1, x2, x3], dim=-1)


def _reciprocal(pivot: Tensor, floor: Tensor) -> Tensor:
    """Return 1 / pivot, and 0 for a pivot that is only rounding."""
    keep = pivot > floor
    return torch.where(keep, 1.0 / torch.where(keep, pivot, torch.ones_like(pivot)), 0.0)
