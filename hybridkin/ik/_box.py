"""Steps within a box of limits: the exact least-squares optimum, and the largest scale."""

from __future__ import annotations

import math
from itertools import combinations

import torch
from torch import Tensor

from hybridkin.ik._gram import apply_columns, apply_rows, damped_solve, row_gram, solve_rows

PROXIMAL_ROUNDS = 2
_ROUNDS_OF_A_REACHABLE_TASK = 40
_EXACT = 1e-11  # of a reachable task step
_FIRST_OF_TWO = 1e-3  # damping of the first task's rows where a second one follows
_BLOCK = 2_000_000  # numbers at a time


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

    The minimiser is dq(mu) = clip(z + J^T mu, lower, upper) with mu in R^m the root of
    F(mu) = J dq(mu) + lambda^2 mu - v. F is the gradient of a strongly convex, piecewise
    quadratic function, so that Newton's method on its active pieces, with an exact line search
    along the few breakpoints, ends after finitely many steps at the optimum.

    Parameters
    ----------
    J : Tensor of shape (N, m, n)
        Jacobians.
    v : Tensor of shape (N, m)
        Wanted task steps J dq.
    z : Tensor of shape (N, n)
        Preferred steps; the optimum is the one nearest to them.
    lower, upper : Tensor of shape (N, n)
        Bounds of the step, lower <= upper.
    damping_sq : Tensor of shape (N,) or (N, m)
        lambda^2 > 0 of all or of every row, in the unit of J J^T; not much below 1e-6 of its
        largest eigenvalue in float64.
    mu : Tensor of shape (N, m), optional
        Start of the iteration. Default: zero.
    max_iter : int, default=60
        Cap on Newton steps; a handful is usual.

    Returns
    -------
    dq : Tensor of shape (N, n)
        The optimal steps, inside the box.
    mu : Tensor of shape (N, m)
        Their multipliers, (v - J dq) / lambda^2.

    References
    ----------
    Hiriart-Urruty, Strodiot & Nguyen, Appl. Math. Optim. 11 (1984); Qi & Sun, Math. Program. 58
    (1993), for semismooth Newton methods.
    """
    mu = torch.zeros_like(v) if mu is None else mu
    if damping_sq.ndim == 1:
        damping_sq = damping_sq[:, None].expand_as(v)
    best = mu.clone()
    J_all, z_all, lower_all, upper_all = J, z, lower, upper
    rows = torch.arange(len(J), device=J.device)
    noise = 4.0 * torch.finfo(J.dtype).eps
    settled = torch.zeros(len(J), dtype=torch.bool, device=J.device)
    for _ in range(max_iter):
        y = z + apply_columns(J, mu)
        dq = torch.clamp(y, lower, upper)
        pull = damping_sq * mu
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
        newton = -solve_rows(J * free[:, None], residual, damping_sq)
        slope = apply_columns(J, newton)
        full = y + slope
        # A full step that stays on its linear piece has solved it, and with it the problem.
        same = ((full > lower) == (y > lower)) & ((full < upper) == (y < upper))
        settled = (same | (lower == upper)).all(-1)
        start = (newton * residual).sum(-1)
        curvature = (damping_sq * newton.square()).sum(-1)
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


def strict_box_step(
    J: Tensor,
    v: Tensor,
    z: Tensor,
    lower: Tensor,
    upper: Tensor,
    damping_sq: Tensor,
    first: int | None = None,
    rounds: int = PROXIMAL_ROUNDS,
) -> Tensor:
    """Return the box-limited step whose task part does not depend on the preferred step z.

    Without damping, z only chooses among the steps that reach v, or come nearest to it. Damping
    would trade v against z; therefore the damped task is solved in the box for z = 0 first, and
    z chooses among the steps that move the tip as that one does. Two tasks go the same way: the
    second one chooses among the steps that the first one leaves, z among what is left then.

    Parameters
    ----------
    J, v, z, lower, upper : Tensor
        As for `box_limited_step`.
    damping_sq : Tensor of shape (N,) or (N, m)
        lambda^2 >= 0. Below 1e-6 of sigma_max^2 (float64) the box-limited step is solved with
        that much, and its task error is taken out by proximal rounds on the multipliers.
    first : int, optional
        Number of leading rows that come before the others. Default: all rows are one task.
    rounds : int, default=2
        Proximal rounds at most; each takes a part lambda^2 / (sigma^2 + lambda^2) of the error
        that is left, where v can be reached.

    Returns
    -------
    Tensor of shape (N, n)
        Steps inside the box.
    """
    size_sq = torch.linalg.matrix_norm(J @ J.mT)  # about sigma_max^2
    # Without any Jacobian the floor only has to be positive.
    floor = torch.where(size_sq > 0.0, box_floor(J.dtype) * size_sq, torch.ones_like(size_sq))
    floor = floor[:, None].expand_as(v)
    if damping_sq.ndim == 1:
        damping_sq = damping_sq[:, None].expand_as(v)
    centre, still = torch.zeros_like(v), torch.zeros_like(z)
    if first is not None:
        top = (slice(None), slice(None, first))
        task = (J[top], v[top], still, lower, upper, damping_sq[top], floor[top])
        dq, centre[top] = _proximal_box_step(*task, centre[top])
        least = max(_FIRST_OF_TWO * box_floor(J.dtype), 30.0 * torch.finfo(J.dtype).eps)
        ranked, left = floor.clone(), torch.maximum(damping_sq, floor)
        ranked[top] *= least / box_floor(J.dtype)
        left[top] = 0.0
        aim = torch.cat([apply_rows(J[top], dq), v[:, first:]], dim=-1)
        dq, centre = _proximal_box_step(J, aim, still, lower, upper, left, ranked, centre)
        v, damping_sq = apply_rows(J, dq), torch.zeros_like(damping_sq)
    rows = ((damping_sq > 0.0).any(-1) & (z != 0.0).any(-1)).nonzero()[:, 0]
    if rows.numel() > 0:
        task = (J[rows], v[rows], still[rows], lower[rows], upper[rows])
        dq, mu = _proximal_box_step(*task, damping_sq[rows], floor[rows], centre[rows])
        v = v.index_put((rows,), apply_rows(task[0], dq))
        # These multipliers hold what the limits hold already, also where v is out of reach.
        centre = centre.index_put((rows,), mu)
        damping_sq = damping_sq.index_put((rows,), torch.zeros_like(damping_sq[rows]))
    return _proximal_box_step(J, v, z, lower, upper, damping_sq, floor, centre, rounds)[0]


def directed_step(
    J: Tensor, v: Tensor, z: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the steps with J dq = s v, s in [0, 1] as large as the box allows, and s.

    Parameters
    ----------
    J, v, z, lower, upper : Tensor
        As for `box_limited_step`, with lower <= 0 <= upper and v in the range of J; z chooses
        among these steps.

    Returns
    -------
    dq : Tensor of shape (N, n)
        Steps inside the box.
    scale : Tensor of shape (N,)
        The scales.
    """
    scale, slope = largest_scale(J, v, lower, upper)
    # What the facet's normal leans on lies at its limit: without that the step sits on an edge,
    # where multipliers have no bound.
    least = 1e-9 * slope.abs().amax(-1, keepdim=True)
    down, up = slope < -least, slope > least
    edge = (scale < 1.0)[:, None]
    upper_used = torch.where(edge & down, lower, upper)
    lower_used = torch.where(edge & up, upper, lower)
    free = torch.zeros_like(scale)
    aim, rounds = scale[:, None] * v, _ROUNDS_OF_A_REACHABLE_TASK
    dq = strict_box_step(J, aim, z, lower_used, upper_used, free, rounds=rounds)
    # Where what is left free is nearly parallel the rounds are slow, and there is little choice.
    inside = J * ((dq > lower_used) & (dq < upper_used))[:, None]
    mu = damped_solve(row_gram(inside), aim - apply_rows(J, dq))
    return torch.clamp(dq + apply_columns(inside, mu), lower_used, upper_used), scale


