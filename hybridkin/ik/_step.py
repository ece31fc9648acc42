"""The law of one step, eq. (1): a task, a posture in its null space, and limits inside the step."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin.ik._box import BoxProblem, strict_box_step
from hybridkin.ik._gram import (
    adaptive_damping,
    apply_columns,
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


def control_step(
    settings: StepSettings,
    q: Tensor,
    J: Tensor,
    e: Tensor,
    feed_forward: Tensor | None = None,
    period: float | None = None,
    last: Tensor | None = None,
) -> StepRows:
    """Return eq. (1) for one period, v = dx dt + gain dt e; rows that are not finite hold still.

    With a limit of acceleration these brake until they stand.

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
    feed_forward : Tensor of shape (N, m), optional
        Motion of the targets in this period [m]. Default: none.
    period : float, optional
        Time to the next step [s]. Default: `settings.dt`.
    last : Tensor of shape (N, n), optional
        Step before, for a period as long as this one. Default: at rest.

    Returns
    -------
    StepRows
        With sigma_min NaN where a row held still.
    """
    gain, beta, seconds = settings.rates(period)
    v = gain * e if feed_forward is None else feed_forward + gain * e
    fine = torch.isfinite(q).all(-1) & torch.isfinite(J).all(-1).all(-1)
    fine &= torch.isfinite(v).all(-1)
    fine = (fine if last is None else fine & torch.isfinite(last).all(-1))[:, None]
    at = torch.where(fine, q, 0.0)
    posture = None
    if settings.has_posture:
        posture = torch.where(fine, beta * (settings.preferred(at) - at), 0.0)
    bounds = settings.step_bounds(q, seconds, last)
    J, v = torch.where(fine[..., None], J, 0.0), torch.where(fine, v, 0.0)
    step = limited_step(settings, J, v, posture, *bounds)
    return step._replace(
        dq=torch.where(torch.isnan(step.dq), 0.0, step.dq),
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
    gram = quick_gram(J, trust is not None) if quick else row_gram(J)
    if trust is not None:
        damping_sq = trust * gram.sigma_max.square()
    elif settings.damping == "adaptive":
        damping_sq = adaptive_damping(gram)
    else:
        damping_sq = (float(settings.damping) * gram.sigma_max).square()
    dq = apply_columns(J, damped_solve(gram, v, damping_sq))
    z = torch.zeros_like(dq) if posture is None else null_projection(J, gram, posture)
    dq = dq + z
    if settings.limits != "off":
        # Rows that meet no limit keep the unlimited step; the others are solved in the box.
        clipped = torch.clamp(dq, lower, upper)
        over = (clipped != dq).any(-1).nonzero()[:, 0]
        if over.numel() > 0:
            low, high = (a.expand_as(dq) for a in (lower, upper))
            problem = BoxProblem(J, v, z, low, high).take(over)
            clipped[over] = strict_box_step(problem, damping_sq[over])
        dq = clipped
    held = (dq <= lower) | (dq >= upper)
    if settings.weights is not None:
        dq = torch.clamp(dq * unit, *box)
    return StepRows(dq, gram.sigma_min, damping_sq.sqrt(), held)


def null_step(settings: StepSettings, J: Tensor, step: Tensor) -> Tensor:
    """Return the part of steps (N, n) that does not move what the rows of J (N, m, n) steer."""
    unit = settings.unit(J)
    J = J * unit
    return unit * null_projection(J, quick_gram(J), step / unit)
