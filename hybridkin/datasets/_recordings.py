"""Recordings of real robots: any CSV log, and three published sets that a user brings."""

from __future__ import annotations

import csv
import difflib
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from sklearn.utils import Bunch

__all__ = ["load_armlab", "load_asl_trunk", "load_csv", "load_ftdcr"]

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254}
ANGLES = {"rad": 1.0, "deg": np.pi / 180}
UNITLESS = {"1": 1.0}
DATA_HOME = "HYBRIDKIN_DATA"

FTDCR_SERVOS = tuple(f"servo_{i}_mm" for i in (4, 3, 9, 5, 2, 8, 6, 1, 7))
FTDCR_FILES = {"train": "train.csv", "tendon_pull": "tendon_pull.csv"}

FTDCR = """\
Three-segment, nine-tendon continuum robot, motion capture (ftdcr_v4)
---------------------------------------------------------------------

q : (n_samples, 9), tendon length changes [m], shortening < 0 (the file has displacements,
    positive = pulled); three per segment, base to tip
x : (n_samples, 3), tip position [m]
groups : (n_samples,), the motion a row belongs to: its label without the ending ``_hold``
pattern_label : (n_samples,), the label as recorded
time : (n_samples,), time stamp [s]

Nominal: segments of 60, 62.5 and 64 mm, tendon circle 4.5 mm, tendons of the far segments run
through the near ones. The rows are slow motions, not rest, and neighbours belong to one motion:
split by groups. The single-tendon pulls are in both files. Tendons can go slack.
"""
ARMLAB = """\
One-segment, three-cable continuum robot (armlab_3cable)
--------------------------------------------------------

q : (n_samples, 3), cable length changes [m], shortening < 0, commanded
x : (n_samples, 3), tip position [m] (the unit is inferred, the source does not state it)
groups : (n_samples,), grid line of the sweep
row : (n_samples,), index in the source's sweep

A raster in steps of 0.1 mm. While the first cable is at rest, a line has one position of the
second (groups 0 to 100, in tenths of a millimetre); afterwards a line has one position of the
first (groups 100 plus tenths of a millimetre). Some lines are absent. Neighbouring lines are
0.1 mm apart: leave out blocks of them to see extrapolation.
"""
ASL = """\
Three-segment trunk with six motors, strong friction (asl_trunk_static)
-----------------------------------------------------------------------

q : (n_samples, 6), normalised motor commands u, without unit
x : (n_samples, 3), position of the tip disk [m], y up
disks : (n_samples, 3, 3), positions of three disks, base to tip [m]
groups : (n_samples,), run
run_names : names of the runs; run_names[groups] names the run of each row
kind : (n_samples,), 0 beta, 1 targeted, 2 circle

Hysteresis dominates: the command alone does not determine the tip. Split by groups.
"""
SOURCES = {
    "ftdcr_v4": (
        "github.com/ContinuumRoboticsLab/opencr-mujoco, commit 17fff8b1, data/sysid/ftdcr_v4, "
        "MIT, (c) 2026 Continuum Robotics Lab",
        "Continuum Robotics Lab, opencr-mujoco, 2026, "
        "https://github.com/ContinuumRoboticsLab/opencr-mujoco.",
    ),
    "armlab_3cable": (
        "github.com/ARM-Lab/Learning-Based-Position-Control-for-Continuum-Robots, commit "
        "00b2d766, MIT, (c) 2025 ARM-Lab",
        "Sincak, Kelemen, Varga and Virgala, Process Control 2025, "
        "doi:10.1109/PC65047.2025.11047513.",
    ),
    "asl_trunk_static": (
        "github.com/StanfordASL/trunk-stack, commit 40886799, MIT, (c) 2024 Stanford Autonomous "
        "Systems Lab",
        "Stanford Autonomous Systems Lab, trunk-stack, 2024, "
        "https://github.com/StanfordASL/trunk-stack.",
    ),
}


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
        ``q_names``, ``x_names``, ``units``, ``source``, ``DESCR``.

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
    q, x = _names("q", q), _names("x", x)
    if len(x) != 3:
        raise ValueError(f"`x` must name 3 columns, got {len(x)}: {x}.")
    q_scale = _scale("q_unit", q_unit, {**METRES, **ANGLES, **UNITLESS})
    x_scale = _scale("x_unit", x_unit, METRES)
    sign = np.asarray(q_sign, dtype=float)
    if sign.shape not in ((), (len(q),)) or not np.isin(sign, (-1, 1)).all():
        raise ValueError(f"`q_sign` must be 1 or -1, or one per column of `q`, got {q_sign!r}.")
    path = Path(path)
    wanted = [*q, *x, *([] if time is None else [time])]
    labels, values, lines = _read_columns(path, wanted, groups, delimiter)
    invalid = ~np.isfinite(values).all(axis=1)
    if invalid.any() and not drop_invalid:
        first = ", ".join(map(str, lines[invalid][:5]))
        raise ValueError(
            f"{invalid.sum()} of {len(values)} rows of {str(path)!r} have a missing, NaN or "
            f"infinite value, the first in line {first}; correct them or leave them out by "
            "drop_invalid=True."
        )
    if invalid.all():
        raise ValueError(f"{str(path)!r} has no valid row left: all {len(values)} were invalid.")
    labels, values, lines = labels[~invalid], values[~invalid], lines[~invalid]
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
        line=lines,
        q_names=q,
        x_names=x,
        units={"q": "m" if q_unit in METRES else "rad" if q_unit in ANGLES else "1", "x": "m"},
        source=str(path),
        DESCR=f"{len(data_q)} rows of {path.name}; {invalid.sum()} invalid rows left out.",
    )


