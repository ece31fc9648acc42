"""Weighted least squares of tip distances over the geometry, with a weak prior."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from torch import Tensor

from hybridkin.calibration._parameters import Problem
from hybridkin.calibration.measured import points
from hybridkin.chains.chain import Chain
from hybridkin.native.library import evaluate

if TYPE_CHECKING:
    from typing_extensions import Self

_MEDIAN = 2.3660  # of the squared length of a normal vector with three coordinates
NO_UNKNOWNS = np.empty(0)
"""Of rows that have no unknowns of their own."""


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
COMPARED = Accuracy(1e-4, 1)  # for errors of held-out rows, to compare sets


class Reduced(NamedTuple):
    """Linearised rows without the unknowns of their own, at the result of a fit.

    Attributes
    ----------
    jacobian : ndarray of shape (R, P)
        Derivative of the residuals while the unknowns follow the free directions.
    unknowns_by_theta : ndarray of shape (U, P)
        How the unknowns follow.
    root : ndarray of shape (U, U)
        Triangular; the squared residuals have the curvature ``root.T @ root`` by the unknowns.
    """

    jacobian: NDArray
    unknowns_by_theta: NDArray
    root: NDArray

    def covariance(self, of_theta: NDArray, noise: float) -> NDArray:
        """Return the covariance (U, U) of the unknowns from that of the free directions."""
        alone = np.linalg.solve(self.root, noise * np.eye(len(self.root)))
        following = self.unknowns_by_theta
        return alone @ alone.T + following @ of_theta @ following.T


@dataclass(frozen=True, eq=False)
class TipRows:
    """Actuator vectors (N, n), measured tips and how often each row counts (N,).

    With K markers the tips are (N, 3 K), NaN if a marker is missing. Results have one entry for
    each of the M measured markers.

    Rows of another kind may have unknowns of their own (U,), e.g. touched points, and ties among
    them. These rows have none.
    """

    q: Tensor
    x: Tensor
    weight: Tensor

    moved: ClassVar[str] = "the tips"
    """What a change moves that shows in the residual."""
    may_be_wrong: ClassVar[str] = (
        "or the description of the robot, may be wrong: app.check_log(Log(q, x), chain=chain) "
        "looks for better ones."
    )
    """What else than the columns of q may be wrong if large residuals are left."""

    def take(self, rows: NDArray | slice) -> Self:
        """Return some of the rows."""
        return replace(self, q=self.q[rows], x=self.x[rows], weight=self.weight[rows])

    @property
    def measured(self) -> TipRows:
        """The rows whose tips were measured."""
        return self

    @property
    def seen(self) -> NDArray[np.bool_]:
        """Which markers were measured, (N, K)."""
        return ~np.isnan(points(self.x.numpy())[..., 0])

    @property
    def weights(self) -> NDArray:
        """How often each measured marker counts, (M,)."""
        return np.repeat(self.weight.numpy(), self.seen.sum(1))

    @property
    def n_used(self) -> float:
        """Number of coordinates that the unknowns of the rows use up."""
        return 0.0

    def first_unknowns(self, chain: Chain) -> NDArray:
        """Return the start of the unknowns (U,) for a chain."""
        return np.empty(0)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which unknowns the rows determine, (U,)."""
        return np.empty(0, dtype=bool)

    def known_after(self, fitted: TipRows, unknowns: NDArray, chain: Chain) -> NDArray:
        """Return the unknowns (U,) of held-out rows after a fit to other rows."""
        return unknowns

    def at_scale_of(self, unknowns: NDArray) -> TipRows:
        """Return rows with the residuals of these at the scale of present unknowns."""
        return self

    def residual(self, chain: Chain, unknowns: NDArray = NO_UNKNOWNS) -> NDArray:
        """Return the coordinate errors (M, 3), predicted minus measured."""
        predicted = evaluate(chain, self.q.numpy())[0]
        return points(predicted - self.x.numpy())[self.seen]

    def jacobian(
        self, problem: Problem, theta: NDArray, chain: Chain, unknowns: NDArray
    ) -> NDArray:
        """Return the derivative of the residual, times the roots of the weights, (3 M, P + U)."""
        J = self.tip_slopes(problem, theta, chain)
        roots = np.sqrt(self.weights)[:, None, None]
        weighted = roots * J[self.seen]
        return weighted.reshape(-1, theta.size)

    def tip_slopes(self, problem: Problem, theta: NDArray, chain: Chain) -> NDArray:
        """Return the derivatives (N, K, 3, P) of all markers by the free directions."""
        with torch.no_grad():
            tangents = problem.tangents(torch.from_numpy(theta).to(self.q))
            return chain.geometry_jacobian(self.q, tangents).unflatten(1, (-1, 3)).numpy()

    def ties(self, unknowns: NDArray) -> NDArray:
        """Return the errors (D,) of what is known of the unknowns, over their noise."""
        return np.empty(0)

    def ties_jacobian(self, unknowns: NDArray) -> NDArray:
        """Return the derivative (D, U) of the ties."""
        return np.empty((0, unknowns.size))

    def reduced(self, jacobian: NDArray, unknowns: NDArray, noise: float) -> Reduced:
        """Return the linearised rows without their unknowns, from their jacobian (3 M, P + U)."""
        return Reduced(jacobian, np.empty((0, jacobian.shape[1])), np.empty((0, 0)))

    def centred(self, unknowns: NDArray) -> NDArray:
        """Return where the tips should be (M, 3), from the middle of all."""
        return points((self.x - self.x.nanmedian(dim=0).values).numpy())[self.seen]

    def rmse(self, chain: Chain, unknowns: NDArray = NO_UNKNOWNS) -> float:
        """Return the root mean square tip distance of a chain [m]."""
        squares = _squares(self.residual(chain, unknowns))
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

    def size_error(self, unknowns: NDArray, covariance: NDArray) -> float:
        """Return the standard error of the size of what the tips reach, relative to it."""
        return 0.0

    def few_messages(self, n_free: int) -> list[str]:
        """Return a warning if there are fewer rows than free parameters: `rmse` is too small."""
        n_rows = len(self.q)
        if n_rows >= n_free:
            return []
        return [
            f"`q` holds {n_rows} different rows for {n_free} free parameters: `rmse` is far below "
            f"the error on new rows. Record at least {4 * n_free}, or list fewer `parameters`."
        ]


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
    unknowns: NDArray  # of the rows
    noise: float  # standard deviation of one coordinate [m]
    rmse: float
    converged: bool

    def chain(self) -> Chain:
        """Return the fitted chain."""
        return self.problem.chain_at(self.theta)

    @cached_property
    def reduced(self) -> Reduced:
        """The linearised rows at the result, without their unknowns."""
        J = self.rows.jacobian(self.problem, self.theta, self.chain(), self.unknowns)
        return self.rows.reduced(J, self.unknowns, self.noise)

    @property
    def jacobian(self) -> NDArray:
        """Derivative of the residual at the result (R, P), with R = 3 N for measured tips."""
        return self.reduced.jacobian


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
    n_free = theta.size

    searched = replace(problem, chain=problem.chain.near_last_shapes())

    @lru_cache(1)
    def chain_and_residual(scaled: TipRows, key: bytes) -> tuple[Chain, NDArray]:
        z = np.frombuffer(key).copy()
        chain = searched.chain_at(z[:n_free])
        return chain, scaled.residual(chain, z[n_free:])

    @lru_cache(1)  # a round starts where the last one ended
    def jacobian(scaled: TipRows, key: bytes) -> NDArray:
        z = np.frombuffer(key).copy()
        chain, _ = chain_and_residual(scaled, key)
        return scaled.jacobian(problem, z[:n_free], chain, z[n_free:])

    def noise(z: NDArray) -> float:
        _, residual = chain_and_residual(rows, z.tobytes())
        share = 1.0 - rows.n_used / (3.0 * weight.sum())
        return max(rows.noise(residual, robust) / share**0.5, floor)

    def whitened(z: NDArray, sigma: float) -> NDArray:
        _, residual = chain_and_residual(rows, z.tobytes())
        of_rows = (root * residual).ravel() / sigma
        theta, unknowns = np.split(z, [n_free])
        return np.concatenate([of_rows, theta / problem.prior_std, rows.ties(unknowns)])

    def slope(z: NDArray, sigma: float) -> NDArray:
        of_rows = jacobian(rows, z.tobytes()) / sigma
        of_unknowns = rows.ties_jacobian(z[n_free:])
        of_prior = np.zeros((n_free, z.size))
        of_prior[:, :n_free] = np.diag(1.0 / problem.prior_std)
        of_ties = np.zeros((len(of_unknowns), z.size))
        of_ties[:, n_free:] = of_unknowns
        return np.vstack([of_rows, of_prior, of_ties])

    functions: dict[str, Any] = {"jac": slope}
    if robust:
        functions["loss"] = partial(row_loss, weight=weight, loss=loss)
    unknowns = rows.first_unknowns(searched.chain_at(theta))
    rows = rows.at_scale_of(unknowns)
    unbounded = np.full(unknowns.size, np.inf)
    low = np.append(problem.low, -unbounded)
    high = np.append(problem.high, unbounded)
    z = np.append(theta, unknowns)
    sigma = noise(z)
    converged = False
    for _ in range(accuracy.rounds):
        solution = least_squares(
            whitened,
            z,
            bounds=(low, high),
            ftol=accuracy.tolerance,
            xtol=accuracy.tolerance,
            gtol=accuracy.tolerance,
            max_nfev=100,
            args=(sigma,),
            **functions,
        )
        z = solution.x
        rows = rows.at_scale_of(z[n_free:])
        converged = solution.status > 0
        previous = sigma
        sigma = noise(z)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    theta, unknowns = np.split(z, [n_free])
    rmse = rows.rmse(problem.chain_at(theta), unknowns)
    if not robust:
        count = float(weight.sum())
        n_left = max(3.0 * count - rows.n_used - n_free, 1.0)
        sigma = max(rmse * (count / n_left) ** 0.5, floor)
    return Fit(problem, rows, theta, unknowns, sigma, rmse, bool(converged))
