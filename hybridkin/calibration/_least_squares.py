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
REFITTED = Accuracy(1e-4, 2)  # for errors of held-out rows, with corrections
COMPARED = Accuracy(1e-4, 1)  # for errors of held-out rows, to compare sets


class Slopes(NamedTuple):
    """Derivatives of rows by the free directions, which the unknowns of the rows follow.

    Attributes
    ----------
    residual : ndarray of shape (3 M, P)
        Of the residual, times the roots of the weights [m].
    ties : ndarray of shape (D, P)
        Of the ties, over their noise.
    unknowns : ndarray of shape (U, P)
        Of the unknowns.
    root : ndarray of shape (U, U)
        Triangular; ``root.T @ root`` is the inverse covariance of the unknowns for known theta.
    growth : ndarray of shape (P,)
        Relative growth of what the unknowns span; 0 without unknowns.
    """

    residual: NDArray
    ties: NDArray
    unknowns: NDArray
    root: NDArray
    growth: NDArray

    @classmethod
    def of_known(cls, residual: NDArray) -> Slopes:
        """Return the slopes of rows without unknowns."""
        n_free = residual.shape[1]
        none = np.empty((0, n_free))
        return cls(residual, none, none, np.empty((0, 0)), np.zeros(n_free))

    def std_of_unknowns(self, factor: NDArray) -> NDArray:
        """Return the standard errors (U,) of the unknowns.

        `factor` (P, P) times its transpose is the covariance of the free directions.
        """
        alone = np.linalg.solve(self.root, np.eye(len(self.root)))
        return np.linalg.norm(np.hstack([alone, self.unknowns @ factor]), axis=1)


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

    def may_be_wrong(self, chain: Chain) -> str:
        """Return what else than the columns of q may be wrong if large residuals are left."""
        words = "or the description of the robot, may be wrong"
        if not chain.n_arcs:  # the check knows no other robots
            return f"{words}."
        return f"{words}: app.check_log(Log(q, x), chain=chain) looks for better ones."

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

    def first_unknowns(self, tips: NDArray) -> NDArray:
        """Return a rough guess of the unknowns (U,) from tips (N, m)."""
        return NO_UNKNOWNS

    def unknowns(self, tips: NDArray, sigma: float, loss: str) -> NDArray:
        """Return the unknowns (U,) that suit the tips (N, m) best, for the noise of coordinates."""
        return NO_UNKNOWNS

    def tips(self, chain: Chain) -> NDArray:
        """Return the tips (N, m) of a chain."""
        return chain.tips_once(self.q)

    @property
    def determined(self) -> NDArray[np.bool_]:
        """Which unknowns the rows determine, (U,)."""
        return np.empty(0, dtype=bool)

    def known_after(self, fitted: TipRows, unknowns: NDArray, tips: NDArray) -> NDArray:
        """Return the unknowns (U,) of held-out rows with these tips after a fit to other rows."""
        return unknowns

    def at_scale_of(self, tips: NDArray) -> TipRows:
        """Return these rows with errors in metres for a robot with these tips (N, m)."""
        return self

    def residual(self, chain: Chain) -> NDArray:
        """Return the coordinate errors (M, 3), predicted minus measured."""
        return self.errors(self.tips(chain), NO_UNKNOWNS)

    def errors(self, tips: NDArray, unknowns: NDArray) -> NDArray:
        """Return the coordinate errors (M, 3) of tips (N, m)."""
        return points(tips - self.x.numpy())[self.seen]

    def ties(self, unknowns: NDArray) -> NDArray:
        """Return the errors (D,) of what is known of the unknowns, over their noise."""
        return np.empty(0)

    def slopes(self, J: NDArray, tips: NDArray, unknowns: NDArray, sigma: float) -> Slopes:
        """Return the derivatives of the errors and of the ties, from `tip_slopes` J."""
        return Slopes.of_known(self.weighted(J[self.seen]))

    def tip_slopes(self, problem: Problem, theta: NDArray, chain: Chain) -> NDArray:
        """Return the derivatives (N, K, 3, P) of all markers by the free directions."""
        with torch.no_grad():
            tangents = problem.tangents(torch.from_numpy(theta).to(self.q))
            return chain.slopes_once(self.q, tangents).unflatten(1, (-1, 3)).numpy()

    def weighted(self, J: NDArray) -> NDArray:
        """Return derivatives (M, 3, P) of errors, times the roots of the weights, (3 M, P)."""
        roots = np.sqrt(self.weights)[:, None, None]
        return (roots * J).reshape(-1, J.shape[2])

    def centred(self, unknowns: NDArray) -> NDArray:
        """Return where the tips should be (M, 3), from the middle of all."""
        return points((self.x - self.x.nanmedian(dim=0).values).numpy())[self.seen]

    def rmse(self, chain: Chain) -> float:
        """Return the root mean square tip distance of a chain [m]."""
        return self.rms(self.residual(chain))

    def rms(self, residual: NDArray) -> float:
        """Return the root mean square length of errors (M, 3)."""
        squares = _squares(residual)
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
    def tips(self) -> NDArray:
        """The tips at the result (N, m)."""
        return self.rows.tips(self.chain())

    @property
    def residual(self) -> NDArray:
        """Errors of the coordinates at the result (M, 3)."""
        return self.rows.errors(self.tips, self.unknowns)

    @cached_property
    def slopes(self) -> Slopes:
        """Derivatives of the rows at the result."""
        J = self.rows.tip_slopes(self.problem, self.theta, self.chain())
        return self.rows.slopes(J, self.tips, self.unknowns, self.noise)

    @property
    def jacobian(self) -> NDArray:
        """Derivative of the residual and of the ties at the result (3 M + D, P)."""
        return np.vstack([self.slopes.residual, self.noise * self.slopes.ties])


def solve(
    problem: Problem,
    rows: TipRows,
    theta: NDArray,
    loss: str,
    accuracy: Accuracy = EXACT,
) -> Fit:
    """Return a fit that alternates least squares and the noise level, the weight of the prior.

    The unknowns of the rows always follow theta (variable projection).
    """
    weight = rows.weights
    root = np.sqrt(weight)[:, None]
    floor = 1e-12 * float(problem.chain.reach)
    robust = loss != "linear"
    share = 1.0 - rows.n_used / (3.0 * weight.sum())

    searched = replace(problem, chain=problem.chain.near_last_shapes())

    @lru_cache(1)
    def chain_and_tips(key: bytes) -> tuple[Chain, NDArray]:
        chain = searched.chain_at(np.frombuffer(key).copy())
        return chain, rows.tips(chain)

    @lru_cache(1)  # a round starts where the last one ended
    def tip_slopes(key: bytes) -> NDArray:
        chain, _ = chain_and_tips(key)
        return rows.tip_slopes(problem, np.frombuffer(key).copy(), chain)

    @lru_cache(1)
    def errors_and_unknowns(scaled: TipRows, key: bytes, sigma: float) -> tuple[NDArray, NDArray]:
        _, tips = chain_and_tips(key)
        unknowns = scaled.unknowns(tips, sigma, loss)
        return scaled.errors(tips, unknowns), unknowns

    def noise(residual: NDArray) -> float:
        return max(rows.noise(residual, robust) / share**0.5, floor)

    def whitened(theta: NDArray, sigma: float) -> NDArray:
        residual, unknowns = errors_and_unknowns(rows, theta.tobytes(), sigma)
        of_rows = (root * residual).ravel() / sigma
        return np.concatenate([of_rows, theta / problem.prior_std, rows.ties(unknowns)])

    def slope(theta: NDArray, sigma: float) -> NDArray:
        key = theta.tobytes()
        _, tips = chain_and_tips(key)
        _, unknowns = errors_and_unknowns(rows, key, sigma)
        slopes = rows.slopes(tip_slopes(key), tips, unknowns, sigma)
        of_prior = np.diag(1.0 / problem.prior_std)
        return np.vstack([slopes.residual / sigma, of_prior, slopes.ties])

    functions: dict[str, Any] = {"jac": slope}
    if robust:
        functions["loss"] = partial(row_loss, weight=weight, loss=loss)
    _, tips = chain_and_tips(theta.tobytes())
    unknowns = rows.first_unknowns(tips)
    rows = rows.at_scale_of(tips)
    residual = rows.errors(tips, unknowns)
    sigma = noise(residual)
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
        _, unknowns = errors_and_unknowns(rows, theta.tobytes(), sigma)
        _, tips = chain_and_tips(theta.tobytes())
        rows = rows.at_scale_of(tips)
        residual = rows.errors(tips, unknowns)
        previous = sigma
        sigma = noise(residual)
        if abs(sigma - previous) <= 0.02 * previous:
            break
    rmse = rows.rms(residual)
    if not robust:
        count = float(weight.sum())
        n_left = max(3.0 * count - rows.n_used - theta.size, 1.0)
        sigma = max(rmse * (count / n_left) ** 0.5, floor)
    return Fit(problem, rows, theta, unknowns, sigma, rmse, bool(converged))
