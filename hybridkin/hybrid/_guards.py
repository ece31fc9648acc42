"""Where a learned error model may be trusted: smooth weights from leverage or from a box."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import lapack
from torch import Tensor, nn

from hybridkin._core.model import PortableModule, reverse_jacobian
from hybridkin.ik._realtime import NumpyFunction, numpy_function

__all__ = ["GUARDS", "BoxGuard", "Guard", "LeverageGuard", "QuadraticReadout", "fit_guard"]

_STILL = 1e-3  # of the largest spread: the log does not go there
_AS_IF = 0.1  # of the range: spread that is taken for granted there

GUARDS = ("leverage", "box", None)

NumpyStrangeness = Callable[[NDArray], tuple[float, "NDArray | None"]]


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

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return how far q is from the training rows, at most 1 among them, shape (...)."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return w(q), shape (..., 1)."""
        beyond = (self.domain_distance(q) - 1.0).clamp(min=0.0)
        return self._weight(beyond)[..., None]

    def weight_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return w(q) (N, 1) and its derivative (N, 1, n) at rows q (N, n)."""
        strangeness, gradient = self._strangeness_and_gradient(q)
        beyond = (strangeness - 1.0).clamp(min=0.0)
        weight = self._weight(beyond)
        slope = -3.0 * (beyond * weight) ** 2
        return weight[:, None], (slope[:, None] * gradient)[:, None]

    def _strangeness_and_gradient(self, q: Tensor) -> tuple[Tensor, Tensor]:
        strangeness, gradient = reverse_jacobian(
            lambda rows: self.domain_distance(rows)[..., None], q
        )
        return strangeness[:, 0], gradient[:, 0]

    def numpy_function(self) -> NumpyStrangeness:
        """Return a NumPy function q (n,) -> strangeness, and its gradient (n,) where above 1."""
        raise NotImplementedError

    def numpy_correction(self, error: nn.Module) -> NumpyFunction:
        """Return a NumPy function q (n,) -> the guarded correction (m,) and its Jacobian (m, n)."""
        correction = self._numpy_parts(error)
        largest = float(self._unit(self.largest.double()))

        def guarded(q: NDArray) -> tuple[NDArray, NDArray]:
            x, J, strangeness, gradient = correction(q)
            if strangeness > 1.0:
                beyond = strangeness - 1.0
                weight = self._weight(beyond)
                slope = -3.0 * (beyond * weight) ** 2 * gradient
                x, J = weight * x, weight * J + x[:, None] * slope
            relative = math.sqrt(x.dot(x)) / largest
            if relative > 1.0:
                kept, slope = self._kept(relative, math.tanh)
                factor = kept / relative
                fading = (slope - factor) / (relative * largest) ** 2 * x.dot(J)
                x, J = factor * x, factor * J + x[:, None] * fading
            return x, J

        return guarded

    def _numpy_parts(self, error: nn.Module) -> Callable[[NDArray], Any]:
        """Return a NumPy function q -> correction, Jacobian, strangeness and its gradient."""
        correction, strangeness = numpy_function(error), self.numpy_function()
        return lambda q: (*correction(q), *strangeness(q))

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

    def is_long(self, error: Tensor) -> Tensor:
        """Return which corrections (..., m) are longer than the largest, shape (...)."""
        return self._relative(error)[..., 0] > 1.0

    def _unit(self, error: Tensor) -> Tensor:
        return self.largest.to(error).clamp(min=torch.finfo(error.dtype).tiny ** 0.25)

    def _relative(self, error: Tensor) -> Tensor:
        # Up to the largest it counts as one: the root stays smooth, and nothing changes.
        squares = (error / self._unit(error)).square().sum(-1, keepdim=True)
        return squares.clamp(min=1.0).sqrt()

    def _kept(self, relative: Any, tanh: Callable[[Any], Any] = torch.tanh) -> tuple[Any, Any]:
        """Return the length kept of one, both in units of the largest, and its slope."""
        over = self.MOST - 1.0
        bent = tanh((relative - 1.0) / over)
        return 1.0 + over * bent, 1.0 - bent * bent

    @staticmethod
    def _weight(beyond: Any) -> Any:
        return 1.0 / (1.0 + beyond**3)


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

    def _strangeness_and_gradient(self, q: Tensor) -> tuple[Tensor, Tensor]:
        if not hasattr(self.readout, "leverage_and_gradient"):
            return super()._strangeness_and_gradient(q)
        leverage, gradient = self.readout.leverage_and_gradient(q)  # pyright: ignore
        limit = self.limit.to(q)
        return leverage / limit, gradient / limit

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the leverage of q over the limit, shape (...)."""
        return self.readout.leverage(q) / self.limit.to(q)  # pyright: ignore[reportCallIssue]

    def numpy_function(self) -> NumpyStrangeness:
        """Return a NumPy function q (n,) -> strangeness, and its gradient (n,) where above 1."""
        limit, readout = float(self.limit), self.readout
        if hasattr(readout, "numpy_leverage"):
            leverage = readout.numpy_leverage(limit)  # pyright: ignore[reportCallIssue]
        else:
            by_torch = numpy_function(lambda q: readout.leverage(q)[..., None])  # pyright: ignore

            def leverage(q: NDArray) -> tuple[float, NDArray]:
                h, gradient = by_torch(q)
                return float(h[0]), gradient[0]

        return lambda q: _relative(*leverage(q), limit)

    def _numpy_parts(self, error: nn.Module) -> Callable[[NDArray], Any]:
        if self.readout is not error or not hasattr(error, "numpy_leverage"):
            return super()._numpy_parts(error)
        limit = float(self.limit)
        # Its features serve both.
        function = error.numpy_function(limit)  # pyright: ignore[reportCallIssue]

        def parts(q: NDArray) -> Any:
            x, J, leverage, gradient = function(q)
            return x, J, *_relative(leverage, gradient, limit)

        return parts


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

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return 1 inside the box, more outside, shape (...)."""
        low, high = self.low.to(q), self.high.to(q)
        width = torch.where(high > low, high - low, torch.ones_like(low))
        outside = (low - q).clamp(min=0.0) + (q - high).clamp(min=0.0)
        return 1.0 + (100.0 * (outside / width).square()).sum(-1)

    def numpy_function(self) -> NumpyStrangeness:
        """Return a NumPy function q (n,) -> strangeness, and its gradient (n,) where above 1."""
        low, high = _array(self.low), _array(self.high)
        width = np.where(high > low, high - low, 1.0)

        def strangeness(q: NDArray) -> tuple[float, NDArray | None]:
            outside = (q - np.minimum(np.maximum(q, low), high)) / width
            squares = float(outside.dot(outside))
            return 1.0 + 100.0 * squares, 200.0 * outside / width if squares > 0.0 else None

        return strangeness


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
        still = _unexcited(q)
        n = q.shape[1]
        gram[1 : n + 1, 1 : n + 1] += _AS_IF**2 * len(q) * still @ still.mT
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

    def numpy_leverage(self, limit: float) -> NumpyStrangeness:
        """Return a NumPy function q (n,) -> leverage, and its gradient (n,) where above a limit."""
        center, half_width = _array(self.center), _array(self.half_width)
        factor, n = np.asfortranarray(_array(self.factor)), len(self.center)
        solve: Any = lapack.dtrtrs  # pyright: ignore[reportAttributeAccessIssue]

        def leverage(q: NDArray) -> tuple[float, NDArray | None]:
            u = (q - center) / half_width
            white, _ = solve(factor, np.concatenate(([1.0], u, u * u)), lower=1)
            white = white.ravel()
            h = float(white.dot(white))
            if h <= limit:
                return h, None
            by_phi = 2.0 * solve(factor, white, lower=1, trans=1)[0].ravel()
            return h, (by_phi[1 : n + 1] + 2.0 * u * by_phi[n + 1 :]) / half_width

        return leverage


def fit_guard(
    kind: str | None, error_module: Callable[[Tensor], Tensor], q: Tensor
) -> Guard | None:
    """Return the guard of an error model trained on rows q (N, n)."""
    if kind is None:
        return None
    with torch.no_grad():
        largest = error_module(q).norm(dim=-1).max()
        if kind == "box":
            return BoxGuard(q.amin(0), q.amax(0), largest)
        own = isinstance(error_module, nn.Module) and hasattr(error_module, "leverage")
        own = own and not _unexcited(q).numel()
        # Where the log went counts, not how often.
        readout: Any = error_module if own else QuadraticReadout.fit(torch.unique(q, dim=0))
        return LeverageGuard.fit(readout, q, largest)


def _unexcited(q: Tensor) -> Tensor:
    """Return the directions (n, k) of q over its range, that rows (N, n) do not go.

    Balanced tendons leave the common pull of a segment alone, for example. Nothing is known of it,
    but the mechanical model; were any step along it strange, an inverse could use the fading of the
    error model as a way to move the tip.
    """
    spread = q - q.mean(0)
    half_width = 0.5 * (q.amax(0) - q.amin(0))
    spread = spread / torch.where(half_width > 0, half_width, 1.0)
    axes, variances, _ = torch.linalg.svd(spread.mT @ spread)
    return axes[:, variances < _STILL**2 * variances[0]]


def _relative(
    leverage: float, gradient: NDArray | None, limit: float
) -> tuple[float, NDArray | None]:
    return leverage / limit, None if gradient is None else gradient / limit


def _array(tensor: Tensor) -> NDArray:
    return tensor.detach().cpu().double().numpy().copy()
