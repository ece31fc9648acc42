"""Error models: one class for each way to learn the residual of a mechanical model."""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import cached_property
from math import inf, nan
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import BaseEstimator, clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.utils.validation import has_fit_parameter
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.model import ForwardModel
from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import points
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._features import (
    Features,
    HiddenFeatures,
    PoseFeatures,
    Projected,
    QuadraticFeatures,
)
from hybridkin.hybrid._guards import fit_guard
from hybridkin.hybrid._kernel import tuned_kernel
from hybridkin.hybrid._linearised import Pair
from hybridkin.hybrid._module import (
    HybridModule,
    InnerCorrection,
    TipCorrection,
)
from hybridkin.hybrid._readout_fit import ReadoutFit, fit_readout
from hybridkin.hybrid._rows import Rows
from hybridkin.learning.elm import ELMRegressor, draw_layer
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.regressor_modules import error_module

FEATURES = ("linear", "quadratic", "pose")
_LEAST = 0.2  # assumed lower limit of training errors, as a share of the errors before learning
_LARGEST_LEVERAGE = 0.999
_MOST = 2000  # rows whose training errors are computed


class Blend(NamedTuple):
    """Several fitted error models; the result is the weighted mean of their hybrids."""

    weights: tuple[float, ...]
    error_models: tuple[Any, ...]


@dataclass(frozen=True)
class Residuals:
    """What a mechanical model leaves of measured rows, and how a correction of it is limited."""

    rows: Rows  # different rows; y are tips [m]
    error: NDArray  # measured minus mechanical model, shaped like y [m]
    mechanical: ForwardModel | None
    guard: str | None = None  # see `fit_guard`
    left_out: bool = True  # whether held-out residuals are needed as well

    @cached_property
    def directions(self) -> Directions:
        """The directions of q that the rows move."""
        return moved_directions(self.rows.X)


@dataclass(frozen=True)
class FittedError:
    """A fitted error model.

    Attributes
    ----------
    result : estimator, ReadoutFit, Blend, tuple or None
        What `HybridForwardModel.error_model_` shows; a tuple holds one for each marker.
    corrections : tuple of (float, TipCorrection)
        Weights and guarded corrections.
    settled : ErrorModel
        The error model with the settings that were chosen, for fits to other rows.
    noise : float
        Standard deviation of one coordinate of the residual that remains, on held-out rows where
        the error model has them [m]. NaN: not computed.
    """

    result: Any
    corrections: tuple[tuple[float, TipCorrection], ...]
    settled: ErrorModel
    noise: float = nan


class ErrorModel(ABC):
    """A way to learn the residual, measured minus mechanical model."""

    learns = True

    @abstractmethod
    def fit(self, residuals: Residuals) -> FittedError:
        """Return the error model fitted to residuals; it does not change itself."""

    def for_markers(
        self, residuals: Residuals, tips: Sequence[Any]
    ) -> list[ErrorModel]:
        """Return the error model of every marker, given the residuals of all and their chains."""
        return [self for _ in tips]


class NoCorrection(ErrorModel):
    """The mechanical model alone."""

    learns = False

    def fit(self, residuals: Residuals) -> FittedError:
        """Return the error model without corrections."""
        noise = _spread(residuals.error, residuals.rows.counts)
        return FittedError(None, (), self, noise)


