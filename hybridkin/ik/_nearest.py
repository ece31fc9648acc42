"""The point of a polyhedron that is nearest to another point: every limited step is one."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import one_hot

from hybridkin._core.kernel_numbers import IK_CHANGES, IK_PROXIMAL, IK_SAME
from hybridkin.ik._gram import apply_rows

_ROUNDING = 2.0 / 3.0  # of a component of a unit vector: this power of eps


class Polyhedron(NamedTuple):
    """Points x (N, n) with E x = e, lower <= x <= upper and A x <= b, a polyhedron for every row.

    Attributes
    ----------
    E, e : Tensor of shape (N, m, n) and (N, m)
        Equations; those that depend on the ones before them, up to rounding, are left out.
    lower, upper : Tensor of shape (N, n)
        Bounds, lower <= upper, infinite where there are none.
    A, b : Tensor of shape (N, k, n) and (N, k)
        Rows of length one, the most important ones first, and their offsets.
    most : Tensor of shape (N, k)
        The largest offsets to which rows may be relaxed.
    """

    E: Tensor
    e: Tensor
    lower: Tensor
    upper: Tensor
    A: Tensor
    b: Tensor
    most: Tensor

    def excess(self, x: Tensor) -> Tensor:
        """Return by how much x violates every inequality, shape (N, 2 n + k): the bounds first."""
        beyond = (self.A @ x[..., None])[..., 0] - self.b
        return torch.cat([self.lower - x, x - self.upper, beyond], dim=-1)

    def rounding(self, x: Tensor) -> Tensor:
        """Return what rounding may leave of the excess of x, shape (N, 2 n + k)."""
        bounds = torch.cat([self.lower.abs() + x.abs(), self.upper.abs() + x.abs()], dim=-1)
        rows = apply_rows(self.A.abs(), x.abs()) + self.b.abs()
        return 8.0 * torch.finfo(x.dtype).eps * torch.cat([bounds, rows], dim=-1)

    def normals(self, which: Tensor) -> Tensor:
        """Return the inward normals (N, n) of inequalities (N,), one for every row."""
        n = self.lower.shape[-1]
        unit = torch.eye(n, dtype=self.lower.dtype, device=self.lower.device)
        sides = torch.cat([unit, -unit]).expand(len(which), -1, -1)
        every = torch.cat([sides, -self.A], dim=1)
        return every[torch.arange(len(which), device=which.device), which]

    def take(self, rows: Tensor) -> Polyhedron:
        """Return the polyhedra of some rows."""
        return Polyhedron(*(a[rows] for a in self))


class _Active(NamedTuple):
    """The constraints that hold as equations, in n slots for every row of x.

    Attributes
    ----------
    free : Tensor of shape (N, n, n)
        Projector onto the directions that they leave.
    inverse : Tensor of shape (N, n, n)
        Rows of the pseudo-inverse of their normals, zero in free slots.
    force : Tensor of shape (N, n)
        Their multipliers, infinite for equations.
    which : Tensor of shape (N, n)
        Their inequality, -1 for none.
    """

    free: Tensor
    inverse: Tensor
    force: Tensor
    which: Tensor

    @classmethod
    def none(cls, x: Tensor) -> _Active:
        """Return no constraints of points x (N, n)."""
        N, n = x.shape
        free = torch.eye(n, dtype=x.dtype, device=x.device).repeat(N, 1, 1)
        which = torch.full((N, n), -1, device=x.device)
        return cls(free, torch.zeros_like(free), torch.zeros_like(x), which)

    def along(self, normal: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return the free part of normals (N, n), its square, and their multiples of the others."""
        way = apply_rows(self.free, apply_rows(self.free, normal))  # twice, for rounding
        return way, way.square().sum(-1), apply_rows(self.inverse, normal)

    def with_one(
        self, adds: Tensor, way: Tensor, multiples: Tensor, force: Tensor, which: Tensor
    ) -> _Active:
        """Return the constraints with one more in the rows `adds`, as from `along`."""
        unit = way / way.square().sum(-1, keepdim=True)
        unit = torch.where(adds[:, None], unit, 0.0)
        empty = (self.inverse == 0.0).all(-1).to(torch.uint8).argmax(-1)
        slot = one_hot(empty, self.force.shape[-1]).bool() & adds[:, None]
        inverse = self.inverse - multiples[..., None] * unit[:, None]
        inverse = torch.where(slot[..., None], unit[:, None], inverse)
        return _Active(
            self.free - way[..., None] * unit[:, None],
            inverse,
            torch.where(slot, force[:, None], self.force),
            torch.where(slot, which[:, None], self.which),
        )

    def without(self, slot: Tensor) -> _Active:
        """Return the constraints without those in slots (N, n) of bool, at most one in a row."""
        way = (self.inverse * slot[..., None]).sum(1)
        size = way.square().sum(-1, keepdim=True)
        unit = torch.where(size > 0.0, way / size, 0.0)
        along_way = apply_rows(self.inverse, unit)
        inverse = self.inverse - along_way[..., None] * way[:, None]
        return _Active(
            self.free + unit[..., None] * way[:, None],
            torch.where(slot[..., None], 0.0, inverse),
            torch.where(slot, 0.0, self.force),
            torch.where(slot, -1, self.which),
        )

    def chosen_of(self, inequalities: Tensor) -> Tensor:
        """Return which inequalities (N, K) are active, bool (N, K)."""
        K = inequalities.shape[-1]
        return one_hot(self.which.clamp_min(-1) + 1, K + 1)[..., 1:].bool().any(1)

    def pushing(self, way: Tensor, rows: Tensor) -> _Active:
        """Return the constraints with the forces of points `way` from the origin, in some rows."""
        force = apply_rows(self.inverse, way)
        return self._replace(force=torch.where(rows & (self.which >= 0), force, self.force))

    def where(self, is_kept: Tensor, replaced: _Active) -> _Active:
        """Return these constraints in the rows `is_kept`, else the other ones."""
        square = is_kept[:, None, None]
        row = is_kept[:, None]
        return _Active(
            torch.where(square, self.free, replaced.free),
            torch.where(square, self.inverse, replaced.inverse),
            torch.where(row, self.force, replaced.force),
            torch.where(row, self.which, replaced.which),
        )

    def take(self, rows: Tensor) -> _Active:
        """Return the constraints of some rows."""
        return _Active(*(a[rows] for a in self))


