"""Logs of a user's robot: columns of a CSV, npz or parquet file, converted to SI units."""

from __future__ import annotations

import csv
import difflib
import itertools
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import (
    as_path,
    check_shape,
    countable,
    labels,
    one_of,
    real_array,
)
from hybridkin._core.commands import Commands
from hybridkin._core.texts import csv_cell
from hybridkin._core.units import METRES, UNITS, duration_in_words
from hybridkin.datasets._log_report import named_rows
from hybridkin.datasets._npz import arrays_of, check_expansion
from hybridkin.datasets._time import seconds_per_unit

_DELIMITERS = (",", ";", "\t")
_UNNAMED = ("", "nan", "NaN", "NaT", "None", "<NA>")  # a missing motion, as text
_MOST_COLUMNS = 10_000  # of an array
_LONGEST = 256  # characters of a motion's name


@dataclass(frozen=True, eq=False, repr=False)
class Log:
    """A measured log: actuator vectors and tip positions, row by row, in SI units.

    Attributes
    ----------
    q : ndarray of shape (N, n)
        Actuator vectors [m], or in the unit given by `units`.
    x : ndarray of shape (N, 3) or (N, 3 K)
        Tip positions [m], or positions of K markers, the last of which is the tip. NaN if a marker
        was not measured.
    groups : ndarray of shape (N,) or None
        Motion or day of each row.
    time : ndarray of shape (N,) or None
        Time stamps [s].
    line : ndarray of shape (N,) of int or None
        Line of each row in a text file; in other files the row number from 0.
    invalid_lines : ndarray of shape (k,) of int
        Lines that were left out because a value is missing, NaN or infinite.
    q_names, x_names : tuple of str
        Names of the columns.
    q_sign : int or sequence of int
        Factor on the actuator columns of the file.
    units, file_units : mapping of str to str
        Units of "q" and "x" in this object and in the file.
    source : str
        Source of the log, for example its path.
    runs : ndarray of shape (N,) or None
        Run of each row: motions that follow each other without a break are one run.
    """

    q: NDArray
    x: NDArray
    groups: NDArray | None = None
    time: NDArray | None = None
    line: NDArray | None = None
    invalid_lines: Sequence[int] | NDArray = ()
    q_names: Sequence[str] = ()
    x_names: Sequence[str] = ()
    q_sign: ArrayLike = 1
    units: Mapping[str, str] = field(default_factory=lambda: {"q": "m", "x": "m"})
    file_units: Mapping[str, str] = field(default_factory=lambda: {"q": "m", "x": "m"})
    source: str = "in memory"
    runs: NDArray | None = None

    def __post_init__(self) -> None:
        for name in ("q", "x", "time"):
            column = getattr(self, name)
            if column is not None:
                object.__setattr__(self, name, real_array(column, name))
        q = np.shape(self.q)
        x = np.shape(self.x)
        rows_fit = len(q) == len(x) == 2 and q[0] == x[0] > 0
        if not rows_fit or x[1] % 3 or x[1] == 0:
            raise ValueError(
                f"`Log` needs q of shape (N, n) and x of shape (N, 3), or (N, 3 K) of K markers, "
                f"got {q} and {x}."
            )
        for name in ("groups", "runs"):
            column = getattr(self, name)
            if column is not None:
                object.__setattr__(self, name, labels(column, q[0], name))
        for name, column in (("time", self.time), ("line", self.line)):
            if column is not None:
                check_shape(np.asarray(column), name, [q[0]], "one for each row")

    def __repr__(self) -> str:
        """Return a summary of a few lines."""
        tips = self.x[:, -3:]
        sides = np.fmax.reduce(tips) - np.fmin.reduce(tips)
        span = " x ".join(f"{side:.3g}" for side in sides)
        head = f"{type(self).__name__} of {self.source}: {len(self.q)} rows"
        if self.groups is not None:
            head += f", {len(np.unique(self.groups))} motions"
        names = ", ".join(column_names(self, "q"))
        values = f"{self.q.min():.4g} to {self.q.max():.4g} {self.units['q']}"
        lines = [
            head,
            f"{self.q.shape[1]} actuators: {names}; {values}",
            f"tips within {span} {self.units['x']}",
        ]
        if self.time is not None:
            duration = duration_in_words(float(np.ptp(self.time)))
            lines.append(
                f"time from {self.time[0]:.6g} to {self.time[-1]:.6g} s: {duration}"
            )
        return "\n  ".join(lines)

    @property
    def commands(self) -> Commands:
        """The actuator vectors with their runs, without such a column the motions, and times."""
        runs = self.groups if self.runs is None else self.runs
        return Commands(self.q, runs, self.time)

    def rows(self, chosen: NDArray | slice) -> Self:
        """Return a log of some of the rows."""
        columns = {}
        for name in ("q", "x", "groups", "runs", "time", "line"):
            column = getattr(self, name)
            if column is not None:
                columns[name] = column[chosen]
        return replace(self, **columns)


