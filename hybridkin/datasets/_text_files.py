"""Reading of text files with a header line: CSV and its kin."""

from __future__ import annotations

import csv
import itertools
import re
from pathlib import Path

import numpy as np

from hybridkin.datasets._tables import Table

_DELIMITERS = (",", ";", "\t")


def text_table(path: Path, delimiter: str | None) -> Table:
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
    return Table(path, header, columns, np.array(lines[1:], dtype=int))