def load_ftdcr(
    data_home: str | os.PathLike[str] | None = None,
    *,
    subset: str = "train",
    return_X_y: bool = False,
) -> Any:
    """Return motion-capture data of a real robot with three segments and nine tendons.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``ftdcr_v4``; None takes the environment variable HYBRIDKIN_DATA.
    subset : {"train", "tendon_pull"}, default="train"
        All motions, or those that pull one tendon at a time (which are among them).
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 9), tendon length changes [m], shortening < 0; ``x`` (n_samples, 3) [m];
        ``groups``, the motion of each row; ``pattern_label``, ``time``, ``q_names``, ``units``,
        ``source``, ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the files are not there; the message names their source.
    """
    if subset not in FTDCR_FILES:
        raise ValueError(f"`subset` must be one of {list(FTDCR_FILES)}, got {subset!r}.")
    path, origin = _locate(data_home, "ftdcr_v4", FTDCR_FILES[subset])
    data = load_csv(
        path,
        q=FTDCR_SERVOS,
        x=("tip_x", "tip_y", "tip_z"),
        groups="pattern_label",
        time="timestamp",
        q_unit="mm",
        x_unit="mm",
        q_sign=-1,
    )
    if return_X_y:
        return data.q, data.x
    data.pattern_label = data.groups
    data.groups = np.array([label.removesuffix("_hold") for label in data.pattern_label])
    data.update(origin, DESCR=FTDCR)
    return data


def load_armlab(
    data_home: str | os.PathLike[str] | None = None, *, return_X_y: bool = False
) -> Any:
    """Return data of a real robot with one segment and three cables.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``armlab_3cable``; None takes the environment variable HYBRIDKIN_DATA.
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 3), cable length changes [m], shortening < 0; ``x`` (n_samples, 3) [m];
        ``groups``, the grid line of each row; ``row``, ``units``, ``source``, ``citation``,
        ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file is not there; the message names its source.
    """
    path, origin = _locate(data_home, "armlab_3cable", "armlab_3cable.npz")
    with np.load(path) as file:
        # Commands are multiples of 0.1 mm, stored in single precision.
        tenths = np.rint(file["cable_shortening_mm"].astype(float) * 10).astype(int)
        x, row = file["tip_mm"] * 1e-3, file["row"]
    q = tenths * -1e-4 + 0.0
    if return_X_y:
        return q, x
    groups = np.where(tenths[:, 0] == 0, tenths[:, 1], 100 + tenths[:, 0])
    units = {"q": "m", "x": "m"}
    return Bunch(q=q, x=x, groups=groups, row=row, units=units, DESCR=ARMLAB, **origin)


