"""What a fit to a measured log found, and its report."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

import hybridkin
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.datasets import LogReport
from hybridkin.workflow.calibrated import Calibration
from hybridkin.workflow.choices import AutoChoice, RadiusEntry
from hybridkin.workflow.compare import (
    AUTO,
    BACKLASH,
    CALIBRATED,
    DATA_LINEAR,
    HYBRID_ELM,
    Comparison,
)
from hybridkin.workflow.errors import Errors, HeldOutErrors, Promise
from hybridkin.workflow.log import write_check
from hybridkin.workflow.report import Report

_SHOWN = (CALIBRATED, DATA_LINEAR, HYBRID_ELM, "hybrid, parallel ELM", AUTO)
_MOST = 5  # motions of largest errors
_MECHANICAL = (
    '"Nominal": the robot description, with a fitted base if the base is calibrated. "Calibrated": '
    'with the geometry fitted to the log. "Data-driven": without a mechanical model. "Hybrid": the '
    "calibrated model plus a learned residual."
)
_AUTO = (
    ' "Parallel": the residual acts at the tip, "serial": inside the robot. "ELM" is a network, '
    '"auto" the chosen one of the hybrids, or a blend of several.'
)
_WITH_BACKLASH = (
    ' "With backlash": the calibrated model at the motion of the actuators, as hybrids.'
)
_NO_MECHANICAL = (
    'The robot has no segments: "hybrid" models correct the linear model of the data.'
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


@dataclass(frozen=True)
class ParameterChoice:
    """The set of parameters that is calibrated, and the errors (cv, io) of all tried sets [m]."""

    taken: str
    tried: Mapping[str, Mapping[str, float]]

    @classmethod
    def of(cls, geometry: GeometryChoice | None) -> ParameterChoice | None:
        """Return the choice; None if the description names the parameters."""
        if geometry is None:
            return None
        tried = {name: errors.known() for name, errors in geometry.errors.items()}
        return cls(geometry.name, tried)

    def write(self, report: Report[Any]) -> None:
        """Add the choice to a report."""
        report.text(
            "## What is calibrated",
            f"Calibrated: **{self.taken}**. The table has mean tip errors in mm: on held-out "
            "motions, and outside, on the outer 35 % of the rows after a fit to the inner 40 %. "
            "Sets with more than 1.1 times the least held-out error are excluded. The score of the "
            "others is the held-out error times the square of the error outside. Of the sets with "
            "nearly the least score, the one with the fewest parameters is calibrated.",
        )
        rows = []
        for name, errors in self.tried.items():
            held_out = 1e3 * errors.get("cv", np.nan)
            outside = 1e3 * errors.get("io", np.nan)
            rows.append([name, f"{held_out:.2f}", f"{outside:.2f}"])
        report.table(["parameters", "held-out motions", "outside"], rows)


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
    worst : list of MotionErrors
        The motions of largest errors.
    markers : list of Errors or None
        Errors of every marker of the saved model, base to tip; None for a single one.
    auto, radius
        The choices of "auto", and the estimated error radius.
    plane : str
        Motions that the log lacks, in words.
    parameters : ParameterChoice or None
        What is calibrated, if the robot says "auto".
    calibration : Calibration or None
        The calibration on all motions.
    calibration_of_saved : Calibration or None
        That of elastic tendons, if "auto" took them instead.
    """

    command: str = "fit"
    choices_by_fold: Sequence[Mapping[str, str]]
    log_check: LogReport
    worst: Sequence[MotionErrors]
    markers: Sequence[Errors] | None
    auto: AutoChoice | None
    radius: RadiusEntry | None
    plane: str
    parameters: ParameterChoice | None
    calibration: Calibration | None
    calibration_of_saved: Calibration | None


def training_notes(record: FitRecord) -> dict[str, Any]:
    """Return the notes that the model file keeps."""
    notes = asdict(record)
    return {field.name: notes[field.name] for field in fields(Training)}


