"""Kernels of constant curvature: lengths from arcs, tips and derivatives from arcs (torch only).

Batches come last here: lengths (S, N), bending vectors (2, S, N), vectors (3, N).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from hybridkin._numerics import Stumpff, stumpff


def tip(length: Tensor, bending: Tensor, arc: Stumpff, offsets: Tensor) -> Tensor:
    """Return the tip (3, N) in the base frame, carried from the last segment to the first."""
    across, ahead = torch.zeros_like(bending[:, 0]), torch.zeros_like(length[0])
    for k in range(len(length) - 1, -1, -1):
        b, c, f, g = bending[:, k], arc.c[k], arc.f[k], arc.g[k]
        across, ahead, _, _ = _carried(across, ahead + offsets[k], length[k], b, c, f, g)
    return torch.cat([across, ahead[None]])


def tip_and_columns(
    length: Tensor, bending: Tensor, offsets: Tensor, *, angular: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the tip (3, N) and its derivatives by (l, bx, by) of each segment, (3, 3 S, N).

    With `angular`, 3 S columns of angular velocity follow the linear ones.
    """
    arc = stumpff((bending**2).sum(0))
    slope_f, slope_g = arc.c3 - arc.g, 2.0 * arc.c4 - arc.c3  # twice the derivatives by s
    eye = torch.eye(2, dtype=length.dtype, device=length.device)[..., None]
    across, ahead = torch.zeros_like(bending[:, 0]), torch.zeros_like(length[0])
    zero = torch.zeros_like(length[0])
    linear = turning = None
    for k in range(len(length) - 1, -1, -1):
        b, c, f, g = bending[:, k], arc.c[k], arc.f[k], arc.g[k]
        before, tail = across, ahead + offsets[k]
        across, ahead, rest, m = _carried(before, tail, length[k], b, c, f, g)
        to = torch.addcmul(slope_g[k] * rest, slope_f[k], tail) * b - g * before
        n = torch.addcmul(slope_f[k] * rest, f, tail, value=-1.0)
        by_length = torch.cat([g * b, f[None]])[:, None]
        by_bending = torch.cat(
            [torch.addcmul(m * eye, b[:, None], to[None]), (n * b - f * before)[None]]
        )
        own = torch.cat([by_length, by_bending], dim=1)
        linear = own if linear is None else torch.cat([own, _turned(linear, b, c, f, g)], dim=1)
        if angular:
            x, y, c3 = *b, arc.c3[k]
            spin = [
                *(zero, -c3 * x * y, c3 * x * x - 1.0),
                *(zero, 1.0 - c3 * y * y, c3 * x * y),
                *(zero, -g * y, g * x),
            ]
            own = torch.stack(spin).unflatten(0, (3, 3))
            own = own if turning is None else torch.cat([own, _turned(turning, b, c, f, g)], dim=1)
            turning = own
    columns = [block for block in (linear, turning) if block is not None]
    return torch.cat([across, ahead[None]]), torch.cat(columns, dim=1)


def _carried(
    across: Tensor, tail: Tensor, length: Tensor, b: Tensor, c: Tensor, f: Tensor, g: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return a point of a segment's end frame in its start frame, and (e, m) of the formula.

    The point is (across, tail), (2, N) and (N,); e is the length less the tail along b, m what
    the point moves across per bending.
    """
    rest = length - (b * across).sum(0)
    m = torch.addcmul(g * rest, f, tail)
    return torch.addcmul(across, b, m), torch.addcmul(f * rest, c, tail), rest, m


def _turned(v: Tensor, b: Tensor, c: Tensor, f: Tensor, g: Tensor) -> Tensor:
    """Return vectors (3, K, N) of a segment's end frame in its start frame."""
    along = (b[:, None] * v[:2]).sum(0)
    m = torch.addcmul(f * v[2], g, along, value=-1.0)
    across = torch.addcmul(v[:2], b[:, None], m)
    return torch.cat([across, torch.addcmul(c * v[2], f, along, value=-1.0)[None]])


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


def reading_matrix(
    radii: Tensor, angles: Tensor, counts: Sequence[int], routing: str, extensible: bool
) -> Tensor:
    """Return the map from arcs to actuator lengths, bendings taken in units of 1 / radius.

    Rows are actuators; columns are the lengths (extensible chains only), then the x- and the
    y-bendings of all segments.
    """
    n_segments = len(counts)
    spans = torch.zeros(sum(counts), n_segments, dtype=radii.dtype, device=radii.device)
    row = 0
    for k, n in enumerate(counts):
        spans[row : row + n, (0 if routing == "base" else k) : k + 1] = 1.0
        row += n
    repeats = torch.tensor(counts, device=radii.device)
    own_radius = radii.repeat_interleave(repeats, output_size=sum(counts))
    lever = spans * (own_radius[:, None] / radii)
    columns = [-torch.cos(angles)[:, None] * lever, -torch.sin(angles)[:, None] * lever]
    return torch.cat([spans, *columns] if extensible else columns, dim=1)