def nearest(
    x: Tensor,
    within: Polyhedron,
    excess: Tensor | float = 0.0,
    centre: Tensor | float = 0.0,
) -> tuple[Tensor, Tensor]:
    """Return the points of polyhedra that are nearest to x (N, n).

    The dual active-set method of Goldfarb & Idnani with the distance as the objective: starting
    from x, the constraint violated most becomes active, and constraints that would push the wrong
    way leave, until none is violated. It is exact after a finite number of changes.

    Rows of A that contradict the bounds or more important rows are relaxed as far as these need,
    the least important one first.

    Parameters
    ----------
    x : Tensor of shape (N, n)
        Points.
    within : Polyhedron
        Where to; its equations and bounds have a common point.
    excess : Tensor of shape (N, m)
        Proximal rounds move the values e of the equations by `excess` times their multipliers:
        what has been added to lambda^2, if the points hold the slack of the equations. Equations
        with an excess come before those without, and do not depend on others.
    centre : Tensor of shape (N, m)
        Multipliers of the equations that the first round takes.

    Returns
    -------
    x : Tensor of shape (N, n)
        Points within the bounds exactly, on equations and within rows up to rounding.
    multipliers : Tensor of shape (N, m)
        Those of the equations.

    References
    ----------
    Goldfarb & Idnani, Math. Program. 27 (1983), with their operators H and N*.
    """
    ends = x.clone()
    multipliers = torch.zeros_like(within.e)
    excess = torch.zeros_like(within.e) + excess
    live = _Live.on_equations(x, within, excess, centre)
    for _ in range(IK_CHANGES):
        live = live.choosing()
        done = live.now.chosen < 0
        if done.any():
            ends[live.rows[done]] = live.now.x[done]
            multipliers[live.rows[done]] = live.multipliers[done]
            live = live.take((~done).nonzero()[:, 0])
        if live.rows.numel() == 0:
            break
        live = live.after_change()
    ends[live.rows] = live.now.x
    multipliers[live.rows] = live.multipliers
    return torch.clamp(ends, within.lower, within.upper), multipliers


class _State(NamedTuple):
    """Where the iteration is: what begins anew when a row of A is relaxed.

    Attributes
    ----------
    x : Tensor of shape (N, n)
        The points.
    e : Tensor of shape (N, m)
        The values of the equations in this round.
    active : _Active
        The constraints that hold as equations.
    rounds : Tensor of shape (N,)
        Rounds left.
    close : Tensor of shape (N,)
        What rounding of all that led to x may be, once it has been seen.
    chosen : Tensor of shape (N,)
        The inequality on its way to be active, -1 for none.
    force : Tensor of shape (N,)
        Its multiplier.
    """

    x: Tensor
    e: Tensor
    active: _Active
    rounds: Tensor
    close: Tensor
    chosen: Tensor
    force: Tensor

    def where(self, is_kept: Tensor, replaced: _State) -> _State:
        """Return this in the rows `is_kept` (N,), else the other one."""
        row = is_kept[:, None]
        return _State(
            torch.where(row, self.x, replaced.x),
            torch.where(row, self.e, replaced.e),
            self.active.where(is_kept, replaced.active),
            torch.where(is_kept, self.rounds, replaced.rounds),
            torch.where(is_kept, self.close, replaced.close),
            torch.where(is_kept, self.chosen, replaced.chosen),
            torch.where(is_kept, self.force, replaced.force),
        )

    def take(self, rows: Tensor) -> _State:
        """Return the state of some rows."""
        parts = []
        for part in self:
            parts.append(part[rows] if isinstance(part, Tensor) else part.take(rows))
        return _State(*parts)


