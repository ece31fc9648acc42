"""Hybrid models of several markers: one for each, on the same calibrated chain."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from torch import Tensor, nn
from typing_extensions import Self

from hybridkin._core.model import ForwardModel
from hybridkin._core.stored import Layout
from hybridkin.hybrid._guards import GroupDistance
from hybridkin.hybrid._module import Hybrid, HybridModule
from hybridkin.learning.regressor_modules import AffineModule


class Stacked(Hybrid):
    """The hybrids of all markers of a chain as one torch module q (..., n) -> x (..., 3 K).

    A row is in the domain if it is in the domains of all markers. The error weight is the least.

    Parameters
    ----------
    mechanical : MarkedChain or None
        The chain of all markers.
    tips : sequence of HybridModule
        The hybrid of every marker, on the chain of that marker alone.
    """

    layout = Layout("stacked", {}, parts=("mechanical", "tips"))

    def __init__(
        self, mechanical: ForwardModel | None, tips: Sequence[HybridModule]
    ) -> None:
        super().__init__()
        self.mechanical = mechanical
        self.tips = nn.ModuleList(tips)
        self.n_actuators = tips[0].n_actuators
        self.n_outputs = 3 * len(tips)

    @property
    def tip_model(self) -> HybridModule:
        """The hybrid of the last marker alone."""
        return cast(HybridModule, self.tips[-1])

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction of the tip acts inside the robot."""
        return self.tip_model.corrects_inside

    @property
    def drift(self) -> AffineModule | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The drift of the tip."""
        return self.tip_model.drift

    @property
    def tested(self) -> GroupDistance | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Distance up to which held-out groups have tested the model of the tip."""
        return self.tip_model.tested

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, which is that of the tip."""
        return self.tip_model.plane

    @property
    def longest_correction(self) -> Tensor | float:
        """Upper bound of the distance from f(q) to x of any marker [m]."""
        return max(tip.longest_correction for tip in self._tips())

    def with_drift(self, drift: AffineModule | None) -> Self:
        """Return the same model with another drift; this model does not change."""
        tips = []
        for k, tip in enumerate(self._tips()):
            if drift is None:
                tips.append(tip.with_drift(None))
                continue
            rows = slice(3 * k, 3 * k + 3)
            tips.append(
                tip.with_drift(AffineModule(drift.coef[rows], drift.bias[rows]))
            )
        return type(self)(self.mechanical, tips)

    def forward(self, q: Tensor) -> Tensor:
        """Return the positions of all markers, shape (..., 3 K) [m]."""
        return torch.cat([tip(q) for tip in self._tips()], dim=-1)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the positions of all markers (..., 3 K) and their derivative (..., 3 K, n)."""
        pairs = [tip.forward_and_jacobian(q) for tip in self._tips()]
        x = torch.cat([x for x, _ in pairs], dim=-1)
        return x, torch.cat([J for _, J in pairs], dim=-2)

    def error_part(self, q: Tensor) -> Tensor:
        """Return the learned parts of all markers, shape (..., 3 K) [m]."""
        return torch.cat([tip.error_part(q) for tip in self._tips()], dim=-1)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the least error weight of a marker, shape (...)."""
        weights = [tip.error_weight(q) for tip in self._tips()]
        return torch.stack(weights, dim=-1).amin(dim=-1)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest distance from the training rows of a marker, shape (...)."""
        distances = [tip.domain_distance(q) for tip in self._tips()]
        return torch.stack(distances, dim=-1).amax(dim=-1)

    def _tips(self) -> list[HybridModule]:
        return cast("list[HybridModule]", [*self.tips])
