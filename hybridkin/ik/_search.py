"""Batched search for configurations that reach targets, and descent in their null space."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_INSIDE,
    IK_INSIDE_OBSTACLE,
    IK_LAST_DAMPING,
    IK_NULL_GAIN,
    IK_NULL_SLIP,
    IK_NULL_STEPS,
    IK_SLOW,
    IK_SLOW_STEPS,
    IK_STATIONARY,
)
from hybridkin.ik._gram import apply_columns, apply_rows, row_gram
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._starts import even_starts, nearest_starts
from hybridkin.ik._step import StepRows, limited_step, null_step
from hybridkin.ik._strict import StepLimits
from hybridkin.ik.limits import Bounds
from hybridkin.ik.tasks import Tolerance

_FIRST_DAMPING = 1.0  # lambda^2 / sigma_max^2 of the first iteration
# In place of the error: reached outside the domain, and inside.
_OUTSIDE = -1.0
_DONE = -2.0
_RETURNS = 30  # attempts to return rows that ended outside the tip limits
# Where further starts are split; only rows still open use the next part.
_PARTS = [4, 8, 16]
_ROWS = 256  # rows searched again at once
_FINE = 0.01  # factor on tol when configurations are compared
_SAME = 0.01  # of the ranges: closer configurations count as the same

RowsT = TypeVar("RowsT", bound="Point")


@dataclass
class Point:
    """Configurations and the task's values there, one row per target."""

    q: Tensor
    x: Tensor
    J: Tensor
    e: Tensor
    target: Tensor

    @property
    def error(self) -> Tensor:
        """Norm of the error, shape (N,)."""
        return self.e.norm(dim=-1)

    def take(self: RowsT, rows: Tensor) -> RowsT:
        """Return some rows, by their places."""
        return type(self)(*(a[rows] for a in vars(self).values()))

    def put(self, rows: Tensor, other: Point) -> None:
        """Overwrite some rows, by their places, in the fields that both have."""
        for name in vars(self).keys() & vars(other).keys():
            vars(self)[name][rows] = vars(other)[name]

    def replace(self, better: Tensor, other: Point) -> None:
        """Take rows of another one where these are better, in the fields that both have."""
        for name in vars(self).keys() & vars(other).keys():
            present = vars(self)[name]
            mask = better.reshape(-1, *[1] * (present.ndim - 1))
            vars(self)[name] = torch.where(mask, vars(other)[name], present)


@dataclass
class Found(Point):
    """The best point so far of every row, updated in place by the search."""

    reached: Tensor
    stationary: Tensor
    held: Tensor
    n_iter: Tensor
    n_starts: Tensor


@dataclass
class _Descent(Found):
    """Rows on their way to a target."""

    start: Tensor  # initial error
    nu: Tensor  # lambda^2 / sigma_max^2 at the initial error
    growth: Tensor  # factor on nu after a step that does not lower the error
    slow: Tensor  # consecutive steps that gained little


@dataclass
class _Slide(Point):
    """Rows on their way along the null space."""

    wish: Tensor  # desired step
    free: Tensor  # its part in the null space
    fraction: Tensor  # of it, to take


