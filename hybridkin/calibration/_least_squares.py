"""Weighted least squares of tip distances over the geometry, with a weak prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from hybridkin.calibration._parameters import Problem
from hybridkin.calibration.measured import points
from hybridkin.chains.chain import Chain
from hybridkin.native.library import evaluate

_MEDIAN = 2.3660  # of the squared length of a normal vector with three coordinates


_Loss = Callable[[NDArray], tuple[NDArray, NDArray, NDArray]]


def _linear(s: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    return s, np.ones_like(s), np.zeros_like(s)


def _soft_l1(s: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    return 2 * s / (1 + np.sqrt(1 + s)), (1 + s) ** -0.5, -0.5 * (1 + s) ** -1.5


def _cauchy(s: NDArray) -> tuple[NDArray, NDArray, NDArray]:
    return np.log1p(s), 1 / (1 + s), -((1 + s) ** -2.0)


LOSSES: dict[str, _Loss] = {
    "linear": _linear,
    "soft_l1": _soft_l1,
    "cauchy": _cauchy,
}
"""rho(s), rho'(s) and rho''(s), for the squared distance s of a row over its noise."""


class Accuracy(NamedTuple):
    """When a fit ends: relative change of a step, and rounds of the noise level."""

    tolerance: float
    rounds: int


EXACT = Accuracy(1e-12, 12)
HELD_OUT = Accuracy(1e-6, 12)  # for errors of held-out rows
ROUGH = Accuracy(1e-5, 2)  # to compare initial guesses
REFITTED = Accuracy(1e-4, 2)  # for errors of held-out rows, with corrections
COMPARED = Accuracy(1e-4, 1)  # for errors of held-out rows, to compare sets


