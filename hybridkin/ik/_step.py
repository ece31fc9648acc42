"""The law of one step, eq. (1): a task, a posture in its null space, and limits of the step.

Equations (17) to (20) are those of the page "Theory" of the documentation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import (
    IK_BALANCE,
    IK_CORRECTIONS,
    IK_EXCESS,
    IK_LEAST_PULL,
    IK_PROJECTIONS,
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
    row_gram,
    solve_rows,
)
from hybridkin.ik._settings import StepSettings, stopping


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
    feed = torch.zeros_like(e) if feed_forward is None else feed_forward
    before = torch.zeros_like(q) if last is None else last
    # Rows that are not finite, or overflow, get zeros, and no step at the end.
    sizes = torch.stack([e.norm(dim=-1), (feed + gain * e).norm(dim=-1)], dim=-1)
    known = _finite(before)
    fine = _finite(q) & _finite(J.flatten(1)) & _finite(sizes) & known
    before = torch.where(known, before, 0.0)
    at = torch.where(fine, q, 0.0)
    e = torch.where(fine, e, 0.0)
    feed = torch.where(fine, feed, 0.0)
    J = _only_taut(settings, torch.where(fine[..., None], J, 0.0))
    posture = None
    if settings.has_posture:
        posture = torch.where(fine, beta * (settings.preferred(at) - at), 0.0)
    change = settings.change(q, seconds)
    if settings.accelerates:
        # Limit the speed towards target and posture so that the actuators can brake in time.
        brake = _braking(settings, J, e, change)
        gain = stopping(torch.ones_like(brake), brake).clamp_max(gain)[:, None]
        if posture is not None:
            fastest = stopping((posture / beta).abs(), change)
            posture = torch.clamp(posture, -fastest, fastest)
    # Eq. (17), within the limits of q, of its speed and acceleration, and of the tip.
    v = feed + gain * e
    bounds = settings.step_bounds(q, seconds, before)
    spaces = settings.tip_limits
    if spaces is None or tip is None:
        step = limited_step(settings, J, v, posture, *bounds)
    else:
        margin = spaces.margin(torch.where(fine, tip, 0.0))
        if settings.accelerates:
            normals = spaces.normals.to(J)[:, None].expand(-1, len(J), -1)
            brakes = [_braking(settings, J, normal, change) for normal in normals]
            margin = stopping(margin, torch.stack(brakes, dim=-1))
        step = _step_inside(settings, margin, J, v, posture, *bounds)
        v = v + spaces.way_in(margin - spaces.along(v))
    if settings.pulls.any():
        step = _arriving(settings, at, J, v, step, *bounds)
    # The other rows stay, or brake; outside the limits their known actuators return.
    fine = fine & _finite(step.dq)
    still = torch.clamp(torch.zeros_like(q), *bounds)
    still = torch.where(torch.isfinite(q), still, 0.0)
    held = (still <= bounds[0]) | (still >= bounds[1])
    return step._replace(
        dq=torch.where(fine, step.dq, still),
        sigma_min=torch.where(fine[:, 0], step.sigma_min, math.nan),
        damping=torch.where(fine[:, 0], step.damping, 0.0),
        saturated=torch.where(fine, step.saturated, held),
    )


def limited_step(
    settings: StepSettings,
    J: Tensor,
    v: Tensor,
    posture: Tensor | None,
    lower: Tensor,
    upper: Tensor,
    damping_sq: Tensor | None = None,
) -> StepRows:
    """Return the step for the task v and the posture step, within the bounds.

    Weights are a change of unit: in u = W^(1/2) q all weights are 1. With `damping_sq`, lambda^2 in
    this unit, singular values are not computed, and sigma_min is NaN.
    """
    unit = settings.unit(v)
    J = J * unit
    low = lower / unit
    high = upper / unit
    if posture is not None:
        posture = posture / unit
    # Eq. (17): damped least squares, and the part of the posture step that does not move the tip.
    if damping_sq is not None:
        mu = solve_rows(J, v, damping_sq)
        sigma_min = torch.full_like(damping_sq, math.nan)
        z = torch.zeros_like(J[:, 0])
    else:
        gram = row_gram(J)
        sigma_min = gram.sigma_min
        if isinstance(settings.damping, str):
            damping_sq = adaptive_damping(gram)
        else:
            damping_sq = (settings.damping * gram.sigma_max).square()
        mu = damped_solve(gram, v, damping_sq)
        z = torch.zeros_like(J[:, 0])
        if posture is not None:
            z = null_projection(J, gram, posture)
    dq = apply_columns(J, mu) + z
    if settings.limits != "off":
        # Rows within all limits keep this step; eq. (19) is solved for the others. Weights turn J
        # out of the plane.
        clipped = torch.clamp(dq, low, high)
        out_of_plane = settings.plane is not None and settings.weights is not None
        over = ((clipped != dq).any(-1) | out_of_plane).nonzero()[:, 0]
        if over.numel() > 0:
            rows, motion = _with_plane(settings, J, v, posture)
            ends = (low.expand_as(dq), high.expand_as(dq))
            problem = BoxProblem(rows, motion, z, *ends).take(over)
            clipped[over] = strict_box_step(problem, damping_sq[over])
        dq = clipped
    held = (dq <= low) | (dq >= high)
    dq = torch.clamp(dq * unit, lower, upper)
    return StepRows(dq, sigma_min, damping_sq.sqrt(), held)


def null_step(settings: StepSettings, J: Tensor, step: Tensor) -> Tensor:
    """Return the part of steps (N, n) in the null space of J (N, m, n)."""
    unit = settings.unit(J)
    J = J * unit
    return unit * null_projection(J, row_gram(J), step / unit)


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
    aside = torch.zeros_like(rows[..., 0])
    if posture is not None:
        aside = apply_rows(rows, posture)
    return torch.cat([J, rows], dim=1), torch.cat([v, aside], dim=1)


def _finite(rows: Tensor) -> Tensor:
    """Return whether all numbers of rows (N, k) are finite, shape (N, 1)."""
    return torch.isfinite(rows).all(-1, keepdim=True)


def _norm(rows: Tensor) -> Tensor:
    """Return the lengths (N, 1) of rows."""
    return rows.norm(dim=-1, keepdim=True)


def _braking(settings: StepSettings, J: Tensor, way: Tensor, change: Tensor) -> Tensor:
    """Return the largest change of the tip's motion per period, in multiples of `way` (N,)."""
    free = torch.full_like(J[:, 0], math.inf)
    dq = limited_step(settings, J, way, None, -free, free).dq
    return (change / dq.abs()).amin(-1)


