"""Statistics of tip errors, and the error to expect of a robot at new commands."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import scipy  # its folders are imported when they are used
from numpy.typing import NDArray
from typing_extensions import Self

_LEAST = 1e-3  # of the mean error: least mean error for which a row is weighted
_MOST_FITS = 100
_SETTLED = 1e-6  # relative change of a line that is fitted


def marker_distances(predicted: NDArray, measured: NDArray) -> NDArray:
    """Return the distances (N, K) of predicted and measured markers (N, 3 K) [m]."""
    difference = (predicted - measured).reshape(len(measured), -1, 3)
    return np.linalg.norm(difference, axis=2)


@dataclass(frozen=True, kw_only=True)
class Errors:
    """Statistics of tip errors [m], NaN if not known.

    Attributes
    ----------
    rows : int
        Number of rows.
    mean, std, median, p95, max : float
        Mean, standard deviation, median, 95 % quantile and maximum.
    """

    rows: float = math.nan
    mean: float
    std: float = math.nan
    median: float = math.nan
    p95: float
    max: float = math.nan

    @classmethod
    def of(cls, errors: NDArray, **more: object) -> Self:
        """Return the statistics of errors (N,); `more` are the fields of a subclass."""
        return cls(
            rows=len(errors),
            mean=errors.mean(),
            std=errors.std(),
            median=np.median(errors),
            p95=np.percentile(errors, 95),
            max=errors.max(),
            **more,
        )


@dataclass(frozen=True, kw_only=True)
class HeldOutErrors(Errors):
    """Statistics of tip errors on held-out motions [m].

    Attributes
    ----------
    std_error : float
        Standard error of the mean over motions, because rows of a motion have similar errors.
    by_fold : ndarray of shape (n_folds,)
        Mean of every fold.
    std_folds : float
        Its standard deviation.
    """

    std_error: float = math.nan
    by_fold: NDArray | None = None
    std_folds: float = math.nan

    @classmethod
    def of_motions(cls, errors: NDArray, motions: NDArray, fold: NDArray) -> Self:
        """Return the statistics of errors (N,) from the motion and the fold of every row (N,).

        References
        ----------
        Cochran, Sampling Techniques (1977), chapter 9A: clusters of unequal sizes.
        """
        _, motion = np.unique(motions, return_inverse=True)
        sums = np.bincount(motion, errors - errors.mean())
        deviation = np.sqrt(len(sums) * (sums @ sums) / (len(sums) - 1))
        by_fold = np.bincount(fold, errors) / np.bincount(fold)
        return cls.of(
            errors,
            std_error=deviation / len(errors),
            by_fold=by_fold,
            std_folds=by_fold.std(),
        )

    @classmethod
    def read(cls, entry: Mapping[str, Any]) -> Self:
        """Return the errors of an entry of a file; unknown ones are ignored."""
        names = [field.name for field in fields(cls)]
        return cls(**{name: entry[name] for name in names if name in entry})


@dataclass(frozen=True)
class ExpectedErrors:
    """Mean errors (N,) to expect of a robot, and what 95 % do not exceed [m]; NaN: unknown."""

    mean: NDArray
    p95: NDArray

    @classmethod
    def unknown(cls, n: int) -> Self:
        """Return those of n commands for a model that promises nothing."""
        return cls(np.full(n, np.nan), np.full(n, np.nan))

    @property
    def known(self) -> bool:
        """Whether the model promises an error of any command."""
        return bool(np.isfinite(self.mean).any())


@dataclass(frozen=True)
class Promise:
    """Mean error to expect, which grows linearly with the distance from the log, and a quantile.

    Attributes
    ----------
    at_rows : float
        Mean error at rows of the log [m].
    per_distance : float
        Its growth with the distance, see `GroupDistance.distances` [m].
    p95 : float
        95 % quantile of the errors, relative to the mean.
    """

    at_rows: float
    per_distance: float
    p95: float

    @classmethod
    def of(cls, errors: NDArray, distances: NDArray) -> Promise:
        """Return the promise from errors (N,) of held-out rows and their distances (N,)."""
        if not errors.any():
            return cls(0.0, 0.0, 1.0)
        at_rows, per_distance = _line(errors, distances)
        if at_rows == 0.0:  # a robot without error at the rows of its log is not credible
            at_rows = float(errors.mean())
            per_distance = 0.0
        ratios = errors / (at_rows + per_distance * distances)
        return cls(at_rows, per_distance, float(np.quantile(ratios, 0.95)))

    def at(self, distances: NDArray) -> ExpectedErrors:
        """Return the errors (N,) to expect at these distances [m]."""
        mean = self.at_rows + self.per_distance * distances
        return ExpectedErrors(mean, self.p95 * mean)


def _line(errors: NDArray, distances: NDArray) -> tuple[float, float]:
    """Return intercept and slope, not negative, of mean errors by their distance [m].

    The spread of errors is proportional to their mean, whose inverse square weights the rows:
    iteratively reweighted least squares, after which the mean ratio of error and line is 1. Without
    weights the large errors far from the log decide, and near it the line can be a small part of
    the errors there.
    """
    columns = np.column_stack([np.ones_like(errors), distances])
    mean = np.full_like(errors, errors.mean())
    least = _LEAST * errors.mean()
    coefficients = np.zeros(2)
    for _ in range(_MOST_FITS):
        before = coefficients
        coefficients = scipy.optimize.nnls(columns / mean[:, None], errors / mean)[0]
        mean = np.maximum(columns @ coefficients, least)
        if np.allclose(coefficients, before, rtol=_SETTLED, atol=0.0):
            break
    return float(coefficients[0]), float(coefficients[1])
