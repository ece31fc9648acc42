"""A report: text, tables, numbers and figures, and the files they are written to."""

from __future__ import annotations

import json
import math
import os
import platform
import textwrap
from collections.abc import Callable, Sequence
from contextlib import suppress
from functools import partial
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures

from hybridkin._core.arrays import as_path
from hybridkin._core.files import write_files
from hybridkin._core.stored import plain
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain

_WIDTH = 98
_Unit = tuple[float, str]  # factor from SI, and name
_MILLIMETRES: _Unit = (1e3, "mm")
_DEGREES: _Unit = (180.0 / np.pi, "deg")
_UNITS: dict[str, _Unit] = {
    "bending_stiffness": (1e6, "mm²/rad²"),
    "axial_stiffness": (1.0, "-"),
    "gains": (1.0, "m/unit of q"),
    "gain": (1.0, "m/unit of q"),
    "angles": _DEGREES,
    "turns": _DEGREES,
    "rest_bends": _DEGREES,
}

_COLUMNS = {  # of tables of errors: heading, factor, format; others in mm
    "rows": ("rows", 1, ".0f"),
    "promised": ("promised mean", 1e3, ".2f"),
    "promised_p95": ("promised 95 %", 1e3, ".2f"),
    "std": ("std over rows", 1e3, ".2f"),
    "p95": ("95 %", 1e3, ".2f"),
    "std_folds": ("std over folds", 1e3, ".2f"),
    "std_error": ("std error (motions)", 1e3, ".2f"),
    "share_in_domain": ("in domain [%]", 100, ".0f"),
    "share_in_radius": ("in radius [%]", 100, ".0f"),
}

IDENTIFIED = 10.0
"""A parameter is identified by the data if they narrow its prior at least this many times, and if
it and the others of its kind stay physical."""

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""


def quadratic() -> Any:
    """Return a plain quadratic polynomial by least squares."""
    return make_pipeline(
        MinMaxScaler((-1, 1)), PolynomialFeatures(2), LinearRegression()
    )


def statistics(errors: NDArray, motions: NDArray | None = None) -> dict[str, Any]:
    """Return mean, standard deviation, median, 95 % quantile and maximum of errors (N,).

    With the motion of every row (N,) also "std_error", the standard error of the mean over
    motions, because rows of a motion have similar errors.

    References
    ----------
    Cochran, Sampling Techniques (1977), chapter 9A: clusters of unequal sizes.
    """
    spread = {"mean": errors.mean(), "std": errors.std(), "median": np.median(errors)}
    if motions is not None:
        sums = np.bincount(
            np.unique(motions, return_inverse=True)[1], errors - errors.mean()
        )
        spread["std_error"] = np.sqrt(
            len(sums) * (sums @ sums) / (len(sums) - 1)
        ) / len(errors)
    return {**spread, "p95": np.percentile(errors, 95), "max": errors.max()}


def millimetres(lengths: Sequence[float]) -> str:
    """Return the largest of some lengths [m] as text."""
    return f"{1e3 * max(lengths):.3g} mm"


def in_millimetres(point: NDArray) -> str:
    """Return a point [m] as text."""
    return f"({', '.join(f'{1e3 * v:.4g}' for v in point)}) mm"


def geometry_entries(start: Chain, result: CalibrationResult) -> list[dict[str, Any]]:
    """Return the result of a calibration from `start`, one entry for each free parameter.

    Returns
    -------
    list of dict
        "name"; "unit", "mm", "deg", "mm²/rad²" or "-", for gains "m/unit of q"; "start", "value"
        and "std_error" in that unit, for the base its rotation from the start and its position;
        "narrowing", "physical" and "identified".
    """
    columns: list[tuple[Any, ...]] = []
    for name, value in result.values.items():
        physical = name not in result.unphysical
        before, after, units = _values(start, name, np.asarray(value))
        errors = np.ravel(result.std_errors[name])
        for numbers in zip(units, before.ravel(), after.ravel(), errors, strict=True):
            columns.append((physical, *numbers))
    entries = []
    for label, narrowing, (physical, (scale, unit), before, after, error) in zip(
        result.names, result.narrowing.tolist(), columns, strict=True
    ):
        entries.append(
            {
                "name": label,
                "unit": unit,
                "start": scale * before,
                "value": scale * after,
                "std_error": scale * error,
                "narrowing": narrowing,
                "physical": physical,
                "identified": physical and narrowing >= IDENTIFIED,
            }
        )
    return entries


def _values(
    start: Chain, name: str, value: NDArray
) -> tuple[NDArray, NDArray, list[_Unit]]:
    """Return a parameter before and after its calibration, and the unit of every number."""
    before = _start_value(start, name)
    if name == "base":
        turn = Rotation.from_matrix(value[:3, :3] @ before[:3, :3].T).as_rotvec()
        after = np.append(turn, value[:3, 3])
        return (
            np.append(np.zeros(3), before[:3, 3]),
            after,
            3 * [_DEGREES] + 3 * [_MILLIMETRES],
        )
    unit: _Unit = _UNITS.get(name, _MILLIMETRES)
    if name == "actuator_zeros" and isinstance(start, ArcChain) and not start.in_metres:
        unit = (1.0, "units of q")
    return before, value, value.size * [unit]


