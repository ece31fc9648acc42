"""Rows and their weights: equal rows are merged, and rows of weight 0 lose their targets."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.arrays import as_array, table


def targets_that_count(y: Any, weights: Any, name: str) -> Any:
    """Return targets (N, ...) in which rows of weight 0 repeat the first row that counts.

    Nothing then depends on what `y` holds there: NaN, or any number. Of rows that do not count,
    all are zero. Shapes and weights that are not allowed pass, for the checks that follow.
    """
    if weights is None:
        return y
    rows = table(y, name)
    counts = table(weights, "sample_weight")
    if np.ndim(rows) == 0 or np.shape(counts) != np.shape(rows)[:1]:
        return y
    counted = counts != 0.0
    if counted.all():
        return rows
    filled = rows.copy()
    filled[~counted] = rows[counted][0] if counted.any() else 0.0
    return filled


def distinct_rows(
    X: NDArray | Tensor,
    y: NDArray | Tensor,
    weights: NDArray | Tensor,
    apart: NDArray,
    runs: bool = False,
) -> tuple[NDArray, NDArray, NDArray]:
    """Return the different rows, in order of first occurrence, and how often each counts.

    With them a weight of k and k equal rows give the same fit, and equal rows are held out
    together.

    Parameters
    ----------
    X, y : array or Tensor of shape (N, n) and (N, m)
        Measured rows.
    weights : array or Tensor of shape (N,)
        Weights.
    apart : ndarray of shape (N, k)
        Further columns in which rows must be equal to be merged, for example `Groups.apart`.
    runs : bool, default=False
        Merge only equal rows that follow each other, and keep rows of weight 0.

    Returns
    -------
    first : ndarray of int of shape (K,)
        The first of each set of equal rows, ascending.
    weights : ndarray of shape (K,)
        Sums of the weights of equal rows.
    place : ndarray of int of shape (N,)
        Index into `first` for each row; -1 for rows of weight 0.
    """
    columns = as_array(X), as_array(y), apart
    rows = np.column_stack(columns).astype(np.float64)
    rows += 0.0  # -0.0 equals 0.0
    times = as_array(weights)

    # One key for each row that counts; equal rows have equal keys.
    if runs:
        counted = np.arange(len(rows))
        differs = (rows[1:] != rows[:-1]).any(axis=1)
        keys = np.cumsum(np.append(True, differs))
    else:
        counted = np.flatnonzero(times)
        whole_row = np.dtype((np.void, rows.itemsize * rows.shape[1]))
        keys = rows[counted].view(whole_row)[:, 0]

    # The different keys in order of first occurrence.
    _, first, inverse = np.unique(keys, return_index=True, return_inverse=True)
    order = np.argsort(first)
    rank = np.argsort(order)
    place = np.full(len(rows), -1)
    place[counted] = rank[inverse]
    counts = np.bincount(place[counted], weights=times[counted])
    first = counted[first[order]]
    return first, counts, place


def at_place(values: NDArray, place: NDArray) -> NDArray:
    """Return values (K, ...) of the different rows for all rows (N, ...), NaN for weight 0."""
    missing = np.full_like(values[:1], np.nan)
    return np.append(values, missing, axis=0)[place]