class _Live(NamedTuple):
    """Rows of the iteration that are not solved yet: where they are, and what they push against.

    Attributes
    ----------
    rows : Tensor of shape (N,)
        Their places among all rows.
    origin : Tensor of shape (N, n)
        The points to be near to.
    within : Polyhedron
        What they go into, with relaxed rows.
    excess : Tensor of shape (N, m)
        The factor of the multipliers in later rounds.
    begun, now : _State
        The state on the equations alone, and the present one.
    """

    rows: Tensor
    origin: Tensor
    within: Polyhedron
    excess: Tensor
    begun: _State
    now: _State

    @classmethod
    def on_equations(
        cls, origin: Tensor, within: Polyhedron, excess: Tensor, centre: Tensor | float
    ) -> _Live:
        """Return the points that are nearest to the origin on the equations alone."""
        x = origin
        e = within.e + excess * centre
        active = _Active.none(x)
        none = torch.full_like(x[:, 0], -1, dtype=torch.long)
        for normal, value in zip(within.E.unbind(1), e.unbind(1), strict=True):
            way, size, multiples = active.along(normal)
            adds = size > _rounding(x) ** 2 * normal.square().sum(-1)
            missing = value - (normal * x).sum(-1)
            length = torch.where(adds, missing / size, 0.0)
            x = x + length[:, None] * way
            force = torch.full_like(size, torch.inf)
            active = active.with_one(adds, way, multiples, force, none)
        rows = torch.arange(len(x), device=x.device)
        rounds = torch.where((excess > 0.0).any(-1), IK_PROXIMAL, 0)
        zero = torch.zeros_like(x[:, 0])
        begun = _State(x, e, active, rounds, zero, none, zero)
        return cls(rows, origin, within, excess, begun, begun)

    @property
    def multipliers(self) -> Tensor:
        """Those of the equations (N, m)."""
        m = self.within.e.shape[-1]
        return apply_rows(self.now.active.inverse[:, :m], self.now.x - self.origin)

    def choosing(self) -> _Live:
        """Return the same with the inequality violated most chosen where there was none.

        Where none is violated the next round begins.
        """
        live = self
        for _ in range(1 + IK_PROXIMAL):
            now = live.now
            beyond = live.within.excess(now.x)
            least = live.within.rounding(now.x) + now.close[:, None]
            violated = torch.where(beyond > least, beyond, 0.0)
            violated = violated.masked_fill(now.active.chosen_of(beyond), 0.0)
            most, worst = violated.max(-1)
            none = (now.chosen < 0) & (most > 0.0)
            chosen = torch.where(none, worst, now.chosen)
            live = live._replace(now=now._replace(chosen=chosen))
            ended = (chosen < 0) & (now.rounds > 0)
            if not ended.any():
                break
            live = live._next_round(ended)
        return live

    def _next_round(self, ended: Tensor) -> _Live:
        """Return the same with new values of the equations in the rows `ended` (N,)."""
        now = self.now
        m = self.within.e.shape[-1]
        ended = ended[:, None]
        e = torch.where(ended, self.within.e + self.excess * self.multipliers, now.e)
        change = e - now.e
        x = now.x + (change[..., None] * now.active.inverse[:, :m]).sum(1)
        active = now.active.pushing(x - self.origin, ended)
        # What pulls now is no longer active.
        while True:
            least, slot = active.force.min(-1)
            pulls = least < 0.0
            if not pulls.any():
                break
            leaving = one_hot(slot, x.shape[-1]).bool() & pulls[:, None]
            way = (active.inverse * leaving[..., None]).sum(1)
            size = way.square().sum(-1)
            length = torch.where(pulls, least / size, 0.0)
            x = x - length[:, None] * way
            active = active.without(leaving).pushing(x - self.origin, pulls[:, None])
        rounds = now.rounds - ended[:, 0].long()
        return self._refined(now._replace(x=x, e=e, active=active, rounds=rounds))

    def after_change(self) -> _Live:
        """Return the same after one constraint more or less, or with a row that is relaxed."""
        x, active, chosen = self.now.x, self.now.active, self.now.chosen
        normal = self.within.normals(chosen)
        missing = self.within.excess(x).gather(-1, chosen[:, None])[:, 0]
        way, size, multiples = active.along(normal)

        # The step at which it holds, or the first at which an active one pushes no more.
        movable = size > _rounding(x) ** 2
        full = torch.where(movable, missing / size, torch.inf)
        pushes = multiples > _rounding(x)
        lengths = torch.where(pushes, active.force / multiples, torch.inf)
        first, slot = lengths.min(-1)
        length = torch.minimum(full, first)
        stuck = torch.isinf(length)
        length = torch.where(stuck, 0.0, length)
        force = self.now.force + length
        active = active._replace(force=active.force - length[:, None] * multiples)
        adds = ~stuck & (full <= first)
        drops = ~stuck & ~adds
        leaving = one_hot(slot, x.shape[-1]).bool() & drops[:, None]
        now = self.now._replace(
            x=x + torch.where(movable, length, 0.0)[:, None] * way,
            active=active.with_one(adds, way, multiples, force, chosen).without(leaving),
            chosen=torch.where(adds, -1, chosen),
            force=torch.where(adds, 0.0, force),
        )
        moved = self._replace(now=now)
        if stuck.any():
            moved = moved._relaxed(stuck, missing, multiples)
        return moved._refined(moved.now)

    def _relaxed(self, stuck: Tensor, missing: Tensor, multiples: Tensor) -> _Live:
        """Return the same with a row relaxed where constraints contradict: these begin anew.

        The chosen normal is a sum of active ones with factors `multiples` (N, n), none positive.
        """
        now = self.now
        n = now.x.shape[-1]
        first_row = 2 * n
        which = torch.where(multiples < -_rounding(multiples), now.active.which, -1)
        which = torch.cat([which, now.chosen[:, None]], dim=-1)
        room = self.within.most - self.within.b
        every = torch.cat(
            [torch.zeros_like(self.within.excess(now.x))[:, :first_row], room], dim=-1
        )
        which = torch.where(every.gather(-1, which.clamp_min(0)) > 0.0, which, -1)
        factors = torch.cat([-multiples, torch.ones_like(missing)[:, None]], dim=-1)
        least, slot = which.max(-1)
        # What is as small as rounding is none; what comes again, or is more, is a contradiction.
        rounding = self.within.rounding(now.x) + self.within.rounding(self.begun.x)
        close = 0.125 * IK_SAME * rounding
        size = close.gather(-1, now.chosen.clamp_min(0)[:, None])[:, 0]
        ends = stuck & ((missing > size) | (now.close > 0.0))
        has_row = ends & (least >= first_row)
        by = missing / factors.gather(-1, slot[:, None])[:, 0]
        row = (least - first_row).clamp_min(0)
        b = self.within.b
        if b.shape[-1]:
            rounding = 32.0 * torch.finfo(b.dtype).eps
            by = by + rounding * (by + b.gather(-1, row[:, None])[:, 0].abs())
            over = torch.where(has_row, by, 0.0)
            b = b.scatter_add(-1, row[:, None], over[:, None]).minimum(self.within.most)
        size = torch.where(ends, torch.inf, size)
        seen = now._replace(
            close=torch.where(stuck, size, now.close),
            rounds=torch.where(ends, 0, now.rounds),
            chosen=torch.where(stuck, -1, now.chosen),
            force=torch.where(stuck, 0.0, now.force),
        )
        return self._replace(within=self.within._replace(b=b), now=seen.where(~has_row, self.begun))

    def _refined(self, now: _State) -> _Live:
        """Return this at a state after one Newton step onto the active constraints.

        It takes rounding out.
        """
        which = now.active.which
        inequality = -self.within.excess(now.x).gather(-1, which.clamp_min(0))
        off = torch.where(which >= 0, inequality, 0.0)
        # Row c of `inverse` moves along the inward normal c alone.
        x = now.x - (off[..., None] * now.active.inverse).sum(1)
        return self._replace(now=now._replace(x=x))

    def take(self, rows: Tensor) -> _Live:
        """Return some rows."""
        parts = []
        for part in self:
            parts.append(part[rows] if isinstance(part, Tensor) else part.take(rows))
        return _Live(*parts)


def _rounding(x: Tensor) -> float:
    """Return what rounding leaves of a component of a unit vector that is zero."""
    return torch.finfo(x.dtype).eps ** _ROUNDING
