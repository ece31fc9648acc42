"""Errors that arise inside: x = f(z + W phi(q)), with z the coordinates of a robot model."""

from __future__ import annotations

from math import nan
from typing import Any

import torch
from torch import Tensor, nn

from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import ForwardModel, forward_and_jacobian
from hybridkin.hybrid._features import Features
from hybridkin.hybrid._linearised import design

PLACES = ("coordinates", "tip")
_BLOCK = 2**18  # numbers in the features of a block of rows: near in the cache


class SerialModule(ForwardModel):
    """The tip x = f(z(q) + W phi(q)) as a torch module q (..., n) -> x (..., m).

    Parameters
    ----------
    mechanical : nn.Module
        Maps q to x.
    features : Features
        phi, with its slope.
    weights : Tensor of shape (C, P)
        Readout W [unit of z].
    place : {"coordinates", "tip"}, default="coordinates"
        What z is: the arcs of a chain of arcs (lengths [m] up to the tip, then x- and
        y-bendings [rad]), q itself for any other module; or the tip, f being the identity.
    factor : Tensor of shape (C P, K), optional
        R with R R' the posterior covariance of W for noise of variance 1. Default: none, zero.
    noise_variance : Tensor of shape (), optional
        Variance of one coordinate of a measured tip [m^2].
    """

    weights: Tensor
    factor: Tensor
    noise_variance: Tensor

    def __init__(
        self,
        mechanical: nn.Module,
        features: Features,
        weights: Tensor,
        *,
        place: str = "coordinates",
        factor: Tensor | None = None,
        noise_variance: Tensor | None = None,
    ) -> None:
        super().__init__()
        if place not in PLACES:
            raise ValueError(f"`place` must be one of {PLACES}, got {place!r}.")
        self.mechanical = mechanical
        self.n_actuators = mechanical.n_actuators
        self.features = features
        self.place = place
        self.register_buffer("weights", weights)
        nothing, unknown = weights.new_zeros(weights.numel(), 0), weights.new_full((), nan)
        self.register_buffer("factor", nothing if factor is None else factor)
        self.register_buffer(
            "noise_variance", unknown if noise_variance is None else noise_variance
        )

    def forward(self, q: Tensor) -> Tensor:
        """Return the tip x, shape (..., m) [m]."""
        return in_blocks(self._forward, q)[0]

    def jacobian(self, q: Tensor) -> Tensor:
        """Return dx/dq = J_z (dz/dq + d(W phi)/dq), shape (..., m, n), in closed form."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n) in one pass."""
        rows = max(256, _BLOCK // self.weights.shape[1])
        x, J = in_blocks(self._forward_and_jacobian, q, min(rows, 4096))
        return x, J

    def correction(self, q: Tensor) -> Tensor:
        """Return W phi(q), shape (..., C) [unit of z]."""
        return self.features(q) @ self.weights.to(q).mT

    def tip_covariance(self, q: Tensor) -> Tensor:
        """Return the posterior covariance of the tip, without noise, shape (..., m, m) [m^2].

        Of the readout linearised at its optimum.
        """
        (covariance,) = in_blocks(self._unit_covariance, q, 512)
        return self.noise_variance.to(q) * covariance

    def leverage(self, q: Tensor) -> Tensor:
        """Return the variance of the tip over that of the noise, shape (...); below 1 in training.

        It is the mean over the coordinates of x: unlike the largest it is smooth, and unlike any
        one of them it does not change when the measuring frame is turned.
        """
        (covariance,) = in_blocks(self._unit_covariance, q, 512)
        return covariance.diagonal(dim1=-2, dim2=-1).mean(-1)

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        return (
            tip(
                self.mechanical,
                coordinates(self.mechanical, q, self.place)[0] + self.correction(q),
                self.place,
            ),
        )

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        delta, turn = self.features.readout(q, self.weights.to(q))
        z, slope = coordinates(self.mechanical, q, self.place)
        x, J = tip_and_columns(self.mechanical, z + delta, self.place)
        return x, J @ (slope + turn)

    def _unit_covariance(self, q: Tensor) -> tuple[Tensor]:
        phi = self.features(q)
        z = coordinates(self.mechanical, q, self.place)[0] + phi @ self.weights.to(q).mT
        J = tip_and_columns(self.mechanical, z, self.place)[1]
        half = design(J, phi) @ self.factor.to(q)
        return (half @ half.mT,)


def coordinates(mechanical: Any, q: Tensor, place: str) -> tuple[Tensor, Tensor]:
    """Return z (N, C) of rows q (N, n) and dz/dq, (C, n) or (N, C, n)."""
    if place == "tip":
        return forward_and_jacobian(mechanical, q)
    return mechanical.coordinates(q)


def tip(mechanical: Any, z: Tensor, place: str) -> Tensor:
    """Return the tip (N, m) of coordinates z (N, C)."""
    if place == "tip":
        return z
    return mechanical.from_coordinates(z)


def tip_and_columns(mechanical: Any, z: Tensor, place: str) -> tuple[Tensor, Tensor]:
    """Return the tip (N, m) of coordinates z (N, C) and its derivative (N, m, C)."""
    if place == "tip":
        return z, torch.eye(z.shape[1], dtype=z.dtype, device=z.device).expand(len(z), -1, -1)
    return mechanical.from_coordinates_and_jacobian(z)