# Limits of the tip.


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
    them, a safe step is looked for, and the margins of the half-spaces that it does not reach are
    widened up to it. Alternating projections look for a motion that meets margins and bounds. A
    remaining violation is removed by taking a fraction of the way from the safe step to this one.
    """
    limits = settings.tip_limits
    close = 32.0 * torch.finfo(v.dtype).eps
    assert limits is not None
    wanted = v + limits.way_in(margin - limits.along(v))
    step = limited_step(settings, J, wanted, z, *bounds)
    out = limits.along(apply_rows(J, step.dq)) - margin > close
    if out.any():
        safe = _safe_step(settings, margin, J, *bounds)
        least = limits.along(apply_rows(J, safe))
        reachable = torch.maximum(margin, least)
        margin = torch.where(out.any(-1, keepdim=True), reachable, margin)
        step, wanted = _projected(settings, margin, J, step, wanted, z, *bounds)
        over = limits.along(apply_rows(J, step.dq)) - margin
        share = _share(least - margin, over)
        dq = torch.clamp(safe + share * (step.dq - safe), *bounds)
        dq = torch.where(share < 1.0, dq, step.dq)
        held = (dq <= bounds[0]) | (dq >= bounds[1])
        step = step._replace(
            dq=dq, saturated=torch.where(share < 1.0, held, step.saturated)
        )
    return step._replace(stopped=((wanted - v).abs() > close).any(-1))


def _safe_step(
    settings: StepSettings, margin: Tensor, J: Tensor, *bounds: Tensor
) -> Tensor:
    """Return steps (N, n) into the half-spaces, or as near to them as found.

    They start at rest, or at the hardest braking, and lead farther out of no half-space than this
    start. Where the way in turns out of another half-space, only a share of it is taken; else a
    start outside several could get worse.
    """
    limits = settings.tip_limits
    assert limits is not None
    rest = torch.clamp(torch.zeros_like(J[:, 0]), *bounds)
    motion = apply_rows(J, rest)
    start = limits.along(motion)
    unknown = torch.full_like(rest[:, 0], math.nan)
    step = StepRows(rest, unknown, unknown, rest != 0.0)
    back = _projected(settings, margin, J, step, motion, None, *bounds)[0].dq
    end = limits.along(apply_rows(J, back))
    allowed = torch.maximum(margin, start)
    share = _share(start - allowed, end - allowed)
    return torch.clamp(rest + share * (back - rest), *bounds)


def _projected(
    settings: StepSettings,
    margin: Tensor,
    J: Tensor,
    step: StepRows,
    wanted: Tensor,
    z: Tensor | None,
    *bounds: Tensor,
) -> tuple[StepRows, Tensor]:
    """Return steps moved towards the margins, and the tip motions (N, m) they were solved for.

    Alternating projections, with some excess so that they end. Rows within their margins keep
    their step.
    """
    limits = settings.tip_limits
    assert limits is not None
    close = 32.0 * torch.finfo(margin.dtype).eps
    for _ in range(IK_PROJECTIONS):
        motion = apply_rows(J, step.dq)
        over = limits.along(motion) - margin
        out = (over > close).any(-1, keepdim=True)
        if not out.any():
            break
        # A bit farther in, because a step in a box is right to rounding only.
        way = limits.way_in(-over - 8.0 * close)
        wanted = torch.where(out, motion + IK_EXCESS * way, wanted)
        moved = limited_step(settings, J, wanted, z, *bounds)
        step = moved._replace(
            dq=torch.where(out, moved.dq, step.dq),
            saturated=torch.where(out, moved.saturated, step.saturated),
        )
    return step, wanted


def _share(least: Tensor, over: Tensor) -> Tensor:
    """Return the shares (N, 1) of ways from `least` to `over` (N, k) that stay below zero."""
    close = 32.0 * torch.finfo(over.dtype).eps
    share = ((close - least) / (over - least)).clamp(0.0, 1.0)
    return torch.where(over > close, share, 1.0).amin(-1, keepdim=True)


# Tendons that can only pull.


def _only_taut(settings: StepSettings, J: Tensor) -> Tensor:
    """Return J (N, m, n) without the columns of slack tendons.

    A learned error makes them small instead of zero, and a step would drive these tendons far.
    """
    size = J.norm(dim=-2, keepdim=True)
    small = size <= IK_SLACK * size.amax(-1, keepdim=True)
    return torch.where(small & (settings.pulls.to(J) != 0.0), 0.0, J)


class _End(NamedTuple):
    """Ends of steps: what is missing of the motions of the tips, as the model computes them."""

    dq: Tensor
    J: Tensor
    missing: Tensor

    @property
    def distance(self) -> Tensor:
        return _norm(self.missing)

    def where(self, better: Tensor, end: _End) -> _End:
        """Return another end in the rows (N, 1) where it is better."""
        return _End(
            end.dq.where(better, self.dq),
            end.J.where(better[..., None], self.J),
            end.missing.where(better, self.missing),
        )


class _Arrival(NamedTuple):
    """Configurations q (N, n) with tips x, and the bounds of their steps."""

    settings: StepSettings
    q: Tensor
    x: Tensor
    lower: Tensor
    upper: Tensor

    def end(self, dq: Tensor, motion: Tensor) -> _End:
        """Return the end of steps dq, whose tips are to make a motion (N, m)."""
        tip, J = self.settings.evaluate(self.q + dq)
        moved = self.settings.task.difference(self.x, tip)
        return _End(dq, _only_taut(self.settings, J), motion - moved)

    def approach(self, dq: Tensor, motion: Tensor, close: Tensor) -> _End:
        """Return the best end of Newton's method from steps dq, within the bounds."""
        best = end = self.end(dq, motion)
        for _ in range(IK_CORRECTIONS):
            going = best.distance > close
            if not going.any():
                break
            low = self.lower - end.dq
            high = self.upper - end.dq
            correction = limited_step(
                self.settings, end.J, end.missing, None, low, high
            ).dq
            dq = torch.clamp(end.dq + correction, self.lower, self.upper)
            dq = torch.where(correction >= high, self.upper, dq)
            dq = torch.where(correction <= low, self.lower, dq)
            end = self.end(dq, motion)
            best = best.where(going & (end.distance < best.distance), end)
        return best


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
    x, _ = settings.evaluate(q)
    arrival = _Arrival(settings, q, x, lower, upper)
    eps = torch.finfo(q.dtype).eps
    slip = _norm(J.flatten(1)) * (IK_SLIP * _norm(step.dq) + 32.0 * eps * _norm(q))
    promised = apply_rows(J, step.dq)
    close = torch.maximum(0.5 * _norm(promised), slip)
    end = arrival.approach(step.dq, promised, close)
    end = end._replace(missing=v - promised + end.missing)
    # Pull in the slack tendons of weak steps: the whole way to their bound, then less.
    pulls = settings.pulls.to(q)
    slack = (end.J == 0.0).all(-2) & (pulls != 0.0)
    to = torch.where(pulls < 0.0, lower, upper)
    to = torch.where(slack & torch.isfinite(to), to, end.dq)
    way = to - end.dq
    weak = end.distance > torch.maximum(0.5 * _norm(v), slip)
    weak &= (way != 0.0).any(-1, keepdim=True)
    fraction = 1.0
    while fraction > IK_LEAST_PULL and weak.any():
        dq = torch.clamp(to - (1.0 - fraction) * way, lower, upper)
        pulled = arrival.approach(dq, v, slip)
        # A slack tendon moves the tip by rounding alone.
        better = weak & (pulled.distance <= (1.0 + eps**0.5) * end.distance)
        end = end.where(better, pulled)
        weak = weak & ~better
        fraction *= IK_PULL_RATIO
    held = (end.dq <= lower) | (end.dq >= upper)
    return step._replace(dq=end.dq, saturated=held)
