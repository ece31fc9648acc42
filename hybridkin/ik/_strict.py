"""Steps within limits, in which the task comes before the posture."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import IK_CLOSE
from hybridkin.ik._box import BoxProblem, proximal_box_step
from hybridkin.ik._gram import apply_rows
from hybridkin.ik._nearest import Polyhedron, nearest
from hybridkin.ik._stages import in_two_stages


class StepLimits(NamedTuple):
    """Steps dq with lower <= dq <= upper and A dq <= b.

    Attributes
    ----------
    lower, upper : Tensor of shape (N, n)
        Bounds, lower <= upper.
    A, b : Tensor of shape (N, k, n) and (N, k)
        One-sided limits, the most important ones first.
    """

    lower: Tensor
    upper: Tensor
    A: Tensor
    b: Tensor

    @classmethod
    def of_bounds(cls, lower: Tensor, upper: Tensor, like: Tensor) -> StepLimits:
        """Return bounds of steps `like` (N, n), without one-sided limits."""
        none = like.new_empty(*like.shape[:-1], 0)
        lower = lower.expand_as(like)
        upper = upper.expand_as(like)
        return cls(lower, upper, none[..., None].expand(*none.shape, like.shape[-1]), none)

    def with_rows(self, A: Tensor, b: Tensor) -> StepLimits:
        """Return the limits with further rows A (N, k, n) and b (N, k), less important ones."""
        return self._replace(A=torch.cat([self.A, A], dim=1), b=torch.cat([self.b, b], dim=1))

    def clip(self, dq: Tensor) -> Tensor:
        """Return steps moved into the bounds."""
        return torch.clamp(dq, self.lower, self.upper)

    def held(self, dq: Tensor) -> Tensor:
        """Return which actuators are at a bound, bool (N, n)."""
        return (dq <= self.lower) | (dq >= self.upper)

    def broken(self, dq: Tensor) -> Tensor:
        """Return whether steps are beyond a bound, or by more than rounding a row, bool (N,)."""
        return (self.clip(dq) != dq).any(-1) | self.leaves_rows(dq)

    def leaves_rows(self, dq: Tensor) -> Tensor:
        """Return whether steps are beyond a row by more than rounding, bool (N,)."""
        size = apply_rows(self.A.abs(), dq.abs()) + self.b.abs()
        rounding = 8.0 * torch.finfo(dq.dtype).eps * size
        return (apply_rows(self.A, dq) > self.b + rounding).any(-1)

    def snapped(self, dq: Tensor) -> Tensor:
        """Return steps exactly at the bounds that they reach up to rounding.

        Where a step has no choice it ends beside a bound by the rounding of all that led there.
        """
        close = IK_CLOSE * torch.finfo(dq.dtype).eps
        largest = dq.abs().amax(-1, keepdim=True)
        at_lower = (dq - self.lower) <= close * (largest + self.lower.abs())
        at_upper = (self.upper - dq) <= close * (largest + self.upper.abs())
        dq = torch.where(at_lower & torch.isfinite(self.lower), self.lower, dq)
        return torch.where(at_upper & torch.isfinite(self.upper), self.upper, dq)

    def at_rest(self) -> Tensor:
        """Return b, or where the bounds do not allow it at rest what rest has, shape (N, k)."""
        rest = self.clip(torch.zeros_like(self.lower))
        return torch.maximum(self.b, apply_rows(self.A, rest))

    def in_unit(self, unit: Tensor) -> StepLimits:
        """Return the limits of dq / unit."""
        return StepLimits(self.lower / unit, self.upper / unit, self.A * unit, self.b)

    def take(self, rows: Tensor | slice) -> StepLimits:
        """Return the limits of some rows."""
        return StepLimits(*(a[rows] for a in self))


def step_within(
    J: Tensor, v: Tensor, z: Tensor, damping_sq: Tensor, limits: StepLimits, calm: Tensor
) -> Tensor:
    """Return the steps (N, n) of `in_two_stages` within limits.

    The box alone has a faster solver.

    Parameters
    ----------
    J : Tensor of shape (N, m, n)
        Jacobians.
    v : Tensor of shape (N, m)
        Desired task steps J dq.
    z : Tensor of shape (N, n)
        Preferred steps.
    damping_sq : Tensor of shape (N,)
        lambda^2, in the unit of J J^T.
    limits : StepLimits
        The limits of the steps.
    calm : bool Tensor of shape (N,)
        Where z is at most half as long as the step of the task.
    """
    problem = BoxProblem(J, v, z, damping_sq, limits.lower, limits.upper)
    dq = in_two_stages(problem, calm, lambda part, rows, centre: proximal_box_step(part, centre))
    over = limits.broken(dq).nonzero()[:, 0]
    if over.numel() == 0:
        return dq
    of_over = limits.take(over)

    def within_all(part: BoxProblem, rows: Tensor | slice, centre: Tensor) -> tuple[Tensor, Tensor]:
        damping = part.damping_sq.sqrt()
        least = _least_damping(part.J)
        return damped_step(part.J, part.v, part.z, damping, of_over.take(rows), least, centre)

    inside = in_two_stages(problem.take(over), calm[over], within_all)
    return dq.index_put((over,), inside)


def _least_damping(J: Tensor) -> Tensor:
    """Return the least lambda (N,) of `damped_step` for Jacobians (N, m, n)."""
    size = torch.linalg.matrix_norm(J @ J.mT).sqrt()  # about sigma_max
    relative = max(1e-3, torch.finfo(J.dtype).eps ** 0.25)
    # If J is zero it only has to be positive.
    return torch.where(size > 0.0, relative * size, 1.0)


def damped_step(
    J: Tensor,
    v: Tensor,
    z: Tensor,
    damping: Tensor,
    limits: StepLimits,
    least: Tensor,
    centre: Tensor,
) -> tuple[Tensor, Tensor]:
    """Return the steps with the least |dq - z|^2 + |J dq - v|^2 / lambda^2 within the limits.

    lambda is at `least` (N,), and proximal rounds from the multipliers `centre` (N, m) take the
    effect out. With s = (v - J dq) / lambda
    it is the point (dq, s) nearest to (z, 0) with J dq + lambda s = v.
    """
    N, m, n = J.shape
    used = torch.maximum(damping, least)
    excess = used.square() - damping.square()
    slack = torch.eye(m, dtype=J.dtype, device=J.device) * used[:, None, None]
    none = torch.full_like(v, math.inf)
    length = limits.A.norm(dim=-1)
    length = torch.where(length > 0.0, length, 1.0)
    rows = torch.cat([limits.A / length[..., None], J.new_zeros(N, length.shape[1], m)], dim=-1)
    within = Polyhedron(
        torch.cat([J, slack], dim=-1),
        v,
        torch.cat([limits.lower, -none], dim=-1),
        torch.cat([limits.upper, none], dim=-1),
        rows,
        limits.b / length,
        limits.at_rest() / length,
    )
    start = torch.cat([z, torch.zeros_like(v)], dim=-1)
    x, multipliers = nearest(start, within, excess[:, None], centre)
    return limits.snapped(x[:, :n]), multipliers
