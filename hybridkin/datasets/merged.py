"""One log from two recordings: commands by the motors, tips by the camera, merged by time."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import minimize_scalar

from hybridkin._core.arrays import (
    as_path,
    check_shape,
    countable,
    labels,
    number,
    one_of,
    real_array,
)
from hybridkin._core.named_rows import named_places
from hybridkin._core.text_rows import TextForm
from hybridkin._core.units import METRES, UNITS
from hybridkin.datasets._tables import Table, without_missing
from hybridkin.datasets.encoders import _features as rough_features
from hybridkin.datasets.logs import Log
from hybridkin.datasets.table_files import read_table

_AS_WRITTEN = "as written"
_GAP = 5.0  # usual periods of the motor rows: longer ones are gaps
_CELLS = 2**14  # of the coarse search, at most
_OVERLAP = 0.5  # of the shorter recording, at least
_CANDIDATES = 16  # lags of the coarse search that are compared
_SURE = 0.6  # least score of a candidate, relative to the best
_VALLEY = 0.5  # largest score between two candidates, relative to the lesser one
_ALIKE = 0.05  # of the variance of the commands: those of two lags that differ by less are alike
_NAMED = 6  # candidates in a message, at most
_ROWS = 2000  # camera rows that are compared, at most
_FEATURES = 250  # of the rough model, at most
_ROWS_PER_FEATURE = 5  # at least, of polynomials
_WINDOWS = 30  # of the fine search, at most
_DEGREES = (1, 2, 3)  # of the polynomials that explain tips
_EXACT = 1e-3  # what a right lag can leave unexplained; a wrong one only where a motion repeats
_RIDGE = 1e-9  # relative to the mean square of a feature
_PARTS = 3  # of a log, each explained by the others; short ones agree with anything smooth
_EXPLAINED = 0.8  # least share of the motion that the commands explain at the lag
_RIVAL = 2.0  # least ratio of what the second best lag leaves to what the best leaves


@dataclass(frozen=True, eq=False)
class TimedColumns:
    """Columns of one recording with the time of every row.

    Attributes
    ----------
    values : ndarray of shape (N, k)
        Values [m], [rad] or in the unit of the file; NaN where they are missing.
    time : ndarray of shape (N,)
        Times [s], increasing, by the clock of the recording.
    names : tuple of str
        Names of the columns.
    unit : str
        Unit of the values in the file.
    groups : ndarray of shape (N,) or None
        Motion of each row.
    source : str
        Source of the recording, for example its path.
    """

    values: NDArray
    time: NDArray
    names: Sequence[str] = ()
    unit: str = "m"
    groups: NDArray | None = None
    source: str = "in memory"

    def __post_init__(self) -> None:
        values = real_array(self.values, "values").astype(float)
        time = real_array(self.time, "time").astype(float)
        check_shape(values, "values", ("N", "k"), "one row for each time")
        check_shape(time, "time", [len(values)], "one for each row")
        object.__setattr__(self, "values", values)
        object.__setattr__(self, "time", time)
        if self.groups is not None:
            object.__setattr__(self, "groups", labels(self.groups, len(values)))
        late = np.flatnonzero(~(np.diff(time) > 0.0)) + 1
        if len(late) or not np.isfinite(time).all():
            raise ValueError(
                f"`time` of {self.source} must increase from row to row, but does not at "
                f"{named_places(late, 'row')}; sort the rows, leave out repeated ones, and merge "
                "recordings whose clock starts again one by one."
            )

    def complete(self) -> TimedColumns:
        """Return the rows without a missing value."""
        complete = countable(self.values).all(axis=1)
        groups = None if self.groups is None else self.groups[complete]
        return TimedColumns(
            self.values[complete],
            self.time[complete],
            self.names,
            self.unit,
            groups,
            self.source,
        )


def read_columns(
    path: str | os.PathLike[str],
    names: Sequence[str],
    *,
    time: str,
    unit: str = "m",
    sign: ArrayLike = 1,
    groups: str | None = None,
    delimiter: str | None = None,
    header_line: int | None = None,
    decimal: str = ".",
    missing: ArrayLike = (),
) -> TimedColumns:
    r"""Return columns of a recording that holds only commands, or only tips, with their times.

    Parameters
    ----------
    path : path-like
        A file as for `load_log`.
    names : sequence of str
        The columns.
    time : str
        Column of the time stamp [s].
    unit : {"m", "cm", "mm", "um", "in", "rad", "deg", "1", "as written"}, default="m"
        Unit of the columns; lengths become metres and angles radians. "as written": the numbers
        of the file, whatever their unit is.
    sign : 1, -1 or sequence of them, default=1
        Factor on the columns, as `q_sign` of `load_log`.
    groups : str or None, default=None
        Column that names the motion of a row.
    delimiter, header_line, decimal, missing
        As for `load_log`; zeros are missing only where a marker is at 0, 0, 0.

    Returns
    -------
    TimedColumns
        In SI units. Rows without a time are left out; other missing values are NaN.

    Raises
    ------
    ValueError
        If a column is unknown, a cell is not a number, or the times do not increase.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin.datasets import read_columns
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "camera.csv"
    ...     _ = path.write_text("t,X,Y,Z\n0.0,1,2,3\n0.1,1,2,4\n")
    ...     read_columns(path, ["X", "Y", "Z"], time="t", unit="mm").values[1]
    array([0.001, 0.002, 0.004])
    """
    one_of(unit, "unit", [*UNITS, _AS_WRITTEN])
    factor = real_array(sign, "sign")
    table = read_table(as_path(path), TextForm(delimiter, header_line, decimal))
    columns = _columns_as_written(table, names, time, groups, missing)
    if unit != _AS_WRITTEN:
        table.check_unit("unit", table.names("names", names), unit)
        columns = replace(columns, unit=unit)
        factor = factor * UNITS[unit]
    return replace(columns, values=columns.values * factor)


def _columns_as_written(
    table: Table,
    names: Sequence[str],
    time: str,
    groups: str | None = None,
    missing: ArrayLike = (),
) -> TimedColumns:
    """Return columns of a table with their times, not converted; see `read_columns`."""
    columns = table.names("names", names)
    values = table.values([*columns, time], [time])
    without_missing(values[:, :-1], missing)
    timed = countable(values[:, -1])
    motions = None
    if groups is not None:
        motions = table.labels("groups", groups, len(values))[timed]
    time_of_rows = values[timed, -1]
    values = values[timed, :-1]
    return TimedColumns(values, time_of_rows, tuple(columns), "1", motions, str(table.source))


class Merged(NamedTuple):
    """A log merged from two recordings.

    Attributes
    ----------
    log : Log
        The camera rows with the command of their time; `time` is that of the motors.
    lag : float
        How much later than the clock of the motors that of the camera is [s].
    explained : float
        Share of the variance of the tips that a rough model of the commands explains at this lag,
        in thirds of the log that it was not fitted to.
    is_estimated : bool
        Whether the lag was estimated.
    n_left_out : int
        Number of camera rows without a tip, or without motor rows around them.
    """

    log: Log
    lag: float
    explained: float
    is_estimated: bool
    n_left_out: int

    def __str__(self) -> str:
        """Return the lag and the rows in words."""
        how = "estimated from when both move" if self.is_estimated else "given"
        n_rows = len(self.log.q)
        return (
            f"The camera's clock is {self.lag:.4f} s later than that of the motors ({how}); the "
            f"commands then explain {self.explained:.1%} of the motion of the tip in one third of "
            f"the rows by a rough model of the other two thirds. {n_rows} of "
            f"{n_rows + self.n_left_out} camera rows have a tip and commands around them."
        )


def merge_logs(
    motors: TimedColumns,
    camera: TimedColumns,
    *,
    lag: float | None = None,
    tolerance: float | None = None,
    hold: bool = False,
) -> Merged:
    """Return the log of a camera's tips with the motors' commands of the same time.

    The lag between the two clocks is that at which the commands explain the tips best. It includes
    the time that the robot takes to follow a command, so backlash and inertia make it longer.

    Parameters
    ----------
    motors : TimedColumns
        Commands or encoder readings, as from `read_columns`.
    camera : TimedColumns
        Tip positions [m], three columns for each marker, as from `read_columns`.
    lag : float or None, default=None
        How much later than the clock of the motors that of the camera is [s]; 0 if both share one.
        None: it is estimated, to a few milliseconds.
    tolerance : float or None, default=None
        Longest time between two motor rows of which a command is made [s]; camera rows in longer
        gaps are left out. Default: 5 usual periods of the motor rows; with `hold`, no limit.
    hold : bool, default=False
        Whether a command holds until the next one, as in a log of set points. Default: commands are
        linear between two rows.

    Returns
    -------
    Merged
        The log, the lag, and how well the two recordings fit each other. Without groups of the
        motors, a new run starts after every gap.

    Raises
    ------
    ValueError
        If the camera has no three columns for each marker, no rows are left, or no lag is clearly
        the best one: where nothing moves, or a motion repeats.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin.datasets import TimedColumns, merge_logs
    >>> def q(t):
    ...     return np.stack([np.sin(t), np.sin(1.7 * t), np.sin(0.6 * t**1.2)], axis=1)
    >>> t = np.arange(0, 20, 0.01)
    >>> seen = np.arange(2, 15, 0.03)
    >>> motors = TimedColumns(q(t), t)
    >>> camera = TimedColumns(0.05 * q(seen) + 0.1, seen + 1234.5)
    >>> round(merge_logs(motors, camera).lag, 3)
    1234.5
    """
    for name, recording in (("motors", motors), ("camera", camera)):
        if not isinstance(recording, TimedColumns):
            raise TypeError(
                f"`{name}` must be a recording as from `read_columns`, or `TimedColumns`, got "
                f"{type(recording).__name__}."
            )
    if camera.values.shape[1] % 3:
        raise ValueError(
            "`camera` must have three columns for each marker, got "
            f"{camera.values.shape[1]}: {list(camera.names)}."
        )
    commands = motors.complete()
    tips = _measured(camera)
    if len(commands.time) < 3 or len(tips.time) < 3:
        raise ValueError(
            "`motors` and `camera` must have at least 3 complete rows each, got "
            f"{len(commands.time)} and {len(tips.time)}."
        )
    is_estimated = lag is None
    candidates = []
    if lag is None:
        candidates = _candidates(commands, tips, hold)
        if len(candidates) > 1 and candidates[1].unexplained < candidates[0].as_good:
            raise ValueError(_unclear(motors, camera, candidates))
        best = candidates[0]
        lag = _polished(commands, tips, best.lag, best.width, hold)
    else:
        lag = number(lag, "lag")
    time = tips.time - lag
    is_covered, runs = _covered(commands, time, _longest_gap(commands, tolerance, hold))
    if not is_covered.any():
        raise ValueError(
            f"No camera row lies between two motor rows: at the lag of {lag:.4f} s the camera "
            f"records from {time[0]:.6g} to {time[-1]:.6g} s, the motors from "
            f"{commands.time[0]:.6g} to {commands.time[-1]:.6g} s; give `lag`, or a larger "
            "`tolerance`."
        )
    q = commands_at(commands, time[is_covered], hold)
    x = tips.values[is_covered]
    groups = commands.groups
    if groups is not None:
        groups = groups[_row_before(commands, time[is_covered])]
    log = Log(
        q,
        x,
        groups=groups,
        time=time[is_covered],
        runs=runs[is_covered],
        q_names=motors.names,
        x_names=camera.names,
        units={"q": _si_unit(motors.unit), "x": "m"},
        file_units={"q": motors.unit, "x": camera.unit},
        source=f"{motors.source} and {camera.source}",
    )
    explained, _ = _explained(q, x)
    if is_estimated and explained < _EXPLAINED:
        raise ValueError(_unclear(motors, camera, candidates))
    n_left_out = len(camera.time) - int(is_covered.sum())
    return Merged(log, lag, explained, is_estimated, n_left_out)


def commands_at(motors: TimedColumns, time: NDArray, hold: bool = False) -> NDArray:
    """Return the commands (M, n) of other times (M,): linear between two rows, or held."""
    if hold:
        return motors.values[_row_before(motors, time)]
    columns = [np.interp(time, motors.time, column) for column in motors.values.T]
    return np.stack(columns, axis=1)


def _measured(camera: TimedColumns) -> TimedColumns:
    """Return the camera rows in which a marker is complete; other markers are NaN."""
    markers = camera.values.reshape(len(camera.time), -1, 3)
    complete = countable(markers).all(axis=2)
    values = np.where(complete.repeat(3, axis=1), camera.values, np.nan)
    is_complete = complete.any(axis=1)
    return TimedColumns(
        values[is_complete],
        camera.time[is_complete],
        camera.names,
        camera.unit,
        None,
        camera.source,
    )


def _row_before(motors: TimedColumns, time: NDArray) -> NDArray:
    """Return the motor rows (M,) at or before times; the first row for earlier times."""
    return np.maximum(np.searchsorted(motors.time, time, side="right") - 1, 0)


def _longest_gap(motors: TimedColumns, tolerance: float | None, hold: bool) -> float:
    if tolerance is None:
        return np.inf if hold else _GAP * float(np.median(np.diff(motors.time)))
    if not number(tolerance, "tolerance") > 0.0:
        raise ValueError(f"`tolerance` must be a positive time [s], got {tolerance!r}.")
    return tolerance


def _covered(motors: TimedColumns, time: NDArray, longest: float) -> tuple[NDArray, NDArray]:
    """Return which times lie between two motor rows of a motion, and their runs."""
    is_gap = np.diff(motors.time) > longest
    if motors.groups is not None:
        is_gap |= motors.groups[1:] != motors.groups[:-1]
    runs = np.concatenate([[0], np.cumsum(is_gap)])
    row = _row_before(motors, time)
    # The last row has none after it, but the camera may take a tip at the very same time.
    in_gap = np.append(is_gap, False)[row] & (time > motors.time[row])
    inside = (time >= motors.time[0]) & (time <= motors.time[-1])
    return inside & ~in_gap, runs[row]


def _si_unit(unit: str) -> str:
    if unit in METRES:
        return "m"
    return unit if unit == "1" else "rad"


class _Candidate(NamedTuple):
    """A lag [s] with the share of the motion that it leaves, and the width of its search [s]."""

    unexplained: float
    lag: float
    width: float

    @property
    def as_good(self) -> float:
        """Return up to which share another lag is as good."""
        return max(_RIVAL * self.unexplained, _EXACT)


def _candidates(motors: TimedColumns, camera: TimedColumns, hold: bool) -> list[_Candidate]:
    """Return lags at which the commands can explain the tips, the best first.

    Of lags so near to each other that the commands hardly change in between, only the best.
    """
    fits = []
    for lag, width in _coarse_lags(motors, camera):
        fits.append(_refined(motors, camera, lag, width, hold))
    candidates = []
    for fit in sorted(fits, key=lambda fit: fit.unexplained):
        if all(not _alike(motors, fit, better) for better in candidates):
            candidates.append(fit)
    return candidates


def _alike(motors: TimedColumns, a: _Candidate, b: _Candidate) -> bool:
    """Return whether the commands hardly change while the lag goes from one to another."""
    away = abs(a.lag - b.lag)
    if away <= a.width:
        return True
    rows = np.linspace(0, len(motors.time) - 1, min(len(motors.time), _ROWS)).astype(int)
    time = motors.time[rows]
    q = motors.values[rows]
    least = _ALIKE * np.square(q - q.mean(axis=0)).sum()
    for shift in [*np.arange(a.width, away, a.width), away]:
        change = commands_at(motors, time + shift) - q
        if np.square(change).sum() >= least:
            return False
    return True


def _unclear(motors: TimedColumns, camera: TimedColumns, candidates: Sequence[_Candidate]) -> str:
    """Return the message that no lag is clearly the best, with the lags to try."""
    lags = []
    for candidate in candidates[:_NAMED]:
        lags.append(f"{candidate.lag:.3f} s ({1.0 - candidate.unexplained:.1%})")
    return (
        f"The lag between {motors.source} and {camera.source} is not clear: {', '.join(lags)}. In "
        "brackets: how much of the motion of the tip the commands explain in a third of the rows, "
        "by a rough model of the other two thirds. One lag must explain "
        f"{100.0 * _EXPLAINED:.0f} %, and others clearly less. Several lags fit where a motion "
        "repeats, or where all motions last equally long. If both files record the same motion, "
        "try these lags as `lag` (--lag), or 0 if both share a clock; or record motions that "
        "differ in duration."
    )


def _coarse_lags(motors: TimedColumns, camera: TimedColumns) -> list[tuple[float, float]]:
    """Return lags [s] at which motors and camera move at the same times, and their accuracy.

    The correlation of the speeds of both over every overlap of at least half the shorter recording.
    """
    duration = max(np.ptp(motors.time), np.ptp(camera.time))
    step = max(2.0 * float(np.median(np.diff(camera.time))), duration / _CELLS)
    q_speed = _speed(motors.values, motors.time, step)
    x_speed = _speed(_tip(camera.values), camera.time, step)
    score, shift = _correlation(x_speed, q_speed)
    peaks = np.flatnonzero(
        (score >= np.append(score[1:], -np.inf)) & (score > np.append(-np.inf, score[:-1]))
    )
    peaks = peaks[score[peaks] >= _SURE * score[peaks].max()]
    best = []
    for peak in peaks[np.argsort(-score[peaks])]:
        between = [score[min(peak, other) : max(peak, other)].min() for other in best]
        if max(between, default=-np.inf) < _VALLEY * score[peak]:
            best.append(peak)
    best = best[:_CANDIDATES]
    start = camera.time[0] - motors.time[0]
    return [(float(start - shift[k] * step), float(2.0 * step)) for k in best]


def _tip(x: NDArray) -> NDArray:
    """Return the positions (N, 3) of the last marker that is never or least often missing."""
    markers = x.reshape(len(x), -1, 3)
    n_known = np.isfinite(markers).all(axis=2).sum(axis=0)
    last = len(n_known) - 1 - int(np.argmax(n_known[::-1]))
    return markers[:, last]


def _speed(values: NDArray, time: NDArray, step: float) -> NDArray:
    """Return the root of the speed of rows in cells of equal time, columns by their range.

    The root makes single outliers less heavy.
    """
    complete = np.isfinite(values).all(axis=1)
    values = values[complete]
    ranges = np.ptp(values, axis=0)
    scaled = values / np.where(ranges > 0.0, ranges, 1.0)
    steps = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    edges = np.arange(time[0], time[-1] + step, step)
    return np.sqrt(np.diff(np.interp(edges, time[complete], way)))


def _correlation(a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    """Return how surely a (k,) follows b (m,), and at which shift of a by cells.

    The score is the coefficient of correlation of the overlapping cells, times the root of their
    number. The sums over all overlaps are products of Fourier transforms.
    """
    size = len(a) + len(b) - 1
    length = 1 << (size - 1).bit_length()

    def sums(of_a: NDArray, of_b: NDArray) -> NDArray:
        product = np.fft.rfft(of_b, length) * np.conj(np.fft.rfft(of_a, length))
        return np.roll(np.fft.irfft(product, length), len(a) - 1)[:size]

    a = a - a.mean()
    b = b - b.mean()
    ones_a = np.ones(len(a))
    ones_b = np.ones(len(b))
    n = np.rint(sums(ones_a, ones_b)).clip(1.0)
    sum_a = sums(a, ones_b)
    sum_b = sums(ones_a, b)
    covariance = sums(a, b) - sum_a * sum_b / n
    least = 1e-9 * (np.square(a).sum() + np.square(b).sum()) + np.finfo(float).tiny
    variance_a = np.maximum(sums(a**2, ones_b) - sum_a**2 / n, least)
    variance_b = np.maximum(sums(ones_a, b**2) - sum_b**2 / n, least)
    score = covariance / np.sqrt(variance_a * variance_b) * np.sqrt(n)
    score[n < _OVERLAP * min(len(a), len(b))] = -np.inf
    return score, np.arange(size) - (len(a) - 1)


def _refined(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float, hold: bool
) -> _Candidate:
    """Return the best lag nearby."""
    tips = _surely_covered(motors, camera, lag, width)
    shifts = np.linspace(-width, width, 17)
    for _ in range(_WINDOWS):
        if not len(tips.time):
            return _Candidate(1.0, lag, width)
        errors = [_left_at(shift, lag, motors, tips, hold, 2) for shift in shifts]
        best = int(np.argmin(errors))
        lag += float(shifts[best])
        if 0 < best < len(shifts) - 1:
            break
        tips = _surely_covered(motors, camera, lag, width)
    q = commands_at(motors, tips.time - lag, hold)
    return _Candidate(1.0 - _explained(q, tips.values)[0], lag, width)


def _polished(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float, hold: bool
) -> float:
    """Return the best lag near one of the fine search, by a polynomial of the commands."""
    tips = _surely_covered(motors, camera, lag, width)
    if not len(tips.time):
        return lag
    _, degree = _explained(commands_at(motors, tips.time - lag, hold), tips.values)
    fit = minimize_scalar(
        _left_at,
        args=(lag, motors, tips, hold, degree),
        bounds=(-width, width),  # its tolerance is relative, and a lag can be years
        method="bounded",
        options={"xatol": 1e-4 * width},
    )
    return lag + float(fit.x)  # pyright: ignore[reportAttributeAccessIssue]


def _surely_covered(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float
) -> TimedColumns:
    """Return some tips within the motor rows at every lag of a window; none if they are too short.

    So every lag of a window is judged by the same rows.
    """
    tips = _tip(camera.values)
    first = camera.time - lag - width
    inside = (first >= motors.time[0]) & (first + 2.0 * width <= motors.time[-1])
    rows = np.flatnonzero(inside & np.isfinite(tips).all(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _ROWS)).astype(int)]
    shortest = _OVERLAP * min(np.ptp(motors.time), np.ptp(camera.time)) - 2.0 * width
    if len(rows) < 3 or np.ptp(camera.time[rows]) < shortest:
        rows = rows[:0]
    return TimedColumns(tips[rows], camera.time[rows])


def _left_at(
    shift: float,
    lag: float,
    motors: TimedColumns,
    tips: TimedColumns,
    hold: bool,
    degree: int,
) -> float:
    """Return the share of the variance of tips that the commands leave at a shifted lag."""
    q = commands_at(motors, tips.time - lag - shift, hold)
    return _unexplained(q, tips.values, degree)


def _unexplained(q: NDArray, x: NDArray, degree: int) -> float:
    """Return the share of the variance of tips that a polynomial of the commands leaves."""
    features = _features(q, degree)
    weights = _weights(features, x)
    n_free = max(len(x) - features.shape[1], 1)
    left = np.square(x - features @ weights).sum() * len(x) / n_free
    total = np.square(x - x.mean(axis=0)).sum()
    return float(left / total) if total > 0.0 else 1.0


def _explained(q: NDArray, x: NDArray) -> tuple[float, int]:
    """Return the share of the variance of tips that the commands explain in other parts of a log.

    That of three parts in a row, each from the other two, by a polynomial of the best degree, and
    that degree. Smooth motions that have nothing to do with each other agree within one part.
    """
    tips = _tip(x)
    complete = np.isfinite(tips).all(axis=1)
    q = q[complete]
    tips = tips[complete]
    few = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    q = q[few]
    tips = tips[few]
    total = np.square(tips - tips.mean(axis=0)).sum()
    if not total > 0.0:
        return 0.0, 1
    explained = []
    for degree in _DEGREES:
        features = _features(q, degree)
        left = 0.0
        for part in np.array_split(np.arange(len(q)), _PARTS):
            rows = np.delete(np.arange(len(q)), part)
            weights = _weights(features[rows], tips[rows])
            left += np.square(tips[part] - features[part] @ weights).sum()
        explained.append(1.0 - float(left / total))
    best = int(np.argmax(explained))
    return max(explained[best], 0.0), _DEGREES[best]


def _weights(features: NDArray, x: NDArray) -> NDArray:
    """Return the weights (k, 3) of least squares; a tiny ridge keeps rows at rest solvable."""
    gram = features.T @ features
    ridge = _RIDGE * np.trace(gram) / len(gram)
    return np.linalg.solve(gram + ridge * np.eye(len(gram)), features.T @ x)


def _features(q: NDArray, degree: int) -> NDArray:
    """Return the products of up to `degree` of 1 and z for commands (N, n), z from -1 to 1.

    Where these are too many for the rows, products of fewer; at least z^2 where `degree` is 2.
    """
    n = q.shape[1]
    rough = rough_features(q, q)
    if degree == 1:
        return rough[:, : 1 + n]
    most = min(_FEATURES, len(q) / _ROWS_PER_FEATURE)
    if math.comb(n + degree, degree) > most:
        return rough if degree == 2 else _features(q, degree - 1)
    factors = rough[:, : 1 + n].T  # of which the first is 1
    chosen = itertools.combinations_with_replacement(factors, degree)
    return np.stack([np.prod(product, axis=0) for product in chosen], axis=1)