@dataclass(frozen=True)
class Search:
    """Levenberg-Marquardt with box-limited steps; a step is taken if it lowers the error."""

    settings: StepSettings
    tol: Tolerance
    max_iter: int

    def solve(self, q: Tensor, target: Tensor, cold: bool, restarts: int) -> Found:
        """Return the best points from starts q (N, n), and from further starts if these fail."""
        settings = self.settings
        q = self._free(settings.start_at(q))
        target = settings.allowed(target)
        if cold and len(q) > 0:
            q = self._beside_singular_start(q, target)
        best = self._attempt(q, target)
        missed = (~best.reached).nonzero()[:, 0]
        singular = row_gram(best.J[missed], settings.task.n_free).is_singular
        rows = missed[singular.nonzero()[:, 0]]
        nudged = self._nudged(best)[rows]
        self._try_again(best, rows, nudged[:, None])
        if restarts > 0:
            self._restart(best, q, restarts)
        if settings.tip_limits.n > 0:
            self._return_inside(best)
        if settings.has_posture:
            self._to_posture(best)
        return best

    def _beside_singular_start(self, q: Tensor, target: Tensor) -> Tensor:
        """Return the common start q (N, n), moved aside if it is singular.

        At a straight backbone, motions that cancel to first order would be missed.
        """
        _, J = self.settings.evaluate(q[:1])
        if not row_gram(J, self.settings.task.n_free).is_singular.all():
            return q
        at_start = self._start(q, target)
        stay = at_start.reached | ~torch.isfinite(at_start.error)
        nudged = self.settings.start_at(self._nudged(at_start))
        return torch.where(stay[:, None], q, nudged)

    def _restart(self, best: Found, q: Tensor, restarts: int) -> None:
        """Search open rows from further starts, a few of them at a time."""
        wanted = torch.isfinite(torch.cat([q, best.target.flatten(1)], dim=1)).all(1)
        is_open = (self._cost(best) > _DONE) & wanted
        for rows in is_open.nonzero()[:, 0].split(_ROWS):
            if rows.numel() == 0:
                break
            size = _per_tip(best.J, best.error)[rows]
            target = best.target[rows]
            starts = nearest_starts(self.settings, q[rows], size, target, restarts)
            for part in starts.tensor_split(_PARTS, dim=1):
                still_open = (self._cost(best)[rows] > _DONE).nonzero()[:, 0]
                self._try_again(best, rows[still_open], part[still_open])

    def _return_inside(self, best: Found) -> None:
        """Return rows that ended outside the tip limits, by targets beyond these limits."""
        for _ in range(_RETURNS):
            way = self.settings.allowed(best.x) - best.x
            outside = ~best.reached & ~self._within(way)
            rows = outside.nonzero()[:, 0]
            if rows.numel() == 0:
                break
            target = best.x[rows] + 1.5 * way[rows]
            best.put(rows, self._attempt(best.q[rows], target))

    def several(self, best: Found, start: Tensor, restarts: int, count: int) -> Found:
        """Return `count` different points for each row of `best`, the nearest to `start` first.

        Rows without a further point have NaN as q.
        """
        if isinstance(self.tol, tuple):
            tol = tuple(_FINE * t for t in self.tol)
        else:
            tol = _FINE * self.tol
        fine = replace(self, tol=tol)
        n_starts = restarts + 1
        places = torch.arange(count * len(start), device=start.device)
        solutions = best.take(places // count)
        solutions.q[places % count > 0] = torch.nan
        done = self._cost(best) == _DONE
        for rows in done.nonzero()[:, 0].split(_ROWS):
            near = start[rows].repeat_interleave(n_starts, 0)
            ends = fine._from_even_starts(best.take(rows), start[rows], restarts)
            ends.n_starts = best.n_starts[rows].repeat_interleave(n_starts) + n_starts
            self._turn_towards(ends, near)

            # The reached ends of every row that differ, the nearest first.
            way = (ends.q - near) / moved(self.settings.spans, near)
            distance = way.norm(dim=-1)
            distance[fine._cost(ends) != _DONE] = torch.inf
            for k, row in enumerate(rows.tolist()):
                block = slice(k * n_starts, (k + 1) * n_starts)
                picks = self._different(ends.q[block], distance[block], count)
                chosen = ends.take(block.start + picks)
                first = row * count
                solutions.put(places[first : first + len(picks)], chosen)
        return solutions

    def _turn_towards(self, ends: Found, near: Tensor) -> None:
        """Turn joints by whole turns towards q (N, n), where the limits allow it."""
        turned = ends.q + self.settings.whole_turns(near - ends.q)
        allowed = self.settings.inside(turned) == turned
        ends.q = torch.where(allowed, turned, ends.q)

    def _different(self, q: Tensor, distance: Tensor, count: int) -> Tensor:
        """Return which of the configurations (s, n) differ, up to `count`, by their distance."""
        picks = []
        while len(picks) < count and torch.isfinite(distance).any():
            pick = int(distance.argmin())
            picks.append(pick)
            apart = q - q[pick]
            apart = apart - self.settings.whole_turns(apart)
            relative = (apart / moved(self.settings.spans, q)).abs()
            same = relative.amax(-1) <= _SAME
            distance = torch.where(same, torch.inf, distance)
        return torch.tensor(picks, dtype=torch.long, device=q.device)

    def _from_even_starts(self, best: Found, start: Tensor, restarts: int) -> Found:
        """Return the results from the best points and from `restarts` even starts, row by row."""
        anywhere = torch.zeros_like(best.error)
        starts = even_starts(self.settings, start, anywhere, restarts)
        starts = starts.expand(len(start), -1, -1)
        starts = torch.cat([best.q[:, None], starts], dim=1)
        ends = self._from(starts, best.target)
        if self.settings.has_posture:
            self._to_posture(ends)
        return ends

    def _from(self, starts: Tensor, target: Tensor) -> Found:
        """Return the results of several starts (N, s, n) for each target, row by row."""
        rows = self._free(self.settings.start_at(starts.flatten(0, 1)))
        return self._attempt(rows, target.repeat_interleave(starts.shape[1], 0))

    def _to_posture(self, ends: Found) -> None:
        self._descend(ends, lambda q: self.settings.preferred(q) - q)

    def _attempt(self, q: Tensor, target: Tensor) -> Found:
        """Return the result of one start; results outside the domain are moved towards it."""
        ends = self._lower(q, target)
        outside = self._cost(ends) == _OUTSIDE
        rows = outside.nonzero()[:, 0]
        moved = ends.take(rows)
        self._descend(moved, self._inward)
        ends.put(rows, moved)
        return ends

    def _try_again(self, best: Found, rows: Tensor, starts: Tensor) -> None:
        """Search rows (k,) from further starts (k, s, n) at once, and keep the best results."""
        n_starts = starts.shape[1]
        if rows.numel() == 0 or n_starts == 0:
            return
        ends = self._from(starts, best.target[rows])
        best.n_iter[rows] += ends.n_iter.view(-1, n_starts).sum(1)
        best.n_starts[rows] += n_starts
        # The best end of every row; the counts are those of the row.
        cost = self._cost(ends).view(-1, n_starts)
        first = n_starts * torch.arange(len(rows), device=rows.device)
        ends = ends.take(first + cost.argmin(1))
        ends.n_iter = best.n_iter[rows]
        ends.n_starts = best.n_starts[rows]
        better = self._cost(ends) < self._cost(best)[rows]
        ends.replace(~better, best.take(rows))
        best.put(rows, ends)

    def _cost(self, ends: Found) -> Tensor:
        """Return the error, or -1 for rows reached outside the domain, -2 for inside.

        Infinite where there is no tip.
        """
        inside = self.settings.task.in_domain(ends.q)
        reached = torch.where(inside, _DONE, _OUTSIDE)
        error = ends.error.nan_to_num(torch.inf, torch.inf)
        return torch.where(ends.reached, reached, error)

    def _point(self, q: Tensor, target: Tensor) -> Point:
        x, J = self.settings.evaluate(q)
        e = self.settings.task.difference(x, target)
        return Point(q, x, J, e, target)

    def _start(self, q: Tensor, target: Tensor) -> Found:
        point = self._point(q, target)
        copies = [part.clone() for part in vars(point).values()]
        reached = self._reached(point)
        n_iter = torch.zeros_like(reached, dtype=torch.long)
        return Found(
            *copies,
            reached=reached,
            stationary=torch.zeros_like(reached),
            held=torch.zeros_like(reached),
            n_iter=n_iter,
            n_starts=n_iter + 1,
        )

    # Levenberg-Marquardt: eq. (19) without posture, at a damping that follows the progress.

    def _lower(self, q: Tensor, target: Tensor) -> Found:
        """Lower the error until it is within tol or cannot be lowered."""
        state = self._start(q, target)
        rows = torch.arange(len(q), device=q.device)
        damping = torch.full_like(state.error, _FIRST_DAMPING)
        none = torch.zeros_like(damping)
        live = _Descent(
            **vars(state.take(rows)), start=state.error, nu=damping, growth=2.0 + none, slow=none
        )
        for iteration in range(self.max_iter + 1):
            live.reached = self._reached(live)
            live.stationary = (
                self._blocked(live) | (live.nu > IK_LAST_DAMPING) | (live.slow >= IK_SLOW_STEPS)
            )
            live.n_iter = torch.full_like(live.n_iter, iteration)
            going = ~live.reached & ~live.stationary & (iteration < self.max_iter)
            # One question for each iteration: a device waits for the answer.
            left = going.nonzero()[:, 0]
            if len(left) < len(rows):
                state.put(rows, live)
                rows = rows[left]
                live = live.take(left)
            if rows.numel() == 0:
                break
            self._lower_once(live)
        return state

    def _lower_once(self, live: _Descent) -> None:
        """Try a step of all rows, and take it where it lowers the error."""
        settings = self.settings
        error = live.error
        # Damping proportional to the error: the last iterations are Gauss-Newton steps.
        trust = live.nu * (error / live.start)
        size = (live.J * settings.unit(live.J)).flatten(1).square().sum(-1)
        # A turning joint may pass its limit and continue at the other one.
        lower, upper = settings.step_bounds(live.q)
        half_turn = 0.5 * moved(settings.periods, live.q)
        stays = torch.isinf(half_turn)
        lower = lower.where(stays, -half_turn)
        upper = upper.where(stays, half_turn)
        limits = StepLimits.of_bounds(lower, upper, live.q)
        still = torch.zeros_like(live.q)
        step = self._step(live, still, limits, trust * size)
        new = self._point(self._free(settings.inside(live.q + step.dq)), live.target)
        error_new = new.error
        predicted = (live.e - apply_rows(live.J, step.dq)).norm(dim=-1)

        # The damping follows the ratio of actual to predicted gain.
        gain = error.square() - error_new.square()
        predicted_gain = error.square() - predicted.square()
        quality = gain / predicted_gain.clamp_min(1e-30)
        factor = (1.0 - (2.0 * quality - 1.0) ** 3).clamp(1.0 / 3.0, 2.0)
        better = (error_new < error) & self._stays_free(live.q, new.q)
        live.nu = live.nu * torch.where(better, factor, live.growth)
        live.growth = torch.where(better, 2.0, 2.0 * live.growth)
        metres = self.tol[0] if isinstance(self.tol, tuple) else self.tol
        little = better & (error - error_new < IK_SLOW * metres)
        live.slow = torch.where(little, live.slow + 1.0, 0.0)
        live.held = step.saturated.any(-1)
        live.replace(better, new)

    def _within(self, e: Tensor) -> Tensor:
        return self.settings.task.reached(e, self.tol)

    def _reached(self, at: Point) -> Tensor:
        """Return whether errors are within tol and the body is free."""
        clear = self.settings.clear
        return self._within(at.e) & ~clear.is_inside(at.q, clear.scene)

    def _step(
        self, at: Point, posture: Tensor, limits: StepLimits, damping_sq: Tensor | None = None
    ) -> StepRows:
        """Return steps within limits, which take of the gaps to obstacles at most what there is."""
        clear = self.settings.clear
        if not clear:
            return limited_step(self.settings, at.J, at.e, posture, limits, damping_sq)
        near = clear.near(at.q, torch.full_like(at.q, math.inf), clear.scene)
        limits = limits.with_rows(*near.rows(near.gap))
        return limited_step(self.settings, at.J, at.e, posture, limits, damping_sq)

    def _free(self, q: Tensor) -> Tensor:
        """Return configurations moved out of obstacles, within the limits."""
        box = self.settings.box(q)
        return self.settings.clear.freed(q, box.lower.expand_as(q), box.upper.expand_as(q))

    def _stays_free(self, q: Tensor, q_new: Tensor) -> Tensor:
        """Return whether the body is as free as before, or free, bool (N,)."""
        clear = self.settings.clear
        if not clear:
            return torch.ones_like(q[:, 0], dtype=torch.bool)
        allowed = clear.smallest(q, clear.scene).clamp_max(0.0)
        return clear.smallest(q_new, clear.scene) >= allowed - 0.5 * IK_INSIDE_OBSTACLE

    def _blocked(self, at: Point) -> Tensor:
        """Return whether no motion within the limits lowers the error to first order."""
        lower, upper = self.settings.box(at.q)
        pull = apply_columns(at.J, at.e)
        above = (at.q >= upper) & (pull > 0.0)
        below = (at.q <= lower) & (pull < 0.0)
        turns = torch.isfinite(moved(self.settings.periods, at.q))
        held = (above | below) & ~turns
        free_pull = torch.where(held, 0.0, pull).norm(dim=-1)
        return free_pull <= IK_STATIONARY * at.J.flatten(1).norm(dim=-1) * at.error

    # Descent in the null space, towards the posture or into the domain.

    def _inward(self, q: Tensor) -> Tensor:
        """Return Newton's step to a domain distance slightly below 1.

        Zero if the distance has no gradient, e.g. for a function that only returns whether q is in
        its domain.
        """
        slope = torch.zeros_like(q)
        with torch.enable_grad():
            leaf = q.detach().requires_grad_(True)
            distance = self.settings.task.domain_distance(leaf)
            if distance.requires_grad:
                (slope,) = torch.autograd.grad(distance.sum(), leaf, materialize_grads=True)
        beyond = (distance.detach() - IK_INSIDE).clamp_min(0.0)
        square = slope.square().sum(-1)
        length = beyond / torch.where(square > 0.0, square, 1.0)
        return -length[:, None] * slope

    def _descend(self, ends: Found, wanted: Callable[[Tensor], Tensor]) -> None:
        """Move reached rows along their null space in the direction of the desired steps.

        The error may exceed tol temporarily, by a fraction of the motion, because the next step
        corrects it; only points within tol are recorded. The gain of a step is its displacement
        times the mean of the free (null-space) part of the desired step before and after it: the
        trapezoidal rule for the Lagrangian, which ignores the task part of the step. The fraction
        of the desired step to take follows from the curvature of the last step.
        """
        all_rows = ends.reached.nonzero()[:, 0]
        if all_rows.numel() == 0:
            return
        rows = all_rows
        task = self.settings.task
        unit = self.settings.unit(ends.q)
        was_inside = task.in_domain(ends.q)
        start = ends.take(rows)
        live = self._slide(start, wanted, torch.ones_like(start.error))
        for iteration in range(IK_NULL_STEPS):
            # The last step only corrects the error.
            last = iteration == IK_NULL_STEPS - 1
            way = live.fraction[:, None] * live.free
            if last:
                way = torch.zeros_like(way)
            point = self._after_step(live, way)
            new = self._slide(point, wanted, live.fraction)
            dq = new.q - live.q
            moved = dq / unit
            gain = 0.5 * ((live.free + new.free) / unit * moved).sum(-1)

            # Take a step that gains while its error is small, or that corrects a large error, but
            # none that leaves the domain.
            reached = self._within(live.e)
            reached_new = self._within(new.e)
            unprojected = live.J.flatten(1).norm(dim=-1) * dq.norm(dim=-1)
            small = reached_new | (new.error <= IK_NULL_SLIP * unprojected)
            corrects = ~reached & (new.error < 0.5 * live.error)
            stays_inside = task.in_domain(new.q) | ~was_inside[rows]
            stays_inside &= self._stays_free(live.q, new.q)
            taken = ((small & (gain > 0.0)) | corrects | last) & stays_inside
            recorded = taken & reached_new
            point.replace(~recorded, ends.take(rows))
            ends.put(rows, point)
            ends.n_iter[rows] += 1

            # Go on while it is worth it, or with shorter steps.
            least_gain = IK_NULL_GAIN * (live.wish / unit).square().sum(-1)
            unfinished = (gain > least_gain) | ~reached | ~reached_new
            going = torch.where(taken, unfinished, live.fraction > 0.01)

            # The fraction that the curvature of a step that is taken suggests for the next one.
            change = (moved * (live.free - new.free) / unit).sum(-1)
            curvature = change / moved.square().sum(-1)
            newton = 1.0 / curvature
            fraction = torch.where(curvature > 0.0, newton, 2.0 * live.fraction)
            new.fraction = fraction.clamp(0.1, 4.0)
            live.fraction = 0.25 * live.fraction
            live.replace(taken, new)
            left = going.nonzero()[:, 0]
            rows = rows[left]
            live = live.take(left)
            if rows.numel() == 0:
                break
        # A step of the free actuators removes what is left of the error.
        best = ends.take(all_rows)
        corrected = self._after_step(best, torch.zeros_like(best.q), hold=True)
        better = (corrected.error < best.error) & self._reached(corrected)
        best.replace(better, corrected)
        ends.put(all_rows, best)

    def _slide(self, at: Point, wanted: Callable[[Tensor], Tensor], fraction: Tensor) -> _Slide:
        wish = wanted(at.q)
        free = null_step(self.settings, at.J, wish)
        return _Slide(at.q, at.x, at.J, at.e, at.target, wish, free, fraction)

    def _after_step(self, at: Point, posture: Tensor, hold: bool = False) -> Point:
        """Return the point after a step; `hold` fixes actuators at a limit."""
        bounds = self.settings.step_bounds(at.q)
        if hold:
            held = bounds.held(torch.zeros_like(at.q))
            bounds = Bounds(*(end.where(~held, 0.0) for end in bounds))
        limits = StepLimits.of_bounds(*bounds, at.q)
        step = self._step(at, posture, limits)
        return self._point(at.q + step.dq, at.target)

    def _nudged(self, at: Found) -> Tensor:
        """Return starts beside singular points, where first-order motion does not help.

        Examples are a straight backbone that has to shorten, or a stretched arm: the error is
        stationary but not minimal. A second-order motion is needed, which is large even for small
        errors: 5 % of the limits, or the motion that moves a regular tip by a tenth of the error.
        """
        settings = self.settings
        size = 0.1 * _per_tip(at.J, at.error)[:, None]
        span = 0.05 * (settings.q_max - settings.q_min).to(at.q)
        span = torch.where(torch.isfinite(span), span, 0.0)
        # Unequal factors, because equal ones can cancel in a symmetric robot.
        factors = torch.ones_like(at.q).cumsum(-1).cos()
        return at.q + torch.maximum(size, span) * factors


def _per_tip(J: Tensor, error: Tensor) -> Tensor:
    """Return the motion (N,) of an actuator that moves the tip by about the error."""
    size = J.flatten(1).norm(dim=-1)
    return torch.where(size > 0.0, error / size, error)
