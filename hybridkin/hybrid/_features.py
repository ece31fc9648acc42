"""Features of the actuators for linear readouts: a linear part and one that bends."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.blocks import check_vectors
from hybridkin._core.model import PortableModule
from hybridkin.learning.network import ACTIVATIONS


class Features(PortableModule):
    """Features phi(q) = [1, u], with u = (q - center) / scale.

    Kinds with more features append them, so that the two parts can be penalised apart.

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    """

    center: Tensor
    scale: Tensor

    def __init__(self, center: Tensor, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)
        self.register_buffer("scale", scale)

    @classmethod
    def of_range(cls, q: Tensor, *args: Any, **options: Any) -> Self:
        """Return the features for the range of rows q (N, n); constant columns stay."""
        low, high = q.amin(0), q.amax(0)
        scale = 0.5 * (high - low)
        flat = scale <= 4.0 * torch.finfo(q.dtype).eps * q.abs().amax(0)
        scale = torch.where(flat, torch.ones_like(scale), scale)
        return cls(0.5 * (low + high), scale, *args, **options)

    @property
    def n_linear(self) -> int:
        """How many features come first and are linear: the constant, then u."""
        return 1 + len(self.center)

    def forward(self, q: Tensor) -> Tensor:
        """Return phi(q), shape (..., P)."""
        u = self._scaled(q)
        return torch.cat([torch.ones_like(u[..., :1]), u, *self._bent(u)], dim=-1)

    def readout(self, q: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return W phi(q) (..., C) for weights W (C, P), and its slope by q (..., C, n)."""
        u = self._scaled(q)
        linear, bent = weights.tensor_split([self.n_linear], dim=1)
        value = u @ linear[:, 1:].mT + linear[:, 0]
        slope = linear[:, 1:].expand(*u.shape[:-1], *linear[:, 1:].shape)
        if bent.shape[1]:
            more, slope_more = self._bent_readout(u, bent)
            value, slope = value + more, slope + slope_more
        return value, slope / self.scale.to(q)

    def _scaled(self, q: Tensor) -> Tensor:
        n = len(self.center)
        check_vectors(q, n, "q", f"these features were made for {n} inputs")
        return (q - self.center.to(q)) / self.scale.to(q)

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return ()

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        """Return W phi(u) of the features after the linear ones, and its slope by u."""
        raise NotImplementedError


class QuadraticFeatures(Features):
    """The linear features, then u_i u_j for i < j and (3 u_i^2 - 1) / 2.

    The squares have no mean over the range, so their penalty leaves the constant alone.
    """

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        i, j = torch.triu_indices(len(self.center), len(self.center), 1, device=u.device)
        return u[..., i] * u[..., j], 1.5 * u.square() - 0.5

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        n = len(self.center)
        i, j = torch.triu_indices(n, n, 1, device=u.device)
        crossed, squared = weights[:, : len(i)], weights[:, len(i) :]
        hessian = weights.new_zeros(len(weights), n, n)
        hessian[:, i, j] = crossed
        hessian = hessian + hessian.mT + torch.diag_embed(3.0 * squared)
        slope = (u @ hessian.flatten(0, 1).mT).unflatten(-1, hessian.shape[:2])
        value = 0.5 * (slope @ u[..., None])[..., 0] - 0.5 * squared.sum(1)
        return value, slope


class HiddenFeatures(Features):
    """The linear features, then a hidden layer sigma(A u + b).

    Parameters
    ----------
    center, scale : Tensor of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    input_weights : Tensor of shape (H, n)
        A.
    input_bias : Tensor of shape (H,)
        b.
    activation : {"logistic", "tanh", "sin"}, default="logistic"
        The function sigma.
    """

    input_weights: Tensor
    input_bias: Tensor

    def __init__(
        self,
        center: Tensor,
        scale: Tensor,
        input_weights: Tensor,
        input_bias: Tensor,
        activation: str = "logistic",
    ) -> None:
        super().__init__(center, scale)
        self.activation = activation
        self.register_buffer("input_weights", input_weights)
        self.register_buffer("input_bias", input_bias)

    def _bent(self, u: Tensor) -> tuple[Tensor, ...]:
        return (self._hidden(u)[1],)

    def _bent_readout(self, u: Tensor, weights: Tensor) -> tuple[Tensor, Tensor]:
        a, s = self._hidden(u)
        tangent = weights[:, None] * self.input_weights.to(u).mT  # (C, n, H)
        slope = ACTIVATIONS[self.activation][1](a, s) @ tangent.flatten(0, 1).mT
        return s @ weights.mT, slope.unflatten(-1, tangent.shape[:2])

    def _hidden(self, u: Tensor) -> tuple[Tensor, Tensor]:
        a = u @ self.input_weights.to(u).mT + self.input_bias.to(u)
        return a, ACTIVATIONS[self.activation][0](a)
