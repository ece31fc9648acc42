"""The preferred configuration of a redundant robot: none, a fixed one, or a function of q."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import torch
from torch import Tensor

from hybridkin._core.constants import moved
from hybridkin._core.portable import Portable

Function: TypeAlias = Callable[[Tensor], Tensor]


class NoPosture(Portable):
    """No configuration is preferred."""

    exists = False

    @property
    def numbers(self) -> Tensor:
        """What the kernels get, shape () or (n,)."""
        return torch.zeros((), dtype=torch.float64, device="cpu")

    def at(self, q: Tensor) -> Tensor:
        """Return the preferred configurations for q (..., n), of shape (n,) or that of q."""
        return q

    def start(self, middle: Tensor) -> Tensor:
        """Return a configuration to start from; NaN if there is none.

        Parameters
        ----------
        middle : Tensor of shape () or (n,)
            The middle of the limits, NaN if they are not finite.
        """
        return middle


class FixedPosture(NoPosture):
    """One configuration q (n,), or one number for all actuators."""

    exists = True

    def __init__(self, q: Tensor) -> None:
        self._q = q

    @property
    def numbers(self) -> Tensor:
        """What the kernels get, shape () or (n,)."""
        return self._q

    def at(self, q: Tensor) -> Tensor:
        """Return the configuration."""
        return moved(self._q, q)

    def start(self, middle: Tensor) -> Tensor:
        """Return the configuration."""
        return self._q


class PostureFunction(NoPosture):
    """A function of q, torch to torch."""

    exists = True

    def __init__(self, function: Function, on_plane: Function) -> None:
        self._function = function
        self._on_plane = on_plane

    @property
    def numbers(self) -> Tensor:
        """What the kernels get: nothing."""
        raise TypeError("a posture that is a function has no kernel")

    def at(self, q: Tensor) -> Tensor:
        """Return what the function prefers."""
        wanted = self._function(q)
        if not isinstance(wanted, Tensor):
            raise TypeError(
                f"`q_pref` must map torch tensors to torch tensors, got {type(wanted).__name__}."
            )
        return self._on_plane(wanted.to(q))

    def start(self, middle: Tensor) -> Tensor:
        """Return what the function prefers in the middle of the limits."""
        if torch.isfinite(middle).all():
            return self.at(middle)
        return middle
