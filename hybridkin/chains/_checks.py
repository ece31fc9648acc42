"""Checks of a user's geometry and its conversion to tensors, with messages that help."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Any, TypeGuard

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import (
    LARGEST,
    Numbers,
    Transform,
    identity,
    number,
    real_array,
    shaped,
)
from hybridkin._core.units import warn_length

# ratio of radii; more leave too few digits with the routing "base"
_MOST_UNLIKE = 1000.0
_RADIUS = 0.03  # usual radius of a robot [m], and length of a segment
_LENGTH = 0.2
# lengths [m] and gains [m per unit of q] are smaller, and their inverses too
_HUGE = 1e15
_TURNS = 4.0 * math.pi  # [rad]; the angle of a tendon is never larger


def float_dtype(dtype: object) -> torch.dtype:
    """Return a caller's dtype of torch."""
    for supported in (torch.float64, torch.float32):
        if dtype is supported:
            return supported
    raise ValueError(f"`dtype` must be torch.float64 or torch.float32, got {dtype!r}.")


def place_on_body(at: float, n_segments: int) -> float:
    """Return a place on a body, in segments from its start."""
    place = number(at, "at")
    if not 0.0 < place <= n_segments:
        raise ValueError(
            f"`at` must lie in (0, {n_segments}], in segments from the base, got {at}."
        )
    return place


def lengths_of(value: Numbers, name: str, dtype: torch.dtype, size: int | None = None) -> Tensor:
    """Return one positive length per segment, shape (S,)."""
    lengths = numeric(value, name, dtype, need="n", length=size)
    if not len(lengths) or not (lengths > 0).all():
        raise ValueError(f"`{name}` must be positive [m] on every segment, got {lengths.tolist()}.")
    _check_size(lengths, name)
    return lengths


def _check_size(numbers: Tensor, name: str) -> None:
    """Raise if numbers are so large or small that bends would be mere rounding."""
    sizes = numbers.abs()
    if not ((sizes > 1.0 / _HUGE) & (sizes < _HUGE)).all():
        raise ValueError(
            f"`{name}` must be between {1.0 / _HUGE:g} and {_HUGE:g}, got {numbers.tolist()}; "
            "check the units."
        )


