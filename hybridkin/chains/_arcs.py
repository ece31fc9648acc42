"""Kernels of constant curvature: lengths from arcs, tips and derivatives from arcs.

Batches come last here: lengths (S, N), bending vectors (2, S, N), vectors (3, N). The formulas are
written once, by components, for tensors and for plain numbers: `fma(a, b, c)` is a + b c and
`fms(a, b, c)` is a - b c.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.stumpff import Stumpff, stumpff, stumpff_of_number

Vector = tuple[Any, ...]  # x, y, z


class _Arithmetic(NamedTuple):
    fma: Callable[[Any, Any, Any], Any]
    fms: Callable[[Any, Any, Any], Any]


_TENSORS = _Arithmetic(torch.addcmul, partial(torch.addcmul, value=-1.0))
_NUMBERS = _Arithmetic(lambda a, b, c: a + b * c, lambda a, b, c: a - b * c)


class _Carried(NamedTuple):
    """A point in the start frame of a segment, and what its derivatives need."""

    point: Vector  # in the start frame
    tail: Vector  # in the end frame, the rigid offset included
    rest: Any  # length less the tail along the bending
    across: Any  # how far the point moves across, per bending


def _carried(
    by: _Arithmetic, point: Vector, length: Any, b: Any, arc: Any, offset: Any
) -> _Carried:
    """Return a point of the frame after a segment's rigid offset in the segment's start frame."""
    x, y, z = point
    c, f, g, _, _ = arc
    z = z + offset
    rest = by.fms(by.fms(length, b[0], x), b[1], y)
    m = by.fma(g * rest, f, z)
    start = by.fma(x, b[0], m), by.fma(y, b[1], m), by.fma(f * rest, c, z)
    return _Carried(start, (x, y, z), rest, m)


def _columns(by: _Arithmetic, at: _Carried, b: Any, arc: Any) -> tuple[Vector, ...]:
    """Return the derivatives of a carried point by (l, bx, by) of the segment."""
    (bx, by_), (x, y, z), m = b, at.tail, at.across
    _, f, g, c3, c4 = arc
    slope_f, slope_g = c3 - g, 2.0 * c4 - c3  # twice the derivatives by s
    to = by.fma(slope_g * at.rest, slope_f, z)
    n = by.fms(slope_f * at.rest, f, z)
    to_x, to_y = by.fms(to * bx, g, x), by.fms(to * by_, g, y)
    return (
        (g * bx, g * by_, f),
        (by.fma(m, bx, to_x), by_ * to_x, by.fms(n * bx, f, x)),
        (bx * to_y, by.fma(m, by_, to_y), by.fms(n * by_, f, y)),
    )


def _turned(by: _Arithmetic, v: Any, b: Any, arc: Any) -> Vector:
    """Return vectors of a segment's end frame in its start frame."""
    c, f, g, _, _ = arc
    along = by.fma(b[0] * v[0], b[1], v[1])
    m = by.fms(f * v[2], g, along)
    return by.fma(v[0], b[0], m), by.fma(v[1], b[1], m), by.fms(c * v[2], f, along)


def tip(length: Tensor, bending: Tensor, offsets: Tensor) -> Tensor:
    """Return the tip (3, N) in the base frame, carried from the last segment to the first."""
    x, y = bending.unbind()
    arc = stumpff(torch.addcmul(x * x, y, y))
    return torch.stack(_all_carried(length, (x, y), arc, offsets)[0][0].point)


def tip_and_columns(
    length: Tensor,
    bending: Tensor,
    offsets: Tensor,
    *,
    angular: bool = False,
    rigid: bool = False,
) -> tuple[Tensor, Tensor]:
    """Return the tip (3, N) and its derivatives by the arcs of the segments, (3, 3 S, N).

    Columns are the lengths of all segments, then the x-, then the y-bendings. With `angular`,
    3 S columns of angular velocity follow, with `rigid`, S columns for the offsets.
    """
    x, y = bending.unbind()
    arc = stumpff(torch.addcmul(x * x, y, y))
    carried, segments = _all_carried(length, (x, y), arc, offsets)
    tails = tuple(torch.stack(axis) for axis in zip(*(at.tail for at in carried), strict=True))
    rest = torch.stack([at.rest for at in carried])
    across = torch.stack([at.across for at in carried])
    # The segments' own columns all at once, then turned by every segment before them.
    at = _Carried(carried[0].point, tails, rest, across)
    entries = [entry for column in _columns(_TENSORS, at, (x, y), arc) for entry in column]
    if angular:
        entries += _spins(x, y, arc)
    if rigid:
        entries += [arc.f * x, arc.f * y, arc.c]
    columns = torch.stack(entries).unflatten(0, (-1, 3)).transpose(0, 1)
    turned = columns[:, :, -1:]
    for k in range(len(length) - 2, -1, -1):
        ahead = torch.stack(_turned(_TENSORS, turned.unbind(), *segments[k]))
        turned = torch.cat([columns[:, :, k : k + 1], ahead], dim=2)
    return torch.stack(carried[0].point), turned.flatten(1, 2)


