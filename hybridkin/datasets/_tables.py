"""Tables as files hold them: named columns, and their conversion to numbers and labels."""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import real_array
from hybridkin._core.text_rows import cell_advice, number_of
from hybridkin._core.texts import csv_cell

UNNAMED = ("", "nan", "NaN", "NaT", "None", "<NA>")
"""A missing motion or value, as text."""

_LONGEST = 256  # characters of a motion's name


class Table(NamedTuple):
    """The unconverted columns of a file or data frame; for text also the line of every row.

    `units` are the units of length of columns that a file states, and `statement` says where.
    """

    source: str | Path
    header: list[str]
    columns: Sequence[Any]  # each a Sequence or array
    lines: NDArray | None = None
    decimal: str = "."
    units: Mapping[str, str] = MappingProxyType({})
    statement: str = ""

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

    def column(self, name: str) -> Any:
        """Return the column of that name."""
        if not isinstance(name, str):
            raise TypeError(
                f"`groups`, `runs` and `time` must be names of columns, got {name!r:.80}."
            )
        written = csv_cell(name).strip()  # as our own tables hold it
        if name not in self.header and written in self.header:
            name = written
        if name not in self.header:
            name = name.removeprefix("#").lstrip()  # before the header of a text file
        count = self.header.count(name)
        source = str(self.source)
        if count > 1:
            raise ValueError(f"Column {name!r} occurs {count} times in {source!r}; rename it.")
        if count:
            return self.columns[self.header.index(name)]
        close = [other for other in self.header if other.lower() == name.lower()]
        close = close or difflib.get_close_matches(name, self.header, n=3, cutoff=0.4)
        hint = f"did you mean {', '.join(map(repr, close))}? Its" if close else "its"
        if len(self.header) == 1:
            hint = "it has only one column, check `delimiter`. Its"
        raise ValueError(
            f"There is no column {name!r} in {source!r}; {hint:.400} columns: "
            f"{self.header!s:.1000}."
        )

    def numbers(self, name: str, as_time: bool) -> NDArray:
        """Return the column of that name as numbers, NaN for empty cells; times in seconds."""
        column = self.column(name)
        if self.lines is not None:
            return self._numbers_of_text(name, column, self.lines)
        values = np.asarray(column)
        if values.dtype == object:
            values = _of_objects(values)
        kind = values.dtype
        if as_time and kind.kind in "mM":
            return (values - kind.type(0, "s")) / np.timedelta64(1, "s")
        try:
            # astype would use a real part, or ticks of some unit.
            if kind.kind not in "cVmM":
                return values.astype(float)
        except (TypeError, ValueError, OverflowError):
            pass
        raise ValueError(f"Column {name!r} of {str(self.source)!r} must hold numbers, got {kind}.")

    def _numbers_of_text(self, name: str, cells: Sequence[str], lines: NDArray) -> NDArray:
        """Return the numbers in cells (N,) of text, NaN for missing ones."""
        if self.decimal == ".":
            try:
                return np.array([*map(float, cells)])
            except ValueError:
                pass  # empty cells, or no numbers
        numbers = np.empty(len(cells))
        for k, cell in enumerate(cells):
            try:
                numbers[k] = number_of(str(cell), self.decimal)
            except ValueError:
                advice = cell_advice(str(cell), self.decimal)
                raise ValueError(
                    f"Line {lines[k]} of {str(self.source)!r}, column {name!r}: a number is "
                    f"needed, got {str(cell).strip()!r:.60}; {advice}."
                ) from None
        return numbers

    def check_unit(self, argument: str, names: Sequence[str], unit: str) -> None:
        """Raise if the file states another unit of columns than the declared one."""
        for name in names:
            stated = self.units.get(name, unit)
            if stated != unit:
                raise ValueError(
                    f"`{argument}` must be {stated!r} for column {name!r}, as "
                    f"{self.statement} in {str(self.source)!r}, got {unit!r}; give "
                    f"{argument}={stated!r}, on the command line --{argument.replace('_', '-')} "
                    f"{stated}."
                )

    def values(self, names: list[str], times: Sequence[str]) -> NDArray:
        """Return columns as numbers (N, k), those of times in seconds."""
        columns = {name: self.numbers(name, name in times) for name in names}
        if len(columns) < len(names):
            raise ValueError(f"`q`, `x` and `time` must name a column once, got {names}.")
        sizes = {name: len(column) for name, column in columns.items()}
        if len({*sizes.values()}) > 1:
            raise ValueError(
                f"The columns of {str(self.source)!r} must be equally long, got {sizes}."
            )
        if not all(sizes.values()):
            header = "no" if self.lines is None else "a header but no"
            raise ValueError(f"{str(self.source)!r} has {header} rows.")
        return np.column_stack([*columns.values()])

    def labels(self, argument: str, name: str, n_rows: int) -> NDArray:
        """Return the column of that name as labels of the rows."""
        labels = [str(value).strip() for value in self.column(name)]
        longest = max(map(len, labels), default=0)
        if len(labels) != n_rows or longest > _LONGEST:
            raise ValueError(
                f"`{argument}` must name each of {n_rows} rows in at most {_LONGEST} characters, "
                f"but column {name!r} of {str(self.source)!r} has {len(labels)} rows of up to "
                f"{longest} characters; check the file."
            )
        return np.array(labels)


def without_missing(values: NDArray, missing: ArrayLike, zeros: bool = True) -> None:
    """Set the missing values among columns (N, k) to NaN, in place.

    Zeros are missing only where all three coordinates of a marker are zero, and not without
    `zeros`.
    """
    numbers = real_array(missing, "missing").ravel()
    values[np.isin(values, numbers[numbers != 0.0])] = np.nan
    if zeros and (numbers == 0.0).any() and values.shape[1] % 3 == 0:
        markers = values.reshape(len(values), -1, 3)
        lost = (markers == 0.0).all(axis=2)
        values[lost.repeat(3, axis=1)] = np.nan


def _of_objects(values: NDArray) -> NDArray:
    """Return objects as numbers or dates, NaN or NaT for those that are missing."""
    present = [str(value) not in UNNAMED for value in values]
    dates = [value for value in values if hasattr(value, "timestamp")]
    if dates:  # with a time zone
        seconds = np.full(len(values), np.nan)
        seconds[present] = [value.timestamp() for value in values[present]]
        return (1e9 * seconds).astype("M8[ns]")
    filled = values.copy()
    filled[~np.array(present, dtype=bool)] = np.nan
    return filled
