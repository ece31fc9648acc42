"""Rows in which the tip touched points whose positions are not known."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin._core.rotations import cross_matrix
from hybridkin.calibration._least_squares import LOSSES, Slopes, TipRows
from hybridkin.chains.chain import Chain

NO_POINT = -1
"""In place of a point, for rows that touched none."""
_EXACT = 1e-13  # relative change of a step
_MOST_STEPS = 50
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
        by_pair = along[:, None] * self._ends(len(places))[:, :, None]
        return by_pair.reshape(len(self.pairs), places.size)

    def bend(self, places: NDArray) -> NDArray:
        """Return what the curvature (3 K, 3 K) of half the squared residual has beside J'J."""
        between, lengths = self._between(places)
        lengths = np.maximum(lengths, np.finfo(np.float64).tiny)
        along = between / lengths[:, None]
        across = np.eye(3) - along[:, :, None] * along[:, None, :]
        stretch = np.maximum(1.0 - self.distances / lengths, -1.0) / self.std**2
        ends = self._ends(len(places))
        size = places.size
        return np.einsum("d,dk,dl,dij->kilj", stretch, ends, ends, across).reshape(size, size)

    def _ends(self, n_points: int) -> NDArray:
        """Return 1 for the first and -1 for the second point of every pair, (D, K)."""
        first, second = self.pairs.T
        each = np.eye(n_points)
        return each[first] - each[second]


def block_diagonal(blocks: NDArray) -> NDArray:
    """Return the matrix (3 K, 3 K) with blocks (K, 3, 3) on its diagonal."""
    n_blocks = len(blocks)
    matrix = np.zeros((n_blocks, 3, n_blocks, 3))
    each = np.arange(n_blocks)
    matrix[each, :, each] = blocks
    return matrix.reshape(3 * n_blocks, 3 * n_blocks)


class _TouchLoss(NamedTuple):
    """The loss for some points, and half of what each touch adds to its derivatives by its point.

    These are the negative slope (T, 3) and the curvature (T, 3, 3).
    """

    value: float
    forces: NDArray
    curvatures: NDArray


