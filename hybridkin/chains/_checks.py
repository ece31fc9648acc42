"""Geometry as a user writes it: turned into tensors, checked, with messages that help."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from torch import Tensor

_TURNS = 4.0 * math.pi  # nobody counts the angle of a tendon further


def vector(
    value: Any, name: str, dtype: torch.dtype, *, size: int | None = None, positive: bool = False
) -> Tensor:
    """Return one number per segment as a tensor (S,), checked."""
    vector = _tensor(value, name, dtype)
    if vector.ndim != 1 or vector.numel() == 0 or (size is not None and vector.numel() != size):
        need = "(S,), one value per segment" if size is None else f"({size},), one per segment"
        raise ValueError(f"`{name}` must have shape {need}, got {tuple(vector.shape)}.")
    if positive and not (vector > 0).all():
        raise ValueError(f"`{name}` must be positive [m], got {vector.tolist()}.")
    return vector


def filled(value: Any, name: str, dtype: torch.dtype, shape: tuple[int, ...]) -> Tensor:
    """Return one number for all, or an array of the shape (also a list of lists), as a tensor."""
    if len(shape) == 1 and isinstance(value, (list, tuple)) and any(np.ndim(v) for v in value):
        value = [number for part in value for number in np.ravel(part)]
    tensor = _tensor(value, name, dtype)
    if tensor.ndim and tensor.shape != shape:
        raise ValueError(
            f"`{name}` must have shape {shape}, or be one number, got {tuple(tensor.shape)}."
        )
    return tensor.expand(shape).clone()


def _tensor(value: Any, name: str, dtype: torch.dtype) -> Tensor:
    try:
        tensor = torch.as_tensor(np.asarray(value) if not isinstance(value, Tensor) else value)
        tensor = tensor.to(dtype).clone()
    except (TypeError, ValueError) as error:
        raise ValueError(f"`{name}` must be numeric, got {value!r}.") from error
    if not torch.isfinite(tensor).all():
        raise ValueError(f"`{name}` must be finite, got {tensor.tolist()}.")
    return tensor


def actuator_counts(
    n_actuators: Any, n_segments: int, name: str = "n_actuators", least: int = 3
) -> tuple[int, ...]:
    """Return the number of actuators of every segment."""
    if np.ndim(n_actuators) == 0:
        counts = (int(n_actuators),) * n_segments
    else:
        counts = tuple(int(n) for n in n_actuators)
    if len(counts) != n_segments:
        raise ValueError(
            f"`{name}` must be one number or {n_segments} numbers, one per segment as in "
            f"`radii`, got {len(counts)}."
        )
    if min(counts) < least:
        why = "; two actuators do not determine which way a segment bends" if least == 3 else ""
        raise ValueError(f"`{name}` must be at least {least} on every segment, got {counts}{why}.")
    return counts


def flat_angles(angles: Any, counts: tuple[int, ...], dtype: torch.dtype) -> Tensor:
    """Return the angles of all actuators, segment by segment, shape (n,)."""
    if angles is None:
        rows = [2.0 * math.pi * np.arange(n) / n for n in counts]
    elif np.ndim(angles[0]) == 0:
        rows = [angles] * len(counts)
    else:
        rows = list(angles)
    rows = [_tensor(row, "angles", dtype) for row in rows]
    if tuple(row.numel() for row in rows) != counts:
        raise ValueError(
            f"`angles` must hold {list(counts)} angles for the segments, got "
            f"{[row.numel() for row in rows]}; give shape (n,), (S, n) or one list per segment."
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


def pose(value: Any, name: str, dtype: torch.dtype) -> Tensor:
    """Return a pose given as a matrix, a Transform3d or None, shape (4, 4)."""
    if value is None:
        return torch.eye(4, dtype=dtype)
    if hasattr(value, "get_matrix"):  # a pytorch_kinematics Transform3d
        value = value.get_matrix().detach()
        value = value[0] if value.shape[:1] == (1,) else value
    matrix = _tensor(value, name, dtype)
    if matrix.shape != (4, 4):
        raise ValueError(f"`{name}` must be one pose of shape (4, 4), got {tuple(matrix.shape)}.")
    rotation = matrix[:3, :3]
    eye = torch.eye(3, dtype=dtype, device=matrix.device)
    if (rotation.mT @ rotation - eye).abs().max() > 1e-4 or torch.linalg.det(rotation) < 0:
        raise ValueError(
            f"`{name}` must hold a rotation in its upper left 3 x 3 block (orthonormal, "
            f"right-handed), got {rotation.tolist()}."
        )
    return matrix


def check_replacements(values: Mapping[str, Tensor], current: Mapping[str, Tensor]) -> None:
    """Raise where values are not part of the geometry, or have another shape."""
    for name, value in values.items():
        if name not in current:
            raise ValueError(
                f"`{name}` is not part of this chain's geometry; it has {sorted(current)}."
            )
        if value.shape != current[name].shape:
            raise ValueError(
                f"`{name}` must have shape {tuple(current[name].shape)}, got {tuple(value.shape)}."
            )
