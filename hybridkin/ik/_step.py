"""The law of one step, eq. (1): a task, a posture in its null space, and limits of the step.

Equations (17) to (22) are those of the page "Theory" of the documentation.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_AROUND,
    IK_BALANCE,
    IK_CORRECTIONS,
    IK_LEAST_PULL,
    IK_PULL_RATIO,
    IK_SHORTER,
    IK_SLACK,
    IK_SLIP,
    IK_STUCK,
)
from hybridkin.ik._calm import calmed
from hybridkin.ik._escape import way_out
from hybridkin.ik._gram import (
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    row_gram,
    solve_rows,
)
from hybridkin.ik._levels import up_to_level, uppermost, with_lower_levels
from hybridkin.ik._rates import stopping
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._strict import StepLimits, step_within
from hybridkin.ik.limits import Bounds, with_limit


class StepRows(NamedTuple):
    """Steps and further results, one row each."""

    dq: Tensor
    sigma_min: Tensor
    damping: Tensor
    saturated: Tensor
    promised: Tensor  # motion of the tip to first order
    stopped: Tensor | bool = False  # by a tip limit
    blocked: Tensor | bool = False  # by an obstacle

    @property
    def held(self) -> Tensor:
        """Whether a limit restricted the steps, bool (N,)."""
        return self.saturated.any(-1) | self.stopped

    @property
    def damped(self) -> Tensor:
        """Whether the steps were damped, or no motion is possible, bool (N,)."""
        return (self.damping > 0.0) | (self.sigma_min == 0.0)


class Law(NamedTuple):
    """The settings of steps, and the least lambda^2 of this period, zero for none.

    That is one number for every row (N,), or for every level and row (L, N).
    """

    settings: StepSettings
    least: Tensor

    def step(self, J: Tensor, v: Tensor, posture: Tensor, limits: StepLimits) -> StepRows:
        """Return the step for the task v and the posture step, within the limits."""
        return limited_step(self.settings, J, v, posture, limits, least=self.least)


def control_step(
    settings: StepSettings,
    q: Tensor,
    J: Tensor,
    e: Tensor,
    tip: Tensor,
    seconds: float,
    feed_forward: Tensor | float = 0.0,
    last: Tensor | float = 0.0,
    bounds: Bounds | None = None,
    least: Tensor | float = 0.0,
    scene: Tensor | None = None,
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
    tip : Tensor of shape (N, ...)
        Where the tips are for limits of the tip and limits of the caller's own.
    seconds : float
        Time to the next step [s].
    feed_forward : Tensor of shape (N, m) or float
        Motion of the targets in this period [m].
    last : Tensor of shape (N, n) or float
        Previous step, scaled to this period.
    bounds : Bounds, optional
        Bounds of the step. Default: the limits.
    least : Tensor of shape (N,) or float
        Least lambda^2, in the unit in which weights are 1.
    scene : Tensor of shape (K, IK_OBSTACLE), optional
        Where the obstacles are now. Default: where they are in the settings.

    Returns
    -------
    StepRows
        The steps; sigma_min is NaN for rows that are not finite.
    """
    gain, beta = settings.rates(seconds)
    feed_forward = feed_forward + torch.zeros_like(e)
    last = last + torch.zeros_like(q)
    law = Law(settings, least + torch.zeros_like(q[:, 0]))

    # Rows that are not finite, or overflow, get zeros, and no step at the end.
    error_size = e.norm(dim=-1, keepdim=True)
    speed = (feed_forward + gain * e).norm(dim=-1, keepdim=True)
    moving = _finite(last)
    fine = _finite(q) & _finite(J.flatten(1)) & _finite(error_size + speed) & moving
    last = torch.where(moving, last, 0.0)
    at = torch.where(fine, q, 0.0)
    e = torch.where(fine, e, 0.0)
    feed_forward = torch.where(fine, feed_forward, 0.0)
    J = torch.where(fine[..., None], J, 0.0)
    J = _only_taut(settings, J)

    # Limit the speed towards target and posture so that the actuators can brake in time.
    posture = torch.zeros_like(q)
    if settings.has_posture:
        posture = beta * (settings.preferred(at) - at)
        posture = torch.where(fine, posture, 0.0)
    change = settings.change(q, seconds).expand_as(q)
    if scene is None:
        scene = settings.clear.scene
    if settings.accelerates:
        gain = _gains(law, J, e, change, gain)
        if settings.has_posture:
            fastest = stopping((posture / beta).abs(), change)
            posture = torch.clamp(posture, -fastest, fastest)

    # Eq. (17), within the limits of q, of its speed and acceleration, of the tip, and of the body.
    v = feed_forward + gain * e
    if bounds is None:
        bounds = settings.step_bounds(q, seconds, last)
    limits = StepLimits.of_bounds(*bounds, q)
    spaces = settings.tip_limits
    stopped = torch.zeros_like(fine[:, 0])
    allowed = v
    if spaces.n > 0:
        margin = spaces.margin(torch.where(fine, tip, 0.0))
        if settings.accelerates:
            normals = moved(spaces.normals, J)[:, None].expand(-1, len(J), -1)
            brakes = [_braking(law, J, normal, change) for normal in normals]
            margin = stopping(margin, torch.stack(brakes, dim=-1))
        limits = limits.with_rows(moved(spaces.normals, J) @ J, margin)
        left = margin - spaces.along(v)
        rounding = 32.0 * torch.finfo(v.dtype).eps  # of a motion [m]
        stopped = (left < -rounding).any(-1)
        allowed = v + spaces.way_in(left)
    for limit in settings.own_limits:
        limits, known = with_limit(limit, at, tip, J, limits)
        fine = fine & known
    wish = _Wish(law, at, J, v, allowed, e, posture, Bounds(limits.lower, limits.upper))
    if settings.clear:
        step = _clear_step(wish, limits, change, scene)
    else:
        step = wish.step(limits)
    step = step._replace(stopped=stopped)

    # The other rows stay, or brake; outside the limits their finite actuators return.
    fine = fine & _finite(step.dq)
    still = bounds.clip(torch.zeros_like(q))
    still = torch.where(torch.isfinite(q), still, 0.0)
    return step._replace(
        dq=torch.where(fine, step.dq, still),
        sigma_min=torch.where(fine[:, 0], step.sigma_min, math.nan),
        damping=torch.where(fine[:, 0], step.damping, 0.0),
        saturated=torch.where(fine, step.saturated, bounds.held(still)),
    )


