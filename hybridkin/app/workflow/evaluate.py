"""The errors of a model on a log, by motion and in space, and the share of rows in its domain."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import hybridkin
from hybridkin import Commands, HybridForwardModel
from hybridkin.app import LogReport
from hybridkin.app.workflow.errors import Errors, marker_distances
from hybridkin.app.workflow.fit_record import (
    add_histogram,
    errors_of_markers,
    write_markers,
)
from hybridkin.app.workflow.log import MeasuredLog, checked, write_check
from hybridkin.app.workflow.model import (
    check_columns,
    fitted_rows,
    has_body,
    held_out_errors,
    is_fitted,
    kind_of,
)
from hybridkin.app.workflow.report import Report, check_out
from hybridkin.datasets import Log

_FIGURES = ("error_histogram.png", "workspace.png")


@dataclass(frozen=True, kw_only=True)
class LogErrors(Errors):
    """Errors of rows of a log [m], and the shares of them in the domain and in the radius."""

    share_in_domain: float
    share_in_radius: float


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What `evaluate_log` found.

    Attributes
    ----------
    command, model, log : str
        "evaluate", and the sources.
    log_check : LogReport
        Findings of the check of the log.
    all : LogErrors
        Errors of all rows [m].
    motions : dict of str to LogErrors
        Errors by motion.
    fitted_rows : int or None
        Number of rows that the model was fitted to, None if not known. If half of a motion was
        fitted, all of its rows count as fitted.
    fitted, new : LogErrors or None
        Errors of fitted rows and of other rows.
    held_out : Errors or None
        Errors of the fit on held-out motions, if rows were fitted.
    markers : list of Errors
        Errors of every marker, base to tip; empty for a single one.
    """

    command: str = "evaluate"
    model: str
    log: str
    log_check: LogReport
    all: LogErrors
    motions: Mapping[str, LogErrors]
    fitted_rows: int | None
    fitted: LogErrors | None
    new: LogErrors | None
    held_out: Errors | None
    markers: Sequence[Errors]

    @property
    def judged(self) -> Errors:
        """The errors that count: of new rows; if all were fitted, those on held-out motions."""
        return self.new or self.held_out or self.all


@dataclass(frozen=True, eq=False)
class _RowErrors:
    """The tip error of every row (N,) [m], and whether it is in the domain and in the radius.

    NaN stands for what is not known, and for the radius outside the domain.
    """

    error: NDArray
    in_domain: NDArray
    in_radius: NDArray

    def of(self, rows: NDArray) -> LogErrors:
        """Return the errors of some rows."""
        return LogErrors.of(
            self.error[rows],
            share_in_domain=_share(self.in_domain[rows]),
            share_in_radius=_share(self.in_radius[rows]),
        )


def _share(values: NDArray) -> float:
    known = values[~np.isnan(values)]
    return float(known.mean()) if known.size else np.nan


def evaluate_log(
    model: HybridForwardModel,
    log: Log,
    out: str | Path | None = None,
    *,
    force: bool = False,
) -> Report[Evaluation]:
    """Return the errors of a model on a log, and write them with figures if `out` is given.

    Parameters
    ----------
    model : HybridForwardModel
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
    Report of Evaluation
        The errors of all rows, of every motion, and of fitted and new rows.

    Raises
    ------
    LogError
        If the log does not pass its check.
    """
    if out is not None:
        check_out(out, "evaluate", _FIGURES, force=force)
    check_columns(model, log.q)
    measured = checked(log, None, base_is_free=False)
    measured.check(force)
    if model.hysteresis_:
        measured.check_order("A model with hysteresis")
    predicted = model.predict(measured.commands)
    markers = marker_distances(predicted, log.x)
    errors = _row_errors(model, measured.commands, markers)
    fitted = fitted_rows(model, log.q, log.x, measured.motions)
    fitted_errors = None
    new_errors = None
    if fitted is not None and fitted.any():
        fitted_errors = errors.of(fitted)
    if fitted is not None and not fitted.all():
        new_errors = errors.of(~fitted)
    motions = {}
    for name in dict.fromkeys(measured.motions):
        motions[str(name)] = errors.of(measured.motions == name)
    record = Evaluation(
        model=str(model.description_.path),
        log=log.source,
        log_check=measured.report.of_evaluation,
        all=errors.of(np.ones(len(log.q), dtype=bool)),
        motions=motions,
        fitted_rows=None if fitted is None else int(fitted.sum()),
        fitted=fitted_errors,
        new=new_errors,
        held_out=None if fitted_errors is None else held_out_errors(model),
        markers=errors_of_markers(markers),
    )
    report = Report(f"{model.description_.name}: errors on {Path(log.source).name}", record)
    _write_errors(report, model)
    if out is not None:
        _add_figures(report, model, measured, predicted)
        report.write(out)
    return report


def _row_errors(model: HybridForwardModel, commands: Commands, markers: NDArray) -> _RowErrors:
    in_domain = np.full(len(commands), np.nan)
    in_radius = in_domain
    if is_fitted(model):
        in_domain = model.in_domain(commands).astype(float)
    if model.radius_ is not None:
        _, radius = model.predict(commands, return_radius=True)
        inside = np.nanmax(markers, axis=1) <= radius
        in_radius = np.where(np.isinf(radius), np.nan, inside)
    return _RowErrors(np.nanmean(markers, axis=1), in_domain, in_radius)


def _write_errors(report: Report[Evaluation], model: HybridForwardModel) -> None:
    """Add the errors to a report."""
    record = report.record
    write_check(report, record.log_check)
    report.text("## Errors by motion, largest first")
    if record.fitted_rows is None:
        report.text("The model does not say which rows it was fitted to; they have smaller errors.")
    if record.fitted_rows:
        report.text(
            f"**{record.fitted_rows} of {record.all.rows} rows were fitted: their errors are "
            "training errors.** To test the model, evaluate a log of other motions."
        )
    entries: dict[str, Errors] = {"all rows": record.all}
    if record.fitted is not None:
        parts = {
            "new rows": record.new,
            "fitted rows": record.fitted,
            "held out in the fit": record.held_out,
        }
        entries |= {name: part for name, part in parts.items() if part is not None}
    largest_first = sorted(record.motions.items(), key=lambda item: -item[1].mean)
    columns = ["rows", "mean", "median", "p95", "max"]
    if is_fitted(model):
        columns += ["share_in_domain", "share_in_radius"]
    report.errors(entries | dict(largest_first), columns)
    if model.radius_ is not None:
        report.text(f"Estimated error radius: {model.radius_}. Rows without a radius do not count.")
    write_markers(report, record.markers, "all rows")


def _add_figures(
    report: Report[Evaluation],
    model: HybridForwardModel,
    log: MeasuredLog,
    predicted: NDArray,
) -> None:
    plots = hybridkin.plots
    errors = np.nanmean(marker_distances(predicted, log.x), axis=1)
    add_histogram(report, {kind_of(model): errors}, "Tip errors of all rows.")
    figure, ax = plots.new_figure(6.4, 5.2, subplot_kw={"projection": "3d"})
    row = int(np.argsort(errors)[int(0.95 * len(errors))])
    body = None
    if has_body(model):
        q = model.effective(log.commands)[row]
        body = plots.BackboneDisplay.from_estimator(model.module_.robot, q).points[0]
    tips = plots.WorkspaceDisplay(log.x[:, -3:], predicted[:, -3:], body, row)
    tips.plot(ax, unit="mm")
    report.figure("workspace", figure, "Measured tips, coloured by the tip error of the model.")
