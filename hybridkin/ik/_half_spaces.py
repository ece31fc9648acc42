"""Limits of the tip: half-spaces, and the shortest way into them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from hybridkin._core.arrays import Numbers, Transform, as_tensor
from hybridkin._core.constants import moved
from hybridkin._core.portable import Portable
from hybridkin.ik._nearest import Polyhedron, nearest
from hybridkin.ik.tasks import PositionTask, Task


@dataclass(frozen=True, eq=False, repr=False)
class HalfSpaces(Portable):
    """Half-spaces in which the tip must stay: normals x <= offsets, unit normals (k, m)."""

    normals: Tensor
    offsets: Tensor

    @property
    def n(self) -> int:
        """Number of half-spaces."""
        return len(self.offsets)

    def __repr__(self) -> str:
        """Return the number of half-spaces, for printing."""
        return f"{self.n} half-spaces" if self.n else "None"

    def margin(self, x: Tensor) -> Tensor:
        """Return the distances (N, k) of points (N, m) to the planes, negative outside."""
        return moved(self.offsets, x) - self.along(x)

    def along(self, way: Tensor) -> Tensor:
        """Return the components (N, k) of displacements (N, m) along the normals."""
        return way @ moved(self.normals, way).T

    def way_in(self, margin: Tensor) -> Tensor:
        """Return the shortest displacements (N, m) with along(way) <= margin.

        Planes that contradict the ones before them are moved as far as these need.
        """
        normals = moved(self.normals, margin).expand(len(margin), -1, -1)
        still = torch.zeros_like(normals[:, 0])
        infinite = torch.full_like(still, math.inf)
        none = still.new_empty(len(still), 0)
        equations = normals[:, :0]
        most = torch.full_like(margin, math.inf)
        within = Polyhedron(equations, none, -infinite, infinite, normals, margin, most)
        return nearest(still, within)[0]


def everywhere() -> HalfSpaces:
    """Return no half-space: the tip may be anywhere."""
    nowhere = torch.empty(0, 3, dtype=torch.float64, device="cpu")
    return HalfSpaces(nowhere, nowhere[:, 0])


def half_spaces(pair: Sequence[Numbers | Transform], task: Task) -> HalfSpaces:
    """Return tip limits, a pair (A, b) with A x <= b, as half-spaces with unit normals."""
    if not isinstance(task, PositionTask):
        got = type(task).__name__
        raise ValueError(f"`tip_limits` needs a PositionTask, got a {got}.")
    (m,) = task.shape
    need = (
        f"`tip_limits` must be a pair (A, b) of shapes (k, {m}) and (k,), finite, with a direction "
        "in every row of A"
    )
    if not isinstance(pair, Sequence) or len(pair) != 2:
        raise ValueError(f"{need}, got {pair!r:.200}.")
    A, b = (as_tensor(part, "tip_limits").cpu().double() for part in pair)
    size = A.norm(dim=-1)
    good = b.ndim == 1 and A.shape == (len(b), m)
    if good:
        has_direction = torch.isfinite(b) & torch.isfinite(size) & (size > 0.0)
        good = has_direction.all()
    if not good:
        raise ValueError(f"{need}, got {A.tolist()!r:.200} and {b.tolist()!r:.200}.")
    spaces = HalfSpaces(A / size[:, None], b / size)
    margin = spaces.margin(spaces.way_in(spaces.offsets[None]))
    if not (margin >= -1e-9).all():
        raise ValueError("`tip_limits` must have a common point; these half-spaces have none.")
    return spaces
