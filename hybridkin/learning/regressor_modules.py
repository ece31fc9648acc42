"""Fitted scikit-learn regressors as torch modules, with closed-form Jacobians if they exist."""

from __future__ import annotations

from functools import cached_property
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import TransformedTargetRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import ElasticNet, LinearRegression, Ridge, RidgeCV
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import MinMaxScaler, StandardScaler
from torch import Tensor, nn

from hybridkin._core.arrays import copied
from hybridkin._core.blocks import in_blocks
from hybridkin._core.derived import derived
from hybridkin._core.model import Fitted, ForwardModel, as_forward_model
from hybridkin._core.plan import Plan
from hybridkin._core.stored import Layout, Stored
from hybridkin.learning.network import write_units

_LINEAR = (LinearRegression, Ridge, RidgeCV, ElasticNet)
_LARGEST = float(np.finfo(np.float32).max)
_KERNEL_BLOCK = 2**20  # numbers in the kernel matrix of a block of rows
_SOME = 20  # training rows at which derivatives are looked at


class Regressor(Protocol):
    """A fitted scikit-learn regressor."""

    def predict(self, X: NDArray) -> NDArray:
        """Return the prediction of every row."""
        ...


def error_module(regressor: Regressor, q: Tensor) -> ForwardModel:
    """Return a fitted regressor as a forward model q (..., n) -> (..., m).

    Parameters
    ----------
    regressor : estimator
        In closed form: a regressor with a torch ``module_``, a linear model, and a `KernelRidge`
        with an RBF kernel, each also after standard or min-max scalers. Others: finite differences
        of ``predict``.
    q : Tensor of shape (N, n)
        The training rows.
    """
    if isinstance(regressor, Fitted):
        return as_forward_model(regressor)
    steps: list[Any] = [regressor]
    if isinstance(regressor, Pipeline):
        steps = [*regressor.named_steps.values()]
    # u = (q - center) / scale of all scalers in front
    center = np.zeros(q.shape[1])
    scale = np.ones(q.shape[1])
    while len(steps) > 1 and _is_affine(steps[0]):
        offset, slope = _affine(steps.pop(0))
        center = center + scale * offset
        scale = scale * slope
    *before, readout = steps
    if not before and isinstance(readout, _LINEAR):
        coef, intercept = _line(readout)
        coef = coef / scale
        return AffineModule(coef, intercept - coef @ center)
    if not before and type(readout) is KernelRidge and readout.kernel == "rbf":
        return _kernel_module(readout, center, scale)
    return RegressorModule(regressor, q)


class UnitSpread(TransformerMixin, BaseEstimator):
    """Residuals minus their mean, over one spread for all outputs.

    Parameters
    ----------
    mean : ndarray of shape (m,)
        Subtracted [m].
    spread : float
        Divided by [m].
    """

    def __init__(self, mean: NDArray, spread: float) -> None:
        self.mean = mean
        self.spread = spread

    @classmethod
    def of(cls, residual: NDArray, counts: NDArray) -> UnitSpread:
        """Return the map of residuals (N, m) to mean zero and a mean variance of one."""
        mean = np.average(residual, axis=0, weights=counts)
        squares = np.average((residual - mean) ** 2, axis=0, weights=counts)
        return cls(mean, float(np.sqrt(squares.mean())) or 1.0)

    def fit(self, X: NDArray, y: object = None) -> UnitSpread:
        """Return self: the map is fixed."""
        return self

    def transform(self, X: NDArray) -> NDArray:
        """Return scaled residuals."""
        return (X - self.mean) / self.spread

    def inverse_transform(self, X: NDArray) -> NDArray:
        """Return residuals [m]."""
        return X * self.spread + self.mean


class ResidualRegressor(TransformedTargetRegressor):
    """A regressor of residuals that sees them with mean zero and unit spread; it predicts metres.

    Attributes
    ----------
    regressor_ : estimator
        The fitted regressor, of scaled residuals.
    transformer_ : UnitSpread
        The scaling.
    module_ : ForwardModel
        q -> residual [m] in torch, with closed-form Jacobian where `regressor_` has one.
    """

    regressor_: Any
    transformer_: Any
    module_: ForwardModel

    def __init__(self, regressor: Any, transformer: UnitSpread) -> None:
        super().__init__(regressor, transformer=transformer, check_inverse=False)

    def fit(self, X: NDArray, y: NDArray, **options: Any) -> ResidualRegressor:
        """Fit the regressor to scaled residuals."""
        super().fit(X, y, **options)
        of_scaled = error_module(self.regressor_, torch.from_numpy(X.astype(np.float64)))
        self.module_ = _rescaled(of_scaled, self.transformer_)
        return self