def largest_scale(J: Tensor, v: Tensor, lower: Tensor, upper: Tensor) -> tuple[Tensor, Tensor]:
    """Return the largest s in [0, 1] for which some dq in the box has J dq = s v.

    By duality s = min h(y) over y . v = 1, with h(y) = sum_i max(lower_i g_i, upper_i g_i) and
    g = J^T y: h is the support function of the steps that the box allows, a zonotope, and its
    minimum lies at the normal of a facet, on which m - 1 of the g_i vanish. All of them are tried;
    each one bounds s from above, so that none can do harm.

    Parameters
    ----------
    J : Tensor of shape (N, m, n)
        Jacobians.
    v : Tensor of shape (N, m)
        Wanted task steps, in the range of J.
    lower, upper : Tensor of shape (N, n)
        Bounds of the step, with lower <= 0 <= upper.

    Returns
    -------
    scale : Tensor of shape (N,)
        The scales.
    slope : Tensor of shape (N, n)
        g of the facet that bounds the scale: where it is not zero, the step is at its limit.

    References
    ----------
    Ziegler, Lectures on Polytopes (1995), chapter 7, for the facets of a zonotope.
    """
    n_actuators, gram = J.shape[-1], row_gram(J)
    flat = gram.sigma_min < 1e-6 * gram.sigma_max
    if J.shape[-2] > J.shape[-1] or flat.any():
        # In a direction that is lost, segments of no length stand in for the missing facets.
        eye = torch.eye(J.shape[-2], dtype=J.dtype, device=J.device)
        J = torch.cat([J, eye.expand(len(J), -1, -1)], dim=-1)
        zero = torch.zeros_like(v)
        lower, upper = (torch.cat([bound, zero], dim=-1) for bound in (lower, upper))
    m, n = J.shape[-2:]
    facets = list(combinations(range(n), m - 1))
    subsets = torch.tensor(facets, device=J.device, dtype=torch.long).reshape(len(facets), m - 1)
    size = max(1, _BLOCK // (len(facets) * max(m * m, n)))
    blocks = [a.split(size) for a in (J, v, lower, upper)]
    parts = [_least_support(subsets, *block) for block in zip(*blocks, strict=True)]
    scale, slope = (torch.cat(part) for part in zip(*parts, strict=True))
    return scale.clamp(0.0, 1.0), slope[:, :n_actuators]


def _least_support(
    subsets: Tensor, J: Tensor, v: Tensor, lower: Tensor, upper: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the least h(y) over the y with y . v = 1 that m - 1 columns of J are normal to."""
    columns = J.mT[:, subsets]  # (N, C, m - 1, m)
    if J.shape[-2] == 3:
        y = torch.linalg.cross(columns[:, :, 0], columns[:, :, 1])
    else:
        system = torch.cat([columns, v[:, None, None].expand(-1, len(subsets), 1, -1)], dim=-2)
        unit = torch.zeros_like(system[..., :1])
        unit[..., -1, :] = 1.0
        y = torch.linalg.solve_ex(system, unit)[0][..., 0]
    along = (y * v[:, None]).sum(-1, keepdim=True)
    size = torch.linalg.vector_norm(y, dim=-1) * torch.linalg.vector_norm(v, dim=-1)[:, None]
    # Rounding of v is no direction of its own.
    seen = along[..., 0].abs() > math.sqrt(torch.finfo(v.dtype).eps) * size
    y = y / along
    g = (y @ J).scatter(-1, subsets.expand(len(J), -1, -1), 0.0)
    worth = torch.maximum(lower[:, None] * g, upper[:, None] * g)
    h = torch.where(seen, torch.where(g == 0.0, 0.0, worth).sum(-1), math.inf)
    least, which = torch.nan_to_num(h, nan=math.inf).min(-1)
    return least, torch.nan_to_num(g[torch.arange(len(J), device=J.device), which])


def _proximal_box_step(
    J: Tensor,
    v: Tensor,
    z: Tensor,
    lower: Tensor,
    upper: Tensor,
    damping_sq: Tensor,
    floor: Tensor,
    centre: Tensor,
    rounds: int = PROXIMAL_ROUNDS,
) -> tuple[Tensor, Tensor]:
    """Return `box_limited_step` for any lambda^2 >= 0, what it lacks to the floor made up for.

    Every round solves J dq + used mu = v + (used - lambda^2) mu_last, whose fixed point has
    J dq + lambda^2 mu = v.
    """
    used = torch.maximum(damping_sq, floor)
    excess = used - damping_sq
    dq, mu = box_limited_step(J, v + excess * centre, z, lower, upper, used, centre)
    weak = (excess > 0.0).any(-1).nonzero()[:, 0]
    if weak.numel() > 0:
        J, v, z, lower, upper = (a[weak] for a in (J, v, z, lower, upper))
        again, last, excess, used = dq[weak], mu[weak], excess[weak], used[weak]
        for done in range(rounds):
            missed = (apply_rows(J, again) - v).norm(dim=-1)
            if done >= PROXIMAL_ROUNDS and (missed <= _EXACT * v.norm(dim=-1)).all():
                break
            again, last = box_limited_step(J, v + excess * last, z, lower, upper, used, last)
        dq, mu = dq.index_put((weak,), again), mu.index_put((weak,), last)
    return dq, mu


def box_floor(dtype: torch.dtype) -> float:
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