class _Wish(NamedTuple):
    """What steps are for: the task v, of which limits of the tip allow a part, and the posture."""

    law: Law
    q: Tensor
    J: Tensor
    v: Tensor
    allowed: Tensor
    e: Tensor
    posture: Tensor
    bounds: Bounds

    def times(self, part: Tensor) -> _Wish:
        """Return parts (N, 1) of these wishes."""
        return self._replace(
            v=part * self.v, allowed=part * self.allowed, posture=part * self.posture
        )

    def step(self, limits: StepLimits) -> StepRows:
        """Return the step within limits, for which tendons can only pull."""
        settings = self.law.settings
        step = self.law.step(self.J, self.v, self.posture, limits)
        pulls = bool(settings.pulls.any())
        if settings.tip_limits.n == 0 and not pulls:
            J, v, e = (uppermost(settings.task, part) for part in (self.J, self.v, self.e))
            step = _escaping(self.law, self.q, J, v, e, step, self.bounds)
        step = step._replace(promised=apply_rows(self.J, step.dq))
        if not pulls:
            return step
        arrived = _arriving(self.law, self.q, self.J, self.allowed, step, self.bounds)
        beyond = limits.leaves_rows(arrived.dq)[:, None]  # arrival knows no rows
        return step._replace(
            dq=torch.where(beyond, step.dq, arrived.dq),
            saturated=torch.where(beyond, step.saturated, arrived.saturated),
        )


