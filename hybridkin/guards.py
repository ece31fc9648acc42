"""Where a learned error model may be trusted: smooth weights from leverage or from a box."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridkin._numerics import PortableModule

__all__ = ["GUARDS", "BoxGuard", "Guard", "LeverageGuard", "QuadraticReadout", "fit_guard"]

GUARDS = ("leverage", "box", None)


class Guard(PortableModule):
    """Trust in an error model: a weight w(q), and a length that no correction goes far beyond.

    The weight is 1 where `strangeness` is at most 1, and fades beyond. Both are twice continuously
    differentiable, so the full Jacobian stays continuous.

    Parameters
    ----------
    largest : Tensor of shape ()
        The longest correction of a training row [m]. Longer ones are shortened, to less than
        `MOST` times this: nowhere can the hybrid be farther than that from the mechanical model.
    """

    MOST = 1.5
    largest: Tensor

    def __init__(self, largest: Tensor) -> None:
        super().__init__()
        self.register_buffer("largest", largest)

    def strangeness(self, q: Tensor) -> Tensor:
        """Return how far q is from the training rows, at most 1 among them, shape (...)."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return w(q), shape (..., 1)."""
        beyond = (self.strangeness(q) - 1.0).clamp(min=0.0)
        return (1.0 / (1.0 + beyond**3))[..., None]

    def shortened(self, error: Tensor) -> Tensor:
        """Return corrections (..., m), those beyond the largest shortened [m]."""
        relative = self._relative(error)
        return error * (self._kept(relative)[0] / relative)

    def shortened_with_jacobian(self, error: Tensor, J: Tensor) -> tuple[Tensor, Tensor]:
        """Return the same of corrections (N, m), and their Jacobians (N, m, n)."""
        long = (self._relative(error) > 1.0).nonzero()[:, 0]
        if not len(long):
            return error, J
        own, J_own = error[long], J[long]
        relative = self._relative(own)
        kept, slope = self._kept(relative)
        factor = kept / relative
        along = (own[:, None] @ J_own)[:, 0] / (relative * self._unit(own) ** 2)
        fading = (slope - factor) / relative * along
        J_own = factor[..., None] * J_own + own[..., None] * fading[:, None]
        return error.index_copy(0, long, factor * own), J.index_copy(0, long, J_own)

    def _unit(self, error: Tensor) -> Tensor:
        return self.largest.to(error).clamp(min=torch.finfo(error.dtype).tiny ** 0.25)

    def _relative(self, error: Tensor) -> Tensor:
        # Up to the largest it counts as one: the root stays smooth, and nothing changes.
        squares = (error / self._unit(error)).square().sum(-1, keepdim=True)
        return squares.clamp(min=1.0).sqrt()

    def _kept(self, relative: Tensor) -> tuple[Tensor, Tensor]:
        """Return the length kept of one, both in units of the largest, and its slope."""
        over = self.MOST - 1.0
        bent = torch.tanh((relative - 1.0) / over)
        return 1.0 + over * bent, 1.0 - bent.square()


class LeverageGuard(Guard):
    """Strangeness by the leverage phi^T (G + lambda 1)^-1 phi of a ridge readout.

    Parameters
    ----------
    readout : nn.Module
        With ``leverage(q)`` of shape (...).
    limit : Tensor of shape ()
        The leverage that counts as strangeness 1.
    largest : Tensor of shape ()
        The longest correction of a training row [m].
    """

    limit: Tensor

    def __init__(self, readout: nn.Module, limit: Tensor, largest: Tensor) -> None:
        super().__init__(largest)
        self.readout = readout
        self.register_buffer("limit", limit)

    @classmethod
    def fit(cls, readout: nn.Module, q: Tensor, largest: Tensor) -> LeverageGuard:
        """Return the guard whose limit is the largest leverage of a training row, itself left out.

        That is h / (1 - h), with h the leverage of a row that took part in the fit.
        """
        h = readout.leverage(q)  # pyright: ignore[reportCallIssue]
        return cls(readout, (h / (1.0 - h).clamp(min=1e-9)).max(), largest)

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
    largest : Tensor of shape ()
        The longest correction of a training row [m].
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor, largest: Tensor) -> None:
        super().__init__(largest)
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
    with torch.no_grad():
        largest = error_module(q).norm(dim=-1).max()
        if kind == "box":
            return BoxGuard(q.amin(0), q.amax(0), largest)
        own = hasattr(error_module, "leverage")
        return LeverageGuard.fit(error_module if own else QuadraticReadout.fit(q), q, largest)
