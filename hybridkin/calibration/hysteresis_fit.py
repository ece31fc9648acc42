"""Friction and creep of the actuators from a log, by least squares of the tips."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from hybridkin._core.arrays import LARGEST
from hybridkin._core.model import ForwardModel
from hybridkin.calibration.measured import folds
from hybridkin.chains.creep import CreepOperator
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.chains.play import PlayOperator
from hybridkin.chains.prandtl_ishlinskii import PrandtlIshlinskiiOperator
from hybridkin.chains.series import HysteresisSeries

# Widths of the plays, relative to one backlash.
_FACTORS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
_ROUNDS = 4
_LEAST_NOISE = 1e-5  # relative to the spread of the tips
_COMMON = 0.5  # prior correlation of the weights of two actuators
_AT_ONCE = 0.05  # least share of a change that comes at once
_LEAST_GAIN = 1e-6  # of creep


@dataclass(frozen=True)
class HysteresisLog:
    """Commands in order of time, and the measured tips by which their hysteresis is found.

    Attributes
    ----------
    model : ForwardModel
        The mechanical model, calibrated without hysteresis.
    q : ndarray of shape (N, n)
        Commands, the rows of each run in order of time [unit of q].
    x : ndarray of shape (N, m)
        Measured tips, NaN where a marker is missing [m].
    counts : ndarray of shape (N,)
        How many times each row counts.
    groups : ndarray of shape (N,)
        Which rows are held out together.
    runs : ndarray of shape (N,)
        Which rows follow each other in time.
    time : ndarray of shape (N,)
        Times, ascending in each run [s].
    """

    model: ForwardModel
    q: NDArray
    x: NDArray
    counts: NDArray
    groups: NDArray
    runs: NDArray
    time: NDArray

    @cached_property
    def rows(self) -> NDArray:
        """The rows whose errors count."""
        return np.flatnonzero((self.counts > 0) & ~np.isnan(self.x).all(axis=1))

    @cached_property
    def folds(self) -> list[tuple[NDArray, NDArray]]:
        """Training and held-out rows, as places in `rows`."""
        return folds(self.rows, self.groups[self.rows])

    @cached_property
    def times(self) -> NDArray:
        """Time constants to try [s]: from the median step to the median length of a run."""
        steps = []
        lengths = []
        for name in np.unique(self.runs):
            times = self.time[self.runs == name]
            steps.append(np.diff(times))
            lengths.append(times[-1] - times[0])
        positive = np.concatenate(steps)
        positive = positive[positive > 0.0]
        if not len(positive):
            return np.empty(0)
        least = np.median(positive)
        return np.geomspace(least, max(np.median(lengths), 2.0 * least), 4)

    def by_group(self, distances: NDArray) -> NDArray:
        """Return the mean distance of every group, of the distances of `rows`."""
        _, group = np.unique(self.groups[self.rows], return_inverse=True)
        counts = self.counts[self.rows]
        return np.bincount(group, counts * distances) / np.bincount(group, counts)


class HysteresisFit(NamedTuple):
    """Weights of friction and creep, and the errors on held-out groups.

    Attributes
    ----------
    slopes : ndarray of shape (K, n)
        Slopes of the plays, see `PrandtlIshlinskiiOperator`.
    gains : ndarray of shape (J, n)
        Gains of creep, see `CreepOperator`.
    distances : ndarray of shape (C,)
        Distances of the counted rows from a fit without their group [m].
    """

    slopes: NDArray
    gains: NDArray
    distances: NDArray


class HysteresisProblem:
    """Friction and creep by least squares of the tips, with a linear correction inside the model.

    The tips are F(z(y) + W [1, y]): the model at the effective changes y, plus a linear correction
    of its inner coordinates z, as of serial coupling. With the plays P_k of a
    Prandtl-Ishlinskii operator of slopes s, and slow states S_j of creep of gains g,
    ``u = P_K + sum_k s_k (P_k - P_{k+1})`` and ``y = u + sum_j g_j (S_j(u) - u)``, where S_j is
    linear. Gauss-Newton steps from one backlash solve for s, g and W together. A normal prior holds
    the slopes near those of the backlash and the gains near zero; it is correlated, as actuators of
    one robot are alike.

    Parameters
    ----------
    log : HysteresisLog
        The measured rows.
    width : float
        Width of the one backlash [unit of q]; 0 for no friction.
    creep : bool
        Whether there may be creep.
    """

    def __init__(self, log: HysteresisLog, width: float, creep: bool) -> None:
        self.log = log
        self.widths = np.zeros(1)
        if width > 0.0:
            self.widths = width * _FACTORS
        plays = [PlayOperator(w).apply_by_group(log.q, log.runs) for w in self.widths]
        changes = np.stack([*-np.diff(plays, axis=0), plays[-1]], axis=1)
        self.changes = changes[log.rows]  # (C, K + 1, n), of which u is a weighted sum
        self.times = log.times if creep else np.empty(0)
        flat = changes.reshape(len(changes), -1)
        late = []
        for time in self.times:
            half = CreepOperator([0.5], [time])  # y - u = (S(u) - u) / 2
            late.append(2.0 * (half.apply_by_group(flat, log.runs, log.time) - flat))
        late = np.reshape(late, (len(late), *changes.shape))[:, log.rows]
        self.late = late.transpose(1, 0, 2, 3)  # (C, J, K + 1, n)
        self.measured = log.x[log.rows]
        roots = np.sqrt(log.counts[log.rows])[:, None]
        self.roots = np.where(np.isnan(self.measured), 0.0, roots)
        n = log.q.shape[1]
        one_backlash = _FACTORS[: len(self.widths) - 1] >= 1.0
        self.start = np.outer(one_backlash, np.ones(n))
        self.center = log.q.mean(axis=0)
        scale = np.ptp(log.q, axis=0)
        self.scale = np.where(scale > 0.0, scale, 1.0)

    def operator(self, fit: HysteresisFit) -> HysteresisOperator | None:
        """Return the operator of fitted slopes and gains; None without hysteresis."""
        operators: list[HysteresisOperator] = []
        if (fit.slopes != self.start).any():
            operators.append(PrandtlIshlinskiiOperator(self.widths, fit.slopes))
        elif self.widths.any():
            operators.append(PlayOperator(self.widths[_FACTORS == 1.0].item()))
        some = (fit.gains > _LEAST_GAIN).any(axis=1)
        if some.any():
            operators.append(CreepOperator(fit.gains[some], self.times[some]))
        if len(operators) < 2:
            return operators[0] if operators else None
        return HysteresisSeries(operators)

    def fitted(self, slope_spread: float, gain_spread: float) -> HysteresisFit:
        """Return the fit to all rows, and the errors of fits without each fold.

        The fits without a fold share the last linearisation of the fit to all rows.

        Parameters
        ----------
        slope_spread, gain_spread : float
            Standard deviations of the priors of a slope and of a gain; 0 for fixed ones.
        """
        K, n = self.start.shape
        weights = np.concatenate([self.start, np.zeros((len(self.times), n))])
        spreads = np.repeat([slope_spread, gain_spread], [K, len(self.times)])
        free = spreads > 0.0
        mean = weights[free].ravel()
        of_actuators = np.linalg.inv((1.0 - _COMMON) * np.eye(n) + _COMMON)
        precision = np.kron(np.diag(spreads[free] ** -2.0), of_actuators)
        n_rows = np.square(self.roots.max(axis=1)).sum()
        correction = None
        system = None
        distances = np.full(len(self.log.rows), LARGEST)
        for _ in range(_ROUNDS):
            columns, noise, correction = self._linearised(weights, correction, free)
            if not np.isfinite(columns).all():  # the model is not regular so far away
                return HysteresisFit(weights[:K], weights[K:], distances)
            system = _LeastSquares.of(columns, noise * precision, mean, n_rows)
            solution = system.solution(system.products)
            of_weights = solution[correction.size :]
            correction = solution[: correction.size].reshape(correction.shape)
            weights[free] = of_weights.reshape(-1, n)
            late = np.maximum(weights[K:].sum(axis=0), 1.0 - _AT_ONCE)
            weights[K:] *= (1.0 - _AT_ONCE) / late
        assert system is not None
        for _, test in self.log.folds:
            distances[test] = system.held_out(test) / self.roots[test].max(axis=1)
        return HysteresisFit(weights[:K], weights[K:], distances)

    def _linearised(
        self, weights: NDArray, correction: NDArray | None, free: NDArray
    ) -> tuple[NDArray, float, NDArray]:
        """Return columns (C, m, P + F n + 1) of W, of free weights and tips, the noise, and W.

        ``columns @ [W, weights, -1]`` are the errors of the tips, W (Z, n + 1) is zero at first.
        """
        K = len(self.start)
        gains = weights[K:]
        of_changes = np.concatenate([weights[:K], np.ones((1, weights.shape[1]))])
        late = (self.late * of_changes).sum(axis=2)
        y = (self.changes * of_changes).sum(axis=1) + (late * gains).sum(axis=1)
        delayed = (self.late[:, :, :K] * gains[:, None]).sum(axis=1)
        by_weights = np.concatenate([self.changes[:, :K] + delayed, late], axis=1)

        model = self.log.model
        inputs = np.column_stack([np.ones(len(y)), (y - self.center) / self.scale])
        with torch.no_grad():
            z, dz = model.coordinates(torch.from_numpy(y))
            if correction is None:
                correction = np.zeros((z.shape[1], inputs.shape[1]))
            tips, by_z = model.from_coordinates_and_jacobian(
                z + torch.from_numpy(inputs @ correction.T)
            )
            by_y = by_z @ (dz + torch.from_numpy(correction[:, 1:] / self.scale))
        residual = np.where(self.roots > 0.0, self.measured - tips.numpy(), 0.0)
        by_correction = by_z.numpy()[..., None] * inputs[:, None, None]
        by_free = by_y.numpy()[:, :, None] * by_weights[:, None, free]
        by_correction = by_correction.reshape(*residual.shape, -1)
        by_free = by_free.reshape(*residual.shape, -1)
        target = residual + by_correction @ correction.ravel()
        target = target + by_free @ weights[free].ravel()
        columns = np.concatenate([by_correction, by_free, target[..., None]], axis=2)
        noise = np.average(residual**2, weights=self.roots**2)
        noise += _LEAST_NOISE**2 * np.nanvar(self.measured)
        return self.roots[..., None] * columns, noise, correction


class _LeastSquares(NamedTuple):
    """Linear least squares of all rows, whose products are kept to leave some of them out.

    The columns are those of a correction, of weights of zero and more, and of the target. Beside
    the penalty of the weights, each entry of the correction has one that counts as one row.
    """

    columns: NDArray  # (C, m, P + F + 1)
    products: NDArray  # of the columns, summed over rows
    ridge: NDArray  # (P,)
    penalty: NDArray  # (F, F)
    mean: NDArray  # (F,), at which the penalty is zero

    @classmethod
    def of(
        cls, columns: NDArray, penalty: NDArray, mean: NDArray, n_rows: float
    ) -> _LeastSquares:
        """Return the system of columns of so many rows."""
        flat = columns.reshape(-1, columns.shape[2])
        products = flat.T @ flat
        ridge = np.diag(products)[: -1 - len(mean)] / n_rows
        ridge = np.where(ridge > 0.0, ridge, 1.0)
        return cls(columns, products, ridge, penalty, mean)

    def held_out(self, test: NDArray) -> NDArray:
        """Return the lengths of the errors of rows, from the solution of all others."""
        columns = self.columns[test]
        flat = columns.reshape(-1, columns.shape[2])
        solution = self.solution(self.products - flat.T @ flat)
        return np.linalg.norm(columns @ np.append(solution, -1.0), axis=1)

    def solution(self, products: NDArray) -> NDArray:
        """Return the correction and the weights of products; the correction is eliminated."""
        P = len(self.ridge)
        normal = products[:P, :P] + np.diag(self.ridge)
        explained = np.linalg.solve(normal, products[:P, P:])
        if not len(self.mean):
            return explained[:, -1]
        left = products[P:, P:] - products[P:, :P] @ explained
        system = left[:-1, :-1] + self.penalty
        moment = left[:-1, -1] + self.penalty @ self.mean
        factor = np.linalg.cholesky(system)
        weights, _ = nnls(factor.T, np.linalg.solve(factor, moment))
        correction = explained @ np.append(-weights, 1.0)
        return np.concatenate([correction, weights])
