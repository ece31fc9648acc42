"""Rows of text tables: their encoding, separator, decimals and cells."""

from __future__ import annotations

import csv
import itertools
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple, TextIO

DECIMALS = (".", ",")
_DELIMITERS = (",", ";", "\t")  # else spaces
_MARKS = {  # first bytes of a file
    b"\xef\xbb\xbf": "utf-8-sig",
    b"\xff\xfe": "utf-16",
    b"\xfe\xff": "utf-16",
}
_WITHOUT_MARK = ("utf-8", "cp1252")  # names with a degree or micro sign
_CONTROL = re.compile(r"[\x00-\x08\x0e-\x1a\x1c-\x1f]")
_NUL = re.compile("\x00")
_CHUNK = 1 << 20  # characters
_HEAD = 100  # lines among which a header is looked for
_MISSING = ("", "null", "na", "n/a", "<na>", "nat", "none")  # in lower case
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+(e[-+]?\d+)?", re.IGNORECASE)


class Row(NamedTuple):
    """The cells of a row, and its line in the file, from 1."""

    line: int
    cells: list[str]


@dataclass(frozen=True)
class TextForm:
    """How numbers and columns are written in a text file.

    Attributes
    ----------
    delimiter : str or None
        Separator of the columns; None: by the header.
    header_line : int or None
        Line of the header, from 1; None: a known block of header lines, or the first line.
    decimal : {".", ","}
        Decimal sign.
    """

    delimiter: str | None = None
    header_line: int | None = None
    decimal: str = "."

    def __post_init__(self) -> None:
        delimiter = self.delimiter
        if delimiter is not None and not _is_character(delimiter):
            raise ValueError(f"`delimiter` must be one character or None, got {delimiter!r:.80}.")
        if self.decimal not in DECIMALS:
            raise ValueError(f'`decimal` must be "." or ",", got {self.decimal!r:.80}.')
        line = self.header_line
        if line is not None and not _is_line(line):
            raise ValueError(
                f"`header_line` must be the number of a line, from 1, or None, got {line!r:.80}."
            )

    def separator(self, lines: Sequence[str]) -> str:
        """Return the separator, by the first of some lines that has one.

        Of several it is one that occurs as often in the next line, else the most frequent.
        """
        if self.delimiter is not None:
            return self.delimiter
        candidates = [sign for sign in _DELIMITERS if sign != self.decimal]
        unquoted = [re.sub('"[^"]*("|$)', "", line) for line in _whole_lines(lines)]
        for line, following in itertools.zip_longest(unquoted, unquoted[1:], fillvalue=""):
            counts = {sign: line.count(sign) for sign in candidates if sign in line}
            as_often = [sign for sign in counts if following.count(sign) == counts[sign]]
            if counts:
                return max(as_often or counts, key=counts.__getitem__)
        first = "".join(lines[:1]).strip()
        if " " in first and _DELIMITERS[0] not in first:
            return " "
        return _DELIMITERS[0]


def _whole_lines(lines: Sequence[str]) -> Iterator[str]:
    """Yield lines, those that a quoted cell goes across as one."""
    begun = ""
    for line in lines:
        begun += line
        if begun.count('"') % 2 == 0:
            yield begun
            begun = ""
    if begun:
        yield begun


def _is_character(value: object) -> bool:
    return isinstance(value, str) and len(value) == 1


def _is_line(value: object) -> bool:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 1