def sees_scale(regressor: object) -> bool:
    """Return whether the scale of its targets may change what a regressor learns."""
    if isinstance(regressor, Pipeline):
        regressor = regressor.steps[-1][1]
    return not isinstance(regressor, (LinearRegression, Ridge, RidgeCV, KernelRidge))


def _rescaled(module: ForwardModel, scaling: UnitSpread) -> ForwardModel:
    """Return the model of the residual [m] from that of the scaled residual."""
    mean = torch.from_numpy(scaling.mean)
    spread = mean.new_tensor(scaling.spread)
    if isinstance(module, (AffineModule, KernelModule)):
        return module.rescaled(mean, spread)
    return RescaledModule(module, mean, spread)


def _line(fitted: Any) -> tuple[NDArray, NDArray]:
    """Return coefficients (m, n) and intercept (m,) of a linear regressor."""
    coef = np.atleast_2d(fitted.coef_)
    return coef, np.broadcast_to(fitted.intercept_, len(coef))


def _is_affine(step: object) -> bool:
    if isinstance(step, MinMaxScaler):
        return not step.clip
    return isinstance(step, StandardScaler)


def _affine(scaler: Any) -> tuple[NDArray, NDArray]:
    """Return center and scale of a fitted scaler, u = (q - center) / scale."""
    if hasattr(scaler, "min_"):  # a MinMaxScaler
        return -scaler.min_ / scaler.scale_, 1.0 / scaler.scale_
    center = np.zeros(scaler.n_features_in_)
    scale = np.ones(scaler.n_features_in_)
    if scaler.with_mean:
        center = scaler.mean_
    if scaler.with_std:
        scale = scaler.scale_
    return center, scale


def _kernel_module(fitted: Any, center: NDArray, scale: NDArray) -> KernelModule:
    rows = fitted.X_fit_
    gamma = fitted.gamma
    if gamma is None:
        gamma = 1.0 / rows.shape[1]
    width = (2.0 * gamma) ** -0.5
    weights = fitted.dual_coef_.reshape(len(rows), -1)
    return KernelModule(rows / width, weights, 0.0, center, scale * width)


def _register(module: nn.Module, **arrays: ArrayLike) -> None:
    for name, array in arrays.items():
        rows = np.asarray(array, dtype=np.float64, order="C")
        module.register_buffer(name, torch.tensor(rows, device="cpu"))


def _write_affine(plan: Plan, stored: Stored) -> int:
    coef = stored.array("coef")
    m, n = coef.shape
    scaling = np.zeros(n), np.ones(n)
    readout = stored.array("bias"), coef, np.zeros((m, 0))
    no_units = np.zeros((0, n)), np.zeros(0)
    return write_units(plan, "affine", "sin", scaling, readout, no_units)