def write_comparison(report: Report[FitRecord]) -> None:
    """Add the check of the log and the errors on held-out motions."""
    record = report.record
    write_check(report, record.log_check)
    thinned = ""
    if record.n_whole != record.rows:
        thinned = f" (of {record.n_whole}, evenly thinned)"
    report.text(
        "## Errors on held-out motions",
        f"{record.rows} rows{thinned}, {record.n_motions} {record.split}. Each of "
        f"{len(record.choices_by_fold)} folds holds out whole motions. The other motions choose "
        "and fit everything: geometry, features, penalties and blend.",
        _kinds_of_models(record.held_out),
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
    start = "the calibrated model" if first == CALIBRATED else "the linear model"
    report.text(
        f"Mean error of {start} divided {', '.join(ratios)}. Least mean error: {best}."
    )


def _kinds_of_models(compared: Mapping[str, object]) -> str:
    """Return what the names of the compared models mean."""
    words = _MECHANICAL if CALIBRATED in compared else _NO_MECHANICAL
    if BACKLASH in compared:
        words += _WITH_BACKLASH
    if AUTO in compared:
        words += _AUTO
    return words


def write_model(report: Report[FitRecord]) -> None:
    """Add the motions of largest errors, what was saved and chosen, and the calibration."""
    record = report.record
    shown = shown_models(record.held_out)
    report.text(
        f"Mean errors in mm of the five motions with the largest errors of {shown[-1]}:"
    )
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
    if record.auto is not None:
        report.text(" ".join(record.auto.words))
    if record.radius is not None:
        report.text(record.radius.words)
    if record.plane:
        report.text(record.plane)
    if record.parameters is not None:
        record.parameters.write(report)
    if record.calibration is not None:
        record.calibration.write(report, "Calibration on all motions")
    if record.calibration_of_saved is not None:
        title = "Calibration of the elastic tendons that auto chose"
        record.calibration_of_saved.write(report, title)


def shown_models(compared: Mapping[str, object]) -> list[str]:
    """Return the compared models that texts and figures show."""
    return [name for name in _SHOWN if name in compared]


def largest_errors(compared: Comparison, motions: NDArray) -> list[MotionErrors]:
    """Return the motions with the largest errors of the last of the `shown_models`."""
    names, motion = np.unique(motions, return_inverse=True)
    counts = np.bincount(motion)
    shown = shown_models(compared.errors)
    means = {
        name: np.bincount(motion, compared.errors[name]) / counts for name in shown
    }
    entries = []
    for k in np.argsort(means[shown[-1]])[::-1][:_MOST]:
        of_motion = {name: float(means[name][k]) for name in shown}
        entries.append(MotionErrors(str(names[k]), int(counts[k]), of_motion))
    return entries


def errors_of_markers(errors: NDArray) -> list[Errors] | None:
    """Return the errors of every marker from those of rows (N, K), NaN: not measured."""
    if errors.shape[1] == 1:
        return None
    return [Errors.of(column[~np.isnan(column)]) for column in errors.T]


def write_markers(
    report: Report[Any], markers: Sequence[Errors] | None, what: str
) -> None:
    """Add the errors of several markers, one by one."""
    if markers is None:
        return
    report.text(
        f"Errors of the markers, base to tip ({what}). Other tables give their mean."
    )
    entries = {f"marker {k}": errors for k, errors in enumerate(markers)}
    report.errors(entries, ("rows", "mean", "p95", "max"))


def add_error_figures(report: Report[Any], errors: Mapping[str, NDArray]) -> None:
    """Add the distributions of the errors (N,) on held-out motions by model."""
    plots = hybridkin.plots
    figure, ax = plots.new_figure(8.0, 1.5 + 0.32 * len(errors))
    plots.ErrorBoxDisplay(errors).plot(ax, unit="mm")
    caption = "Tip error on held-out motions: quartiles, 5 and 95 %; larger errors as numbers."
    report.figure("held_out", figure, caption)
    figure, ax = plots.new_figure(5.5, 3.8)
    shown = shown_models(errors)
    first_and_last = {name: errors[name] for name in (shown[0], shown[-1])}
    plots.ErrorHistogramDisplay(first_and_last).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors on held-out motions.")
