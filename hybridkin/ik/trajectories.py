"""Paths of the tip in metres and seconds: figure eight, spiral, line, recorded points."""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import as_path, one_of, real_array, shaped
from hybridkin._core.text_rows import TextFile, TextForm, is_number
from hybridkin._core.units import METRES

__all__ = ["Trajectory", "figure_eight", "from_csv", "line", "min_jerk", "spiral"]

_MOST = 1e8  # points of a path; 3 GB
_FAR = 20.0  # largest plausible distance of a tip from the measuring frame [m]
_ABOVE_ZERO = np.finfo(float).tiny
_POINT = "3 finite numbers [m]"


@dataclass(frozen=True, repr=False, eq=False)
class Trajectory:
    """A path of the tip with its times.

    Attributes
    ----------
    t : ndarray of shape (T,)
        Times [s], increasing.
    x : ndarray of shape (T, 3)
        Positions [m].
    """

    t: np.ndarray
    x: np.ndarray

    def __post_init__(self) -> None:
        """Check shapes and times."""
        x = shaped(self.x, "x", "T3")
        t = shaped(self.t, "t", "T", len(x))
        if not len(x):
            raise ValueError("`x` must hold at least one point, got none.")
        bad = np.flatnonzero(~(np.isfinite(t) & np.isfinite(x).all(axis=1)))
        if bad.size:
            rows = f"{bad.size} rows (first: row {bad[0]})"
            raise ValueError(f"`t` and `x` must be finite; drop the {rows} that are not.")
        late = np.flatnonzero(np.diff(t) <= 0)
        if late.size:
            row = late[0] + 1
            pair = f"{t[late[0]]:.6g} s before {t[late[0] + 1]:.6g} s"
            raise ValueError(f"`t` must increase, got {pair} in row {row}; sort, drop repeats.")
        largest = float(np.abs(x).max())
        if largest > _FAR:
            warnings.warn(
                f"`x` reaches {largest:.4g} m, which looks like millimetres or centimetres; "
                "hybridkin works in metres: divide by 1000 or 100, or read a file with unit='mm' "
                "or 'cm'.",
                stacklevel=4,
            )
        vars(self).update(t=t, x=x)

    @property
    def duration(self) -> float:
        """Time from the first to the last point [s]."""
        return float(self.t[-1] - self.t[0])

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.t)

    def __repr__(self) -> str:
        """Return a one-line summary."""
        span = " x ".join(f"{side:.3g}" for side in np.ptp(self.x, axis=0))
        return f"Trajectory({len(self)} points, {self.duration:.4g} s, {span} m)"


def min_jerk(s: ArrayLike) -> np.ndarray:
    """Return the minimum-jerk timing law 10 s^3 - 15 s^4 + 6 s^5.

    It goes from 0 to 1 with zero speed and acceleration at both ends.

    Parameters
    ----------
    s : array-like of shape (...)
        Fraction of the time, clipped to [0, 1].

    Returns
    -------
    ndarray of shape (...)
        Fraction of the path.

    References
    ----------
    Flash & Hogan, J. Neurosci. 5 (1985).
    """
    s = np.clip(real_array(s, "s").astype(float), 0.0, 1.0)
    return s * s * s * (10.0 + s * (6.0 * s - 15.0))


def figure_eight(
    center: ArrayLike,
    size: Sequence[float] = (0.3, 0.15),
    *,
    duration: float = 10.0,
    dt: float = 0.01,
    normal: ArrayLike = (0.0, 0.0, 1.0),
    timing: str = "min_jerk",
) -> Trajectory:
    """Return a figure eight (Gerono's lemniscate) that starts and ends at its crossing point.

    Parameters
    ----------
    center : array-like of shape (3,)
        The crossing point [m].
    size : (float, float), default=(0.3, 0.15)
        Full width and height [m].
    duration : float, default=10.0
        Time for one lap [s], rounded to a multiple of `dt`.
    dt : float, default=0.01
        Time between points [s].
    normal : array-like of shape (3,), default=(0, 0, 1)
        Normal of the plane. The width lies along the x-axis projected into the plane (the y-axis
        if the normal is the x-axis).
    timing : {"min_jerk", "uniform"}, default="min_jerk"
        "min_jerk" starts and ends at rest; "uniform" increases the curve's parameter uniformly,
        e.g. for repeated laps.

    Returns
    -------
    Trajectory
        ``duration / dt + 1`` points.

    References
    ----------
    Reinhart & Steil (2016), Fig. 3, left column.

    Examples
    --------
    >>> from hybridkin.ik.trajectories import figure_eight
    >>> figure_eight([0.0, 0.0, 0.7], (0.4, 0.2), duration=8.0)
    Trajectory(801 points, 8 s, 0.4 x 0.2 x 0 m)
    """
    center = _checked(center, "center", _POINT, (3,))
    width, height = _checked(size, "size", "two numbers, positive [m]", (2,), _ABOVE_ZERO)
    t, s = _timing(duration, dt, timing)
    across, up, _ = _plane(normal)
    phase = 2.0 * math.pi * s[:, None]
    x = 0.5 * width * np.sin(phase) * across + 0.5 * height * np.sin(2.0 * phase) * up
    x[-1] = x[0]  # exactly: sin(2 pi) is not zero
    return Trajectory(t, center + x)


def spiral(
    center: ArrayLike,
    radius: float | Sequence[float] = (0.0, 0.15),
    *,
    rise: float = 0.0,
    turns: float = 3.0,
    duration: float = 15.0,
    dt: float = 0.01,
    normal: ArrayLike = (0.0, 0.0, 1.0),
    timing: str = "min_jerk",
) -> Trajectory:
    """Return a spiral or helix.

    Parameters
    ----------
    center : array-like of shape (3,)
        Centre of the first turn [m].
    radius : float or (float, float), default=(0.0, 0.15)
        Radius, or radius at the start and at the end [m].
    rise : float, default=0.0
        Displacement along the normal from start to end [m].
    turns : float, default=3.0
        Number of turns; negative numbers are clockwise about the normal.
    duration : float, default=15.0
        Time for the path [s], rounded to a multiple of `dt`.
    dt : float, default=0.01
        Time between points [s].
    normal : array-like of shape (3,), default=(0, 0, 1)
        Axis of the spiral. It starts along the x-axis projected into the plane (the y-axis if
        the normal is the x-axis).
    timing : {"min_jerk", "uniform"}, default="min_jerk"
        "min_jerk" starts and ends at rest; "uniform" increases the angle uniformly.

    Returns
    -------
    Trajectory
        ``duration / dt + 1`` points.

    References
    ----------
    Reinhart & Steil (2016), Fig. 3, right column.

    Examples
    --------
    >>> from hybridkin.ik.trajectories import spiral
    >>> spiral([0.0, 0.0, 0.7], (0.05, 0.2), rise=0.1, turns=2.0, duration=5.0)
    Trajectory(501 points, 5 s, 0.363 x 0.326 x 0.1 m)
    """
    center = _checked(center, "center", _POINT, (3,))
    both = (radius, radius) if np.ndim(radius) == 0 else radius
    first, last = _checked(both, "radius", "two numbers, not negative [m]", (2,), 0.0)
    _checked((rise, turns), "(rise, turns)", "finite, the rise in metres", (2,))
    t, s = _timing(duration, dt, timing)
    across, up, along = _plane(normal)
    s = s[:, None]
    angle = 2.0 * math.pi * turns * s
    r = first + (last - first) * s
    x = r * np.cos(angle) * across + r * np.sin(angle) * up + rise * s * along
    return Trajectory(t, center + x)


def line(
    start: ArrayLike,
    end: ArrayLike,
    *,
    duration: float = 5.0,
    dt: float = 0.01,
    timing: str = "min_jerk",
) -> Trajectory:
    """Return a straight line.

    Parameters
    ----------
    start, end : array-like of shape (3,)
        End points [m].
    duration : float, default=5.0
        Time for the path [s], rounded to a multiple of `dt`.
    dt : float, default=0.01
        Time between points [s].
    timing : {"min_jerk", "uniform"}, default="min_jerk"
        "min_jerk" starts and ends at rest; "uniform" has constant speed.

    Returns
    -------
    Trajectory
        ``duration / dt + 1`` points.

    Examples
    --------
    >>> from hybridkin.ik.trajectories import line
    >>> line([0.1, 0.0, 0.7], [-0.1, 0.0, 0.7], duration=2.0).x[100].tolist()
    [0.0, 0.0, 0.7]
    """
    start, end = (_checked(*a, _POINT, (3,)) for a in ((start, "start"), (end, "end")))
    t, s = _timing(duration, dt, timing)
    # The weighted mean is exact at both ends.
    return Trajectory(t, (1.0 - s)[:, None] * start + s[:, None] * end)