def column_names(log: Log, which: str) -> list[str]:
    """Return the names of the columns of "q" or "x"; without names, their numbers."""
    names = log.q_names if which == "q" else log.x_names
    values = log.q if which == "q" else log.x
    return list(names) or [f"{which}[{i}]" for i in range(values.shape[1])]


def load_log(
    path: str | os.PathLike[str],
    q: Sequence[str],
    x: Sequence[str],
    groups: str | None = None,
    *,
    runs: str | None = None,
    time: str | None = None,
    time_unit: str = "s",
    rate: float | None = None,
    q_unit: str = "m",
    x_unit: str = "m",
    q_sign: ArrayLike = 1,
    delimiter: str | None = None,
    drop_invalid: bool = False,
) -> Log:
    r"""Return actuator vectors and tip positions from a log: a CSV, npz or parquet file.

    Parameters
    ----------
    path : path-like
        The file. ``.npz`` is read by NumPy, ``.parquet`` and ``.pq`` by pandas with pyarrow or
        fastparquet, anything else as text with a header line.
    q : sequence of str
        Columns of the actuator vector, in the order of the robot model. In an npz file an array
        (N,) is a column; ``"name[2]"`` is column 2 of an array (N, k), ``"name"`` all its columns.
    x : sequence of 3 str, or of 3 K
        Columns of the tip position, or of the positions of K markers, the last of which is the tip.
        A row without some markers is kept, with NaN for these.
    groups : str or None, default=None
        Column that names the motion or day of a row, for splits by groups.
    runs : str or None, default=None
        Column that names the run of a row, for models with hysteresis, see `Commands`. Default:
        every motion is a run.
    time : str or None, default=None
        Column of the time stamp. In npz and parquet files also dates, which become seconds since
        1970 (UTC), and durations.
    time_unit : {"s", "ms", "us", "ns", "frames"}, default="s"
        Unit of the time stamps in the file; dates and durations have their own.
    rate : float or None, default=None
        Frames per second, for ``time_unit="frames"`` [1/s].
    q_unit : {"m", "cm", "mm", "um", "in", "rad", "deg", "1"}, default="m"
        Unit of the actuator columns in the file; lengths become metres and angles radians. "1" is
        not converted: counts or pressures, for a chain with `gains`.
    x_unit : {"m", "cm", "mm", "um", "in"}, default="m"
        Unit of the tip columns in the file.
    q_sign : 1, -1 or sequence of them, default=1
        Factor on the actuator columns: -1 if the file counts a pulled tendon as positive, because
        here a shortening is negative.
    delimiter : str or None, default=None
        Separator of a text file. None: the most frequent in the header of comma, semicolon and tab.
    drop_invalid : bool, default=False
        Leave out rows with a missing, NaN or infinite value, or without the name of their motion,
        instead of raising an error.

    Returns
    -------
    Log
        In SI units; ``groups`` and ``runs`` are strings. They and ``time`` are None if not
        requested.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If a parquet file is given and pandas cannot read it.
    ValueError
        If a column is unknown or used twice, a cell is not a number, rows are invalid, a quote in
        a text file is not closed, or no row is left.

    Warns
    -----
    UserWarning
        If metres are declared but values look like millimetres.

    See Also
    --------
    check_log : Possible errors of a log, with advice.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin.datasets import load_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "log.csv"
    ...     _ = path.write_text("a,b,c,X,Y,Z\n1,2,3,10,20,30\n")
    ...     log = load_log(path, q=["a", "b", "c"], x=["X", "Y", "Z"], q_unit="mm", x_unit="mm")
    >>> log.x, log.q_names
    (array([[0.01, 0.02, 0.03]]), ['a', 'b', 'c'])
    """
    table = _read(as_path(path), delimiter)
    q = table.names("q", q)
    x = table.names("x", x)
    if len(x) % 3:
        raise ValueError(
            f"`x` must name 3 columns, or 3 for each of several markers, got {len(x)}: {x}."
        )
    factor = _checked_factor(len(q), q_unit, x_unit, q_sign)
    names = [*q, *x]
    stamps = ()
    if time is not None:
        names.append(time)
        stamps = table.column(time)
    seconds = seconds_per_unit(stamps, time_unit, rate)
    values = table.values(names, time)
    labelled = {}
    for argument, column in {"groups": groups, "runs": runs}.items():
        if column is not None:
            labelled[argument] = table.labels(argument, column, len(values))
    commands = values[:, : len(q)]
    tips = values[:, len(q) : len(names) - (time is not None)]
    complete = countable(tips).reshape(len(tips), -1, 3).all(axis=2)
    tips = np.where(complete.repeat(3, axis=1), tips, np.nan)
    valid = countable(commands).all(axis=1) & complete.any(axis=1)
    if time is not None:
        valid &= countable(values[:, -1])
    for labels_of_rows in labelled.values():
        valid &= ~np.isin(labels_of_rows, _UNNAMED)
    kind = "line"
    places = table.lines
    if places is None:
        kind = "row"
        places = np.arange(len(values))
    if not valid.any() or not (drop_invalid or valid.all()):
        raise ValueError(
            f"{(~valid).sum()} of {len(values)} rows of {str(path)!r} have a missing, NaN or "
            f"infinite value, or no motion ({named_rows(places[~valid], kind)}); correct them, or "
            "leave them out with drop_invalid=True if others are left."
        )
    commands = commands[valid]
    tips = tips[valid]
    for name, unit, column in (("q", q_unit, commands), ("x", x_unit, tips)):
        span = (np.nanmax(column, axis=0) - np.nanmin(column, axis=0)).max()
        middle = np.nanmedian(np.abs(column))
        if unit == "m" and (middle > 10 or span > 5):
            warnings.warn(
                f"The `{name}` columns span {span:.4g} m around {middle:.4g} m; if the file has "
                f"millimetres, give {name}_unit='mm' (centimetres: 'cm').",
                stacklevel=2,
            )
    si_unit = q_unit if q_unit == "1" else "rad"
    if q_unit in METRES:
        si_unit = "m"
    return Log(
        commands * factor,
        tips * METRES[x_unit],
        time=None if time is None else seconds * values[valid, -1],
        line=places[valid],
        invalid_lines=places[~valid],
        q_names=q,
        x_names=x,
        q_sign=q_sign,
        units={"q": si_unit, "x": "m"},
        file_units={"q": q_unit, "x": x_unit},
        source=str(path),
        **{argument: names[valid] for argument, names in labelled.items()},
    )


