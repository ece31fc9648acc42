"""Broken lines in space, which pages cannot draw by themselves."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray


def dashes(points: ArrayLike, n: int, pattern: Sequence[float] = (1.0, 1.0)) -> NDArray[np.float64]:
    """Return the dashes of a broken line.

    Parameters
    ----------
    points : array-like of shape (P, 3)
        The line [m].
    n : int
        How many times the pattern is repeated.
    pattern : sequence of float, default=(1.0, 1.0)
        Lengths of dash and gap in turn, relative to each other.

    Returns
    -------
    ndarray of shape (K, 2, 3)
        The ends of every dash [m]: n for each dash of the pattern.

    Examples
    --------
    >>> from hybridkin.plots.page_server import dashes
    >>> dashes([[0.0, 0.0, 0.0], [0.0, 0.0, 0.5]], 2)[:, :, 2].tolist()
    [[0.0, 0.125], [0.25, 0.375]]
    """
    points = np.asarray(points, dtype=float)
    lengths = np.linalg.norm(np.diff(points, axis=0), axis=1)
    along = np.concatenate([[0.0], np.cumsum(lengths)])
    period = along[-1] / n
    marks = period * np.cumsum([0.0, *pattern]) / sum(pattern)
    starts = period * np.arange(n)
    places = starts[:, None, None] + marks[:-1].reshape(-1, 2)  # dash after dash, gap after gap
    ends = [np.interp(places, along, column) for column in points.T]
    return np.stack(ends, axis=-1).reshape(-1, 2, 3)
