"""The errors of a model on a log, by motion and in space, and the share of rows in its domain."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin.calibration.measured import distance, distances
from hybridkin.datasets import Log
from hybridkin.plots import (
    BackboneDisplay,
    ErrorHistogramDisplay,
    WorkspaceDisplay,
    new_figure,
)
from hybridkin.workflow._fit_report import radius_entry, write_check, write_markers
from hybridkin.workflow.log import MeasuredLog, checked
from hybridkin.workflow.model import LoadedModel, check_columns
from hybridkin.workflow.report import Report, check_out, statistics

_PARTS = {"new rows": "new", "fitted rows": "fitted", "held out in the fit": "held_out"}
_SHARES = ("share_in_domain", "share_in_radius")


def evaluate_log(
    loaded: LoadedModel,
    log: Log,
    out: str | Path | None = None,
    *,
    force: bool = False,
) -> tuple[Report, list[Path]]:
    """Return the errors of a model on a log, and write them with figures if `out` is given.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.
    log : Log
        As from `read_log` or `datasets.load_log`.
    out : str or Path, optional
        Folder to write into. Default: nothing is written.
    force : bool, default=False
        Continue if the check of the log finds errors, and replace files of `out` that `evaluate`
        did not write.

    Returns
    -------
    report : Report
        Its ``record`` holds "all" and "motions" with mean, median, p95 and max [m], and if the
        model has them "share_in_domain" and "share_in_radius". "fitted_rows" is the number of rows
        that the model was fitted to, None if not known. "fitted" and "new" hold the errors of
        fitted rows and other rows, "held_out" those of the fit on held-out motions. If half of a
        motion was fitted, all of its rows count as fitted.
    paths : list of Path
        The written files.

    Raises
    ------
    LogError
        If the log does not pass its check.
    """
    if out is not None:
        check_out(
            out, "evaluate", ["error_histogram.png", "workspace.png"], force=force
        )
    check_columns(log.q, loaded)
    measured = checked(log, None, base_is_free=False)
    measured.check(force)
    if loaded.play is not None:
        measured.check_order("A model with backlash (play)")
    # Else one motion.
    motion = measured.motions if measured.named else np.zeros(len(log.q))
    predicted = loaded.predict(log.q, motion)
    markers = distances(predicted, log.x)
    columns = {"error": np.nanmean(markers, axis=1)}
    report = Report(f"{loaded.name}: errors on {Path(log.source).name}")
    if loaded.hybrid is not None:
        columns["share_in_domain"] = loaded.hybrid.in_domain(log.q, groups=motion)
        if loaded.hybrid.radius_ is not None:
            _, radius = loaded.hybrid.predict(log.q, return_radius=True, groups=motion)
            columns["share_in_radius"] = np.where(
                np.isinf(radius), np.nan, np.nanmax(markers, axis=1) <= radius
            )
            report.record["radius"] = radius_entry(loaded.hybrid)
    motions = {}
    for name in dict.fromkeys(measured.motions):
        motions[str(name)] = _entry(columns, measured.motions == name)
    fitted = loaded.was_fitted(log.q, log.x, measured.motions)
    new_errors = fitted_errors = None
    if fitted is not None and not fitted.all():
        new_errors = _entry(columns, ~fitted)
    if fitted is not None and fitted.any():
        fitted_errors = _entry(columns, fitted)
    report.record.update(
        command="evaluate",
        model=str(loaded.path),
        log=log.source,
        all=_entry(columns, slice(None)),
        motions=motions,
        fitted_rows=None if fitted is None else int(fitted.sum()),
        new=new_errors,
        fitted=fitted_errors,
        held_out=None if fitted_errors is None else loaded.held_out,
        split=measured.split,
    )
    write_check(report, measured)
    _write_errors(report)
    write_markers(report, markers, "all rows")
    if out is None:
        return report, []
    _add_figures(report, loaded, measured, predicted, motion)
    return report, report.write(out)


def _entry(columns: dict[str, NDArray], rows: NDArray | slice) -> dict[str, Any]:
    error = columns["error"][rows]
    entry = {"rows": len(error), **statistics(error)}
    for name in _SHARES:
        if name in columns:
            values = np.ma.masked_invalid(columns[name][rows])
            entry[name] = float(np.ma.filled(values.mean(), np.nan))
    return entry


def _write_errors(report: Report) -> None:
    record = report.record
    everything = record["all"]
    motions = sorted(record["motions"].items(), key=lambda item: -item[1]["mean"])
    report.text("## Errors by motion, largest first")
    if record["fitted_rows"] is None:
        report.text(
            "The model does not say which rows it was fitted to; they have smaller errors."
        )
    if record["fitted_rows"]:
        report.text(
            f"**{record['fitted_rows']} of {everything['rows']} rows were fitted: their errors are "
            "training errors.** To test the model, evaluate a log of other motions."
        )
    entries = {"all rows": everything}
    if record["fitted"] is not None:
        for title, name in _PARTS.items():
            if record[name] is not None:
                entries[title] = record[name]
    columns = ["rows", "mean", "median", "p95", "max"]
    columns += [share for share in _SHARES if share in everything]
    report.errors({**entries, **dict(motions)}, columns)
    if "radius" in report.record:
        report.text(
            f"{report.record['radius']['words']} Rows without a radius do not count."
        )


def _add_figures(
    report: Report,
    loaded: LoadedModel,
    log: MeasuredLog,
    predicted: NDArray,
    motion: NDArray,
) -> None:
    errors = distance(predicted, log.x)
    figure, ax = new_figure(6.0, 3.6)
    ErrorHistogramDisplay({loaded.kind: errors}).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors of all rows.")
    figure, ax = new_figure(6.4, 5.2, subplot_kw={"projection": "3d"})
    row = int(np.argsort(errors)[int(0.95 * len(errors))])
    body = None
    if loaded.chain is not None:
        q = loaded.effective(log.q, motion)[row]
        body = BackboneDisplay.from_estimator(loaded.chain, q).points[0]
    WorkspaceDisplay(log.x[:, -3:], predicted[:, -3:], body, row).plot(ax, unit="mm")
    report.figure(
        "workspace", figure, "Measured tips, coloured by the tip error of the model."
    )
