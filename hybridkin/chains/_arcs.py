"""Kernels of constant curvature: lengths from arcs, tips and derivatives from arcs.

The batch comes last here: lengths (S, N), bending vectors (2, S, N), vectors (3, N). Formulas are
in components: `fma(a, b, c)` is a + b c and `fms(a, b, c)` is a - b c.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.stumpff import Stumpff, stumpff

Vector = tuple[Tensor, Tensor, Tensor]  # x, y, z
Bending = tuple[Tensor, Tensor]  # x, y

fma = torch.addcmul
fms = partial(torch.addcmul, value=-1.0)


class _Carried(NamedTuple):
    """A point in the start frame of a segment, and values that its derivatives use."""

    point: Vector  # in the start frame
    tail: Vector  # in the end frame, including the rigid offset
    rest: Tensor  # length minus the component of the tail along the bending
    across: Tensor  # transverse motion of the point per bending


def _carried(
    point: Vector, length: Tensor, b: Bending, arc: Stumpff, offset: Tensor
) -> _Carried:
    """Return a point, given in the frame after a segment's offset, in the segment's start frame."""
    x, y, z = point
    c, f, g, _, _ = arc
    z = z + offset
    rest = fms(fms(length, b[0], x), b[1], y)
    m = fma(g * rest, f, z)
    start = fma(x, b[0], m), fma(y, b[1], m), fma(f * rest, c, z)
    return _Carried(start, (x, y, z), rest, m)


def _columns(at: _Carried, b: Bending, arc: Stumpff) -> tuple[Vector, Vector, Vector]:
    """Return the derivatives of a carried point with respect to the segment's (l, bx, by)."""
    bx, by = b
    x, y, z = at.tail
    m = at.across
    _, f, g, c3, c4 = arc
    # twice the derivatives df/ds, dg/ds
    slope_f = c3 - g
    slope_g = 2.0 * c4 - c3
    to = fma(slope_g * at.rest, slope_f, z)
    n = fms(slope_f * at.rest, f, z)
    to_x = fms(to * bx, g, x)
    to_y = fms(to * by, g, y)
    return (
        (g * bx, g * by, f),
        (fma(m, bx, to_x), by * to_x, fms(n * bx, f, x)),
        (bx * to_y, fma(m, by, to_y), fms(n * by, f, y)),
    )


def _turned(v: Sequence[Tensor], b: Bending, arc: Stumpff) -> Vector:
    """Return vectors, given in a segment's end frame, in its start frame."""
    c, f, g, _, _ = arc
    along = fma(b[0] * v[0], b[1], v[1])
    m = fms(f * v[2], g, along)
    return fma(v[0], b[0], m), fma(v[1], b[1], m), fms(c * v[2], f, along)


def tip(
    length: Tensor, bending: Tensor, offsets: Tensor, beside: Sequence[float]
) -> Tensor:
    """Return the tip (3, N) in the base frame, transformed from the last segment to the first.

    `beside` is the position of the tip in the frame after the last rigid offset [m].
    """
    return torch.stack(_all_carried(length, bending, offsets, beside)[0][0].point)