def _start_value(start: Chain, name: str) -> NDArray:
    """Return the start value of a parameter of `calibrate`."""
    geometry = {
        key: value.detach().cpu().numpy() for key, value in start.geometry().items()
    }
    if name == "turns" and isinstance(
        start, ArcChain
    ):  # the angle of each ring's first actuator
        counts = np.array(start.actuators_per_segment)
        return geometry["angles"][np.cumsum(counts) - counts]
    if name == "tool" and name not in geometry:
        return geometry["offsets"][-1:]
    if name == "gain":
        return geometry["gains"][:1]
    return geometry[name]


class Report:
    """Markdown blocks, a JSON record and named files.

    Parameters
    ----------
    title : str
        Heading of the report.
    """

    def __init__(self, title: str) -> None:
        self.record: dict[str, Any] = {"title": title, "versions": versions()}
        # As Markdown, and text or header and rows of a table.
        self._blocks: list[
            tuple[str, str | tuple[Sequence[str], Sequence[Sequence[str]]]]
        ] = []
        self._files: dict[str, Callable[[Path], Any]] = {}
        self.text(f"# {title}")

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs."""
        self._blocks += [(text, _wrapped(text)) for text in paragraphs]

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table."""
        ruled = [header, ["---"] * len(header), *rows]
        markdown = "\n".join("| " + " | ".join(line) + " |" for line in ruled)
        self._blocks.append((markdown, (header, rows)))

    def errors(self, record: dict[str, dict[str, Any]], columns: Sequence[str]) -> None:
        """Add a table of tip errors [mm] by name, with some of their `statistics`."""
        header = ["tip error [mm]"]
        rows = [[name] for name in record]
        for key in columns:
            title, factor, form = _COLUMNS.get(key, (key, 1e3, ".2f"))
            header.append(title)
            for row, entry in zip(rows, record.values(), strict=True):
                text = f"{factor * entry.get(key, math.nan):{form}}"
                row.append(text.replace("nan", "-"))
        self.table(header, rows)

    def geometry(self, entries: Sequence[dict[str, Any]]) -> None:
        """Add a table of calibrated parameters, see `geometry_entries`."""
        header = [
            "parameter",
            "start",
            "calibrated",
            "standard error",
            "prior narrowed by",
        ]
        rows = []
        for entry in entries:
            identified = "yes" if entry["identified"] else "no"
            row = [f"{entry['name']} [{entry['unit']}]"]
            row += [f"{entry[key]:.2f}" for key in ("start", "value", "std_error")]
            row.append(f"{entry['narrowing']:.3g}")
            row.append(identified if entry["physical"] else "not physical")
            rows.append(row)
        self.table([*header, "identified"], rows)

    def figure(self, name: str, figure: Any, caption: str) -> None:
        """Add a figure that becomes `name`.png."""
        self._blocks.append((f"![{caption}]({name}.png)\n\n*{caption}*", ""))
        self.file(f"{name}.png", figure.savefig)

    def markdown(self) -> str:
        """Return the report as Markdown text."""
        return "\n\n".join(markdown for markdown, _ in self._blocks) + "\n"

    def plain(self, table: Callable[..., str] | None = None) -> str:
        """Return the report as text; `table` makes text of header and rows, by default aligned."""
        if table is None:
            table = _aligned
        texts = []
        for _, block in self._blocks:
            texts.append(block if isinstance(block, str) else table(*block))
        return "\n\n".join(filter(None, texts))

    def file(self, name: str, write: Callable[[Path], Any]) -> None:
        """Add a file; `write` gets its path and writes it."""
        self._files[name] = write

    def write(self, out: str | Path) -> list[Path]:
        """Write everything into the folder `out` and return the paths.

        The report is the last file. A killed process leaves whole files, old or new ones.
        """
        files = dict(self._files)
        files["report.json"] = partial(_write_text, text=json_text(self.record) + "\n")
        files["report.md"] = partial(_write_text, text=self.markdown())
        write_files(out, files)
        return [Path(out) / name for name in files]


def _aligned(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table as text, the first column aligned to the left, the others to the right."""
    widths = [max(map(len, column)) for column in zip(header, *rows, strict=True)]
    lines = []
    for name, *cells in [header, *rows]:
        aligned = map(str.rjust, cells, widths[1:])
        lines.append("  " + "  ".join([name.ljust(widths[0]), *aligned]))
    return "\n".join(lines)


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
    if path.exists() and not path.is_dir():
        raise FileExistsError(
            f"`out` must be a folder, got the file {path}; name another one."
        )
    home = next(
        parent for parent in [path, *path.absolute().parents] if parent.exists()
    )
    if not os.access(home, os.W_OK):
        raise PermissionError(
            f"`out` must be writable, but {home} is not; name another folder."
        )
    report = path / "report.json"
    entry = f'"command": "{command}"'
    if force or (report.is_file() and entry in report.read_text(errors="replace")):
        return
    there = [
        name for name in (*files, report.name, "report.md") if (path / name).exists()
    ]
    if there:
        raise FileExistsError(
            f"`out` {path} has {', '.join(there)}, not written by `hybridkin {command}`; name "
            "another folder, or replace them with --force."
        )


def quiet(label: str, done: int, total: int) -> None:
    """Ignore progress."""


def json_text(record: object) -> str:
    """Return a record as JSON; numbers that are not finite become null.

    Parameters
    ----------
    record : dict
        Numbers, strings, paths, arrays, and lists and dicts of them.

    Returns
    -------
    str
        JSON text.
    """
    return json.dumps(plain(record), indent=2, allow_nan=False, default=str)


def versions() -> dict[str, str]:
    """Return the versions of Python and of the main packages."""
    versions = {"python": platform.python_version()}
    for name in ("hybridkin", "torch", "numpy", "scikit-learn", "mujoco"):
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions
