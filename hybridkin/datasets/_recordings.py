"""Recordings of real robots: readers for five published data sets, which the user provides."""

from __future__ import annotations

import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from sklearn.utils import Bunch

from hybridkin._core.arrays import one_of
from hybridkin.datasets._npz import arrays_of
from hybridkin.datasets.logs import load_log

_FTDCR_SERVOS = tuple(f"servo_{i}_mm" for i in (4, 3, 9, 5, 2, 8, 6, 1, 7))
_FTDCR_TIP = ("tip_x", "tip_y", "tip_z")

_SOURCES = {
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
    "asu_bellows": (
        "github.com/ASU-RISE-Lab/4-chamber-softarm-control, commit 6df7ec9d, MIT, "
        "(c) 2023 ASU-RISE-Lab",
        "ASU RISE Lab, 4-chamber-softarm-control, 2023, "
        "https://github.com/ASU-RISE-Lab/4-chamber-softarm-control.",
    ),
    "soromox_tentacle": (
        "github.com/tud-phi/soromox, commit 4f03054a, "
        "paper_results/secVa_system_identification, MIT, (c) 2025-2026 SoRoMoX contributors",
        "SoRoMoX contributors, soromox, 2026, https://github.com/tud-phi/soromox.",
    ),
}


def load_ftdcr(data_home: str | os.PathLike[str] | None = None, *, subset: str = "train") -> Bunch:
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
    one_of(subset, "subset", ("train", "tendon_pull"))
    path = _path(data_home, "ftdcr_v4", f"{subset}.csv")
    log = load_log(
        path,
        _FTDCR_SERVOS,
        _FTDCR_TIP,
        "pattern_label",
        time="timestamp",
        q_unit="mm",
        x_unit="mm",
        q_sign=-1,
    )
    labels = np.asarray(log.groups)
    return _recording(
        load_ftdcr,
        "ftdcr_v4",
        q=log.q,
        x=log.x,
        groups=np.array([label.removesuffix("_hold") for label in labels]),
        pattern_label=labels,
        time=log.time,
        q_names=log.q_names,
        units=log.units,
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
    shapes = {"cable_shortening_mm": (3,), "tip_mm": (3,), "row": ()}
    file = _arrays(data_home, "armlab_3cable", shapes)
    # Commands are multiples of 0.1 mm, stored in single precision.
    tenths = np.rint(file["cable_shortening_mm"].astype(float) * 10).astype(int)
    return _recording(
        load_armlab,
        "armlab_3cable",
        q=tenths * -1e-4 + 0.0,
        x=file["tip_mm"] * 1e-3,
        groups=np.where(tenths[:, 0] == 0, tenths[:, 1], 100 + tenths[:, 0]),
        row=file["row"],
        units={"q": "m", "x": "m"},
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
    shapes = {"u": (6,), "disk_pos_m": (3, 3), "run_id": (), "kind": ()}
    file = _arrays(data_home, "asl_trunk_static", shapes)
    disks = file["disk_pos_m"]
    return _recording(
        load_asl_trunk,
        "asl_trunk_static",
        q=file["u"].astype(float),
        x=disks[:, -1].copy(),
        disks=disks,
        groups=file["run_id"].astype(int),
        run_names=file.get("run_names"),
        kind=file["kind"],
        units={"q": "1", "x": "m"},
    )


def load_asu_bellows(data_home: str | os.PathLike[str] | None = None) -> Bunch:
    """Return data of a real planar arm with two bellows segments and six pressures.

    The rows are steps and cycles of 20 to 70 s at about 10 Hz, recorded on several days: they show
    dynamics and hysteresis, and a pressure does not determine a length. Split by `day`.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``asu_bellows``; None takes the environment variable HYBRIDKIN_DATA.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (n_samples, 6), measured pressures [Pa], three per segment, base to tip;
        ``q_command`` (n_samples, 6), commanded pressures [Pa]; ``x`` (n_samples, 3), tip relative
        to the base marker [m], in axes of the camera; ``middle`` (n_samples, 3), marker between
        the segments [m]; ``groups``, the run of each row, named by ``run_names[groups]``; ``day``
        of each row; ``time`` within a run [s]; ``units``, ``source``, ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file does not exist; the message names its source.
    """
    shapes = {
        "pressure_pa": (6,),
        "pressure_command_pa": (6,),
        "tip_m": (3,),
        "middle_m": (3,),
        "run_id": (),
        "t": (),
    }
    file = _arrays(data_home, "asu_bellows", shapes)
    return _recording(
        load_asu_bellows,
        "asu_bellows",
        q=file["pressure_pa"].astype(float),
        q_command=file["pressure_command_pa"].astype(float),
        x=file["tip_m"].astype(float),
        middle=file["middle_m"].astype(float),
        groups=file["run_id"].astype(int),
        run_names=file.get("run_names"),
        day=file.get("day"),
        time=file["t"].astype(float),
        units={"q": "Pa", "x": "m"},
    )


def load_soromox_tentacle(data_home: str | os.PathLike[str] | None = None) -> Bunch:
    """Return data of a real tapered silicone tentacle pulled by two tendon forces.

    22 loads at rest, under gravity; the tentacle is 0.36 m long. Each row is the mean of one load:
    hold out whole rows.

    Parameters
    ----------
    data_home : path-like or None, default=None
        Folder that holds ``soromox_tentacle``; None takes the environment variable HYBRIDKIN_DATA.

    Returns
    -------
    data : :class:`~sklearn.utils.Bunch`
        ``q`` (22, 2), tendon forces [N], pulling > 0 (motor torques over a spool of 32.5 mm);
        ``x`` (22, 12), four markers on the body relative to the base marker [m], base to tip: as
        for a chain of four markers; ``groups``, the name of each load; ``units``, ``source``,
        ``citation``, ``DESCR``.

    Raises
    ------
    FileNotFoundError
        If the file does not exist; the message names its source.
    """
    shapes = {"force_n": (2,), "marker_m": (4, 3)}
    file = _arrays(data_home, "soromox_tentacle", shapes)
    markers = file["marker_m"].astype(float)
    return _recording(
        load_soromox_tentacle,
        "soromox_tentacle",
        q=file["force_n"].astype(float),
        x=markers.reshape(len(markers), -1),
        groups=file.get("load"),
        units={"q": "N", "x": "m"},
    )


def _arrays(
    data_home: str | os.PathLike[str] | None,
    folder: str,
    shapes: Mapping[str, tuple[int, ...]],
) -> dict[str, NDArray]:
    """Return the arrays of a recording; raise if the rows of some do not have these shapes."""
    path = _path(data_home, folder, f"{folder}.npz")
    file = arrays_of(path)
    n_rows = len(next(iter(file.values()), ()))
    for name, shape in shapes.items():
        array = file.get(name, np.array("no array"))
        numbers = array.dtype.kind in "biuf" and np.isfinite(array).all()
        if not numbers or array.shape != (n_rows, *shape):
            raise ValueError(
                f"{path} is damaged: {name!r} has shape {array.shape} and type "
                f"{array.dtype!s:.40}; copy the file again."
            )
    return file


def _path(data_home: str | os.PathLike[str] | None, folder: str, name: str) -> Path:
    """Return the path of a recording."""
    home = data_home or os.environ.get("HYBRIDKIN_DATA")
    looked = "no data_home was given"
    if home:
        path = Path(home) / folder / name
        if path.is_file():
            return path
        looked = f"there is no {str(path)!r}"
    raise FileNotFoundError(
        f"{folder}/{name} is not part of hybridkin, and {looked}. Its source: "
        f"{_SOURCES[folder][0]}. Put the file into a folder {folder!r} and give its parent folder "
        "as `data_home` or as the environment variable HYBRIDKIN_DATA."
    )


def _recording(load: Callable[..., Bunch], folder: str, **columns: object) -> Bunch:
    """Return the columns of a recording, with its description, source and citation."""
    source, citation = _SOURCES[folder]
    description = inspect.getdoc(load)
    return Bunch(**columns, DESCR=description, source=source, citation=citation)
