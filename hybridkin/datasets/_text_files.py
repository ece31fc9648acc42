"""Reading of text files with one or several header lines: CSV and its kin."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybridkin._core.text_rows import (
    Row,
    TextFile,
    TextForm,
    likely_header,
    number_of,
)
from hybridkin.datasets._header_blocks import KINDS, TIME, Header, Plain
from hybridkin.datasets._tables import Table


def text_table(path: Path, form: TextForm) -> Table:
    """Return the columns of a text file, as text."""
    file = TextFile.of(path)
    head = file.head()
    first = 0 if form.header_line is None else form.header_line - 1
    delimiter = form.separator(head[first:])
    rows = list(file.rows(delimiter))
    if form.header_line is None:
        header = _found_header(path, rows, head)
    else:
        header = _given_header(path, rows, form.header_line)
    table = _Rows(path, rows[header.rows], header, delimiter)
    table.check_quotes()
    columns = table.columns()
    lines = np.array([row.line for row in table.rows], dtype=int)
    names = header.names[: len(columns)]
    if header.rate > 0.0 and columns:
        names.append(TIME)
        columns.append(_times(names, columns, header.rate))
    return Table(
        path,
        names,
        columns,
        lines,
        decimal=form.decimal,
        units=header.units,
        statement=header.statement,
    )


def _found_header(path: Path, rows: Sequence[Row], head: Sequence[str]) -> Header:
    """Return the header of a known kind, else that of the first line."""
    if not rows:
        raise ValueError(f"{str(path)!r} is empty; a header line and rows are needed.")
    kind = next(kind for kind in KINDS if kind.recognises(rows))
    line = likely_header(head)
    if isinstance(kind, Plain) and line > rows[0].line:
        raise ValueError(
            f"{str(path)!r} does not begin with names of columns, but line {line} looks like the "
            f"header: {head[line - 1].strip():.200}; give header_line={line} "
            f"(--header-line {line})."
        )
    return kind.header(rows)


def _given_header(path: Path, rows: Sequence[Row], line: int) -> Header:
    """Return the header in a line that the user names."""
    below = [row for row in rows if row.line >= line]
    if not below:
        raise ValueError(
            f"`header_line` must be a line of {str(path)!r}, got {line}; the last line with cells "
            f"is {rows[-1].line if rows else 0}."
        )
    header = Plain().header(below)
    return Header(header.line, header.names, slice(len(rows) - len(below) + 1, None))


class _Rows:
    """The rows below a header, which must fit its columns."""

    def __init__(self, path: Path, rows: list[Row], header: Header, delimiter: str) -> None:
        self.path = path
        self.header = header
        self.delimiter = delimiter
        self.rows = rows

    def check_quotes(self) -> None:
        """Raise if a cell with line breaks has as many delimiters as a row, so it hides one."""
        n = len(self.header.names)
        for row in self.rows:
            text = self.delimiter.join(row.cells)
            n_lines = len(text.splitlines()) - 1
            if n_lines > 0 and text.count(self.delimiter) >= len(row.cells) + n - 2:
                raise ValueError(
                    f'A quote (") in line {row.line - n_lines} of {str(self.path)!r} hides rows up '
                    f"to line {row.line}; close or remove it."
                )

    def columns(self) -> list[Sequence[str]]:
        """Return the columns that have a name, or a cell that is not empty.

        Empty cells at the end of the header or of a row are a separator at the end of the line. A
        last row that is too short was cut off while it was written: all its cells are missing.
        """
        names = self.header.names
        n_named = len(names)
        while n_named and not names[n_named - 1]:
            n_named -= 1
        cells = []
        for row in self.rows:
            n_cells = len(row.cells)
            if n_cells >= n_named and not any(map(str.strip, row.cells[n_named:])):
                cells.append(row.cells[:n_named])
            elif n_cells < n_named and row is self.rows[-1] and len(self.rows) > 1:
                cells.append([""] * n_named)
            else:
                raise ValueError(self._misfit(row, n_named))
        if not cells:
            return [()] * n_named
        return list(zip(*cells, strict=True))

    def _misfit(self, row: Row, n_named: int) -> str:
        """Return the message that a row does not fit the header, with both counts."""
        n_cells = len(row.cells)
        while n_cells > n_named and not row.cells[n_cells - 1].strip():
            n_cells -= 1
        advice = "name every column once, and write an empty cell for a missing value"
        if n_cells == n_named - 1:
            advice = "delete the name without a column, or write an empty cell for a missing value"
        if n_cells == n_named + 1:
            advice = (
                "if the rows begin with an index without a name, save the table without it "
                "(index=False), or name it in the header"
            )
        if self.delimiter == "," and n_cells == 2 * n_named:
            advice = (
                "if decimals have a comma, save the table with semicolons, and give decimal="
                '"," (--decimal ,)'
            )
        return (
            f"The header (line {self.header.line}) of {str(self.path)!r} names {n_named} columns, "
            f"but line {row.line} has {n_cells} cells; {advice}, or check `delimiter` (now "
            f"{self.delimiter!r})."
        )


def _times(names: Sequence[str], columns: Sequence[Sequence[str]], rate: float) -> list[str]:
    """Return the times [s] of frames, without their numbers those of successive rows."""
    frames: Sequence[str] = [str(k) for k in range(len(columns[0]))]
    if "Frame" in names:
        frames = columns[names.index("Frame")]
    return [f"{number_of(frame) / rate:.9g}" for frame in frames]
