"""From the arcs of a chain to the position of its tip, and the derivatives.

The batch comes last: lengths (S, ...), vectors as three tensors x, y, z. The formulas are those of
docs/theory.md, "Constant curvature": a segment of length l and bending b takes a vector v, given
in its end frame, into its start frame by

    e = l - b . v_xy      m = g e + f v_z      (v_xy + m b,  f e + c v_z)

with l = 0 for directions. `fma(a, b, c)` is a + b c and `fms(a, b, c)` is a - b c, in one pass
over the memory.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor, nn

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


class WorkOfGravity:
    """Work of gravity on the weights of arcs, from the base frame to their centres, by the arcs.

    The weights (A,) act half way along the arcs; `down` (3,) is a direction in the base frame. In
    the end frame of an arc, the later weights have the moment M, the sum of weight times position.
    In the start frame it is R M + W t, with the weight W after the arc and its end point t: the
    formulas of a tail v, with W l instead of l.
    """

    def __init__(self, segments: Segments, weights: Tensor, down: Tensor) -> None:
        self.segments = segments
        self._weights = weights[:, None]
        after = weights.flip(0).cumsum(0).flip(0) - weights
        self._after = after[:, None]
        self._each = segments.each()
        self._down = down

        # Moments of the weights of the arcs themselves, at their centres.
        half = self._half(segments)
        direction = torch.stack([half.g * half.x, half.g * half.y, half.f])
        centres = (half.length * direction).unbind(1)

        # Then from the last arc to the base.
        moment = torch.zeros_like(centres[0])
        moments = []
        for k in range(len(self._each) - 1, -1, -1):
            segment = self._each[k]
            x, y, z = moment
            at_end = torch.stack([x, y, z + after[k] * segment.offset])
            moments.append(at_end)
            length = after[k] * segment.length
            moved = _in_start_frame(at_end.unbind(), segment, length)
            moment = torch.stack([*moved]) + centres[k]
        self._moments = torch.stack(moments[::-1], dim=1)  # (3, A, N)
        self.value = torch.tensordot(down, moment, 1)

    def _half(self, segments: Segments) -> Segments:
        """Return the first halves of the arcs, with lengths times the weights of the arcs."""
        length = self._weights * segments.length
        halves = 0.5 * torch.cat([length, segments.x, segments.y])
        return segments_of(halves, segments.offset)

    def _local_columns(self, segments: Segments) -> Tensor:
        """Return derivatives (3, 3, A, N) of moments in start frames, by l, b_x, b_y, as vectors.

        The moments in the end frames stay the same.
        """
        heavy = segments._replace(length=self._after * segments.length)
        later = _vectors(_columns(self._moments.unbind(), heavy))
        half = self._half(segments)
        zero = torch.zeros_like(half.x)
        centre = 0.5 * _vectors(_columns((zero, zero, zero), half))
        by_length = self._after * later[:1] + self._weights * centre[:1]
        by_bending = later[1:] + centre[1:]
        return torch.cat([by_length, by_bending])

    def _downs(self) -> Tensor:
        """Return the direction of gravity in the start frames of the arcs, (3, A, N)."""
        zero = torch.zeros_like(self._each[0].length)
        down: Vector = [zero + component for component in self._down]
        downs = []
        for segment in self._each:
            downs.append(torch.stack([*down]))
            inverse = segment._replace(x=-segment.x, y=-segment.y)
            down = _in_start_frame(down, inverse, 0.0)
        return torch.stack(downs, dim=1)

    def gradient(self) -> Tensor:
        """Return the derivative (3 A, N) by the arcs: lengths, then x-, then y-bendings."""
        columns = self._local_columns(self.segments)
        return (columns * self._downs()).sum(1).flatten(0, 1)

    def hessian(self) -> Tensor:
        """Return the second derivative (3 A, 3 A, N) by the arcs."""
        downs = self._downs()
        columns = self._local_columns(self.segments)
        columns = columns.transpose(0, 1)  # (3 vector, 3, A, N)

        # Of each arc with the later ones: the bending turns their moments.
        later = columns[:, :, :0]  # in the end frame of the present arc
        rows = []
        for k in range(len(self._each) - 1, -1, -1):
            segment = self._each[k]
            weightless = segment._replace(length=torch.zeros_like(segment.length))
            by_bending = _vectors(_columns(later.unbind(), weightless)[3:])
            by_later = torch.einsum("jciln,cn->jiln", by_bending, downs[:, k])
            rows.append(nn.functional.pad(by_later, (0, 0, k + 1, 0, 0, 0, 1, 0)))
            later = _with_later(columns[:, :, k : k + 1], later, segment)
        upper = torch.stack(rows[::-1], dim=1)  # (3, A, 3, A, N)
        upper = upper.flatten(2, 3).flatten(0, 1)

        within = self._within(downs).transpose(2, 3).diag_embed()  # (3, 3, N, A, A)
        within = within.permute(0, 3, 1, 4, 2).flatten(2, 3).flatten(0, 1)
        return upper + upper.transpose(0, 1) + within

    def _within(self, downs: Tensor) -> Tensor:
        """Return the second derivatives (3, 3, A, N) by the arcs, each with itself."""
        offset = self.segments.offset

        def slope(arcs: Tensor) -> Tensor:
            segments = segments_of(arcs.flatten(0, 1), offset)
            return (self._local_columns(segments) * downs).sum(1)

        arcs = torch.stack([self.segments.length, self.segments.x, self.segments.y])
        # Backward: in forward mode torch decomposes addcmul in Python, which is slow.
        backward = torch.func.vjp(slope, arcs)[1]
        seconds = []
        for kind in range(3):
            chosen = torch.zeros_like(arcs)
            chosen[kind] = 1.0
            seconds.append(backward(chosen)[0])
        return torch.stack(seconds)


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
    entries = _columns((x, y, z + segments.offset), segments)
    if angular:
        entries += _spins(segments)
    if rigid:  # the tangents
        entries += [segments.f * segments.x, segments.f * segments.y, segments.c]

    # All columns in the start frames of their own segments, then turned by all earlier segments.
    columns = _vectors(entries).transpose(0, 1)
    turned = columns[:, :, -1:]
    for k in range(len(each) - 2, -1, -1):
        turned = _with_later(columns[:, :, k : k + 1], turned, each[k])
    return torch.stack([*in_base]), turned.flatten(1, 2)


def _vectors(entries: list[Tensor]) -> Tensor:
    """Return vectors (K, 3, ...), given as x, y, z one after the other."""
    return torch.stack(entries).unflatten(0, (-1, 3))


def _with_later(columns: Tensor, later: Tensor, segment: Segments) -> Tensor:
    """Return columns of a segment, and those of all later ones turned into its start frame."""
    turned = _in_start_frame(later.unbind(), segment, 0.0)
    return torch.cat([columns, torch.stack([*turned])], dim=2)


def _columns(tail: Vector, segments: Segments) -> list[Tensor]:
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


def _spins(segments: Segments) -> list[Tensor]:
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
    xy = -g * x * y
    x_row = [1.0 - g * x * x, xy, f * x, across * x]
    y_row = [xy, 1.0 - g * y * y, f * y, across * y]
    z_row = [-f * x, -f * y, c, along]
    last_row = [zero, zero, zero, torch.ones_like(x)]
    entries = [*x_row, *y_row, *z_row, *last_row]
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
