"""The work of gravity on heavy arcs, and its derivatives by the arcs."""

from __future__ import annotations

from functools import cached_property

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.stumpff import next_stumpff
from hybridkin.chains._arcs import (
    Segments,
    columns_of,
    rotation_of,
    segments_of,
    spins_of,
    vectors,
)


class WorkOfGravity:
    """Work of gravity on the weights of arcs, from the base frame to their centres, by the arcs.

    The weights (A, ...) act half way along the arcs; `down` (3, ...) is a direction in the base
    frame. The work is linear in both. All moments are about the ends of arcs, in the base frame.
    """

    def __init__(self, segments: Segments, weights: Tensor, down: Tensor) -> None:
        self.segments = segments
        self._weights = weights
        self._down = down
        self._after = weights.flip(0).cumsum(0).flip(0) - weights

        # The weights act at the ends of the first halves of the arcs.
        halves = 0.5 * torch.cat([segments.length, segments.x, segments.y])
        self._half = segments_of(halves, segments.offset)
        centres = self._half.length * _tangent_step(self._half)

        # Rotations (3, 3, A, ...) from start frames, and from end frames, to the base frame.
        self._starts, self._ends = _rotations(segments)
        arcs = segments.length * _rotated(self._starts, _tangent_step(segments))
        steps = arcs + segments.offset * self._ends[:, 2]
        ends_in_base = steps.cumsum(1)
        self._centres = ends_in_base - steps + _rotated(self._starts, centres)
        heavy = weights * self._centres
        later = heavy.flip(1).cumsum(1).flip(1) - heavy
        self._moments = later - self._after * ends_in_base  # (3, A, ...)

    @property
    def value(self) -> Tensor:
        """The work (...)."""
        return (self._down * (self._weights * self._centres).sum(1)).sum(0)

    @cached_property
    def _columns(self) -> tuple[Tensor, Tensor]:
        """Return derivatives of the later moments by l, b_x and b_y, and spins, (3, 3, A, ...).

        Vectors in the base frame: (vector, kind, A, ...).
        """
        zero = torch.zeros_like(self.segments.x)
        tool = (zero, zero, zero + self.segments.offset)
        ends = vectors(columns_of(tool, self.segments)).transpose(0, 1)
        centres = vectors(columns_of((zero, zero, zero), self._half)).transpose(0, 1)
        own = self._after * ends + 0.5 * self._weights * centres
        starts = self._starts[:, :, None]
        local_spins = vectors(spins_of(self.segments)).transpose(0, 1)
        spins = _rotated(starts, local_spins)
        turned = torch.linalg.cross(spins, self._moments[:, None], dim=0)
        return _rotated(starts, own) + turned, spins

    def gradient(self) -> Tensor:
        """Return the derivative (3 A, ...) by the arcs: lengths, then x-, then y-bendings."""
        columns, _ = self._columns
        return (self._down[:, None, None] * columns).sum(0).flatten(0, 1)

    def hessian(self) -> Tensor:
        """Return the second derivative (3 A, 3 A, N) by the arcs."""
        columns, spins = self._columns

        # The bending of an arc turns the derivatives by all later arcs.
        down = self._down[:, None, None].expand_as(columns)
        torques = torch.linalg.cross(columns, down, dim=0)
        pairs = torch.einsum("vikn,vjmn->ikjmn", spins, torques)
        A = len(self._weights)
        later = pairs.new_ones(A, A).triu(1)[:, None, :, None]
        pairs = (pairs * later).flatten(2, 3).flatten(0, 1)

        within = self._within().transpose(2, 3).diag_embed()  # (3, 3, N, A, A)
        within = within.permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)
        return pairs + pairs.transpose(0, 1) + within

    def _within(self) -> Tensor:
        """Return the second derivatives (3, 3, A, N) by the arcs, each with itself."""
        down = _rotated(self._starts.transpose(0, 1), self._down[:, None])
        x, y, z = _rotated(self._ends.transpose(0, 1), self._moments)
        heavy = self.segments._replace(length=self._after * self.segments.length)
        tail = torch.stack([x, y, z + self._after * heavy.offset])
        by_length, by_bending = _second_derivatives(tail, heavy, down)
        none = torch.zeros_like(tail)
        by_half_length, by_half_bending = _second_derivatives(none, self._half, down)
        mixed = self._after * by_length + 0.25 * self._weights * by_half_length
        bending = by_bending + 0.25 * self._weights * by_half_bending
        lengths = torch.cat([torch.zeros_like(mixed[:1]), mixed])
        return torch.cat([lengths[None], torch.cat([mixed[:, None], bending], dim=1)])


def _tangent_step(segment: Segments) -> Tensor:
    """Return the derivative (3, ...) of the end of an arc by its length."""
    return torch.stack([segment.g * segment.x, segment.g * segment.y, segment.f])


def _rotated(turns: Tensor, vectors: Tensor) -> Tensor:
    """Return rotations (3, 3, ...) times vectors (3, ...)."""
    return (turns * vectors).sum(1)


def _rotations(segments: Segments) -> tuple[Tensor, Tensor]:
    """Return the rotations (3, 3, A, ...) from start and end frames of arcs to the base frame."""
    _, x, y, c, f, g, *_ = segments
    x_row, y_row, z_row = rotation_of(x, y, c, f, g)
    steps = vectors([*x_row, *y_row, *z_row])
    ends = [steps[:, :, 0]]
    for step in steps.unbind(2)[1:]:
        ends.append(_rotated(ends[-1][:, :, None], step))
    base = identity(3, x).reshape(3, 3, *[1] * (x.ndim - 1)).expand_as(ends[0])
    return torch.stack([base, *ends[:-1]], dim=2), torch.stack(ends, dim=2)


def _second_derivatives(tail: Tensor, segments: Segments, down: Tensor) -> tuple[Tensor, Tensor]:
    """Return second derivatives of d . p, the point p of an end frame along a direction d.

    Those by l and b_i are (2, ...), those by b_i and b_j (2, 2, ...); the tail v = (v_xy, v_z) and
    d (3, ...) are constant. With beta = d_xy . b and functions of |b|^2, d . p is

        P e + Q v_z + d_xy . v_xy,      P = beta g + d_z f,      Q = beta f + d_z c.
    """
    _, bx, by, _, f, g, c3, c4, _ = segments
    b = torch.stack([bx, by])
    square = (b * b).sum(0)
    c5, c6 = next_stumpff(square, c3, c4)
    d, dz = down[:2], down[2]
    v, vz = tail[:2], tail[2]
    e = segments.length - (b * v).sum(0)
    beta = (d * b).sum(0)
    # First and second derivatives of f and g by |b|^2, times 2 and 4.
    f1 = c3 - g
    g1 = 2.0 * c4 - c3
    f2 = c3 - 3.0 * c4 + 3.0 * c5
    g2 = c4 - 5.0 * c5 + 8.0 * c6
    p1 = beta * g1 + dz * f1
    q1 = beta * f1 - dz * f
    P = g * d + p1 * b
    one_sided = _outer(d, (g1 * e + f1 * vz) * b) - _outer(P, v)
    along = (beta * g2 + dz * f2) * e + (beta * f2 - dz * f1) * vz
    eye = identity(2, b).reshape(2, 2, *[1] * square.ndim)
    by_bending = (
        one_sided + one_sided.transpose(0, 1) + along * _outer(b, b) + (p1 * e + q1 * vz) * eye
    )
    return P, by_bending


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, None] * b
