"""Error models that are readouts of features, at the tip or inside the robot; and blends."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from hybridkin.chains.arc_chain import ArcChain
from hybridkin.hybrid._features import Features, HiddenFeatures, QuadraticFeatures
from hybridkin.hybrid._guards import fit_guard
from hybridkin.hybrid._linearised import Pair
from hybridkin.hybrid._module import BlendModule, HybridModule, SerialHybridModule
from hybridkin.hybrid._pose_features import PoseFeatures
from hybridkin.hybrid._readout_fit import SerialFit, fit_serial
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.hidden_layer import draw_layer

__all__ = ["COUPLINGS", "READOUTS", "Blend", "Readout", "blended", "fit_coupled"]

COUPLINGS = {"parallel": "tip", "serial": "coordinates"}
"""Where the error acts, by the name of the coupling."""

READOUTS = ("linear", "quadratic", "pose")
"""Error models by name: features, whose penalties are chosen by rows or groups left out."""


class Readout(NamedTuple):
    """An error model by name, with its penalties where they are settled."""

    kind: str
    alphas: Pair | None = None
    noise_ratio: float = inf


class Blend(NamedTuple):
    """Several error models, the hybrids of which are averaged."""

    weights: tuple[float, ...]
    error_models: tuple[Any, ...]


def blended(weights: Sequence[float], fits: Sequence[tuple[Any, HybridModule]]) -> tuple[Any, Any]:
    """Return error model and module of the weighted mean of fitted hybrids; of one these as is."""
    if len(fits) == 1:
        return fits[0]
    models, modules = zip(*fits, strict=True)
    shares = torch.tensor(weights, dtype=torch.float64)
    return Blend(tuple(weights), models), BlendModule(modules, shares)


def fit_coupled(
    error_model: Any,
    coupling: str,
    mechanical: nn.Module,
    q: Tensor,
    x: Tensor,
    weights: NDArray | None,
    groups: Any,
    guard: str | None,
) -> tuple[SerialFit, SerialHybridModule]:
    """Return the fitted readout and the hybrid of it, guarded.

    Parameters
    ----------
    error_model : {"linear", "quadratic", "pose"}, Readout, ELMRegressor or ELMRegressorCV
        The features: of an ELMRegressor its hidden layer, with its `alpha` as the penalty; an
        ELMRegressorCV gives a hidden layer and has the penalties chosen.
    coupling : {"parallel", "serial"}
        Where the error acts.
    mechanical : nn.Module
        Maps q (N, n) to x (N, m).
    q, x : Tensor of shape (N, n) and (N, m)
        Measured rows.
    weights, groups : array-like of shape (N,) or None
        How often each row counts; its motion.
    guard : {"leverage", "box"} or None
        Where the error is trusted.
    """
    kept = q if weights is None else q[torch.from_numpy(weights > 0)]
    features, alphas = _features(error_model, mechanical, kept)
    fit = fit_serial(
        mechanical,
        features,
        q,
        x,
        place=COUPLINGS[coupling],
        sample_weight=None if weights is None else torch.from_numpy(weights),
        groups=groups,
        alphas=alphas,
        noise_ratio=getattr(error_model, "noise_ratio", inf),
    )
    module = SerialHybridModule(fit.module)
    module.guard = fit_guard(guard, module.error_part, kept)
    return fit, module


def _features(error_model: Any, mechanical: Any, q: Tensor) -> tuple[Features, Pair | None]:
    """Return the features, and the penalties where they are given."""
    if isinstance(error_model, str):
        error_model = Readout(error_model)
    if isinstance(error_model, Readout):
        if error_model.kind == "pose":
            if not isinstance(mechanical, ArcChain):
                raise TypeError(
                    f"`mechanical_model` must be a chain of arcs, a ConstantCurvatureChain or an "
                    f"ElasticTendonChain, with error_model='pose', got "
                    f"{type(mechanical).__name__}; use error_model='quadratic'."
                )
            return PoseFeatures.of_range(q, mechanical), error_model.alphas
        kinds: dict[str, Any] = {"linear": Features, "quadratic": QuadraticFeatures}
        return kinds[error_model.kind].of_range(q), error_model.alphas
    params = error_model
    if isinstance(error_model, ELMRegressorCV):
        params = ELMRegressor(
            n_hidden=int(np.max(error_model.n_hidden)),
            activation=error_model.activation,
            random_state=error_model.random_state,
        )
    if np.ndim(params.alpha):
        raise ValueError(
            "`alpha` of the error model must be one number where it acts inside the robot, got "
            f"{params.alpha!r}: no output of its own belongs to a coordinate there."
        )
    layer = draw_layer(params, q.numpy(), None)
    features = HiddenFeatures.of_range(
        q, layer.input_weights, layer.input_bias, activation=layer.activation
    )
    alpha = float(params.alpha)
    return features, None if params is not error_model else (alpha, alpha)