def filled(value: Numbers, name: str, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
    """Return one number for all, or an array of the shape (also a list of lists), as a tensor."""
    if len(shape) == 1 and _is_nested(value):
        value = torch.cat([numeric(part, name).flatten() for part in value])
    tensor = numeric(value, name, dtype)
    if tensor.ndim and tensor.shape != shape:
        raise ValueError(
            f"`{name}` must have shape {shape}, or be one number, got {tuple(tensor.shape)}."
        )
    return tensor.expand(shape).clone()


def stiffnesses(
    bending: Numbers, axial: Numbers, dtype: torch.dtype, size: int
) -> dict[str, Tensor]:
    """Return positive bending and axial stiffnesses of all segments, each of shape (S,)."""
    given = {"bending_stiffness": bending, "axial_stiffness": axial}
    checked = {}
    for name, value in given.items():
        tensor = filled(value, name, dtype, (size,))
        if not (tensor > 1.0 / LARGEST).all():
            need = f"must be positive, over {1.0 / LARGEST:g}"
            raise ValueError(f"`{name}` {need}, got {tensor.tolist()}.")
        checked[name] = tensor
    return checked


def arc_geometry(
    radii: Numbers,
    lengths: Any,
    n_actuators: int | Sequence[int],
    angles: Numbers | None,
    offsets: Numbers,
    rest_bends: Numbers,
    gains: Numbers,
    base: Numbers | Transform | None,
    dtype: torch.dtype,
) -> tuple[tuple[int, ...], tuple[bool, ...], dict[str, Tensor]]:
    """Return the number of actuators of each segment, whether it is extensible, its geometry."""
    radii = lengths_of(radii, "radii", dtype)
    if radii.max() > _MOST_UNLIKE * radii.min():
        raise ValueError(
            f"`radii` must be within a factor of {_MOST_UNLIKE:g} of each other, got "
            f"{radii.tolist()} m; check their units."
        )
    S = radii.numel()
    counts = actuator_counts(n_actuators, S)
    warn_length("radii", radii, 1.0, _RADIUS)
    each = gains
    if not _is_nested(gains) and np.shape(gains) == (S,):
        each = np.repeat(real_array(gains, "gains"), counts)
    geometry = {
        "radii": radii,
        "angles": flat_angles(angles, counts, dtype),
        "offsets": filled(offsets, "offsets", dtype, (S,)),
        "rest_bends": filled(rest_bends, "rest_bends", dtype, (S, 2)),
        "gains": filled(each, "gains", dtype, (sum(counts),)),
        "base": pose(base, "base", dtype),
    }
    extensible = (lengths is None,) * S
    if isinstance(lengths, (list, tuple)):
        extensible = tuple(length is None for length in lengths)
        lengths = [length for length in lengths if length is not None]
    if extensible != (True,) * S and lengths is not None:
        geometry["lengths"] = lengths_of(lengths, "lengths", dtype, S - sum(extensible))
        warn_length("lengths", geometry["lengths"], 10.0, _LENGTH)
    if not geometry["gains"].all():
        raise ValueError(f"`gains` must not be zero [m per unit of q], got {gains}.")
    _check_size(geometry["gains"], "gains")
    return counts, extensible, geometry


def numeric(
    value: Numbers | Transform,
    name: str,
    dtype: torch.dtype = torch.float64,
    *,
    need: str | None = None,
    length: int | None = None,
    finite: bool = True,
) -> Tensor:
    """Return a copy of numbers as a tensor; NaN and infinity raise.

    With `need` the shape is checked, see `arrays.shaped`. With ``finite=False`` only NaN raises.
    """
    if need is None:
        array = real_array(value, name)
    else:
        array = shaped(value, name, need, length)
    tensor = torch.tensor(array, dtype=dtype, device="cpu")
    valid = torch.isfinite(tensor) if finite else ~torch.isnan(tensor)
    if not valid.all():
        raise ValueError(f"`{name}` must be finite, got {tensor.tolist()}.")
    return tensor


def joint_limits(n: int, *given: Numbers | None) -> dict[str, Tensor]:
    """Return `q_min`, `q_max`, `dq_max` and `ddq_max`, shape (n,), infinite if given as None."""
    limits = {}
    ends = dict.fromkeys(("q_min", "q_max", "dq_max", "ddq_max"), math.inf)
    ends["q_min"] = -math.inf
    for (name, end), value in zip(ends.items(), given, strict=True):
        if value is None:
            value = np.full(n, end)
        limits[name] = numeric(value, name, need="n", length=n, finite=False)
    low, high, speed, acceleration = limits.values()
    if not ((low <= high) & (speed > 0.0) & (acceleration > 0.0)).all():
        raise ValueError(
            "`q_min` must not exceed `q_max`, and `dq_max` and `ddq_max` must be positive, got "
            f"{low.tolist()}, {high.tolist()}, {speed.tolist()} and {acceleration.tolist()}."
        )
    return limits


def actuator_counts(n_actuators: int | Sequence[int], n_segments: int) -> tuple[int, ...]:
    """Return the number of actuators of every segment."""
    numbers = np.asarray(n_actuators)
    if numbers.dtype.kind not in "iu" or numbers.shape not in ((), (n_segments,)):
        raise ValueError(
            f"`n_actuators` must be one whole number or {n_segments} of them, one per segment as "
            f"in `radii`, got {n_actuators!r}."
        )
    counts = tuple(np.broadcast_to(numbers, n_segments).tolist())
    if min(counts) < 1:
        raise ValueError(f"`n_actuators` must be at least 1 on every segment, got {counts}.")
    return counts


def _is_nested(value: object) -> TypeGuard[Sequence[Numbers]]:
    parts = value if isinstance(value, (list, tuple)) else ()
    return any(isinstance(part, (list, tuple)) or np.ndim(part) > 0 for part in parts)


def flat_angles(angles: Numbers | None, counts: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return the angles of all actuators, segment by segment, shape (n,)."""
    if angles is None:
        by_segment = [2.0 * math.pi * np.arange(n) / n for n in counts]
    elif _is_nested(angles):
        by_segment = angles
    else:
        values = numeric(angles, "angles", dtype)
        by_segment = values if values.ndim == 2 else [values] * len(counts)
    rows = [numeric(row, "angles", dtype) for row in by_segment]
    sizes = [row.numel() for row in rows]
    if sizes != [*counts]:
        raise ValueError(
            f"`angles` must hold {[*counts]} angles for the segments, got {sizes}; give shape "
            "(n,), (S, n) or one list per segment."
        )
    flat = torch.cat(rows)
    largest = float(flat.abs().max())
    if largest > _TURNS:
        warnings.warn(
            f"`angles` reach {largest:.4g}, which looks like degrees; hybridkin works in radians: "
            "give numpy.radians(angles).",
            stacklevel=3,
        )
    return flat


def pose(value: Numbers | Transform | None, name: str, dtype: torch.dtype) -> Tensor:
    """Return a pose given as a matrix, a Transform3d or None, shape (4, 4)."""
    if value is None:
        return torch.eye(4, dtype=dtype, device="cpu")
    matrix = numeric(value, name, dtype)
    if isinstance(value, Transform) and len(matrix) == 1:
        matrix = matrix[0]
    if matrix.shape != (4, 4):
        raise ValueError(f"`{name}` must be one pose of shape (4, 4), got {tuple(matrix.shape)}.")
    rotation = matrix[:3, :3]
    not_orthonormal = rotation.mT @ rotation - identity(3, matrix)
    if not_orthonormal.abs().max() > 1e-4 or torch.linalg.det(rotation) < 0:
        raise ValueError(
            f"`{name}` must hold a rotation in its upper left 3 x 3 block (orthonormal, "
            f"right-handed), got {rotation.tolist()}."
        )
    return matrix


def rigid_pose(value: Numbers, name: str) -> Tensor:
    """Return a checked pose whose rotation is made orthonormal to rounding."""
    measured = pose(value, name, torch.float64)
    left, _, right = torch.linalg.svd(measured[:3, :3])
    matrix = identity(4, measured)
    matrix[:3, :3] = left @ right
    matrix[:3, 3] = measured[:3, 3]
    return matrix