def log_columns(
    path: str | os.PathLike[str], delimiter: str | None = None
) -> list[str]:
    """Return the names of the columns of a log file.

    Parameters
    ----------
    path, delimiter
        As for `load_log`.

    Returns
    -------
    list of str
        In the order of the file.
    """
    return _read(as_path(path), delimiter).header


def _read(path: Path, delimiter: str | None) -> _Table:
    if not path.is_file():
        raise FileNotFoundError(
            f"`path` must be a log file, there is none at {str(path)!r}."
        )
    if path.suffix.lower() == ".npz":
        return _read_npz(path)
    if path.suffix.lower() in (".parquet", ".pq"):
        return _read_parquet(path)
    return _read_text(path, delimiter)


class _Table(NamedTuple):
    """The unconverted columns of a file; for text also the line of every row."""

    path: Path
    header: list[str]
    columns: Sequence[NDArray | Sequence[str]]
    lines: NDArray | None = None

    def names(self, argument: str, names: Sequence[str]) -> list[str]:
        """Return names of columns; the name of an array (N, k) becomes those of its columns."""
        names = [names] if names is None or isinstance(names, str) else list(names)
        if not names or not all(isinstance(name, str) for name in names):
            raise ValueError(f"`{argument}` must be column names, got {names!r}.")
        if len(set(names)) < len(names):
            raise ValueError(f"`{argument}` names a column twice: {names}.")
        columns = []
        for name in names:
            part = re.compile(rf"{re.escape(name)}\[\d+\]")
            if name not in self.header and any(map(part.fullmatch, self.header)):
                columns += filter(part.fullmatch, self.header)
            else:
                self.column(name)
                columns.append(name)
        return columns

    def column(self, name: str) -> NDArray | Sequence[str]:
        """Return the column of that name."""
        if not isinstance(name, str):
            raise TypeError(
                f"`groups`, `runs` and `time` must be names of columns, got {name!r:.80}."
            )
        written = csv_cell(name).strip()  # as our own tables hold it
        if name not in self.header and written in self.header:
            name = written
        count = self.header.count(name)
        path = str(self.path)
        if count > 1:
            raise ValueError(
                f"Column {name!r} occurs {count} times in {path!r}; rename it."
            )
        if count:
            return self.columns[self.header.index(name)]
        close = [other for other in self.header if other.lower() == name.lower()]
        close = close or difflib.get_close_matches(name, self.header, n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(map(repr, close))}? Its" if close else "its"
        if len(self.header) == 1:
            hint = "it has only one column, check `delimiter`. Its"
        raise ValueError(
            f"There is no column {name!r} in {path!r}; {hint:.400} columns: {self.header!s:.1000}."
        )

    def numbers(self, name: str, as_time: bool) -> NDArray:
        """Return the column of that name as numbers, NaN for empty cells; times in seconds."""
        column = self.column(name)
        if self.lines is not None:
            numbers = []
            for cell, line in zip(column, self.lines, strict=True):
                numbers.append(_number(str(cell), name, line, self.path))
            return np.array(numbers)
        values = np.asarray(column)
        kind = values.dtype
        if as_time and kind.kind in "mM":
            return (values - kind.type(0, "s")) / np.timedelta64(1, "s")
        try:
            # astype would use a real part, or ticks of some unit.
            if kind.kind not in "cVmM":
                return values.astype(float)
        except (TypeError, ValueError, OverflowError):
            pass
        raise ValueError(
            f"Column {name!r} of {str(self.path)!r} must hold numbers, got {kind}."
        )

    def values(self, names: list[str], time: str | None) -> NDArray:
        """Return columns as numbers (N, k), that of the time in seconds."""
        columns = {name: self.numbers(name, name == time) for name in names}
        if len(columns) < len(names):
            raise ValueError(
                f"`q`, `x` and `time` must name a column once, got {names}."
            )
        sizes = {name: len(column) for name, column in columns.items()}
        if len({*sizes.values()}) > 1:
            raise ValueError(
                f"The columns of {str(self.path)!r} must be equally long, got {sizes}."
            )
        if not all(sizes.values()):
            header = "no" if self.lines is None else "a header but no"
            raise ValueError(f"{str(self.path)!r} has {header} rows.")
        return np.column_stack([*columns.values()])

    def labels(self, argument: str, name: str, n_rows: int) -> NDArray:
        """Return the column of that name as labels of the rows."""
        labels = [str(value).strip() for value in self.column(name)]
        longest = max(map(len, labels), default=0)
        if len(labels) != n_rows or longest > _LONGEST:
            raise ValueError(
                f"`{argument}` must name each of {n_rows} rows in at most {_LONGEST} characters, "
                f"but column {name!r} of {str(self.path)!r} has {len(labels)} rows of up to "
                f"{longest} characters; check the file."
            )
        return np.array(labels)


