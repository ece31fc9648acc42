"""Constants of computations, copied once to each device and precision that asks for them.

A copy from the CPU to a GPU waits for it; made in every call it would empty its queue of work.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch._subclasses import FakeTensor

_MOST = 1024  # constants that are kept


def constant(numbers: Any, like: Tensor, dtype: torch.dtype | None = None) -> Tensor:
    """Return numbers as a tensor on the device of another one; nobody writes into it.

    Parameters
    ----------
    numbers : number, or tuple of numbers or tuples
        The constant.
    like : Tensor
        Its device, and without `dtype` its precision, are those of the result.
    dtype : torch.dtype, optional
        Default: that of `like`.
    """
    dtype = like.dtype if dtype is None else dtype
    if torch.compiler.is_compiling():
        return torch.tensor(numbers, dtype=dtype, device=like.device)
    try:
        return _kept(numbers, dtype, like.device)
    except _NotKept as error:
        return error.tensor


@lru_cache(_MOST)
def _kept(numbers: Any, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the constant; raise it in a `_NotKept` if it belongs to a graph or a transform."""
    # Later derivatives cannot use tensors of the inference mode.
    with torch.inference_mode(False):
        tensor = torch.tensor(numbers, dtype=dtype, device=device)
    if isinstance(tensor, FakeTensor) or not outlives_transforms(tensor):
        raise _NotKept(tensor)
    return tensor


def outlives_transforms(tensor: Tensor) -> bool:
    """Return whether a tensor has memory, also after the transform of torch it was made in."""
    try:
        tensor.data_ptr()
    except RuntimeError:
        return False
    return True


class _NotKept(Exception):
    """Brings a tensor past the cache."""

    def __init__(self, tensor: Tensor) -> None:
        super().__init__()
        self.tensor = tensor


def moved(tensor: Tensor, like: Tensor) -> Tensor:
    """Return a constant tensor on the device and in the precision of another one.

    A copy on another device is kept with the tensor, until this is written.
    """
    if tensor.device == like.device or tensor.requires_grad or tensor.is_inference():
        return tensor.to(like)
    copies = vars(tensor).setdefault("_copies", {})
    place = like.dtype, like.device
    version, copy = copies.get(place, (-1, tensor))
    if version != tensor._version:
        version = tensor._version
        with torch.inference_mode(False):
            copy = tensor.to(like)
        copies[place] = version, copy
    return copy
