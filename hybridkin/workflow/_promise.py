"""The error to expect of a robot at new commands, from held-out errors and distances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import nnls


@dataclass(frozen=True)
class Promise:
    """Mean error to expect, which grows linearly with the distance from the log, and a quantile.

    Attributes
    ----------
    at_rows : float
        Mean error at rows of the log [m].
    per_distance : float
        Its growth with the distance, see `distances` [m].
    p95 : float
        95 % quantile of the errors, relative to the mean.
    """

    at_rows: float
    per_distance: float
    p95: float

    @classmethod
    def of(cls, errors: NDArray, distances: NDArray) -> Promise:
        """Return the promise from errors (N,) of held-out rows and their distances (N,)."""
        columns = np.column_stack([np.ones_like(errors), distances])
        at_rows, per_distance = nnls(columns, errors)[0]
        expected = columns @ (at_rows, per_distance)
        ratios = errors / np.maximum(expected, np.finfo(float).tiny)
        return cls(at_rows, per_distance, float(np.quantile(ratios, 0.95)))

    def mean(self, distances: NDArray) -> NDArray:
        """Return the mean errors (N,) to expect at these distances [m]."""
        return self.at_rows + self.per_distance * distances