class TextFile(NamedTuple):
    """A text file and its encoding."""

    path: Path
    encoding: str

    @classmethod
    def of(cls, path: Path) -> TextFile:
        """Return a file with its encoding: by its mark, else UTF-8, else that of Windows."""
        with open(path, "rb") as file:
            start = file.read(4)
        encodings = [name for mark, name in _MARKS.items() if start.startswith(mark)]
        for encoding in encodings or _WITHOUT_MARK:
            if _is_text(path, encoding):
                return cls(path, encoding)
        raise ValueError(f"{str(path)!r} is not a text file; save it as CSV.")

    def open(self) -> TextIO:
        """Return the opened file, with the ends of its lines."""
        return open(self.path, encoding=self.encoding, newline="")

    def head(self) -> list[str]:
        """Return its first lines."""
        with open(self.path, encoding=self.encoding) as file:
            return [line.rstrip("\n") for line in itertools.islice(file, _HEAD)]

    def rows(self, delimiter: str) -> Iterator[Row]:
        """Yield the rows that are not blank."""
        try:
            with self.open() as file:
                # Several spaces separate two cells only.
                several = delimiter == " "
                reader = csv.reader(file, delimiter=delimiter, skipinitialspace=several)
                for cells in reader:
                    if any(map(str.strip, cells)):
                        yield Row(reader.line_num, cells)
        except csv.Error as error:
            raise ValueError(
                f"{str(self.path)!r} does not close a quote ({error}); save the log as CSV, npz "
                "or parquet."
            ) from error


def _is_text(path: Path, encoding: str) -> bool:
    # Nearly any byte is a letter of Windows: other files are recognised by control characters.
    impossible = _CONTROL if encoding == "cp1252" else _NUL
    try:
        with open(path, encoding=encoding, newline="") as file:
            while text := file.read(_CHUNK):
                if impossible.search(text):
                    return False
    except UnicodeError:
        return False
    return True


def number_of(cell: str, decimal: str = ".") -> float:
    """Return the number in a cell, NaN for a missing one; a ValueError if it holds none."""
    text = cell.strip()
    if text.lower() in _MISSING:
        return float("nan")
    if decimal == ",":
        if "." in text:
            raise ValueError(f"a point in {text!r}, where decimals have a comma")
        text = text.replace(",", ".")
    return float(text)


def has_decimal_comma(cell: str) -> bool:
    """Return whether a cell looks like a number with a decimal comma."""
    return _DECIMAL_COMMA.fullmatch(cell.strip()) is not None


def cell_advice(cell: str, decimal: str) -> str:
    """Return what to do with a cell that holds no number."""
    if decimal == "." and has_decimal_comma(cell):
        return 'its decimals have a comma: give decimal="," (--decimal ,)'
    if decimal == "," and "." in cell:
        return 'its decimals have a point: leave out decimal="," (--decimal ,)'
    return (
        "correct the cell (an empty cell is a missing value, see `drop_invalid`; a number that "
        "stands for one is named by `missing`)"
    )


def is_number(cell: str) -> bool:
    """Return whether a cell holds a number, with a point or a comma, or nothing."""
    try:
        number_of(cell)
    except ValueError:
        return has_decimal_comma(cell)
    return True


def likely_header(lines: Sequence[str]) -> int:
    """Return the number of the line, from 1, that looks like names above numbers; 0: none does."""
    best = 0
    most_cells = 1
    for delimiter in _DELIMITERS:
        rows = [
            Row(line, cells)
            for line, cells in enumerate(csv.reader(lines, delimiter=delimiter), 1)
            if any(map(str.strip, cells))
        ]
        for k, row in enumerate(rows):
            names = [cell for cell in row.cells if cell.strip()]
            if len(names) > most_cells and _above_numbers(rows, k):
                best = row.line
                most_cells = len(names)
    return best


def _above_numbers(rows: Sequence[Row], k: int) -> bool:
    """Return whether a row holds no number, but the next, or that below units, mostly does."""
    if any(cell.strip() and is_number(cell) for cell in rows[k].cells):
        return False
    for row in rows[k + 1 : k + 3]:
        if len(row.cells) != len(rows[k].cells):
            return False
        n_numbers = sum(map(is_number, row.cells))
        n_filled = sum(cell.strip() != "" for cell in row.cells)
        if 2 * n_numbers >= len(row.cells) and n_filled > 1 and _has_number(row):
            return True
    return False


def _has_number(row: Row) -> bool:
    return any(cell.strip() and is_number(cell) for cell in row.cells)
