"""How far the tip is from itself where a log comes back to the same actuator vector."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls
from scipy.spatial import KDTree
from sklearn.preprocessing import PolynomialFeatures

_NEIGHBOURS = 60  # nearest rows, among which one of another motion is searched
_FEWEST = 40  # rows with such a neighbour
_CLOSE = 0.05  # largest distance of a pair, relative to the range of an actuator
_BINS = 10  # of distances, for the change of the tip with q
_STATIC = 0.2  # largest part of the squared difference of a pair that is such a change
# Mean length of normal errors in space, for a median distance 1 of two of them.
_MEAN_OF_MEDIAN = 0.7336


def repeatability(q: NDArray, x: NDArray, motions: NDArray) -> float | None:
    """Return the mean error that no function of q can go below [m].

    It is found from pairs of rows that are near in q but of two motions. What a quadratic function
    of q explains is removed, and only pairs are used over whose distance the rest does not change.
    The error is noise, drift, and what depends on the past. Medians make it robust to outliers.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Actuator vectors; or what the actuators do, to know what hysteresis leaves.
    x : ndarray of shape (N, 3)
        Measured tips [m].
    motions : ndarray of shape (N,)
        Motion of every row.

    Returns
    -------
    float or None
        None if the log has too few such pairs to tell.
    """
    span = np.ptp(q, axis=0)
    z = (q - q.mean(axis=0)) / np.where(span > 0.0, span, 1.0)
    degree = 2 if len(z) > 2 * z.shape[1] ** 2 else 1
    features = PolynomialFeatures(degree).fit_transform(z)
    weights, *_ = np.linalg.lstsq(features, x, rcond=None)
    residual = x - features @ weights

    neighbours: Any = KDTree(z).query(z, k=min(_NEIGHBOURS, len(z)))
    distances, near = neighbours
    is_other = motions[near] != motions[:, None]
    rows = np.flatnonzero(is_other.any(axis=1))
    nearest = rows, is_other[rows].argmax(axis=1)
    order = np.argsort(distances[nearest])
    apart = distances[nearest][order]
    differences = (residual[rows] - residual[near[nearest]])[order]
    squared = np.square(differences).sum(axis=1)
    n_close = int(np.searchsorted(apart, _CLOSE))
    if n_close < _FEWEST:
        return None

    # Squared differences grow as a + b h^2 with the distance h in q.
    medians = []
    for part in np.array_split(np.arange(len(apart) // 2), _BINS):
        medians.append([1.0, np.median(apart[part]) ** 2, np.median(squared[part])])
    growth = np.array(medians)
    slope = nnls(growth[:, :2], growth[:, 2])[0][1]
    used = None
    for n_pairs in np.geomspace(_FEWEST, n_close, 20).astype(int):
        median = np.median(squared[:n_pairs])
        if slope * apart[n_pairs - 1] ** 2 <= _STATIC * median:
            used = median
    return None if used is None else float(_MEAN_OF_MEDIAN * np.sqrt(used))
