"""Hybrid models of several markers: one module for each, on the same calibrated chain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from typing_extensions import Self

from hybridkin._core.model import ForwardModel
from hybridkin._core.stored import Layout
from hybridkin.hybrid._module import HybridModule, Inside
from hybridkin.learning.regressor_modules import AffineModule


class MarkedHybridModule(HybridModule):
    """The hybrids of all markers of a chain as one torch module q (..., n) -> x (..., 3 K).

    A row is in the domain if it is in the domains of all markers. The error weight is the least.

    Parameters
    ----------
    mechanical : MarkedChain or None
        The chain of all markers.
    tips : sequence of HybridModule
        The hybrid of every marker, on the chain of that marker alone.
    """

    layout = Layout("marked_hybrid_module", {}, parts=("mechanical", "tips"))

    def __init__(self, mechanical: ForwardModel | None, tips: Sequence[HybridModule]) -> None:
        super().__init__(mechanical, [], tips[0].weights.new_zeros(0))
        self.tips = nn.ModuleList(tips)

    @property
    def tip_model(self) -> HybridModule:
        """The hybrid of the last marker alone."""
        return cast(HybridModule, self.tips[-1])

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction of the tip acts inside the robot."""
        return self.tip_model.corrects_inside

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, which is that of the tip."""
        return self.tip_model.plane

    @property
    def longest_correction(self) -> Tensor | float:
        """Upper bound of the distance from f(q) to x of any marker [m]."""
        return max(tip.longest_correction for tip in cast("list[HybridModule]", self.tips))

    def with_drift(self, drift: AffineModule | None) -> Self:
        """Return the same model with another drift; this model does not change."""
        moved = []
        for k, tip in enumerate(self.tips):
            rows = slice(3 * k, 3 * k + 3)
            own = drift and AffineModule(drift.coef[rows], drift.bias[rows])
            moved.append(cast(HybridModule, tip).with_drift(own))
        return type(self)(self.mechanical, moved)

    def _each(self, name: str, *given: object) -> list:
        """Return the result of a method for the module of every marker."""
        return [getattr(tip, name)(*given) for tip in self.tips]

    def _inside(self, q: Tensor) -> None:
        """Return None: every marker has its own."""

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        return (torch.cat(self._each("forward", q), dim=-1),)

    def _learned(self, q: Tensor, inside: Inside | None) -> Tensor:
        return torch.cat(self._each("error_part", q), dim=-1)

    def _trust(self, q: Tensor) -> Tensor:
        return torch.stack(self._each("error_weight", q), dim=1).amin(1, keepdim=True)

    def _distance(self, q: Tensor) -> Tensor:
        return torch.stack(self._each("domain_distance", q), dim=1).amax(1, keepdim=True)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = zip(*self._each("forward_and_jacobian", q), strict=True)
        return torch.cat(x, dim=1), torch.cat(J, dim=1)
