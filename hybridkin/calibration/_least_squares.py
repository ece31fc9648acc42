"""Weighted least squares of tip distances over the geometry, with a weak prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from hybridkin.calibration._parameters import Problem
from hybridkin.chains.chain import Chain

_MAX_ROUNDS = 12
_MEDIAN = 2.3660  # of the squared length of a normal vector with three coordinates
_TINY = np.finfo(np.float64).tiny


# rho(s) and rho'(s) of a squared distance s over its noise.
LOSSES: dict[str, Callable[[NDArray], tuple[NDArray, NDArray]]] = {
    "linear": lambda s: (s, np.ones_like(s)),
    "soft_l1": lambda s: (2.0 * s / (1.0 + np.sqrt(1.0 + s)), (1.0 + s) ** -0.5),
    "huber": lambda s: (np.where(s > 1.0, 2.0 * np.sqrt(s) - 1.0, s), np.maximum(s, 1.0) ** -0.5),
    "cauchy": lambda s: (np.log1p(s), 1.0 / (1.0 + s)),
    "arctan": lambda s: (np.arctan(s), 1.0 / (1.0 + s * s)),
}


class Rows(NamedTuple):
    """Actuator vectors (N, n), measured tips (N, 3) and how many times each row counts (N,)."""

    q: Tensor
    x: Tensor
    weight: Tensor

    def residual(self, chain: Chain) -> NDArray:
        """Return the coordinate errors (N, 3)."""
        with torch.no_grad():
            return (chain(self.q) - self.x).numpy()

    def jacobian(self, problem: Problem, theta: Tensor) -> NDArray:
        """Return the derivative of the residual (N, 3, P)."""
        with torch.no_grad():
            chain = problem.moved(theta)
            return chain.geometry_jacobian(self.q, problem.tangents(theta)).numpy()

    def rmse(self, chain: Chain) -> float:
        """Return the root mean square tip distance of a chain [m]."""
        return float(np.sqrt(np.average(_squares(self.residual(chain)), weights=self.weight)))

    def noise(self, residual: NDArray, robust: bool) -> float:
        """Return the standard deviation of one coordinate, from the median where robust."""
        squares, weight = _squares(residual), self.weight.numpy()
        if not robust:
            return float(np.sqrt(np.average(squares, weights=weight) / 3.0))
        order = np.argsort(squares)
        middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
        return float(np.sqrt(squares[order][middle] / _MEDIAN))


def _squares(residual: NDArray) -> NDArray:
    return (residual**2).sum(axis=1)


def _bounded(residual: NDArray, sigma: float, loss: str) -> tuple[NDArray, NDArray]:
    """Return the factors k that make |k e|^2 the loss 3 rho(|e|^2 / 3), and t = s rho'(s) / rho(s).

    `residual` holds the errors e (N, 3), in units of `sigma`. The loss sees their length alone:
    it stays when the frame turns. Its 3 keeps the noise of three coordinates near s = 1.
    """
    s = np.maximum(_squares(residual) / (3.0 * sigma**2), _TINY)
    rho, slope = LOSSES[loss](s)
    return np.sqrt(rho / s), s * slope / rho


@dataclass(frozen=True, eq=False)
class Fit:
    """What a search found, and the derivative of the residual there."""

    problem: Problem
    theta: NDArray
    jacobian: NDArray  # of the residual, (3 N, P)
    noise: float  # standard deviation of one coordinate [m]
    rmse: float
    converged: bool

    def chain(self) -> Chain:
        """Return the chain at the end of the search."""
        base = self.problem.chain.geometry()["base"]
        with torch.no_grad():
            return self.problem.moved(torch.as_tensor(self.theta).to(base))


def solve(problem: Problem, rows: Rows, theta: NDArray, loss: str, *, roughly: bool = False) -> Fit:
    """Alternate least squares and the noise level that weighs the prior against the data.

    With `roughly` the search stops as soon as good and bad initial guesses differ.
    """
    root = rows.weight.sqrt().numpy()[:, None]

    def residual(theta: NDArray) -> NDArray:
        return rows.residual(problem.moved(torch.as_tensor(theta).to(rows.q)))

    def jacobian(theta: NDArray) -> NDArray:
        return rows.jacobian(problem, torch.as_tensor(theta).to(rows.q))

    def whitened(theta: NDArray, sigma: float) -> NDArray:
        errors = residual(theta)
        scale = root / sigma * _bounded(errors, sigma, loss)[0][:, None]
        return np.concatenate([(scale * errors).ravel(), theta / problem.prior_std])

    def whitened_jacobian(theta: NDArray, sigma: float) -> NDArray:
        errors, J = residual(theta), jacobian(theta)
        factor, share = _bounded(errors, sigma, loss)
        # d(k e) = k (1 - (1 - t) u u') de, with u = e / |e|.
        along = (errors[:, None] @ J) / np.maximum(_squares(errors), _TINY)[:, None, None]
        J = J - (1.0 - share)[:, None, None] * errors[..., None] * along
        J = (root / sigma * factor[:, None])[..., None] * J
        return np.vstack([J.reshape(-1, theta.size), np.diag(1.0 / problem.prior_std)])

    floor = 1e-12 * float(problem.chain.reach)
    robust = loss != "linear"
    sigma = max(rows.noise(residual(theta), robust), floor)
    converged, tol = False, 1e-5 if roughly else 1e-12
    options: dict[str, Any] = dict.fromkeys(("ftol", "xtol", "gtol"), tol)
    options |= {"jac": whitened_jacobian, "bounds": (problem.low, problem.high), "max_nfev": 100}
    for _ in range(2 if roughly else _MAX_ROUNDS):
        solution = least_squares(whitened, theta, args=(sigma,), **options)
        theta, converged = solution.x, solution.status > 0
        previous, sigma = sigma, max(rows.noise(residual(theta), robust), floor)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    square, count = (
        float((_squares(residual(theta)) * root[:, 0] ** 2).sum()),
        float(rows.weight.sum()),
    )
    noise = max(sigma if robust else (square / max(3.0 * count - theta.size, 1.0)) ** 0.5, floor)
    J = (root[..., None] * jacobian(theta)).reshape(-1, theta.size)
    return Fit(problem, theta, J, noise, (square / count) ** 0.5, bool(converged))
