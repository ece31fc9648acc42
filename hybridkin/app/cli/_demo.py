"""The demo: from a log to a film on simulated data, by the commands that a user types."""

from __future__ import annotations

import shlex
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

import hybridkin
from hybridkin.formats import write_file

if TYPE_CHECKING:
    from hybridkin.app.workflow import Report
    from hybridkin.app.workflow.fit_record import FitRecord
    from hybridkin.app.workflow.track import TrackRecord

_ROWS = 240
_BLOCK = 12
_SHOWN = ("mechanical, nominal", "mechanical, calibrated", "data-driven, quadratic")


def write_log(path: Path) -> None:
    """Write postures of the simulated trunk, lengths and tips in millimetres."""
    data = hybridkin.datasets.load_trunk()
    rows = np.flatnonzero(data.part == 3)[:_ROWS]  # where all segments move
    table = np.column_stack([np.arange(_ROWS) // _BLOCK, 1e3 * data.q[rows], 1e3 * data.x[rows]])
    names = "group,c1,c2,c3,c4,c5,c6,c7,c8,c9,tip_x,tip_y,tip_z"
    form = {"fmt": "%.6g", "delimiter": ",", "header": names, "comments": ""}
    write_file(path, partial(np.savetxt, X=table, **form))


def steps(out: Path) -> dict[str, str]:
    """Return the commands, each with what it does."""
    at = shlex.quote(out.as_posix())
    geometry = "--kind chambers --segments 3 --radius 100,93,79"
    shape = "--shape figure-eight --size 200,100 --dt 0.1"
    return {
        f"init {at}/robot.toml --log {at}/log.csv {geometry}": "Describe the robot: its rough "
        "geometry, and the columns and units of its log.",
        f"fit {at}/log.csv --robot {at}/robot.toml --out {at}/model --folds 2": "Check "
        "the log, calibrate the geometry, compare models on held-out rows, save a hybrid.",
        f"track {at}/model {shape} --out {at}/track": "Compute the commands (chamber lengths) that "
        "lead the tip along a figure eight.",
        f"animate {at}/model {at}/track --out {at}/track.gif --frames 24": "Make a film of it.",
    }


def summary(out: Path, records: dict[str, Any]) -> Report[dict[str, Any]]:
    """Return what the steps have shown, from their records by the name of the command."""
    fit: FitRecord = records["fit"]
    track: TrackRecord = records["track"]
    expected = track.expected["mean"]
    calibrated = fit.held_out[_SHOWN[1]].mean
    saved = fit.held_out[fit.saved].mean
    report = hybridkin.app.workflow.Report("From a log to a film, on SIMULATED data", records)
    report.text(
        f"The log comes from a physics simulator, not from a robot: {_ROWS} postures of a "
        "pneumatic trunk, three segments of three chambers, with sensor noise. A row has nine "
        "chamber lengths and the measured tip [mm].",
        *(f"{what}\n$ hybridkin {command}" for command, what in steps(out).items()),
        "Errors on held-out rows, which the fit of a model has not seen:",
    )
    report.errors(
        {name: fit.held_out[name] for name in (*_SHOWN, fit.saved)},
        ("mean", "p95", "max"),
    )
    report.text(
        "Nominal: geometry as described, pose of the base fitted. Calibrated: geometry fitted. "
        "Quadratic: a polynomial of the data, no mechanics. Hybrid: the calibrated model and a "
        f"learned correction, with {calibrated / saved:.1f} times less mean error.",
        f"Track: by the model the tip reaches {track.reached} of {track.n} points. Expect "
        f"{1e3 * expected:.2g} mm of the robot on this path.",
        f"Look at {out}/track.gif, {out}/model/report.md and {out}/robot.toml.",
        "Take the tip and pull, in the browser:\n"
        f"$ hybridkin view {shlex.quote((out / 'model').as_posix())} "
        f"{shlex.quote((out / 'log.csv').as_posix())}",
        "For your own robot, with a log of its actuators and its tip:\n"
        "$ hybridkin init robot.toml --log log.csv\n"
        "$ hybridkin fit log.csv --robot robot.toml --out model\n"
        "$ hybridkin track model --shape figure-eight --size 40,20 --unit mm --out track\n"
        "$ hybridkin animate model track --out track.gif",
    )
    return report
