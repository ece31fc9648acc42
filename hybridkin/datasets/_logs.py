"""Logs that a user brings: columns of a CSV, npz or parquet file, in SI units."""

from __future__ import annotations

import csv
import difflib
import os
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.units import METRES

__all__ = ["Log", "load_log"]

LENGTHS = {**METRES, "um": 1e-6, "in": 0.0254}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
UNITLESS = {"1": 1.0}

_PARQUET = (".parquet", ".pq")
_DELIMITERS = (",", ";", "\t")


@dataclass(frozen=True, eq=False)
class Log:
    """A measured log: actuator vectors and tip positions, row by row, in SI units.

    Attributes
    ----------
    q : ndarray of shape (N, n)
        Actuator vectors [m], or in the unit that `units` says.
    x : ndarray of shape (N, 3)
        Tip positions [m].
    groups : ndarray of shape (N,) or None
        Motion, run or day of each row.
    time : ndarray of shape (N,) or None
        Time stamps [s].
    line : ndarray of shape (N,) of int or None
        Line of each row in a text file, its number from 0 in other files.
    invalid_lines : ndarray of shape (k,) of int
        The lines that were left out because a value is missing, NaN or infinite.
    q_names, x_names : tuple of str
        Names of the columns.
    q_sign : int or sequence of int
        Factor of the actuator columns of the file.
    units, file_units : mapping of str to str
        Units of "q" and "x" here and in the file.
    source : str
        Where the log comes from.
    """

    q: NDArray
    x: NDArray
    groups: NDArray | None = None
    time: NDArray | None = None
    line: NDArray | None = None
    invalid_lines: Sequence[int] | NDArray = ()
    q_names: Sequence[str] = ()
    x_names: Sequence[str] = ()
    q_sign: ArrayLike = 1
    units: Mapping[str, str] = field(default_factory=lambda: {"q": "m", "x": "m"})
    file_units: Mapping[str, str] = field(default_factory=lambda: {"q": "m", "x": "m"})
    source: str = "in memory"

    def __post_init__(self) -> None:
        if np.ndim(self.q) != 2 or np.shape(self.x) != (len(self.q), 3) or len(self.q) == 0:
            raise ValueError(
                f"A log needs q of shape (N, n) and x of shape (N, 3), got {np.shape(self.q)} and "
                f"{np.shape(self.x)}."
            )

    def rows(self, kept: NDArray | slice) -> Self:
        """Return a log of some of the rows."""
        columns = {name: vars(self)[name] for name in ("q", "x", "groups", "time", "line")}
        return replace(self, **{k: v[kept] for k, v in columns.items() if v is not None})


