"""Checks of measured rows before a fit: missing values, scaled values; folds of motions."""

from __future__ import annotations

from collections.abc import Sized

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import GroupKFold, KFold

from hybridkin._core.arrays import countable
from hybridkin._core.turns import TURNS

# fractions of rows by distance: end of the inner, start of the outer
_INNER = 0.4
_BEYOND = 0.65
_EXCITED = 0.01  # of the largest spread


def check_finite(**arrays: ArrayLike) -> None:
    """Raise if rows of numbers hold NaN or infinity."""
    for name, values in arrays.items():
        rows = np.asarray(values)
        if rows.ndim not in (1, 2) or rows.dtype.kind != "f" or countable(rows).all():
            continue
        bad = ~countable(rows.reshape(len(rows), -1)).all(axis=1)
        raise ValueError(
            f"`{name}` must be finite, got NaN or infinity in {bad.sum()} of {len(rows)} rows "
            f"(first: row {bad.argmax()}); leave these rows out (np.isfinite finds them), or "
            "read the log with datasets.load_log(..., drop_invalid=True)."
        )


def points(x: NDArray) -> NDArray:
    """Return rows x (N, 3 K) of K points as (N, K, 3), rows of another length m as (N, 1, m)."""
    return x.reshape(len(x), -1, 3 if x.shape[1] % 3 == 0 else x.shape[1])


def distances(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances (N, K) of the points of two sets of rows (N, m) or (N,)."""
    return np.linalg.norm(points((a - b).reshape(len(a), -1)), axis=2)


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distance (N,) of two sets of rows; for several points the mean of the measured."""
    return np.nanmean(distances(a, b), axis=1)


def with_missing_markers(x: NDArray, name: str) -> NDArray:
    """Return rows x (N, 3 K) in which all coordinates of an incomplete marker are NaN.

    Raise if a row has no complete marker, or if numbers are infinite.
    """
    missing = np.any(np.isnan(points(x)), axis=2)
    allowed = missing & ~np.all(missing, axis=1, keepdims=True)
    check_finite(
        **{name: np.where(allowed[..., None], 0.0, points(x)).reshape(x.shape)}
    )
    return np.where(missing[..., None], np.nan, points(x)).reshape(x.shape)


def check_unscaled(name: str, values: NDArray, meant: str) -> None:
    """Raise if all columns (N, k) seem to be scaled to numbers without a unit."""
    if len(values) < 3:
        return
    rows = values.astype(np.float64, copy=False)
    low, high, mean, std = (f(rows, axis=0) for f in (np.min, np.max, np.mean, np.std))
    standard = np.abs([mean, std - 1.0]).max() < 1e-3
    if standard or (
        np.isin(low, (0.0, -1.0)).all() and np.abs(high - 1.0).max() < 1e-6
    ):
        scaler = "StandardScaler" if standard else "MinMaxScaler"
        raise ValueError(
            f"`{name}` must hold {meant} for this mechanical model, but looks like the output of "
            f"{scaler}; take it out of the pipeline. Error models scale their inputs themselves; "
            "one that does not can include it: error_model=make_pipeline(StandardScaler(), ...)."
        )


def folds(
    X: Sized, groups: NDArray | None, most: int = 5, shuffle: bool = False
) -> list[tuple[NDArray, NDArray]]:
    """Return training and held-out rows of at most `most` folds of whole groups, or of rows.

    Rows are always shuffled, groups only if `shuffle`.
    """
    n_folds = min(most, len(X) if groups is None else len(np.unique(groups)))
    if n_folds < 2:
        raise ValueError(
            "`groups` must hold at least two motions, so that one can be held out, got one; record "
            "more motions, or leave `groups` out."
        )
    if groups is None:
        return [*KFold(n_folds, shuffle=True, random_state=0).split(X)]
    splitter = GroupKFold(n_folds, shuffle=shuffle, random_state=0 if shuffle else None)
    with TURNS.filters:
        return [*splitter.split(X, groups=groups)]


def evenly_spaced(n: int, most: int) -> NDArray[np.intp]:
    """Return the places of at most `most` of n rows, evenly spaced."""
    return np.linspace(0, n - 1, min(most, n)).astype(np.intp)


def inner_and_outer(X: NDArray) -> tuple[NDArray, NDArray]:
    """Return the inner 40 % and the outer 35 % of rows by Mahalanobis distance from the mean.

    The rows between are left out, so that predictions of the outer rows are extrapolation.
    Directions that are not excited are ignored.
    """
    axes, spread, _ = np.linalg.svd(X - X.mean(axis=0), full_matrices=False)
    excited = spread > _EXCITED * spread.max(initial=0.0)
    order = np.argsort(np.linalg.norm(axes[:, excited], axis=1), kind="stable")
    return np.sort(order[: max(1, int(_INNER * len(X)))]), np.sort(
        order[int(_BEYOND * len(X)) :]
    )