def from_csv(path: str | PathLike[str], *, dt: float | None = None, unit: str = "m") -> Trajectory:
    """Return a recorded path from a CSV file.

    Parameters
    ----------
    path : path-like
        A text file with columns t, x, y, z, or x, y, z if `dt` is given, separated by commas,
        semicolons or tabs; with the latter two decimals may have a comma. One line of names and
        lines that start with # are allowed.
    dt : float, optional
        Time between points [s]; a file with times is interpolated linearly to this period.
    unit : {"m", "cm", "mm"}, default="m"
        Unit of the positions in the file. Times are seconds.

    Returns
    -------
    Trajectory
        In metres and seconds.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file has no times and `dt` is not given, or is not a table of numbers.
    """
    one_of(unit, "unit", METRES)
    if dt is not None:
        dt = _period(dt, "dt")
    path = as_path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a CSV file of points, there is none at {path}.")
    rows = _rows_of(path)
    columns = 4
    need = "t, x, y, z"
    if max(map(len, rows), default=0) == 3:
        columns = 3
        need = "x, y, z"
        if dt is None:
            raise ValueError(f"{path} has no times; give the time between its points (--dt 0.02).")
    named = bool(rows) and not is_number(rows[0][0])
    numbers = []
    try:
        for row in rows[named:]:
            numbers.append([float(cell) for cell in row])
        table = np.array(numbers)
    except ValueError as error:
        need = f"numbers in {columns} columns ({need}) after one line of names"
        raise ValueError(f"{path} must hold {need}: {error!s:.200}.") from error
    if table.ndim != 2 or table.shape[1] != columns:
        raise ValueError(f"{path} must have rows of {columns} columns ({need}), got {table.shape}.")
    x = METRES[unit] * table[:, -3:]
    if dt is not None and columns == 3:
        return Trajectory(dt * np.arange(len(table)), x)
    timed = Trajectory(table[:, 0], x)
    if dt is None:
        return timed
    n_steps = int(periods(timed.duration, dt) + 1e-9)
    return interpolated(timed, timed.t[0] + dt * np.arange(n_steps + 1))


def _rows_of(path: Path) -> list[list[str]]:
    """Return the cells of the rows of a file of points, without comments.

    Decimals have a comma if another character separates the columns, and no cell has a point.
    """
    file = TextFile.of(path)
    lines = [line for line in file.head() if line.strip() and line.strip()[0] != "#"]
    delimiter = TextForm(decimal=",").separator(lines[-1:])
    rows = []
    for row in file.rows(delimiter):
        cells = [cell.strip() for cell in row.cells]
        while not cells[-1]:
            cells.pop()  # a separator at the end of the line
        if cells[0][:1] != "#":
            rows.append(cells)
    has_points = any("." in cell for cells in rows[1:] for cell in cells)
    if delimiter == "," or has_points:
        return rows
    return [[cell.replace(",", ".") for cell in cells] for cells in rows]


def interpolated(path: Trajectory, t: NDArray) -> Trajectory:
    """Return the points of a path at other times (N,) [s], linear between its points."""
    columns = [np.interp(t, path.t, column) for column in path.x.T]
    return Trajectory(t, np.stack(columns, axis=1))


def periods(duration: float, dt: float) -> float:
    """Return the number of periods `dt` in a duration [s]; raise if there are too many."""
    n = duration / _period(dt, "dt")
    if n > _MOST:
        raise ValueError(f"`duration` must be at most {_MOST:g} times `dt`, got {n:g} times.")
    return n


def _timing(duration: float, dt: float, timing: str) -> tuple[np.ndarray, np.ndarray]:
    """Return times [s] and the fraction of the path at each."""
    n = max(1, round(periods(_period(duration, "duration"), dt)))
    one_of(timing, "timing", ("min_jerk", "uniform"))
    s = np.arange(n + 1) / n
    if timing == "min_jerk":
        s = min_jerk(s)
    return float(dt) * np.arange(n + 1), s


def _plane(normal: ArrayLike) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a right-handed frame (across, up, normal)."""
    direction = _checked(normal, "normal", _POINT, (3,))
    if not direction.any():
        raise ValueError("`normal` must not be zero; it is the normal of the plane.")
    # Squares neither overflow nor underflow.
    along = direction / np.abs(direction).max()
    along = along / np.linalg.norm(along)
    axis = np.array([1.0, 0.0, 0.0])
    if abs(along[0]) > 1.0 - 1e-9:
        axis = np.array([0.0, 1.0, 0.0])
    across = axis - (axis @ along) * along
    across /= np.linalg.norm(across)
    return across, np.cross(along, across), along


def _checked(
    value: ArrayLike,
    name: str,
    need: str,
    shape: tuple[int, ...],
    least: float = -math.inf,
) -> np.ndarray:
    """Return finite numbers of this shape, each at least `least`."""
    numbers = np.array(real_array(value, name), dtype=float)
    finite = numbers.shape == shape and np.isfinite(numbers).all()
    if not finite or (numbers < least).any():
        raise ValueError(f"`{name}` must be {need}, got {value!r}.")
    return numbers


def _period(value: float, name: str) -> float:
    return float(_checked(value, name, "positive [s]", (), _ABOVE_ZERO))
