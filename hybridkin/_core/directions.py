"""The directions of q that rows move, and directions in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

_EXCITED = 0.01  # of the largest spread
# of the largest value: a range below it is none.
_ROUNDING = 4.0 * np.finfo(np.float64).eps
_POINT = 1e-6  # of the largest value: the range of rows of a single configuration
_COUNTS = 1e-4  # of a step: numbers this close to multiples of a step are whole counts
_AS_ROUNDED = 2.0  # variances of rounding: what moves less is not distinguished from it
_INSIDE = 0.05  # part of a unit vector outside a span that counts as zero
_MENTIONED = 0.05  # of the largest part of a direction


class Directions(NamedTuple):
    """The directions of q that rows move, and those that they do not, in units of `scale`."""

    mean: NDArray  # (n,)
    scale: NDArray  # (n,), half the range; for an actuator that never moves the largest of all
    moved: NDArray  # (n, k), orthonormal columns
    still: NDArray  # (n, n - k), orthonormal columns

    def projection(self) -> tuple[NDArray, NDArray]:
        """Return M (n, n) and c (n,): q @ M + c is the part of q along the moved directions."""
        M = (self.moved @ self.moved.T) * self.scale / self.scale[:, None]
        return M, self.mean - self.mean @ M

    def normals(self) -> NDArray:
        """Return orthonormal columns (n, n - k), normal to the plane in which the rows lie."""
        return np.linalg.qr(self.still / self.scale[:, None])[0]


def moved_directions(X: NDArray) -> Directions:
    """Return the directions that rows X (N, n) move; nothing can be learned along the others.

    For example, tendons that are commanded in balance never move together: in that direction the
    rows contain only rounding errors. These have a known variance if X holds whole counts; else a
    direction that moves by less than 1 % of the largest motion counts as still.
    """
    X = X.astype(np.float64)
    mean = X.mean(axis=0)
    half = 0.5 * np.ptp(X, axis=0)
    size = np.abs(X).max(axis=0)
    moves = half > _ROUNDING * size
    scale = np.where(moves, half, max(half.max(), _POINT * size.max(), _POINT**2))
    rows = np.where(moves, (X - mean) / scale, 0.0)
    squares, axes = np.linalg.eigh(rows.T @ rows)
    rounding = len(X) / 12.0 * (axes.T**2 @ (_steps(X) / scale) ** 2)
    least = np.maximum(_AS_ROUNDED * rounding, _EXCITED**2 * squares[-1])
    excited = squares > least
    return Directions(mean, scale, axes[:, excited], axes[:, ~excited])


def _steps(X: NDArray) -> NDArray:
    """Return the step (n,) to which each column is rounded, 0 for columns of other numbers."""
    steps = np.zeros(X.shape[1])
    for j, column in enumerate(X.T):
        gaps = np.diff(np.unique(column))
        if len(gaps) > 1:
            counts = gaps / gaps.min()
            steps[j] = gaps.min() * (np.abs(counts - counts.round()) < _COUNTS).all()
    return steps


def few_terms(directions: NDArray) -> NDArray:
    """Return a sparse basis (K, P) of the span of orthonormal rows (K, P).

    For each entry, fixed to 1, minimise the sum of absolute entries; take the shortest independent.
    """
    (K, P) = directions.shape
    if K < 2:
        return directions
    cost = np.concatenate([np.zeros(K), np.ones(P)])
    eye = np.eye(P)
    above = np.block([[directions.T, -eye], [-directions.T, -eye]])

    def shortest(entry: NDArray) -> NDArray:
        equal = np.concatenate([entry, np.zeros(P)])[None]
        solution = linprog(
            cost, above, np.zeros(2 * P), equal, [1.0], bounds=(None, None)
        ).x
        # if it fails, the nearest vector.
        a = entry if solution is None else solution[:K]
        return a / np.linalg.norm(a)

    columns = directions.T[np.linalg.norm(directions, axis=0) > _INSIDE]
    candidates = [shortest(entry) for entry in columns]
    candidates.sort(
        key=lambda a: np.abs(a @ directions).sum() / np.abs(a @ directions).max()
    )
    chosen: list[NDArray] = []
    while len(chosen) < K:
        taken = np.array(chosen).reshape(-1, K)
        remaining = np.linalg.svd(taken)[2][len(chosen) :]
        free = [a for a in candidates if np.linalg.norm(remaining @ a) > _INSIDE]
        chosen.append(free[0] if free else shortest(remaining[0]))
    return np.array(chosen) @ directions


def in_terms(directions: NDArray, names: Sequence[str]) -> str:
    """Return directions of q (n, k) in words, each by few of the named actuators."""
    sentences = []
    for move in few_terms(directions.T):
        lead = np.argmax(np.abs(move) > 0.5 * np.abs(move).max())
        words = []
        for name, part in zip(names, move / move[lead], strict=True):
            if abs(part) > _MENTIONED:
                words.append(f"{part:+.2g} {name}")
        sentences.append(" ".join(words))
    return "; ".join(sentences)