def _checked_factor(n: int, q_unit: str, x_unit: str, q_sign: ArrayLike) -> NDArray:
    """Return the factor on the n columns of q, after a check of units and sign."""
    advice = "; for other units give '1', and `gains` [m per unit] of the chain"
    one_of(q_unit, "q_unit", UNITS, advice)
    one_of(x_unit, "x_unit", METRES)
    sign = real_array(q_sign, "q_sign")
    if sign.shape not in ((), (n,)) or not np.isin(sign, (-1, 1)).all():
        raise ValueError(
            f"`q_sign` must be 1 or -1, or one per column of `q`, got {q_sign!r}."
        )
    return sign * UNITS[q_unit]


def _read_text(path: Path, delimiter: str | None) -> _Table:
    if delimiter is not None and not (
        isinstance(delimiter, str) and len(delimiter) == 1
    ):
        raise ValueError(
            f"`delimiter` must be one character or None, got {delimiter!r:.80}."
        )
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            unquoted = re.sub('"[^"]*("|$)', "", file.readline())
            delimiter = delimiter or max(_DELIMITERS, key=unquoted.count)
            file.seek(0)
            reader = csv.reader(file, delimiter=delimiter)
            rows = [
                (reader.line_num, row) for row in reader if any(map(str.strip, row))
            ]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"{str(path)!r} is not a text file in UTF-8, or does not close a quote ({error}); save "
            "the log as CSV, npz or parquet."
        ) from error
    if not rows:
        raise ValueError(f"{str(path)!r} is empty; a header line and rows are needed.")
    n = len(rows[0][1])
    for line, row in rows:
        if len(row) > n:
            raise ValueError(
                f"Line {line} of {str(path)!r} has {len(row)} cells, the header {n}; check "
                f"`delimiter` (now {delimiter!r})."
            )
        # A cell may have line breaks, but with all delimiters of a row it hides one.
        text = delimiter.join(row)
        n_lines = len(text.splitlines()) - 1
        if n_lines > 0 and text.count(delimiter) >= len(row) + n - 2:
            raise ValueError(
                f'A quote (") in line {line - n_lines} of {str(path)!r} hides rows up to line '
                f"{line}; close or remove it."
            )
    lines, cells = zip(*rows, strict=True)
    header = [name.strip() for name in cells[0]]
    columns = [column[1:] for column in itertools.zip_longest(*cells, fillvalue="")]
    return _Table(path, header, columns, np.array(lines[1:], dtype=int))


