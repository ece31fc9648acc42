"""Mechanical model and learned error as one torch module q -> x, with a guard between them."""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import ForwardModel, forward_and_jacobian
from hybridkin.hybrid._guards import Guard, LeverageGuard
from hybridkin.hybrid._serial import SerialModule
from hybridkin.ik._realtime import NumpyFunction, by_torch, numpy_function
from hybridkin.learning.network import ELM
from hybridkin.learning.regressor_modules import AffineModule

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["BlendModule", "HybridModule", "SerialHybridModule"]


class HybridModule(ForwardModel):
    """The sum f_mech(q) + w(q) eps(q) as a torch module q (..., n) -> x (..., m).

    Parameters
    ----------
    mechanical, error : nn.Module or None
        The parts; at least one of them.
    guard : nn.Module or None
        The weight w(q) in [0, 1], shape (..., 1). None: one everywhere.
    drift : AffineModule or None
        What has changed since, w(q) (B q + c), is added.
    """

    def __init__(
        self,
        mechanical: nn.Module | None,
        error: nn.Module | None,
        guard: Guard | None = None,
        drift: AffineModule | None = None,
    ) -> None:
        super().__init__()
        self.mechanical = mechanical
        self.error = error
        self.guard = guard
        self.drift = drift
        self.n_actuators = 0 if mechanical is None else mechanical.n_actuators

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m) [m]."""
        if self.mechanical is None:
            return self.error_part(q)
        if self.error is None and self.drift is None:
            return self.mechanical(q)
        return self.mechanical(q) + self.error_part(q)

    def mechanical_part(self, q: Tensor) -> Tensor:
        """Return f_mech(q), zero without a mechanical model, shape (..., m) [m]."""
        return self.mechanical(q) if self.mechanical is not None else 0.0 * self.error_part(q)

    def error_part(self, q: Tensor) -> Tensor:
        """Return what is added to f_mech(q), w(q) eps(q) and the drift, shape (..., m) [m]."""
        if self.error is None:
            return 0.0 * self.mechanical_part(q) if self.drift is None else self.drift(q)
        parts = [self.error(q)] if self.drift is None else [self.error(q), self.drift(q)]
        if self.guard is not None:
            weight = self.guard(q)
            parts = [weight * part for part in parts]
            parts[0] = self.guard.shortened(parts[0])
        return sum(parts[1:], parts[0])

    def jacobian(self, q: Tensor) -> Tensor:
        """Return dx/dq of the sum, shape (..., m, n)."""
        return self.forward_and_jacobian(q)[1]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n), closed form where the parts offer it."""
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        parts = []
        if self.mechanical is not None:
            parts.append(forward_and_jacobian(self.mechanical, q))
        fading = None
        if self.error is not None:
            x, J, outside = self._error_and_outside(q)
            if self.guard is not None and outside is not None and len(outside):
                fading = outside, *self.guard.weight_and_jacobian(q[outside])
                x, J = _faded(x, J, *fading)
            if self.guard is not None:
                x, J = self.guard.shortened_with_jacobian(x, J)
            parts.append((x, J))
        if self.drift is not None:
            x, J = forward_and_jacobian(self.drift, q)
            parts.append((x, J) if fading is None else _faded(x, J, *fading))
        (x, J), *rest = parts
        for x_part, J_part in rest:
            x, J = x + x_part, J + J_part
        return x, J

    def _error_and_outside(self, q: Tensor) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return eps, its Jacobian, and the rows where its weight may be less than one."""
        guard = self.guard
        if isinstance(guard, LeverageGuard) and guard.readout is self.error is not None:
            if isinstance(self.error, ELM):  # its features serve both
                x, J, inside = self.error.forward_jacobian_and(
                    q, lambda features: guard.is_inside(features)[..., None]
                )
                unsure = (~inside[:, 0]).nonzero()[:, 0]
                return x, J, unsure[~self.in_domain(q[unsure])] if len(unsure) else unsure
        outside = None if guard is None else (~self.in_domain(q)).nonzero()[:, 0]
        return *forward_and_jacobian(self.error, q), outside

    def with_drift(self, drift: AffineModule | None) -> Self:
        """Return the same with another drift; this one stays as it is."""
        module = copy.copy(self)
        module._modules = dict(self._modules)
        module.drift = drift
        return module

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, q (n,) -> x (m,) and dx/dq (m, n).

        The sum of what the parts offer as ``numpy_function``, without torch's overhead; in float64,
        with their present parameters.
        """
        if self.drift is not None:
            return by_torch(self)
        if self.error is None:
            return numpy_function(self.mechanical)
        guard = self.guard
        correction = (
            numpy_function(self.error) if guard is None else guard.numpy_correction(self.error)
        )
        if self.mechanical is None:
            return correction
        mechanical = numpy_function(self.mechanical)

        def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
            x, J = mechanical(q)
            more, slope = correction(q)
            return x + more, J + slope

        return tip_and_jacobian

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the weight w(q) of the error model, shape (...)."""
        return q.new_ones(q.shape[:-1]) if self.guard is None else self.guard(q)[..., 0]

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return how far q is from the training rows, at most 1 among them, shape (...)."""
        if self.guard is None:
            return q.new_zeros(q.shape[:-1])
        return self.guard.domain_distance(q)