@dataclass(frozen=True, eq=False)
class TouchedRows(TipRows):
    """Rows in some of which the tip touched one of K points, the unknowns (3 K,) of these rows.

    The residual of such a row is the tip minus its point. It follows those of the measured tips;
    a row can have both. A robot shrunk to a point would touch all of them at once, so residuals are
    divided by the size of the set of mean tips, one for each point: the fit then has no reason to
    shrink the robot. At the size to which the rows are scaled the residuals are in metres.

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

    def may_be_wrong(self, chain: Chain) -> str:
        return "`touched`, or the description of the robot, may be wrong."

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
        n_coordinates = float(self.determined.sum())
        # Distances leave the six coordinates of a rigid body.
        return max(n_coordinates - len(self.known.distances), min(n_coordinates, 6.0))

    @property
    def determined(self) -> NDArray[np.bool_]:
        return np.repeat(self.counts > 0.0, 3)

    def first_unknowns(self, tips: NDArray) -> NDArray:
        """Return the mean of the tips at every point; without any, the mean of all tips."""
        means = np.where(self.counts[:, None] > 0.0, self._means(tips), tips.mean(axis=0))
        return means.ravel()

    def unknowns(self, tips: NDArray, sigma: float, loss: str) -> NDArray:
        """Return the points (3 K,) with the least loss, by damped Newton steps from mean tips."""
        places = self.first_unknowns(tips)
        factor = self.scale / self._size(tips) / sigma
        damping = 0.0
        at = self._loss(tips, places, sigma, loss)
        for _ in range(_MOST_STEPS):
            ties = self.known.jacobian(places.reshape(-1, 3))
            pull = factor * self._sums(at.forces).ravel() - ties.T @ self.ties(places)
            curvature = factor**2 * block_diagonal(self._sums(at.curvatures)) + ties.T @ ties
            curvature += self.known.bend(places.reshape(-1, 3))
            ridge = (damping + _EXACT) * np.diag(curvature).max()
            ridge = max(ridge, np.finfo(np.float64).tiny)  # points that no row touched stay
            step = np.linalg.solve(curvature + ridge * np.eye(len(pull)), pull)
            moved = self._loss(tips, places + step, sigma, loss)
            if moved.value > (1.0 + _EXACT) * at.value:
                damping = max(10.0 * damping, 1e-3)
                continue
            places = places + step
            at = moved
            damping = 0.1 * damping if damping > 1e-6 else 0.0
            if np.abs(step).max() <= _EXACT * np.abs(places).max():
                break
        return places

    def _loss(self, tips: NDArray, unknowns: NDArray, sigma: float, loss: str) -> _TouchLoss:
        """Return the loss of the touches and ties for points (3 K,)."""
        errors = self._touch_errors(tips, unknowns) / sigma
        squares = (errors**2).sum(axis=1)
        rho, slope, bend = LOSSES[loss](squares / 3.0)
        weight = self.touch_weights
        outer = 2.0 / 3.0 * errors[:, :, None] * errors[:, None, :]
        curvatures = slope[:, None, None] * np.eye(3) + bend[:, None, None] * outer
        return _TouchLoss(
            float(3.0 * weight @ rho + (self.ties(unknowns) ** 2).sum()),
            (weight * slope)[:, None] * errors,
            weight[:, None, None] * curvatures,
        )

    def _sums(self, values: NDArray) -> NDArray:
        """Return the sums (K, ...) of values (T, ...) of the touches of every point."""
        sums = np.zeros((self.n_points, *values.shape[1:]))
        np.add.at(sums, self.touched, values)
        return sums

    def known_after(self, fitted: TipRows, unknowns: NDArray, tips: NDArray) -> NDArray:
        """Return the points of a fit; those that its rows did not touch are at their mean tips."""
        return np.where(fitted.determined, unknowns, self.first_unknowns(tips))

    def at_scale_of(self, tips: NDArray) -> Self:
        return replace(self, scale=self._size(tips))

    def residual(self, chain: Chain) -> NDArray:
        """Return the errors (M, 3) of a chain, with each point at the mean of its tips."""
        tips = self.tips(chain)
        return self.at_scale_of(tips).errors(tips, self.first_unknowns(tips))

    def errors(self, tips: NDArray, unknowns: NDArray) -> NDArray:
        measured = super().errors(tips, unknowns)
        return np.vstack([measured, self._touch_errors(tips, unknowns)])

    def ties(self, unknowns: NDArray) -> NDArray:
        return self.known.residual(unknowns.reshape(-1, 3))

    def slopes(self, J: NDArray, tips: NDArray, unknowns: NDArray, sigma: float) -> Slopes:
        errors = self._touch_errors(tips, unknowns)
        factor = self.scale / self._size(tips)
        growth = self._growth(J, tips)
        carried = errors[:, :, None] * growth + self._turned(J, tips, errors)
        of_touches = factor * J[self.touching, 0] - carried
        by_theta = self.weighted(np.concatenate([J[self.seen], of_touches]))
        by_points = np.zeros((len(self.weights), 3, unknowns.size))
        first = len(by_points) - len(errors)
        by_points[first:] = -factor * self._points_of_touches()
        ties = self.known.jacobian(unknowns.reshape(-1, 3))
        by_unknowns = np.vstack([self.weighted(by_points) / sigma, ties])[:, self.determined]
        # The unknowns follow theta: what they can make good is projected out.
        by_theta = np.vstack([by_theta / sigma, np.zeros((len(ties), by_theta.shape[1]))])
        directions, root = np.linalg.qr(by_unknowns)
        along = directions.T @ by_theta
        by_theta = by_theta - directions @ along
        of_unknowns = np.zeros((unknowns.size, by_theta.shape[1]))
        of_unknowns[self.determined] = -np.linalg.solve(root, along)
        of_residual, of_ties = np.split(by_theta, [3 * len(by_points)])
        return Slopes(sigma * of_residual, of_ties, of_unknowns, root, growth)

    def _growth(self, J: NDArray, tips: NDArray) -> NDArray:
        """Return the relative growth (P,) of the set of mean tips, by which errors are divided."""
        shares, centred = self._set_of(tips)
        moved = self._means(J[:, 0])
        return np.einsum("k,ki,kip->p", shares, centred, moved) / self._size(tips) ** 2

    def _turned(self, J: NDArray, tips: NDArray, errors: NDArray) -> NDArray:
        """Return the derivatives (T, 3, P) of errors that turn with the set of mean tips.

        A turn does not change the length of an error, so no loss depends on it. Without it, the
        direction in which the robot turns together with all points changes no error at all.
        """
        shares, centred = self._set_of(tips)
        moved = self._means(J[:, 0])
        # A turn w moves the means by w x c = -[c]x w.
        spins = cross_matrix(torch.from_numpy(centred)).numpy()
        inertia = np.einsum("k,kji,kjl->il", shares, spins, spins)
        inertia += _THIN * self._size(tips) ** 2 * np.eye(3)
        turns = -np.linalg.solve(inertia, np.einsum("k,kji,kjp->ip", shares, spins, moved))
        return -cross_matrix(torch.from_numpy(errors)).numpy() @ turns

    def _means(self, values: NDArray) -> NDArray:
        """Return the means (K, ...) of values (N, ...) of the rows at every point; 0 without."""
        ones = [1] * (values.ndim - 1)
        sums = self._sums(self.touch_weights.reshape(-1, *ones) * values[self.touching])
        counts = np.where(self.counts > 0.0, self.counts, 1.0)
        return sums / counts.reshape(-1, *ones)

    def _set_of(self, tips: NDArray) -> tuple[NDArray, NDArray]:
        """Return the shares of the touches at every point (K,), and the mean tips from their mean.

        Points without touches have no share.
        """
        shares = self.counts / max(self.counts.sum(), np.finfo(np.float64).tiny)
        means = self._means(tips)
        return shares, means - shares @ means

    def _size(self, tips: NDArray) -> float:
        """Return the rms distance of the mean tips from their mean [m]."""
        shares, centred = self._set_of(tips)
        return float(np.sqrt(shares @ (centred**2).sum(axis=1) + self.least_size**2))

    def _touch_errors(self, tips: NDArray, unknowns: NDArray) -> NDArray:
        """Return the errors (T, 3) of the touches."""
        apart = tips[self.touching] - unknowns.reshape(-1, 3)[self.touched]
        return self.scale / self._size(tips) * apart

    def _points_of_touches(self) -> NDArray:
        """Return the derivative (T, 3, 3 K) of the touched point by all points."""
        return np.kron(np.eye(self.n_points)[self.touched], np.eye(3)).reshape(
            -1, 3, 3 * self.n_points
        )

    def centred(self, unknowns: NDArray) -> NDArray:
        places = unknowns.reshape(-1, 3)[self.touched]
        from_middle = places - np.median(places, axis=0)
        if not self.seen.any():
            return from_middle
        return np.vstack([super().centred(unknowns), from_middle])

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
