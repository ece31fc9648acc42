"""Rows in which the tip touched points whose positions are not known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.calibration._least_squares import NO_UNKNOWNS, Reduced, TipRows
from hybridkin.calibration._parameters import Problem
from hybridkin.chains.chain import Chain
from hybridkin.native.library import evaluate

NO_POINT = -1
"""In place of a point, for rows that touched none."""


class Ties(NamedTuple):
    """Known distances between points.

    Attributes
    ----------
    pairs : ndarray of int of shape (D, 2)
        The points.
    distances : ndarray of shape (D,)
        Their distances [m].
    std : float
        Standard error of each [m].
    """

    pairs: NDArray[np.intp]
    distances: NDArray
    std: float

    def _between(self, places: NDArray) -> tuple[NDArray, NDArray]:
        """Return the vectors (D, 3) from the second to the first points (K, 3), and lengths."""
        first, second = self.pairs.T
        between = places[first] - places[second]
        return between, np.linalg.norm(between, axis=1)

    def residual(self, places: NDArray) -> NDArray:
        """Return the errors (D,) of the distances of points (K, 3), over their noise."""
        _, lengths = self._between(places)
        return (lengths - self.distances) / self.std

    def jacobian(self, places: NDArray) -> NDArray:
        """Return the derivatives (D, 3 K) of the residual by points (K, 3)."""
        between, lengths = self._between(places)
        lengths = np.maximum(lengths, np.finfo(np.float64).tiny)
        along = between / lengths[:, None] / self.std
        J = np.zeros((len(self.pairs), *places.shape))
        each = np.arange(len(self.pairs))
        J[each, self.pairs[:, 0]] = along
        J[each, self.pairs[:, 1]] = -along
        return J.reshape(len(self.pairs), places.size)


@dataclass(frozen=True, eq=False)
class TouchedRows(TipRows):
    """Rows in some of which the tip touched one of K points, the unknowns (3 K,) of these rows.

    The residual of such a row is the tip minus its point. It follows those of the measured tips;
    a row can have both. A robot shrunk to a point would touch all of them at once, so residuals are
    divided by the size of the set of points: the fit then has no reason to shrink the robot. At the
    size to which the rows are scaled the residuals are in metres.

    Attributes
    ----------
    point : ndarray of int of shape (N,)
        Which point each row touched; -1: none.
    n_points : int
        Number of points K.
    known : Ties
        Known distances between points.
    least_size : float
        A size far below that of any set of points [m]; a single point has it.
    scale : float
        Size at which residuals are in metres [m].
    """

    point: NDArray[np.intp]
    n_points: int
    known: Ties
    least_size: float
    scale: float = 1.0

    moved: ClassVar[str] = "the tips from the points that they touched"
    may_be_wrong: ClassVar[str] = "`touched`, or the description of the robot, may be wrong."

    def take(self, rows: NDArray | slice) -> Self:
        return replace(super().take(rows), point=self.point[rows])

    @property
    def measured(self) -> TipRows:
        rows = self.seen.any(axis=1)
        return TipRows(self.q[rows], self.x[rows], self.weight[rows])

    @property
    def touching(self) -> NDArray[np.bool_]:
        """Which rows touched a point, (N,)."""
        return np.not_equal(self.point, NO_POINT)

    @property
    def touched(self) -> NDArray[np.intp]:
        """Point of every touch, (T,)."""
        return self.point[self.touching]

    @property
    def touch_weights(self) -> NDArray:
        """How often each touch counts, (T,)."""
        return self.weight.numpy()[self.touching]

    @property
    def counts(self) -> NDArray:
        """How often each point was touched, by weight, (K,)."""
        return np.bincount(self.touched, self.touch_weights, self.n_points)

    @property
    def weights(self) -> NDArray:
        return np.append(super().weights, self.touch_weights)

    @property
    def n_used(self) -> float:
        return max(float(self.determined.sum()) - len(self.known.distances), 0.0)

    @property
    def determined(self) -> NDArray[np.bool_]:
        return np.repeat(self.counts > 0.0, 3)

    def first_unknowns(self, chain: Chain) -> NDArray:
        """Return the means of the tips at every point; where there are none, the mean of all."""
        tips = evaluate(chain, self.q.numpy())[0]
        places = np.tile(tips.mean(axis=0), (self.n_points, 1))
        weights = self.touch_weights
        for k in range(self.n_points):
            here = self.touched == k
            if here.any():
                places[k] = np.average(tips[self.touching][here], axis=0, weights=weights[here])
        return places.ravel()

    def known_after(self, fitted: TipRows, unknowns: NDArray, chain: Chain) -> NDArray:
        """Return the points of a fit; those that its rows did not touch are at their mean tips."""
        return np.where(fitted.determined, unknowns, self.first_unknowns(chain))

    def at_scale_of(self, unknowns: NDArray) -> Self:
        size, _ = self.size(unknowns)
        return replace(self, scale=size)

    def size(self, unknowns: NDArray) -> tuple[float, NDArray]:
        """Return the size of the set of touched points, and the derivative of its logarithm.

        It is the rms distance [m] of the tips at their points from the mean of all.
        """
        places = unknowns.reshape(-1, 3)
        counts = self.counts[:, None]
        shares = counts / max(counts.sum(), np.finfo(np.float64).tiny)
        centred = places - (shares * places).sum(axis=0)
        square = (shares * centred**2).sum() + self.least_size**2
        return float(np.sqrt(square)), (shares * centred / square).ravel()

    def residual(self, chain: Chain, unknowns: NDArray = NO_UNKNOWNS) -> NDArray:
        predicted = evaluate(chain, self.q.numpy())[0]
        measured = (predicted - self.x.numpy())[self.seen[:, 0]]
        size, _ = self.size(unknowns)
        places = unknowns.reshape(-1, 3)
        apart = predicted[self.touching] - places[self.touched]
        return np.vstack([measured, self.scale / size * apart])

    def jacobian(
        self, problem: Problem, theta: NDArray, chain: Chain, unknowns: NDArray
    ) -> NDArray:
        J = self.tip_slopes(problem, theta, chain)[:, 0]
        size, of_size = self.size(unknowns)
        factor = self.scale / size
        by_theta = np.concatenate([J[self.seen[:, 0]], factor * J[self.touching]])
        # By the points: a residual r = factor (tip - point), and the factor falls with the size.
        n_touches = len(self.touched)
        residual = self.residual(chain, unknowns)
        of_touches = residual[len(residual) - n_touches :]
        by_points = -of_touches[:, :, None] * of_size
        by_point = by_points.reshape(n_touches, 3, self.n_points, 3)
        by_point[np.arange(n_touches), :, self.touched] -= factor * np.eye(3)
        by_unknowns = np.zeros((len(residual), 3, unknowns.size))
        by_unknowns[len(residual) - n_touches :] = by_points
        J = np.concatenate([by_theta, by_unknowns], axis=2)
        weighted = np.sqrt(self.weights)[:, None, None] * J
        return weighted.reshape(-1, theta.size + unknowns.size)

    def ties(self, unknowns: NDArray) -> NDArray:
        return self.known.residual(unknowns.reshape(-1, 3))

    def ties_jacobian(self, unknowns: NDArray) -> NDArray:
        return self.known.jacobian(unknowns.reshape(-1, 3))

    def reduced(self, jacobian: NDArray, unknowns: NDArray, noise: float) -> Reduced:
        n_free = jacobian.shape[1] - unknowns.size
        by_theta, by_unknowns = np.split(jacobian, [n_free], axis=1)
        ties = noise * self.ties_jacobian(unknowns)
        by_unknowns = np.vstack([by_unknowns, ties])
        by_theta = np.vstack([by_theta, np.zeros((len(ties), n_free))])
        directions, root = np.linalg.qr(by_unknowns)
        along = directions.T @ by_theta
        return Reduced(
            by_theta - directions @ along,
            -np.linalg.solve(root, along),
            root,
        )

    def centred(self, unknowns: NDArray) -> NDArray:
        places = unknowns.reshape(-1, 3)[self.touched]
        from_middle = places - np.median(places, axis=0)
        if not self.seen.any():
            return from_middle
        return np.vstack([super().centred(unknowns), from_middle])

    def size_error(self, unknowns: NDArray, covariance: NDArray) -> float:
        _, of_size = self.size(unknowns)
        return float(np.sqrt(of_size @ covariance @ of_size))

    def few_messages(self, n_free: int) -> list[str]:
        n_touches = len(self.touched)
        n_points = np.count_nonzero(self.counts)
        n_tips = np.count_nonzero(self.seen)
        n_rows = n_tips + n_touches - n_points
        if n_rows >= n_free:
            return []
        return [
            f"{n_touches} touches of {n_points} points and {n_tips} measured tips count as "
            f"{n_rows} rows, one less for each point, for {n_free} free parameters: `rmse` is far "
            f"below the error on new rows. Record at least {4 * n_free}, or list fewer "
            "`parameters`."
        ]
