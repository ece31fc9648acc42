"""Shapes of least energy of a heavy elastic body: the energy, and a search for its minimum.

A search ends in one of five ways, its `Outcome`. Only shapes at rest are returned: their imbalance
is zero to a tolerance, and the second derivative of their energy is positive definite.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from enum import IntEnum
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.kernel_numbers import HK_LEAST_LENGTH
from hybridkin.chains._arcs import segments_of
from hybridkin.chains._gravity import WorkOfGravity

_MOST_STEPS = 1000  # a body that falls to one side and is pulled to another turns slowly
_TOLERANCE = 1e-10  # imbalance relative to the loads
_SIDE = 2e-6  # relative load that decides to which side a body falls; 16 roundings of float32
_FLAT = 1e-9  # relative curvature of the energy below which a shape is not stable
_ENOUGH = 1e-4  # least decrease of the energy, relative to that of the linear model


class Outcome(IntEnum):
    """How a search ended."""

    AT_REST = 0
    BUCKLED = 1  # a saddle, or a circle of shapes: no load decides the side
    COMPRESSED = 2  # at rest, but an arc is shorter than `HK_LEAST_LENGTH`
    NOT_FOUND = 3
    INVALID = 4  # forces that are not finite


class Statics(NamedTuple):
    """The energy of a shape: arcs (3 A, N), all lengths, then x- and y-bendings.

    ``1/2 (a - rest)' K (a - rest) + a' B' f`` minus the work of gravity.
    """

    stiffness: Tensor  # (3 A,), diagonal of K
    rest: Tensor  # (3 A,), without forces and weight
    readings: Tensor  # B (n, 3 A), change of the tendon paths per change of shape
    weights: Tensor  # (A,) [N]
    offsets: Tensor  # (A,), rigid length after each arc [m]
    down: Tensor  # (3,), direction of gravity in the frame of the base

    def at(self, rows: Tensor) -> Statics:
        """Return the same on the device of rows."""
        return Statics(*(part.to(rows.device) for part in self))

    @property
    def unit(self) -> Tensor:
        """Change of each coordinate (3 A,) that costs half a joule of elastic energy."""
        return self.stiffness.rsqrt()

    def loads(self, forces: Tensor) -> Tensor:
        """Return the size (N,) of all loads in units of the shape [J^(1/2)].

        Tendon forces and their moments count without signs, and gravity with the whole weight at
        the end of the whole body: what cancels in a symmetric body does not make them smaller.
        """
        by_tendons = (forces @ self.readings.abs()) * self.unit
        weight = self.weights.sum()
        reach = self.rest.chunk(3)[0].sum() + self.offsets.abs().sum()
        axial, *bending = self.unit.chunk(3)
        by_weight = torch.cat([weight * axial, *(weight * reach * u for u in bending)])
        return by_tendons.norm(dim=1) + by_weight.norm()


class Shape:
    """Arcs (3 A, N) with tendon forces (N, n): their energy and its derivatives."""

    def __init__(self, statics: Statics, arcs: Tensor, forces: Tensor) -> None:
        self.statics = statics
        self.arcs = arcs
        self.forces = forces
        self.strain = arcs - statics.rest[:, None]
        segments = segments_of(arcs, statics.offsets[:, None])
        weights = statics.weights[:, None]
        self.gravity = WorkOfGravity(segments, weights, statics.down[:, None])

    @cached_property
    def _parts(self) -> tuple[Tensor, Tensor]:
        """Return the elastic energy (N,), and that of each tendon (n, N)."""
        squares = self.strain.square()
        elastic = 0.5 * (self.statics.stiffness[:, None] * squares).sum(0)
        return elastic, self.forces.mT * (self.statics.readings @ self.strain)

    @property
    def energy(self) -> Tensor:
        """The energy (N,) [J]."""
        elastic, tendons = self._parts
        return elastic + tendons.sum(0) - self.gravity.value

    @property
    def rounding(self) -> Tensor:
        """Rounding error (N,) of the energy [J]."""
        elastic, tendons = self._parts
        lengths, *_ = self.arcs.chunk(3)
        reach = lengths.abs().sum(0) + self.statics.offsets.abs().sum()
        size = elastic + tendons.abs().sum(0) + self.statics.weights.sum() * reach
        return 16.0 * torch.finfo(size.dtype).eps * size

    @property
    def imbalance(self) -> Tensor:
        """The derivative (3 A, N) of the energy by the arcs: zero at rest."""
        elastic = self.statics.stiffness[:, None] * self.strain
        tendons = self.statics.readings.mT @ self.forces.mT
        return elastic + tendons - self.gravity.gradient()

    @property
    def hessian(self) -> Tensor:
        """The second derivative (N, 3 A, 3 A) of the energy by the arcs."""
        by_gravity = self.gravity.hessian().permute(2, 0, 1)
        return torch.diag(self.statics.stiffness) - by_gravity


class Found(NamedTuple):
    """Results of searches; where the outcome is not AT_REST, rest shapes and zeros."""

    arcs: Tensor  # (3 A, N)
    compliance: Tensor  # (N, 3 A, 3 A), inverse of the second derivative of the energy
    outcome: Tensor  # (N,), values of Outcome


@dataclass
class _Live:
    """Rows whose search goes on, with the energy and its derivatives in units of the shape."""

    row: Tensor  # (N,), number of the row
    forces: Tensor  # (N, n)
    tol: Tensor  # (N,), imbalance of a shape at rest
    side: Tensor  # (N,), load that decides the side to which a body falls
    damping: Tensor  # (N,)
    arcs: Tensor  # (N, 3 A)
    energy: Tensor  # (N,)
    imbalance: Tensor  # (N, 3 A)
    hessian: Tensor  # (N, 3 A, 3 A)

    def take(self, rows: Tensor) -> _Live:
        """Return some of the rows, a bool mask (N,)."""
        places = rows.nonzero()[:, 0]
        return _Live(*(getattr(self, field.name)[places] for field in fields(self)))


@dataclass
class _Step:
    """A way down for every row, and what the curvature says about its shape."""

    way: Tensor  # (N, 3 A)
    is_stable: Tensor  # (N,), bool: the second derivative is positive definite
    is_stuck: Tensor  # (N,), bool: no way down, but not stable either


def shapes_of_least_energy(statics: Statics, forces: Tensor, start: Tensor) -> Found:
    """Return shapes at minima of the energy, from arcs (3 A, N) on for forces (N, n).

    Newton steps; where the energy is not convex, or such a step did not lower it, damped steps
    along the axes of its curvature, downhill along each of them. Every step lowers the energy, or
    the imbalance where the energy changes by rounding alone.
    """
    unit = statics.unit
    n = len(unit)
    shapes = Found(
        statics.rest[:, None].expand(-1, len(forces)).clone(),
        forces.new_zeros(len(forces), n, n),
        torch.full_like(forces[:, 0], Outcome.NOT_FOUND, dtype=torch.long),
    )
    shapes.outcome[~forces.isfinite().all(1)] = Outcome.INVALID
    live = _started(statics, forces, start)
    live = live.take(live.imbalance.norm(dim=1).isfinite() & live.tol.isfinite())
    for _ in range(_MOST_STEPS):
        if not len(live.row):
            break
        size = live.imbalance.norm(dim=1)
        step = _downhill(live)
        at_rest = (size <= live.tol) & step.is_stable
        stuck = live.take(step.is_stuck)
        why = torch.where(_is_short(statics, stuck), Outcome.COMPRESSED, Outcome.BUCKLED)
        shapes.outcome[stuck.row] = why
        if at_rest.any():
            _record(shapes, statics, live.take(at_rest))
        going = ~(at_rest | step.is_stuck)
        if not going.all():
            live = live.take(going)
            step.way = step.way[going]
        if len(live.row):
            _move(statics, live, step.way)
    return shapes


def _started(statics: Statics, forces: Tensor, start: Tensor) -> _Live:
    """Return all rows at their start."""
    loads = statics.loads(forces)
    size = (start.mT / statics.unit).norm(dim=1)
    rounding = 16.0 * torch.finfo(loads.dtype).eps * size  # of arcs
    tol = _TOLERANCE * loads + rounding
    shape = Shape(statics, start, forces)
    return _Live(
        row=torch.arange(len(forces), device=forces.device),
        forces=forces,
        tol=tol,
        side=torch.maximum(_SIDE * loads, tol),
        damping=torch.zeros_like(loads),
        arcs=start.mT,
        energy=shape.energy,
        imbalance=shape.imbalance.mT * statics.unit,
        hessian=statics.unit[:, None] * shape.hessian * statics.unit,
    )


def _downhill(live: _Live) -> _Step:
    """Return a step that lowers the energy, in units of the shape."""
    eye = identity(live.hessian.shape[1], live.hessian)
    flat = _FLAT * live.hessian.abs().amax((1, 2))
    lowered = live.hessian - flat[:, None, None] * eye
    factor, failed = torch.linalg.cholesky_ex(lowered)
    is_stable = failed == 0
    is_plain = is_stable & (live.damping == 0.0)
    factor = torch.where(is_plain[:, None, None], factor, eye)
    way = -torch.cholesky_solve(live.imbalance[..., None], factor)[..., 0]
    is_stuck = torch.zeros_like(is_stable)
    if is_plain.all():
        return _Step(way, is_stable, is_stuck)

    # Along the axes of curvature. A body falls where it is not stable, but only to a side that
    # the loads decide, not rounding.
    hard = ~is_plain
    curvature, axes = torch.linalg.eigh(live.hessian[hard])
    slope = (axes.mT @ live.imbalance[hard][..., None])[..., 0]
    falls = curvature <= flat[hard][:, None]
    undecided = falls & (slope.abs() <= live.side[hard][:, None])
    slope = torch.where(undecided, 0.0, slope)
    stiffness = torch.maximum(curvature.abs(), flat[hard][:, None])
    steps = slope / (stiffness + live.damping[hard][:, None])
    way[hard] = -(axes @ steps[..., None])[..., 0]
    is_stuck[hard] = falls.any(1) & (slope.norm(dim=1) <= live.tol[hard])
    return _Step(way, is_stable, is_stuck)


def _move(statics: Statics, live: _Live, way: Tensor) -> None:
    """Move the rows that get lower, and damp the next step of the others more."""
    moved = live.arcs + statics.unit * way
    shape = Shape(statics, moved.mT, live.forces)
    energy = shape.energy
    imbalance = shape.imbalance.mT * statics.unit
    hessian = statics.unit[:, None] * shape.hessian * statics.unit

    predicted = -(live.imbalance * way).sum(1)
    lower = energy <= live.energy - _ENOUGH * predicted
    level = (energy - live.energy).abs() <= shape.rounding
    calmer = imbalance.norm(dim=1) < live.imbalance.norm(dim=1)
    finite = (energy + imbalance.sum(1) + hessian.sum((1, 2))).isfinite()
    accepted = finite & (lower | (level & calmer))

    live.arcs = torch.where(accepted[:, None], moved, live.arcs)
    live.energy = torch.where(accepted, energy, live.energy)
    live.imbalance = torch.where(accepted[:, None], imbalance, live.imbalance)
    live.hessian = torch.where(accepted[:, None, None], hessian, live.hessian)
    more = (10.0 * live.damping).clamp(min=0.1)
    less = torch.where(live.damping > 1e-3, 0.1 * live.damping, 0.0)
    live.damping = torch.where(accepted, less, more)


def _record(shapes: Found, statics: Statics, live: _Live) -> None:
    """Put shapes at rest into the results, unless an arc is too short."""
    is_short = _is_short(statics, live)
    shapes.outcome[live.row[is_short]] = Outcome.COMPRESSED
    if is_short.any():
        live = live.take(~is_short)
    eye = identity(live.hessian.shape[1], live.hessian).expand_as(live.hessian)
    inverse, _ = torch.linalg.solve_ex(live.hessian, eye)
    shapes.outcome[live.row] = Outcome.AT_REST
    shapes.arcs[:, live.row] = live.arcs.mT
    shapes.compliance[live.row] = statics.unit[:, None] * inverse * statics.unit


def _is_short(statics: Statics, live: _Live) -> Tensor:
    """Return which shapes (N,) have an arc that is too short."""
    lengths, *_ = live.arcs.chunk(3, dim=1)
    rest, *_ = statics.rest.chunk(3)
    return (lengths < HK_LEAST_LENGTH * rest).any(1)
