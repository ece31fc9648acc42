"""Limits of your own: what a function of the present state says about the next step.

`InverseKinematics` takes such functions as `limits`. Each gets the configurations q (N, n), the
tips x (N, ...) and the Jacobians J (N, m, n) as tensors, and returns `Rows` or `Bounds` of the step
dq (N, n) of this period. They hold exactly, together with all other limits.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from hybridkin._core.arrays import check_shape
from hybridkin.ik._strict import StepLimits

__all__ = ["Bounds", "Limit", "Rows"]


class Bounds(NamedTuple):
    """Bounds ``lower <= dq <= upper`` of steps, or of q; each of shape () or (..., n) [unit of q].

    Examples
    --------
    The first actuator may only grow:

    >>> import torch
    >>> from hybridkin.ik.limits import Bounds
    >>> def only_grows(q, x, J):
    ...     lower = torch.full_like(q, -torch.inf)
    ...     lower[:, 0] = 0.0
    ...     return Bounds(lower, torch.full_like(q, torch.inf))
    """

    lower: Tensor
    upper: Tensor

    def clip(self, values: Tensor) -> Tensor:
        """Return values moved into the bounds."""
        return torch.clamp(values, self.lower, self.upper)

    def held(self, values: Tensor) -> Tensor:
        """Return which values are at a bound."""
        return (values <= self.lower) | (values >= self.upper)


class Rows(NamedTuple):
    """One-sided limits ``A dq <= b`` of steps.

    Where they contradict each other, or the limits of the actuators, they give way as far as they
    must, the last ones first; none gives way to more than the robot has at rest.

    Attributes
    ----------
    A : Tensor of shape (N, k, n) or (k, n)
        Rows, the most important one first [any unit per unit of q].
    b : Tensor of shape (N, k) or (k,)
        Their limits [that unit].

    Examples
    --------
    The volume of three chambers together changes by at most 1 % per period:

    >>> import torch
    >>> from hybridkin import InverseKinematics, robots
    >>> from hybridkin.ik.limits import Rows
    >>> def slow_volume(q, x, J):
    ...     total = torch.zeros_like(q)
    ...     total[:, :3] = 1.0
    ...     limit = 0.01 * q[:, :3].sum(-1)
    ...     return Rows(torch.stack([total, -total], dim=1), torch.stack([limit, limit], dim=1))
    >>> trunk = robots.bionic_handling_assistant()
    >>> ik = InverseKinematics(trunk, q_min=0.1, q_max=0.4, limits=[slow_volume])
    >>> q = torch.full((9,), 0.25, dtype=torch.float64)
    >>> step = ik.step(q, torch.tensor([0.1, 0.0, 0.9], dtype=torch.float64))
    >>> bool(step.dq[:3].sum().abs() <= 0.0075 + 1e-12)
    True
    """

    A: Tensor
    b: Tensor


Limit: TypeAlias = Callable[[Tensor, Tensor, Tensor], Rows | Bounds]


def functions(value: Sequence[Limit]) -> tuple[Limit, ...]:
    """Return a caller's functions, checked."""
    if not isinstance(value, Sequence) or not all(map(callable, value)):
        raise TypeError(
            '`limits` must be "saturate", "off" or a list of functions limit(q, x, J) -> Rows or '
            f"Bounds, got {value!r:.200}."
        )
    return tuple(value)


def with_limit(
    limit: Limit, q: Tensor, x: Tensor, J: Tensor, limits: StepLimits
) -> tuple[StepLimits, Tensor]:
    """Return the limits of steps with those of a caller's function, and where these are known.

    Parameters
    ----------
    limit : callable
        The function.
    q, x, J : Tensor of shape (N, n), (N, ...) and (N, m, n)
        The state.
    limits : StepLimits
        The limits before.

    Returns
    -------
    limits : StepLimits
        With the new ones; where these are NaN, without.
    known : bool Tensor of shape (N, 1)
        Where they are not NaN.
    """
    answer = limit(q, x, J)
    N, n = q.shape
    if isinstance(answer, Bounds):
        lower, upper = (_tensor(end, "Bounds").to(q).expand(N, n) for end in answer)
        known = ~(lower.isnan() | upper.isnan()).any(-1, keepdim=True)
        before = Bounds(limits.lower, limits.upper)
        lower = torch.where(known, before.clip(lower), limits.lower)
        upper = torch.where(known, before.clip(upper), limits.upper)
        return limits._replace(lower=torch.minimum(lower, upper), upper=upper), known
    if not isinstance(answer, Rows):
        raise TypeError(
            f"`limits` must be functions that return Rows or Bounds, got {answer!r:.200}; see "
            "hybridkin.ik.limits."
        )
    A = _tensor(answer.A, "Rows").to(q)
    b = _tensor(answer.b, "Rows").to(q)
    k = b.shape[-1] if b.ndim else 0
    check_shape(b, "Rows.b", ("...", k), "one limit per row")
    check_shape(A, "Rows.A", ("...", k, n), "one row of n numbers per limit")
    A = A.expand(N, k, n)
    b = b.expand(N, k)
    known = ~(A.isnan().flatten(1).any(-1, keepdim=True) | b.isnan().any(-1, keepdim=True))
    A = torch.where(known[..., None], A, 0.0)
    b = torch.where(known, b, math.inf)
    return limits.with_rows(A, b), known


def _tensor(value: object, name: str) -> Tensor:
    """Return a part of what a caller's function returns, which must be a tensor."""
    if not isinstance(value, Tensor):
        raise TypeError(f"`{name}` must hold torch tensors, got {type(value).__name__}.")
    return value