class SerialHybridModule(HybridModule):
    """The tip f_mech(z(q) + delta(q)) as a torch module, fading to f_mech(q) out of its domain.

    Parameters
    ----------
    error : SerialModule
        The tip with the correction delta inside, unguarded; it holds the mechanical model.
    guard, drift : nn.Module or None
        As for `HybridModule`; the guard weighs the difference of the two tips.
    """

    error: SerialModule
    mechanical: nn.Module

    def __init__(
        self, error: SerialModule, guard: Guard | None = None, drift: AffineModule | None = None
    ) -> None:
        super().__init__(error.mechanical, error, guard, drift)

    def error_part(self, q: Tensor) -> Tensor:
        """Return what is added to f_mech(q) at the tip, shape (..., m) [m]."""
        part = self.error(q) - self.mechanical(q)
        drift = None if self.drift is None else self.drift(q)
        if self.guard is not None:
            weight = self.guard(q)
            part = self.guard.shortened(weight * part)
            drift = None if drift is None else weight * drift
        return part if drift is None else part + drift

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = self.error.forward_and_jacobian(q)
        drift = None if self.drift is None else forward_and_jacobian(self.drift, q)
        if self.guard is not None:
            long = self.guard.is_long(x - self.mechanical(q))
            rows = (long | ~self.in_domain(q)).nonzero()[:, 0]
            if len(rows):
                fading = self.guard.weight_and_jacobian(q[rows])
                x_mech, J_mech = forward_and_jacobian(self.mechanical, q[rows])
                own, J_own = _weighed(x[rows] - x_mech, J[rows] - J_mech, *fading)
                own, J_own = self.guard.shortened_with_jacobian(own, J_own)
                x = x.index_copy(0, rows, x_mech + own)
                J = J.index_copy(0, rows, J_mech + J_own)
                if drift is not None:
                    drift = _faded(*drift, rows, *fading)
        return (x, J) if drift is None else (x + drift[0], J + drift[1])

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, q (n,) -> x (m,) and dx/dq (m, n)."""
        return by_torch(self)


class BlendModule(HybridModule):
    """The weighted mean of several hybrids over one mechanical model, as a torch module.

    Parameters
    ----------
    parts : sequence of HybridModule
        Each with the same mechanical model.
    weights : Tensor of shape (K,)
        Sum to one.
    drift : AffineModule or None
        As for `HybridModule`; every part's guard weighs its share of it.
    """

    weights: Tensor

    def __init__(
        self, parts: Sequence[HybridModule], weights: Tensor, drift: AffineModule | None = None
    ) -> None:
        super().__init__(parts[0].mechanical, None, None, drift)
        self.parts = nn.ModuleList(parts)
        self.register_buffer("weights", weights)

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m) [m]."""
        return self._mean(q, lambda part: part(q))

    def error_part(self, q: Tensor) -> Tensor:
        """Return what is added to f_mech(q), shape (..., m) [m]."""
        return self._mean(q, lambda part: part.error_part(q))

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = zip(*(part._forward_and_jacobian(q) for part in self._shown()), strict=True)
        weights = self.weights.to(q)
        return torch.tensordot(weights, torch.stack(x), 1), torch.tensordot(
            weights, torch.stack(J), 1
        )

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, q (n,) -> x (m,) and dx/dq (m, n)."""
        weights = self.weights.cpu().numpy()
        functions = [part.numpy_function() for part in self._shown()]

        def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
            x, J = zip(*(function(q) for function in functions), strict=True)
            return np.tensordot(weights, x, 1), np.tensordot(weights, J, 1)

        return tip_and_jacobian

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the mean weight w(q) of the error models, shape (...)."""
        return self._mean(q, lambda part: part.error_weight(q))

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return how far q is from the training rows of the part that knows least, shape (...)."""
        return torch.stack([part.domain_distance(q) for part in self._shown()]).amax(0)

    def _shown(self) -> list[HybridModule]:
        parts: list[Any] = [*self.parts]
        return [part.with_drift(self.drift) for part in parts]

    def _mean(self, q: Tensor, function: Callable[[HybridModule], Tensor]) -> Tensor:
        values = torch.stack([function(part) for part in self._shown()])
        return torch.tensordot(self.weights.to(q), values, 1)


def _weighed(x: Tensor, J: Tensor, weight: Tensor, slope: Tensor) -> tuple[Tensor, Tensor]:
    """Return x (k, m) and J (k, m, n) times a weight (k, 1) of slope (k, 1, n)."""
    return weight * x, weight[..., None] * J + x[..., None] * slope


def _faded(
    x: Tensor, J: Tensor, rows: Tensor, weight: Tensor, slope: Tensor
) -> tuple[Tensor, Tensor]:
    """Return x (N, m) and J (N, m, n), in some rows times a weight (k, 1) of slope (k, 1, n)."""
    own, J_own = _weighed(x[rows], J[rows], weight, slope)
    return x.index_copy(0, rows, own), J.index_copy(0, rows, J_own)
