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
from functools import cached_property, partial
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.stumpff import next_stumpff, stumpff

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
        ends = _vectors(_columns(tool, self.segments)).transpose(0, 1)
        centres = _vectors(_columns((zero, zero, zero), self._half)).transpose(0, 1)
        own = self._after * ends + 0.5 * self._weights * centres
        starts = self._starts[:, :, None]
        local_spins = _vectors(_spins(self.segments)).transpose(0, 1)
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
    x_row, y_row, z_row = _rotation(x, y, c, f, g)
    steps = _vectors([*x_row, *y_row, *z_row])
    ends = [steps[:, :, 0]]
    for step in steps.unbind(2)[1:]:
        ends.append(_rotated(ends[-1][:, :, None], step))
    base = identity(3, x).reshape(3, 3, *[1] * (x.ndim - 1)).expand_as(ends[0])
    return torch.stack([base, *ends[:-1]], dim=2), torch.stack(ends, dim=2)


def _rotation(
    x: Tensor, y: Tensor, c: Tensor, f: Tensor, g: Tensor
) -> tuple[list[Tensor], list[Tensor], list[Tensor]]:
    """Return the rows of the rotation from the end frame of an arc to its start frame."""
    xy = -g * x * y
    x_row = [1.0 - g * x * x, xy, f * x]
    y_row = [xy, 1.0 - g * y * y, f * y]
    return x_row, y_row, [-f * x, -f * y, c]


def _second_derivatives(
    tail: Tensor, segments: Segments, down: Tensor
) -> tuple[Tensor, Tensor]:
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
        one_sided
        + one_sided.transpose(0, 1)
        + along * _outer(b, b)
        + (p1 * e + q1 * vz) * eye
    )
    return P, by_bending


def _outer(a: Tensor, b: Tensor) -> Tensor:
    return a[:, None] * b


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
    x_row, y_row, z_row = _rotation(x, y, c, f, g)
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
