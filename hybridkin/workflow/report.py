"""A report: text, tables, numbers and figures that reach the disk together or not at all."""

from __future__ import annotations

import json
import os
import platform
import shutil
import tempfile
from collections.abc import Callable, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures

from hybridkin.calibration._parameters import parameter
from hybridkin.calibration.calibrate import CalibrationResult

_UNITS = {"bending_stiffness": (1e6, "mm²/rad²"), "axial_stiffness": (1.0, "-")}

TOLD = 10.0
"""The data tell a parameter whose prior they narrow so many times."""

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""


def linear() -> Any:
    """Return the paper's linear model A q + b."""
    return LinearRegression()


def quadratic() -> Any:
    """Return a plain quadratic polynomial by least squares."""
    return make_pipeline(MinMaxScaler((-1, 1)), PolynomialFeatures(2), LinearRegression())


def distance(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances (N,) between points (N, 3)."""
    return np.linalg.norm(a - b, axis=-1)


def geometry_entries(start: Any, result: CalibrationResult) -> list[dict[str, Any]]:
    """Return what a calibration from `start` found, one entry for each free parameter.

    Returns
    -------
    list of dict
        "name"; "unit", "mm", "deg", "mm²/rad²" or "-"; "start", "value" and "std_error" in that
        unit, of the base its turn from the start and its position; "narrowing" and "told".
    """
    entries = []
    narrowing = iter(result.narrowing.tolist())
    for name, value in result.values.items():
        part = parameter(start, name)
        value, std = np.asarray(value), np.ravel(np.asarray(result.std_errors[name]))
        if name == "base":
            first = part.start.numpy()
            turn = Rotation.from_matrix(value[:3, :3] @ first[:3, :3].T).as_rotvec()
            before = np.concatenate([np.zeros(3), first[:3, 3]])
            value = np.concatenate([turn, value[:3, 3]])
        else:
            before = part.value(part.start).numpy().ravel()
        for label, kind, *numbers in zip(
            part.labels, part.kind, before, value.ravel(), std, strict=True
        ):
            scale, unit = (180.0 / np.pi, "deg") if kind == "rad" else _UNITS.get(name, (1e3, "mm"))
            entry = dict(
                zip(("start", "value", "std_error"), scale * np.array(numbers), strict=True)
            )
            told = next(narrowing)
            entries.append({"name": label, "unit": unit, **entry, "narrowing": told})
            entries[-1]["told"] = told >= TOLD
    return entries


def geometry_rows(entries: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return entries of a calibration as rows of a table; see `GEOMETRY_HEADER`."""
    return [
        [
            f"{entry['name']} [{entry['unit']}]",
            *(f"{entry[key]:.2f}" for key in ("start", "value", "std_error")),
            f"{entry['narrowing']:.3g}",
            "yes" if entry["told"] else "no",
        ]
        for entry in entries
    ]


GEOMETRY_HEADER = ("parameter", "start", "calibrated", "standard error", "prior narrowed", "told")


class Report:
    """Markdown blocks, a JSON record and named files, written in one go.

    Parameters
    ----------
    title : str
        Heading of the report.
    """

    def __init__(self, title: str) -> None:
        self.blocks = [f"# {title}"]
        self.record: dict[str, Any] = {"title": title, "versions": versions()}
        self._files: dict[str, Callable[[Path], Any]] = {}

    def text(self, *paragraphs: str) -> None:
        """Add paragraphs."""
        self.blocks.extend(paragraphs)

    def table(self, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
        """Add a table."""
        lines = [header, ["---"] * len(header), *rows]
        self.blocks.append("\n".join("| " + " | ".join(line) + " |" for line in lines))

    def figure(self, name: str, figure: Any, caption: str) -> None:
        """Add a figure that becomes `name`.png."""
        self.blocks.append(f"![{caption}]({name}.png)\n\n*{caption}*")
        self.file(f"{name}.png", lambda path: figure.savefig(path))

    def file(self, name: str, write: Callable[[Path], Any]) -> None:
        """Add a file that `write` makes when handed its path."""
        self._files[name] = write

    def write(self, out: str | Path) -> list[Path]:
        """Write everything into the folder `out` and return the paths.

        All files are made beside `out` first, so that a failure leaves `out` as it was.
        """
        out = Path(out)
        out.parent.mkdir(parents=True, exist_ok=True)
        staging = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
        try:
            for name, write in self._files.items():
                write(staging / name)
            record = json.dumps(self.record, indent=2, default=_plain)
            (staging / "report.json").write_text(record + "\n", encoding="utf-8")
            (staging / "report.md").write_text("\n\n".join(self.blocks) + "\n", encoding="utf-8")
            out.mkdir(exist_ok=True)
            names = [*self._files, "report.json", "report.md"]
            for name in names:
                os.replace(staging / name, out / name)
        finally:
            shutil.rmtree(staging, ignore_errors=True)
        return [out / name for name in names]


def check_out(out: str | Path) -> None:
    """Raise, before any work is done, where `out` cannot become a folder of results."""
    path = Path(out)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"`out` must be a folder, got the file {path}; name another one.")
    home = next(parent for parent in [path, *path.absolute().parents] if parent.exists())
    if not os.access(home, os.W_OK):
        raise PermissionError(f"`out` must be writable, but {home} is not; name another folder.")


def quiet(label: str, done: int, total: int) -> None:
    """Report no progress."""


def _plain(value: Any) -> Any:
    if isinstance(value, (np.ndarray, np.generic, torch.Tensor)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} has no JSON form")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that matter."""
    found = {"python": platform.python_version()}
    for name in ("hybridkin", "torch", "numpy", "scikit-learn", "mujoco"):
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
