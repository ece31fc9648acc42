"""Folds by the size of a log, and kernel ridge regression with parameters tuned on them."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
from numpy.typing import NDArray
from sklearn.kernel_ridge import KernelRidge

from hybridkin.calibration.measured import folds

_FOLDS, _FOLDS_OF_FEW, _FEW = 5, 10, 200
_ALPHAS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
_GAMMAS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # over the mean variance of the inputs


def folds_of(X: NDArray, groups: NDArray | None) -> list[tuple[NDArray, NDArray]]:
    """Return training and held-out rows of 5 folds of groups, or of rows; 10 of a small log."""
    return folds(X, groups, _FOLDS if len(X) >= _FEW else _FOLDS_OF_FEW, shuffle=True)


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distance of two sets of tips (N, m) or (N,), row by row, shape (N,)."""
    return np.abs(a - b) if a.ndim == 1 else np.linalg.norm(a - b, axis=1)


def tuned_kernel(
    X: NDArray, error: NDArray, weights: NDArray, groups: NDArray | None
) -> KernelRidge:
    """Return Gaussian kernel ridge with the width and the penalty of least held-out distance.

    The search starts on a coarse grid and walks to the best neighbour until none is better.
    """
    splits = folds_of(X, groups)
    spread = X.var(axis=0).mean() or 1.0

    def ridge(at: tuple[int, int]) -> KernelRidge:
        gamma = _GAMMAS[at[0]] / spread
        return KernelRidge(kernel="rbf", gamma=gamma).set_params(alpha=_ALPHAS[at[1]])

    @cache
    def held_out(at: tuple[int, int]) -> float:
        total = 0.0
        for train, test in splits:
            fitted = ridge(at).fit(X[train], error[train], sample_weight=weights[train])
            total += float(weights[test] @ distance(fitted.predict(X[test]), error[test]))
        return total

    widths, penalties = range(len(_GAMMAS)), range(len(_ALPHAS))
    best, previous = min(product(widths[::2], penalties[1::2]), key=held_out), None
    while best != previous:
        width, penalty = best
        near = product(range(width - 1, width + 2), range(penalty - 1, penalty + 2))
        allowed = (at for at in near if at[0] in widths and at[1] in penalties)
        previous, best = best, min(allowed, key=held_out)
    return ridge(best)
