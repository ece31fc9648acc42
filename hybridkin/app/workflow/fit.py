"""The fit to a measured log: check, compare models on held-out motions, fit the best, report."""

from __future__ import annotations

import shutil
import warnings
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from hybridkin import CrossFit, HybridForwardModel, robots, save_model
from hybridkin.app.workflow.choices import (
    auto_in_words,
    choice_in_words,
    choices_by_fold,
)
from hybridkin.app.workflow.compare import (
    AUTO,
    DATA_QUADRATIC,
    DEFAULTS,
    NOMINAL,
    FitSettings,
    compare,
    mechanical_of,
    with_hysteresis_detected,
)
from hybridkin.app.workflow.counts import Counts
from hybridkin.app.workflow.errors import HeldOutErrors, Promise, marker_distances
from hybridkin.app.workflow.explained import explained_in_words
from hybridkin.app.workflow.fit_record import (
    FitRecord,
    add_error_figures,
    errors_of_markers,
    errors_of_rows,
    largest_errors,
    training_notes,
    write_comparison,
    write_model,
)
from hybridkin.app.workflow.log import MeasuredLog, checked
from hybridkin.app.workflow.model import log_unit, plane_in_words
from hybridkin.app.workflow.report import Progress, Report, check_out, quiet
from hybridkin.datasets import Log

_FILES = ("model.safetensors", "robot.toml", "held_out.png", "error_histogram.png")


def fit_log(
    log: Log,
    robot: robots.RobotDescription,
    out: str | Path,
    settings: FitSettings = DEFAULTS,
    *,
    force: bool = False,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> Report[FitRecord]:
    """Check a log, compare models on held-out motions, fit the best to all of it, and report.

    The hybrid with ``error_model="auto"`` is saved, which chooses among the other hybrids. Without
    it (`auto` of the settings) the calibrated model or the hybrid with the least mean error on
    held-out motions is saved. For a robot without segments, a linear model of the data takes the
    place of the mechanical model.

    Parameters
    ----------
    log : Log
        As from `read_log` or `datasets.load_log`.
    robot : robots.RobotDescription
        As from `robots.read_description`.
    out : str or Path
        Folder to write into.
    settings : FitSettings, optional
        Settings of the fit and of the comparison.
    force : bool, default=False
        Fit even if the check of the log finds errors, and replace files of `out` that `fit` did
        not write.
    n_jobs, progress
        As for `hybridkin.cross_fit`.

    Returns
    -------
    Report of FitRecord
        Every number; its ``paths`` are the written files, including the model.

    Raises
    ------
    LogError
        If the log does not pass its check.
    ValueError
        If the log or the settings do not allow the comparison.
    """
    check_out(out, "fit", _FILES, force=force)
    complete = checked(log, robot.chain, robot.base_is_free)
    _check(complete, robot, settings)
    complete.check(force)
    rows = complete.thinned(settings.max_rows)
    measured = rows.measured
    progress("calibration", 0, 1)
    mechanical = mechanical_of(robot, measured, settings.loss)
    messages = [*mechanical.messages, *mechanical.suspicions(measured)]
    for message in messages:
        warnings.warn(message, stacklevel=2)
    settings = with_hysteresis_detected(settings, rows, robot, mechanical)
    if not settings.follows_order:
        rows = measured
    compared = compare(rows, robot, settings, mechanical, n_jobs=n_jobs, progress=progress)
    saved = AUTO if settings.auto else _best_to_save(compared)
    model = compared.models[saved]
    if model.calibrate is mechanical.calibrate:
        model.set_params(calibrate=robot.calibrate)
    model.count_as_fitted(complete.q, complete.x)
    model.described(replace(model.description_, robot=robot))
    progress("writing the report", 0, 1)
    held_out = {}
    errors = errors_of_rows(compared)
    for name, of_model in errors.items():
        held_out[name] = HeldOutErrors.of_motions(of_model, measured.motions, compared.fold)
    record = FitRecord(
        log=Path(log.source).name,
        robot=robot.name,
        rows=len(measured.q),
        n_whole=len(complete.q),
        thinned=rows.thinned_in_words(complete),
        n_motions=len(np.unique(complete.motions)),
        split=complete.split,
        excluded=complete.excluded,
        loss=settings.loss,
        saved=saved,
        chosen=choice_in_words(model, rows.q_unit),
        held_out=held_out,
        promise=Promise.of(errors[saved], compared.distances_from_others),
        counts=None if robot.log is None else Counts.of_log(robot.log.to_log(complete.q)),
        choices_by_fold=choices_by_fold(compared, rows.q_unit),
        log_check=complete.report,
        worst=largest_errors(errors, measured.motions),
        markers=errors_of_markers(
            marker_distances(compared.tips[compared.names.index(saved)], compared.y)
        ),
        auto=model.cv_results_,
        words=[
            explained_in_words(held_out, rows, model),
            *_in_words(model),
        ],
        tried=mechanical.tried,
        calibrated=mechanical.parameters,
        calibration=mechanical.calibration(measured, settings.loss, messages),
    )
    report = Report(f"{robot.name}: hybrid model of {record.log}", record)
    write_comparison(report)
    add_error_figures(report, errors)
    write_model(report)
    _add_model(report, model, robot)
    report.write(out)
    return report


def _check(log: MeasuredLog, robot: robots.RobotDescription, settings: FitSettings) -> None:
    """Raise if the log or the settings do not allow a comparison by motions."""
    n_motions = len(np.unique(log.motions))
    if n_motions < 3:
        raise ValueError(
            "`groups` must name at least 3 motions, one to hold out and two to choose by, but the "
            f"log has {n_motions}; name another column: --groups COLUMN."
        )
    if settings.hysteresis == "detect" or not settings.follows_order:
        return
    if not robot.has_segments or not settings.auto or not log.named:
        raise ValueError(
            "`hysteresis` requires a robot with segments, `auto=True` (no --no-auto), and motions "
            "that a column names (--groups COLUMN, or groups = in [log])."
        )
    log.check_order("`hysteresis`")


def _best_to_save(compared: CrossFit) -> str:
    """Return the model of least mean error that stays near a mechanical or linear model."""
    means = {}
    for name, errors in compared.errors.items():
        if name not in (NOMINAL, DATA_QUADRATIC):
            means[name] = errors.mean
    return min(means, key=means.__getitem__)


def _in_words(model: HybridForwardModel) -> list[str]:
    """Return what a model chose and expects, its error radius, and motions that its log lacks."""
    words = [
        *auto_in_words(model, log_unit(model)),
        *model.structure_in_words(),
    ]
    if model.radius_ is not None:
        words.append(f"Estimated error radius: {model.radius_}.")
    if plane_in_words(model):
        words.append(plane_in_words(model))
    return words


def _add_model(
    report: Report[FitRecord], model: HybridForwardModel, robot: robots.RobotDescription
) -> None:
    """Add the model and the description of its robot to the files of a report."""
    training = training_notes(report.record)
    report.file("model.safetensors", lambda path: save_model(model, path, training=training))
    report.text("The model: `hybridkin.load_model('model.safetensors')`.")
    if robot.path is not None:  # the description it was made from
        report.file("robot.toml", partial(shutil.copyfile, robot.path))
