"""A change of the robot since the fit: an affine correction, learned measurement by measurement."""

from __future__ import annotations

from math import inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hybridkin.hybrid._features import center_and_scale
from hybridkin.learning.regressor_modules import AffineModule

_ALPHAS = 10.0 ** np.arange(3.0, -6.1, -0.5)  # penalties to choose from
_SWITCH = 4.0  # the gain in log evidence that a correction must bring


class Drift(NamedTuple):
    """Statistics of the residuals of a fitted model; earlier ones fade.

    The correction B [1, u], ``u = (q - center) / scale``, is the ridge regression of the residuals
    with penalty `alpha`. It starts at zero and returns to zero where nothing is measured for long.

    Parameters
    ----------
    center, scale : ndarray of shape (n,)
        Map of the range of the fit to [-1, 1] [unit of q].
    gram : ndarray of shape (n + 1, n + 1)
        Weighted products of [1, u].
    moment : ndarray of shape (n + 1, m)
        Their weighted products with the residuals [m].
    """

    center: NDArray
    scale: NDArray
    gram: NDArray
    moment: NDArray

    @classmethod
    def of_range(cls, q: Tensor, n_outputs: int) -> Drift:
        """Return the drift before any measurement, for a fit to rows q (N, n)."""
        center, scale = center_and_scale(q)
        n = len(scale) + 1
        return cls(center.numpy(), scale.numpy(), np.zeros((n, n)), np.zeros((n, n_outputs)))

    def learned(self, q: NDArray, residual: NDArray, weights: NDArray, decay: float) -> Drift:
        """Return the statistics after rows q (N, n) in order of time.

        Each row multiplies the weight of all before it by `decay`, once for each repetition.
        """
        phi = np.column_stack([np.ones(len(q)), (q - self.center) / self.scale])
        later = weights[::-1].cumsum()[::-1] - weights
        own = weights if decay == 1.0 else (1.0 - decay**weights) / (1.0 - decay)
        weighed = (own * decay**later)[:, None] * phi
        kept = decay ** weights.sum()
        gram, moment = kept * self.gram + weighed.T @ phi, kept * self.moment + weighed.T @ residual
        return self._replace(gram=gram, moment=moment)

    def emptied(self) -> Drift:
        """Return the drift before any measurement."""
        return self._replace(gram=0.0 * self.gram, moment=0.0 * self.moment)

    def likeliest_alpha(self, noise: float) -> float:
        """Return the penalty of largest evidence, infinite where no correction is as likely.

        Parameters
        ----------
        noise : float
            Standard deviation of a coordinate of a residual without a change [m]. NaN: unknown,
            then the penalty is 1.
        """
        if np.isnan(noise):
            return 1.0
        sizes, axes = np.linalg.eigh(self.gram)
        alphas = _ALPHAS[:, None]
        along = (axes.T @ self.moment / noise) ** 2
        explained = along.sum(1) / (sizes + alphas)
        gain = 0.5 * (explained - self.moment.shape[1] * np.log1p(sizes / alphas)).sum(1)
        return float(_ALPHAS[gain.argmax()]) if gain.max() > _SWITCH else inf

    def correction(self, alpha: float) -> AffineModule:
        """Return the correction as a torch module q (..., n) -> (..., m)."""
        readout = 0.0 * self.moment
        if alpha < inf:
            system = self.gram + alpha * np.eye(len(self.gram))
            readout = np.linalg.solve(system, self.moment)
        coef = readout[1:].T / self.scale
        return AffineModule(coef, readout[0] - coef @ self.center)
