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
from hybridkin.chains.creep import CreepOperator, slow_shares
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
        late = _slow_states(changes, log, self.times)[:, log.rows] - self.changes
        self.late = late.transpose(1, 0, 2, 3)  # (C, J, K + 1, n)
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
        K = len(self.start)
        J, n = len(self.times), self.start.shape[1]
        weights = np.concatenate([self.start, np.zeros((J, n))])
        spreads = np.repeat([slope_spread, gain_spread], [K, J])
        prior = _Prior.of(weights, spreads)
        correction: NDArray | None = None
        system = None
        for _ in range(_ROUNDS):
            system = self._linearised(weights, correction, prior)
            if system is None:  # the model is not regular so far from the rows
                far = np.full(len(self.log.rows), LARGEST)
                return HysteresisFit(self.start, np.zeros((J, n)), far)
            weights, correction = system.solved()
            gains = weights[K:]
            most = (1.0 - _AT_ONCE) / np.maximum(gains.sum(axis=0), 1.0 - _AT_ONCE)
            weights = np.concatenate([weights[:K], gains * most])
        assert system is not None
        distances = np.empty(len(self.log.rows))
        for _, test in self.log.folds:
            distances[test] = system.held_out(test)
        return HysteresisFit(weights[:K], weights[K:], distances)

    def _linearised(
        self, weights: NDArray, correction: NDArray | None, prior: _Prior
    ) -> _System | None:
        """Return the linear system at weights (K + J, n) and W (Z, n + 1); None if not finite."""
        log = self.log
        K = len(self.start)
        gains = weights[K:]
        of_changes = np.concatenate([weights[:K], np.ones((1, weights.shape[1]))])[None]
        late = (self.late * of_changes).sum(axis=2)
        y = (self.changes * of_changes).sum(axis=1) + (late * gains).sum(axis=1)
        delayed = (self.late[:, :, :K] * gains[:, None]).sum(axis=1)
        by_weights = np.concatenate([self.changes[:, :K] + delayed, late], axis=1)

        inputs = np.column_stack([np.ones(len(y)), (y - self.center) / self.scale])
        with torch.no_grad():
            z, dz = log.model.coordinates(torch.from_numpy(y))
            if correction is None:
                correction = np.zeros((z.shape[1], inputs.shape[1]))
            tips, by_z = log.model.from_coordinates_and_jacobian(
                z + torch.from_numpy(inputs @ correction.T)
            )
            by_y = by_z @ (dz + torch.from_numpy(correction[:, 1:] / self.scale))
        root = np.sqrt(log.counts[log.rows])[:, None]
        measured = log.x[log.rows]
        root = np.where(np.isnan(measured), 0.0, root)
        residual = np.where(root > 0.0, measured - tips.numpy(), 0.0)
        if not (np.isfinite(residual).all() and by_y.isfinite().all()):
            return None
        noise = np.square(root * residual).sum() / (root > 0.0).sum()
        noise += _LEAST_NOISE**2 * np.nanvar(measured)
        by_correction = inputs[:, None, :, None] * by_z.numpy()[:, :, None]
        by_free = by_y.numpy()[:, :, None] * by_weights[:, None, prior.free]
        return _System.of(
            root, residual, by_correction, by_free, weights, correction, noise, prior
        )


def _slow_states(changes: NDArray, log: HysteresisLog, times: NDArray) -> NDArray:
    """Return the slow states (J, N, K, n) of creep that changes (N, K, n) lead to."""
    slow = np.empty((len(times), *changes.shape))
    for name in np.unique(log.runs):
        run = np.flatnonzero(log.runs == name)
        steps = np.diff(log.time[run], prepend=log.time[run[0]])
        state = np.tile(changes[run[0]], (len(times), 1, 1))
        decays = slow_shares(steps, times)[..., None, None]
        for row, decay in zip(run, decays, strict=True):
            state = changes[row] + decay * (state - changes[row])
            slow[:, row] = state
    return slow


