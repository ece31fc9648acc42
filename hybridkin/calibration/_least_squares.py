"""Weighted least squares of tip distances over the geometry, with a weak prior."""

from __future__ import annotations

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


class Rows(NamedTuple):
    """Actuator vectors (N, n), measured tips (N, 3) and how many times each row counts (N,)."""

    q: Tensor
    x: Tensor
    weight: Tensor

    def residual(self, chain: Chain) -> Tensor:
        """Return the weighted coordinate errors (3 N,), whose squares add up to the loss."""
        return ((chain(self.q) - self.x) * self.weight.sqrt()[:, None]).reshape(-1)

    def jacobian(self, problem: Problem, theta: Tensor) -> Tensor:
        """Return the derivative of the residual (3 N, P)."""
        chain = problem.moved(theta)
        J = chain.geometry_jacobian(self.q, problem.tangents(theta))
        return (J * self.weight.sqrt()[:, None, None]).flatten(0, 1)

    def rmse(self, chain: Chain) -> float:
        """Return the root mean square tip distance of a chain [m]."""
        with torch.no_grad():
            return float((self.residual(chain).square().sum() / self.weight.sum()).sqrt())

    def noise(self, residual: NDArray, robust: bool) -> float:
        """Return the standard deviation of one coordinate, from the median where robust."""
        weight = np.repeat(self.weight.numpy(), 3)
        if not robust:
            return float(np.sqrt((residual**2).sum() / weight.sum()))
        size = np.abs(residual) / np.sqrt(weight)
        order = np.argsort(size)
        middle = np.searchsorted(np.cumsum(weight[order]), 0.5 * weight.sum())
        return 1.4826 * float(size[order][middle])


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

    def residual(theta: NDArray) -> NDArray:
        with torch.no_grad():
            return rows.residual(problem.moved(torch.as_tensor(theta).to(rows.q))).numpy()

    def jacobian(theta: NDArray) -> NDArray:
        with torch.no_grad():
            return rows.jacobian(problem, torch.as_tensor(theta).to(rows.q)).numpy()

    def whitened(theta: NDArray, sigma: float) -> NDArray:
        return np.concatenate([residual(theta) / sigma, theta / problem.prior_std])

    def whitened_jacobian(theta: NDArray, sigma: float) -> NDArray:
        return np.vstack([jacobian(theta) / sigma, np.diag(1.0 / problem.prior_std)])

    floor = 1e-12 * float(problem.chain.reach)
    robust = loss != "linear"
    sigma = max(rows.noise(residual(theta), robust), floor)
    converged, tol = False, 1e-5 if roughly else 1e-12
    options: dict[str, Any] = dict.fromkeys(("ftol", "xtol", "gtol"), tol) | {
        "jac": whitened_jacobian
    }
    options |= {"bounds": (problem.low, problem.high), "loss": loss, "max_nfev": 100}
    for _ in range(2 if roughly else _MAX_ROUNDS):
        solution = least_squares(whitened, theta, args=(sigma,), **options)
        theta, converged = solution.x, solution.status > 0
        previous, sigma = sigma, max(rows.noise(residual(theta), robust), floor)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    errors = residual(theta)
    square, count = float(errors @ errors), float(rows.weight.sum())
    noise = max(sigma if robust else (square / max(3.0 * count - theta.size, 1.0)) ** 0.5, floor)
    rmse = (square / count) ** 0.5
    return Fit(problem, theta, jacobian(theta), noise, rmse, bool(converged))
