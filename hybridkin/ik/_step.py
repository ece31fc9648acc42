"""The law of one step, eq. (1): a task, a posture in its null space, and limits inside the step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from hybridkin.ik._box import directed_step, strict_box_step
from hybridkin.ik._gram import (
    RowGram,
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    quick_gram,
    row_gram,
)
from hybridkin.ik.tasks import Task

HEALTHY = 0.02  # sigma_min / sigma_max above which the pseudo-inverse needs no damping


class Move(NamedTuple):
    """A step and what came with it, a row each."""

    dq: Tensor
    sigma_min: Tensor
    damping: Tensor
    saturated: Tensor
    scale: Tensor


@dataclass(frozen=True)
class Law:
    """What a step depends on besides q and the target; see `InverseKinematics`."""

    task: Task
    q_min: Tensor
    q_max: Tensor
    dq_max: Tensor
    q_pref: Any
    weights: Tensor | None
    damping: str | float
    limits: str
    mode: str

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, ...) and J (N, m, n) at q of shape (N, n)."""
        if len(q) == 0:
            return q.new_zeros(0, *self.task.shape), q.new_zeros(
                0, sum(self.task.parts), q.shape[1]
            )
        return self.task.evaluate(q)

    def preferred(self, q: Tensor) -> Tensor:
        """Return the preferred configurations, of shape (n,) or that of q."""
        wanted: Any = self.q_pref(q) if callable(self.q_pref) else self.q_pref
        return wanted.to(q)

    def unit(self, q: Tensor) -> Tensor:
        """Return the units, shape () or (n,), of q in which nothing has a weight."""
        return q.new_ones(()) if self.weights is None else self.weights.to(q).rsqrt()

    def null_step(self, J: Tensor, step: Tensor) -> Tensor:
        """Return the part of steps (N, n) that does not move what J (N, m, n) speaks of."""
        unit = self.unit(J)
        J = J * unit
        return unit * null_projection(J, quick_gram(J), step / unit)

    def advance(self, q: Tensor, J: Tensor, v: Tensor, beta: float, period: float) -> Move:
        """Return eq. (1) for one period; rows that are not finite hold still."""
        fine = torch.isfinite(q).all(-1) & torch.isfinite(J).all(-1).all(-1)
        fine = (fine & torch.isfinite(v).all(-1))[:, None]
        at = torch.where(fine, q, 0.0)
        posture = None
        if self.q_pref is not None and beta > 0.0:
            posture = torch.where(fine, beta * (self.preferred(at) - at), 0.0)
        bounds = self.step_bounds(q, self.dq_max.to(q) * period)
        J, v = torch.where(fine[..., None], J, 0.0), torch.where(fine, v, 0.0)
        move = self.resolve(J, v, posture, *bounds, mode=self.mode, first=self.task.first)
        return move._replace(
            dq=torch.where(torch.isnan(q), 0.0, move.dq),
            sigma_min=torch.where(fine[:, 0], move.sigma_min, math.nan),
            scale=torch.where(fine[:, 0], _share(J, v, move), math.nan),
        )

    def resolve(
        self,
        J: Tensor,
        v: Tensor,
        posture: Tensor | None,
        lower: Tensor,
        upper: Tensor,
        trust: Tensor | None = None,
        *,
        mode: str = "least_squares",
        first: int | None = None,
        quick: bool = False,
    ) -> Move:
        """Return the step for the task v and the posture step, within the bounds.

        Weights are a change of unit: in u = W^(1/2) q nothing has a weight. `scale` is NaN where
        the mode has not set it. A search looks at every step it took: there estimates of singular
        values will do, and `trust`, lambda^2 / sigma_max^2, in place of the damping.
        """
        box = lower, upper
        unit = self.unit(v)
        if self.weights is not None:
            J, lower, upper = J * unit, lower / unit, upper / unit
            posture = None if posture is None else posture / unit
        if first is None:
            gram = quick_gram(J, trust is not None) if quick else row_gram(J)
            dq, nulls, damping_sq, sigma_min = self._plain(J, gram, v, trust)
        else:
            dq, nulls, damping_sq, sigma_min = self._ranked(J, v, trust, first)
        wanted, z = dq, torch.zeros_like(dq)
        if posture is not None:
            z = posture
            for rows, gram in nulls:
                z = null_projection(rows, gram, z)
            dq = dq + z
        scale = torch.full_like(sigma_min, math.nan)
        if self.limits != "off":
            clipped = torch.clamp(dq, lower, upper)
            over = (clipped != dq).any(-1).nonzero()[:, 0]
            if self.limits == "saturate" and over.numel() > 0:
                at, inside = J[over], (a[over] for a in torch.broadcast_tensors(lower, upper))
                low, high = inside
                clipped[over] = strict_box_step(
                    at, v[over], z[over], low, high, damping_sq[over], first
                )
                # From outside the limits there is no direction to keep, only a way back.
                ray = ((low <= 0.0) & (high >= 0.0)).all(-1).nonzero()[:, 0]
                if mode == "direction" and ray.numel() > 0:
                    at, low, high, rows = at[ray], low[ray], high[ray], over[ray]
                    aim = apply_rows(at, wanted[rows])
                    clipped[rows], scale[rows] = directed_step(at, aim, z[rows], low, high)
            dq = clipped
        if self.weights is not None:
            dq = torch.clamp(dq * unit, *box) if self.limits != "off" else dq * unit
        saturated = (dq <= box[0]) | (dq >= box[1])
        damping = damping_sq if damping_sq.ndim == 1 else damping_sq.amax(-1)
        return Move(dq, sigma_min, damping.sqrt(), saturated, scale)

    def _plain(self, J: Tensor, gram: RowGram, v: Tensor, trust: Tensor | None) -> tuple:
        """Return the step for one task, the null spaces left, lambda^2 and sigma_min."""
        damping_sq = self._damping_sq(gram, gram.sigma_max, trust)
        dq = apply_columns(J, damped_solve(gram, v, damping_sq))
        return dq, [(J, gram)], damping_sq, gram.sigma_min

    def _ranked(self, J: Tensor, v: Tensor, trust: Tensor | None, first: int) -> tuple:
        """Return the same for two tasks, the second in the null space of the first."""
        top, gram = J[:, :first], row_gram(J[:, :first])
        dq, _, top_sq, sigma_min = self._plain(top, gram, v[:, :first], None)
        below = J[:, first:]
        whole = torch.linalg.matrix_norm(below, ord=2) if len(J) else top_sq
        left = null_projection(top[:, None], _unsqueezed(gram), below)
        gram_left = row_gram(left)
        left_sq = self._damping_sq(gram_left, whole, trust)
        rest = v[:, first:] - apply_rows(below, dq)
        dq = dq + apply_columns(left, damped_solve(gram_left, rest, left_sq))
        sizes = (top.shape[1], below.shape[1])
        pairs = zip((top_sq, left_sq), sizes, strict=True)
        damping_sq = torch.cat([a[:, None].expand(-1, size) for a, size in pairs], dim=-1)
        return dq, [(top, gram), (left, gram_left)], damping_sq, sigma_min

    def _damping_sq(self, gram: RowGram, sigma_max: Tensor, trust: Tensor | None) -> Tensor:
        if trust is not None:
            return trust * sigma_max.square()
        if self.damping == "adaptive":
            return adaptive_damping(gram, HEALTHY, sigma_max)
        return (float(self.damping) * sigma_max).square()

    def box(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the limits of q."""
        if self.limits == "off":
            return q.new_tensor(-math.inf), q.new_tensor(math.inf)
        return self.q_min.to(q), self.q_max.to(q)

    def inside(self, q: Tensor) -> Tensor:
        """Return q moved into the limits."""
        return torch.clamp(q, *self.box(q))

    def step_bounds(self, q: Tensor, largest: Tensor | None) -> tuple[Tensor, Tensor]:
        """Return the bounds of dq: position and speed intersected, never empty.

        From outside the limits both bounds meet at the way back, at most the largest step. The
        nextafter makes q + upper <= q_max hold after rounding, and with it q + dq for every dq.
        """
        q_min, q_max = self.box(q)
        lower, upper = q_min - q, q_max - q
        up, down = torch.full_like(q, math.inf), torch.full_like(q, -math.inf)
        upper = torch.where(q + upper > q_max, torch.nextafter(upper, down), upper)
        lower = torch.where(q + lower < q_min, torch.nextafter(lower, up), lower)
        if self.limits != "off" and largest is not None:
            lower = torch.clamp(lower, -largest, largest)
            upper = torch.clamp(upper, -largest, largest)
        return lower, upper

    def margin(self, q: Tensor) -> Tensor:
        """Return the smallest distance of an actuator to its limits."""
        return torch.minimum(q - self.q_min.to(q), self.q_max.to(q) - q).amin(-1)


def _share(J: Tensor, v: Tensor, move: Move) -> Tensor:
    """Return the scale, or where the mode has set none, how far dq goes along v."""
    square = v.square().sum(-1)
    along = (apply_rows(J, move.dq) * v).sum(-1) / torch.where(square > 0.0, square, 1.0)
    along = torch.where(square > 0.0, along, 1.0)
    return torch.where(torch.isnan(move.scale), along, move.scale)


def _unsqueezed(gram: RowGram) -> RowGram:
    """Return a RowGram for steps with one more leading axis."""
    parts = tuple(part[:, None] for part in gram.parts)
    return RowGram(parts, gram.sigma_min[:, None], gram.sigma_max[:, None])