def _clear_step(wish: _Wish, limits: StepLimits, change: Tensor, scene: Tensor) -> StepRows:
    """Return the step after which the body is clear of obstacles, and can stop before them.

    The rows of the gaps hold to first order. Where the model bends its way into an obstacle they
    are tightened by what it took too much. If that does not help, or leads a free robot away from
    its target, as in a wedge, the step is shortened towards the hardest braking.
    """
    bounds = wish.bounds
    near = wish.law.settings.clear.near(wish.q, change, scene)
    b = near.b
    target = wish.v
    free = (near.gap >= 0.0).all(-1)
    first = step = wish.step(limits.with_rows(*near.rows(b)))
    blocked = near.is_active(step.dq)
    wedged = torch.zeros_like(blocked)
    for _ in range(IK_AROUND):
        way, taken = near.farthest(step.dq, change)
        broken = near.is_broken(taken).any(-1)
        if not broken.any():
            return step._replace(blocked=blocked)
        blocked = blocked | broken
        b, part = near.tightened(b, step.dq, way, taken)
        wish = wish.times(part)
        step = wish.step(limits.with_rows(*near.rows(b)))
        towards = (step.promised * target).sum(-1) > 0.0
        wedged = wedged | (broken & free & ~towards)
        step = step._replace(dq=torch.where(wedged[:, None], first.dq, step.dq))

    brake = bounds.clip(torch.zeros_like(step.dq))
    wanted = step.dq
    part = torch.ones_like(wanted[:, :1])
    for halving in range(IK_SHORTER + 1):
        dq = torch.where(part < 1.0, brake + part * (wanted - brake), wanted)
        _, taken = near.farthest(dq, change)
        broken = near.is_broken(taken).any(-1, keepdim=True)
        if not broken.any():
            break
        shorter = 0.5 * part if halving < IK_SHORTER else 0.0
        part = torch.where(broken, shorter, part)
    dq = torch.where(part < 1.0, brake + part * (wanted - brake), wanted)
    held = torch.where(part < 1.0, bounds.held(dq), step.saturated)
    promised = torch.where(part < 1.0, apply_rows(wish.J, dq), step.promised)
    return step._replace(dq=dq, saturated=held, promised=promised, blocked=blocked)


def limited_step(
    settings: StepSettings,
    J: Tensor,
    v: Tensor,
    posture: Tensor,
    limits: StepLimits,
    damping_sq: Tensor | None = None,
    least: Tensor | float = 0.0,
) -> StepRows:
    """Return the step for the task v and the posture step, within the limits.

    Weights are a change of unit: in u = W^(1/2) q all weights are 1. With `damping_sq`, lambda^2 in
    this unit, singular values are not computed, and sigma_min is NaN. Else lambda^2 is at `least`
    a number; where this is positive, the posture step is at most half as long as that of the task.

    Of a task of several levels sigma_min and damping are those of the first level. `least` may be a
    number for every level (L, N); `damping_sq` (L, N) is the least lambda^2, too.
    """
    if settings.task.n_levels == 1:
        return _one_level(settings, settings.task.n_free, J, v, posture, limits, damping_sq, least)
    first = settings.task.by_level[0]
    n_levels = settings.task.n_levels
    least = least + v.new_zeros(n_levels, len(v))
    if damping_sq is not None:
        least = least.maximum(damping_sq)
    still = torch.zeros_like(posture)
    step = _one_level(
        settings, first.n_free, J[:, first.rows], v[:, first.rows], still, limits, None, least[0]
    )
    dq = with_lower_levels(settings, J, v, posture, limits, step.dq, least)
    return step._replace(dq=dq, saturated=limits.held(dq), promised=v)


def _one_level(
    settings: StepSettings,
    n_free: int,
    J: Tensor,
    v: Tensor,
    posture: Tensor,
    limits: StepLimits,
    damping_sq: Tensor | None,
    least: Tensor | float,
) -> StepRows:
    """Return the step for one level, as `limited_step`; `n_free` is that of its rows."""
    unit = settings.unit(v)
    J = J * unit
    box = limits.in_unit(unit)
    posture = posture / unit

    # Eq. (17): damped least squares, and the part of the posture step that does not move the tip.
    z = torch.zeros_like(J[:, 0])
    if damping_sq is not None:
        mu = solve_rows(J, v, damping_sq)
        sigma_min = torch.full_like(damping_sq, math.nan)
    else:
        gram = row_gram(J, n_free)
        sigma_min = gram.sigma_min
        if isinstance(settings.damping, str):
            damping_sq = adaptive_damping(gram)
        else:
            damping_sq = (settings.damping * gram.sigma_max).square()
        damping_sq = damping_sq.clamp_min(least)
        mu = damped_solve(gram, v, damping_sq)
        z = null_projection(J, gram, posture)
    dq = apply_columns(J, mu)
    calm = least + torch.zeros_like(damping_sq) > 0.0
    z = calmed(z, dq, calm)
    dq = dq + z

    # Rows within all limits keep this step; eq. (19) is solved for the others. Weights turn J out
    # of the plane.
    if settings.limits != "off":
        out_of_plane = bool(settings.plane.n_normals) and settings.weighted
        over = (box.broken(dq) | out_of_plane).nonzero()[:, 0]
        if over.numel() > 0:
            rows, motion = _with_plane(settings, J, v, posture)
            inside = step_within(
                rows[over], motion[over], z[over], damping_sq[over], box.take(over), calm[over]
            )
            dq = dq.index_put((over,), inside)
    held = box.held(dq)
    dq = limits.clip(dq * unit)
    return StepRows(dq, sigma_min, damping_sq.sqrt(), held, v)


