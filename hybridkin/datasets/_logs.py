"""Logs that a user brings: columns of a CSV, npz or parquet file, in SI units."""

from __future__ import annotations

import csv
import difflib
import os
import re
import warnings
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple
from zipfile import BadZipFile

import numpy as np
from numpy.typing import ArrayLike, NDArray
from sklearn.utils import Bunch

__all__ = ["load_csv", "load_log"]

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
UNITLESS = {"1": 1.0}

_PARQUET = (".parquet", ".pq")
_DELIMITERS = (",", ";", "\t")


class _Table(NamedTuple):
    """Columns as read: labels (N,), values (N, k) with NaN for gaps, and where each row stands."""

    labels: NDArray
    values: NDArray
    places: NDArray
    kind: str  # of place: "line" or "row"


class _Settings(NamedTuple):
    q: list[str]
    x: list[str]
    groups: str | None
    time: str | None
    q_unit: str
    x_unit: str
    q_sign: Any
    drop_invalid: bool


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
    return_X_y: bool = False,
) -> Any:
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
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, n_actuators) and ``x`` (n_samples, 3) in SI units; ``groups`` (strings)
        and ``time``, None if not asked for; ``line`` (n_samples,), line of each row in a text
        file, else its number from 0; ``invalid_lines`` of the rows left out; ``q_names``,
        ``x_names``, ``units``, ``file_units``, ``source``, ``DESCR``.

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
    >>> import numpy as np
    >>> from hybridkin.datasets import load_log
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "log.npz"
    ...     np.savez(path, cables=np.ones((4, 3)), tip=np.zeros((4, 3)))
    ...     data = load_log(path, q=["cables"], x=["tip"], q_unit="mm")
    >>> data.q[0], data.q_names
    (array([0.001, 0.001, 0.001]), ['cables[0]', 'cables[1]', 'cables[2]'])
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a log file, there is none at {str(path)!r}.")
    suffix, q, x = path.suffix.lower(), _names("q", q), _names("x", x)
    if suffix == ".npz" or suffix in _PARQUET:
        columns = _npz_columns(path) if suffix == ".npz" else _parquet_columns(path)
        q, x = _expanded(q, columns), _expanded(x, columns)
        for name in (*q, *x):
            _column(name, [*columns], path)
        read: Any = partial(_picked, columns=columns)
    else:
        read = partial(_read_text, delimiter=delimiter or _delimiter(path))
    settings = _Settings(q, x, groups, time, q_unit, x_unit, q_sign, drop_invalid)
    return _loaded(path, read, settings, return_X_y)


