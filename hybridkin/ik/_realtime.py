"""One configuration of a model in NumPy; goes with the methods `numpy_function` of the models."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from numpy.typing import NDArray
from torch import nn

from hybridkin._core.model import forward_and_jacobian

NumpyFunction = Callable[[NDArray], tuple[NDArray, NDArray]]


def numpy_function(module: Any) -> NumpyFunction:
    """Return a NumPy function of one configuration, q (n,) -> x (m,) and dx/dq (m, n).

    Parameters
    ----------
    module : nn.Module or callable
        Maps q ``(..., n)`` to ``(..., m)``, torch to torch. Its own ``numpy_function()`` is used
        where it has one; else torch computes a batch of one, many times slower.

    Returns
    -------
    function
        In float64. It keeps the module's present parameters.
    """
    own = getattr(module, "numpy_function", None)
    return by_torch(module) if own is None else own()


def by_torch(module: Any) -> NumpyFunction:
    """Return the `numpy_function` of a module that has none: torch computes a batch of one."""
    device = None
    if isinstance(module, nn.Module):
        device = next((a.device for a in (*module.parameters(), *module.buffers())), None)

    def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
        rows = torch.tensor(q, dtype=torch.float64, device=device)[None]
        with torch.no_grad():
            x, J = forward_and_jacobian(module, rows)
        return x[0].cpu().double().numpy(), J[0].cpu().double().numpy()

    return tip_and_jacobian
