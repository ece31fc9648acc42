"""From the arcs of a chain to the position of its tip, and the derivatives.

The batch comes last: lengths (S, ...), vectors as three tensors x, y, z. The formulas are those of
docs/explanation/theory.md, "Constant curvature": a segment of length l and bending b takes a vector
v, given in its end frame, into its start frame by

    e = l - b . v_xy      m = g e + f v_z      (v_xy + m b,  f e + c v_z)

with l = 0 for directions. `fma(a, b, c)` is a + b c and `fms(a, b, c)` is a - b c, in one pass
over the memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.stumpff import stumpff

Vector = Sequence[Tensor] | Tensor  # x, y, z

fma = torch.addcmul
fms = partial(torch.addcmul, value=-1.0)


class Segments(NamedTuple):
    """Arcs from base to tip, or one of them."""

    length: Tensor  # l [m]
    x: Tensor  # components of the bending vector b [rad]
    y: Tensor
    c: Tensor  # Stumpff functions of |b|^2
    f: Tensor
    g: Tensor
    c3: Tensor
    c4: Tensor
    offset: Tensor  # rigid length after the arc [m]

    def each(self) -> list[Segments]:
        """Return the segments one by one."""
        values = [part.unbind() for part in self]
        return [Segments(*parts) for parts in zip(*values, strict=True)]


def segments_of(arcs: Tensor, offsets: Tensor) -> Segments:
    """Return the segments with arcs (3 S, ...), all lengths, x- then y-bendings, and offsets."""
    length, x, y = arcs.chunk(3)
    functions = stumpff(fma(x * x, y, y))
    return Segments(length, x, y, *functions, offsets)


def _in_start_frame(v: Vector, segment: Segments, length: Tensor | float) -> Vector:
    """Return a point of the end frame (before the offset) or, with length 0, a direction."""
    x, y, z = v
    along = length - fma(segment.x * x, segment.y, y)  # e
    across = fma(segment.g * along, segment.f, z)  # m
    start_x = fma(x, segment.x, across)
    start_y = fma(y, segment.y, across)
    start_z = fma(segment.f * along, segment.c, z)
    return start_x, start_y, start_z


def _tips(segments: list[Segments], beside: Vector) -> list[Vector]:
    """Return the tip in the start frame of every segment, and in the frame at the end."""
    zero = torch.zeros_like(segments[0].length)
    tip: Vector = [zero + component for component in beside]
    tips: list[Vector] = [tip]
    for segment in reversed(segments):
        x, y, z = tip
        tip = _in_start_frame((x, y, z + segment.offset), segment, segment.length)
        tips.append(tip)
    return tips[::-1]


def tip(segments: Segments, beside: Vector) -> Tensor:
    """Return the tip (3, ...) in the base frame.

    `beside` is its position (3, ...) in the frame after the last offset [m].
    """
    in_base, *_ = _tips(segments.each(), beside)
    return torch.stack([*in_base])


def rotation_of(
    x: Tensor, y: Tensor, c: Tensor, f: Tensor, g: Tensor
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Return the rows of the rotation from the end frame of an arc to its start frame."""
    xy = -g * x * y
    x_row = [1.0 - g * x * x, xy, f * x]
    y_row = [xy, 1.0 - g * y * y, f * y]
    return x_row, y_row, [-f * x, -f * y, c]


