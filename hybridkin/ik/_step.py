"""The law of one step, eq. (1): a task, a posture in its null space, and limits inside the step."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin.ik._box import BoxProblem, strict_box_step
from hybridkin.ik._gram import (
    RowGram,
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    quick_gram,
    row_gram,
)
from hybridkin.ik._settings import StepSettings


class StepRows(NamedTuple):
    """A step and what came with it, a row each."""

    dq: Tensor
    sigma_min: Tensor
    damping: Tensor
    saturated: Tensor


class _Wanted(NamedTuple):
    """The step that a task asks for without limits, and what it leaves to the posture."""

    dq: Tensor
    null_spaces: list[tuple[Tensor, RowGram]]
    damping_sq: Tensor
    sigma_min: Tensor


def control_step(
    settings: StepSettings,
    q: Tensor,
    J: Tensor,
    e: Tensor,
    feed_forward: Tensor | float = 0.0,
    period: float | None = None,
) -> StepRows:
    """Return eq. (1) for one period, v = dx dt + gain dt e; rows that are not finite hold still.

    Parameters
    ----------
    settings : StepSettings
        Limits, posture and rates.
    q : Tensor of shape (N, n)
        Present configurations.
    J : Tensor of shape (N, m, n)
        Jacobians of the task.
    e : Tensor of shape (N, m)
        Errors of the task, to be taken back by the gain [m].
    feed_forward : Tensor of shape (N, m) or float, default=0.0
        Motion of the targets in this period [m].
    period : float, optional
        Time to the next step [s]. Default: `settings.dt`.

    Returns
    -------
    StepRows
        With sigma_min NaN where a row held still.
    """
    gain, beta, seconds = settings.rates(period)
    v = feed_forward + gain * e
    fine = torch.isfinite(q).all(-1) & torch.isfinite(J).all(-1).all(-1)
    fine = (fine & torch.isfinite(v).all(-1))[:, None]
    at = torch.where(fine, q, 0.0)
    posture = None
    if settings.has_posture:
        posture = torch.where(fine, beta * (settings.preferred(at) - at), 0.0)
    bounds = settings.step_bounds(q, settings.dq_max.to(q) * seconds)
    J, v = torch.where(fine[..., None], J, 0.0), torch.where(fine, v, 0.0)
    step = limited_step(settings, J, v, posture, *bounds, first=settings.task.first)
    return step._replace(
        dq=torch.where(torch.isnan(q), 0.0, step.dq),
        sigma_min=torch.where(fine[:, 0], step.sigma_min, math.nan),
    )


def limited_step(
    settings: StepSettings,
    J: Tensor,
    v: Tensor,
    posture: Tensor | None,
    lower: Tensor,
    upper: Tensor,
    trust: Tensor | None = None,
    *,
    first: int | None = None,
    quick: bool = False,
) -> StepRows:
    """Return the step for the task v and the posture step, within the bounds.

    Weights are a change of unit: in u = W^(1/2) q nothing has a weight. A search checks every step
    it takes: there estimates of singular values will do (`quick`), and `trust`,
    lambda^2 / sigma_max^2, in place of the damping.
    """
    box, unit = (lower, upper), settings.unit(v)
    if settings.weights is not None:
        J, lower, upper = J * unit, lower / unit, upper / unit
        posture = None if posture is None else posture / unit
    if first is None:
        gram = quick_gram(J, trust is not None) if quick else row_gram(J)
        wanted = _one_task(settings, J, gram, v, trust)
    else:
        wanted = _two_tasks(settings, J, v, trust, first)
    dq, z = wanted.dq, torch.zeros_like(wanted.dq)
    if posture is not None:
        z = posture
        for rows, gram in wanted.null_spaces:
            z = null_projection(rows, gram, z)
        dq = dq + z
    if settings.limits != "off":
        # Rows that meet no limit keep the unlimited step; the others are solved in the box.
        clipped = torch.clamp(dq, lower, upper)
        over = (clipped != dq).any(-1).nonzero()[:, 0]
        if over.numel() > 0:
            low, high = (a.expand_as(dq) for a in (lower, upper))
            problem = BoxProblem(J, v, z, low, high).take(over)
            clipped[over] = strict_box_step(problem, wanted.damping_sq[over], first)
        dq = clipped
    if settings.weights is not None:
        dq = torch.clamp(dq * unit, *box)
    damping_sq = wanted.damping_sq
    damping = (damping_sq if damping_sq.ndim == 1 else damping_sq.amax(-1)).sqrt()
    return StepRows(dq, wanted.sigma_min, damping, (dq <= box[0]) | (dq >= box[1]))


def null_step(settings: StepSettings, J: Tensor, step: Tensor) -> Tensor:
    """Return the part of steps (N, n) that does not move what the rows of J (N, m, n) steer."""
    unit = settings.unit(J)
    J = J * unit
    return unit * null_projection(J, quick_gram(J), step / unit)


def _one_task(
    settings: StepSettings, J: Tensor, gram: RowGram, v: Tensor, trust: Tensor | None
) -> _Wanted:
    damping_sq = _damping_sq(settings, gram, gram.sigma_max, trust)
    dq = apply_columns(J, damped_solve(gram, v, damping_sq))
    return _Wanted(dq, [(J, gram)], damping_sq, gram.sigma_min)


def _two_tasks(
    settings: StepSettings, J: Tensor, v: Tensor, trust: Tensor | None, first: int
) -> _Wanted:
    """Return the step for two tasks, the second in the null space of the first `first` rows."""
    top, below = J[:, :first], J[:, first:]
    gram = row_gram(top)
    dq, null_spaces, top_sq, sigma_min = _one_task(settings, top, gram, v[:, :first], None)
    whole = torch.linalg.matrix_norm(below, ord=2) if len(J) else top_sq
    per_row = RowGram(tuple(a[:, None] for a in gram.parts), *(a[:, None] for a in gram[1:]))
    left = null_projection(top[:, None], per_row, below)
    gram_left = row_gram(left)
    left_sq = _damping_sq(settings, gram_left, whole, trust)
    rest = v[:, first:] - apply_rows(below, dq)
    dq = dq + apply_columns(left, damped_solve(gram_left, rest, left_sq))
    pairs = ((top_sq, top.shape[1]), (left_sq, below.shape[1]))
    damping_sq = torch.cat([a[:, None].expand(-1, size) for a, size in pairs], dim=-1)
    return _Wanted(dq, [*null_spaces, (left, gram_left)], damping_sq, sigma_min)


def _damping_sq(
    settings: StepSettings, gram: RowGram, sigma_max: Tensor, trust: Tensor | None
) -> Tensor:
    if trust is not None:
        return trust * sigma_max.square()
    if settings.damping == "adaptive":
        return adaptive_damping(gram, sigma_max)
    return (float(settings.damping) * sigma_max).square()
