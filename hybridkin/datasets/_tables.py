"""Tables as files hold them: named columns, and their conversion to numbers and labels."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.texts import csv_cell

_LONGEST = 256  # characters of a motion's name


class Table(NamedTuple):
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
                numbers.append(number_of(str(cell), name, line, self.path))
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


def number_of(cell: str, name: str, line: int, path: Path) -> float:
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
