"""Where a learned error model may be trusted: smooth weights from leverage or from a box."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridkin._numerics import PortableModule

__all__ = ["GUARDS", "BoxGuard", "Guard", "LeverageGuard", "QuadraticReadout", "fit_guard"]

GUARDS = ("leverage", "box", None)


class Guard(PortableModule):
    """Weight w(q) of the error model: 1 where `strangeness` is at most 1, fading beyond.

    Twice continuously differentiable, so the full Jacobian stays continuous.
    """

    def strangeness(self, q: Tensor) -> Tensor:
        """Return how far q is from the training rows, at most 1 among them, shape (...)."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return w(q), shape (..., 1)."""
        beyond = (self.strangeness(q) - 1.0).clamp(min=0.0)
        return (1.0 / (1.0 + beyond**3))[..., None]


class LeverageGuard(Guard):
    """Strangeness by the leverage phi^T (G + lambda 1)^-1 phi of a ridge readout.

    Parameters
    ----------
    readout : nn.Module
        With ``leverage(q)`` of shape (...).
    limit : Tensor of shape ()
        The leverage that counts as strangeness 1.
    """

    limit: Tensor

    def __init__(self, readout: nn.Module, limit: Tensor) -> None:
        super().__init__()
        self.readout = readout
        self.register_buffer("limit", limit)

    @classmethod
    def fit(cls, readout: nn.Module, q: Tensor) -> LeverageGuard:
        """Return the guard whose limit is the largest leverage of a training row, itself left out.

        That is h / (1 - h), with h the leverage of a row that took part in the fit.
        """
        h = readout.leverage(q)  # pyright: ignore[reportCallIssue]
        return cls(readout, (h / (1.0 - h).clamp(min=1e-9)).max())

    def is_inside(self, features: Tensor) -> Tensor:
        """Return where the strangeness is certainly below 1, from the readout's features."""
        return self.readout.leverage_is_below(self.limit, features)  # pyright: ignore

    def strangeness(self, q: Tensor) -> Tensor:
        """Return the leverage of q over the limit, shape (...)."""
        return self.readout.leverage(q) / self.limit.to(q)  # pyright: ignore[reportCallIssue]


class BoxGuard(Guard):
    """Strangeness by the distance outside a box, in tenths of its width.

    Parameters
    ----------
    low, high : Tensor of shape (n,)
        Corners of the box.
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self.register_buffer("low", low)
        self.register_buffer("high", high)

    def strangeness(self, q: Tensor) -> Tensor:
        """Return 1 inside the box, more outside, shape (...)."""
        low, high = self.low.to(q), self.high.to(q)
        width = torch.where(high > low, high - low, torch.ones_like(low))
        outside = (low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)
        return 1.0 + (100.0 * (outside / width).square()).sum(-1)


class QuadraticReadout(PortableModule):
    """Leverage in linear and squared inputs, for error models that have none of their own.

    Parameters
    ----------
    center, half_width : Tensor of shape (n,)
        Map of the training range to [-1, 1].
    factor : Tensor of shape (2 n + 1, 2 n + 1)
        Lower Cholesky factor of the features' Gram matrix plus the penalty.
    """

    center: Tensor
    half_width: Tensor
    factor: Tensor

    def __init__(self, center: Tensor, half_width: Tensor, factor: Tensor) -> None:
        super().__init__()
        self.register_buffer("center", center)
        self.register_buffer("half_width", half_width)
        self.register_buffer("factor", factor)

    @classmethod
    def fit(cls, q: Tensor, alpha: float = 0.1) -> QuadraticReadout:
        """Return the readout of training rows q (N, n)."""
        low, high = q.amin(0), q.amax(0)
        half_width = 0.5 * (high - low)
        half_width = torch.where(half_width > 0, half_width, torch.ones_like(half_width))
        readout = cls(0.5 * (low + high), half_width, torch.eye(2 * q.shape[1] + 1).to(q))
        features = readout._features(q)
        gram = features.mT @ features
        gram.diagonal().add_(alpha)
        readout.factor = torch.linalg.cholesky(gram)
        return readout

    def _features(self, q: Tensor) -> Tensor:
        u = (q - self.center.to(q)) / self.half_width.to(q)
        return torch.cat([torch.ones_like(u[..., :1]), u, u * u], dim=-1)

    def leverage(self, q: Tensor) -> Tensor:
        """Return phi^T (Phi^T Phi + alpha 1)^-1 phi, shape (...)."""
        features = self._features(q)[..., None]
        white = torch.linalg.solve_triangular(self.factor.to(q), features, upper=False)
        return white.square().sum((-2, -1))


def fit_guard(kind: str | None, error_module: nn.Module, q: Tensor) -> Guard | None:
    """Return the guard of an error model trained on rows q (N, n)."""
    if kind is None:
        return None
    if kind == "box":
        return BoxGuard(q.amin(0), q.amax(0))
    own = hasattr(error_module, "leverage")
    return LeverageGuard.fit(error_module if own else QuadraticReadout.fit(q), q)
