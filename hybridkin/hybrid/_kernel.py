"""Cross-validation folds, and kernel ridge regression with parameters tuned on them."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache, lru_cache
from itertools import product
from math import inf

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from sklearn.kernel_ridge import KernelRidge
from sklearn.metrics.pairwise import euclidean_distances

from hybridkin._core.groups import Groups
from hybridkin._core.turns import TURNS
from hybridkin.calibration.measured import distance, evenly_spaced_of

_MOST = 10_000  # rows; the matrices then take 3 GB
_FOLDS = 5
_FOLDS_OF_FEW = 10
_FEW = 200
_ALPHAS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
# Divided by the mean variance of the inputs.
_GAMMAS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)
_WIDTHS = range(len(_GAMMAS))
_PENALTIES = range(len(_ALPHAS))
_FIRST = 600  # rows of the first search
_ENOUGH = 1200  # rows of the second one
_BESIDE = ((-1, 0), (1, 0), (0, -1), (0, 1))
_AROUND = ((-1, -1), (-1, 1), (1, -1), (1, 1), *_BESIDE)
Place = tuple[int, int]


def folds_of(groups: Groups) -> list[tuple[NDArray, NDArray]]:
    """Return training and held-out rows of 5 folds of groups; 10 folds for small logs."""
    most = _FOLDS if len(groups) >= _FEW else _FOLDS_OF_FEW
    return groups.folds(most, shuffle=True)


def tuned_kernel(X: NDArray, error: NDArray, weights: NDArray, groups: Groups) -> KernelRidge:
    """Return Gaussian kernel ridge with the width and the penalty of least held-out error.

    The search starts on a coarse grid and moves to the best neighbour until none is better. It
    takes a few evenly spaced rows first; then more of them move it to neighbours in one parameter.
    """
    if len(X) > _MOST:
        raise ValueError(
            f"`X` must hold at most {_MOST} different rows with error_model='kernel', whose memory "
            f"grows with the square of their number, got {len(X)}; use fewer rows, or "
            "error_model=ELMRegressorCV()."
        )
    squares = np.square(X - np.average(X, axis=0, weights=weights))
    spread = np.average(squares, axis=0, weights=weights).mean() or 1.0

    def held_out(most: int) -> _HeldOut:
        rows = evenly_spaced_of(groups, most)
        return _HeldOut(X[rows], error[rows], weights[rows], groups.take(rows), spread)

    few = held_out(_FIRST)
    best = min(product(_WIDTHS[::2], _PENALTIES[1::2]), key=few.distance)
    best = few.best_near(best, _AROUND)
    if len(X) > _FIRST:
        best = held_out(_ENOUGH).best_near(best, _BESIDE)
    width = _GAMMAS[best[0]] / spread
    alpha = _ALPHAS[best[1]]
    return KernelRidge(kernel="rbf", gamma=width).set_params(alpha=alpha)


class _HeldOut:
    """Held-out distances of kernels; a kernel is a place among the widths and the penalties."""

    def __init__(
        self,
        X: NDArray,
        error: NDArray,
        weights: NDArray,
        groups: Groups,
        spread: float,
    ) -> None:
        self._error = error
        self._weights = weights
        self._spread = spread
        self._splits = folds_of(groups)
        self._root = np.sqrt(weights).reshape(-1, *[1] * (error.ndim - 1))
        with TURNS.filters:
            self._squares = euclidean_distances(X.astype(np.float64), squared=True)
        self._kernel = lru_cache(1)(self._weighted_kernel)
        self.distance = cache(self._distance)

    def best_near(self, at: Place, steps: Iterable[Place]) -> Place:
        """Return the place from which none of the steps leads to a smaller distance."""
        previous = None
        while at != previous:
            previous = at
            near = [(at[0] + width, at[1] + penalty) for width, penalty in steps]
            inside = set(near) & set(product(_WIDTHS, _PENALTIES))
            at = min([at, *sorted(inside)], key=self.distance)
        return at

    def _weighted_kernel(self, width: int) -> NDArray:
        scaled = torch.from_numpy(-_GAMMAS[width] / self._spread * self._squares)
        kernel = scaled.exp_().numpy()  # NumPy's exponential is slower
        root = self._root.reshape(-1, 1)
        kernel *= root
        kernel *= root.T
        return kernel

    def _distance(self, at: Place) -> float:
        """Return the sum of held-out distances."""
        total = 0.0
        K = self._kernel(at[0])
        targets = self._root * self._error
        for train, test in self._splits:
            system = K[np.ix_(train, train)]
            system.flat[:: len(train) + 1] += _ALPHAS[at[1]]
            try:
                factor = cho_factor(system.T, True, True, False)
            except LinAlgError:
                return inf
            predicted = K[np.ix_(test, train)] @ cho_solve(factor, targets[train])
            far = distance(predicted / self._root[test], self._error[test])
            total += float(self._weights[test] @ far)
        return total
