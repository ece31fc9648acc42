"""The figures of a study as a CSV file beside its report."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from hybridkin.app.workflow.report import Report


def add_csv(
    report: Report, name: str, header: Sequence[str], rows: Sequence[Sequence[Any]]
) -> None:
    """Add a CSV file with a header to a report.

    Parameters
    ----------
    report : Report
        Writes the file with its other ones.
    name : str
        Name of the file.
    header : sequence of str
        Names of the columns, with units.
    rows : sequence of sequence
        One for each line; numbers are written with two digits behind the point.
    """
    report.file(name, partial(_write, header=header, rows=rows))


def _write(path: Path, header: Sequence[str], rows: Sequence[Sequence[Any]]) -> None:
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows([_text(cell) for cell in row] for row in rows)


def _text(cell: Any) -> str:
    return f"{cell:.2f}" if isinstance(cell, float) else str(cell)
