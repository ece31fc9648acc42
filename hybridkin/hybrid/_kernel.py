"""Cross-validation folds, and kernel ridge regression with parameters tuned on them."""

from __future__ import annotations

from functools import cache, lru_cache
from itertools import product
from math import inf

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances

from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import distance, folds

_MOST = 10_000  # rows; the matrices then take 3 GB
_FOLDS = 5
_FOLDS_OF_FEW = 10
_FEW = 200
_ALPHAS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
# Divided by the mean variance of the inputs.
_GAMMAS = (
    0.003,
    0.01,
    0.03,
    0.1,
    0.3,
    1.0,
)


def folds_of(X: NDArray, groups: NDArray | None) -> list[tuple[NDArray, NDArray]]:
    """Return training and held-out rows of 5 folds of groups, or rows; 10 folds for small logs."""
    return folds(X, groups, _FOLDS if len(X) >= _FEW else _FOLDS_OF_FEW, shuffle=True)


def tuned_kernel(
    X: NDArray, error: NDArray, weights: NDArray, groups: NDArray | None
) -> KernelRidge:
    """Return Gaussian kernel ridge with the width and the penalty of least held-out error.

    The search starts on a coarse grid and moves to the best neighbour until none is better.
    """
    if len(X) > _MOST:
        raise ValueError(
            f"`X` must hold at most {_MOST} different rows with error_model='kernel', whose memory "
            f"grows with the square of their number, got {len(X)}; use fewer rows, or "
            "error_model=ELMRegressorCV()."
        )
    splits = folds_of(X, groups)
    spread = X.var(axis=0).mean() or 1.0
    with TURNS.filters:
        squares = euclidean_distances(X.astype(np.float64), squared=True)
    root = np.sqrt(weights).reshape(-1, *[1] * (error.ndim - 1))
    targets = root * error

    @lru_cache(1)
    def kernel(width: int) -> NDArray:
        return np.exp(-_GAMMAS[width] / spread * squares) * np.outer(root, root)

    @cache
    def held_out(at: tuple[int, int]) -> float:
        """Return the sum of held-out distances."""
        total = 0.0
        K = kernel(at[0])
        alpha = _ALPHAS[at[1]]
        for train, test in splits:
            system = K[np.ix_(train, train)]
            system.flat[:: len(train) + 1] += alpha
            try:
                dual = cho_solve(
                    cho_factor(system.T, True, True, False), targets[train]
                )
            except LinAlgError:
                return inf
            predicted = K[np.ix_(test, train)] @ dual / root[test]
            total += float(weights[test] @ distance(predicted, error[test]))
        return total

    widths = range(len(_GAMMAS))
    penalties = range(len(_ALPHAS))
    best = min(product(widths[::2], penalties[1::2]), key=held_out)
    previous = None
    while best != previous:
        width, penalty = best
        near = product(range(width - 1, width + 2), range(penalty - 1, penalty + 2))
        allowed = (at for at in near if at[0] in widths and at[1] in penalties)
        previous = best
        best = min(allowed, key=held_out)
    width = _GAMMAS[best[0]] / spread
    alpha = _ALPHAS[best[1]]
    return KernelRidge(kernel="rbf", gamma=width).set_params(alpha=alpha)
