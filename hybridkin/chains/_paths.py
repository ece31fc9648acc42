"""The paths of actuators along a chain: what their lengths tell about the arcs."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity, one_of
from hybridkin._core.constants import constant

_DETERMINED = 1e-6  # smallest relative reading that determines a direction of bending


def path_starts(routing: str, counts: Sequence[int], extensible: Sequence[bool]) -> tuple[int, ...]:
    """Return the first segment that the actuators of each segment run through.

    Actuators carried by a rigid stage start after it.
    """
    one_of(routing, "routing", ("segment", "base"))
    segments = range(len(counts))
    if routing == "segment":
        return (*segments,)
    first = 0
    starts = []
    kinds = set()
    for k in segments:
        starts.append(first)
        if extensible[k] and counts[k] == 1:  # a stage
            first = k + 1
        else:
            kinds.add(extensible[k])
    if len(kinds) > 1:
        raise ValueError(
            "`routing` must be 'segment' if tendons would run through extensible segments of "
            "several actuators, or the reverse, got 'base'; their lengths would not be defined."
        )
    return tuple(starts)


def reading_matrix(
    radii: Tensor, angles: Tensor, counts: Sequence[int], starts: Sequence[int]
) -> Tensor:
    """Return the linear map (n, 3 S) from arcs to actuator lengths.

    An actuator at the angle psi on the radius r reads ``l - r (b_x cos psi + b_y sin psi)``, summed
    over the segments from `starts[k]` to its own, k. Columns are the lengths, then the x- and the
    y-bendings of all segments.
    """
    spans = constant(_spans(tuple(counts), tuple(starts)), radii)
    return torch.cat([spans, bend_matrix(radii, angles, counts, starts)], dim=-1)


def bend_matrix(
    radii: Tensor, angles: Tensor, counts: Sequence[int], starts: Sequence[int]
) -> Tensor:
    """Return the columns (..., n, 2 S) of the bendings of the `reading_matrix`."""
    segment = constant(_segments(tuple(counts)), radii, torch.long)
    radius = -radii.index_select(-1, segment)
    spans = constant(_spans(tuple(counts), tuple(starts)), radii)
    x = (radius * angles.cos())[..., None]
    y = (radius * angles.sin())[..., None]
    return torch.cat([x * spans, y * spans], dim=-1)


def _segments(counts: tuple[int, ...]) -> tuple[int, ...]:
    """Return the segment (n,) of every actuator."""
    segments = [k for k, count in enumerate(counts) for _ in range(count)]
    return tuple(segments)


def _spans(counts: tuple[int, ...], starts: tuple[int, ...]) -> tuple[tuple[float, ...], ...]:
    """Return which segments (n, S) every actuator runs through, as 0 and 1."""
    spans = []
    for k, count in enumerate(counts):
        row = [0.0] * len(counts)
        row[starts[k] : k + 1] = [1.0] * (k + 1 - starts[k])
        spans += [tuple(row)] * count
    return tuple(spans)


def bend_readings(angles: Tensor, extensible: bool) -> Tensor:
    """Return how a segment's bending changes the lengths of its n actuators, (2, n) [-].

    Rows are x and y. Without the mean if the segment is extensible: that is a change of its length.
    """
    readings = torch.stack([angles.cos(), angles.sin()])
    if extensible:
        return readings - readings.mean(dim=1, keepdim=True)
    return readings


def bend_extremes(angles: Tensor, extensible: bool) -> tuple[float, float]:
    """Return the largest and the smallest reading of a bending of 1 rad in any direction [-]."""
    readings = nn.functional.pad(bend_readings(angles, extensible), (0, 1))
    most, least = torch.linalg.svdvals(readings).tolist()
    return most, least


def bend_counts(angles: Sequence[Tensor], extensible: Sequence[bool]) -> tuple[int, ...]:
    """Return the number of directions in which each segment bends: 2, or 1 in a plane.

    It is 0 for an extensible segment with a single actuator.
    """
    bends = []
    for of_segment, stretches in zip(angles, extensible, strict=True):
        if stretches and len(of_segment) == 1:
            bends.append(0)
            continue
        most, least = bend_extremes(of_segment, stretches)
        planar = least <= 64.0 * torch.finfo(of_segment.dtype).eps * most
        if most < _DETERMINED or not (planar or least > _DETERMINED * most):
            raise ValueError(
                "`angles` must determine the bending of every segment, got "
                f"{[row.tolist() for row in angles]}; give the actuators of a segment clearly "
                "different angles [rad], or exactly planar ones: psi and psi + math.pi."
            )
        bends.append(1 if planar else 2)
    return tuple(bends)


def free_arcs(angles: Sequence[Tensor], extensible: Sequence[bool], bends: Sequence[int]) -> Tensor:
    """Return the projector (3 S, 3 S) on the arcs that the actuators of each segment determine.

    These are its length if it is extensible, and `bends` components of its bending: both, none, or
    the one in the plane of its actuators.
    """
    if 1 not in bends:
        components = [0.5 * n_bends for n_bends in bends]
        free = (*map(float, extensible), *components, *components)
        return torch.diag(constant(free, angles[0]))
    blocks = []  # (3, 3) for every segment: length, x- and y-bending
    for of_segment, stretches, n_bends in zip(angles, extensible, bends, strict=True):
        if n_bends == 1:
            # The plane at the angle psi in which the actuators read most.
            x, y = bend_readings(of_segment, stretches)
            product = 2.0 * (x * y).sum()
            difference = (x * x - y * y).sum()
            psi = 0.5 * torch.atan2(product, difference)
            direction = torch.stack([psi.cos(), psi.sin()])
            bending = torch.outer(direction, direction)
        else:
            bending = 0.5 * n_bends * identity(2, of_segment)
        length = float(stretches) * of_segment.new_ones(1, 1)
        blocks.append(torch.block_diag(length, bending))
    # From segment by segment to all lengths, all x- and all y-bendings.
    by_kind = torch.diag_embed(torch.stack(blocks, dim=-1))  # (3, 3, S, S)
    return by_kind.transpose(1, 2).flatten(2).flatten(0, 1)
