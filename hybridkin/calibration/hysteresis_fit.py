"""A Prandtl-Ishlinskii operator for the hysteresis of the actuators, from a log."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import nnls

from hybridkin._core.model import ForwardModel
from hybridkin.chains.play import PlayOperator
from hybridkin.chains.prandtl_ishlinskii import PrandtlIshlinskiiOperator

# Widths of the plays, relative to one backlash.
_FACTORS = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 4.0, 8.0])
_ROUNDS = 5
_LEAST_NOISE = 1e-5  # relative to the spread of the tips
_COMMON = 0.5  # prior correlation of the slopes of two actuators


class HysteresisProblem:
    """Slopes of plays by least squares of the tips, with a linear correction inside the model.

    The tips of rows are F(z(y) + W [1, q]): the model at the effective changes y, plus a linear
    correction of its inner coordinates z, as of serial coupling. y is linear in the slopes of a
    Prandtl-Ishlinskii operator, whose plays run through whole motions. Gauss-Newton steps from one
    backlash solve for the slopes and W together. A normal prior holds the slopes near those of the
    backlash; it is correlated, as actuators of one robot are alike.

    Parameters
    ----------
    model : ForwardModel
        The mechanical model, calibrated with one backlash.
    q : ndarray of shape (N, n)
        Commands, the rows of each motion in order of time [unit of q].
    motions : ndarray of shape (N,)
        Motion of every row.
    x : ndarray of shape (N, m)
        Measured tips [m].
    counts : ndarray of shape (N,)
        How many times each row counts.
    width : float
        Width of the one backlash [unit of q].
    """

    def __init__(
        self,
        model: ForwardModel,
        q: NDArray,
        motions: NDArray,
        x: NDArray,
        counts: NDArray,
        width: float,
    ) -> None:
        self.model = model
        self.x = x
        self.root = np.sqrt(counts)[:, None]
        self.widths = width * _FACTORS
        plays = [PlayOperator(w).apply_by_group(q, motions) for w in self.widths]
        self.widest = plays[-1]
        self.steps = -np.diff(plays, axis=0).transpose(1, 0, 2)  # (N, K - 1, n)
        self.start = (_FACTORS[:-1] >= 1.0).astype(float)[:, None] * np.ones(q.shape[1])
        scale = np.ptp(q, axis=0)
        scale = np.where(scale > 0.0, scale, 1.0)
        self.inputs = np.column_stack([np.ones(len(q)), (q - q.mean(axis=0)) / scale])

    def effective(self, slopes: NDArray) -> NDArray:
        """Return the effective changes (N, n) of slopes (K - 1, n)."""
        return self.widest + (self.steps * slopes).sum(axis=1)

    def operator(self, slopes: NDArray) -> PrandtlIshlinskiiOperator:
        """Return the operator of slopes (K - 1, n)."""
        return PrandtlIshlinskiiOperator(self.widths, slopes)

    def fitted(self, rows: NDArray, spread: float) -> NDArray:
        """Return the slopes (K - 1, n) fitted to some rows.

        Parameters
        ----------
        rows : ndarray of int
            The rows to fit.
        spread : float
            Standard deviation of the prior of a slope.
        """
        K, n = self.start.shape
        prior = spread**2 * ((1.0 - _COMMON) * np.eye(n) + _COMMON)
        precision = np.kron(np.eye(K), np.linalg.inv(prior))
        least = _LEAST_NOISE**2 * self.x[rows].var()
        slopes = self.start
        weights: NDArray | None = None
        for _ in range(_ROUNDS):
            residual, by_weights, by_slopes, weights = self._linearised(
                rows, slopes, weights
            )
            if not np.isfinite(residual).all():
                return self.start  # the model is not regular so far from the rows
            noise = np.square(residual).mean() + least
            # One unit of the scaled weights moves the tips by 1 m; they may explain all errors.
            units = np.sqrt(np.square(by_weights).sum(axis=1).mean(axis=0))
            units = np.where(units > 0.0, units, 1.0)
            A = (by_weights / units).reshape(len(rows) * self.x.shape[1], -1)
            B = by_slopes.reshape(len(A), -1)
            deviation = (slopes - self.start).ravel()
            scaled_weights = weights.T.ravel() * units
            y = residual.ravel() + A @ scaled_weights + B @ deviation
            new_slopes, scaled_weights = _least_squares(
                A, B, y, noise * precision, self.start.ravel()
            )
            slopes = new_slopes.reshape(K, n)
            weights = (scaled_weights / units).reshape(weights.T.shape).T
        return slopes

    def _linearised(
        self, rows: NDArray, slopes: NDArray, weights: NDArray | None
    ) -> tuple[NDArray, NDArray, NDArray, NDArray]:
        """Return residuals (R, m), their slopes by W (R, m, P C) and slopes, and W (C, P)."""
        q = torch.from_numpy(self.effective(slopes)[rows])
        inputs = self.inputs[rows]
        with torch.no_grad():
            z, dz = self.model.coordinates(q)
            if weights is None:
                weights = np.zeros((z.shape[1], inputs.shape[1]))
            tips, J = self.model.from_coordinates_and_jacobian(
                z + torch.from_numpy(inputs @ weights.T)
            )
            by_actuators = (J @ dz).numpy()
        root = self.root[rows]
        residual = root * (self.x[rows] - tips.numpy())
        J = root[..., None] * J.numpy()
        by_actuators = root[..., None] * by_actuators
        by_weights = inputs[:, None, :, None] * J[:, :, None]
        by_slopes = by_actuators[:, :, None] * self.steps[rows][:, None]
        by_weights = by_weights.reshape(*residual.shape, -1)
        return residual, by_weights, by_slopes, weights


def _least_squares(
    A: NDArray, B: NDArray, y: NDArray, penalty: NDArray, start: NDArray
) -> tuple[NDArray, NDArray]:
    """Return the slopes s >= 0 and weights w of least |y - A w - B (s - start)|^2 + penalties.

    The penalties are |w|^2 and (s - start)' penalty (s - start). The weights are eliminated first.
    """
    gram = A.T @ A + np.eye(A.shape[1])
    explained = np.linalg.solve(gram, np.column_stack([A.T @ B, A.T @ y]))
    system = B.T @ B - (B.T @ A) @ explained[:, :-1] + penalty
    moment = B.T @ y - (B.T @ A) @ explained[:, -1]
    # system (slopes - start) = moment, with slopes of zero and more.
    factor = np.linalg.cholesky(system)
    target = np.linalg.solve(factor, moment + system @ start)
    slopes, _ = nnls(factor.T, target)
    weights = explained[:, -1] - explained[:, :-1] @ (slopes - start)
    return slopes, weights
