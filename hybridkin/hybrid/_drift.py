"""Drift: a change of the robot since the fit, as an affine correction learned row by row."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hybridkin.hybrid._features import center_and_scale
from hybridkin.learning.regressor_modules import AffineModule

_ALPHAS = np.append(inf, 10.0 ** np.arange(3.0, -6.1, -0.5))  # penalties to choose from
# Evidence for a change of a robot: the gain in log evidence that each part of a change needs, and
# the candidates for the variance that no change explains, relative to that of the fit. Each
# doubling of this variance needs a gain of one.
SWITCH = 2.0
MISFITS = 2.0 ** np.arange(5)


def too_far() -> ValueError:
    """Return the error for rows at which the models are not finite."""
    way = "leave these rows out, or check their unit"
    return ValueError(f"`X` or `y` holds numbers too large for the model; {way}.")


class Drift(NamedTuple):
    """Statistics of the residuals of a fitted model, in which earlier residuals fade.

    The correction B [1, u], ``u = (q - center) / scale``, is the ridge regression of the residuals
    with penalty `alpha`. It starts at zero and returns to zero in directions without new data.

    Parameters
    ----------
    center, scale : ndarray of shape (n,)
        Map of the training range to [-1, 1] [unit of q].
    gram : ndarray of shape (m, n + 1, n + 1)
        Weighted products of [1, u] over the rows in which each output was measured.
    moment : ndarray of shape (n + 1, m)
        Their weighted products with the residuals [m].
    squares : ndarray of shape ()
        Weighted sum of the squared residuals [m^2].
    alpha : float
        The penalty; infinite: no correction.
    """

    center: NDArray
    scale: NDArray
    gram: NDArray
    moment: NDArray
    squares: NDArray
    alpha: float = inf

    @classmethod
    def of_range(cls, q: Tensor, n_outputs: int) -> Drift:
        """Return the drift before any measurement, for training rows q (N, n)."""
        center, scale = center_and_scale(q)
        n = len(scale) + 1
        none = np.zeros((n_outputs, n, n)), np.zeros((n, n_outputs)), np.zeros(())
        return cls(center.numpy(), scale.numpy(), *none)

    def learned(self, q: NDArray, residual: NDArray, weights: NDArray, decay: float) -> Drift:
        """Return the statistics after rows q (N, n) in order of time.

        Each row multiplies the weights of all earlier rows by `decay`, once per repetition. The
        residual of a missing marker is NaN; every row has at least one.
        """
        measured = ~np.isnan(residual)
        residual = np.where(measured, residual, 0.0)
        if not (measured.any(axis=1).all() and np.isfinite(residual).all()):
            raise too_far()
        phi = np.column_stack([np.ones(len(q)), (q - self.center) / self.scale])
        later = weights[::-1].cumsum()[::-1] - weights
        decayed = weights
        if decay < 1.0:
            decayed = (1.0 - decay**weights) / (1.0 - decay)
        weighed = (decayed * decay**later)[:, None] * phi
        remaining = decay ** weights.sum()
        gram = remaining * self.gram + np.einsum("nk,ni,nj->kij", measured, weighed, phi)
        moment = remaining * self.moment + weighed.T @ residual
        squares = remaining * self.squares + weighed[:, 0] @ (residual**2).sum(1)
        return self._replace(gram=gram, moment=moment, squares=squares)

    def emptied(self) -> Drift:
        """Return the drift before any measurement."""
        return self._replace(
            gram=0.0 * self.gram,
            moment=0.0 * self.moment,
            squares=0.0 * self.squares,
            alpha=inf,
        )

    def likeliest_alpha(self, noise: float) -> float:
        """Return the penalty of largest evidence, infinite if no correction is as likely.

        Parameters
        ----------
        noise : float
            Standard deviation of one residual coordinate without a change [m].
        """
        sizes, axes = np.linalg.eigh(self.gram)
        along = (self.moment.T[:, None] @ axes).ravel() ** 2
        sizes = sizes.ravel()
        alphas = _ALPHAS[:, None]
        misfits = MISFITS[:, None]
        explained = (along / (sizes + alphas)).sum(1)
        spread = np.log1p(sizes.clip(min=0.0) / alphas).sum(1)
        left = (self.squares - explained) / (misfits * noise**2)
        count = self.gram[:, 0, 0].sum()
        evidence = -0.5 * (left + spread + count * np.log(misfits)) - np.log2(misfits)
        evidence -= 2.0 * SWITCH * (_ALPHAS < inf)  # offset and slope
        return float(_ALPHAS[evidence.max(0).argmax()])

    def __bool__(self) -> bool:
        """Return whether there is a correction."""
        return self.alpha < inf

    def correction(self) -> AffineModule:
        """Return the correction as a torch module q (..., n) -> (..., m)."""
        largest = self.gram.trace(axis1=1, axis2=2).max()
        least = np.finfo(float).eps * largest + np.finfo(float).tiny
        system = self.gram + max(self.alpha, least) * np.eye(len(self.moment))
        readout = np.linalg.solve(system, self.moment.T[..., None])[..., 0].T
        coef = readout[1:].T / self.scale
        return AffineModule(coef, readout[0] - coef @ self.center)
