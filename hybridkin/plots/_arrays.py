"""Checks of the arrays of a display."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core import arrays

T = TypeVar("T")


def plain(value: Any, name: str = "array") -> NDArray:
    """Return numbers, also torch tensors, as a new float array; infinite ones become NaN."""
    array = np.array(arrays.real_array(value, name), dtype=float)
    array[np.isinf(array)] = np.nan
    return array


def shaped(
    value: object, name: str, need: Sequence[int | str], length: int | None = None
) -> NDArray[np.float64]:
    """Return numbers of a checked shape as a new float array; infinite ones become NaN."""
    return arrays.shaped(plain(value, name), name, need, length)


def shaped_or_empty(
    value: object, name: str, need: Sequence[int | str], length: int | None = None
) -> NDArray[np.float64]:
    """Return `shaped` numbers; for None an array without rows."""
    if value is None:
        others = [int(axis) if str(axis).isdigit() else 0 for axis in need[1:]]
        return np.empty((0, *others))
    return shaped(value, name, need, length)


def times(value: ArrayLike | None, n_rows: int) -> NDArray | None:
    """Return increasing times (T,) [s], or None."""
    if value is None:
        return None
    t = shaped(value, "t", "T", n_rows)
    if np.isnan(t).any() or not (np.diff(t) > 0.0).all():
        raise ValueError("`t` must increase [s]; sort the rows and drop repeated or unknown times.")
    return t


def named(value: Mapping[str, T], name: str) -> dict[str, T]:
    """Return a mapping as a dict, checked; a single object in its place raises."""
    if not isinstance(value, Mapping) or not value:
        raise ValueError(
            f"`{name}` must be a mapping from names to arrays, at least one, got {value!r:.80}; "
            f"write {{'model': ...}} for a single one."
        )
    return {str(key): item for key, item in value.items()}


def positions(x: ArrayLike) -> NDArray:
    """Return tips (N, m) [m]; of poses (N, 6) the position."""
    x = plain(x, "x")
    return x[:, :3] if x.ndim == 2 and x.shape[1] == 6 else x


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances of rows, NaN where one of them is unknown."""
    return np.hypot.reduce(a - b, axis=-1)  # hypot does not overflow
