"""Batched search for configurations that reach targets, and the descent in their null space."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from hybridkin.ik._gram import apply_columns, apply_rows, row_gram
from hybridkin.ik._step import HEALTHY, Law, Move

_FIRST_DAMPING = 1.0  # lambda^2 / sigma_max^2 of the first iteration
_LAST_DAMPING = 1e8  # no descent even with this one: the point is as good as it gets
_STATIONARY = 1e-4  # sine of the angle between the error and what the limits leave free
_SLOW_STEPS = 8  # iterations in a row that gain less than 1 % of tol
_NULL_STEPS = 30  # iterations of a null-space descent
_NULL_SLIP = 0.3  # error per tip-sized motion that a null-space step may leave to the next
_NULL_GAIN = 1e-8  # of the square of what is left to go; the descent ends where it gains less
_INSIDE = 0.98  # domain distance to go to from outside the domain
Tolerance = float | tuple[float, ...]


@dataclass
class Found:
    """The best points so far of every row, owned by the search and updated in place."""

    q: Tensor
    x: Tensor
    J: Tensor
    error: Tensor
    reached: Tensor
    stationary: Tensor
    held: Tensor
    n_iter: Tensor

    def put(self, rows: Tensor, *parts: Tensor) -> None:
        """Overwrite rows of the leading fields."""
        for field, part in zip(fields(self), parts, strict=False):
            getattr(self, field.name)[rows] = part

    def parts(self) -> tuple[Tensor, ...]:
        """Return all but the count of iterations."""
        return tuple(getattr(self, field.name) for field in fields(self)[:-1])


@dataclass(frozen=True)
class Search:
    """Levenberg-Marquardt with box-limited steps; a step is taken where it lowers the error."""

    law: Law
    tol: Tolerance
    max_iter: int

    def solve(self, q: Tensor, target: Tensor, cold: bool, starts: list[Tensor]) -> Found:
        """Return the best points from starts q (N, n), and from further ones where they fail."""
        q = self.law.inside(q)
        if cold and len(q) > 0 and singular(self.law.evaluate(q[:1])[1]).all():
            # A straight backbone: motions that cancel to first order would be missed.
            point = self._at(q, target)
            nudged = self.law.inside(self._nudged(point))
            q = torch.where(point.reached[:, None], q, nudged)
        found = self._attempt(q, target)
        lost = ~found.reached
        lost[lost.clone()] = singular(found.J[lost])
        self._try_again(found, lost, self._nudged(found), target)
        for start in starts:
            self._try_again(found, self._rank(found) > 0, start.expand_as(q), target)
        if self.law.q_pref is not None:
            self._descend(found, target, lambda p: self.law.preferred(p) - p)
        return found

    def _attempt(self, q: Tensor, target: Tensor) -> Found:
        """Return what one start leads to."""
        found = self._lower(q, target)
        first = self.law.task.first
        if first is not None:
            self._give_way(found, target, first)
        self._enter_domain(found, target)
        return found

    def _try_again(self, found: Found, rows: Tensor, q: Tensor, target: Tensor) -> None:
        """Search some rows from another start, and keep what is better."""
        rows = rows.nonzero()[:, 0]
        if rows.numel() == 0:
            return
        again = self._attempt(self.law.inside(q[rows]), target[rows])
        found.n_iter[rows] += again.n_iter
        old, new = self._rank(found)[rows], self._rank(again)
        better = (new < old) | ((new == old) & (new == 2) & (again.error < found.error[rows]))
        found.put(rows[better], *(part[better] for part in again.parts()))

    def _rank(self, found: Found) -> Tensor:
        """Return 0 for rows that are done, 1 for those outside the domain, 2 for the others."""
        rank = torch.where(found.reached, 0, 2)
        if not len(rank):
            return rank
        return torch.where(found.reached & ~self.law.task.in_domain(found.q), 1, rank)

    def _at(self, q: Tensor, target: Tensor) -> Found:
        x, J = self.law.evaluate(q)
        e = self.law.task.difference(x, target)
        no = torch.zeros(len(q), dtype=torch.bool, device=q.device)
        reached = self.law.task.reached(e, self.tol)
        state = (q, x, J, e.norm(dim=-1), reached, no, no, no.long())
        return Found(*(part.clone() for part in state))

    def _lower(self, q: Tensor, target: Tensor, first: int | None = None) -> Found:
        """Lower the error from one start until it is within tol or cannot be lowered."""
        task, head = self.law.task, slice(None, first)
        found = self._at(q, target)
        rows = torch.arange(len(q), device=q.device)
        e = task.difference(found.x, target)[:, head]
        error = e.norm(dim=-1)
        nu = torch.full_like(error, _FIRST_DAMPING)  # lambda^2 / sigma_max^2 of the whole error
        live = [q, found.x, found.J, e, error, target, error, nu]
        live = [*live, torch.full_like(nu, 2.0), torch.zeros_like(nu)]
        held = torch.zeros_like(found.held)
        for iteration in range(self.max_iter + 1):
            q, x, J, e, error, aim, start, nu, growth, slow = live
            J = J[:, head]
            still = self._blocked(q, J, e) | (nu > _LAST_DAMPING) | (slow >= _SLOW_STEPS)
            reached = self._within(e, first)
            going = (~reached & ~still) & (iteration < self.max_iter)
            if not going.all():
                done = (~going).nonzero()[:, 0]
                parts = (q, x, live[2], error, reached, still, held)
                found.put(rows[done], *(part[done] for part in parts))
                found.n_iter[rows[done]] = iteration
                going = going.nonzero()[:, 0]
                if going.numel() == 0:
                    break
                rows, live = rows[going], [a[going] for a in live]
                q, x, J, e, error, aim, start, nu, growth, slow = live
                J = J[:, head]
            bounds = self.law.step_bounds(q, None)
            # Error-proportional, so that the last iterations are Gauss-Newton's.
            move = self.law.resolve(J, e, None, *bounds, nu * (error / start), quick=True)
            new = q + move.dq
            x_new, J_new = self.law.evaluate(new)
            e_new = task.difference(x_new, aim)[:, head]
            error_new = e_new.norm(dim=-1)
            predicted = (e - apply_rows(J, move.dq)).norm(dim=-1)
            gained = error.square() - error_new.square()
            quality = gained / (error.square() - predicted.square()).clamp_min(1e-30)
            better = error_new < error
            held = move.saturated.any(-1)
            nu = torch.where(
                better, nu * (1.0 - (2.0 * quality - 1.0) ** 3).clamp(1.0 / 3.0, 2.0), nu * growth
            )
            growth = torch.where(better, 2.0, 2.0 * growth)
            slow = torch.where(better & (error - error_new < 0.01 * self._metres), slow + 1.0, 0.0)
            taken = (new, x_new, J_new, e_new, error_new)
            kept = [_pick(better, a, b) for a, b in zip(taken, live[:5], strict=True)]
            live = [*kept, aim, start, nu, growth, slow]
        return found

    def _give_way(self, found: Found, target: Tensor, first: int) -> None:
        """Where two tasks cannot both be done: the first one, and of the second what it leaves."""
        task, law = self.law.task, self.law
        rows = (~found.reached).nonzero()[:, 0]
        if rows.numel() == 0:
            return
        top = self._lower(found.q[rows], target[rows], first)
        q, x, J, aim = top.q, top.x, top.J, target[rows]
        e, nu = task.difference(x, aim), torch.full_like(top.error, _FIRST_DAMPING)
        still = torch.zeros_like(top.stationary)
        for _ in range(self.max_iter):
            move = law.resolve(J, e, None, *law.step_bounds(q, None), nu, first=first)
            new = q + move.dq
            x_new, J_new = law.evaluate(new)
            e_new = task.difference(x_new, aim)
            before, after = e[:, :first].norm(dim=-1), e_new[:, :first].norm(dim=-1)
            strict = self._within(e_new[:, :first], first) | (after <= before * (1.0 + 1e-9))
            gain = e[:, first:].norm(dim=-1) - e_new[:, first:].norm(dim=-1)
            better = strict & (gain > 0.0) & ~still
            nu = torch.where(better, 0.2 * nu, 4.0 * nu)
            still |= (better & (gain < 0.01 * self._metres)) | (nu > _LAST_DAMPING)
            taken, state = (new, x_new, J_new, e_new), (q, x, J, e)
            q, x, J, e = (_pick(better, a, b) for a, b in zip(taken, state, strict=True))
            top.n_iter += (~still).long()
            if still.all():
                break
        reached = task.reached(e, self.tol)
        found.n_iter[rows] += top.n_iter
        found.put(rows, q, x, J, e.norm(dim=-1), reached, ~top.reached & top.stationary | still)

    def _enter_domain(self, found: Found, target: Tensor) -> None:
        """Slide rows that are reached outside the models' domain towards it."""
        rows = (self._rank(found) == 1).nonzero()[:, 0]
        if rows.numel() == 0:
            return

        def inward(q: Tensor) -> Tensor:
            with torch.enable_grad():
                leaf = q.detach().requires_grad_(True)
                distance = self.law.task.domain_distance(leaf)
                # Of a function that only says whether, there is no way in.
                if not distance.requires_grad:
                    return torch.zeros_like(q)
                (slope,) = torch.autograd.grad(distance.sum(), leaf)
            beyond = (distance.detach() - _INSIDE).clamp_min(0.0)
            square = slope.square().sum(-1)
            return -(beyond / torch.where(square > 0.0, square, 1.0))[:, None] * slope

        part = Found(*(part[rows] for part in (*found.parts(), found.n_iter)))
        self._descend(part, target[rows], inward)
        found.n_iter[rows] = part.n_iter
        found.put(rows, *part.parts())

    def _descend(self, found: Found, target: Tensor, wanted: Callable[[Tensor], Tensor]) -> None:
        """Slide reached rows along their null space as far as the wanted steps lead, then polish.

        On the way the error may exceed tol by a share of the motion, for the next step takes it
        back; only what is within tol is recorded. What a step gains is the way times the part of
        the wanted step that is free, before and after, on average: the trapezoidal rule for the
        Lagrangian, in which what a step does for the task does not count. How much of the wanted
        step is taken follows the curvature seen on the last one.
        """
        law, task = self.law, self.law.task
        all_rows = rows = found.reached.nonzero()[:, 0]
        if rows.numel() == 0:
            return
        inside = task.in_domain(found.q)
        unit = law.unit(found.q)
        q, x, J, aim = (a[rows] for a in (found.q, found.x, found.J, target))
        e, wish = task.difference(x, aim), wanted(q)
        live = [q, x, J, e, wish, law.null_step(J, wish), aim, torch.ones_like(e[:, 0])]
        for iteration in range(_NULL_STEPS):
            q, x, J, e, wish, free, aim, share = live
            last = iteration == _NULL_STEPS - 1
            posture = None if last else share[:, None] * free
            move, new, x_new, J_new, e_new = self._try_step(q, J, e, aim, posture)
            wish_new = wanted(new)
            free_new = law.null_step(J_new, wish_new)
            way = (new - q) / unit
            gain = 0.5 * ((free + free_new) / unit * way).sum(-1)
            error, error_new = e.norm(dim=-1), e_new.norm(dim=-1)
            loose = error_new <= _NULL_SLIP * J.flatten(1).norm(dim=-1) * move.dq.norm(dim=-1)
            reached, reached_new = self._within(e), self._within(e_new)
            ok = ((loose | reached_new) & (gain > 0.0)) | last
            ok |= ~reached & (error_new < 0.5 * error)
            ok &= task.in_domain(new) | ~inside[rows]
            record = ok & reached_new
            found.put(rows[record], *(a[record] for a in (new, x_new, J_new, error_new)))
            found.n_iter[rows] += 1
            worth = _NULL_GAIN * (wish / unit).square().sum(-1)
            going = torch.where(ok, (gain > worth) | ~reached | ~reached_new, share > 0.01)
            curvature = (way * (free - free_new) / unit).sum(-1) / way.square().sum(-1)
            fitting = torch.where(curvature > 0.0, 1.0 / curvature, 2.0 * share).clamp(0.1, 4.0)
            share = torch.where(ok, fitting, 0.25 * share)
            taken = (new, x_new, J_new, e_new, wish_new, free_new)
            kept = [_pick(ok, a, b) for a, b in zip(taken, live, strict=False)]
            live = [a[going] for a in (*kept, aim, share)]
            rows = rows[going]
            if rows.numel() == 0:
                break
        q, x, J, aim = (a[all_rows] for a in (found.q, found.x, found.J, target))
        _, *ended, e = self._try_step(q, J, task.difference(x, aim), aim, None, hold=True)
        better = e.norm(dim=-1) < found.error[all_rows]
        found.put(all_rows[better], *(a[better] for a in (*ended, e.norm(dim=-1))))

    def _try_step(
        self,
        q: Tensor,
        J: Tensor,
        e: Tensor,
        target: Tensor,
        posture: Tensor | None,
        hold: bool = False,
    ) -> tuple[Move, Tensor, Tensor, Tensor, Tensor]:
        """Return a step, and q, x, J and the error after it; `hold` what lies at a limit."""
        lower, upper = self.law.step_bounds(q, None)
        if hold:
            held = (lower >= 0.0) | (upper <= 0.0)
            lower, upper = (torch.where(held, 0.0, bound) for bound in (lower, upper))
        move = self.law.resolve(J, e, posture, lower, upper, quick=True)
        new = q + move.dq
        x_new, J_new = self.law.evaluate(new)
        return move, new, x_new, J_new, self.law.task.difference(x_new, target)

    @property
    def _metres(self) -> float:
        return self.tol[0] if isinstance(self.tol, tuple) else self.tol

    def _within(self, e: Tensor, first: int | None = None) -> Tensor:
        """Return whether errors, or those of the `first` rows alone, are within tol."""
        if first is None:
            return self.law.task.reached(e, self.tol)
        rest = sum(self.law.task.parts) - first
        return self.law.task.reached(torch.nn.functional.pad(e, (0, rest)), self.tol)

    def _blocked(self, q: Tensor, J: Tensor, e: Tensor) -> Tensor:
        """Return where no motion within the limits lowers the error to first order."""
        lower, upper = self.law.box(q)
        pull = apply_columns(J, e)
        out = ((q >= upper) & (pull > 0.0)) | ((q <= lower) & (pull < 0.0))
        left = torch.where(out, 0.0, pull).norm(dim=-1)
        return left <= _STATIONARY * J.flatten(1).norm(dim=-1) * e.norm(dim=-1)

    def _nudged(self, found: Found) -> Tensor:
        """Return starts beside singular points, where the first-order motion is blind.

        A straight backbone asked to shorten, or a stretched arm: the error is stationary without
        being smallest. The way out is of second order, hence not short where the error is small:
        5 % of the limits, or what moves a healthy tip by a tenth of the error.
        """
        n = found.q.shape[-1]
        size = found.J.flatten(1).norm(dim=-1, keepdim=True)
        size = torch.where(size > 0.0, 0.1 * found.error[:, None] / size, 0.0).expand_as(found.q)
        span = 0.05 * (self.law.q_max - self.law.q_min).to(found.q)
        size = torch.where(torch.isfinite(span), torch.maximum(size, span), size)
        # Unequal shares, because equal ones may cancel in a symmetric robot.
        return found.q + size * torch.cos(torch.arange(1.0, n + 1.0).to(found.q))


def singular(J: Tensor) -> Tensor:
    """Return where Jacobians have (nearly) lost a direction."""
    gram = row_gram(J)
    return gram.sigma_min < HEALTHY * gram.sigma_max


def _pick(rows: Tensor, a: Tensor, b: Tensor) -> Tensor:
    """Return a in some rows, b in the others."""
    return torch.where(rows.view(-1, *[1] * (a.ndim - 1)), a, b)