def tip_and_columns(
    length: Tensor,
    bending: Tensor,
    offsets: Tensor,
    beside: Sequence[float] = (0.0, 0.0, 0.0),
    *,
    angular: bool = False,
    rigid: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return the tip (3, N) and its derivatives by the arcs of the segments, (3, 3 S, N).

    Columns belong to the lengths of all segments, then the x-, then the y-bendings. `angular` adds
    3 S columns of angular velocity, `rigid` adds S columns for the offsets.
    """
    carried, segments, (x, y), arc = _all_carried(length, bending, offsets, beside)
    tx, ty, tz = (
        torch.stack(axis) for axis in zip(*(at.tail for at in carried), strict=True)
    )
    rest = torch.stack([at.rest for at in carried])
    across = torch.stack([at.across for at in carried])
    # Columns of all segments in their own start frames, then turned by all earlier segments.
    at = _Carried(carried[0].point, (tx, ty, tz), rest, across)
    entries = [entry for column in _columns(at, (x, y), arc) for entry in column]
    if angular:
        entries += _spins(x, y, arc)
    if rigid:
        entries += [arc.f * x, arc.f * y, arc.c]
    columns = torch.stack(entries).unflatten(0, (-1, 3)).transpose(0, 1)
    turned = columns[:, :, -1:]
    for k in range(len(length) - 2, -1, -1):
        ahead = torch.stack(_turned(turned.unbind(), *segments[k]))
        turned = torch.cat([columns[:, :, k : k + 1], ahead], dim=2)
    return torch.stack(carried[0].point), turned.flatten(1, 2)


def _all_carried(
    length: Tensor, bending: Tensor, offsets: Tensor, beside: Sequence[float]
) -> tuple[list[_Carried], list[tuple[Bending, Stumpff]], Bending, Stumpff]:
    """Return the tip in the start frame of every segment, and the segments' bendings and arcs.

    Bendings and arcs are returned segment by segment, then stacked.
    """
    x, y = bending.unbind()
    arc = stumpff(torch.addcmul(x * x, y, y))
    bends = [*zip(x.unbind(), y.unbind(), strict=True)]
    arcs = [
        Stumpff(*each) for each in zip(*(part.unbind() for part in arc), strict=True)
    ]
    segments = [*zip(bends, arcs, strict=True)]
    zero = torch.zeros_like(length[0])
    point = (zero + beside[0], zero + beside[1], zero + beside[2])
    carried = []
    parts = [*zip(length.unbind(), segments, offsets.unbind(), strict=True)]
    for of_length, (b, of_arc), offset in reversed(parts):
        carried.append(_carried(point, of_length, b, of_arc, offset))
        point = carried[-1].point
    return carried[::-1], segments, (x, y), arc


def _spins(x: Tensor, y: Tensor, arc: Stumpff) -> list[Tensor]:
    """Return the nine entries of the angular velocity per (l, bx, by), each (S, N)."""
    zero = torch.zeros_like(x)
    c3 = arc.c3
    g = arc.g
    by_x = -c3 * x * y, 1.0 - c3 * y * y, -g * y
    by_y = c3 * x * x - 1.0, c3 * x * y, g * x
    return [zero, zero, zero, *by_x, *by_y]


def transforms(length: Tensor, bending: Tensor, offsets: Tensor) -> Tensor:
    """Return the transforms (..., S, 4, 4) from segment ends after offsets to segment starts."""
    arc = stumpff(bending.square().sum(-1))
    x, y = bending.unbind(-1)
    zero = torch.zeros_like(x)
    ones = torch.ones_like(x)
    fx = arc.f * x
    fy = arc.f * y
    gxy = -arc.g * x * y
    across = length * arc.g + offsets * arc.f
    entries = [
        *(1.0 - arc.g * x * x, gxy, fx, across * x),
        *(gxy, 1.0 - arc.g * y * y, fy, across * y),
        *(-fx, -fy, arc.c, length * arc.f + offsets * arc.c),
        *(zero, zero, zero, ones),
    ]
    return torch.stack(entries, dim=-1).unflatten(-1, (4, 4))


def levers(radii: Tensor, angles: Tensor, counts: Sequence[int]) -> Tensor:
    """Return the position of every actuator in its segment's cross-section (..., 2, n) [m].

    The inputs may have the same leading dimensions.
    """
    repeats = torch.tensor(counts, device=radii.device)
    radius = radii.repeat_interleave(repeats, dim=-1, output_size=sum(counts))
    return torch.stack([radius * angles.cos(), radius * angles.sin()], dim=-2)


def reading_matrix(
    levers: Tensor, counts: Sequence[int], starts: Sequence[int]
) -> Tensor:
    """Return the linear map from arcs to actuator lengths, (..., n, 3 S).

    Columns are the lengths, then the x- and the y-bendings of all segments. Actuators of segment k
    run through the segments from `starts[k]` to k.
    """
    spans = levers.new_zeros(sum(counts), len(counts))
    row = 0
    for k, (n, start) in enumerate(zip(counts, starts, strict=True)):
        spans[row : row + n, start : k + 1] = 1.0
        row += n
    x, y = (-levers[..., None] * spans).unbind(-3)
    return torch.cat([spans.expand_as(x), x, y], dim=-1)


def bend_readings(angles: Tensor, extensible: bool) -> Tensor:
    """Return how a segment's bending changes the lengths of its n actuators, (2, n) [-].

    Rows are x and y. Without the mean if the segment is extensible: that is a change of its length.
    """
    at = torch.stack([angles.cos(), angles.sin()])
    return at - at.mean(dim=1, keepdim=True) if extensible else at


def free_arcs(
    angles: Sequence[Tensor], extensible: Sequence[bool], bends: Sequence[int]
) -> Tensor:
    """Return the projector (3 S, 3 S) on the arcs that the actuators of each segment determine.

    These are its length if it is extensible, and `bends` components of its bending: both, none, or
    the one in the plane of its actuators.
    """
    S = len(bends)
    counts = [*map(float, extensible), *(0.5 * n for n in (*bends, *bends))]
    # Not new_tensor: before torch 2.5 it does not work in functional transforms.
    free = torch.diag(
        torch.tensor(counts, dtype=angles[0].dtype, device=angles[0].device)
    )
    for k in (k for k in range(S) if bends[k] == 1):
        # In a plane at the angle psi: [[1 + cos 2 psi, sin 2 psi], [sin 2 psi, 1 - cos 2 psi]] / 2.
        x, y = bend_readings(angles[k], extensible[k])
        a = (x * x - y * y).sum()
        b = 2.0 * (x * y).sum()
        plane = torch.stack([a, b, b, -a]).reshape(2, 2) / (2.0 * torch.hypot(a, b))
        at = identity(3 * S, free)[[S + k, 2 * S + k]]
        free = free + at.T @ plane @ at
    return free


def rolled(poses: Tensor, angle: Tensor) -> Tensor:
    """Return poses (..., K, 4, 4), all but the first turned by an angle (..., 1) about own z."""
    moves = torch.arange(poses.shape[-3], device=poses.device) > 0
    angle = (angle * moves)[..., None, None]
    c = angle.cos()
    s = angle.sin()
    x, y, rest = poses.split([1, 1, 2], dim=-1)
    return torch.cat([c * x + s * y, c * y - s * x, rest], dim=-1)


def turned_by_first(arcs: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Return arcs (3 S, N) with all bendings turned by an angle [rad] given as the first length.

    That length becomes zero. `slope` (3 S, K, N) holds changes of the arcs; the changes of the
    turned arcs are returned too.
    """
    S = len(arcs) // 3
    c = arcs[0].cos()
    s = arcs[0].sin()
    slope = slope.expand(-1, -1, arcs.shape[1])
    turned = [0.0 * arcs[:1], arcs[1:S]]
    moved = [0.0 * slope[:1], slope[1:S]]
    x, y = arcs[S:].chunk(2)
    dx, dy = slope[S:].chunk(2)
    for a, b, da, db in ((x, -y, dx, -dy), (y, x, dy, dx)):
        turned.append(c * a + s * b)
        moved.append(c * da + s * db + (c * b - s * a)[:, None] * slope[0])
    return torch.cat(turned), torch.cat(moved)
