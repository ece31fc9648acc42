"""Regressors as torch modules: the same values, and Jacobians that are their derivatives."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.ensemble import RandomForestRegressor
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import ElasticNet, Lasso, LinearRegression, Ridge, RidgeCV
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures, StandardScaler
from sklearn.svm import SVR, LinearSVR
from torch.autograd import gradcheck
from torch.func import jacfwd, jacrev, vmap
from torch.testing import assert_close

from hybridkin._core.model import slopes
from hybridkin.learning.regressor_modules import (
    AffineModule,
    KernelModule,
    RegressorModule,
    error_module,
)

CLOSED = [
    (AffineModule, LinearRegression()),
    (AffineModule, make_pipeline(StandardScaler(), MinMaxScaler((-1, 1)), Ridge())),
    (AffineModule, make_pipeline(StandardScaler(with_mean=False), RidgeCV())),
    (AffineModule, ElasticNet(1e-4)),
    (AffineModule, Lasso(1e-4)),
    (KernelModule, KernelRidge(kernel="rbf", alpha=1e-3)),
    (KernelModule, make_pipeline(StandardScaler(), KernelRidge(kernel="rbf", gamma=0.2))),
]
names = [f"{i}-{kind.__name__}" for i, (kind, _) in enumerate(CLOSED)]


def data(m, n=80):
    rng = np.random.default_rng(0)
    X = rng.uniform(0.1, 0.4, (n, 3))
    y = np.sin(8 * X @ rng.standard_normal((3, m))) + 0.2
    return X, y[:, 0] if m == 1 else y


def differences(predict, X, step=1e-6):
    columns = []
    for j in range(X.shape[1]):
        move = np.zeros(X.shape[1])
        move[j] = step
        columns.append((predict(X + move) - predict(X - move)) / (2 * step))
    return np.stack([column.reshape(len(X), -1) for column in columns], axis=-1)


@pytest.mark.parametrize(("kind", "regressor"), CLOSED, ids=names)
def test_values_and_jacobians_are_those_of_the_regressor(kind, regressor):
    for m in (1, 2):
        X, y = data(m, 24)
        regressor.fit(X, y)
        module, q = error_module(regressor, torch.from_numpy(X)), torch.from_numpy(X + 0.03)
        assert type(module) is kind
        expected = regressor.predict(q.numpy()).reshape(len(X), m)
        assert_allclose(module(q).numpy(), expected, rtol=0, atol=1e-10)
        x, J = module.forward_and_jacobian(q)
        assert_close(x, module(q), rtol=1e-12, atol=1e-12)
        slope = differences(regressor.predict, q.numpy())
        assert_allclose(J.numpy(), slope, rtol=0, atol=1e-6 * np.abs(slope).max())
    assert gradcheck(module, q[:3].requires_grad_())
    lead = q[:12].detach().reshape(2, 6, 3)
    assert_close(module.jacobian(lead), J[:12].detach().reshape(2, 6, 2, 3))
    assert_close(module(lead.float()), module(lead).float(), rtol=1e-2, atol=1e-2)


@pytest.mark.parametrize(
    "regressor",
    [
        KernelRidge(kernel="laplacian", alpha=0.1),
        KernelRidge(kernel="poly", alpha=1e-3),
        GaussianProcessRegressor(RBF(0.5), alpha=0.01, optimizer=None),
        make_pipeline(MinMaxScaler(clip=True), Ridge()),
        make_pipeline(PolynomialFeatures(2), LinearSVR()),
        make_pipeline(MinMaxScaler((-1, 1)), PolynomialFeatures(3), Ridge(1e-3)),
        RandomForestRegressor(5, random_state=0),
    ],
    ids=lambda r: type(r).__name__,
)
def test_others_are_differenced(regressor):
    X, y = data(1)
    regressor.fit(X, y)
    q = torch.from_numpy(X)
    module = error_module(regressor, q)
    assert type(module) is RegressorModule
    assert_allclose(module(q)[:, 0].numpy(), regressor.predict(X))
    if not isinstance(regressor, RandomForestRegressor):
        inside = X[np.all((X > X.min(0) + 0.01) & (X < X.max(0) - 0.01), axis=1)]
        J = module.jacobian(torch.from_numpy(inside)).numpy()
        expected = differences(regressor.predict, inside)
        kinks = np.abs(J - expected) > 1e-4 * np.abs(J).max()
        assert kinks.mean() < 0.02


def test_differences_pass_through_the_transforms_of_torch():
    X, y = data(2)
    q = torch.from_numpy(X[:4])
    module = error_module(MultiOutputRegressor(SVR()).fit(X, y), torch.from_numpy(X))
    assert type(module) is RegressorModule
    J = module.jacobian(q)
    assert J.abs().max() > 1.0
    assert_close(vmap(module)(q), module(q))
    assert_close(vmap(module, in_dims=1)(q.mT), module(q))
    assert_close(vmap(jacrev(module))(q), J)
    assert_close(vmap(jacfwd(module))(q), J)
    assert_close(jacrev(module)(q[0]), J[0])
    rows = q.clone().requires_grad_()
    assert_close(slopes(module(rows), rows), J)


@pytest.mark.parametrize("transform", [jacrev, jacfwd])
def test_differences_are_not_differentiated_again(transform):
    X, y = data(1)
    module = error_module(SVR().fit(X, y), torch.from_numpy(X))
    with pytest.raises(RuntimeError, match=r"twice differentiable by torch.*got SVR, whose"):
        transform(jacrev(module))(torch.from_numpy(X[0]))
    q = torch.from_numpy(X[:1]).requires_grad_()
    (slope,) = torch.autograd.grad(module(q).sum(), q, create_graph=True)
    with pytest.raises(RuntimeError, match="take a linear model, a KernelRidge"):
        slope.sum().backward()


@pytest.mark.parametrize("unit", [1e-4, 1e4])
def test_differences_follow_the_range_of_the_inputs(unit):
    """In another unit the Jacobian is the same, counted in that unit."""
    X, y = data(1)
    jacobians = []
    for factor in (1.0, unit):
        regressor = make_pipeline(StandardScaler(), KernelRidge(kernel="poly", alpha=1e-3))
        q = torch.from_numpy(factor * X)
        module = error_module(regressor.fit(factor * X, y), q)
        assert type(module) is RegressorModule
        jacobians.append(factor * module.jacobian(q))
    assert_close(*jacobians, rtol=1e-6, atol=1e-6 * float(jacobians[0].abs().max()))