def _read_npz(path: Path) -> _Table:
    """Return the arrays (N,) of a file; columns of arrays (N, k) are named ``name[i]``."""
    arrays = arrays_of(path)
    columns = {name: array for name, array in arrays.items() if array.ndim == 1}
    for name, array in arrays.items():
        if array.ndim == 2 and array.shape[1] > _MOST_COLUMNS:
            raise ValueError(
                f"{name!r} of {str(path)!r} must have at most {_MOST_COLUMNS} columns, got "
                f"{array.shape[1]}; transpose it if rows and columns are swapped."
            )
        if array.ndim == 2:
            columns |= {f"{name}[{i}]": column for i, column in enumerate(array.T)}
    return _Table(path, [*columns], [*columns.values()])


def _read_parquet(path: Path) -> _Table:
    try:
        import pandas as pd

        _check_rows(path)
        frame = pd.read_parquet(path)
        for name in frame.select_dtypes("datetimetz"):
            frame[name] = frame[name].dt.tz_convert(None)  # to UTC
    except ImportError as error:
        raise ImportError(
            f"Reading {str(path)!r} needs pandas and pyarrow (pip install pandas pyarrow); or "
            "save the log as CSV or npz."
        ) from error
    except Exception as error:  # pyarrow and pandas have many kinds of them
        raise ValueError(
            f"{str(path)!r} is not a parquet file: {error!s:.200}."
        ) from error
    return _Table(
        path, [*map(str, frame.columns)], [frame[c].to_numpy() for c in frame.columns]
    )


def _check_rows(path: Path) -> None:
    """Raise if a parquet file has too many rows for its size, e.g. one value repeated."""
    try:
        from pyarrow.parquet import read_metadata
    except ImportError:  # fastparquet reads it
        return
    metadata = read_metadata(path)
    check_expansion(path, 8 * metadata.num_rows * metadata.num_columns)


def _number(cell: str, name: str, line: int, path: Path) -> float:
    text = cell.strip()
    if not text:
        return np.nan
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"Line {line} of {str(path)!r}, column {name!r}: a number is needed, got {text!r:.60}; "
            "correct the cell (an empty cell is a missing value, see `drop_invalid`; decimals "
            "need a point)."
        ) from None
