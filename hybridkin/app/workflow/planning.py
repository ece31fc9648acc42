"""The configurations to measure next, as a file of commands for the robot."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from hybridkin import (
    ForwardModel,
    HybridForwardModel,
    SeparatingMotion,
    choose_geometry,
    choose_rows,
    separating_motions,
    trajectories,
)
from hybridkin.app.workflow.domain import Domain, PathLimits, path_limits
from hybridkin.app.workflow.log import MeasuredLog
from hybridkin.app.workflow.model import commands_for, is_fitted, tips_at
from hybridkin.app.workflow.report import (
    Progress,
    Report,
    check_out,
    error_in_millimetres,
    lengths_for_table,
    quiet,
)
from hybridkin.app.workflow.track import Attempts, best_track
from hybridkin.arguments import whole

_POOL = 2000  # number of configurations to choose from
_SHOWN = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)  # rows of the table
_TOL = 1e-3  # tolerance of the inverse kinematics along a path [m]


def next_rows(
    model: HybridForwardModel,
    out: str | Path,
    *,
    n: int = 50,
    limits: PathLimits | None = None,
    measured: MeasuredLog | None = None,
    path: trajectories.Trajectory | None = None,
    force: bool = False,
    progress: Progress = quiet,
) -> Report[dict[str, object]]:
    """Choose the configurations to measure next, see `choose_rows`, and write them.

    ``next.csv`` has one row per configuration, in the order of the choice: commands in the units,
    names and sign of the robot's logs, and the expected error after this row. Commands lie within
    the limits, and tendons of a segment do not pull against each other. With backlash, send the
    commands in this order.

    If rows are measured, and the description of the robot leaves open what is calibrated, the
    report names the motions that separate sets of parameters with nearly equal errors, see
    `separating_motions`; their commands are in ``separating.csv``, each motion once. Without such
    a motion there is no such file.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    out : str or Path
        Folder to write into.
    n : int, default=50
        Number of configurations.
    limits : PathLimits, optional
        As from `path_limits`. Default: those of the description, else the training range.
    measured : MeasuredLog, optional
        Rows that are already measured.
    path : Trajectory, optional
        Path along which the error must be small [m]; its configurations are candidates, too.
        Default: everywhere within the limits.
    force : bool, default=False
        Replace files of `out` that `next` did not write.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    Report of dict
        "expected_errors" (n,) [m] after each configuration, the "limits", "n_measured" rows,
        "where" the error must be small, in words, and the "separating" motions, one
        `SeparatingMotion` for each set of parameters whose errors are near the best.

    Raises
    ------
    ValueError
        If the range of the actuators is not known, or fewer than `n` balanced configurations lie
        within it.
    """
    check_out(out, "next", ["next.csv", "separating.csv"], force=force)
    n = whole(n, "n")
    if limits is None:
        limits = path_limits(model, within_fit=False)
    domain = Domain(model, limits)
    candidates = domain.postures(_POOL)
    target = None
    where = "within the limits"
    if path is not None:
        target = best_track(domain, path, _TOL, Attempts(progress)).effective
        candidates = np.concatenate([target, candidates])
        far = np.linalg.norm(tips_at(model, target) - path.x, axis=1).max()
        largest = error_in_millimetres(far)
        where = f"along the path, where the largest error of the solver is {largest}"
    measured_q = None
    if measured is not None:
        measured_q = model.effective(measured.commands)
    progress("choosing configurations", 0, 1)
    rows, errors = choose_rows(
        _to_improve(model), candidates, n, measured=measured_q, target=target
    )
    n_measured = 0
    separating: tuple[SeparatingMotion, ...] = ()
    if measured is not None:
        n_measured = len(measured.q)
        progress("comparing sets of parameters", 0, 1)
        separating = _separating(model, measured, limits)
    record = {
        "command": "next",
        "model": model.description_.path,
        "n_measured": n_measured,
        "where": where,
        "limits": limits,
        "expected_errors": errors,
        "separating": separating,
    }
    report = Report(f"{model.description_.name}: {n} configurations to measure next", record)
    shown = sorted({k for k in _SHOWN if k < n} | {n})
    table = [[str(k), f"{1e3 * errors[k - 1]:.2f}"] for k in shown]
    report.table(["rows", "expected error [mm]"], table)
    report.text(
        f"Expected error {where}, computed without measured tips. It shows when more rows bring "
        f"little, not how large the error will be. {n_measured} rows are already measured. "
        f"Limits: {limits.source}."
    )
    log = model.description_.log
    sent = log.to_log(commands_for(model, candidates[rows]))
    cells = [np.char.mod("%.9g", sent), lengths_for_table(errors, log.x_unit)]
    report.table_file("next.csv", [*log.q, "expected_error"], np.column_stack(cells))
    # One of an earlier run is not that of these rows.
    (Path(out) / "separating.csv").unlink(missing_ok=True)
    if separating:
        _write_separating(report, model, separating)
    report.write(out)
    return report


def _write_separating(
    report: Report, model: HybridForwardModel, separating: Sequence[SeparatingMotion]
) -> None:
    """Add which motions separate sets of parameters, and their commands if there are any."""
    log = model.description_.log
    items = []
    lines = []
    n_motions = 0
    for rivals in _by_motion(separating):
        items.append(_in_words(rivals))
        motion = rivals[0]
        if motion.separates:
            n_motions += 1
            for command in log.to_log(commands_for(model, motion.q)):
                lines.append([str(n_motions), *np.char.mod("%.9g", command)])
    meaning = "No motion shows which one is right; use any."
    if n_motions:
        meaning = "The motions in separating.csv show which one is right."
        report.table_file("separating.csv", ["motion", *log.q], lines)
    report.text(
        "## What the measured rows leave open\n\nThese sets of parameters have nearly equal errors "
        f"on the measured rows. {meaning}"
    )
    report.items(items)


def _to_improve(model: HybridForwardModel) -> HybridForwardModel | ForwardModel:
    """Return the model to choose rows for: of a description its mechanical model.

    Nobody chose yet that it learns nothing; a later fit chooses its error model.
    """
    if is_fitted(model):
        return model
    return model.module_.robot


def _by_motion(separating: Sequence[SeparatingMotion]) -> list[list[SeparatingMotion]]:
    """Return them by motion and by whether it separates, each time the smallest rival first."""
    groups: dict[tuple[str, bool], list[SeparatingMotion]] = {}
    for motion in separating:
        groups.setdefault((motion.motion, motion.separates), []).append(motion)
    return [*groups.values()]


def _in_words(rivals: Sequence[SeparatingMotion]) -> str:
    """Return what to do, and all sets that this motion is the best one for."""
    others = ", ".join(repr(motion.rival) for motion in rivals[1:])
    return f"{rivals[0]}; the same for {others}" if others else str(rivals[0])


def _separating(
    model: HybridForwardModel, measured: MeasuredLog, limits: PathLimits
) -> tuple[SeparatingMotion, ...]:
    """Return the motions that separate what the description of the robot leaves open.

    There are none if it has no chain, or a list of what to calibrate.
    """
    robot = model.description_.robot
    if robot.chain is None or robot.calibrate != "auto":
        return ()
    rows = measured.counted
    q = model.effective(measured.commands)[rows]
    x = measured.x[rows]
    choice = choose_geometry(robot.chain, q, x, groups=measured.motions[rows])
    return separating_motions(choice, q, x, q_min=limits.q_min, q_max=limits.q_max)
