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
    bx, by = bending
    vx = vy = torch.zeros_like(length[0])
    vz = vx
    for k in range(len(length) - 1, -1, -1):
        vz = vz + offsets[k]
        ahead = length[k] - (bx[k] * vx + by[k] * vy)
        m = arc.g[k] * ahead + arc.f[k] * vz
        vx, vy = vx + bx[k] * m, vy + by[k] * m
        vz = arc.f[k] * ahead + arc.c[k] * vz
    return torch.stack([vx, vy, vz])


def tip_and_columns(
    length: Tensor, bending: Tensor, offsets: Tensor, *, angular: bool = False
) -> tuple[Tensor, Tensor]:
    """Return the tip (3, N) and its derivatives by (l, bx, by) of each segment, (3, 3 S, N).

    With `angular`, 3 S columns of angular velocity follow the linear ones.
    """
    arc = stumpff((bending**2).sum(0))
    bx, by = bending
    zero = torch.zeros_like(length[0])
    vx = vy = vz = zero
    linear: list[Tensor] = []
    turning: list[Tensor] = []
    for k in range(len(length) - 1, -1, -1):
        x, y, c, f, g, c3 = bx[k], by[k], arc.c[k], arc.f[k], arc.g[k], arc.c3[k]
        vz = vz + offsets[k]
        ahead = length[k] - (x * vx + y * vy)
        m = g * ahead + f * vz
        by_s = (2.0 * arc.c4[k] - c3) * ahead + (c3 - g) * vz
        n = (c3 - g) * ahead - f * vz
        to_x, to_y = by_s * x - g * vx, by_s * y - g * vy
        own = [
            torch.stack([g * x, g * y, f]),
            torch.stack([m + x * to_x, y * to_x, n * x - f * vx]),
            torch.stack([x * to_y, m + y * to_y, n * y - f * vy]),
        ]
        later = [_turn(column, x, y, c, f, g) for column in linear]
        linear = own + later
        if angular:
            spin = [
                torch.stack([zero, zero, zero]),
                torch.stack([-c3 * x * y, 1.0 - c3 * y * y, -g * y]),
                torch.stack([c3 * x * x - 1.0, c3 * x * y, g * x]),
            ]
            turning = spin + [_turn(column, x, y, c, f, g) for column in turning]
        vx, vy = vx + x * m, vy + y * m
        vz = f * ahead + c * vz
    return torch.stack([vx, vy, vz]), torch.stack(linear + turning, dim=1)


def _turn(v: Tensor, x: Tensor, y: Tensor, c: Tensor, f: Tensor, g: Tensor) -> Tensor:
    """Return vectors (3, N) of a segment's end frame in its start frame."""
    along = x * v[0] + y * v[1]
    m = f * v[2] - g * along
    return torch.stack([v[0] + x * m, v[1] + y * m, c * v[2] - f * along])


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
