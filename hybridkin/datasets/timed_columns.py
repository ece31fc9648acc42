"""Columns of one recording with the times of its rows, by its own clock."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import as_path, check_shape, countable, labels, one_of, real_array
from hybridkin._core.named_rows import named_places
from hybridkin._core.text_rows import TextForm
from hybridkin._core.units import UNITS
from hybridkin.datasets._tables import Table, without_missing
from hybridkin.datasets.table_files import read_table

_AS_WRITTEN = "as written"


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


def commands_at(motors: TimedColumns, time: NDArray, hold: bool = False) -> NDArray:
    """Return the commands (M, n) of other times (M,): linear between two rows, or held."""
    if hold:
        return motors.values[row_before(motors, time)]
    columns = [np.interp(time, motors.time, column) for column in motors.values.T]
    return np.stack(columns, axis=1)


def row_before(motors: TimedColumns, time: NDArray) -> NDArray:
    """Return the motor rows (M,) at or before times; the first row for earlier times."""
    return np.maximum(np.searchsorted(motors.time, time, side="right") - 1, 0)
