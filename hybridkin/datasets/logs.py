"""Logs of a user's robot: columns of a CSV, npz or parquet file, converted to SI units."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

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
from hybridkin._core.named_rows import named_places
from hybridkin._core.reading import Reading, with_fields_of
from hybridkin._core.text_rows import TextForm
from hybridkin._core.units import METRES, UNITS, duration_in_words
from hybridkin.datasets._frames import frame_table
from hybridkin.datasets._tables import UNNAMED, Table, without_missing
from hybridkin.datasets._time import seconds_per_unit
from hybridkin.datasets.encoders import (
    EncoderFault,
    encoder_faults,
    given_periods,
    periods_of,
    unwrapped,
)
from hybridkin.datasets.table_files import read_table


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
        columns = self._columns
        for name in ("q", "x", "time"):
            if name in columns:
                object.__setattr__(self, name, real_array(columns[name], name))
        q = np.shape(self.q)
        x = np.shape(self.x)
        rows_fit = len(q) == len(x) == 2 and q[0] == x[0] > 0
        if not rows_fit or x[1] % 3 or x[1] == 0:
            raise ValueError(
                f"`Log` needs q of shape (N, n) and x of shape (N, 3), or (N, 3 K) of K markers, "
                f"got {q} and {x}."
            )
        for name in ("groups", "runs"):
            if name in columns:
                object.__setattr__(self, name, labels(columns[name], q[0], name))
        for name in ("time", "line"):
            if name in columns:
                check_shape(np.asarray(columns[name]), name, [q[0]], "one for each row")

    @property
    def _columns(self) -> dict[str, NDArray]:
        """The columns that it has, by name."""
        columns = {}
        for name in ("q", "x", "groups", "runs", "time", "line"):
            column = vars(self)[name]
            if column is not None:
                columns[name] = column
        return columns

    def __repr__(self) -> str:
        """Return a summary of a few lines."""
        tips = self.x[:, -3:]
        sides = np.fmax.reduce(tips) - np.fmin.reduce(tips)
        span = " x ".join(f"{side:.3g}" for side in sides)
        head = f"{type(self).__name__} of {self.source}: {len(self.q)} rows"
        if self.groups is not None:
            head += f", {len(np.unique(self.groups))} motions"
        names = ", ".join(self.column_names("q"))
        values = "no commands"
        if self.q.size:
            values = f"{self.q.min():.4g} to {self.q.max():.4g} {self.units['q']}"
        lines = [
            head,
            f"{self.q.shape[1]} actuators: {names}; {values}",
            f"tips within {span} {self.units['x']}",
        ]
        if self.time is not None:
            duration = duration_in_words(float(np.ptp(self.time)))
            lines.append(f"time from {self.time[0]:.6g} to {self.time[-1]:.6g} s: {duration}")
        return "\n  ".join(lines)

    @staticmethod
    @with_fields_of(Reading)
    def from_frame(df: Any, reading: Reading) -> Log:
        """Return the log in a data frame as from a file; see `load_log`.

        The frame is one of pandas, polars, modin or narwhals, or a table of pyarrow. Null is
        missing, and lines are the numbers of rows, from 0.

        Raises
        ------
        TypeError
            If `df` is no data frame.
        ValueError
            As for `load_log`.

        Examples
        --------
        >>> import pandas as pd
        >>> from hybridkin.datasets import Log
        >>> df = pd.DataFrame({"a": [1.0, 2.0], "X": [10, 20], "Y": [0, 0], "Z": [50, 60]})
        >>> Log.from_frame(df, q=["a"], x=["X", "Y", "Z"], q_unit="mm", x_unit="mm").x
        array([[0.01, 0.  , 0.05],
               [0.02, 0.  , 0.06]])
        """
        return _converted(frame_table(df, "data frame"), reading)

    @property
    def commands(self) -> Commands:
        """The actuator vectors with their runs, without such a column the motions, and times."""
        runs = self.groups if self.runs is None else self.runs
        return Commands(self.q, runs, self.time)

    def rows(self, chosen: NDArray | slice) -> Self:
        """Return a log of some of the rows."""
        columns = self._columns
        for name, column in columns.items():
            columns[name] = column[chosen]
        return replace(self, **columns)

    def column_names(self, which: str) -> list[str]:
        """Return the names of the columns of "q" or "x"; without names, their numbers."""
        names = self.q_names if which == "q" else self.x_names
        values = self.q if which == "q" else self.x
        return list(names) or [f"{which}[{i}]" for i in range(values.shape[1])]

    def encoder_faults(self) -> list[EncoderFault]:
        """Return the readings of q that are whole turns of an encoder off, as the tips confirm.

        Usual periods of encoders are tried, in the unit of the file; see `unwrap` of `load_log`.
        """
        q_unit = self.file_units["q"]
        readings = self.q / np.multiply(self.q_sign, UNITS.get(q_unit, 1.0))
        runs = self.commands.run_of_rows
        periods = [periods_of(q_unit)] * readings.shape[1]
        return encoder_faults(readings, self.x, runs[1:] == runs[:-1], periods)


@with_fields_of(Reading)
def load_log(path: str | os.PathLike[str], reading: Reading) -> Log:
    r"""Return actuator vectors and tip positions from a log: a CSV, npz or parquet file.

    Parameters
    ----------
    path : path-like
        The file. ``.npz`` is read by NumPy, ``.parquet`` and ``.pq`` by pandas with pyarrow or
        fastparquet, anything else as text with a header: UTF-8, UTF-16 with its mark, or the
        encoding of Windows (cp1252, with Latin-1).
    q : sequence of str
        Columns of the actuator vector, in the order of the robot model. In an npz file an array
        (N,) is a column; ``"name[2]"`` is column 2 of an array (N, k), ``"name"`` all its columns.
        Empty: a recording of a camera alone.
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
    q_unit : {"m", "cm", "mm", "um", "in", "rad", "deg", "1", "counts"}, default="m"
        Unit of the actuator columns in the file; lengths become metres and angles radians. "1" is
        not converted: counts or pressures, for a chain with `gains`. "counts" is another name of
        "1".
    x_unit : {"m", "cm", "mm", "um", "in"}, default="m"
        Unit of the tip columns in the file.
    q_sign : 1, -1 or sequence of them, default=1
        Factor on the actuator columns: -1 if the file counts a pulled tendon as positive, because
        here a shortening is negative.
    delimiter : str or None, default=None
        Separator of a text file. None: the most frequent in the header of comma, semicolon and tab.
    header_line : int or None, default=None
        Line of the header of a text file, from 1; lines above it are not read. None: the block of
        header lines of Motive, Vicon Nexus or Qualisys Track Manager, else line 1. In such a block
        columns are named "marker X" or "body X", and the rotations "body rot X"; the unit of length
        that it states must be `x_unit`.
    decimal : {".", ","}, default="."
        Decimal sign of a text file.
    missing : sequence of float, default=()
        Numbers in q and x that stand for missing values, such as 9999.999, in the unit of the
        file. Zero means the 0, 0, 0 of a lost marker, not zeros elsewhere.
    unwrap : bool, float or mapping of str to float, default=False
        Correct encoders: readings that start again after a period, turns that are lost from some
        row on, and single readings that are whole periods off. The period of the encoders in the
        unit of the file, such as 4096 or 360; a mapping gives those of some columns. True: usual
        periods are tried, and only what the tips confirm is corrected. A column is corrected up
        to a constant number of periods. The rows of a run must be in order of time.
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
        If a column is unknown or used twice, a cell is not a number, rows are invalid or do not fit
        the header, a quote in a text file is not closed, the file states another unit, or no row is
        left.

    Warns
    -----
    UserWarning
        If metres are declared but values look like millimetres.

    See Also
    --------
    Log.from_frame : The same from a data frame.
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
    return _converted(read_table(as_path(path), reading.text_form), reading)


