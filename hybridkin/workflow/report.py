"""A report: one record of numbers, and the text, tables, figures and files about it."""

from __future__ import annotations

import json
import math
import os
import platform
import textwrap
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

from numpy.typing import NDArray

from hybridkin._core.arrays import as_path
from hybridkin._core.files import Writer, write_files
from hybridkin._core.stored import plain
from hybridkin.datasets import LogReport

if TYPE_CHECKING:
    from hybridkin.workflow.errors import Errors

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""

Record = TypeVar("Record")

_WIDTH = 98
_FENCE = "```"


class _Figure(Protocol):
    def savefig(self, path: Path, /) -> object: ...


class _Column(NamedTuple):
    """A column of a table of errors."""

    title: str
    factor: float = 1e3  # from metres
    form: str = ".2f"


_COLUMNS = {
    "rows": _Column("rows", 1.0, ".0f"),
    "promised": _Column("promised mean"),
    "promised_p95": _Column("promised 95 %"),
    "std": _Column("std over rows"),
    "p95": _Column("95 %"),
    "std_folds": _Column("std over folds"),
    "std_error": _Column("std error (motions)"),
    "share_in_domain": _Column("in domain [%]", 100.0, ".0f"),
    "share_in_radius": _Column("in radius [%]", 100.0, ".0f"),
}


def millimetres(length: float, form: str = ".3g") -> str:
    """Return a length [m] as text."""
    return f"{1e3 * length:{form}} mm"


def percent(share: float) -> str:
    """Return a share from 0 to 1 as text."""
    return f"{100.0 * share:.0f} %"


def listed(numbers: Sequence[float] | NDArray, form: str) -> str:
    """Return numbers as text, separated by commas."""
    return ", ".join(f"{number:{form}}" for number in numbers)


def point_in_millimetres(point: NDArray) -> str:
    """Return a point [m] as text."""
    return f"({listed(1e3 * point, '.4g')}) mm"


class Report(Generic[Record]):
    """A record, and what is said and shown about it.

    Parameters
    ----------
    title : str
        Heading of the report.
    record : dataclass or dict
        Every number of the report; the content of its JSON.

    Attributes
    ----------
    paths : list of Path
        The files that were written.
    """

    def __init__(self, title: str, record: Record) -> None:
        self.title = title
        self.record = record
        self.paths: list[Path] = []
        self._blocks = [f"# {title}"]
        self._files: dict[str, Writer] = {}

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs."""
        self._blocks += paragraphs

    def verbatim(self, text: str) -> None:
        """Add lines as they are."""
        self._blocks.append(f"{_FENCE}\n{text}\n{_FENCE}")

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table, the first column aligned to the left, the others to the right."""
        widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
        rule = ["-" * width for width in widths]
        lines = []
        for name, *cells in [header, rule, *rows]:
            aligned = map(str.rjust, cells, widths[1:])
            line = " | ".join([name.ljust(widths[0]), *aligned])
            lines.append(f"| {line} |")
        self._blocks.append("\n".join(lines))

    def errors(self, entries: Mapping[str, Errors], columns: Sequence[str]) -> None:
        """Add a table of tip errors [mm] by name; `columns` are attributes of the errors."""
        shown = [_COLUMNS.get(name, _Column(name)) for name in columns]
        rows = []
        for name, entry in entries.items():
            row = [name]
            for key, column in zip(columns, shown, strict=True):
                value = getattr(entry, key, math.nan)
                text = f"{column.factor * value:{column.form}}"
                row.append(text.replace("nan", "-"))
            rows.append(row)
        self.table(["tip error [mm]", *(column.title for column in shown)], rows)

    def figure(self, name: str, figure: _Figure, caption: str) -> None:
        """Add a figure that becomes `name`.png."""
        self._blocks.append(f"![{caption}]({name}.png)\n\n*{caption}*")
        self.file(f"{name}.png", figure.savefig)

    def file(self, name: str, write: Writer) -> None:
        """Add a file; `write` gets its path and writes it."""
        self._files[name] = write

    def markdown(self) -> str:
        """Return the report as Markdown text."""
        return "\n\n".join(self._blocks) + "\n"

    def plain(self) -> str:
        """Return the report as text for a terminal: without figures, with wrapped lines."""
        texts = []
        for block in self._blocks:
            if block.startswith(_FENCE):
                texts.append(block.strip(f"{_FENCE}\n"))
            elif block.startswith("|"):
                texts.append(block)
            elif not block.startswith("!["):
                texts.append(_wrapped(block))
        return "\n\n".join(texts)

    def json(self) -> str:
        """Return the record as JSON, with the title, versions and the written files."""
        return json_text(self._content() | {"written": self.paths})

    def write(self, out: str | Path) -> list[Path]:
        """Write everything into the folder `out` and return the paths.

        The report is the last file. A killed process leaves whole files, old or new ones.
        """
        record = json_text(self._content()) + "\n"
        files = dict(self._files)
        files["report.json"] = partial(_write_text, text=record)
        files["report.md"] = partial(_write_text, text=self.markdown())
        write_files(out, files)
        self.paths = [Path(out) / name for name in files]
        return self.paths

    def _content(self) -> dict[str, Any]:
        return {
            "title": self.title,
            "versions": versions(),
            **_fields(self.record),
        }


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def _wrapped(text: str) -> str:
    """Return lines of Markdown as text, wrapped to the width of a terminal."""
    lines: list[str] = []
    wrapper = textwrap.TextWrapper(_WIDTH, break_on_hyphens=False)
    for line in text.replace("**", "").splitlines():
        wrapper.subsequent_indent = "  " if line.startswith("- ") else ""
        lines += wrapper.wrap(line.lstrip("# "))
    return "\n".join(lines)


def check_out(
    out: str | Path, command: str, files: Sequence[str] = (), *, force: bool
) -> None:
    """Raise, before any work, if `out` cannot be used as a folder for results.

    `files` and a report are replaced only if the report is one of the same command, or by `force`.
    """
    path = as_path(out, "out")
    folder = path.absolute()
    while not folder.exists():
        folder = folder.parent
    if not folder.is_dir() or not os.access(folder, os.W_OK):
        raise OSError(
            f"`out` must be a folder that can be written, got {path}; name another one."
        )
    report = path / "report.json"
    entry = f'"command": "{command}"'
    if force or (report.is_file() and entry in report.read_text(errors="replace")):
        return
    names = (*files, "report.json", "report.md")
    present = [name for name in names if (path / name).exists()]
    if present:
        raise FileExistsError(
            f"`out` {path} has {', '.join(present)}, not written by `hybridkin {command}`; name "
            "another folder, or replace them with --force."
        )


def quiet(label: str, done: int, total: int) -> None:
    """Ignore progress."""


def json_text(record: object) -> str:
    """Return a record as JSON; numbers that are not finite become null.

    Parameters
    ----------
    record : dict or dataclass
        Numbers, strings, paths, arrays, and lists, dicts and dataclasses of them.

    Returns
    -------
    str
        JSON text.
    """
    return json.dumps(plain(record), indent=2, allow_nan=False, default=_in_json)


def _in_json(value: object) -> Any:
    return plain(_fields(value)) if is_dataclass(value) else str(value)


def _fields(record: object) -> dict[str, Any]:
    """Return what JSON shows of a dict or dataclass."""
    if isinstance(record, dict):
        return record
    return record.to_dict() if isinstance(record, LogReport) else vars(record)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the main packages."""
    versions = {"python": platform.python_version()}
    for name in ("hybridkin", "torch", "numpy", "scikit-learn", "mujoco"):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions
