"""The law of one step, eq. (1): a task, a posture in its null space, and limits of the step."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import (
    IK_BALANCE,
    IK_CORRECTIONS,
    IK_LEAST_PULL,
    IK_PULL_RATIO,
    IK_SLACK,
    IK_SLIP,
)
from hybridkin.ik._box import BoxProblem, strict_box_step
from hybridkin.ik._gram import (
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    quick_gram,
    row_gram,
)
from hybridkin.ik._settings import StepSettings, stopping

# for a step that would leave the tip limits
_PROJECTIONS = 8
_EXCESS = 1.5


class StepRows(NamedTuple):
    """Steps and further results, one row each."""

    dq: Tensor
    sigma_min: Tensor
    damping: Tensor
    saturated: Tensor
    stopped: Tensor | bool = False  # by a tip limit


def control_step(
    settings: StepSettings,
    q: Tensor,
    J: Tensor,
    e: Tensor,
    feed_forward: Tensor | None = None,
    period: float | None = None,
    last: Tensor | None = None,
    tip: Tensor | None = None,
) -> StepRows:
    """Return the step of eq. (1) for one period, with v = dx dt + gain dt e.

    Rows that are not finite, or overflow, do not move. With a limit of acceleration they brake to
    a stop; outside the limits their known actuators return.

    Parameters
    ----------
    settings : StepSettings
        Limits, posture and rates.
    q : Tensor of shape (N, n)
        Present configurations.
    J : Tensor of shape (N, m, n)
        Jacobians of the task.
    e : Tensor of shape (N, m)
        Errors of the task, to be corrected by the gain [m].
    feed_forward : Tensor of shape (N, m), optional
        Motion of the targets in this period [m]. Default: none.
    period : float, optional
        Time to the next step [s]. Default: `settings.dt`.
    last : Tensor of shape (N, n), optional
        Previous step, scaled to this period. Default: at rest.
    tip : Tensor of shape (N, m), optional
        Position of the tip, for tip limits.

    Returns
    -------
    StepRows
        The steps; sigma_min is NaN for rows that are not finite.
    """
    gain, beta, seconds = settings.rates(period)
    v = gain * e if feed_forward is None else feed_forward + gain * e
    sizes = torch.stack([e.norm(dim=-1), v.norm(dim=-1)], dim=-1)
    fine = _finite(q) & _finite(J.flatten(1)) & _finite(sizes)
    before = 0.0
    if last is not None:
        fine = fine & _finite(last)
        before = torch.where(_finite(last), last, 0.0)
    at = torch.where(fine, q, 0.0)
    e = torch.where(fine, e, 0.0)
    J = _only_taut(settings, torch.where(fine[..., None], J, 0.0))
    limits = None if tip is None else settings.tip_limits
    posture = None
    if settings.has_posture:
        posture = torch.where(fine, beta * (settings.preferred(at) - at), 0.0)
    change = settings.change(q, seconds)
    if settings.accelerates:
        # Limit the speed towards target and posture so that the actuators can brake in time.
        brake = _braking(settings, J, e, change)
        gain = stopping(torch.ones_like(brake), brake).clamp_max(gain)[:, None]
        if posture is not None:
            most = stopping((posture / beta).abs(), change)
            posture = torch.clamp(posture, -most, most)
    if feed_forward is None:
        v = gain * e
    else:
        v = torch.where(fine, feed_forward + gain * e, 0.0)
    bounds = settings.step_bounds(q, seconds, before)
    if limits is None:
        step = limited_step(settings, J, v, posture, *bounds)
    else:
        assert tip is not None
        margin = limits.margin(torch.where(fine, tip, 0.0))
        if settings.accelerates:
            normals = limits.normals.to(J)
            brakes = [
                _braking(settings, J, a.expand(len(J), -1), change) for a in normals
            ]
            margin = stopping(margin, torch.stack(brakes, dim=-1))
        step = _step_inside(settings, margin, J, v, posture, *bounds)
        v = v + limits.way_in(margin - limits.along(v))
    if settings.pulls.any():
        step = _arriving(settings, at, J, v, step, *bounds)
    fine = fine & _finite(step.dq)
    still = torch.where(
        torch.isfinite(q), torch.clamp(torch.zeros_like(q), *bounds), 0.0
    )
    held = (still <= bounds[0]) | (still >= bounds[1])
    return step._replace(
        dq=torch.where(fine, step.dq, still),
        sigma_min=torch.where(fine[:, 0], step.sigma_min, math.nan),
        damping=torch.where(fine[:, 0], step.damping, 0.0),
        saturated=torch.where(fine, step.saturated, held),
    )


def _finite(rows: Tensor) -> Tensor:
    """Return whether all numbers of rows (N, k) are finite, shape (N, 1)."""
    return torch.isfinite(rows).all(-1, keepdim=True)


def _braking(settings: StepSettings, J: Tensor, way: Tensor, change: Tensor) -> Tensor:
    """Return the largest change of the tip's motion per period, in multiples of `way` (N,)."""
    free = torch.full_like(J[:, 0], math.inf)
    return (change / limited_step(settings, J, way, None, -free, free).dq.abs()).amin(
        -1
    )


def _step_inside(
    settings: StepSettings,
    margin: Tensor,
    J: Tensor,
    v: Tensor,
    z: Tensor | None,
    *bounds: Tensor,
) -> StepRows:
    """Return a step within the bounds after which, to first order, the tip is within its limits.

    The desired motion v is projected onto the half-spaces. If the bounds then move J dq out of
    them, alternating projections look for a motion that meets both, with some excess, so that they
    end. A remaining violation is removed by taking a fraction of the way from a safe step, one
    that stays or returns, to this step.
    """
    # [m]
    limits = settings.tip_limits
    close = 32.0 * torch.finfo(v.dtype).eps
    assert limits is not None

    def taken(way: Tensor, z: Tensor | None = z) -> tuple[StepRows, Tensor]:
        step = limited_step(settings, J, way, z, *bounds)
        return step, limits.along(apply_rows(J, step.dq)) - margin

    wanted = v + limits.way_in(margin - limits.along(v))
    step, over = taken(wanted)
    for _ in range(_PROJECTIONS):
        out = (over > close).any(-1, keepdim=True)
        if not out.any():
            break
        back = apply_rows(J, step.dq) + _EXCESS * limits.way_in(-over)
        wanted = torch.where(out, back, wanted)
        step, over = taken(wanted)
    else:
        stay, least = taken(limits.way_in(margin), None)
        step_size = ((close - least) / (over - least)).clamp(0.0, 1.0)
        step_size = torch.where(over > close, step_size, 1.0).amin(-1, keepdim=True)
        dq = torch.clamp(stay.dq + step_size * (step.dq - stay.dq), *bounds)
        held = (dq <= bounds[0]) | (dq >= bounds[1])
        step = step._replace(
            dq=torch.where(step_size < 1.0, dq, step.dq), saturated=held
        )
    return step._replace(stopped=((wanted - v).abs() > close).any(-1))


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

    Weights are a change of unit: in u = W^(1/2) q all weights are 1. A search checks all its steps,
    so it can use estimates of the singular values (`quick`), and `trust`,
    lambda^2 / sigma_max^2, in place of the damping.
    """
    box = (lower, upper)
    unit = settings.unit(v)
    if settings.weights is not None:
        J = J * unit
        lower = lower / unit
        upper = upper / unit
        if posture is not None:
            posture = posture / unit
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
        # Rows within all limits keep the unlimited step; the others are solved in the box.
        clipped = torch.clamp(dq, lower, upper)
        unbalanced = settings.plane is not None and settings.weights is not None
        over = ((clipped != dq).any(-1) | unbalanced).nonzero()[:, 0]
        if over.numel() > 0:
            low, high = (a.expand_as(dq) for a in (lower, upper))
            rows, motion = _with_plane(settings, J, v, posture)
            problem = BoxProblem(rows, motion, z, low, high).take(over)
            clipped[over] = strict_box_step(problem, damping_sq[over])
        dq = clipped
    held = (dq <= lower) | (dq >= upper)
    if settings.weights is not None:
        dq = torch.clamp(dq * unit, *box)
    return StepRows(dq, gram.sigma_min, damping_sq.sqrt(), held)


def _with_plane(
    settings: StepSettings, J: Tensor, v: Tensor, posture: Tensor | None
) -> tuple[Tensor, Tensor]:
    """Return J and v with further rows: only `posture` leaves the plane, also at the limits.

    Else a limit that stops one actuator would unbalance the others.
    """
    if settings.plane is None:
        return J, v
    stiff = IK_BALANCE * J.flatten(1).norm(dim=-1)[:, None, None]
    rows = stiff * (settings.plane[1].to(J).mT * settings.unit(v))
    if posture is None:
        aside = torch.zeros_like(rows[..., 0])
    else:
        aside = apply_rows(rows, posture)
    return torch.cat([J, rows], dim=1), torch.cat([v, aside], dim=1)


def _only_taut(settings: StepSettings, J: Tensor) -> Tensor:
    """Return J (N, m, n) without the columns of slack tendons.

    A learned error makes them small instead of zero, and a step would drive these tendons far.
    """
    size = J.norm(dim=-2, keepdim=True)
    slack = (size <= IK_SLACK * size.amax(-1, keepdim=True)) & (
        settings.pulls.to(J) != 0.0
    )
    return torch.where(slack, 0.0, J)


class _End(NamedTuple):
    """Ends of steps: what is missing of the motions of the tips, as the model computes them."""

    dq: Tensor
    J: Tensor
    missing: Tensor

    @property
    def distance(self) -> Tensor:
        return _norm(self.missing)

    def where(self, better: Tensor, other: _End) -> _End:
        """Return the ends of `other` in the rows (N, 1) where it is better."""
        pairs = zip(other, self, strict=True)
        return _End(
            *(
                a.where(better if a.ndim == 2 else better[..., None], b)
                for a, b in pairs
            )
        )


def _norm(rows: Tensor) -> Tensor:
    """Return the lengths (N, 1) of rows."""
    return rows.norm(dim=-1, keepdim=True)


def _arriving(
    settings: StepSettings,
    q: Tensor,
    J: Tensor,
    v: Tensor,
    step: StepRows,
    lower: Tensor,
    upper: Tensor,
) -> StepRows:
    """Return steps whose tips move as the steps promised, with tendons that can only pull.

    Their Jacobian jumps where a tendon gets slack or taut, so each end is evaluated by the model.
    Newton's method corrects it within the bounds. Where the result is less than half of the motion
    v, slack tendons are pulled in, as far as the tip gets nearer to v or not away.
    """
    pulls = settings.pulls.to(q)
    task = settings.task
    x = settings.evaluate(q)[0]

    def end_of(dq: Tensor, motion: Tensor) -> _End:
        tip, slope = settings.evaluate(q + dq)
        return _End(dq, _only_taut(settings, slope), motion - task.difference(x, tip))

    def approach(dq: Tensor, motion: Tensor, close: Tensor) -> _End:
        best = end = end_of(dq, motion)
        for _ in range(IK_CORRECTIONS):
            going = best.distance > close
            if not going.any():
                break
            low = lower - end.dq
            high = upper - end.dq
            correction = limited_step(settings, end.J, end.missing, None, low, high).dq
            dq = torch.clamp(end.dq + correction, lower, upper)
            dq = torch.where(
                correction <= low, lower, torch.where(correction >= high, upper, dq)
            )
            end = end_of(dq, motion)
            best = best.where(going & (end.distance < best.distance), end)
        return best

    eps = torch.finfo(q.dtype).eps
    slip = _norm(J.flatten(1)) * (IK_SLIP * _norm(step.dq) + 32.0 * eps * _norm(q))
    promised = apply_rows(J, step.dq)
    close = torch.maximum(0.5 * _norm(promised), slip)
    end = approach(step.dq, promised, close)
    end = end._replace(missing=v - promised + end.missing)
    weak = end.distance > torch.maximum(0.5 * _norm(v), slip)
    to = torch.where(pulls < 0.0, lower, upper)
    slack = (end.J == 0.0).all(-2) & (pulls != 0.0)
    to = torch.where(slack & torch.isfinite(to), to, end.dq)
    way = to - end.dq
    weak &= (way != 0.0).any(-1, keepdim=True)
    fraction = 1.0
    while fraction > IK_LEAST_PULL and weak.any():
        pulled = approach(
            torch.clamp(to - (1.0 - fraction) * way, lower, upper), v, slip
        )
        # A slack tendon moves the tip by rounding alone.
        better = weak & (pulled.distance <= (1.0 + eps**0.5) * end.distance)
        end = end.where(better, pulled)
        weak = weak & ~better
        fraction *= IK_PULL_RATIO
    held = (end.dq <= lower) | (end.dq >= upper)
    return step._replace(dq=end.dq, saturated=held)


def null_step(settings: StepSettings, J: Tensor, step: Tensor) -> Tensor:
    """Return the part of steps (N, n) in the null space of J (N, m, n)."""
    unit = settings.unit(J)
    J = J * unit
    return unit * null_projection(J, quick_gram(J), step / unit)