def load_asl_trunk(
    data_home: str | os.PathLike[str] | None = None, *, return_X_y: bool = False
) -> Any:
    """Return data of a real trunk with three segments, six motors and strong friction.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``asl_trunk_static``; None takes the environment variable HYBRIDKIN_DATA.
    return_X_y : bool, default=False
        If True, return ``(q, x)`` only.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 6), normalised motor commands without unit; ``x`` (n_samples, 3), tip
        disk [m]; ``disks`` (n_samples, 3, 3) [m]; ``groups``, the run of each row; ``run_names``,
        ``kind``, ``units``, ``source``, ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file is not there; the message names its source.
    """
    path, origin = _locate(data_home, "asl_trunk_static", "asl_trunk_static.npz")
    with np.load(path) as file:
        q, disks = file["u"].astype(float), file["disk_pos_m"]
        groups, names, kind = file["run_id"].astype(int), file["run_names"], file["kind"]
    x = disks[:, -1].copy()
    if return_X_y:
        return q, x
    units = {"q": "1", "x": "m"}
    extra = {"run_names": names, "kind": kind, "units": units, "DESCR": ASL}
    return Bunch(q=q, x=x, disks=disks, groups=groups, **extra, **origin)


def _locate(data_home, folder, name):
    """Path of a recording, and where it comes from."""
    source, citation = SOURCES[folder]
    home = os.environ.get(DATA_HOME) if data_home is None else data_home
    path = None if not home else Path(home) / folder / name
    if path is None or not path.is_file():
        looked = "no data_home was given" if path is None else f"there is no {str(path)!r}"
        raise FileNotFoundError(
            f"{folder}/{name} is not part of hybridkin, and {looked}. Its source: {source}. Put "
            f"the file into a folder {folder!r} and give the folder above as `data_home` or as the "
            f"environment variable {DATA_HOME}."
        )
    return path, {"source": source, "citation": citation}


def _names(argument, names):
    if isinstance(names, str):
        names = [names]
    names = list(names)
    if not names or not all(isinstance(name, str) for name in names):
        raise ValueError(f"`{argument}` must be column names, got {names!r}.")
    if len(set(names)) < len(names):
        raise ValueError(f"`{argument}` names a column twice: {names}.")
    return names


def _scale(argument, unit, known):
    if unit not in known:
        raise ValueError(f"`{argument}` must be one of {list(known)}, got {unit!r}.")
    return known[unit]


def _read_columns(path, wanted, groups, delimiter):
    """Group labels (n,), values (n, len(wanted)) with NaN for empty cells, file lines (n,)."""
    if not path.is_file():
        raise FileNotFoundError(f"`path` must be a CSV file, there is none at {str(path)!r}.")
    labels, values, lines = [], [], []
    with open(path, encoding="utf-8-sig", newline="") as file:
        reader = csv.reader(file, delimiter=delimiter)
        header = [name.strip() for name in next(reader, [])]
        if not header:
            raise ValueError(f"{str(path)!r} is empty; a header line and rows are needed.")
        columns = [_column(name, header, path) for name in wanted]
        group_column = None if groups is None else _column(groups, header, path)
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
    if not values:
        raise ValueError(f"{str(path)!r} has a header but no rows.")
    return np.array(labels), np.array(values), np.array(lines)


def _column(name, header, path):
    found = header.count(name)
    if found == 1:
        return header.index(name)
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


def _number(cell, name, line, path):
    text = cell.strip()
    if not text:
        return np.nan
    try:
        return float(text)
    except ValueError:
        raise ValueError(
            f"Line {line} of {str(path)!r}, column {name!r}: a number is needed, got {text!r}; "
            "correct the cell (an empty one counts as missing, see `drop_invalid`)."
        ) from None


def _warn_if_millimetres(name, values):
    if np.median(np.abs(values)) > 10 or np.ptp(values, axis=0).max() > 5:
        warnings.warn(
            f"The `{name}` columns span {np.ptp(values, axis=0).max():.4g} m around "
            f"{np.median(np.abs(values)):.4g} m; if the file has millimetres, give "
            f"{name}_unit='mm'.",
            stacklevel=3,
        )
