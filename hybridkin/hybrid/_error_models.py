"""Error models: one class for each way to learn the residual of a mechanical model.

A class with a name is an option of ``HybridForwardModel(error_model=...)``, see `named`.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import replace
from math import inf, nan
from typing import Any, Generic, NamedTuple, TypeVar, cast

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.frozen import FrozenEstimator
from sklearn.kernel_ridge import KernelRidge
from sklearn.utils.validation import check_is_fitted, has_fit_parameter
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.directions import Directions
from hybridkin._core.model import ForwardModel, ZeroModel
from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import points
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._features import (
    Features,
    HiddenFeatures,
    PoseFeatures,
    Projected,
    QuadraticFeatures,
    Readout,
)
from hybridkin.hybrid._kernel import tuned_kernel
from hybridkin.hybrid._linearised import Pair
from hybridkin.hybrid._module import InnerCorrection, TipCorrection
from hybridkin.hybrid._readout_fit import ReadoutFit, fit_readout
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, FittedError, Seed, Spec, Weighted
from hybridkin.learning.elm import ELMRegressor, draw_layer
from hybridkin.learning.elm_cv import ELMRegressorCV
from hybridkin.learning.regressor_modules import (
    Regressor,
    ResidualRegressor,
    UnitSpread,
    error_module,
    sees_scale,
)

_LEAST = 0.2  # assumed lower limit of training errors, as a share of the errors before learning
_LARGEST_LEVERAGE = 0.999
_MOST = 2000  # rows whose training errors are computed

NAMED: dict[str, type[ErrorModel]] = {}
"""Error models by name."""
_Class = TypeVar("_Class", bound=type[ErrorModel])
_Regressor = TypeVar("_Regressor")


def named(name: str) -> Callable[[_Class], _Class]:
    """Return a decorator that makes an error model an option of `HybridForwardModel`."""

    def register(cls: _Class) -> _Class:
        NAMED[name] = cls
        return cls

    return register


class TipModel(ErrorModel):
    """An error model of one tip; several markers are fitted one by one."""

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the error model fitted to every marker."""
        return _of_markers([self.fit_tip(*part) for part in spec.by_marker(rows)])

    @abstractmethod
    def fit_tip(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the error model fitted to the rows of one tip."""


class PerMarker(ErrorModel):
    """One error model for each marker.

    Parameters
    ----------
    models : sequence of ErrorModel
        In the order of the markers.
    """

    def __init__(self, models: Sequence[ErrorModel]) -> None:
        self.models = tuple(models)

    def without_errors(self) -> ErrorModel:
        """Return these models for fits of which only the predictions count."""
        return PerMarker([model.without_errors() for model in self.models])

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return every error model fitted to its marker."""
        fits = []
        for model, part in zip(self.models, spec.by_marker(rows), strict=True):
            fits.append(model.fit(*part))
        return _of_markers(fits)


def _of_markers(fits: list[FittedError]) -> FittedError:
    """Return the fits of all markers as one."""
    if len(fits) == 1:
        return fits[0]
    first = fits[0]
    results = None
    if first.result is not None:
        results = tuple(fitted.result for fitted in fits)
    variances = [fitted.noise**2 for fitted in fits]
    return FittedError(
        results,
        [fitted.corrections[0] for fitted in fits],
        PerMarker([fitted.settled for fitted in fits]),
        float(np.sqrt(np.mean(variances))),
        first.rejected,
        first.held_out,
    )


@named("drop")
class NoCorrection(TipModel):
    """The mechanical model alone."""

    learns = False
    for_poses = True

    def fit_tip(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the error model without corrections."""
        return _nothing(self, rows)


def _nothing(model: ErrorModel, rows: Rows) -> FittedError:
    """Return the result of an error model for rows that give nothing to learn."""
    return FittedError(None, [[]], model, _spread(_residual(rows), rows.counts))


class FeatureModel(TipModel):
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

    def __init__(self, coupling: str, alphas: Pair | None = None, noise_ratio: float = inf) -> None:
        self.coupling = coupling
        self.alphas = alphas
        self.noise_ratio = noise_ratio
        self.near = False  # whether penalties are chosen near these
        self.start: Readout | None = None  # of a fit to other rows
        self.exact = True  # whether the search goes on below the noise

    @classmethod
    def of(cls, coupling: str, random_state: Seed) -> Self:
        """Return the error model for these settings of a HybridForwardModel."""
        return cls(coupling)

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return the model that chooses its penalties near the settled ones."""
        if not isinstance(settled, FeatureModel):  # one for each marker
            return self
        near = copy.copy(settled)
        near.near = True
        return near

    def down_to_noise(self) -> Self:
        """Return the model whose search ends where steps gain less than the noise of the rows.

        Its held-out errors are as small, in a fraction of the time.
        """
        model = copy.copy(self)
        model.exact = False
        return model

    @abstractmethod
    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fitted readouts; inside the robot one readout is learned from all markers."""
        markers = spec.by_marker(rows)
        at_tip = self.coupling == "parallel"
        if at_tip or len(markers) == 1 or not rows.directions.moved.size:
            return super().fit(rows, spec)
        read_out = self.read_out(rows, spec)
        fits = []
        for of_marker, marker in markers:
            assert marker.mechanical is not None
            readout = read_out.readout.up_to_tip_of(marker.mechanical.robot)
            fit = read_out._replace(readout=readout)
            fits.append(self._with_correction(fit, of_marker))
        return replace(_of_markers(fits), settled=fits[0].settled)

    def fit_tip(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fitted readout; without motion of the rows there is nothing to learn."""
        if spec.mechanical is not None and not rows.directions.moved.size:
            return _nothing(self, rows)
        return self._with_correction(self.read_out(rows, spec), rows)

    def read_out(self, rows: Rows, spec: Spec) -> ReadoutFit:
        """Return the readout of least tip error."""
        mechanical = spec.mechanical
        if mechanical is None:
            mechanical = ZeroModel(rows.q.shape[1], rows.tips.shape[1])
        try:
            return fit_readout(
                mechanical,
                self.features(rows.q, mechanical),
                rows,
                self.coupling,
                self.alphas,
                self.noise_ratio,
                self.tells_errors,
                self.near,
                self.start,
                self.exact,
            )
        except torch.linalg.LinAlgError as error:  # pyright: ignore
            raise too_far() from error

    def _with_correction(self, fit: ReadoutFit, rows: Rows) -> FittedError:
        module = _on_moved_directions(fit.readout, rows.directions)
        if self.coupling == "serial":
            correction = InnerCorrection(module)
        else:
            correction = TipCorrection(module)
        settled = copy.copy(self)
        settled.tells_errors = True
        settled.alphas = fit.alphas
        settled.noise_ratio = fit.noise_ratio
        settled.near = False
        settled.start = fit.readout
        noise = fit.rmse / points(fit.residual).shape[2] ** 0.5
        return FittedError(
            fit,
            [[(1.0, correction)]],
            settled,
            noise,
            rejected=fit.alphas == (inf, inf),
            held_out=True,
        )


@named("linear")
class LinearModel(FeatureModel):
    """A linear function of q."""

    needs_mechanical = False

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        return Features.of_range(q)


@named("quadratic")
class QuadraticModel(FeatureModel):
    """A quadratic function of q."""

    needs_mechanical = False

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        return QuadraticFeatures.of_range(q)


@named("pose")
class ShapeModel(FeatureModel):
    """A linear function of q and of the shape of a chain, on which loads act."""

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        robot = mechanical.robot
        if robot.n_arcs:
            return PoseFeatures.of_range(q, robot)
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

    def knows_held_out_error(self, rows: Rows) -> bool:
        """Return True: `fit_readout` holds out rows, or groups if given."""
        return True

    def features(self, q: Tensor, mechanical: ForwardModel) -> Features:
        """Return the features for training rows q (N, n)."""
        layer = draw_layer(self.layer, q.numpy(), np.ones(len(q)))
        return HiddenFeatures.of_range(q, layer.input_weights, layer.input_bias, layer.activation)


class RegressorModel(TipModel, Generic[_Regressor]):
    """A scikit-learn regressor of the residual at the tip.

    Parameters
    ----------
    regressor : estimator
        It is cloned.
    """

    couplings = ("parallel",)
    for_poses = True
    needs_mechanical = False
    holds_out = False  # whether `_noise` is that of held-out rows

    def __init__(self, regressor: _Regressor) -> None:
        self.regressor = regressor

    def fit_tip(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the fitted regressor; without motion of the rows there is nothing to learn."""
        directions = rows.directions
        if spec.mechanical is not None and not directions.moved.size:
            return _nothing(self, rows)
        # A regressor sees only what the rows moved; random weights slope in all directions.
        if directions.still.size:
            matrix, offset = directions.projection()
            rows = replace(rows, X=(rows.X @ matrix + offset).astype(rows.X.dtype))
        regressor = self._learned(rows)
        module = error_module(cast(Regressor, regressor), rows.q)
        noise = nan
        if self.tells_errors:
            noise = self._noise(regressor, module, rows)
        correction = TipCorrection(_on_moved_directions(module, directions))
        return FittedError(
            self._shown(regressor, rows),
            [[(1.0, correction)]],
            self._settled(regressor),
            noise,
            held_out=self.holds_out,
        )

    def _learned(self, rows: Rows) -> _Regressor:
        return _fit_to_residuals(self.regressor, rows)

    def knows_held_out_error(self, rows: Rows) -> bool:
        """Return whether the `noise` of its fit is that of held-out rows, or groups if given."""
        return self.holds_out and not rows.groups.whole

    def _settled(self, regressor: _Regressor) -> ErrorModel:
        return self

    def _shown(self, regressor: _Regressor, rows: Rows) -> _Regressor:
        """Return the fitted regressor with its results for the rows as they were given."""
        return regressor

    def _noise(self, regressor: _Regressor, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of training errors; regressors may overfit, so it has a least share."""
        rows = rows.thinned(_MOST)
        before = _residual(rows)
        with torch.no_grad():
            after = before - module(rows.q).numpy()
        mean = np.average(before, axis=0, weights=rows.counts)
        least = _LEAST * _spread(before - mean, rows.counts)
        return max(_spread(after, rows.counts), least)


class ForeignModel(RegressorModel[Any]):
    """A regressor of another library, which sees residuals of unit spread."""

    def _learned(self, rows: Rows) -> Any:
        regressor = self.regressor
        if sees_scale(regressor):
            scaling = UnitSpread.of(_residual(rows), rows.counts)
            regressor = ResidualRegressor(regressor, scaling)
        with TURNS.filters:  # it may change them while it fits
            return _fit_to_residuals(regressor, rows)


class FrozenModel(RegressorModel[FrozenEstimator]):
    """A regressor that was fitted to residuals before, for example to a stream of rows.

    The rows of a fit give its guard, its domain and its errors.
    """

    def fit_tip(self, rows: Rows, spec: Spec) -> FittedError:
        """Return a copy of the regressor."""
        regressor: Any = copy.deepcopy(self.regressor.estimator)
        check_is_fitted(regressor)
        residual = _residual(rows)
        n_inputs = rows.X.shape[1]
        n_known = getattr(regressor, "n_features_in_", n_inputs)
        if n_known != n_inputs:
            raise ValueError(
                f"`error_model` must take {n_inputs} actuators, but the frozen regressor was "
                f"fitted to {n_known} inputs; fit it to the residuals of this robot."
            )
        module = error_module(regressor, rows.q)
        with torch.no_grad():
            learned = module(rows.q).numpy().reshape(len(rows), -1)
        n_outputs = residual.shape[1]
        if learned.shape[1] != n_outputs:
            raise ValueError(
                f"`error_model` must predict {n_outputs} columns, the residual of one tip or pose, "
                f"but the frozen regressor predicts {learned.shape[1]}; fit it to y minus the "
                "prediction of the mechanical model."
            )
        noise = _spread(residual - learned, rows.counts)
        return FittedError(regressor, [[(1.0, TipCorrection(module))]], self, noise)


class NetworkModel(RegressorModel[ELMRegressor]):
    """An extreme learning machine of the residual at the tip."""

    holds_out = True

    def _noise(self, regressor: ELMRegressor, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of leave-one-out errors."""
        rows = rows.thinned(_MOST)
        network = regressor.module_
        with torch.no_grad():
            after = _residual(rows) - network(rows.q).numpy()
            leverage = rows.counts * network.leverage(rows.q).numpy()
        remaining = 1.0 - leverage.clip(max=_LARGEST_LEVERAGE)
        return _spread(after / remaining[:, None], rows.counts)


class NetworkModelCV(RegressorModel[ELMRegressorCV]):
    """An extreme learning machine that chooses its own settings."""

    holds_out = True

    def _settled(self, regressor: ELMRegressorCV) -> ErrorModel:
        return NetworkModel(ELMRegressor(**regressor.best_params_))

    def _shown(self, regressor: ELMRegressorCV, rows: Rows) -> ELMRegressorCV:
        """Return the network with the errors of the given rows."""
        regressor.left_out_errors_ = rows.as_given(regressor.left_out_errors_)
        return regressor

    def knows_held_out_error(self, rows: Rows) -> bool:
        """Return True: it holds out rows, or groups if given."""
        return True

    def starting_at(self, settled: ErrorModel) -> ErrorModel:
        """Return the model with a shorter search, which starts at the settled input scales.

        It may choose fewer neurons than settled ones: a number that suits held-out rows would make
        their errors too small.
        """
        if not isinstance(settled, NetworkModel):  # one for each marker
            return self
        network = _copy(self.regressor).set_params(
            weight_scales=(settled.regressor.weight_scale,),
            input_scaling=settled.regressor.input_scaling,
            relevance_rounds=1,
            max_hidden=settled.regressor.n_hidden,
        )
        return NetworkModelCV(network)

    def _noise(self, regressor: ELMRegressorCV, module: ForwardModel, rows: Rows) -> float:
        """Return the spread of the errors of rows that were held out."""
        return _spread(regressor.left_out_errors_.reshape(len(rows), -1), rows.counts)


@named("kernel")
class KernelModel(RegressorModel[KernelRidge]):
    """Kernel ridge with the width and the penalty of least held-out error."""

    def __init__(self) -> None:
        super().__init__(KernelRidge())

    def _learned(self, rows: Rows) -> KernelRidge:
        tuned = tuned_kernel(rows.X, rows.residual, rows.counts, rows.groups)
        with TURNS.filters:  # scikit-learn's solver changes them
            return _fit_to_residuals(tuned, rows)

    def _settled(self, regressor: KernelRidge) -> ErrorModel:
        return ForeignModel(_copy(regressor))


class FittedBlend(NamedTuple):
    """Several fitted error models; the result is the weighted mean of their hybrids."""

    weights: tuple[float, ...]
    error_models: tuple[object, ...]


class Blend(ErrorModel):
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

    def without_errors(self) -> ErrorModel:
        """Return these models for fits of which only the predictions count."""
        return Blend(self.weights, [model.without_errors() for model in self.models])

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return all models fitted to the same rows."""
        fits = [model.fit(rows, spec) for model in self.models]
        return replace(blended(fits, self.weights), settled=self)


def blended(fits: Sequence[FittedError], weights: Sequence[float]) -> FittedError:
    """Return the weighted mean of fitted error models; of a single one itself."""
    if len(fits) == 1:
        return fits[0]
    corrections: list[Weighted] = [[] for _ in fits[0].corrections]
    for weight, fitted in zip(weights, fits, strict=True):
        for of_blend, of_model in zip(corrections, fitted.corrections, strict=True):
            for part, correction in of_model:
                of_blend.append((weight * part, correction))
    results = tuple(fitted.result for fitted in fits)
    result = FittedBlend(tuple(weights), results)
    return FittedError(result, corrections, fits[0].settled)


def network_model(
    setting: ELMRegressor | ELMRegressorCV, coupling: str, random_state: Seed
) -> ErrorModel:
    """Return the error model of a network, with this seed if it has none."""
    network = _copy(setting)
    if network.random_state is None:
        network.set_params(random_state=random_state)
    if coupling == "serial":
        return HiddenLayer(network)
    if isinstance(network, ELMRegressorCV):
        return NetworkModelCV(network)
    return NetworkModel(network)


def _copy(regressor: _Regressor) -> _Regressor:
    """Return an unfitted copy of a regressor."""
    copied: Any = clone(regressor)
    return copied


def _fit_to_residuals(regressor: _Regressor, rows: Rows) -> _Regressor:
    """Return a copy of the regressor fitted to the residuals, with the arguments that it takes."""
    copied: Any = clone(regressor)
    within: Any = copied
    if isinstance(regressor, ResidualRegressor):
        within = copied.regressor
    if not has_fit_parameter(within, "sample_weight"):
        rows = rows.repeated()
    options = {}
    if not rows.count_once:  # scikit-learn's numbers change with weights of one
        options["sample_weight"] = rows.counts
    if rows.groups.whole and has_fit_parameter(within, "groups"):
        options["groups"] = rows.groups.labels
    try:
        copied.fit(rows.X, rows.residual, **options)
    except ValueError as error:
        if not _takes_one_column(within, rows):
            raise
        name = type(within).__name__
        raise ValueError(
            f"`error_model` must learn all columns of `y`, but {name} takes one; fit one for each: "
            f"sklearn.multioutput.MultiOutputRegressor({name}(...))."
        ) from error
    return copied


def _takes_one_column(regressor: Any, rows: Rows) -> bool:
    """Return whether a regressor that could not learn the residuals learns their first column."""
    single: Any = clone(regressor)
    try:
        single.fit(rows.X, _residual(rows)[:, 0])
    except ValueError:
        return False
    return rows.y.ndim > 1


def _on_moved_directions(module: ForwardModel, directions: Directions) -> ForwardModel:
    """Return the module for the part of q that the rows moved."""
    if not directions.still.size:
        return module
    matrix, offset = directions.projection()
    return Projected(module, torch.from_numpy(matrix), torch.from_numpy(offset))


def _residual(rows: Rows) -> NDArray:
    """Return the residuals as a matrix (N, m) [m]."""
    return rows.residual.reshape(len(rows), -1)


def _spread(residual: NDArray, counts: NDArray) -> float:
    """Return the root mean square of residuals (N, m), without missing markers."""
    squares = np.ma.masked_invalid(residual**2)
    variances = np.ma.average(squares, axis=0, weights=counts)
    return float(variances.mean() ** 0.5)
