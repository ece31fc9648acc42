"""Recordings of real robots: three published sets that a user brings."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
from sklearn.utils import Bunch

from hybridkin.datasets._logs import load_csv

__all__ = ["load_armlab", "load_asl_trunk", "load_ftdcr"]

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