def log_columns(
    path: str | os.PathLike[str],
    delimiter: str | None = None,
    *,
    header_line: int | None = None,
    decimal: str = ".",
) -> dict[str, str]:
    """Return the names of the columns of a log file, and the units that the file states.

    Parameters
    ----------
    path, delimiter, header_line, decimal
        As for `load_log`.

    Returns
    -------
    dict of str to str
        The unit by the name of the column, "" where the file does not say; in the order of the
        file.
    """
    table = read_table(as_path(path), TextForm(delimiter, header_line, decimal))
    return {name: table.units.get(name, "") for name in table.header}


class _Columns(NamedTuple):
    """The names of the columns of a log; of motions and runs by argument."""

    q: list[str]
    x: list[str]
    times: list[str]  # one name, or none
    labels: dict[str, str]

    @classmethod
    def of(cls, table: Table, reading: Reading) -> Self:
        """Return the names as the table has them."""
        of_q = []
        if not isinstance(reading.q, (list, tuple)) or reading.q:
            of_q = table.names("q", reading.q)
        of_x = table.names("x", reading.x)
        if len(of_x) % 3:
            raise ValueError(
                "`x` must name 3 columns, or 3 for each of several markers, got "
                f"{len(of_x)}: {of_x}."
            )
        labels = {"groups": reading.groups, "runs": reading.runs}
        named = {}
        for argument, name in labels.items():
            if name is not None:
                named[argument] = name
        times = [] if reading.time is None else [reading.time]
        return cls(of_q, of_x, times, named)