class FeatureModel(ErrorModel):
    """A readout of features of q, at the tip or inside the robot.

    Parameters
    ----------
    coupling : {"parallel", "serial"}
        Where the readout acts.
    alphas : tuple of two floats, optional
        Penalties of the linear and of the other features. Default: chosen by held-out errors.
    noise_ratio : float, default=inf
        See `fit_readout`.
    """

    def __init__(
        self, coupling: str, alphas: Pair | None = None, noise_ratio: float = inf
    ) -> None:
        self.coupling = coupling
        self.alphas = alphas
        self.noise_ratio = noise_ratio

    @abstractmethod
    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""

    def fit(self, residuals: Residuals) -> FittedError:
        """Return the fitted readout; without motion of the rows there is nothing to learn."""
        if not residuals.directions.moved.size:
            return replace(NoCorrection().fit(residuals), settled=self)
        return self._fitted(self.read_out(residuals), residuals)

    def read_out(self, residuals: Residuals) -> ReadoutFit:
        """Return the readout of least tip error."""
        rows = residuals.rows
        mechanical = residuals.mechanical
        assert mechanical is not None
        try:
            return fit_readout(
                mechanical,
                self.features(rows.q, mechanical),
                rows,
                self.coupling,
                self.alphas,
                self.noise_ratio,
                residuals.left_out,
            )
        except torch.linalg.LinAlgError as error:  # pyright: ignore
            raise too_far() from error

    def for_markers(
        self, residuals: Residuals, tips: Sequence[Any]
    ) -> list[ErrorModel]:
        """Return the error model of every marker; a serial one is learned once from all."""
        if self.coupling == "parallel" or not residuals.directions.moved.size:
            return super().for_markers(residuals, tips)
        read_out = self.read_out(residuals)
        return [_ReadOut(self, read_out, tip) for tip in tips]

    def _settled(self, fit: ReadoutFit) -> Self:
        settled = copy.copy(self)
        settled.alphas = fit.alphas
        settled.noise_ratio = fit.noise_ratio
        return settled

    def _fitted(self, fit: ReadoutFit, residuals: Residuals) -> FittedError:
        module = _on_moved_directions(fit.readout, residuals.directions)
        if self.coupling == "serial":
            correction = InnerCorrection(module)
        else:
            correction = TipCorrection(module)
        noise = fit.rmse / points(fit.residual).shape[2] ** 0.5
        return FittedError(
            fit, _guarded(correction, module, residuals), self._settled(fit), noise
        )


class NamedFeatures(FeatureModel):
    """A readout of features that a name stands for.

    Parameters
    ----------
    name : {"linear", "quadratic", "pose"}
        The features.
    coupling, alphas, noise_ratio
        As of `FeatureModel`.
    """

    def __init__(
        self,
        name: str,
        coupling: str,
        alphas: Pair | None = None,
        noise_ratio: float = inf,
    ) -> None:
        super().__init__(coupling, alphas, noise_ratio)
        self.name = name

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        if self.name == "linear":
            return Features.of_range(q)
        if self.name == "quadratic":
            return QuadraticFeatures.of_range(q)
        if isinstance(mechanical, ArcChain):
            return PoseFeatures.of_range(q, mechanical)
        raise TypeError(
            "`mechanical_model` must be a chain of arcs with error_model='pose', got "
            f"{type(mechanical).__name__}; use error_model='quadratic'."
        )


class HiddenLayer(FeatureModel):
    """A readout of the hidden layer of a network, inside the robot.

    The `alpha` of an ELMRegressor is the penalty; for an ELMRegressorCV the penalties are chosen.

    Parameters
    ----------
    network : ELMRegressor or ELMRegressorCV
        Its hidden layer is used.
    """

    def __init__(self, network: ELMRegressor | ELMRegressorCV) -> None:
        super().__init__("serial")
        if isinstance(network, ELMRegressorCV):
            self.layer = ELMRegressor(
                int(np.max(network.n_hidden)),
                activation=network.activation,
                random_state=network.random_state,
            )
            return
        self.layer = network
        if np.ndim(network.alpha):
            raise ValueError(
                "`alpha` of the error model must be one number with coupling='serial', got "
                f"{network.alpha!r}: coordinates inside the robot do not correspond to single "
                "outputs."
            )
        self.alphas = (float(network.alpha), float(network.alpha))

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        layer = draw_layer(self.layer, q.numpy(), None)
        return HiddenFeatures.of_range(
            q, layer.input_weights, layer.input_bias, layer.activation
        )


class _ReadOut(ErrorModel):
    """The readout that was learned from all markers, for the chain of one of them."""

    def __init__(self, model: FeatureModel, fit: ReadoutFit, tip: ArcChain) -> None:
        self._model = model
        self._fit = fit._replace(readout=fit.readout.up_to(tip))

    def fit(self, residuals: Residuals) -> FittedError:
        """Return the readout with the guard for the residuals of the marker."""
        return self._model._fitted(self._fit, residuals)


