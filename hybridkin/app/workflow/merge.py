"""One log file from a file of the motors and one of a camera."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from hybridkin.app.workflow.report import Report
from hybridkin.arguments import as_path
from hybridkin.datasets import merge_logs, read_columns
from hybridkin.formats import check_outputs, csv_table, write_file


def merge_files(
    motors: str | Path,
    camera: str | Path,
    out: str | Path,
    *,
    q: Sequence[str],
    x: Sequence[str],
    time: str,
    camera_time: str | None = None,
    groups: str | None = None,
    lag: float | None = None,
    tolerance: float | None = None,
    hold: bool = False,
    delimiter: str | None = None,
    decimal: str = ".",
    missing: ArrayLike = (),
    force: bool = False,
) -> Report[dict[str, Any]]:
    """Write the log of a camera's tips with the motors' commands of the same time.

    Names, units and signs of the columns are those of the two files. Without motions, the column
    "run" counts the parts between the gaps of the motors.

    Parameters
    ----------
    motors, camera : str or Path
        Files as for `datasets.load_log`.
    out : str or Path
        CSV file to write.
    q : sequence of str
        Columns of the actuators in the file of the motors.
    x : sequence of str
        Columns of the tip in the file of the camera.
    time : str
        Column of the time of the motors [s].
    camera_time : str, optional
        Column of the time of the camera [s]. Default: that of the same name as `time`.
    groups : str, optional
        Column of the motion in the file of the motors.
    lag, tolerance, hold
        As for `datasets.merge_logs`.
    delimiter, decimal, missing
        As for `datasets.load_log`, for both files; `missing` for that of the camera.
    force : bool, default=False
        Replace the file if it exists.

    Returns
    -------
    Report of dict
        The "lag" [s], the share of the motion "explained", and the numbers of "rows" and of camera
        rows "left_out".

    Raises
    ------
    ValueError
        If two columns of the log have one name, or as for `datasets.merge_logs`.
    """
    path = as_path(out, "out")
    check_outputs([path], "merge", lambda _: False, force=force)
    form = {"delimiter": delimiter, "decimal": decimal, "unit": "as written"}
    commands = read_columns(motors, q, time=time, groups=groups, **form)
    tips = read_columns(camera, x, time=camera_time or time, missing=missing, **form)
    merged = merge_logs(commands, tips, lag=lag, tolerance=tolerance, hold=hold)
    log = merged.log
    motions = np.asarray(log.runs if groups is None else log.groups)
    names = [time, *log.q_names, *log.x_names, groups or "run"]
    if len({*names}) < len(names):
        raise ValueError(
            f"The columns of the log must have names of their own, got {names}; rename those that "
            "occur twice in one of the files."
        )
    numbers = np.column_stack([log.q, log.x])
    rows = []
    for at, row, motion in zip(np.asarray(log.time), numbers, motions, strict=True):
        cells = np.char.mod("%.9g", row).tolist()
        rows.append([f"{at:.6f}", *cells, str(motion)])
    text = csv_table(names, rows).replace("nan", "")
    record = {
        "command": "merge",
        "motors": str(motors),
        "camera": str(camera),
        "lag": merged.lag,
        "explained": merged.explained,
        "rows": len(log.q),
        "left_out": merged.n_left_out,
    }
    report = Report(f"{path.name}: {len(log.q)} rows", record)
    report.text("{merged}", merged=merged)
    write_file(path, partial(Path.write_text, data=text, encoding="utf-8"))
    report.paths = [path]
    return report
