"""Friction and creep of the actuators from a log, by least squares of the tips."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls
from torch import Tensor

from hybridkin._core.arrays import LARGEST
from hybridkin.hysteresis.follow import followed
from hybridkin.hysteresis.log import HysteresisLog
from hybridkin.hysteresis.stages.backlash import Backlash
from hybridkin.hysteresis.stages.creep import Creep
from hybridkin.hysteresis.value import Hysteresis

# Widths of the plays, relative to one backlash.
_FACTORS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
_ROUNDS = 4
_LEAST_NOISE = 1e-5  # relative to the spread of the tips
_COMMON = 0.5  # prior correlation of the weights of two actuators
_BLOCK = 5_000_000  # largest number of entries that creep follows at once
_MOST_LATE = 0.95  # largest share of a change that comes late
_LEAST_SHARE = 1e-6  # of creep


class HysteresisFit(NamedTuple):
    """Weights of friction and creep, and the errors on held-out groups.

    Attributes
    ----------
    slopes : ndarray of shape (K, n)
        Slopes of the plays, see `Hysteresis.friction`.
    shares : ndarray of shape (J, n)
        Shares of creep, see `Hysteresis.creep`.
    distances : ndarray of shape (C,)
        Distances of the counted rows from a fit without their group [m].
    """

    slopes: NDArray
    shares: NDArray
    distances: NDArray


class HysteresisProblem:
    """Friction and creep by least squares of the tips, with a linear correction inside the model.

    The tips are F(z(y) + W [1, y]): the model at the effective changes y, plus a linear correction
    of its inner coordinates z, as of serial coupling. With the plays P_k of
    friction of slopes s, and slow states S_j of creep of shares g,
    ``u = P_K + sum_k s_k (P_k - P_{k+1})`` and ``y = u + sum_j g_j (S_j(u) - u)``, where S_j is
    linear. Gauss-Newton steps from one backlash solve for s, g and W together. A normal prior holds
    the slopes near those of the backlash and the shares near zero; it is correlated, as the
    actuators of one robot are alike.

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
        self.times = log.times if creep else np.empty(0)
        # (C, K + 1, n), of which u is a weighted sum, and what creep does with them
        self.changes, self.late = self._changes()
        n = log.q.shape[1]
        one_backlash = _FACTORS[: len(self.widths) - 1] >= 1.0
        self.start = np.outer(one_backlash, np.ones(n))

        self.measured = log.x[log.rows]
        counts = log.counts[log.rows]
        roots = np.sqrt(counts)[:, None]
        self.roots = np.where(np.isnan(self.measured), 0.0, roots)
        self.center = np.average(log.q[log.rows], axis=0, weights=counts)
        self.scale = log.ranges
        self.least_noise = _LEAST_NOISE**2 * np.nanvar(self.measured)

    def _changes(self) -> tuple[NDArray, NDArray]:
        """Return changes c (C, K + 1, n), and S(c) - c (C, J, K + 1, n) with the slow states S.

        The rows that do not count move the plays and slow states, one after the other.
        """
        log = self.log
        order = log.order
        rows = log.q[order.order]
        steps = order.steps(log.time)
        counted = np.argsort(order.order)[log.rows]
        n = rows.shape[1]
        n_changes = len(self.widths)
        changes = np.empty((len(counted), n_changes, n))
        late = np.empty((len(counted), len(self.times), n_changes, n))
        at_once = max(1, _BLOCK // rows.size)
        block: list[NDArray] = []
        play = followed([Backlash(self.widths[0])], rows, steps)
        for k in range(n_changes):
            wider = np.zeros_like(play)  # what is left of the widest is the last change
            if k + 1 < n_changes:
                wider = followed([Backlash(self.widths[k + 1])], rows, steps)
            block.append(play - wider)
            play = wider
            changes[:, k] = block[-1][counted]
            if len(block) < at_once and k + 1 < n_changes:
                continue
            side_by_side = np.concatenate(block, axis=1)
            for j, time in enumerate(self.times):
                of_block = self._late(side_by_side, steps, time)[counted]
                part = late[:, j, k + 1 - len(block) : k + 1]
                part[:] = of_block.reshape(part.shape)
            block.clear()
        return changes, late

    def _late(self, change: NDArray, steps: NDArray, time: float) -> NDArray:
        """Return S(c) - c (N, n) of changes c in the order of runs, with the slow state S.

        Rows that were left out lie on a straight line between two others, in equal steps. A command
        in between, held from one of the two to the other, leads to the same S.
        """
        held_back = _held_back(steps / time, self.log.recorded)
        held = change - held_back[:, None] * np.diff(change, axis=0, prepend=change[:1])
        half = Creep([0.5], [time])  # y - u = (S(u) - u) / 2
        return 2.0 * followed([half], held, steps) - held - change

    def hysteresis(self, fit: HysteresisFit) -> Hysteresis:
        """Return the hysteresis of fitted slopes and shares; maybe none."""
        hysteresis = Hysteresis()
        if (fit.slopes != self.start).any():
            hysteresis = Hysteresis.friction(self.widths, fit.slopes)
        elif self.widths.any():
            hysteresis = Hysteresis.backlash(self.widths[_FACTORS == 1.0].item())
        some = (fit.shares > _LEAST_SHARE).any(axis=1)
        if not some.any():
            return hysteresis
        return hysteresis | Hysteresis.creep(fit.shares[some], self.times[some])

    def fitted(self, slope_spread: float, share_spread: float) -> HysteresisFit:
        """Return the fit to all rows, and the errors of fits without each fold.

        The fits without a fold share the last linearisation of the fit to all rows.

        Parameters
        ----------
        slope_spread, share_spread : float
            Standard deviations of the priors of a slope and of a share; 0 for fixed ones.
        """
        n_slopes, n = self.start.shape
        n_shares = len(self.times)
        weights = np.concatenate([self.start, np.zeros((n_shares, n))])
        spreads = np.repeat([slope_spread, share_spread], [n_slopes, n_shares])
        prior = _Prior.of(weights, spreads)
        moved = self._moved(weights)
        correction = np.zeros((moved.z.shape[1], 1 + len(self.center)))
        system = None
        for _ in range(_ROUNDS):
            system = self._linearised(moved, weights, correction, prior)
            if not system.is_finite:
                # The model is not regular so far away.
                unknown = np.full(len(self.log.rows), LARGEST)
                return HysteresisFit(weights[:n_slopes], weights[n_slopes:], unknown)
            solution = system.solution(system.products)
            correction = solution[: correction.size].reshape(correction.shape)
            if prior.free.any():
                weights[prior.free] = solution[correction.size :].reshape(-1, n)
                shares = weights[n_slopes:]
                shares *= _MOST_LATE / np.maximum(shares.sum(axis=0), _MOST_LATE)
                moved = self._moved(weights)
        assert system is not None
        distances = system.held_out() / self.roots.max(axis=1)
        return HysteresisFit(weights[:n_slopes], weights[n_slopes:], distances)

    def _effective(self, weights: NDArray) -> tuple[NDArray, NDArray]:
        """Return the effective changes y (C, n), and dy / d weights (C, K + J, n).

        An actuator depends on its own weights (K + J, n) only.
        """
        n_slopes = len(self.start)
        shares = weights[n_slopes:]
        of_changes = np.ones((n_slopes + 1, weights.shape[1]))  # the last are 1
        of_changes[:-1] = weights[:n_slopes]
        by_shares = np.einsum("cjkn,kn->cjn", self.late, of_changes)
        y = np.einsum("ckn,kn->cn", self.changes, of_changes)
        y += np.einsum("cjn,jn->cn", by_shares, shares)
        delayed = np.einsum("cjkn,jn->ckn", self.late[:, :, :n_slopes], shares)
        by_slopes = self.changes[:, :n_slopes] + delayed
        return y, np.concatenate([by_slopes, by_shares], axis=1)

    def _moved(self, weights: NDArray) -> _Moved:
        """Return what the actuators do with some weights (K + J, n)."""
        y, by_weights = self._effective(weights)
        inputs = np.column_stack([np.ones(len(y)), (y - self.center) / self.scale])
        with torch.no_grad():
            z, slope = self.log.model.coordinates(torch.from_numpy(y))
        return _Moved(by_weights, inputs, z, slope)

    def _linearised(
        self, moved: _Moved, weights: NDArray, correction: NDArray, prior: _Prior
    ) -> _LeastSquares:
        """Return the least squares of the next step, from weights and a correction W."""
        of_correction = moved.inputs @ correction.T
        with torch.no_grad():
            corrected = moved.z + torch.from_numpy(of_correction)
            tips, slope = self.log.model.from_coordinates_and_jacobian(corrected)
        residual = np.where(self.roots > 0.0, self.measured - tips.numpy(), 0.0)

        # What the unknowns have to explain: the residual, and what they explain already.
        by_z = slope.numpy()
        by_free = np.empty((*residual.shape, 0))
        if prior.free.any():
            by_y = by_z @ (moved.slope.numpy() + correction[:, 1:] / self.scale)
            by_free = by_y[:, :, None] * moved.by_weights[:, None, prior.free]
            by_free = by_free.reshape(*residual.shape, -1)
        target = residual + (by_z @ of_correction[..., None])[..., 0]
        target += by_free @ weights[prior.free].ravel()

        counts = self.roots**2
        noise = np.average(residual**2, weights=counts) + self.least_noise
        roots = self.roots[..., None]
        return _LeastSquares(
            roots * by_z,
            moved.inputs,
            roots * by_free,
            self.roots * target,
            [test for _, test in self.log.folds],
            noise * prior.precision,
            prior.mean,
            n_rows=counts.max(axis=1).sum(),
        )


class _Moved(NamedTuple):
    """What the actuators do at the rows that count.

    Attributes
    ----------
    by_weights : ndarray of shape (C, K + J, n)
        Derivatives of the effective changes y by the weights of each actuator.
    inputs : ndarray of shape (C, 1 + n)
        One, and y from -1 to 1 or so: the inputs of the correction.
    z, slope : Tensor of shape (C, Z) and (C, Z, n)
        Inner coordinates of the model at y, and their derivative.
    """

    by_weights: NDArray
    inputs: NDArray
    z: Tensor
    slope: Tensor


def _held_back(steps: NDArray, spans: NDArray) -> NDArray:
    """Return the share (N,) of a change that is not held, if it came in several equal steps.

    Of K equal steps, slow states lag in the end by one of them over exp(x / K) - 1, with the time x
    of all in time constants, as far as they have forgotten where they began.

    Parameters
    ----------
    steps : ndarray of shape (N,)
        Time since the row before, in time constants; zero or less: nothing is held back.
    spans : ndarray of shape (N,) or ()
        Number K of steps of the change.
    """
    passed = np.where(steps > 0.0, steps, 1.0)
    with np.errstate(over="ignore"):
        lag = 1.0 / (spans * np.expm1(passed / spans)) - 1.0 / np.expm1(passed)
    return np.where((steps > 0.0) & (spans > 1.0), lag, 0.0)


class _Prior(NamedTuple):
    """Normal prior of the free weights, correlated over actuators: those of a robot are alike."""

    free: NDArray  # (K + J,), the weights that are not fixed
    mean: NDArray  # (F,)
    precision: NDArray  # (F, F)

    @classmethod
    def of(cls, weights: NDArray, spreads: NDArray) -> _Prior:
        """Return the prior about weights (K + J, n) with standard deviations (K + J,)."""
        free = spreads > 0.0
        correlation = (1.0 - _COMMON) * np.eye(weights.shape[1]) + _COMMON
        of_actuators = np.linalg.inv(correlation)
        precision = np.kron(np.diag(spreads[free] ** -2.0), of_actuators)
        return cls(free, weights[free].ravel(), precision)


@dataclass(frozen=True)
class _LeastSquares:
    """Linear least squares of all rows, whose products are kept to leave some of them out.

    The columns are those of a correction, of weights of zero and more, and of the target. Those of
    the correction are products ``by_z[z] inputs[i]``, so they are never written out. Beside the
    penalty of the weights, each entry of the correction has one that counts as one row.
    """

    by_z: NDArray  # (C, m, Z)
    inputs: NDArray  # (C, I)
    by_weights: NDArray  # (C, m, F)
    target: NDArray  # (C, m)
    folds: list[NDArray]  # the rows of each part
    penalty: NDArray  # (F, F)
    mean: NDArray  # (F,), at which the penalty is zero
    n_rows: float

    @property
    def is_finite(self) -> bool:
        """Whether all columns are."""
        return bool(np.isfinite(self.products).all())

    @cached_property
    def of_folds(self) -> list[NDArray]:
        """Products of the columns, summed over the rows of each part."""
        return [self._products(rows) for rows in self.folds]

    @cached_property
    def products(self) -> NDArray:
        """Products of the columns, summed over all rows."""
        return np.sum(self.of_folds, axis=0)

    @cached_property
    def ridge(self) -> NDArray:
        """Penalties of the correction (Z I,)."""
        ridge = np.diag(self.products)[: -1 - len(self.mean)] / self.n_rows
        return np.where(ridge > 0.0, ridge, 1.0)

    def _products(self, rows: NDArray) -> NDArray:
        """Return the products of the columns with each other, summed over some rows."""
        by_z = self.by_z[rows]
        inputs = self.inputs[rows]
        others = np.concatenate([self.by_weights[rows], self.target[rows, :, None]], axis=2)
        n_rows, _, n_z = by_z.shape
        n_inputs = inputs.shape[1]
        n_others = others.shape[2]
        n_both = n_z * n_inputs
        products = np.empty((n_both + n_others,) * 2)

        squares = (by_z.mT @ by_z).reshape(n_rows, -1)
        first, second = np.triu_indices(n_inputs)  # the products of inputs are symmetric
        half = squares.T @ (inputs[:, first] * inputs[:, second])
        both = np.empty((n_inputs, n_inputs, n_z * n_z))
        both[first, second] = both[second, first] = half.T
        both = both.reshape(n_inputs, n_inputs, n_z, n_z)
        products[:n_both, :n_both] = both.transpose(2, 0, 3, 1).reshape(n_both, n_both)

        mixed = (by_z.mT @ others).reshape(n_rows, -1)
        mixed = (inputs.T @ mixed).reshape(n_inputs, n_z, n_others)
        mixed = mixed.transpose(1, 0, 2).reshape(n_both, n_others)
        products[:n_both, n_both:] = mixed
        products[n_both:, :n_both] = mixed.T

        flat = others.reshape(-1, n_others)
        products[n_both:, n_both:] = flat.T @ flat
        return products

    def held_out(self) -> NDArray:
        """Return the lengths (C,) of the errors of rows, from the solution without their part."""
        lengths = np.empty(len(self.target))
        for rows, of_rows in zip(self.folds, self.of_folds, strict=True):
            solution = self.solution(self.products - of_rows)
            inputs = self.inputs[rows]
            n_both = self.by_z.shape[2] * inputs.shape[1]
            correction = solution[:n_both].reshape(-1, inputs.shape[1])
            explained = (self.by_z[rows] @ (inputs @ correction.T)[..., None])[..., 0]
            explained += self.by_weights[rows] @ solution[n_both:]
            lengths[rows] = np.linalg.norm(explained - self.target[rows], axis=1)
        return lengths

    def solution(self, products: NDArray) -> NDArray:
        """Return the correction and the weights of products; the correction is eliminated."""
        P = len(self.ridge)
        normal = products[:P, :P] + np.diag(self.ridge)
        explained = np.linalg.solve(normal, products[:P, P:])
        if not len(self.mean):
            return explained[:, -1]
        remaining = products[P:, P:] - products[P:, :P] @ explained
        system = remaining[:-1, :-1] + self.penalty
        moment = remaining[:-1, -1] + self.penalty @ self.mean
        factor = np.linalg.cholesky(system)
        weights, _ = nnls(factor.T, np.linalg.solve(factor, moment))
        correction = explained @ np.append(-weights, 1.0)
        return np.concatenate([correction, weights])