class TipRows(NamedTuple):
    """Actuator vectors (N, n), measured tips and how often each row counts (N,).

    With K markers the tips are (N, 3 K), NaN if a marker is missing. Results have one entry for
    each of the M measured markers.
    """

    q: Tensor
    x: Tensor
    weight: Tensor

    def take(self, rows: NDArray | slice) -> TipRows:
        """Return some of the rows."""
        return TipRows(self.q[rows], self.x[rows], self.weight[rows])

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which markers were measured, (N, K)."""
        return ~np.isnan(points(self.x.numpy())[..., 0])

    @property
    def weights(self) -> NDArray:
        """How often each measured marker counts, (M,)."""
        return np.repeat(self.weight.numpy(), self.seen.sum(1))

    def residual(self, chain: Chain) -> NDArray:
        """Return the coordinate errors (M, 3), predicted minus measured."""
        predicted = evaluate(chain, self.q.numpy())[0]
        return points(predicted - self.x.numpy())[self.seen]

    def jacobian(self, problem: Problem, theta: NDArray, chain: Chain) -> NDArray:
        """Return the derivative of the residual, times the roots of the weights, (3 M, P)."""
        with torch.no_grad():
            tangents = problem.tangents(torch.from_numpy(theta).to(self.q))
            J = chain.geometry_jacobian(self.q, tangents).unflatten(1, (-1, 3))
        roots = np.sqrt(self.weights)[:, None, None]
        weighted = roots * J.numpy()[self.seen]
        return weighted.reshape(-1, theta.size)

    def rmse(self, chain: Chain) -> float:
        """Return the root mean square tip distance of a chain [m]."""
        squares = _squares(self.residual(chain))
        return float(np.sqrt(np.average(squares, weights=self.weights)))

    def noise(self, residual: NDArray, robust: bool) -> float:
        """Return the standard deviation of one coordinate, from the median if robust."""
        squares = _squares(residual)
        weight = self.weights
        if not robust:
            return float(np.sqrt(np.average(squares, weights=weight) / 3.0))
        order = np.argsort(squares)
        counts = np.cumsum(weight[order])
        middle = np.searchsorted(counts, 0.5 * weight.sum())
        return float(np.sqrt(squares[order][middle] / _MEDIAN))


def _squares(residual: NDArray) -> NDArray:
    return (residual**2).sum(axis=1)


def row_loss(z: NDArray, weight: NDArray, loss: str) -> NDArray:
    """Return the loss that SciPy's `least_squares` minimises, and its derivatives, (3, M).

    `z` holds the squares of 3 N weighted coordinates, over their noise, then those of the prior.
    The loss of a row is 3 w rho(s) with s = |e|^2 / 3: it does not depend on the frame, and noise
    in three coordinates gives s near 1. The second derivative gives all coordinates of a row the
    mean curvature rho' + 2/3 s rho'', so the search does not depend on the frame either.
    """
    rows, prior = np.split(z, [3 * len(weight)])
    s = rows.reshape(-1, 3).sum(axis=1) / (3.0 * weight)
    rho, slope, bend = LOSSES[loss](s)
    of_rows = np.repeat([weight * rho, slope, bend * s / 3.0], 3, axis=1)
    of_rows[2] /= np.maximum(rows, np.finfo(np.float64).tiny)
    return np.hstack([of_rows, _linear(prior)])


@dataclass(frozen=True, eq=False)
class Fit:
    """Result of a fit."""

    problem: Problem
    rows: TipRows
    theta: NDArray
    noise: float  # standard deviation of one coordinate [m]
    rmse: float
    converged: bool

    def chain(self) -> Chain:
        """Return the fitted chain."""
        return self.problem.chain_at(self.theta)

    @cached_property
    def jacobian(self) -> NDArray:
        """Derivative of the residual at the result (3 N, P)."""
        return self.rows.jacobian(self.problem, self.theta, self.chain())


def solve(
    problem: Problem,
    rows: TipRows,
    theta: NDArray,
    loss: str,
    accuracy: Accuracy = EXACT,
) -> Fit:
    """Return a fit that alternates least squares and the noise level, the weight of the prior."""
    weight = rows.weights
    root = np.sqrt(weight)[:, None]
    floor = 1e-12 * float(problem.chain.reach)
    robust = loss != "linear"

    searched = replace(problem, chain=problem.chain.near_last_shapes())

    @lru_cache(1)
    def chain_and_residual(key: bytes) -> tuple[Chain, NDArray]:
        chain = searched.chain_at(np.frombuffer(key).copy())
        return chain, rows.residual(chain)

    @lru_cache(1)  # a round starts where the last one ended
    def jacobian(key: bytes) -> NDArray:
        chain, _ = chain_and_residual(key)
        return rows.jacobian(problem, np.frombuffer(key).copy(), chain)

    def noise(theta: NDArray) -> float:
        _, residual = chain_and_residual(theta.tobytes())
        return max(rows.noise(residual, robust), floor)

    def whitened(theta: NDArray, sigma: float) -> NDArray:
        _, residual = chain_and_residual(theta.tobytes())
        of_rows = (root * residual).ravel() / sigma
        return np.concatenate([of_rows, theta / problem.prior_std])

    def slope(theta: NDArray, sigma: float) -> NDArray:
        of_prior = np.diag(1.0 / problem.prior_std)
        return np.vstack([jacobian(theta.tobytes()) / sigma, of_prior])

    functions: dict[str, Any] = {"jac": slope}
    if robust:
        functions["loss"] = partial(row_loss, weight=weight, loss=loss)
    sigma = noise(theta)
    converged = False
    for _ in range(accuracy.rounds):
        solution = least_squares(
            whitened,
            theta,
            bounds=(problem.low, problem.high),
            ftol=accuracy.tolerance,
            xtol=accuracy.tolerance,
            gtol=accuracy.tolerance,
            max_nfev=100,
            args=(sigma,),
            **functions,
        )
        theta = solution.x
        converged = solution.status > 0
        previous = sigma
        sigma = noise(theta)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    rmse = rows.rmse(problem.chain_at(theta))
    if not robust:
        count = float(weight.sum())
        n_free = max(3.0 * count - theta.size, 1.0)
        sigma = max(rmse * (count / n_free) ** 0.5, floor)
    return Fit(problem, rows, theta, sigma, rmse, bool(converged))
