"""Checks of measured rows before a fit: missing values, scaled values."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import countable
from hybridkin._core.directions import moved_directions
from hybridkin._core.finite_rows import LEAVE_OUT, check_entries
from hybridkin._core.groups import Groups

# fractions of rows by distance: end of the inner, start of the outer
_INNER = 0.4
_BEYOND = 0.65


WEIGH_ZERO = (
    "give these rows the weight 0 in `sample_weight` (np.isfinite finds them): their commands "
    "still move the actuators, which they would not if the rows were left out"
)


def check_finite(advice: str = LEAVE_OUT, /, **arrays: ArrayLike) -> None:
    """Raise if rows of numbers hold NaN or infinity."""
    for name, values in arrays.items():
        rows = np.asarray(values)
        if rows.ndim not in (1, 2) or rows.dtype.kind != "f":
            continue
        check_entries(countable(rows.reshape(len(rows), -1)), name, advice)


def points(x: NDArray) -> NDArray:
    """Return rows x (N, 3 K) of K points as (N, K, 3), rows of another length m as (N, 1, m)."""
    n_columns = x.shape[1]
    size = n_columns if n_columns % 3 else 3
    return x.reshape(len(x), -1, size)


def distances(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances (N, K) of the points of two sets of rows (N, m) or (N,)."""
    difference = (a - b).reshape(len(a), -1)
    return np.linalg.norm(points(difference), axis=2)


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distance (N,) of two sets of rows; for several points the mean of the measured."""
    return np.nanmean(distances(a, b), axis=1)


def with_missing_markers(x: NDArray, name: str, advice: str = LEAVE_OUT) -> NDArray:
    """Return rows x (N, 3 K) in which all coordinates of an incomplete marker are NaN.

    Raise if a row has no complete marker, or if numbers are infinite.
    """
    markers = points(x)
    missing = np.any(np.isnan(markers), axis=2, keepdims=True)
    # A marker may be missing where another one of the row is complete.
    allowed = missing & ~missing.all(axis=1, keepdims=True)
    required = np.where(allowed, 0.0, markers)
    check_finite(advice, **{name: required.reshape(x.shape)})
    return np.where(missing, np.nan, markers).reshape(x.shape)


def check_unscaled(name: str, values: NDArray, meant: str) -> None:
    """Raise if all columns (N, k) seem to be scaled to numbers without a unit."""
    if len(values) < 3:
        return
    rows = values.astype(np.float64, copy=False)
    mean = rows.mean(axis=0)
    std = rows.std(axis=0)
    is_standard = np.abs([mean, std - 1.0]).max() < 1e-3
    from_low = np.isin(rows.min(axis=0), (0.0, -1.0)).all()
    to_one = np.abs(rows.max(axis=0) - 1.0).max() < 1e-6
    if is_standard or (from_low and to_one):
        scaler = "StandardScaler" if is_standard else "MinMaxScaler"
        raise ValueError(
            f"`{name}` must hold {meant} for this mechanical model, but looks like the output of "
            f"{scaler}; take it out of the pipeline. Error models scale their inputs themselves; "
            "one that does not can include it: error_model=make_pipeline(StandardScaler(), ...)."
        )


def evenly_spaced(n: int, most: int) -> NDArray[np.intp]:
    """Return the places of at most `most` of n rows, evenly spaced."""
    return np.linspace(0, n - 1, min(most, n)).astype(np.intp)


def evenly_spaced_of(groups: Groups, most: int) -> NDArray[np.intp]:
    """Return `evenly_spaced` rows, or all rows where these would lack a whole group.

    Their groups are then those of all rows, so that the same ones are held out.
    """
    rows = evenly_spaced(len(groups), most)
    if groups.whole and groups.take(rows).number < groups.number:
        return np.arange(len(groups))
    return rows


def inner_and_outer(X: NDArray) -> tuple[NDArray, NDArray]:
    """Return the inner 40 % and the outer 35 % of rows by Mahalanobis distance from the mean.

    The rows between are left out, so that predictions of the outer rows are extrapolation.
    Directions that do not move are ignored, whatever the units of the columns.
    """
    directions = moved_directions(X)
    scaled = (X - directions.mean) / directions.scale
    axes, _, _ = np.linalg.svd(scaled @ directions.moved, full_matrices=False)
    distance_from_mean = np.linalg.norm(axes, axis=1)
    order = np.argsort(distance_from_mean, kind="stable")
    n_inner = max(1, int(_INNER * len(X)))
    first_outer = int(_BEYOND * len(X))
    return np.sort(order[:n_inner]), np.sort(order[first_outer:])
