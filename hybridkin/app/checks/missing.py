"""Checks of a log for numbers that stand for missing values: 9999.999, -9999, or 0, 0, 0."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hybridkin.formats import METRES, UNITS

if TYPE_CHECKING:
    from hybridkin.app.checks.columns import LogRows
    from hybridkin.app.checks.report import LogFinding

_FAR = 5.0  # ranges of the other values: a number so far away is no measurement
_MOST = 0.9  # part of the rows that may be missing
_MOVED = 0.1  # part of an actuator's range
_REPEATS = 2  # rows with the same number


def missing_values(rows: LogRows) -> Iterator[LogFinding]:
    """Yield numbers that are far outside the others and repeated exactly, and markers at 0, 0, 0.

    The log may have several markers, and NaN.
    """
    for number, places in _sentinels(rows).items():
        yield rows.finding(
            "missing",
            f"{number} stands in {len(places)} rows, far outside all other values "
            f"({rows.named(places)}): it looks like a missing value.",
            f"name it: missing = [{number}] in [log] (--missing {number}, missing=), and leave "
            "these rows out with --drop-invalid (drop_invalid=True).",
            places,
            "error",
        )
    for marker, places in _lost_markers(rows):
        yield rows.finding(
            "missing",
            f"{marker} is at 0, 0, 0 in {len(places)} rows while the robot moves "
            f"({rows.named(places)}): the marker was lost.",
            "name it: missing = [0] in [log] (--missing 0, missing=), and leave these rows out "
            "with --drop-invalid (drop_invalid=True); zeros elsewhere stay.",
            places,
            "error",
        )


def _sentinels(rows: LogRows) -> dict[str, NDArray]:
    """Return the rows of every number, in the unit of the file, that is no measurement."""
    found: dict[str, list[NDArray]] = {}
    for which, units in (("q", UNITS), ("x", METRES)):
        factor = units.get(rows.log.file_units[which], 1.0)
        columns = rows.columns(which)
        signs = np.ones(len(columns))
        if which == "q":
            signs = np.broadcast_to(rows.log.q_sign, len(columns))
        for (_, column), sign in zip(columns, signs, strict=True):
            for value in _far_and_repeated(column):
                number = f"{sign * value / factor:.10g}"
                found.setdefault(number, []).append(np.flatnonzero(column == value))
    return {number: np.unique(np.concatenate(p)) for number, p in found.items()}


def _far_and_repeated(column: NDArray) -> list[float]:
    """Return the numbers of a column (N,) that are repeated, and far from all others."""
    values, counts = np.unique(column[np.isfinite(column)], return_counts=True)
    far = []
    while len(values) > 2:
        ends = [end for end in (0, -1) if _is_far(values, counts, end)]
        if not ends:
            break
        far.append(float(values[ends[0]]))
        values = np.delete(values, ends[0])
        counts = np.delete(counts, ends[0])
    return far


def _is_far(values: NDArray, counts: NDArray, end: int) -> bool:
    """Return whether the first or last of sorted values is no measurement."""
    if values[end] == 0.0:  # see _lost_markers
        return False
    others = np.delete(values, end)
    gap = abs(values[end] - others[end])
    many = counts[end] > _MOST * counts.sum()
    return counts[end] >= _REPEATS and not many and gap > _FAR * np.ptp(others)


def _lost_markers(rows: LogRows) -> Iterator[tuple[str, NDArray]]:
    """Yield the markers that are at 0, 0, 0 in rows in which the actuators differ, and the rows."""
    names = [name for name, _ in rows.columns("x")]
    markers = rows.log.x.reshape(len(rows.log.x), -1, 3)
    for k in range(markers.shape[1]):
        lost = (markers[:, k] == 0.0).all(axis=1)
        if not lost.any() or lost.mean() > _MOST:
            continue
        places = np.flatnonzero(lost)
        if _moves(rows.log.q, places) or _is_apart(markers[~lost, k]):
            three = ", ".join(map(repr, names[3 * k : 3 * k + 3]))
            yield f"the marker in columns {three}", places


def _moves(q: NDArray, places: NDArray) -> bool:
    """Return whether actuators (N, n) differ considerably in some rows."""
    ranges = np.nanmax(q, axis=0) - np.nanmin(q, axis=0)
    ranges[ranges == 0.0] = np.inf
    moved = np.nanmax(q[places], axis=0) - np.nanmin(q[places], axis=0)
    return bool((moved / ranges).max() > _MOVED)


def _is_apart(tips: NDArray) -> bool:
    """Return whether the origin lies outside the box around other tips (N, 3), by its size."""
    low = np.nanmin(tips, axis=0)
    high = np.nanmax(tips, axis=0)
    outside = np.maximum(low, -high)
    return bool(outside.max() > np.max(high - low))
