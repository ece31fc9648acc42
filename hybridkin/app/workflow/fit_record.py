"""What a fit to a measured log found, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hybridkin
from hybridkin import CrossFit
from hybridkin.app import LogReport
from hybridkin.app.workflow.calibrated import Calibration
from hybridkin.app.workflow.compare import (
    AUTO,
    CALIBRATED,
    DATA_LINEAR,
    HYBRID_ELM,
)
from hybridkin.app.workflow.counts import Counts
from hybridkin.app.workflow.errors import Errors, HeldOutErrors, Promise
from hybridkin.app.workflow.log import write_check
from hybridkin.app.workflow.report import Report

_SHOWN = (CALIBRATED, DATA_LINEAR, HYBRID_ELM, "hybrid, parallel ELM", AUTO)
_MOST = 5  # motions of largest errors
_KINDS_OF_MODELS = (
    '"Nominal": the robot description, with a fitted base if the base is calibrated. "Calibrated": '
    'with the geometry fitted to the log. "With backlash": the calibrated model at the motion of '
    'the actuators. "Data-driven": without a mechanical model. "Hybrid": the calibrated model, or '
    'for a robot without segments the linear one, plus a learned residual. "Parallel": the '
    'residual acts at the tip, "serial": inside the robot. "ELM" is a network, "auto" the chosen '
    "one of the hybrids, or a blend of several."
)


@dataclass(frozen=True, kw_only=True)
class Training:
    """The notes of a fit that its model file keeps.

    Attributes
    ----------
    log, robot : str
        Names of the log and of the robot.
    rows, n_whole : int
        Number of fitted rows, and of all rows of the log.
    n_motions : int
        Number of motions.
    split : str
        The kind of the motions, in words.
    excluded : sequence of str
        Patterns of the motions that were left out.
    loss : str
        Loss of the calibration.
    saved, chosen : str
        Name of the saved model, and what it chose.
    held_out : dict of str to HeldOutErrors
        Errors of every model on held-out motions [m].
    promise : Promise
        Errors to expect of the saved model.
    counts : Counts or None
        Whole numbers that the columns of the log can hold; None without a format of the log.
    """

    log: str
    robot: str
    rows: int
    n_whole: int
    n_motions: int
    split: str
    excluded: Sequence[str]
    loss: str
    saved: str
    chosen: str
    held_out: Mapping[str, HeldOutErrors]
    promise: Promise
    counts: Counts | None = None


@dataclass(frozen=True)
class MotionErrors:
    """Mean errors of some models on a held-out motion [m]."""

    motion: str
    rows: int
    means: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class FitRecord(Training):
    """What `fit_log` found.

    Attributes
    ----------
    command : str
        "fit".
    choices_by_fold : list of dict
        What models chose in each fold.
    log_check : LogReport
        Findings of the check of the log.
    thinned : str
        Which rows of a long log were fitted, in words; empty: all.
    worst : list of MotionErrors
        The motions of largest errors.
    markers : list of Errors
        Errors of every marker of the saved model, base to tip; empty for a single one.
    auto : dict or None
        The choices of "auto", see ``HybridForwardModel.cv_results_``.
    words : list of str
        How much of the errors is static, hysteresis, and not repeatable; what the saved model
        chose, its error radius, and motions that the log lacks.
    tried : dict of str to dict
        If the robot says "auto", the errors of all sets of parameters that were tried [m]: on
        held-out motions, "cv", and outside the fitted rows, "io".
    calibrated : str
        The set that is calibrated.
    calibration : Calibration or None
        The calibration on all motions.
    """

    command: str = "fit"
    choices_by_fold: Sequence[Mapping[str, str]]
    log_check: LogReport
    thinned: str
    worst: Sequence[MotionErrors]
    markers: Sequence[Errors]
    auto: Mapping[str, Any] | None
    words: Sequence[str]
    tried: Mapping[str, Mapping[str, float]]
    calibrated: str
    calibration: Calibration | None


def training_notes(record: FitRecord) -> dict[str, object]:
    """Return the notes that the model file keeps."""
    notes = asdict(record)
    return {field.name: notes[field.name] for field in fields(Training)}


def write_comparison(report: Report[FitRecord]) -> None:
    """Add the check of the log and the errors on held-out motions."""
    record = report.record
    write_check(report, record.log_check)
    thinned = ""
    if record.thinned:
        thinned = f" ({record.thinned})"
    report.text(
        "## Errors on held-out motions",
        f"{record.rows} rows{thinned}, {record.n_motions} {record.split}. Each of "
        f"{len(record.choices_by_fold)} folds holds out whole motions. Geometry, hysteresis, "
        "penalties and networks are chosen and fitted without them, in searches that start at the "
        "choices for all motions. Those also decide whether hysteresis is looked for, and how many "
        "neurons a network has at most. The other folds choose the weights of a blend.",
        _KINDS_OF_MODELS,
    )
    columns = ("mean", "std_error", "std", "p95", "max", "std_folds")
    report.errors(record.held_out, columns)
    report.text(
        "Std: standard deviation. The standard error of the mean counts every motion as one "
        "sample, because rows of a motion have similar errors. 95 %: quantile over rows."
    )
    first, *rivals = shown_models(record.held_out)
    ratios = []
    for name in rivals:
        ratio = record.held_out[first].mean / record.held_out[name].mean
        ratios.append(f"by that of {name}: **{ratio:.2f}**")
    best = min(record.held_out, key=lambda name: record.held_out[name].mean)
    report.text(f"Mean error of {first} divided {', '.join(ratios)}. Least mean error: {best}.")


def write_model(report: Report[FitRecord]) -> None:
    """Add the motions of largest errors, what was saved and chosen, and the calibration."""
    record = report.record
    shown = shown_models(record.held_out)
    report.text(f"Mean errors in mm of the five motions with the largest errors of {shown[-1]}:")
    rows = []
    for entry in record.worst:
        means = [f"{1e3 * entry.means[name]:.1f}" for name in shown]
        rows.append([entry.motion, str(entry.rows), *means])
    report.table(["motion", "rows", *shown], rows)
    by_fold = [choices.get(record.saved, "-") for choices in record.choices_by_fold]
    reason = "It has the least mean error of the models that can be saved."
    if record.saved == AUTO:
        reason = "It chooses among the other hybrids itself."
    report.text(
        f"Saved: **{record.saved}**, fitted to all motions: {record.chosen}. {reason} Settings "
        f"chosen in each fold: {'; '.join(by_fold)}."
    )
    write_markers(report, record.markers, f"{record.saved}, on held-out motions")
    for words in record.words:
        report.text("{words}", words=words)
    if record.tried:
        write_tried(report, record.calibrated, record.tried)
    if record.calibration is not None:
        report.text("## Calibration on all motions", whose_values(record.calibrated, record.auto))
        record.calibration.write(report)


def whose_values(calibrated: str, auto: Mapping[str, Any] | None) -> str:
    """Return which model has the calibrated values of the report, in words.

    Parameters
    ----------
    calibrated : str
        The set of parameters of the calibrated model.
    auto : dict or None
        The choices of "auto", see ``HybridForwardModel.cv_results_``.
    """
    words = f'These are the values of the row "{CALIBRATED}".'
    if auto is None or len(auto["mechanical_model"]) < 2:  # the saved model chose no set
        return words
    if auto["parameters"] != calibrated:
        words += f" The saved model has other ones: it calibrates {auto['parameters']}."
    return words


def write_tried(report: Report, calibrated: str, tried: Mapping[str, Mapping[str, float]]) -> None:
    """Add the calibrated set of parameters, and all sets that were tried, to a report."""
    report.text(
        "## What is calibrated",
        f'Calibrated in the row "{CALIBRATED}": **{calibrated}**. The table has mean tip '
        "errors in mm: on held-out motions, and outside, on the outer 35 % of the rows after a fit "
        "to the inner 40 %. Sets with more than 1.1 times the least held-out error are excluded. "
        "The score of the others is the held-out error times the square of the error outside. Of "
        "the sets with nearly the least score, the one with the fewest parameters is calibrated.",
    )
    rows = []
    for name, errors in tried.items():
        in_mm = []
        for key in ("cv", "io"):
            in_mm.append(f"{1e3 * errors[key]:.2f}" if key in errors else "-")
        rows.append([name, *in_mm])
    report.table(["parameters", "held-out motions", "outside"], rows)
    if not any("io" in errors for errors in tried.values()):
        report.text("-: too few rows for an error outside; the score is the held-out error.")


def shown_models(compared: Mapping[str, object]) -> list[str]:
    """Return the compared models that texts and figures show."""
    return [name for name in _SHOWN if name in compared]


def errors_of_rows(compared: CrossFit) -> dict[str, NDArray]:
    """Return the error of each row (N,) by model [m]; for several markers their mean."""
    return dict(zip(compared.names, compared.distances, strict=True))


def largest_errors(errors: Mapping[str, NDArray], motions: NDArray) -> list[MotionErrors]:
    """Return the motions with the largest errors of the last of the `shown_models`."""
    names, motion = np.unique(motions, return_inverse=True)
    counts = np.bincount(motion)
    shown = shown_models(errors)
    means = {name: np.bincount(motion, errors[name]) / counts for name in shown}
    entries = []
    for k in np.argsort(means[shown[-1]])[::-1][:_MOST]:
        of_motion = {name: float(means[name][k]) for name in shown}
        entries.append(MotionErrors(str(names[k]), int(counts[k]), of_motion))
    return entries


def errors_of_markers(errors: NDArray) -> list[Errors]:
    """Return the errors of several markers from those of rows (N, K), NaN: not measured."""
    if errors.shape[1] == 1:
        return []
    return [Errors.of(column[~np.isnan(column)]) for column in errors.T]


def write_markers(report: Report, markers: Sequence[Errors], what: str) -> None:
    """Add the errors of several markers, one by one."""
    if markers:
        report.text(f"Errors of the markers, base to tip ({what}). Other tables give their mean.")
        entries = {f"marker {k}": errors for k, errors in enumerate(markers)}
        report.errors(entries, ("rows", "mean", "p95", "max"))


def add_error_figures(report: Report, errors: Mapping[str, NDArray]) -> None:
    """Add the distributions of the errors (N,) on held-out motions by model."""
    figure, ax = hybridkin.plots.new_figure(8.0, 1.5 + 0.32 * len(errors))
    hybridkin.plots.ErrorBoxDisplay(errors).plot(ax, unit="mm")
    caption = "Tip error on held-out motions: quartiles, 5 and 95 %; larger errors as numbers."
    report.figure("held_out", figure, caption)
    shown = shown_models(errors)
    first_and_last = {name: errors[name] for name in (shown[0], shown[-1])}
    add_histogram(report, first_and_last, "Tip errors on held-out motions.")


def add_histogram(report: Report, errors: Mapping[str, NDArray], caption: str) -> None:
    """Add a histogram of errors (N,) by model."""
    figure, ax = hybridkin.plots.new_figure(5.5, 3.8)
    hybridkin.plots.ErrorHistogramDisplay(errors).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, caption)