def null_step(settings: StepSettings, J: Tensor, step: Tensor) -> Tensor:
    """Return the part of steps (N, n) in the null space of J (N, m, n)."""
    unit = settings.unit(J)
    J = J * unit
    return unit * null_projection(J, row_gram(J), step / unit)


def _with_plane(
    settings: StepSettings, J: Tensor, v: Tensor, posture: Tensor
) -> tuple[Tensor, Tensor]:
    """Return J and v with further rows: only `posture` leaves the plane, also at the limits.

    Else a limit that stops one actuator would unbalance the others.
    """
    if not settings.plane.n_normals:
        return J, v
    # J is in the unit in which weights are 1, so that only their ratios count.
    unit = settings.unit(v)
    size = J.flatten(1).norm(dim=-1) / unit.square().mean().sqrt()
    stiff = IK_BALANCE * size[:, None, None]
    rows = stiff * (settings.plane.normals.to(J).mT * unit)
    aside = apply_rows(rows, posture)
    return torch.cat([J, rows], dim=1), torch.cat([v, aside], dim=1)


def _finite(rows: Tensor) -> Tensor:
    """Return whether all numbers of rows (N, k) are finite, shape (N, 1)."""
    return torch.isfinite(rows).all(-1, keepdim=True)


def _norm(rows: Tensor) -> Tensor:
    """Return the lengths (N, 1) of rows."""
    return rows.norm(dim=-1, keepdim=True)


def _gains(law: Law, J: Tensor, e: Tensor, change: Tensor, most: float) -> Tensor:
    """Return the gains, at most `most`, with which errors e (N, m) can be braked, (N, m) or (N, 1).

    A level is not slowed down by those after it.
    """
    task = law.settings.task
    if task.n_levels == 1:
        brake = _braking(law, J, e, change)
        return stopping(torch.ones_like(brake), brake).clamp_max(most)[:, None]
    gains = torch.empty_like(e)
    for k, level in enumerate(task.by_level):
        brake = _braking(law, up_to_level(task, J, k), up_to_level(task, e, k), change)
        gain = stopping(torch.ones_like(brake), brake).clamp_max(most)
        gains[:, level.rows] = gain[:, None]
    return gains


def _braking(law: Law, J: Tensor, way: Tensor, change: Tensor) -> Tensor:
    """Return the largest change of the tip's motion per period, in multiples of `way` (N,)."""
    free = torch.full_like(J[:, 0], math.inf)
    step = law.step(J, way, torch.zeros_like(free), StepLimits.of_bounds(-free, free, free))
    return (change / step.dq.abs()).amin(-1)


def _escaping(
    law: Law,
    q: Tensor,
    J: Tensor,
    v: Tensor,
    e: Tensor,
    step: StepRows,
    bounds: Bounds,
) -> StepRows:
    """Return steps that leave singular configurations in which they promise almost nothing of v."""
    promised = apply_rows(J, step.dq).norm(dim=-1)
    damped = step.damping.square() > 1.001 * torch.atleast_2d(law.least)[0]
    singular = damped | ~(step.sigma_min > 0.0)
    stuck = singular & (promised <= IK_STUCK * v.norm(dim=-1)) & (_norm(e)[:, 0] > 0.0)
    rows = stuck.nonzero()[:, 0]
    if rows.numel() == 0:
        return step
    lower, upper = (end.expand_as(q) for end in bounds)
    of_rows = Bounds(lower[rows], upper[rows])
    way = way_out(law.settings, q[rows], J[rows], e[rows], step.dq[rows], of_rows)
    dq = step.dq.index_put((rows,), of_rows.clip(step.dq[rows] + way))
    left = torch.zeros_like(stuck).index_put((rows,), (way != 0.0).any(-1))
    held = torch.where(left[:, None], bounds.held(dq), step.saturated)
    return step._replace(dq=dq, saturated=held)