def _converted(table: Table, reading: Reading) -> Log:
    """Return a log in SI units, without its invalid rows."""
    columns = _Columns.of(table, reading)
    q_unit = "1" if reading.q_unit == "counts" else reading.q_unit
    x_unit = reading.x_unit
    n = len(columns.q)
    factor = _checked_factor(n, q_unit, x_unit, reading.q_sign)
    table.check_unit("q_unit", columns.q, q_unit)
    table.check_unit("x_unit", columns.x, x_unit)
    stamps = table.column(columns.times[0]) if columns.times else ()
    seconds = seconds_per_unit(stamps, reading.time_unit, reading.rate)
    values = table.values([*columns.q, *columns.x, *columns.times], columns.times)
    labelled = {
        argument: table.labels(argument, name, len(values))
        for argument, name in columns.labels.items()
    }
    commands = values[:, :n]
    tips = values[:, n : n + len(columns.x)]
    times = values[:, n + len(columns.x) :]
    without_missing(commands, reading.missing, zeros=False)
    without_missing(tips, reading.missing)
    complete = countable(tips).reshape(len(tips), -1, 3).all(axis=2)
    tips = np.where(complete.repeat(3, axis=1), tips, np.nan)
    valid = countable(commands).all(axis=1) & complete.any(axis=1)
    valid &= countable(times).all(axis=1)
    for labels_of_rows in labelled.values():
        valid &= ~np.isin(labels_of_rows, UNNAMED)
    kind = "line"
    places = table.lines
    if places is None:
        kind = "row"
        places = np.arange(len(values))
    if not valid.any() or not (reading.drop_invalid or valid.all()):
        raise ValueError(
            f"{(~valid).sum()} of {len(values)} rows of {str(table.source)!r} have a missing, "
            f"NaN or infinite value, or no motion ({named_places(places[~valid], kind)}); correct "
            "them, or leave them out with drop_invalid=True if others are left."
        )
    commands = commands[valid]
    tips = tips[valid]
    labelled = {argument: names[valid] for argument, names in labelled.items()}
    periods = given_periods(reading.unwrap, columns.q, q_unit)
    if any(periods):
        same_run = _same_run(labelled, len(tips))
        commands = unwrapped(commands, tips[:, -3:], same_run, periods)
    _warn_of_millimetres("q", commands, q_unit)
    _warn_of_millimetres("x", tips, x_unit)
    si_unit = q_unit if q_unit == "1" else "rad"
    if q_unit in METRES:
        si_unit = "m"
    return Log(
        commands * factor,
        tips * METRES[x_unit],
        time=seconds * times[valid, 0] if columns.times else None,
        line=places[valid],
        invalid_lines=places[~valid],
        q_names=columns.q,
        x_names=columns.x,
        q_sign=reading.q_sign,
        units={"q": si_unit, "x": "m"},
        file_units={"q": q_unit, "x": x_unit},
        source=str(table.source),
        **labelled,
    )


def _same_run(labelled: Mapping[str, NDArray], n_rows: int) -> NDArray:
    """Return whether each row and the next belong to one run, else motion, shape (n_rows - 1,)."""
    same = np.ones(n_rows - 1, dtype=bool)
    for labels_of_rows in labelled.values():  # those of runs come last
        same = labels_of_rows[1:] == labels_of_rows[:-1]
    return same


def _warn_of_millimetres(name: str, column: NDArray, unit: str) -> None:
    """Warn if metres are declared but values (N, k) look like millimetres."""
    if not column.size:
        return
    span = (np.nanmax(column, axis=0) - np.nanmin(column, axis=0)).max()
    middle = np.nanmedian(np.abs(column))
    if unit == "m" and (middle > 10 or span > 5):
        warnings.warn(
            f"The `{name}` columns span {span:.4g} m around {middle:.4g} m; if the file has "
            f"millimetres, give {name}_unit='mm' (centimetres: 'cm').",
            stacklevel=5,
        )


def _checked_factor(n: int, q_unit: str, x_unit: str, q_sign: ArrayLike) -> NDArray:
    """Return the factor on the n columns of q, after a check of units and sign."""
    advice = "; for other units give '1', and `gains` [m per unit] of the chain"
    one_of(q_unit, "q_unit", UNITS, advice)
    one_of(x_unit, "x_unit", METRES)
    sign = real_array(q_sign, "q_sign")
    if sign.shape not in ((), (n,)) or not np.isin(sign, (-1, 1)).all():
        raise ValueError(f"`q_sign` must be 1 or -1, or one per column of `q`, got {q_sign!r}.")
    return sign * UNITS[q_unit]
