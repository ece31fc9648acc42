"""Figures of the examination as CSV, and the page made of them.

A folder of figures holds runs.csv, with a line for every file: where its figures are from, and the
files that it names. A part writes PART.csv; files PART_OTHER.csv belong to the same section of the
page. Figures of by-hand examinations, and tables of before parts wrote CSV, stand there as well.
"""

from __future__ import annotations

import csv
import platform
import re
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields
from datetime import date
from importlib.metadata import version
from pathlib import Path

from _line import Line

ROOT = Path(__file__).parents[2]
COMMITTED = ROOT / "docs" / "data" / "examination"
PAGE = ROOT / "docs" / "reference" / "reliability_report.md"
PACKAGES = ("torch", "numpy", "scipy", "scikit-learn")
HEADER = ("what", "figure", "holds")
HOLDS = {True: "yes", False: "NO", None: "not run"}

BEGINNING = """# Reliability report

For those who check what [Reliability](reliability.md) says: all figures of the full examination.
This page is generated from docs/data/examination by the following command; edit the data instead.

```console
python tests/examination report
```

`python tests/examination PART --full --out docs/data/examination` examines a part again and
replaces its figures. All robots are simulated."""


@dataclass(frozen=True)
class Run:
    """Where the figures of a file are from, a line of runs.csv."""

    file: str
    command: str
    date: str
    seconds: str
    machine: str
    versions: str
    about: str

    @property
    def part(self) -> str:
        """What was examined."""
        return self.file.removesuffix(".csv").partition("_")[0]

    @property
    def origin(self) -> str:
        """Command, date, machine and versions, on one line."""
        took = f"{self.seconds} s" if self.seconds else ""
        told = (f"`{self.command}`", self.date, took, self.machine, self.versions)
        return ", ".join(entry for entry in told if entry.strip("`"))


COLUMNS = tuple(field.name for field in fields(Run))


def runs_in(folder: Path) -> list[Run]:
    """Return the lines of runs.csv, none where there is no such file."""
    path = folder / "runs.csv"
    if not path.is_file():
        return []
    with open(path, newline="", encoding="utf-8") as file:
        return [Run(**row) for row in csv.DictReader(file)]


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Write a table with a header."""
    with open(path, "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(header)
        writer.writerows(rows)


def write_part(
    folder: Path, part: str, command: str, about: str, seconds: float, lines: Sequence[Line]
) -> None:
    """Write the lines of a part, and where they are from; the same part before is replaced."""
    name = f"{part}.csv"
    write_csv(folder / name, HEADER, [(x.what, x.figure, HOLDS[x.holds]) for x in lines])
    run = Run(
        file=name,
        command=command,
        date=date.today().isoformat(),
        seconds=f"{seconds:.0f}",
        machine=f"{platform.machine()} {platform.system()}",
        versions=", ".join(
            [f"Python {platform.python_version()}", *(f"{p} {version(p)}" for p in PACKAGES)]
        ),
        about=about,
    )
    runs = runs_in(folder)
    places = [k for k, other in enumerate(runs) if other.file == name]
    if places:
        runs[places[0]] = run
    else:
        runs.append(run)
    write_csv(folder / "runs.csv", COLUMNS, [astuple(run) for run in runs])


def sections(folder: Path, parts: Sequence[str] = ()) -> str:
    """Return the sections of some parts, or of all in the order of runs.csv, as Markdown."""
    runs = runs_in(folder)
    texts = []
    for part in parts or dict.fromkeys(run.part for run in runs):
        texts.append(f"## {part.capitalize()}")
        of_part = [run for run in runs if run.part == part]
        origin = ""
        for run in of_part:
            texts.append(run.about)
            if run.origin != origin:
                texts.append(run.origin)
            texts.append(table(folder / run.file))
            origin = run.origin
        if not of_part:
            texts.append("This part ended without a result.")
    return "\n\n".join(text for text in texts if text)


def table(path: Path) -> str:
    """Return a CSV file as a table of Markdown."""
    with open(path, newline="", encoding="utf-8") as file:
        header, *rows = csv.reader(file)
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(f"| {' | '.join(map(_cell, line))} |" for line in lines)


def _cell(text: str) -> str:
    """Return a text as a cell, in which a bar ends no cell."""
    return re.sub(r"\s+", " ", text.replace("|", r"\|"))


def page() -> str:
    """Return the page of the committed figures."""
    return f"{BEGINNING}\n\n{sections(COMMITTED)}\n"
