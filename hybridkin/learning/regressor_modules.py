"""Fitted scikit-learn regressors as torch modules, with closed-form Jacobians if they exist."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.base import BaseEstimator, TransformerMixin
from sklearn.compose import TransformedTargetRegressor
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import ElasticNet, LinearRegression, Ridge, RidgeCV
from sklearn.pipeline import Pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures, StandardScaler
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from hybridkin._core.arrays import copied
from hybridkin._core.blocks import in_blocks
from hybridkin._core.derived import derived
from hybridkin._core.model import Fitted, ForwardModel, as_forward_model
from hybridkin._core.plan import Plan
from hybridkin._core.stored import Layout, Stored
from hybridkin.learning.network import write_units

_LINEAR = (LinearRegression, Ridge, RidgeCV, ElasticNet)
_MOST_POWER = 100
_LARGEST = float(np.finfo(np.float32).max)
_KERNEL_BLOCK = 2**20  # numbers in the kernel matrix of a block of rows


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
        In closed form: a regressor with a torch ``module_``, a linear model (also on
        `PolynomialFeatures`), and a `KernelRidge` with an RBF kernel, each also after standard or
        min-max scalers. Others: finite differences of ``predict``.
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
    if isinstance(readout, _LINEAR):
        coef, intercept = _line(readout)
        if not before:
            coef = coef / scale
            return AffineModule(coef, intercept - coef @ center)
        if len(before) == 1 and isinstance(before[0], PolynomialFeatures):
            # The intercept is a monomial.
            powers = np.pad(before[0].powers_, ((1, 0), (0, 0)))
            weights = np.vstack([intercept, coef.T])
            return PolynomialModule(powers, weights, center, scale)
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
        of_scaled = error_module(
            self.regressor_, torch.from_numpy(X.astype(np.float64))
        )
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
    if isinstance(module, (AffineModule, PolynomialModule, KernelModule)):
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


def _write_polynomial(plan: Plan, stored: Stored) -> int:
    """Write the node of a polynomial: for each monomial the places of its powers in a table."""
    powers = stored.derived["monomials"]
    readouts = stored.derived["readouts"]
    n_monomials, n = powers.shape
    degrees = int(powers.max()) + 1
    plan.limit("powers", n * degrees)
    factors = []
    for exponents in powers:
        (inputs,) = exponents.nonzero()
        factors += [len(inputs), *(inputs * degrees + exponents[inputs])]
    scaling = stored.array("center"), 1.0 / stored.array("scale")
    n_outputs = stored.array("readout").shape[1]
    numbers = [*scaling, readouts]
    return plan.node(
        "polynomial", n, n_outputs, numbers, n_monomials, degrees, *factors
    )


class PolynomialModule(ForwardModel):
    """A polynomial ``phi(u) @ readout`` of ``u = (q - center) / scale``.

    The derivative of a monomial is a monomial, so the Jacobian is a second readout of the same
    features.

    Parameters
    ----------
    powers : array-like of int of shape (P, n)
        Exponents of the monomials.
    readout : array-like of shape (P, m)
        Their coefficients; coefficients of equal monomials are added.
    center, scale : array-like of shape (n,)
        Map of the inputs [unit of q].
    """

    layout = Layout(
        "polynomial",
        {"powers": "pn", "readout": "pm", "center": "n", "scale": "n"},
        derived=("monomials", "readouts"),
        write_plan=_write_polynomial,
    )
    computed = ("slope",)

    def __init__(
        self, powers: ArrayLike, readout: ArrayLike, center: ArrayLike, scale: ArrayLike
    ) -> None:
        super().__init__()
        _register(self, powers=powers, readout=readout, center=center, scale=scale)
        self.n_actuators = self.powers.shape[1]
        self.n_outputs = self.readout.shape[1]
        self._monomials_and_readouts()  # checks the powers

    @derived("powers", "readout", "scale")
    def _monomials_and_readouts(self) -> tuple[Tensor, Tensor]:
        """Return the exponents (D, n) of all monomials, and their readouts (D, m + m n).

        These are the distinct monomials of the polynomial and of its derivatives. The readouts are
        that of the polynomial, then that of its Jacobian.
        """
        exponents = self.powers.numpy(force=True)
        if not np.isin(exponents, range(_MOST_POWER)).all():
            raise ValueError(f"'powers' must hold whole numbers below {_MOST_POWER}")
        # Monomial k has a derivative along input j: another monomial.
        k, j = np.nonzero(exponents)
        lower = exponents[k] - np.eye(self.n_actuators)[j]
        both = np.vstack([exponents, lower]).astype(int)
        distinct, place = np.unique(both, axis=0, return_inverse=True)
        places = torch.from_numpy(place.reshape(-1)).to(self.readout.device)
        of_monomial, of_slope = places.split([len(exponents), len(k)])

        none = self.readout.new_zeros(len(distinct), self.n_outputs)
        values = none.index_add(0, of_monomial, self.readout)
        each = torch.eye(self.n_actuators, dtype=none.dtype, device=none.device)
        by_input = (self.powers[k, j, None] * each[j] / self.scale)[:, None]
        by_monomial = (self.readout[k, :, None] * by_input).flatten(1)
        slopes = none.new_zeros(len(distinct), by_monomial.shape[1])
        slopes = slopes.index_add(0, of_slope, by_monomial)
        monomials = torch.from_numpy(distinct).to(none.device)
        return monomials, torch.cat([values, slopes], dim=1)

    @property
    def monomials(self) -> Tensor:
        """Exponents of the distinct monomials of the polynomial and its derivatives, (D, n)."""
        return self._monomials_and_readouts()[0]

    @property
    def readouts(self) -> Tensor:
        """Readouts (D, m + m n) of these monomials: of the polynomial, then of its Jacobian."""
        return self._monomials_and_readouts()[1]

    def rescaled(self, mean: Tensor, spread: Tensor) -> PolynomialModule:
        """Return mean (m,) + spread times this module."""
        powers = nn.functional.pad(self.powers, (0, 0, 1, 0))  # the monomial 1
        readout = torch.vstack([mean, spread * self.readout])
        return PolynomialModule(powers, readout, self.center, self.scale)

    def forward(self, q: Tensor) -> Tensor:
        """Return the polynomial, shape (..., m)."""
        monomials, readouts = self._monomials_and_readouts()
        return self._features(q, monomials) @ readouts[:, : self.n_outputs].to(q)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the polynomial (..., m) and its Jacobian (..., m, n) from the same features."""
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        monomials, readouts = self._monomials_and_readouts()
        phi = self._features(q, monomials)
        value, slope = (phi @ readouts.to(q)).tensor_split([self.n_outputs], dim=-1)
        return value, slope.unflatten(-1, (-1, q.shape[-1]))

    def _features(self, q: Tensor, monomials: Tensor) -> Tensor:
        u = (q - self.center.to(q)) / self.scale.to(q)
        monomials = monomials.to(q.device)
        phi = torch.ones_like(u[..., :1]).expand(*u.shape[:-1], len(monomials))
        of_each = [torch.ones_like(u)]
        for _ in range(int(monomials.max())):
            of_each.append(of_each[-1] * u)
        table = torch.stack(of_each, dim=-1)
        for j in range(u.shape[-1]):
            phi = phi * table[..., j, :].index_select(-1, monomials[:, j])
        return phi


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
        return KernelModule(
            self.rows, spread * self.weights, bias, self.center, self.scale
        )

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
        self.n_actuators = q.shape[1]
        self.n_outputs = self.evaluate(q[:1]).shape[1]

    def forward(self, q: Tensor) -> Tensor:
        """Return the regressor's prediction, shape (..., m)."""
        return _Differenced.apply(q, self)

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


class _Differenced(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, q: Tensor, module: RegressorModule) -> Tensor:
        ctx.save_for_backward(q)
        ctx.module = module
        return module.evaluate(q)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor, None]:  # pyright: ignore
        (q,) = ctx.saved_tensors
        return (grad[..., None, :] @ ctx.module.differences(q))[..., 0, :], None
