"""The search for configurations that reach targets of several levels of priority."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import IK_SLOW, IK_SLOW_STEPS
from hybridkin.ik._levels import up_to_level
from hybridkin.ik._search import Found, Point, Search
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._step import StepRows
from hybridkin.ik._strict import StepLimits
from hybridkin.ik.tasks import Task, Tolerance

_RATIO = 0.1  # of the weights of a level and of the one before it, in the search from the starts
_FIRST_DAMPING = 1e-3  # lambda^2 / |J|^2 of the levels after the first
_LAST_DAMPING = 1e4  # no gain even with this damping: the point is stationary
_SMALL = 0.01  # of tol: smaller errors of a level count as zero where a later one gains by them
_RETURNS = 2  # steps that take out what a step of all levels adds to errors before the last level


def search_of(settings: StepSettings, tol: Tolerance, max_iter: int) -> Search:
    """Return the search for targets of a task."""
    if settings.task.n_levels > 1:
        return LevelSearch(settings, tol, max_iter)
    return Search(settings, tol, max_iter)


@dataclass(frozen=True)
class _InOneLevel(Search):
    """The search with weights in place of levels, which fall by a ratio; `task` has the levels."""

    task: Task
    ratio: float

    def _within(self, e: Tensor) -> Tensor:
        scale = torch.ones_like(e[0])
        for k, level in enumerate(self.task.by_level):
            scale[[*level.rows]] = self.ratio**k
        return self.task.reached(e / scale, self.tol)


@dataclass(frozen=True)
class LevelSearch(Search):
    """A search in one level; where that reaches no end, one by weights and then by levels."""

    def solve(self, q: Tensor, target: Tensor, cold: bool, restarts: int) -> Found:
        """Return the best points from starts q (N, n), and from further starts if these fail."""
        ends = self._in_one_level(1.0).solve(q, target, cold, restarts)
        missed = ~ends.reached & torch.isfinite(ends.error)
        self._by_levels(ends, missed.nonzero()[:, 0], ends.q, 0)
        lost = missed & ~ends.reached & (self._errors(ends)[0] > self._tolerances[0])
        if restarts > 0:
            self._by_levels(ends, lost.nonzero()[:, 0], q, restarts)
        return ends

    def several(self, best: Found, start: Tensor, restarts: int, count: int) -> Found:
        """Return `count` different points for each row of `best`, see `Search.several`."""
        return self._in_one_level(1.0).several(best, start, restarts, count)

    def _in_one_level(self, ratio: float) -> Search:
        task = self.settings.task
        settings = replace(self.settings, task=task.in_one_level(ratio))
        return _InOneLevel(settings, self.tol, self.max_iter, task, ratio)

    def _by_levels(self, ends: Found, rows: Tensor, q: Tensor, restarts: int) -> None:
        """Put ends of a search from q (N, n) in some rows: by weights, then by levels."""
        if rows.numel() == 0:
            return
        target = ends.target[rows]
        weighted = self._in_one_level(_RATIO).solve(q[rows], target, False, restarts)
        again = self._start(weighted.q, target)
        again.n_iter = ends.n_iter[rows] + weighted.n_iter
        again.n_starts = ends.n_starts[rows] + weighted.n_starts
        ends.put(rows, again)
        self._refine(ends, rows[~again.reached])

    def _refine(self, ends: Found, rows: Tensor) -> None:
        """Bring rows to where no level can be nearer without one before it being farther."""
        live = ends.take(rows)
        damping = torch.full_like(live.error, _FIRST_DAMPING)
        slow = torch.zeros_like(damping)
        for _ in range(self.max_iter):
            if rows.numel() == 0:
                break
            new, step = self._after_levels(live, damping)
            better, little = self._compared(live, new)
            better &= self._stays_free(live.q, new.q)
            live.put(better, new.take(better))
            live.reached = self._reached(live)
            live.held = step.saturated.any(-1)
            live.n_iter = live.n_iter + 1
            damping = damping * torch.where(better, 0.25, 4.0)
            slow = torch.where(better & little, slow + 1.0, 0.0)
            live.stationary = (damping > _LAST_DAMPING) | (slow >= IK_SLOW_STEPS)
            ends.put(rows, live)
            going = ~live.reached & ~live.stationary
            rows = rows[going]
            live = live.take(going)
            damping = damping[going]
            slow = slow[going]

    def _after_levels(self, at: Point, damping: Tensor) -> tuple[Point, StepRows]:
        """Return points after a step of all levels, and the step."""
        task = self.settings.task
        size = damping * at.J.flatten(1).square().sum(-1)
        damping_sq = size.expand(task.n_levels, -1).clone()
        # The first level is damped only where it is out of reach.
        damping_sq[0] = torch.where(self._errors(at)[0] > self._tolerances[0], size, 0.0)
        new, step = self._moved(at, at, damping_sq)
        before_last = task.n_levels - 2
        for _ in range(_RETURNS):
            J = up_to_level(task, new.J, before_last)
            e = up_to_level(task, new.e, before_last)
            new, _ = self._moved(new, replace(new, J=J, e=e), damping_sq)
        return new, step

    def _moved(self, at: Point, wish: Point, damping_sq: Tensor) -> tuple[Point, StepRows]:
        """Return the points after steps from `at`, and the steps, which are for a wish there."""
        limits = StepLimits.of_bounds(*self.settings.step_bounds(at.q), at.q)
        step = self._step(wish, torch.zeros_like(at.q), limits, damping_sq)
        q = self._free(self.settings.inside(at.q + step.dq))
        return self._point(q, at.target), step

    def _errors(self, at: Point) -> list[Tensor]:
        """Return the errors (N,) of all levels."""
        return [at.e[:, level.rows].norm(dim=-1) for level in self.settings.task.by_level]

    @cached_property
    def _tolerances(self) -> list[float]:
        """The smallest tolerance of every level."""
        task = self.settings.task
        if not isinstance(self.tol, tuple):
            return [self.tol] * task.n_levels
        of_parts = np.multiply(self.tol, task.units)
        of_rows = np.repeat(of_parts, task.parts)
        return [float(of_rows[[*level.rows]].min()) for level in task.by_level]

    def _compared(self, old: Point, new: Point) -> tuple[Tensor, Tensor]:
        """Return whether points are nearer in the first level that differs, and only a little."""
        equal = torch.ones_like(old.error, dtype=torch.bool)
        better = torch.zeros_like(equal)
        little = torch.ones_like(equal)
        errors = zip(self._errors(old), self._errors(new), self._tolerances, strict=True)
        for k, (before, after, tol) in enumerate(errors):
            last = k == self.settings.task.n_levels - 1
            small = 0.0 if last else _SMALL * tol
            gain = before.clamp_min(small) - after.clamp_min(small)
            better |= equal & (gain > small)
            little &= ~(equal & (gain > IK_SLOW * tol))
            equal &= gain.abs() <= small
        return better, little
