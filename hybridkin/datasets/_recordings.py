"""Recordings of real robots: readers for three published data sets, which the user provides."""

from __future__ import annotations

import inspect
import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import Bunch

from hybridkin.datasets._logs import load_log
from hybridkin.datasets._npz import arrays_of

DATA_HOME = "HYBRIDKIN_DATA"

FTDCR_SERVOS = tuple(f"servo_{i}_mm" for i in (4, 3, 9, 5, 2, 8, 6, 1, 7))
FTDCR_TIP = ("tip_x", "tip_y", "tip_z")
FTDCR_FORMAT: Any = {"time": "timestamp", "q_unit": "mm", "x_unit": "mm", "q_sign": -1}
FTDCR_FILES = {"train": "train.csv", "tendon_pull": "tendon_pull.csv"}

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


def load_ftdcr(
    data_home: str | os.PathLike[str] | None = None, *, subset: str = "train"
) -> Bunch:
    """Return motion-capture data of a real robot with three segments and nine tendons.

    Nominal: segments of 60, 62.5 and 64 mm, tendon circle 4.5 mm. Tendons of distal segments run
    through the proximal ones and can become slack. The rows are slow motions, not rest, and
    neighbours belong to one motion: split by groups. Both subsets hold the single-tendon pulls.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``ftdcr_v4``; None takes the environment variable HYBRIDKIN_DATA.
    subset : {"train", "tendon_pull"}, default="train"
        All motions, or only those that pull one tendon at a time.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 9), tendon length changes [m], three per segment from base to tip,
        shortening < 0 (the file has displacements, positive = pulled); ``x`` (n_samples, 3), tip
        [m]; ``groups``, the motion of each row: its label without the ending ``_hold``;
        ``pattern_label``, the label as recorded; ``time`` [s]; ``q_names``, ``units``, ``source``,
        ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the files do not exist; the message names their source.
    """
    if subset not in FTDCR_FILES:
        raise ValueError(
            f"`subset` must be one of {list(FTDCR_FILES)}, got {subset!r}."
        )
    path, origin = _locate(data_home, "ftdcr_v4", FTDCR_FILES[subset])
    log = load_log(path, FTDCR_SERVOS, FTDCR_TIP, "pattern_label", **FTDCR_FORMAT)
    labels = np.asarray(log.groups)
    return Bunch(
        **{name: vars(log)[name] for name in ("q", "x", "time", "q_names", "units")},
        groups=np.array([label.removesuffix("_hold") for label in labels]),
        pattern_label=labels,
        DESCR=inspect.getdoc(load_ftdcr),
        **origin,
    )


def load_armlab(data_home: str | os.PathLike[str] | None = None) -> Bunch:
    """Return data of a real robot with one segment and three cables.

    The rows are a grid in steps of 0.1 mm. While the first cable is at rest, each grid line has one
    position of the second cable (groups 0 to 100, in tenths of a millimetre). Afterwards each line
    has one position of the first cable (groups 100 plus tenths of a millimetre). Some lines are
    missing. Neighbouring lines are 0.1 mm apart: hold out blocks of lines to test extrapolation.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``armlab_3cable``; None takes the environment variable HYBRIDKIN_DATA.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 3), commanded cable length changes [m], shortening < 0; ``x``
        (n_samples, 3), tip [m] (the unit is inferred, the source does not state it); ``groups``,
        the grid line of each row; ``row``, its index in the source's sweep; ``units``, ``source``,
        ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file does not exist; the message names its source.
    """
    path, origin = _locate(data_home, "armlab_3cable", "armlab_3cable.npz")
    file = _arrays(path, {"cable_shortening_mm": (3,), "tip_mm": (3,), "row": ()})
    # Commands are multiples of 0.1 mm, stored in single precision.
    tenths = np.rint(file["cable_shortening_mm"].astype(float) * 10).astype(int)
    x = file["tip_mm"] * 1e-3
    row = file["row"]
    groups = np.where(tenths[:, 0] == 0, tenths[:, 1], 100 + tenths[:, 0])
    return Bunch(
        q=tenths * -1e-4 + 0.0,
        x=x,
        groups=groups,
        row=row,
        units={"q": "m", "x": "m"},
        DESCR=inspect.getdoc(load_armlab),
        **origin,
    )


def load_asl_trunk(data_home: str | os.PathLike[str] | None = None) -> Bunch:
    """Return data of a real trunk with three segments, six motors and strong friction.

    Hysteresis is strong: the command does not determine the tip. Split by groups.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``asl_trunk_static``; None takes the environment variable HYBRIDKIN_DATA.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 6), normalised motor commands without unit; ``x`` (n_samples, 3), tip
        disk [m], y up; ``disks`` (n_samples, 3, 3), positions of three disks, base to tip [m];
        ``groups``, the run of each row, named by ``run_names[groups]``; ``kind``, 0 beta,
        1 targeted, 2 circle; ``units``, ``source``, ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file does not exist; the message names its source.
    """
    path, origin = _locate(data_home, "asl_trunk_static", "asl_trunk_static.npz")
    shapes = {"u": (6,), "disk_pos_m": (3, 3), "run_id": (), "kind": ()}
    file = _arrays(path, shapes, "run_names")
    disks = file["disk_pos_m"]
    return Bunch(
        q=file["u"].astype(float),
        x=disks[:, -1].copy(),
        disks=disks,
        groups=file["run_id"].astype(int),
        run_names=file["run_names"],
        kind=file["kind"],
        units={"q": "1", "x": "m"},
        DESCR=inspect.getdoc(load_asl_trunk),
        **origin,
    )


def _arrays(
    path: Path, shapes: Mapping[str, tuple[int, ...]], *names: str
) -> dict[str, NDArray]:
    """Return the arrays of a recording; raise if their rows do not have these shapes."""
    file = arrays_of(path)
    n = {len(array) for name, array in file.items() if name in shapes and array.ndim}
    for name in (*shapes, *names):
        array = file.get(name, np.array(None))
        right = array.ndim == 1 if name in names else array.shape[1:] == shapes[name]
        kind = "U" if name in names else "biuf"
        right &= array.ndim > 0 and len(n) == 1 and array.dtype.kind in kind
        if not right or (kind != "U" and not np.isfinite(array).all()):
            got = f"of shape {array.shape} and type {array.dtype!s:.40}"
            raise ValueError(
                f"{path} is damaged: {name!r} is {got}; copy the file again."
            )
    return file


def _locate(
    data_home: str | os.PathLike[str] | None, folder: str, name: str
) -> tuple[Path, dict[str, str]]:
    """Return the path of a recording, and its source and citation."""
    source, citation = SOURCES[folder]
    home = os.environ.get(DATA_HOME) if data_home is None else data_home
    path = None if not home else Path(home) / folder / name
    if path is None or not path.is_file():
        if path is None:
            looked = "no data_home was given"
        else:
            looked = f"there is no {str(path)!r}"
        raise FileNotFoundError(
            f"{folder}/{name} is not part of hybridkin, and {looked}. Its source: {source}. Put "
            f"the file into a folder {folder!r} and give its parent folder as `data_home` or as "
            f"the environment variable {DATA_HOME}."
        )
    return path, {"source": source, "citation": citation}
