"""Row-by-row functions evaluated in blocks of rows, and the check of their input."""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from hybridkin._core.arrays import check_shape
from hybridkin._core.forks import THREADS
from hybridkin._core.named_rows import rows_from

_ON_GPU = 32  # times the rows of a CPU: a GPU computes them in the time of a few


def rows_at_once(size: int, device: torch.device) -> int:
    """Return the rows of a block on a device, for the size that suits the cache of a CPU."""
    return size if device.type == "cpu" else _ON_GPU * size


def in_blocks(
    function: Callable[[Tensor], tuple[Tensor, ...]], q: Tensor, size: int = 4096
) -> tuple[Tensor, ...]:
    """Return the result of a row-by-row function for q (..., n), computed in blocks of rows.

    Temporary arrays of a block fit into the cache of a CPU, so the time per row does not grow with
    the number of rows. The function may return transposed memory; the result is contiguous.
    """
    check_tensor(q, "q")
    return in_blocks_of(rows_at_once(size, q.device), function, q)


def in_blocks_of(
    size: int, function: Callable[[Tensor], tuple[Tensor, ...]], q: Tensor
) -> tuple[Tensor, ...]:
    """Return the result of `in_blocks` with exactly this number of rows in a block.

    In a compiled graph all rows are one block: it is right for any number of rows.
    """
    if q.ndim == 0:
        return function(q)  # which raises
    lead = q.shape[:-1]
    rows = q.reshape(math.prod(lead), q.shape[-1])
    blocks = (rows,) if torch.compiler.is_compiling() else rows.split(size)
    of_blocks = [function(blocks[0])]
    for k, block in enumerate(blocks[1:], 1):
        with rows_from(k * size):
            of_blocks.append(function(block))
    results = []
    for parts in zip(*of_blocks, strict=True):
        # Flattened, because a tensor of many axes in transposed memory is slow to join.
        whole = torch.cat([part.flatten(1) for part in parts])
        results.append(whole.reshape(*lead, *parts[0].shape[1:]))
    return tuple(results)


def check_tensor(value: Tensor, name: str, size: int | str = "n") -> None:
    """Raise if `value` is not a dense tensor of float64 or float32."""
    THREADS.check()
    if not isinstance(value, Tensor):
        raise TypeError(
            f"`{name}` must be a torch tensor of shape (..., {size}), got "
            f"{type(value).__name__}; wrap it in torch.as_tensor(...)."
        )
    real = value.dtype in (torch.float64, torch.float32)
    if not real or value.layout != torch.strided or value.is_meta:
        raise TypeError(
            f"`{name}` must be a dense floating tensor, float64 or float32, got {value.dtype} "
            f"with layout {value.layout} on {value.device}; convert it with `.double()` or "
            "`.to_dense()`."
        )


def check_vectors(value: Tensor, size: int, name: str, why: str) -> None:
    """Raise if `value` is not a dense floating tensor of shape (..., size)."""
    check_tensor(value, name, size)
    check_shape(value, name, ("...", size), why)