class AffineModule(ForwardModel):
    """A fitted linear regressor as a torch module.

    Parameters
    ----------
    coef : array-like of shape (m, n) or (n,)
        Coefficients.
    bias : array-like of shape (m,) or float
        Value at q = 0.
    """

    layout = Layout("affine", {"coef": "mn", "bias": "m"}, write_plan=_write_affine)

    def __init__(self, coef: ArrayLike, bias: ArrayLike) -> None:
        super().__init__()
        matrix = np.atleast_2d(coef)
        self.n_outputs, self.n_actuators = matrix.shape
        _register(self, coef=matrix, bias=np.broadcast_to(bias, self.n_outputs))

    def rescaled(self, mean: Tensor, spread: Tensor) -> AffineModule:
        """Return mean (m,) + spread times this module."""
        return AffineModule(spread * self.coef, mean + spread * self.bias)

    def forward(self, q: Tensor) -> Tensor:
        """Return coef q + bias, shape (..., m)."""
        return q @ self.coef.to(q).mT + self.bias.to(q)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the value (..., m), and the constant matrix for every row (..., m, n)."""
        return self(q), self.coef.to(q).expand(*q.shape[:-1], *self.coef.shape)


def _write_kernel(plan: Plan, stored: Stored) -> int:
    rows = stored.array("rows")
    weights = stored.array("weights")
    direct = np.zeros((weights.shape[1], rows.shape[1]))
    hidden = rows, -0.5 * (rows * rows).sum(1)
    scaling = stored.array("center"), stored.array("scale")
    readout = stored.array("bias"), direct, weights.T
    return write_units(plan, "kernel", "gaussian", scaling, readout, hidden)


class KernelModule(ForwardModel):
    """A sum of Gaussians ``weights' exp(-|u - u_i|^2 / 2) + bias`` at training rows.

    Parameters
    ----------
    rows : array-like of shape (N, n)
        Scaled inputs u_i of the training rows.
    weights : array-like of shape (N, m)
        Their weights.
    bias : array-like of shape (m,) or float
        Added to the sum.
    center, scale : array-like of shape (n,)
        ``u = (q - center) / scale`` [unit of q]; the Gaussians have width 1 along each u.
    """

    layout = Layout(
        "kernel",
        {"rows": "kn", "weights": "km", "bias": "m", "center": "n", "scale": "n"},
        write_plan=_write_kernel,
    )
    computed = ("tangent",)

    def __init__(
        self,
        rows: ArrayLike,
        weights: ArrayLike,
        bias: ArrayLike,
        center: ArrayLike,
        scale: ArrayLike,
    ) -> None:
        super().__init__()
        at = np.asarray(rows)
        heights = np.asarray(weights)
        n_rows, self.n_actuators = at.shape
        self.n_outputs = heights.shape[1]
        self._block = max(1, _KERNEL_BLOCK // n_rows)
        bias = np.broadcast_to(bias, self.n_outputs)
        _register(self, rows=at, weights=heights, bias=bias, center=center, scale=scale)

    @derived("rows", "weights")
    def _tangent(self) -> tuple[Tensor]:
        """Return the products (N, m n) of weights and rows."""
        return ((self.weights[:, :, None] * self.rows[:, None]).flatten(1),)

    def rescaled(self, mean: Tensor, spread: Tensor) -> KernelModule:
        """Return mean (m,) + spread times this module."""
        bias = mean + spread * self.bias
        return KernelModule(self.rows, spread * self.weights, bias, self.center, self.scale)

    def forward(self, q: Tensor) -> Tensor:
        """Return the sum, shape (..., m)."""
        return in_blocks(self._forward, q, self._block)[0]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the sum (..., m) and its Jacobian (..., m, n) from one kernel matrix."""
        x, J = in_blocks(self._forward_and_jacobian, q, self._block)
        return x, J

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        _, kernel = self._kernel(q)
        return (kernel @ self.weights.to(q) + self.bias.to(q),)

    def _kernel(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return u (N, n) and the Gaussians (N, R) of all training rows."""
        u = (q - self.center.to(q)) / self.scale.to(q)
        rows = self.rows.to(q)
        squares = u.square().sum(-1, keepdim=True) + rows.square().sum(-1)
        distances = (squares - 2.0 * (u @ rows.mT)).clamp(min=0.0)
        return u, torch.exp(-0.5 * distances)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        u, kernel = self._kernel(q)
        value = kernel @ self.weights.to(q)
        (tangent,) = self._tangent()
        towards = (kernel @ tangent.to(q)).unflatten(-1, (-1, q.shape[-1]))
        J = (towards - value[..., None] * u[..., None, :]) / self.scale.to(q)
        return value + self.bias.to(q), J


class RescaledModule(ForwardModel):
    """The model ``mean + spread * f(q)``.

    Parameters
    ----------
    model : ForwardModel
        f, q (..., n) -> (..., m).
    mean : Tensor of shape (m,)
        Added [m].
    spread : Tensor of shape ()
        The factor [m].
    """

    layout = Layout("rescaled", {"mean": "m", "spread": ""}, parts=("model",))

    def __init__(self, model: ForwardModel, mean: Tensor, spread: Tensor) -> None:
        super().__init__()
        self.model = model
        self.n_actuators = model.n_actuators
        self.n_outputs = model.n_outputs
        _register(self, mean=mean, spread=spread)

    def forward(self, q: Tensor) -> Tensor:
        """Return mean + spread f(q), shape (..., m)."""
        return self.mean.to(q) + self.spread.to(q) * self.model(q)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the value (..., m), and its Jacobian (..., m, n)."""
        x, J = self.model.forward_and_jacobian(q)
        spread = self.spread.to(q)
        return self.mean.to(q) + spread * x, spread * J


class RegressorModule(ForwardModel):
    """Any fitted scikit-learn regressor as a torch module, with a Jacobian by central differences.

    The step is the training range of each input times the cube root of machine precision. The
    relative error is then near 1e-10 for smooth regressors. Trees are piecewise constant: their
    Jacobian is zero almost everywhere.
    """

    def __init__(self, regressor: Regressor, q: Tensor) -> None:
        super().__init__()
        self.regressor = regressor
        width = (q.amax(0) - q.amin(0)).numpy()
        width[width == 0.0] = 1.0
        self._step = np.finfo(np.float64).eps ** (1 / 3) * width
        self._some_rows = q[:: max(1, len(q) // _SOME)].clone()
        self.n_actuators = q.shape[1]
        self.n_outputs = self.evaluate(q[:1]).shape[1]

    @cached_property
    def is_stepwise(self) -> bool:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Whether predictions change from row to row, but have no derivative at most of them."""
        rows = self._some_rows
        changes = bool((self(rows) != self(rows[:1])).any())
        flat = (self.differences(rows) == 0.0).flatten(1).all(dim=1)
        return changes and bool(2 * flat.sum() > len(rows))

    def forward(self, q: Tensor) -> Tensor:
        """Return the regressor's prediction, shape (..., m)."""
        return _Prediction.apply(q, self)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the prediction (..., m) and dx/dq (..., m, n)."""
        return self(q), self.differences(q)

    def differences(self, q: Tensor) -> Tensor:
        """Return dx/dq without a graph, shape (..., m, n)."""
        center = q.detach().cpu().double()
        steps = torch.from_numpy(np.diag(self._step))
        changes = []
        for step in steps:
            after = self.evaluate(center + step)
            before = self.evaluate(center - step)
            changes.append(after - before)
        slopes = torch.stack(changes, dim=-1) / (2 * steps.diag())
        return slopes.to(q)

    def evaluate(self, q: Tensor) -> Tensor:
        """Return the prediction without a graph, shape (..., m).

        Trees compute in float32, so numbers that it cannot hold are replaced by its largest.
        """
        clamped = q.detach().cpu().double().clamp(-_LARGEST, _LARGEST)
        rows = clamped.reshape(-1, q.shape[-1]).numpy()
        x = copied(self.regressor.predict(rows), q.device, np.float64)
        return x.to(q).reshape(*q.shape[:-1], -1)


class _ByRows(torch.autograd.Function):
    """A function of rows that scikit-learn computes, for every torch transform.

    The dimension of a `vmap` becomes one more leading dimension of the rows.
    """

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, RegressorModule], output: Tensor) -> None:
        q, ctx.module = inputs
        ctx.save_for_backward(q)
        ctx.save_for_forward(q)


class _Prediction(_ByRows):
    @staticmethod
    def forward(q: Tensor, module: RegressorModule) -> Tensor:
        return module.evaluate(q)

    @staticmethod
    def vmap(info: object, in_dims: tuple[int, None], *args: Any) -> tuple[Tensor, int]:
        q, module = args
        return _Prediction.apply(q.movedim(in_dims[0], 0), module), 0

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # pyright: ignore
        (q,) = ctx.saved_tensors
        J = _Slopes.apply(q, ctx.module)
        return (grad[..., None, :] @ J)[..., 0, :], None

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:  # pyright: ignore
        (q,) = ctx.saved_tensors
        J = _Slopes.apply(q, ctx.module)
        return (J @ tangent[..., None])[..., 0]


class _Slopes(_ByRows):
    @staticmethod
    def forward(q: Tensor, module: RegressorModule) -> Tensor:
        return module.differences(q)

    @staticmethod
    def vmap(info: object, in_dims: tuple[int, None], *args: Any) -> tuple[Tensor, int]:
        q, module = args
        return _Slopes.apply(q.movedim(in_dims[0], 0), module), 0

    @staticmethod
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # pyright: ignore
        raise RuntimeError(_only_once(ctx.module))

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, _: None) -> Tensor:  # pyright: ignore
        raise RuntimeError(_only_once(ctx.module))


def _only_once(module: RegressorModule) -> str:
    """Return why a regressor has no second derivatives, and what has them."""
    return (
        f"`error_model` must be twice differentiable by torch for second derivatives, got "
        f"{type(module.regressor).__name__}, whose Jacobian is made of differences; take a linear "
        "model, a KernelRidge with an RBF kernel, an ELMRegressor or a named error model."
    )
