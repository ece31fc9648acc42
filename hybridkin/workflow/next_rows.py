"""Which configurations to measure next, as a file to send to the robot."""

from __future__ import annotations

import csv
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.units import METRES
from hybridkin.hybrid.choose_rows import choose_rows
from hybridkin.ik.trajectories import Trajectory
from hybridkin.workflow._domain import Domain, PathLimits, path_limits
from hybridkin.workflow.log import MeasuredLog
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Progress, Report, check_out, distance, quiet
from hybridkin.workflow.track import best_track

_POOL = 2000  # configurations to choose from
_SHOWN = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # rows of the table
_TOL = 1e-3  # of the inverse kinematics along a path [m]


def next_rows(
    loaded: LoadedModel,
    out: str | Path,
    *,
    n: int = 50,
    limits: PathLimits | None = None,
    measured: MeasuredLog | None = None,
    path: Trajectory | None = None,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Choose the configurations to measure next, see `choose_rows`, and write them.

    ``next.csv`` has one row per configuration in the order chosen: commands in the units, names and
    sign of the robot's logs, and the expected error that remains after it. They lie within the
    limits; tendons of a segment do not pull against each other. Of a model with play the commands
    are those to send, in that order.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.
    out : str or Path
        Folder to write into.
    n : int, default=50
        How many configurations.
    limits : PathLimits, optional
        As from `path_limits`. Default: those of the description, else the range of the fit.
    measured : MeasuredLog, optional
        What was measured already.
    path : Trajectory, optional
        Where the error is to be small [m]; its configurations are candidates, too. Default:
        everywhere within the limits.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    report : Report
        Its ``record`` holds "expected_errors" [m], after each configuration, "n_measured" and
        "limits", and "path": points and the largest "error" [m] of the inverse kinematics.
    paths : list of Path
        What was written.

    Raises
    ------
    ValueError
        If nobody knows the range of the actuators, or fewer than `n` balanced configurations lie
        within it.
    """
    check_out(out)
    limits = path_limits(loaded, within_fit=False) if limits is None else limits
    domain = Domain(loaded, limits)
    candidates, target = domain.postures(_POOL), None
    report = Report(f"{loaded.name}: {n} configurations to measure next")
    report.record.update(model=str(loaded.path), n=n, limits=dict(vars(limits)), path=None)
    report.text(f"Limits: {limits.source}.")
    if path is not None:
        target = best_track(domain, path, _TOL, progress).q
        far = float(distance(loaded.tips(target), path.x).max())
        candidates = np.concatenate([target, candidates])
        report.record["path"] = {"points": len(path), "error": far}
        report.text(
            f"Where the error is to be small: a path of {len(path)} points, which the model misses "
            f"by {1e3 * far:.3g} mm at most."
        )
    known = None if measured is None else loaded.effective(measured.q, measured.motions)
    rows, errors = choose_rows(loaded.model, candidates, n, measured=known, target=target)
    sent = candidates[rows] if loaded.play is None else loaded.play.command(candidates[rows])[0]
    report.record.update(n_measured=0 if known is None else len(known), expected_errors=errors)
    shown = sorted({k for k in _SHOWN if k < n} | {n})
    report.table(
        ["measured", "expected error [mm]"], [[str(k), f"{1e3 * errors[k - 1]:.2f}"] for k in shown]
    )
    report.text(
        "The expected error is that of a serial hybrid, before any tip is measured: it says where "
        "more rows end paying, not how large the error will be."
    )
    report.file("next.csv", partial(_write, loaded, sent, errors))
    return report, report.write(out)


def _write(loaded: LoadedModel, q: NDArray, errors: NDArray, file: Path) -> None:
    log = loaded.log_format()
    table = np.column_stack([q / log.q_factor, errors / METRES[log.x_unit]])
    with open(file, "w", encoding="utf-8", newline="") as lines:
        head = [*log.q, "expected_error"]
        writer = csv.writer(lines, lineterminator="\n")
        writer.writerows([head, *np.char.mod("%.9g", table + 0.0)])  # no -0