def _all_carried(
    length: Tensor, bending: tuple[Tensor, Tensor], arc: Stumpff, offsets: Tensor
) -> tuple[list[_Carried], list[tuple[Any, Any]]]:
    """Return the tip in the start frame of every segment, and each segment's bending and arc."""
    bends, arcs = (
        [*zip(*(part.unbind() for part in parts), strict=True)] for parts in (bending, arc)
    )
    zero = torch.zeros_like(length[0])
    point, carried = (zero, zero, zero), []
    parts = [*zip(length.unbind(), bends, arcs, offsets.unbind(), strict=True)]
    for of_length, b, of_arc, offset in reversed(parts):
        carried.append(_carried(_TENSORS, point, of_length, b, of_arc, offset))
        point = carried[-1].point
    return carried[::-1], [*zip(bends, arcs, strict=True)]


def _spins(x: Tensor, y: Tensor, arc: Stumpff) -> list[Tensor]:
    """Return the nine entries of the angular velocity by (l, bx, by), each (S, N)."""
    zero, c3, g = torch.zeros_like(x), arc.c3, arc.g
    by_x = -c3 * x * y, 1.0 - c3 * y * y, -g * y
    by_y = c3 * x * x - 1.0, c3 * x * y, g * x
    return [zero, zero, zero, *by_x, *by_y]


def tip_and_columns_of_numbers(
    arcs: NDArray, offsets: Sequence[float]
) -> tuple[Vector, list[list[float]]]:
    """Return the tip and its derivatives for one configuration, in plain numbers.

    `arcs` holds 3 S numbers: lengths, x- and y-bendings. The columns come as three rows of 3 S
    numbers in the same order; see `tip_and_columns`.
    """
    n = len(offsets)
    numbers = arcs.tolist()
    lengths, bendings = numbers[:n], list(zip(numbers[n : 2 * n], numbers[2 * n :], strict=True))
    point, columns = (0.0, 0.0, 0.0), []
    for k in range(n - 1, -1, -1):
        b = bendings[k]
        arc = stumpff_of_number(b[0] * b[0] + b[1] * b[1])
        at = _carried(_NUMBERS, point, lengths[k], b, arc, offsets[k])
        point = at.point
        columns = [_turned(_NUMBERS, column, b, arc) for column in columns]
        columns = [*_columns(_NUMBERS, at, b, arc), *columns]
    ordered = [columns[3 * k + j] for j in range(3) for k in range(n)]
    return point, [list(row) for row in zip(*ordered, strict=True)]


def arc_transforms(length: Tensor, bending: Tensor, offsets: Tensor) -> Tensor:
    """Return the transforms (..., S, 4, 4) from segment ends, offsets included, to their starts."""
    arc = stumpff(bending.square().sum(-1))
    x, y = bending.unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    fx, fy, gxy = arc.f * x, arc.f * y, -arc.g * x * y
    px, py = (length * arc.g + offsets * arc.f) * x, (length * arc.g + offsets * arc.f) * y
    entries = [
        *(1.0 - arc.g * x * x, gxy, fx, px),
        *(gxy, 1.0 - arc.g * y * y, fy, py),
        *(-fx, -fy, arc.c, length * arc.f + offsets * arc.c),
        *(zero, zero, zero, one),
    ]
    return torch.stack(entries, dim=-1).unflatten(-1, (4, 4))


def levers(radii: Tensor, angles: Tensor, counts: Sequence[int]) -> Tensor:
    """Return where every actuator crosses its segment's cross-section (..., 2, n) [m].

    The inputs may carry leading dimensions alike.
    """
    repeats = torch.tensor(counts, device=radii.device)
    radius = radii.repeat_interleave(repeats, dim=-1, output_size=sum(counts))
    return torch.stack([radius * angles.cos(), radius * angles.sin()], dim=-2)


def reading_matrix(levers: Tensor, counts: Sequence[int], routing: str, extensible: bool) -> Tensor:
    """Return the linear map from arcs to actuator lengths, (..., n, 3 S) or (..., n, 2 S).

    Columns are the lengths (extensible chains only), then the x- and the y-bendings of all
    segments.
    """
    n_segments = len(counts)
    spans = levers.new_zeros(sum(counts), n_segments)
    row = 0
    for k, n in enumerate(counts):
        spans[row : row + n, (0 if routing == "base" else k) : k + 1] = 1.0
        row += n
    x, y = (-levers[..., None] * spans).unbind(-3)
    return torch.cat([spans.expand_as(x), x, y] if extensible else [x, y], dim=-1)