class RegressorModel(ErrorModel):
    """A scikit-learn regressor of the residual at the tip.

    Parameters
    ----------
    regressor : estimator
        It is cloned.
    """

    def __init__(self, regressor: object) -> None:
        self.regressor = regressor

    def fit(self, residuals: Residuals) -> FittedError:
        """Return the fitted regressor; without motion of the rows there is nothing to learn."""
        directions = residuals.directions
        if residuals.mechanical is not None and not directions.moved.size:
            return replace(NoCorrection().fit(residuals), settled=self)
        # A regressor sees only what the rows moved; random weights slope in all directions.
        rows = replace(residuals.rows, y=residuals.error)
        if directions.still.size:
            matrix, offset = directions.projection()
            rows = replace(rows, X=(rows.X @ matrix + offset).astype(rows.X.dtype))
        regressor = self._fitted(rows)
        network = error_module(regressor, rows.q)
        module = _on_moved_directions(network, directions)
        corrections = _guarded(TipCorrection(module), module, residuals)
        noise = self._noise(regressor, network, rows) if residuals.left_out else nan
        return FittedError(regressor, corrections, self._settled(regressor), noise)

    def _fitted(self, rows: Rows) -> Any:
        regressor: Any = clone(self.regressor)
        if not has_fit_parameter(regressor, "sample_weight"):
            rows = rows.repeated()
        options = {}
        if rows.weights is not None:
            options["sample_weight"] = rows.weights
        if rows.groups is not None and has_fit_parameter(regressor, "groups"):
            options["groups"] = rows.groups
        with TURNS.filters if isinstance(regressor, KernelRidge) else nullcontext():
            return regressor.fit(rows.X, rows.y, **options)

    def _settled(self, regressor: object) -> ErrorModel:
        return self

    def _noise(self, regressor: object, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of training errors; regressors may overfit, so it has a least share."""
        rows = rows.thinned(_MOST)
        before = rows.tips
        with torch.no_grad():
            after = before - module(rows.q).numpy()
        least = _LEAST * np.sqrt(np.var(before, axis=0).mean())
        return max(_spread(after, rows.counts), float(least))


class NetworkModel(RegressorModel):
    """An extreme learning machine of the residual at the tip."""

    def _noise(self, regressor: Any, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of leave-one-out errors."""
        rows = rows.thinned(_MOST)
        network = regressor.module_
        with torch.no_grad():
            after = rows.tips - network(rows.q).numpy()
            leverage = rows.counts * network.leverage(rows.q).numpy()
        return _spread(
            after / (1.0 - leverage.clip(max=_LARGEST_LEVERAGE))[:, None], rows.counts
        )


class NetworkModelCV(RegressorModel):
    """An extreme learning machine that chooses its own settings."""

    def _fitted(self, rows: Rows) -> Any:
        network = super()._fitted(rows)
        network.left_out_errors_ = rows.as_given(network.left_out_errors_)
        return network

    def _settled(self, regressor: Any) -> ErrorModel:
        return NetworkModel(ELMRegressor(**regressor.best_params_))

    def _noise(self, regressor: Any, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of the errors of rows that were held out."""
        return float(np.sqrt(np.nanmean(np.square(regressor.left_out_errors_))))


class KernelModel(RegressorModel):
    """Kernel ridge with the width and the penalty of least held-out error."""

    def __init__(self) -> None:
        super().__init__(None)

    def _fitted(self, rows: Rows) -> Any:
        tuned = tuned_kernel(rows.X, rows.y, rows.counts, rows.groups)
        return RegressorModel(tuned)._fitted(rows)

    def _settled(self, regressor: object) -> ErrorModel:
        return RegressorModel(clone(regressor))


class WeightedModels(ErrorModel):
    """The weighted mean of several error models.

    Parameters
    ----------
    weights : sequence of float
        They sum to one.
    models : sequence of ErrorModel
        The error models.
    """

    def __init__(self, weights: Sequence[float], models: Sequence[ErrorModel]) -> None:
        self.weights = tuple(weights)
        self.models = tuple(models)

    def fit(self, residuals: Residuals) -> FittedError:
        """Return all models fitted to the same residuals."""
        fits = [model.fit(residuals) for model in self.models]
        corrections = []
        for weight, fitted in zip(self.weights, fits, strict=True):
            corrections += [
                (weight * part, correction) for part, correction in fitted.corrections
            ]
        blend = Blend(self.weights, tuple(fitted.result for fitted in fits))
        return FittedError(blend, tuple(corrections), self)

    def for_markers(
        self, residuals: Residuals, tips: Sequence[Any]
    ) -> list[ErrorModel]:
        """Return the weighted mean for every marker."""
        by_model = [model.for_markers(residuals, tips) for model in self.models]
        return [
            WeightedModels(self.weights, models)
            for models in zip(*by_model, strict=True)
        ]


class PerMarker(ErrorModel):
    """One error model for each marker.

    Parameters
    ----------
    models : sequence of ErrorModel
        In the order of the markers.
    """

    def __init__(self, models: Sequence[ErrorModel]) -> None:
        self.models = tuple(models)

    def fit(self, residuals: Residuals) -> FittedError:
        """Raise: markers are fitted one by one."""
        raise TypeError(
            "an error model for each marker cannot be fitted to one of them"
        )

    def for_markers(
        self, residuals: Residuals, tips: Sequence[Any]
    ) -> list[ErrorModel]:
        """Return the error model of every marker; serial ones have the same settings for all."""
        first = self.models[0]
        if isinstance(first, FeatureModel) and first.coupling == "serial":
            return first.for_markers(residuals, tips)
        return [*self.models]


def error_model_of(
    setting: BaseEstimator | str | None,
    coupling: str,
    seed: int | np.random.RandomState | None,
) -> ErrorModel:
    """Return the error model for the settings of a HybridForwardModel, which are checked already.

    Parameters
    ----------
    setting : estimator, str or None
        `error_model`, except "auto".
    coupling : {"parallel", "serial"}
        Where it acts.
    seed : int, RandomState or None
        Seed of networks without one.
    """
    if setting == "drop":
        return NoCorrection()
    if setting == "kernel":
        return KernelModel()
    if isinstance(setting, str) and setting in FEATURES:
        return NamedFeatures(setting, coupling)
    if setting is None or setting == "elm":
        setting = ELMRegressor()
    if not isinstance(setting, (ELMRegressor, ELMRegressorCV)):
        return RegressorModel(setting)
    network: Any = clone(setting)
    if network.random_state is None:
        network.set_params(random_state=seed)
    if coupling == "serial":
        return HiddenLayer(network)
    kind = NetworkModel if isinstance(network, ELMRegressor) else NetworkModelCV
    return kind(network)


def _on_moved_directions(module: ForwardModel, directions: Directions) -> ForwardModel:
    """Return the module for the part of q that the rows moved."""
    if not directions.still.size:
        return module
    matrix, offset = directions.projection()
    return Projected(module, torch.from_numpy(matrix), torch.from_numpy(offset))


def _guarded(
    correction: TipCorrection, module: ForwardModel, residuals: Residuals
) -> tuple[tuple[float, TipCorrection], ...]:
    """Return the correction with its guard; without a mechanical model nothing would remain."""
    if residuals.mechanical is not None:
        q = residuals.rows.q
        alone = HybridModule(residuals.mechanical, [correction], q.new_ones(1))
        with torch.no_grad():
            values = alone.error_part(q)
        correction.guard = fit_guard(
            residuals.guard, values, module, q, residuals.rows.counts
        )
    return ((1.0, correction),)


def _spread(residual: NDArray, counts: NDArray) -> float:
    """Return the root mean square of residuals (N, m) or (N,), without missing markers."""
    squares = np.ma.masked_invalid(residual.reshape(len(residual), -1) ** 2)
    return float(np.ma.average(squares, axis=0, weights=counts).mean() ** 0.5)
