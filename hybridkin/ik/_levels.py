"""Steps of tasks in order: a level moves only what the levels before it leave free.

A step of the levels 0, ..., k - 1 is changed by y, for which J_i y = 0 for all their Jacobians,
within all limits of the step. Level k chooses y as a single task chooses its step, eq. (19), damped
by the singular values of what its Jacobian has left; the posture chooses last.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import IK_HEALTHY
from hybridkin.ik._calm import calmed
from hybridkin.ik._gram import apply_columns, apply_rows
from hybridkin.ik._nearest import Polyhedron, nearest
from hybridkin.ik._settings import StepSettings
from hybridkin.ik._strict import StepLimits
from hybridkin.ik.tasks import Level, Task

_ROUNDING = 100.0  # of a singular value, relative to those of the Jacobian [eps]


def uppermost(task: Task, rows: Tensor) -> Tensor:
    """Return rows of the task (N, m) or (N, m, n), zero in all levels but the first."""
    return rows if task.n_levels == 1 else up_to_level(task, rows, 0)


def up_to_level(task: Task, rows: Tensor, last: int) -> Tensor:
    """Return rows of the task (N, m) or (N, m, n), zero in the levels after `last`."""
    kept = torch.zeros_like(rows)
    for level in task.by_level[: last + 1]:
        kept[:, level.rows] = rows[:, level.rows]
    return kept


def with_lower_levels(
    settings: StepSettings,
    J: Tensor,
    v: Tensor,
    posture: Tensor,
    limits: StepLimits,
    dq: Tensor,
    least: Tensor,
) -> Tensor:
    """Return the steps of the first level with those of the others, and with the posture.

    Parameters
    ----------
    settings : StepSettings
        Task, weights, damping and plane.
    J : Tensor of shape (N, m, n)
        Jacobians of all levels.
    v : Tensor of shape (N, m)
        Desired task steps J dq.
    posture : Tensor of shape (N, n)
        Posture steps.
    limits : StepLimits
        The limits of the steps.
    dq : Tensor of shape (N, n)
        The steps of the first level, within the limits.
    least : Tensor of shape (L, N)
        Least lambda^2 of every level, in the unit in which weights are 1.

    Returns
    -------
    Tensor of shape (N, n)
        Steps within the limits, with the motion of every level that it has without those after it.
    """
    # LAPACK refuses NaN; rows with one get none of these steps.
    fine = torch.isfinite(dq + v.sum(-1, keepdim=True) + J.sum(1) + posture).all(-1, keepdim=True)
    J = torch.where(fine[..., None], J, 0.0)
    v = torch.where(fine, v, 0.0)
    dq = torch.where(fine, dq, 0.0)
    posture = torch.where(fine, posture, 0.0)
    steps = _in_order(settings, J, v, posture, limits, dq, least)
    return torch.where(fine, steps, math.nan)


def _in_order(
    settings: StepSettings,
    J: Tensor,
    v: Tensor,
    posture: Tensor,
    limits: StepLimits,
    dq: Tensor,
    least: Tensor,
) -> Tensor:
    """Return `with_lower_levels` of finite rows."""
    unit = settings.unit(v)
    if settings.limits == "off":
        infinite = torch.full_like(dq, math.inf)
        limits = StepLimits.of_bounds(-infinite, infinite, dq)
    inside = limits.in_unit(unit)
    J = J * unit
    normals = J[:, :0]
    if settings.plane.n_normals:
        normals = (settings.plane.normals.to(J).mT * unit).expand(len(J), -1, -1)
    first, *lower = settings.task.by_level
    so_far = _StepSoFar(dq / unit, inside, _orthonormal(normals))
    so_far = so_far.without(J[:, first.rows])
    for k, level in enumerate(lower, start=1):
        so_far = so_far.after(settings, level, J, v, least[k])

    # The posture may leave the plane, as far as the limits allow.
    z = posture / unit
    if not z.any():
        return limits.clip(so_far.dq * unit)
    every = so_far._replace(taken=normals[:, :0])
    for level in settings.task.by_level:
        every = every.without(J[:, level.rows])
    z = calmed(every.free(z), so_far.dq, (least > 0.0).any(0))
    if settings.plane.n_normals:
        every = every.towards(normals, apply_rows(normals, z), torch.zeros_like(z[:, 0]))
        every = every.without(normals)
    return limits.clip(every.nearest_to(z) * unit)


class _StepSoFar(NamedTuple):
    """Steps, and what may be added to them: what moves nothing that comes before.

    Attributes
    ----------
    dq : Tensor of shape (N, n)
        The steps, in the unit in which weights are 1.
    limits : StepLimits
        Their limits.
    taken : Tensor of shape (N, r, n)
        Orthonormal rows, or zero, across which nothing may be added.
    """

    dq: Tensor
    limits: StepLimits
    taken: Tensor

    def free(self, rows: Tensor) -> Tensor:
        """Return the part of rows (N, n) or (N, k, n) that may be added."""
        stacked = rows.reshape(len(rows), -1, rows.shape[-1])
        for _ in range(2):  # twice, for rounding
            stacked = stacked - (stacked @ self.taken.mT) @ self.taken
        return stacked.reshape(rows.shape)

    def without(self, J: Tensor) -> _StepSoFar:
        """Return the same steps, with what may be added without motions J (N, m, n)."""
        taken = torch.cat([self.taken, _orthonormal(self.free(J), J)], dim=1)
        # Rows that are zero go last, and those that are zero everywhere go.
        is_row = (taken != 0.0).any(-1)
        order = is_row.to(torch.uint8).argsort(dim=1, descending=True, stable=True)
        taken = taken.gather(1, order[..., None].expand_as(taken))
        most = int(is_row.sum(1).amax()) if len(is_row) else 0
        return self._replace(taken=taken[:, :most])

    def after(
        self, settings: StepSettings, level: Level, J: Tensor, v: Tensor, least: Tensor
    ) -> _StepSoFar:
        """Return the steps with a level, as far as it can go towards its v."""
        J = J[:, level.rows]
        missing = v[:, level.rows] - apply_rows(J, self.dq)
        largest = torch.linalg.matrix_norm(J, ord=2)
        damping = None if isinstance(settings.damping, str) else settings.damping * largest
        moved = self.towards(J, missing, least, damping)
        return moved.without(J)

    def towards(
        self, J: Tensor, missing: Tensor, least: Tensor, damping: Tensor | None = None
    ) -> _StepSoFar:
        """Return the steps with the least |dq|^2 + |J y - missing|^2 / lambda^2.

        Every direction of J that is left has its own lambda: `damping` (N,), by default that of
        eq. (18), and at least the root of `least` (N,).
        """
        U, S, V = torch.linalg.svd(self.free(J), full_matrices=False)
        largest = torch.linalg.matrix_norm(J, ord=2)[:, None]
        lost = S <= _rounding(J) * largest
        S = torch.where(lost, 0.0, S)
        rows = S[..., None] * V
        along = torch.where(lost, 0.0, apply_columns(U, missing))
        threshold = IK_HEALTHY * largest
        ratio = S / torch.where(threshold > 0.0, threshold, 1.0)
        wanted = threshold * (1.0 - ratio.square()).clamp_min(0.0)
        if damping is not None:
            wanted = damping[:, None].expand_as(S)
        wanted = torch.maximum(wanted, least.sqrt()[:, None])

        # As in `damped_step`: a floor of lambda, whose effect proximal rounds take out.
        floor = max(1e-3, torch.finfo(J.dtype).eps ** 0.25) * S[:, :1]
        floor = torch.where(floor > 0.0, floor, 1.0)
        used = torch.maximum(wanted, floor)
        excess = torch.where(lost, 0.0, used.square() - wanted.square())
        return self._replace(dq=self._nearest(torch.zeros_like(self.dq), rows, along, used, excess))

    def nearest_to(self, z: Tensor) -> Tensor:
        """Return the steps that are nearest to z (N, n)."""
        none = z[:, :0]
        return self._nearest(z, self.taken[:, :0], none, none, none)

    def _nearest(
        self, start: Tensor, rows: Tensor, along: Tensor, damping: Tensor, excess: Tensor
    ) -> Tensor:
        """Return steps nearest to a start, with rows (step - dq) + damping s = along."""
        n_rows = rows.shape[1]
        slack = torch.diag_embed(damping)
        limits = self.limits
        hard = torch.cat([self.taken, start.new_zeros(*self.taken.shape[:2], n_rows)], dim=-1)
        length = limits.A.norm(dim=-1)
        length = torch.where(length > 0.0, length, 1.0)
        one_sided = limits.A / length[..., None]
        b = torch.maximum(limits.b, apply_rows(limits.A, self.dq)) / length
        infinite = torch.full_like(along, math.inf)
        within = Polyhedron(
            torch.cat([torch.cat([rows, slack], dim=-1), hard], dim=1),
            torch.cat([along + apply_rows(rows, self.dq), apply_rows(self.taken, self.dq)], dim=1),
            torch.cat([limits.lower, -infinite], dim=-1),
            torch.cat([limits.upper, infinite], dim=-1),
            torch.cat([one_sided, one_sided.new_zeros(*b.shape, n_rows)], dim=-1),
            b,
            b,
        )
        excess = torch.cat([excess, torch.zeros_like(hard[..., 0])], dim=1)
        x, _ = nearest(torch.cat([start, torch.zeros_like(along)], dim=-1), within, excess)
        return limits.clip(limits.snapped(x[:, : start.shape[-1]]))


def _orthonormal(rows: Tensor, of: Tensor | None = None) -> Tensor:
    """Return orthonormal rows (N, k, n) that span rows (N, m, n), zero for those that are rounding.

    Rounding is that of the rows `of`, by default the same.
    """
    if rows.shape[1] == 0:
        return rows
    _, S, V = torch.linalg.svd(rows, full_matrices=False)
    largest = torch.linalg.matrix_norm(rows if of is None else of, ord=2)[:, None]
    return torch.where((S > _rounding(rows) * largest)[..., None], V, 0.0)


def _rounding(rows: Tensor) -> float:
    """Return what rounding leaves of a singular value, relative to the largest."""
    return _ROUNDING * torch.finfo(rows.dtype).eps