def load_log(
    path: str | os.PathLike[str],
    q: Sequence[str],
    x: Sequence[str],
    groups: str | None = None,
    *,
    time: str | None = None,
    q_unit: str = "m",
    x_unit: str = "m",
    q_sign: ArrayLike = 1,
    delimiter: str | None = None,
    drop_invalid: bool = False,
) -> Log:
    r"""Return actuator vectors and tip positions from a log: a CSV, npz or parquet file.

    Parameters
    ----------
    path : path-like
        The file. ``.npz`` is read by NumPy, ``.parquet`` and ``.pq`` by pandas with pyarrow or
        fastparquet, anything else as text with a header line.
    q : sequence of str
        Columns of the actuator vector, in the order of the robot model. In an npz file an array
        (N,) is a column; ``"name[2]"`` is column 2 of an array (N, k), ``"name"`` all of them.
    x : sequence of 3 str
        Columns of the tip position.
    groups : str or None, default=None
        Column that names the motion, run or day of a row, for splitting by groups.
    time : str or None, default=None
        Column of the time stamp [s].
    q_unit : {"m", "cm", "mm", "um", "in", "rad", "deg", "1"}, default="m"
        Unit of the actuator columns in the file; lengths become metres and angles radians. "1" is
        left as it is.
    x_unit : {"m", "cm", "mm", "um", "in"}, default="m"
        Unit of the tip columns in the file.
    q_sign : 1, -1 or sequence of them, default=1
        Factor of the actuator columns: -1 where the file counts a pulled tendon as positive, since
        length changes here are negative for shortening.
    delimiter : str or None, default=None
        Separator of a text file. None: comma, semicolon or tab, whichever the header has most of.
    drop_invalid : bool, default=False
        Leave out rows with a missing, NaN or infinite value instead of raising.

    Returns
    -------
    Log
        In SI units; ``groups`` are strings, None like ``time`` if not asked for.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ImportError
        If a parquet file is given and pandas cannot read it.
    ValueError
        If a column is unknown, a cell is not a number, rows are invalid or none is left.

    Warns
    -----
    UserWarning
        If values look like millimetres where metres were declared.

    See Also
    --------
    check_log : What may be wrong with a log, and what to do.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin.datasets import load_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "log.csv"
    ...     _ = path.write_text("a,b,c,X,Y,Z\n1,2,3,10,20,30\n")
    ...     log = load_log(path, q=["a", "b", "c"], x=["X", "Y", "Z"], q_unit="mm", x_unit="mm")
    >>> log.x, log.q_names
    (array([[0.01, 0.02, 0.03]]), ['a', 'b', 'c'])
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a log file, there is none at {str(path)!r}.")
    q, x, columns = _names("q", q), _names("x", x), _columns(path)
    if columns is not None:
        q, x = _expanded(q, columns, path), _expanded(x, columns, path)
    if len(x) != 3:
        raise ValueError(f"`x` must name 3 columns, got {len(x)}: {x}.")
    q_scale = _scale("q_unit", q_unit, {**LENGTHS, **ANGLES, **UNITLESS})
    x_scale = _scale("x_unit", x_unit, LENGTHS)
    sign = _signs(q_sign, len(q))
    wanted = [*q, *x, *([] if time is None else [time])]
    if columns is None:
        labels, values, places, kind = _read_text(path, wanted, groups, delimiter)
    else:
        labels, values, places, kind = _picked(path, wanted, groups, columns)
    invalid = ~np.isfinite(values).all(axis=1)
    if invalid.any() and not drop_invalid:
        first = ", ".join(map(str, places[invalid][:5]))
        raise ValueError(
            f"{invalid.sum()} of {len(values)} rows of {str(path)!r} have a missing, NaN or "
            f"infinite value, the first in {kind} {first}; correct them or leave them out by "
            "drop_invalid=True."
        )
    if invalid.all():
        raise ValueError(
            f"{str(path)!r} has no valid row left: all have a missing, NaN or infinite value."
        )
    valid, n = values[~invalid], len(q)
    if q_unit == "m":
        _warn_if_millimetres("q", valid[:, :n])
    if x_unit == "m":
        _warn_if_millimetres("x", valid[:, n : n + 3])
    return Log(
        valid[:, :n] * q_scale * sign,
        valid[:, n : n + 3] * x_scale,
        groups=None if groups is None else labels[~invalid],
        time=None if time is None else valid[:, -1],
        line=places[~invalid],
        invalid_lines=places[invalid],
        q_names=q,
        x_names=x,
        q_sign=q_sign,
        units={"q": "m" if q_unit in LENGTHS else "rad" if q_unit in ANGLES else "1", "x": "m"},
        file_units={"q": q_unit, "x": x_unit},
        source=str(path),
    )


class _Table(NamedTuple):
    """Columns as read: labels (N,), values (N, k) with NaN for gaps, and where each row stands."""

    labels: NDArray
    values: NDArray
    places: NDArray
    kind: str  # of place: "line" or "row"


def _names(argument: str, names: Sequence[str]) -> list[str]:
    names = [names] if isinstance(names, str) else list(names)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`{argument}` must be column names, got {names!r}.")
    if len(set(names)) < len(names):
        raise ValueError(f"`{argument}` names a column twice: {names}.")
    return names


def _scale(argument: str, unit: str, known: dict[str, float]) -> float:
    if unit not in known:
        raise ValueError(f"`{argument}` must be one of {list(known)}, got {unit!r}.")
    return known[unit]


def _signs(q_sign: ArrayLike, n: int) -> NDArray:
    sign = np.asarray(q_sign, dtype=float)
    if sign.shape not in ((), (n,)) or not np.isin(sign, (-1, 1)).all():
        raise ValueError(f"`q_sign` must be 1 or -1, or one per column of `q`, got {q_sign!r}.")
    return sign


def _delimiter(path: Path) -> str:
    with open(path, encoding="utf-8-sig", errors="replace", newline="") as file:
        header = file.readline()
    return max(_DELIMITERS, key=header.count)


def _read_text(path: Path, wanted: list[str], groups: str | None, delimiter: str | None) -> _Table:
    labels, values, lines = [], [], []
    delimiter = delimiter or _delimiter(path)
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, delimiter=delimiter)
            header = [name.strip() for name in next(reader, [])]
            if not header:
                raise ValueError(f"{str(path)!r} is empty; a header line and rows are needed.")
            columns = [header.index(_column(name, header, path)) for name in wanted]
            group_column = None if groups is None else header.index(_column(groups, header, path))
            for cells in reader:
                if not any(cell.strip() for cell in cells):
                    continue
                line = reader.line_num
                if len(cells) > len(header):
                    raise ValueError(
                        f"Line {line} of {str(path)!r} has {len(cells)} cells, the header "
                        f"{len(header)}; check `delimiter` (now {delimiter!r})."
                    )
                cells += [""] * (len(header) - len(cells))
                values.append([_number(cells[c], header[c], line, path) for c in columns])
                labels.append("" if group_column is None else cells[group_column].strip())
                lines.append(line)
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(
            f"{str(path)!r} is not a text file in UTF-8 ({error}); save the log as CSV, npz or "
            "parquet."
        ) from error
    if not values:
        raise ValueError(f"{str(path)!r} has a header but no rows.")
    return _Table(np.array(labels), np.array(values), np.array(lines), "line")


def _columns(path: Path) -> dict[str, NDArray] | None:
    """Return the columns of an npz or parquet file by name, None of a text file."""
    suffix = path.suffix.lower()
    if suffix == ".npz":
        return _npz_columns(path)
    return _parquet_columns(path) if suffix in _PARQUET else None


def _npz_columns(path: Path) -> dict[str, NDArray]:
    """Return the arrays (N,) of a file, columns of arrays (N, k) as ``name[i]``."""
    columns: dict[str, NDArray] = {}
    try:
        with np.load(path, allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
    except (ValueError, OSError, EOFError, BadZipFile, AttributeError) as error:
        raise ValueError(f"{str(path)!r} is not an npz file of plain arrays: {error}.") from error
    for name, array in arrays.items():
        if array.ndim == 1:
            columns[name] = array
        elif array.ndim == 2:
            columns |= {f"{name}[{i}]": column for i, column in enumerate(array.T)}
    return columns


def _parquet_columns(path: Path) -> dict[str, NDArray]:
    try:
        import pandas as pd

        frame = pd.read_parquet(path)
    except ImportError as error:
        raise ImportError(
            f"{str(path)!r} needs pandas and pyarrow to be read (pip install pandas pyarrow); or "
            "save the log as CSV or npz."
        ) from error
    except (ValueError, OSError) as error:
        raise ValueError(f"{str(path)!r} is not a parquet file: {error}.") from error
    return {str(name): frame[name].to_numpy() for name in frame.columns}


def _expanded(names: list[str], columns: dict[str, NDArray], path: Path) -> list[str]:
    """Return the names of columns, with that of a table (N, k) replaced by those of its columns."""
    found: list[str] = []
    for name in names:
        parts = [c for c in columns if re.fullmatch(rf"{re.escape(name)}\[\d+\]", c)]
        found += [name] if name in columns or not parts else parts
    return [_column(name, [*columns], path) for name in found]


def _picked(
    path: Path, wanted: list[str], groups: str | None, columns: dict[str, NDArray]
) -> _Table:
    asked = [*wanted, *([] if groups is None else [groups])]
    picked = {name: columns[_column(name, [*columns], path)] for name in asked}
    sizes = {name: len(array) for name, array in picked.items()}
    if len(set(sizes.values())) > 1:
        raise ValueError(f"The columns of {str(path)!r} must be equally long, got {sizes}.")
    n = next(iter(sizes.values()))
    if n == 0:
        raise ValueError(f"{str(path)!r} has no rows.")
    values = np.empty((n, len(wanted)))
    for k, name in enumerate(wanted):
        try:
            values[:, k] = picked[name].astype(float)
        except (TypeError, ValueError) as error:
            raise ValueError(
                f"Column {name!r} of {str(path)!r} must hold numbers, got {picked[name].dtype}."
            ) from error
    labels = np.full(n, "") if groups is None else np.array([*map(str, picked[groups])])
    return _Table(labels, values, np.arange(n), "row")


def _column(name: str, header: list[str], path: Path) -> str:
    """Return the name, once it is known to be that of one column."""
    found = header.count(name)
    if found == 1:
        return name
    if found:
        raise ValueError(f"Column {name!r} occurs {found} times in {str(path)!r}; rename it.")
    close = difflib.get_close_matches(name, header, n=3, cutoff=0.4)
    lower = [other for other in header if other.lower() == name.lower()]
    suggestion = f"did you mean {', '.join(map(repr, lower or close))}?" if lower or close else ""
    if len(header) == 1:
        suggestion = "it has one column only, check `delimiter`."
    raise ValueError(
        f"There is no column {name!r} in {str(path)!r}; {suggestion} Its columns: {header}."
    )


def _number(cell: str, name: str, line: int, path: Path) -> float:
    text = cell.strip()
    if not text:
        return np.nan
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"Line {line} of {str(path)!r}, column {name!r}: a number is needed, got {text!r}; "
            "correct the cell (an empty one counts as missing, see `drop_invalid`; decimals take "
            "a point)."
        ) from None


def _warn_if_millimetres(name: str, values: NDArray) -> None:
    if np.median(np.abs(values)) > 10 or np.ptp(values, axis=0).max() > 5:
        warnings.warn(
            f"The `{name}` columns span {np.ptp(values, axis=0).max():.4g} m around "
            f"{np.median(np.abs(values)):.4g} m; if the file has millimetres, give "
            f"{name}_unit='mm'.",
            stacklevel=3,
        )
