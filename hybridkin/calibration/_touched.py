"""Rows in which the tip touched points whose positions are not known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import least_squares
from typing_extensions import Self

from hybridkin._core.rotations import cross_matrix
from hybridkin.calibration._least_squares import Slopes, TipRows, row_loss
from hybridkin.chains.chain import Chain

NO_POINT = -1
"""In place of a point, for rows that touched none."""
_EXACT = 1e-14
_THIN = 1e-6  # of the moment of inertia of a set of points: about this axis it is a line


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

    def take(self, ties: NDArray[np.intp]) -> Ties:
        """Return some of the distances."""
        return Ties(self.pairs[ties], self.distances[ties], self.std)

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
        taken = replace(super().take(rows), point=self.point[rows])
        touched = np.unique(taken.touched)
        both = np.flatnonzero(np.isin(self.known.pairs, touched).all(axis=1))
        return replace(taken, known=self.known.take(both))

    @property
    def measured(self) -> TipRows:
        rows = np.flatnonzero(self.seen.any(axis=1))
        return TipRows(self.q[rows], self.x[rows], self.weight[rows])

    @property
    def touching(self) -> NDArray[np.bool_]:
        """Which rows touched a point, (N,)."""
        return np.asarray(self.point != NO_POINT)

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

    def first_unknowns(self, tips: NDArray) -> NDArray:
        """Return the mean of the tips at every point; without any, the mean of all tips."""
        places = np.tile(tips.mean(axis=0), (self.n_points, 1))
        for k in np.unique(self.touched):
            here = self.point == k
            places[k] = np.average(tips[here], axis=0, weights=self.weight.numpy()[here])
        return places.ravel()

    def unknowns(self, tips: NDArray, sigma: float, loss: str) -> NDArray:
        weight = self.touch_weights
        root = np.sqrt(weight)[:, None]

        def whitened(unknowns: NDArray) -> NDArray:
            of_touches = (root * self._touch_errors(tips, unknowns)).ravel() / sigma
            return np.append(of_touches, self.ties(unknowns))

        def slope(unknowns: NDArray) -> NDArray:
            errors = self._touch_errors(tips, unknowns)
            J = root[:, :, None] * self._slopes_by_points(errors, unknowns)
            of_touches = J.reshape(-1, unknowns.size) / sigma
            return np.vstack([of_touches, self._ties_by_points(unknowns)])

        functions: dict[str, Any] = {"jac": slope}
        if loss != "linear":
            functions["loss"] = partial(row_loss, weight=weight, loss=loss)
        solution = least_squares(
            whitened,
            self.first_unknowns(tips),
            ftol=_EXACT,
            xtol=_EXACT,
            gtol=_EXACT,
            max_nfev=50,
            **functions,
        )
        return solution.x

    def known_after(self, fitted: TipRows, unknowns: NDArray, tips: NDArray) -> NDArray:
        """Return the points of a fit; those that its rows did not touch are at their mean tips."""
        return np.where(fitted.determined, unknowns, self.first_unknowns(tips))

    def at_scale_of(self, unknowns: NDArray) -> Self:
        size, _ = self.size(unknowns)
        return replace(self, scale=size)

    def size(self, unknowns: NDArray) -> tuple[float, NDArray]:
        """Return the size of the set of touched points, and the derivative of its logarithm.

        It is the rms distance [m] of the tips at their points from the mean of all.
        """
        shares, centred = self._centred(unknowns)
        square = (shares * centred**2).sum() + self.least_size**2
        return float(np.sqrt(square)), (shares * centred / square).ravel()

    def residual(self, chain: Chain) -> NDArray:
        """Return the errors (M, 3) of a chain, with each point at the mean of its tips."""
        tips = self.tips(chain)
        unknowns = self.first_unknowns(tips)
        return self.at_scale_of(unknowns).errors(tips, unknowns)

    def _centred(self, unknowns: NDArray) -> tuple[NDArray, NDArray]:
        """Return the share of the touches at each point (K, 1), and the points from their mean."""
        places = unknowns.reshape(-1, 3)
        counts = self.counts[:, None]
        shares = counts / max(counts.sum(), np.finfo(np.float64).tiny)
        return shares, places - (shares * places).sum(axis=0)

    def errors(self, tips: NDArray, unknowns: NDArray) -> NDArray:
        measured = super().errors(tips, unknowns)
        return np.vstack([measured, self._touch_errors(tips, unknowns)])

    def ties(self, unknowns: NDArray) -> NDArray:
        return self.known.residual(unknowns.reshape(-1, 3))

    def slopes(self, J: NDArray, residual: NDArray, unknowns: NDArray, sigma: float) -> Slopes:
        size, _ = self.size(unknowns)
        of_touches = self.scale / size * J[self.touching, 0]
        by_theta = self.weighted(np.concatenate([J[self.seen], of_touches]))
        n_measured = len(residual) - len(self.touched)
        by_points = np.zeros((len(residual), 3, unknowns.size))
        by_points[n_measured:] = self._slopes_by_points(residual[n_measured:], unknowns)
        ties = self._ties_by_points(unknowns)
        by_unknowns = np.vstack([self.weighted(by_points) / sigma, ties])[:, self.determined]
        # The unknowns follow theta: what they can make good is projected out.
        by_theta = np.vstack([by_theta / sigma, np.zeros((len(ties), by_theta.shape[1]))])
        directions, root = np.linalg.qr(by_unknowns)
        along = directions.T @ by_theta
        by_theta = by_theta - directions @ along
        of_unknowns = np.zeros((unknowns.size, by_theta.shape[1]))
        of_unknowns[self.determined] = -np.linalg.solve(root, along)
        of_residual, of_ties = np.split(by_theta, [3 * len(residual)])
        turned = np.zeros((len(residual), 3, by_theta.shape[1]))
        turned[n_measured:] = self._turned(residual[n_measured:], unknowns, of_unknowns)
        of_residual = sigma * of_residual - self.weighted(turned)
        return Slopes(of_residual, of_ties, of_unknowns, root)

    def _turned(self, errors: NDArray, unknowns: NDArray, of_unknowns: NDArray) -> NDArray:
        """Return derivatives (T, 3, P) of the errors (T, 3) that turn like the set of points.

        They do not change the length of an error, so no loss depends on them. Without them a turn
        of the robot together with all points is a direction that changes nothing.
        """
        shares, centred = self._centred(unknowns)
        size, _ = self.size(unknowns)
        # A turn w moves the points by w x c = -[c]x w.
        spins = cross_matrix(torch.from_numpy(centred)).numpy()
        weighted = (shares[..., None] * spins).reshape(-1, 3)
        inertia = spins.reshape(-1, 3).T @ weighted + _THIN * size**2 * np.eye(3)
        turns = -np.linalg.solve(inertia, weighted.T @ of_unknowns)
        return -cross_matrix(torch.from_numpy(errors)).numpy() @ turns

    def _touch_errors(self, tips: NDArray, unknowns: NDArray) -> NDArray:
        """Return the errors (T, 3) of the touches."""
        size, _ = self.size(unknowns)
        apart = tips[self.touching] - unknowns.reshape(-1, 3)[self.touched]
        return self.scale / size * apart

    def _slopes_by_points(self, errors: NDArray, unknowns: NDArray) -> NDArray:
        """Return the derivatives (T, 3, 3 K) of the errors (T, 3) of the touches by the points."""
        size, of_size = self.size(unknowns)
        n_touches = len(errors)
        # An error is a factor times (tip - point), and the factor falls with the size.
        J = -errors[:, :, None] * of_size
        by_point = J.reshape(n_touches, 3, self.n_points, 3)
        by_point[np.arange(n_touches), :, self.touched] -= self.scale / size * np.eye(3)
        return J

    def _ties_by_points(self, unknowns: NDArray) -> NDArray:
        """Return the derivatives (D, 3 K) of the ties by the points."""
        return self.known.jacobian(unknowns.reshape(-1, 3))

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
