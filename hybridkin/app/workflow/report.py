"""A report: one record of numbers, and the text, tables, figures and files about it."""

from __future__ import annotations

import json
import math
import platform
import textwrap
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import is_dataclass
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from hybridkin.app import LogReport
from hybridkin.arguments import as_path
from hybridkin.formats import (
    METRES,
    check_outputs,
    csv_table,
    markdown,
    markdown_block,
    markdown_cell,
    plain,
    visible,
    visible_lines,
    write_files,
)

if TYPE_CHECKING:
    from hybridkin.app.workflow.errors import Errors

Writer = Callable[[Path], object]
"""Writes a file to the path that it is given."""

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""

Record = TypeVar("Record")

_WIDTH = 98
_LEAST_ERROR = 1e-6  # [m]; cameras do not see less
_LEAST_LENGTH = 1e-9  # in files [m]
_COMMAND = "$ "  # how a line that is a command begins


class _Picture(Protocol):
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


def error_in_millimetres(error: float) -> str:
    """Return an error of a solver [m] as text, no digits of it below a micrometre."""
    if 0.0 < error < _LEAST_ERROR:
        return f"below {millimetres(_LEAST_ERROR)}"
    return millimetres(error)


def lengths_for_table(lengths: NDArray, unit: str) -> NDArray:
    """Return lengths (...) [m] as cells of a CSV file in a unit, to a nanometre."""
    decimals = round(math.log10(METRES[unit] / _LEAST_LENGTH))
    rounded = np.round(lengths / METRES[unit], decimals) + 0.0  # no -0
    return np.char.rstrip(np.char.rstrip(np.char.mod(f"%.{decimals}f", rounded), "0"), ".")


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
        Every number of the report; the content of its JSON. ``help(report.record)`` explains it.

    Attributes
    ----------
    paths : list of Path
        The files that were written.
    """

    def __init__(self, title: str, record: Record) -> None:
        self.title = title
        self.record = record
        self.paths: list[Path] = []
        self._blocks: list[_Block] = [_Text("# {title}", {"title": title})]
        self._files: dict[str, Writer] = {}

    def text(self, *paragraphs: str, **names: object) -> None:
        """Add paragraphs of Markdown.

        A user's text is no Markdown: give it by a name, as in
        ``text("Fitted to {log}.", log=path)``. Such a field is shown as text, whatever it holds.
        """
        for paragraph in paragraphs:
            self._blocks.append(_Text(paragraph, names))

    def items(self, lines: Sequence[str]) -> None:
        """Add a list of texts, which are shown as they are."""
        names = {f"line_{k}": line for k, line in enumerate(lines)}
        self.text("\n".join(f"- {{{name}}}" for name in names), **names)

    def verbatim(self, text: str) -> None:
        """Add lines as they are."""
        self._blocks.append(_Verbatim(text))

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table, the first column aligned to the left, the others to the right."""
        self._blocks.append(_Table([header, *rows]))

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

    def figure(self, name: str, figure: _Picture, caption: str) -> None:
        """Add a figure that becomes `name`.png."""
        self._blocks.append(_Figure(name, caption))
        self.file(f"{name}.png", figure.savefig)

    def file(self, name: str, write: Writer) -> None:
        """Add a file; `write` gets its path and writes it."""
        self._files[name] = write

    def table_file(
        self, name: str, header: Sequence[str], rows: Iterable[Sequence[object]]
    ) -> None:
        """Add a CSV file, see `csv_table`."""
        self.file(name, partial(_write_text, text=csv_table(header, rows)))

    def markdown(self) -> str:
        """Return the report as Markdown text."""
        return "\n\n".join(block.markdown() for block in self._blocks) + "\n"

    def plain(self) -> str:
        """Return the report as text for a terminal: without figures, with wrapped lines."""
        texts = [block.plain() for block in self._blocks]
        return "\n\n".join(text for text in texts if text is not None)

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


class _Block(Protocol):
    """A part of a report, in Markdown and as text for a terminal; None: not shown there."""

    def markdown(self) -> str: ...
    def plain(self) -> str | None: ...


class _Text(NamedTuple):
    """A paragraph of Markdown, with fields for texts of a user."""

    template: str
    names: Mapping[str, object]

    def markdown(self) -> str:
        return self._filled(self.template, markdown)

    def plain(self) -> str:
        lines: list[str] = []
        wrapper = textwrap.TextWrapper(_WIDTH, break_on_hyphens=False)
        for line in self.template.replace("**", "").splitlines():
            if line.startswith(_COMMAND):  # a line to copy
                lines.append(self._filled(line, visible))
                continue
            wrapper.subsequent_indent = "  " if line.startswith("- ") else ""
            lines += wrapper.wrap(self._filled(line.lstrip("# "), visible))
        return "\n".join(lines)

    def _filled(self, template: str, show: Callable[[object], str]) -> str:
        if not self.names:
            return template
        shown = {name: show(text) for name, text in self.names.items()}
        return template.format_map(shown)


class _Verbatim(NamedTuple):
    """Lines as they are."""

    text: str

    def markdown(self) -> str:
        return markdown_block(self.text)

    def plain(self) -> str:
        return visible_lines(self.text)


class _Table(NamedTuple):
    """A table; its first row is the header."""

    rows: Sequence[Sequence[str]]

    def markdown(self) -> str:
        return self._aligned(markdown_cell)

    def plain(self) -> str:
        return self._aligned(visible)

    def _aligned(self, show: Callable[[object], str]) -> str:
        header, *rows = [[*map(show, row)] for row in self.rows]
        widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
        rule = ["-" * width for width in widths]
        lines = []
        for name, *cells in [header, rule, *rows]:
            aligned = map(str.rjust, cells, widths[1:])
            line = " | ".join([name.ljust(widths[0]), *aligned])
            lines.append(f"| {line} |")
        return "\n".join(lines)


class _Figure(NamedTuple):
    """A picture beside the report."""

    name: str
    caption: str

    def markdown(self) -> str:
        caption = markdown(self.caption)
        return f"![{caption}]({self.name}.png)\n\n*{caption}*"

    def plain(self) -> None:
        return None


def _write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8", newline="")


def check_out(out: str | Path, command: str, files: Sequence[str] = (), *, force: bool) -> None:
    """Raise, before any work, if `out` cannot be used as a folder for results.

    `files` and a report are replaced only if the report is one of the same command, or by `force`.
    """
    path = as_path(out, "out")
    report = path / "report.json"
    entry = f'"command": "{command}"'
    is_ours = report.is_file() and entry in report.read_text(errors="replace")
    names = (*files, "report.json", "report.md")
    check_outputs([path / name for name in names], command, lambda _: is_ours, force=force)


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
    text = json.dumps(plain(record), indent=2, allow_nan=False, default=_in_json)
    return text.replace("\x7f", "\\u007f")  # the one control character that JSON lets pass


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
