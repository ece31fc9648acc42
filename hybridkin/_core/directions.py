"""The directions of q that rows move, and directions in words."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import scipy  # its folders are imported when they are used
from numpy.typing import NDArray

_EXCITED = 0.01  # of the largest spread
# of the largest value: a range below it is none.
_ROUNDING = 4.0 * np.finfo(np.float64).eps
_POINT = 1e-6  # of the largest value: the range of rows of a single configuration
_COUNTS = 1e-4  # of a step: numbers this close to multiples of a step are whole counts
_AS_ROUNDED = 2.0  # variances of rounding: what moves less is not distinguished from it
_INSIDE = 0.05  # part of a unit vector outside a span that counts as zero
_FAIR = 0.49  # of the largest part: one with more can be named first, so also a half
_MENTIONED = 0.05  # of the largest part of a direction
# Later entries cost more, by this part of the root of their place: of equal sums the first count.
_EARLIER = 1e-4
_DIGITS = 6  # of lengths; those that differ by rounding are equal


class Directions(NamedTuple):
    """The directions of q that rows move, and those that they do not, in units of `scale`."""

    mean: NDArray  # (n,)
    scale: NDArray  # (n,), half the range; for an actuator that never moves the largest of all
    moved: NDArray  # (n, k), orthonormal columns
    still: NDArray  # (n, n - k), orthonormal columns

    def projection(self) -> tuple[NDArray, NDArray]:
        """Return M (n, n) and c (n,): q @ M + c is the part of q along the moved directions."""
        along = self.moved @ self.moved.T
        M = along * self.scale / self.scale[:, None]
        return M, self.mean - self.mean @ M

    def normals(self) -> NDArray:
        """Return orthonormal columns (n, n - k), normal to the plane in which the rows lie."""
        normals, _ = np.linalg.qr(self.still / self.scale[:, None])
        return normals


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
    largest = max(half.max(), _POINT * size.max(), _POINT**2)
    scale = np.where(moves, half, largest)

    # Principal axes of the scaled rows, and their sums of squares.
    rows = np.where(moves, (X - mean) / scale, 0.0)
    squares, axes = np.linalg.eigh(rows.T @ rows)

    # Numbers rounded to steps have a variance of a twelfth of the squared step.
    step_squares = (_steps(X) / scale) ** 2
    rounding = len(X) / 12.0 * (axes.T**2 @ step_squares)
    least = np.maximum(_AS_ROUNDED * rounding, _EXCITED**2 * squares[-1])
    excited = squares > least
    return Directions(mean, scale, axes[:, excited], axes[:, ~excited])


def _steps(X: NDArray) -> NDArray:
    """Return the step (n,) to which each column is rounded, 0 for columns of other numbers."""
    steps = np.zeros(X.shape[1])
    for j, column in enumerate(X.T):
        gaps = np.diff(np.unique(column))
        if len(gaps) < 2:
            continue
        step = gaps.min()
        counts = gaps / step
        if (np.abs(counts - counts.round()) < _COUNTS).all():
            steps[j] = step
    return steps


def few_terms(directions: NDArray) -> NDArray:
    """Return a sparse basis (K, P) of the span of orthonormal rows (K, P).

    For each entry, fixed to 1, minimise the sum of absolute entries; take the shortest independent.
    Of equally short ones the first entries count, so that the result depends on the span alone, not
    on the axes that an eigenvalue problem gives it.
    """
    (K, P) = directions.shape
    if K < 2:
        return directions
    # Unknowns: coefficients (K,) of the directions, and bounds (P,) of the absolute entries.
    cost = np.concatenate([np.zeros(K), 1.0 + _EARLIER * np.sqrt(np.arange(P))])
    entries = np.hstack([directions.T, np.zeros((P, P))])
    bounds = np.hstack([np.zeros((P, K)), np.eye(P)])
    above = np.vstack([entries - bounds, -entries - bounds])

    def shortest(entry: NDArray) -> NDArray:
        fixed = np.pad(entry, (0, P))[None]
        zeros = np.zeros(2 * P)
        solution = scipy.optimize.linprog(cost, above, zeros, fixed, [1.0], bounds=(None, None))
        coefficients = entry  # the nearest vector, if there is no solution
        if solution.x is not None:
            coefficients = solution.x[:K]
        return coefficients / np.linalg.norm(coefficients)

    def length(coefficients: NDArray) -> float:
        sizes = np.abs(coefficients @ directions)
        return round(sizes.sum() / sizes.max(), _DIGITS)

    determined = np.linalg.norm(directions, axis=0) > _INSIDE
    candidates = [shortest(entry) for entry in directions.T[determined]]
    candidates.sort(key=length)  # of equal ones the first stay first
    chosen = np.empty((0, K))
    while len(chosen) < K:
        remaining = np.linalg.svd(chosen)[2][len(chosen) :]
        for candidate in candidates:
            if np.linalg.norm(remaining @ candidate) > _INSIDE:
                break
        else:
            candidate = shortest(remaining[0])
        chosen = np.vstack([chosen, candidate])
    return chosen @ directions


def leading_part(sizes: NDArray) -> int:
    """Return which part of a direction is named first: the first of fair size."""
    return int(np.argmax(sizes > _FAIR * sizes.max()))


def in_terms(directions: NDArray, names: Sequence[str]) -> str:
    """Return directions of q (n, k) in words, each by few of the named actuators."""
    sentences = []
    for move in few_terms(directions.T):
        sizes = np.abs(move)
        lead = leading_part(sizes)
        parts = np.round(move / move[lead], _DIGITS)
        words = []
        for name, part in zip(names, parts, strict=True):
            if abs(part) > _MENTIONED:
                words.append(f"{part:+.2g} {name}")
        sentences.append(" ".join(words))
    return "; ".join(sentences)