def tip_and_columns(
    segments: Segments, beside: Vector, *, angular: bool = False, rigid: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the tip (3, ...) and its derivatives by the arcs of the segments, (3, 3 S, ...).

    Columns belong to the lengths of all segments, then the x-, then the y-bendings. `angular` adds
    3 S columns of angular velocity, `rigid` adds S columns for the offsets.
    """
    each = segments.each()
    in_base, *at_ends = _tips(each, beside)
    x, y, z = map(torch.stack, zip(*at_ends, strict=True))
    entries = columns_of((x, y, z + segments.offset), segments)
    if angular:
        entries += spins_of(segments)
    if rigid:  # the tangents
        entries += [segments.f * segments.x, segments.f * segments.y, segments.c]

    # All columns in the start frames of their own segments, then turned by all earlier segments.
    columns = vectors(entries).transpose(0, 1)
    turned = columns[:, :, -1:]
    for k in range(len(each) - 2, -1, -1):
        turned = _with_later(columns[:, :, k : k + 1], turned, each[k])
    return torch.stack([*in_base]), turned.flatten(1, 2)


def vectors(entries: list[Tensor]) -> Tensor:
    """Return vectors (K, 3, ...), given as x, y, z one after the other."""
    return torch.stack(entries).unflatten(0, (-1, 3))


def _with_later(columns: Tensor, later: Tensor, segment: Segments) -> Tensor:
    """Return columns of a segment, and those of all later ones turned into its start frame."""
    turned = _in_start_frame(later.unbind(), segment, 0.0)
    return torch.cat([columns, torch.stack([*turned])], dim=2)


def columns_of(tail: Vector, segments: Segments) -> list[Tensor]:
    """Return x, y, z of the derivatives of a point by l, b_x and b_y of the segment before it.

    The tail v is the point in the end frame. With M = 2 g' e + 2 f' v_z, N = 2 f' e - f v_z and
    X = M b - g v_xy, where ' is d / d |b|^2:

        d/dl = (g b, f)      d/db_j = (m e_j + b X_j,  N b_j - f v_j)
    """
    length, bx, by, _, f, g, c3, c4, _ = segments
    x, y, z = tail
    along = length - fma(bx * x, by, y)  # e
    across = fma(g * along, f, z)  # m
    slope_f = c3 - g  # 2 f'
    slope_g = 2.0 * c4 - c3  # 2 g'
    M = fma(slope_g * along, slope_f, z)
    N = fms(slope_f * along, f, z)
    X = fms(M * bx, g, x)
    Y = fms(M * by, g, y)
    by_bx = [fma(across, bx, X), by * X, fms(N * bx, f, x)]
    by_by = [bx * Y, fma(across, by, Y), fms(N * by, f, y)]
    return [g * bx, g * by, f, *by_bx, *by_by]


def spins_of(segments: Segments) -> list[Tensor]:
    """Return x, y, z of the angular velocity of a segment's end by its l, b_x and b_y.

    With the rotation vector phi = (-b_y, b_x, 0) this is the left Jacobian J_l(phi) dphi.
    """
    _, x, y, _, _, g, c3, *_ = segments
    zero = torch.zeros_like(x)
    xy = c3 * x * y
    by_bx = [-xy, 1.0 - c3 * y * y, -g * y]
    by_by = [c3 * x * x - 1.0, xy, g * x]
    return [zero, zero, zero, *by_bx, *by_by]


def transforms(length: Tensor, bending: Tensor, offsets: Tensor) -> Tensor:
    """Return the transforms (..., S, 4, 4) from segment ends after offsets to segment starts."""
    c, f, g, _, _ = stumpff(bending.square().sum(-1))
    x, y = bending.unbind(-1)
    zero = torch.zeros_like(x)
    across = length * g + offsets * f
    along = length * f + offsets * c
    x_row, y_row, z_row = rotation_of(x, y, c, f, g)
    entries = [*x_row, across * x, *y_row, across * y, *z_row, along]
    entries += [zero, zero, zero, torch.ones_like(x)]
    return torch.stack(entries, dim=-1).unflatten(-1, (4, 4))


def rolled(poses: Tensor, angle: Tensor) -> Tensor:
    """Return poses (..., K, 4, 4), all but the first turned by an angle (..., 1) about own z."""
    moves = torch.arange(poses.shape[-3], device=poses.device) > 0
    angle = (angle * moves)[..., None, None]
    c = angle.cos()
    s = angle.sin()
    x, y, others = poses.split([1, 1, 2], dim=-1)
    return torch.cat([c * x + s * y, c * y - s * x, others], dim=-1)


def turned_by_first(arcs: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Return arcs (3 S, N) with all bendings turned by an angle [rad] given as the first length.

    That length becomes zero. `slope` (3 S, K, N) holds changes of the arcs; the changes of the
    turned arcs are returned too.
    """
    length, x, y = arcs.chunk(3)
    d_length, dx, dy = slope.expand(-1, -1, arcs.shape[1]).chunk(3)
    angle, *lengths = length
    d_angle, *d_lengths = d_length
    c = angle.cos()
    s = angle.sin()
    turned_x = c * x - s * y
    turned_y = s * x + c * y
    d_turned_x = c * dx - s * dy - turned_y[:, None] * d_angle
    d_turned_y = s * dx + c * dy + turned_x[:, None] * d_angle

    no_length = torch.zeros_like(angle)
    turned = torch.stack([no_length, *lengths, *turned_x, *turned_y])
    unchanged = torch.zeros_like(d_angle)
    d_turned = torch.stack([unchanged, *d_lengths, *d_turned_x, *d_turned_y])
    return turned, d_turned
