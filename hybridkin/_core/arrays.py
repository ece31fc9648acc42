"""Arrays of a caller, NumPy or torch, as rows of tensors and back."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor


@runtime_checkable
class Transform(Protocol):
    """A pose as a pytorch_kinematics Transform3d, which takes a second to import."""

    def get_matrix(self) -> Tensor:
        """Return the homogeneous transforms, shape (N, 4, 4)."""
        ...


Numbers = ArrayLike | Tensor  # what a caller may hand over as an array


def as_tensor(
    value: Numbers | Transform, name: str, device: torch.device | str | None = None
) -> Tensor:
    """Return a floating tensor that shares no memory with a caller's array."""
    if isinstance(value, Transform):
        return value.get_matrix().detach()
    if not isinstance(value, Tensor):
        try:
            value = torch.tensor(np.asarray(value), device=device)
        except (TypeError, ValueError) as error:
            raise ValueError(f"`{name}` must be numeric, got {value!r}.") from error
    value = value.detach()
    return value if value.is_floating_point() else value.double()


def as_array(a: Numbers) -> np.ndarray:
    """Return a tensor or array as a NumPy array."""
    return a.cpu().numpy() if isinstance(a, Tensor) else np.asarray(a)


def is_numpy(value: object) -> bool:
    """Return whether results for this argument go back as NumPy arrays."""
    return not isinstance(value, (Tensor, Transform))


def leading(pairs: Sequence[tuple[Tensor, int]]) -> tuple[int, ...]:
    """Return the common batch shape of tensors, each with its number of trailing axes."""
    shapes = [tuple(a.shape[: a.ndim - trailing]) for a, trailing in pairs]
    try:
        return tuple(torch.broadcast_shapes(*shapes))
    except RuntimeError as error:
        need = "configurations and targets must agree in their batch shapes"
        raise ValueError(f"{need}, got {shapes}.") from error


def rows_of(a: Tensor, lead: tuple[int, ...], trailing: int = 1) -> Tensor:
    """Return a tensor broadcast to the batch shape, as rows (N, ...)."""
    shape = a.shape[a.ndim - trailing :]
    return a.expand(*lead, *shape).reshape(math.prod(lead), *shape)


def give_back(results: Iterable[Tensor], lead: tuple[int, ...], as_numpy: bool) -> list[Any]:
    """Return rows (N, ...) in the caller's batch shape and kind."""
    shaped = [a.reshape((*lead, *a.shape[1:])) for a in results]
    return [as_array(a) for a in shaped] if as_numpy else shaped