def load_csv(
    path: str | os.PathLike[str],
    q: Sequence[str],
    x: Sequence[str],
    groups: str | None = None,
    *,
    time: str | None = None,
    q_unit: str = "m",
    x_unit: str = "m",
    q_sign: ArrayLike = 1,
    delimiter: str = ",",
    drop_invalid: bool = False,
    return_X_y: bool = False,
) -> Any:
    r"""Return actuator vectors and tip positions from a CSV log with a header line.

    Parameters
    ----------
    path : path-like
        The file, UTF-8.
    q : sequence of str
        Columns of the actuator vector, in the order of the robot model.
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
    delimiter : str, default=","
        Separator of the columns.
    drop_invalid : bool, default=False
        Leave out rows with a missing, NaN or infinite value instead of raising.
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, n_actuators) and ``x`` (n_samples, 3) in SI units; ``groups`` (strings)
        and ``time``, None if not asked for; ``line`` (n_samples,), line of each row in the file;
        ``invalid_lines`` of the rows left out; ``q_names``, ``x_names``, ``units``, ``file_units``,
        ``source``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If a column is unknown, a cell is not a number, rows are invalid or none is left.

    Warns
    -----
    UserWarning
        If values look like millimetres where metres were declared.

    Examples
    --------
    >>> import pathlib, tempfile
    >>> from hybridkin.datasets import load_csv
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = pathlib.Path(folder) / "log.csv"
    ...     _ = path.write_text("a,b,c,X,Y,Z\n1,2,3,10,20,30\n")
    ...     data = load_csv(path, q=["a", "b", "c"], x=["X", "Y", "Z"], q_unit="mm", x_unit="mm")
    >>> data.x
    array([[0.01, 0.02, 0.03]])
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a CSV file, there is none at {str(path)!r}.")
    q, x = _names("q", q), _names("x", x)
    settings = _Settings(q, x, groups, time, q_unit, x_unit, q_sign, drop_invalid)
    return _loaded(path, partial(_read_text, delimiter=delimiter), settings, return_X_y)


def _loaded(path: Path, read: Any, settings: _Settings, return_X_y: bool) -> Any:
    """Return what the reader finds in the wanted columns, checked and in SI units."""
    q, x, groups, time, q_unit, x_unit, q_sign, drop_invalid = settings
    if len(x) != 3:
        raise ValueError(f"`x` must name 3 columns, got {len(x)}: {x}.")
    q_scale = _scale("q_unit", q_unit, {**METRES, **ANGLES, **UNITLESS})
    x_scale = _scale("x_unit", x_unit, METRES)
    sign = np.asarray(q_sign, dtype=float)
    if sign.shape not in ((), (len(q),)) or not np.isin(sign, (-1, 1)).all():
        raise ValueError(f"`q_sign` must be 1 or -1, or one per column of `q`, got {q_sign!r}.")
    wanted = [*q, *x, *([] if time is None else [time])]
    labels, values, places, kind = read(path, wanted=wanted, groups=groups)
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
            f"{str(path)!r} has no valid row left: all {len(values)} have a missing, NaN or "
            "infinite value."
        )
    labels, values = labels[~invalid], values[~invalid]
    n = len(q)
    for name, unit, part in (("q", q_unit, values[:, :n]), ("x", x_unit, values[:, n : n + 3])):
        if unit == "m":
            _warn_if_millimetres(name, part)
    data_q, data_x = values[:, :n] * q_scale * sign, values[:, n : n + 3] * x_scale
    if return_X_y:
        return data_q, data_x
    return Bunch(
        q=data_q,
        x=data_x,
        groups=None if groups is None else labels,
        time=None if time is None else values[:, -1],
        line=places[~invalid],
        invalid_lines=places[invalid],
        q_names=q,
        x_names=x,
        units={"q": "m" if q_unit in METRES else "rad" if q_unit in ANGLES else "1", "x": "m"},
        file_units={"q": q_unit, "x": x_unit},
        source=str(path),
        DESCR=f"{len(data_q)} rows of {path.name}; {invalid.sum()} invalid rows left out.",
    )


def _names(argument: str, names: Any) -> list[str]:
    if isinstance(names, str):
        names = [names]
    names = list(names)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`{argument}` must be column names, got {names!r}.")
    if len(set(names)) < len(names):
        raise ValueError(f"`{argument}` names a column twice: {names}.")
    return names


def _scale(argument: str, unit: str, known: dict[str, float]) -> float:
    if unit not in known:
        raise ValueError(f"`{argument}` must be one of {list(known)}, got {unit!r}.")
    return known[unit]


def _delimiter(path: Path) -> str:
    with open(path, encoding="utf-8-sig", errors="replace", newline="") as file:
        header = file.readline()
    return max(_DELIMITERS, key=header.count)


def _read_text(path: Path, wanted: list[str], groups: str | None, delimiter: str) -> _Table:
    labels, values, lines = [], [], []
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


def _expanded(names: list[str], columns: dict[str, NDArray]) -> list[str]:
    """Return the names with that of a table (N, k) replaced by those of its columns."""
    found: list[str] = []
    for name in names:
        parts = [c for c in columns if re.fullmatch(rf"{re.escape(name)}\[\d+\]", c)]
        found += [name] if name in columns or not parts else parts
    return found


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
            stacklevel=4,
        )
