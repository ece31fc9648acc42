"""Batched search for configurations that reach targets, and descent in their null space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import (
    IK_INSIDE,
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
from hybridkin.ik.tasks import Tolerance

_FIRST_DAMPING = 1.0  # lambda^2 / sigma_max^2 of the first iteration
# in place of the error: reached outside the domain, and inside
_OUTSIDE = -1.0
_DONE = -2.0
_RETURNS = 30  # attempts to return rows that ended outside the tip limits
# Where further starts are split; only rows still open use the next part.
_PARTS = [
    4,
    8,
    16,
]
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
        """Return some rows."""
        return type(self)(*(a[rows] for a in vars(self).values()))

    def put(self, rows: Tensor, other: Point) -> None:
        """Overwrite some rows, in place, in the fields that both have."""
        for name in vars(self).keys() & vars(other).keys():
            vars(self)[name][rows] = vars(other)[name]


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
    share: Tensor  # fraction of it to take


@dataclass(frozen=True)
class Search:
    """Levenberg-Marquardt with box-limited steps; a step is taken if it lowers the error."""

    settings: StepSettings
    tol: Tolerance
    max_iter: int

    def solve(self, q: Tensor, target: Tensor, cold: bool, restarts: int) -> Found:
        """Return the best points from starts q (N, n), and from further starts if these fail."""
        settings = self.settings
        q = settings.start_at(q)
        target = settings.allowed(target)
        if (
            cold
            and len(q) > 0
            and row_gram(settings.evaluate(q[:1])[1]).is_singular.all()
        ):
            # At a straight backbone, motions that cancel to first order would be missed.
            at_start = self._start(q, target)
            nudged = settings.start_at(self._nudged(at_start))
            stay = at_start.reached | ~torch.isfinite(at_start.error)
            q = torch.where(stay[:, None], q, nudged)
        best = self._attempt(q, target)
        rows = (~best.reached & row_gram(best.J).is_singular).nonzero()[:, 0]
        self._try_again(best, rows, self._nudged(best)[rows, None])
        rows = ((self._cost(best) > _DONE) & torch.isfinite(best.error)).nonzero()[:, 0]
        for some in rows.split(_ROWS) if restarts * len(rows) > 0 else ():
            size = _per_tip(best.J, best.error)[some]
            starts = nearest_starts(
                settings, q[some], size, best.target[some], restarts
            )
            for part in starts.tensor_split(_PARTS, dim=1):
                open_rows = self._cost(best)[some] > _DONE
                self._try_again(best, some[open_rows], part[open_rows])
        for _ in range(_RETURNS if settings.tip_limits is not None else 0):
            way = settings.allowed(best.x) - best.x
            rows = (~best.reached & ~self._within(way)).nonzero()[:, 0]
            if rows.numel() == 0:
                break
            best.put(rows, self._attempt(best.q[rows], (best.x + 1.5 * way)[rows]))
        if settings.has_posture:
            self._to_posture(best)
        return best

    def several(self, best: Found, start: Tensor, restarts: int, count: int) -> Found:
        """Return `count` different points for each row of `best`, the nearest to `start` first.

        Rows without a further point have NaN as q.
        """
        settings = self.settings
        n_starts = restarts + 1
        spans = settings.spans.to(start)
        if isinstance(self.tol, tuple):
            tol = tuple(_FINE * t for t in self.tol)
        else:
            tol = _FINE * self.tol
        fine = replace(self, tol=tol)
        rows = torch.arange(len(start), device=start.device)
        solutions = best.take(rows.repeat_interleave(count))
        further = torch.arange(len(solutions.q), device=start.device) % count > 0
        solutions.q[further] = torch.nan
        for some in (self._cost(best) == _DONE).nonzero()[:, 0].split(_ROWS):
            near = start[some].repeat_interleave(n_starts, 0)
            further_solutions = fine._from_even_starts(
                best.take(some), start[some], restarts
            )
            turned = further_solutions.q + settings.whole_turns(
                near - further_solutions.q
            )
            further_solutions.q = torch.where(
                settings.inside(turned) == turned, turned, further_solutions.q
            )
            distance = ((further_solutions.q - near) / spans).norm(dim=-1)
            distance = torch.where(
                fine._cost(further_solutions) == _DONE, distance, torch.inf
            )
            distance = distance.view(-1, n_starts)
            first = n_starts * torch.arange(len(some), device=some.device)
            q = further_solutions.q.unflatten(0, (-1, n_starts))
            further_solutions.n_starts = (
                best.n_starts[some].repeat_interleave(n_starts) + n_starts
            )
            for place in range(count):
                nearest, pick = distance.min(1)
                exists = torch.isfinite(nearest)
                picked = further_solutions.take(first + pick)
                solutions.put(count * some[exists] + place, picked.take(exists))
                apart = q - picked.q[:, None]
                apart = ((apart - settings.whole_turns(apart)) / spans).abs().amax(-1)
                distance = torch.where(apart <= _SAME, torch.inf, distance)
        return solutions

    def _from_even_starts(self, best: Found, start: Tensor, restarts: int) -> Found:
        """Return the results from the best points and from `restarts` even starts, row by row."""
        starts = even_starts(
            self.settings, start, torch.zeros_like(best.error), restarts
        )
        starts = torch.cat([best.q[:, None], starts.expand(len(start), -1, -1)], dim=1)
        target = best.target.repeat_interleave(restarts + 1, 0)
        solutions = self._attempt(self.settings.start_at(starts.flatten(0, 1)), target)
        if self.settings.has_posture:
            self._to_posture(solutions)
        return solutions

    def _to_posture(self, found: Found) -> None:
        self._descend(found, lambda q: self.settings.preferred(q) - q)

    def _attempt(self, q: Tensor, target: Tensor) -> Found:
        """Return the result of one start; results outside the domain are moved towards it."""
        solution = self._lower(q, target)
        rows = (self._cost(solution) == _OUTSIDE).nonzero()[:, 0]
        part = solution.take(rows)
        self._descend(part, self._inward)
        solution.put(rows, part)
        return solution

    def _try_again(self, found: Found, rows: Tensor, starts: Tensor) -> None:
        """Search rows (k,) from further starts (k, s, n) at once, and keep the best results."""
        n_starts = starts.shape[1]
        if rows.numel() == 0 or n_starts == 0:
            return
        q = starts.flatten(0, 1)
        target = found.target[rows].repeat_interleave(n_starts, 0)
        again = self._attempt(self.settings.start_at(q), target)
        n_iter = found.n_iter[rows] + again.n_iter.view(-1, n_starts).sum(1)
        n_tried = found.n_starts[rows] + n_starts
        cost = self._cost(again).nan_to_num(torch.inf).view(-1, n_starts)
        best = cost.argmin(1)
        again = again.take(
            best + n_starts * torch.arange(len(rows), device=best.device)
        )
        better = self._cost(again) < self._cost(found)[rows]
        found.put(rows[better], again.take(better))
        found.n_iter[rows] = n_iter
        found.n_starts[rows] = n_tried

    def _cost(self, found: Found) -> Tensor:
        """Return the error, or -1 for rows reached outside the domain, -2 for inside."""
        inside = self.settings.task.in_domain(found.q)
        return torch.where(
            found.reached, torch.where(inside, _DONE, _OUTSIDE), found.error
        )

    def _point(self, q: Tensor, target: Tensor) -> Point:
        x, J = self.settings.evaluate(q)
        return Point(q, x, J, self.settings.task.difference(x, target), target)

    def _start(self, q: Tensor, target: Tensor) -> Found:
        point = self._point(q, target)
        no = torch.zeros(len(q), dtype=torch.bool, device=q.device)
        outcome = (self._within(point.e), no, no, no.long(), (~no).long())
        return Found(*(part.clone() for part in (*vars(point).values(), *outcome)))

    def _lower(self, q: Tensor, target: Tensor) -> Found:
        """Lower the error until it is within tol or cannot be lowered."""
        state = self._start(q, target)
        rows = torch.arange(len(q), device=q.device)
        damping = torch.full_like(state.error, _FIRST_DAMPING)
        none = torch.zeros_like(damping)
        live = _Descent(
            **vars(state), start=state.error, nu=damping, growth=2.0 + none, slow=none
        )
        for iteration in range(self.max_iter + 1):
            live.reached = self._within(live.e)
            live.stationary = self._blocked(live)
            live.stationary |= (live.nu > IK_LAST_DAMPING) | (
                live.slow >= IK_SLOW_STEPS
            )
            live.n_iter = torch.full_like(live.n_iter, iteration)
            going = ~live.reached & ~live.stationary & (iteration < self.max_iter)
            if not going.all():
                state.put(rows[~going], live.take(~going))
                rows = rows[going]
                live = live.take(going)
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
        lower, upper = settings.step_bounds(live.q)
        # A turning joint may pass its limit and continue at the other one.
        half_turn = 0.5 * settings.periods.to(live.q)
        stays = torch.isinf(half_turn)
        bounds = lower.where(stays, -half_turn), upper.where(stays, half_turn)
        step = limited_step(settings, live.J, live.e, None, *bounds, trust, quick=True)
        new = self._point(settings.inside(live.q + step.dq), live.target)
        error_new = new.error
        predicted = (live.e - apply_rows(live.J, step.dq)).norm(dim=-1)
        # The damping follows the ratio of actual to predicted gain.
        gain = error.square() - error_new.square()
        quality = gain / (error.square() - predicted.square()).clamp_min(1e-30)
        factor = (1.0 - (2.0 * quality - 1.0) ** 3).clamp(1.0 / 3.0, 2.0)
        better = error_new < error
        live.nu = live.nu * torch.where(better, factor, live.growth)
        live.growth = torch.where(better, 2.0, 2.0 * live.growth)
        metres = self.tol[0] if isinstance(self.tol, tuple) else self.tol
        little = better & (error - error_new < IK_SLOW * metres)
        live.slow = torch.where(little, live.slow + 1.0, 0.0)
        live.held = step.saturated.any(-1)
        live.put(better, new.take(better))

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
                (slope,) = torch.autograd.grad(
                    distance.sum(), leaf, materialize_grads=True
                )
        beyond = (distance.detach() - IK_INSIDE).clamp_min(0.0)
        square = slope.square().sum(-1)
        return -(beyond / torch.where(square > 0.0, square, 1.0))[:, None] * slope

    def _descend(self, found: Found, wanted: Callable[[Tensor], Tensor]) -> None:
        """Move reached rows along their null space in the direction of the desired steps.

        The error may exceed tol temporarily, by a fraction of the motion, because the next step
        corrects it; only points within tol are recorded. The gain of a step is its displacement
        times the mean of the free (null-space) part of the desired step before and after it: the
        trapezoidal rule for the Lagrangian, which ignores the task part of the step. The fraction
        of the desired step to take follows from the curvature of the last step.
        """
        all_rows = rows = found.reached.nonzero()[:, 0]
        if rows.numel() == 0:
            return
        task = self.settings.task
        unit = self.settings.unit(found.q)
        inside = task.in_domain(found.q)
        live = self._slide(found.take(rows), wanted, torch.ones_like(found.e[rows, 0]))
        for iteration in range(IK_NULL_STEPS):
            last = iteration == IK_NULL_STEPS - 1
            step, point = self._try_step(
                live, None if last else live.share[:, None] * live.free
            )
            new = self._slide(point, wanted, live.share)
            way = (new.q - live.q) / unit
            gain = 0.5 * ((live.free + new.free) / unit * way).sum(-1)
            moved = live.J.flatten(1).norm(dim=-1) * step.dq.norm(dim=-1)
            loose = new.error <= IK_NULL_SLIP * moved
            reached = self._within(live.e)
            reached_new = self._within(new.e)
            ok = ((loose | reached_new) & (gain > 0.0)) | last
            ok |= ~reached & (new.error < 0.5 * live.error)
            ok &= task.in_domain(new.q) | ~inside[rows]
            record = ok & reached_new
            found.put(rows[record], point.take(record))
            found.n_iter[rows] += 1
            worth = IK_NULL_GAIN * (live.wish / unit).square().sum(-1)
            far = (gain > worth) | ~reached | ~reached_new
            going = torch.where(ok, far, live.share > 0.01)
            curvature = (way * (live.free - new.free) / unit).sum(
                -1
            ) / way.square().sum(-1)
            new.share = torch.where(curvature > 0.0, 1.0 / curvature, 2.0 * live.share)
            new.share = new.share.clamp(0.1, 4.0)
            live.share = 0.25 * live.share
            live.put(ok, new.take(ok))
            rows = rows[going]
            live = live.take(going)
            if rows.numel() == 0:
                break
        _, ended = self._try_step(found.take(all_rows), None, hold=True)
        better = (ended.error < found.error[all_rows]) & self._within(ended.e)
        found.put(all_rows[better], ended.take(better))

    def _slide(
        self, at: Point, wanted: Callable[[Tensor], Tensor], share: Tensor
    ) -> _Slide:
        wish = wanted(at.q)
        free = null_step(self.settings, at.J, wish)
        return _Slide(at.q, at.x, at.J, at.e, at.target, wish, free, share)

    def _try_step(
        self, at: Point, posture: Tensor | None, hold: bool = False
    ) -> tuple[StepRows, Point]:
        """Return a step and the point after it; `hold` fixes actuators at a limit."""
        lower, upper = self.settings.step_bounds(at.q)
        if hold:
            held = (lower >= 0.0) | (upper <= 0.0)
            lower, upper = (torch.where(held, 0.0, bound) for bound in (lower, upper))
        step = limited_step(
            self.settings, at.J, at.e, posture, lower, upper, quick=True
        )
        return step, self._point(at.q + step.dq, at.target)

    def _within(self, e: Tensor) -> Tensor:
        return self.settings.task.reached(e, self.tol)

    def _blocked(self, at: Point) -> Tensor:
        """Return whether no motion within the limits lowers the error to first order."""
        q = at.q
        lower, upper = self.settings.box(at.q)
        pull = apply_columns(at.J, at.e)
        out = ((q >= upper) & (pull > 0.0)) | ((q <= lower) & (pull < 0.0))
        out &= torch.isinf(self.settings.periods.to(q.device))
        left = torch.where(out, 0.0, pull).norm(dim=-1)
        return left <= IK_STATIONARY * at.J.flatten(1).norm(dim=-1) * at.error

    def _nudged(self, found: Found) -> Tensor:
        """Return starts beside singular points, where first-order motion does not help.

        Examples are a straight backbone that has to shorten, or a stretched arm: the error is
        stationary but not minimal. A second-order motion is needed, which is large even for small
        errors: 5 % of the limits, or the motion that moves a regular tip by a tenth of the error.
        """
        n = found.q.shape[-1]
        settings = self.settings
        size = 0.1 * _per_tip(found.J, found.error)[:, None].expand_as(found.q)
        span = 0.05 * (settings.q_max - settings.q_min).to(found.q)
        size = torch.where(torch.isfinite(span), torch.maximum(size, span), size)
        # Unequal factors, because equal ones can cancel in a symmetric robot.
        return found.q + size * torch.cos(found.q.new_ones(n).cumsum(0))


def _per_tip(J: Tensor, error: Tensor) -> Tensor:
    """Return the motion (N,) of an actuator that moves the tip by about the error."""
    size = J.flatten(1).norm(dim=-1)
    return torch.where(size > 0.0, error / size, error)
