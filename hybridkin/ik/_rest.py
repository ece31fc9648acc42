"""Rest at the point nearest to a target out of reach: damping by the curvature of the model.

Where the error stays large, Gauss-Newton leaves out a curvature that can exceed J^T J, and steps
overshoot without end. Eq. (21) of the page "Theory" of the documentation damps them by what the
last steps showed of it.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_CURVED,
    IK_EASED,
    IK_EASED_WAY,
    IK_JUMP,
    IK_MOST_CURVED,
    IK_NO_FALL,
    IK_NO_WAY,
    IK_STRAIGHT,
)
from hybridkin.ik._settings import StepSettings
from hybridkin.ik.tasks import Level, Task


class Rest(NamedTuple):
    """What is remembered of the last step, and the curvature that it has shown.

    Attributes
    ----------
    curvature : Tensor of shape (N,)
        Damping lambda^2 per metre of the error, in the unit of q in which weights are 1.
    way_sq : Tensor of shape (N,)
        Squared length of the step, in this unit.
    share : Tensor of shape (N,)
        The largest share of an actuator's range in the step.
    promised : Tensor of shape (N, m)
        Motion of the tip to first order [m].
    error : Tensor of shape (N, m)
        The error that the step was made for [m].
    """

    curvature: Tensor
    way_sq: Tensor
    share: Tensor
    promised: Tensor
    error: Tensor

    @classmethod
    def at(cls, e: Tensor) -> Self:
        """Return what is known at the start of a motion, for errors (N, m): nothing."""
        none = torch.zeros_like(e[:, 0])
        return cls(none, none, none, torch.zeros_like(e), torch.zeros_like(e))

    def seen(self, settings: StepSettings, before: Tensor, e: Tensor, J: Tensor) -> Self:
        """Return this with the curvature that the last step has shown.

        It grows where more than half of the promised change of the squared error did not come true:
        to what is missing per squared step. It eases where less than a quarter is missing, after
        steps that are longer than rounding or show far less of it.

        Parameters
        ----------
        settings : StepSettings
            The weights.
        before, e : Tensor of shape (N, m)
            Errors to the present target before and after the step [m].
        J : Tensor of shape (N, m, n)
            The present Jacobian.
        """
        largest = (J * settings.unit(J)).square().sum((-2, -1))  # about sigma_max^2
        size = e.norm(dim=-1)
        start, end, left = map(_squared, (before, e, before - self.promised))
        fall = start - end
        promised = start - left
        bend = (end - left) / self.way_sq
        missing = promised - fall
        none = max(IK_NO_FALL, 32.0 * torch.finfo(e.dtype).eps)
        tells = promised.abs().maximum(fall.abs()) > none * start
        tells &= self.share > IK_NO_WAY
        tells &= _squared(before - self.error) <= IK_JUMP**2 * start
        weak = tells & (missing > 0.5 * promised.abs()) & (bend > IK_CURVED * largest)
        here = bend / size
        straight = here < IK_STRAIGHT * self.curvature
        long = (self.share > IK_EASED_WAY) | straight
        kept = tells & (missing < 0.25 * promised.abs()) & long

        grown = torch.maximum(self.curvature, here)
        # Where it exceeds J^T J along the step, a longer one would not have kept its promise.
        lost = missing > 0.5 * _squared(self.promised)
        eased = IK_EASED * self.curvature
        floor = torch.minimum(self.curvature, here)
        eased = torch.where(lost, torch.maximum(eased, floor), eased)
        curvature = torch.where(kept, eased, self.curvature)
        curvature = torch.where(weak, grown, curvature)
        curvature = torch.minimum(curvature, IK_MOST_CURVED * largest / size)
        small = curvature * size < IK_CURVED * largest
        curvature = torch.where(small, 0.0, curvature)
        known = torch.isfinite(curvature) & (size > 0.0)
        return self._replace(curvature=torch.where(known, curvature, self.curvature))

    def least(self, e: Tensor) -> Tensor:
        """Return the least lambda^2 (N,) of a step at errors (N, m)."""
        return (self.curvature * e.norm(dim=-1)).nan_to_num(0.0)

    def after(self, settings: StepSettings, dq: Tensor, promised: Tensor, e: Tensor) -> Self:
        """Return this after steps dq (N, n), made for errors e (N, m).

        They promised motions of the tip (N, m).
        """
        span = moved(settings.spans, dq)
        span = torch.where(torch.isfinite(span), span, 1.0)
        way_sq = _squared(dq / settings.unit(dq))
        share = (dq.abs() / span).amax(-1)
        return self._replace(way_sq=way_sq, share=share, promised=promised, error=e)


class RestOfLevels(NamedTuple):
    """The rest of every level of a task: a level out of reach does not damp those before it."""

    levels: tuple[Level, ...]
    rests: tuple[Rest, ...]

    @classmethod
    def at(cls, levels: tuple[Level, ...], e: Tensor) -> Self:
        """Return what is known at the start of a motion, for errors (N, m): nothing."""
        return cls(levels, tuple(Rest.at(e[:, level.rows]) for level in levels))

    def seen(self, settings: StepSettings, before: Tensor, e: Tensor, J: Tensor) -> Self:
        """Return this with the curvatures that the last step has shown, see `Rest.seen`."""
        rests = []
        for level, rest in zip(self.levels, self.rests, strict=True):
            rows = level.rows
            rests.append(rest.seen(settings, before[:, rows], e[:, rows], J[:, rows]))
        return self._replace(rests=tuple(rests))

    def least(self, e: Tensor) -> Tensor:
        """Return the least lambda^2 (L, N) of the levels of a step at errors (N, m)."""
        each = zip(self.levels, self.rests, strict=True)
        return torch.stack([rest.least(e[:, level.rows]) for level, rest in each])

    def after(self, settings: StepSettings, dq: Tensor, promised: Tensor, e: Tensor) -> Self:
        """Return this after steps dq (N, n), see `Rest.after`."""
        rests = []
        for level, rest in zip(self.levels, self.rests, strict=True):
            rows = level.rows
            rests.append(rest.after(settings, dq, promised[:, rows], e[:, rows]))
        return self._replace(rests=tuple(rests))


def at_start(task: Task, e: Tensor) -> Rest | RestOfLevels:
    """Return what is known at the start of a motion of a task, for errors (N, m): nothing."""
    return Rest.at(e) if task.n_levels == 1 else RestOfLevels.at(task.by_level, e)


def _squared(rows: Tensor) -> Tensor:
    return rows.square().sum(-1)