# Tendons that can only pull.


def _only_taut(settings: StepSettings, J: Tensor) -> Tensor:
    """Return J (N, m, n) without the columns of slack tendons.

    A learned error makes them small instead of zero, and a step would drive these tendons far.
    """
    size = J.norm(dim=-2, keepdim=True)
    small = size <= IK_SLACK * size.amax(-1, keepdim=True)
    return torch.where(small & (moved(settings.pulls, J) != 0.0), 0.0, J)


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

    law: Law
    q: Tensor
    x: Tensor
    bounds: Bounds

    def end(self, dq: Tensor, motion: Tensor) -> _End:
        """Return the end of steps dq, whose tips are to make a motion (N, m)."""
        settings = self.law.settings
        tip, J = settings.evaluate(self.q + dq)
        moved = settings.task.difference(self.x, tip)
        missing = uppermost(settings.task, motion - moved)
        return _End(dq, _only_taut(settings, J), missing)

    def approach(self, dq: Tensor, motion: Tensor, close: Tensor) -> _End:
        """Return the best end of Newton's method from steps dq, within the bounds."""
        lower, upper = self.bounds
        best = end = self.end(dq, motion)
        for _ in range(IK_CORRECTIONS):
            going = best.distance > close
            if not going.any():
                break
            left = StepLimits.of_bounds(lower - end.dq, upper - end.dq, end.dq)
            still = torch.zeros_like(end.J[:, 0])
            step = self.law.step(end.J, end.missing, still, left)
            dq = self.bounds.clip(end.dq + step.dq)
            dq = torch.where(step.dq >= left.upper, upper, dq)
            dq = torch.where(step.dq <= left.lower, lower, dq)
            end = self.end(dq, motion)
            nearer = end.distance < best.distance
            best = best.where(going & nearer, end)
        return best


def _arriving(
    law: Law,
    q: Tensor,
    J: Tensor,
    v: Tensor,
    step: StepRows,
    bounds: Bounds,
) -> StepRows:
    """Return steps whose tips move as the steps promised, with tendons that can only pull.

    Their Jacobian jumps where a tendon gets slack or taut, so each end is evaluated by the model.
    Newton's method corrects it within the bounds. Where the result is less than half of the motion
    v, slack tendons are pulled in, as far as the tip gets nearer to v or not away. Of several
    levels the first one decides.
    """
    settings = law.settings
    v = uppermost(settings.task, v)
    promised = uppermost(settings.task, step.promised)
    x, _ = settings.evaluate(q)
    arrival = _Arrival(law, q, x, bounds)
    eps = torch.finfo(q.dtype).eps
    smallest_step = IK_SLIP * _norm(step.dq) + 32.0 * eps * _norm(q)
    slip = _norm(J.flatten(1)) * smallest_step
    close = torch.maximum(0.5 * _norm(promised), slip)
    end = arrival.approach(step.dq, promised, close)
    end = end._replace(missing=v - promised + end.missing)

    # Pull in the slack tendons of weak steps: the whole way to their bound, then less. None of them
    # is let out: else they could be let out where they began.
    pulls = moved(settings.pulls, q)
    to = torch.where(pulls < 0.0, *bounds)
    slack = (end.J == 0.0).all(-2) & (pulls != 0.0) & torch.isfinite(to)
    to = torch.where(slack, to, end.dq)
    way = to - end.dq
    lower = torch.where(slack & (pulls > 0.0), end.dq, bounds.lower)
    upper = torch.where(slack & (pulls < 0.0), end.dq, bounds.upper)
    inwards = arrival._replace(bounds=Bounds(lower, upper))
    weak = end.distance > torch.maximum(0.5 * _norm(v), slip)
    weak &= (way != 0.0).any(-1, keepdim=True)
    fraction = 1.0
    while fraction > IK_LEAST_PULL and weak.any():
        dq = bounds.clip(to - (1.0 - fraction) * way)
        pulled = inwards.approach(dq, v, slip)
        # A slack tendon moves the tip by rounding alone.
        allowed = (1.0 + eps**0.5) * end.distance
        better = weak & (pulled.distance <= allowed)
        end = end.where(better, pulled)
        weak = weak & ~better
        fraction *= IK_PULL_RATIO
    return step._replace(dq=end.dq, saturated=bounds.held(end.dq))