class _Prior(NamedTuple):
    """A normal prior of the weights that are free; the others keep their start."""

    start: NDArray  # (F, n)
    free: NDArray  # (K + J,), which rows of the weights
    precision: NDArray  # (F n, F n)

    @classmethod
    def of(cls, weights: NDArray, spreads: NDArray) -> _Prior:
        """Return the prior about weights (K + J, n) with standard deviations (K + J,)."""
        n = weights.shape[1]
        free = spreads > 0.0
        of_actuators = np.linalg.inv((1.0 - _COMMON) * np.eye(n) + _COMMON)
        precision = np.kron(np.diag(spreads[free] ** -2.0), of_actuators)
        return cls(weights[free], free, precision)


class _System(NamedTuple):
    """Linear least squares of all rows, whose products are kept.

    The columns of a row are those of the correction W, of the free weights, and of the tips. One
    unit of the scaled W moves the tips by 1 m; W may explain all errors.
    """

    columns: NDArray  # (C, m, P + F n + 1)
    products: NDArray  # of the columns, summed over rows
    units: NDArray  # (P,)
    weights: NDArray  # (K + J, n), at the linearisation
    shape: tuple[int, ...]  # of W
    noise: float
    prior: _Prior
    root: NDArray  # (C, m), roots of the counts

    @classmethod
    def of(
        cls,
        root: NDArray,
        residual: NDArray,
        by_correction: NDArray,
        by_free: NDArray,
        weights: NDArray,
        correction: NDArray,
        noise: float,
        prior: _Prior,
    ) -> _System:
        """Return the system of rows, linearised at weights and a correction."""
        by_correction = by_correction.reshape(*residual.shape, -1)
        by_free = by_free.reshape(*residual.shape, -1)
        units = np.sqrt(np.square(by_correction).sum(axis=1).mean(axis=0))
        units = np.where(units > 0.0, units, 1.0)
        target = residual + by_correction @ correction.T.ravel()
        target = target + by_free @ (weights[prior.free] - prior.start).ravel()
        columns = [by_correction / units, by_free, target[..., None]]
        columns = root[..., None] * np.concatenate(columns, axis=2)
        flat = columns.reshape(-1, columns.shape[2])
        products = flat.T @ flat
        shape = correction.shape
        return cls(columns, products, units, weights, shape, noise, prior, root)

    def solved(self) -> tuple[NDArray, NDArray]:
        """Return the weights (K + J, n) and the correction W (Z, n + 1) of all rows."""
        solution = self._solution(self.products)
        P = len(self.units)
        correction = (solution[:P] / self.units).reshape(self.shape[::-1]).T
        weights = self.weights.copy()
        free = self.prior.start + solution[P:].reshape(self.prior.start.shape)
        weights[self.prior.free] = free
        return weights, correction

    def held_out(self, test: NDArray) -> NDArray:
        """Return the distances of rows from the solution of all others [m]."""
        columns = self.columns[test]
        flat = columns.reshape(-1, columns.shape[2])
        solution = self._solution(self.products - flat.T @ flat)
        missed = columns @ np.append(-solution, 1.0)
        # Each row as it is measured once.
        return np.linalg.norm(missed, axis=1) / self.root[test].max(axis=1)

    def _solution(self, products: NDArray) -> NDArray:
        """Return scaled W and changes of the weights, whose sums with the start are positive.

        Least squares plus the penalties |W|^2 and those of the prior. W is eliminated first.
        """
        P = len(self.units)
        A = slice(0, P)
        B = slice(P, -1)
        normal = products[A, A] + np.eye(P)
        explained = np.linalg.solve(normal, products[A, P:])
        of_weights, of_tips = explained[:, :-1], explained[:, -1]
        if not len(self.prior.precision):
            return of_tips
        start = self.prior.start.ravel()
        system = products[B, B] - products[B, A] @ of_weights
        system = system + self.noise * self.prior.precision
        moment = products[B, -1] - products[B, A] @ of_tips
        # system (weights - start) = moment, with weights of zero and more.
        factor = np.linalg.cholesky(system)
        target = np.linalg.solve(factor, moment + system @ start)
        weights, _ = nnls(factor.T, target)
        return np.concatenate(
            [of_tips - of_weights @ (weights - start), weights - start]
        )
