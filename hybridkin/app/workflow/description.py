"""The report on a model: geometry, training, domain, errors and the choices of its fit."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from torch import Tensor

from hybridkin import robots
from hybridkin.app.workflow.errors import HeldOutErrors
from hybridkin.app.workflow.model import (
    hysteresis_in_words,
    is_fitted,
    trained_range,
    widths_in_log,
)
from hybridkin.app.workflow.report import Report, listed
from hybridkin.formats import LogUnit, visible

if TYPE_CHECKING:
    from hybridkin import HybridForwardModel

_RANGE = "training range of q"  # of a notebook; here it follows in the unit of the logs
_NAMES = 24  # width of the names of rows
_NOTES = ("log", "rows", "n_whole", "n_motions", "saved", "chosen")
_PER_TIME = {"dq_max": "/s", "ddq_max": "/s^2"}


@dataclass(frozen=True, eq=False)
class Description:
    """What a model is, in SI units; entries that are not known are None or empty.

    Attributes
    ----------
    name, path, kind : str
        Name of the robot, file and class of the model.
    n_actuators : int
        Size of q.
    geometry : dict of str to Tensor
        That of its chain, see ``Chain.geometry``.
    auto : dict or None
        The choices of "auto", see ``HybridForwardModel.cv_results_``.
    hysteresis : list of float or None
        Widths of the hysteresis of one or all actuators, in the unit of the robot's logs.
    domain : Limits
        Training range.
    log_format : LogFormat
        Format of the robot's logs.
    limits : Limits
        Limits of its actuators.
    training : dict
        Notes of the fit in the file.
    created, versions
        When and by which packages the file was written.
    """

    name: str
    path: str
    kind: str
    n_actuators: int
    geometry: Mapping[str, Tensor]
    auto: Mapping[str, Any] | None
    hysteresis: list[float] | None
    domain: robots.Limits
    log_format: robots.LogFormat
    limits: robots.Limits
    training: Mapping[str, Any]
    created: str
    versions: Mapping[str, str]


def describe(model: HybridForwardModel) -> Report[Description]:
    """Return a report on a model.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.

    Returns
    -------
    Report of Description
        Geometry, training, domain, errors and choices.
    """
    known = model.description_
    robot = model.module_.robot
    kind = type(model)
    rows = model.html_rows()
    if not is_fitted(model):
        kind = type(robot)
        rows = robot.html_rows()
    record = Description(
        name=known.name,
        path=str(known.path),
        kind=kind.__name__,
        n_actuators=model.n_features_in_,
        geometry=robot.geometry(),
        auto=model.cv_results_,
        hysteresis=widths_in_log(model),
        domain=trained_range(model),
        log_format=known.log,
        limits=known.limits,
        training=known.training,
        created=known.created,
        versions=known.versions,
    )
    hysteresis = ""
    if model.hysteresis_:
        hysteresis = f"The actuators have {hysteresis_in_words(model)}."
    return _report(record, rows, hysteresis)


def describe_robot(robot: robots.RobotDescription) -> Report[Description]:
    """Return a report on a robot, of which there is no fitted model.

    Parameters
    ----------
    robot : RobotDescription
        The robot, as from `robots.read_description`; with segments.

    Returns
    -------
    Report of Description
        Its geometry, limits and logs.
    """
    if robot.chain is None:
        raise ValueError(
            f"`robot` {robot.path} has no segments: there is nothing to describe before a fit."
        )
    n = robot.n_actuators
    log = robot.log
    if log is None:
        unit = "m" if robot.chain.in_metres else "1"
        names = tuple(f"q{i + 1}" for i in range(n))
        log = robots.LogFormat(names, ("x", "y", "z"), q_unit=unit)
    record = Description(
        name=robot.name,
        path=str(robot.path),
        kind=type(robot.chain).__name__,
        n_actuators=n,
        geometry=robot.chain.geometry(),
        auto=None,
        hysteresis=None,
        domain=robots.Limits(),
        log_format=log,
        limits=robot.limits,
        training={},
        created="",
        versions={},
    )
    return _report(record, robot.chain.html_rows(), "")


def _report(
    record: Description, rows: Mapping[str, object], hysteresis: str
) -> Report[Description]:
    """Return a record with its words; `rows` are those of a notebook."""
    what = "fitted model" if np.isfinite(record.domain.q_min).all() else "mechanical model"
    title = f"{record.name}: {what}, {record.n_actuators} actuators"
    report = Report(title, record)
    shown = {name: value for name, value in rows.items() if name != _RANGE}
    report.verbatim(_in_lines(shown, LogUnit.of(record.log_format.q_unit)))
    if hysteresis:
        report.text(hysteresis)
    log = record.log_format
    _write_limits(report, "Training range", record.domain, log)
    _write_limits(report, "Limits", record.limits, log)
    report.text(
        "Logs: q in {unit}, q_sign {sign} ({q}), x in {x_unit} ({x}).",
        unit=log.q_unit,
        sign=log.q_sign,
        q=", ".join(log.q),
        x_unit=log.x_unit,
        x=", ".join(log.x),
    )
    _write_training(report, record.training)
    if record.versions:
        words = [f"{name} {version}" for name, version in record.versions.items()]
        report.text(
            "Saved on {date} by {versions}.",
            date=record.created,
            versions=", ".join(words),
        )
    return report


def _in_lines(rows: Mapping[str, object], unit: LogUnit) -> str:
    """Return names and values, one in a line; parts are indented. `unit` is that of q."""
    lines = []
    for name, value in rows.items():
        name = visible(unit.named_in(name))
        if isinstance(value, Mapping):
            lines += [f"{name}:", textwrap.indent(_in_lines(value, unit), "  ")]
        elif value is not None:
            text = str(value)
            if isinstance(value, tuple):
                text = "  ".join(map(str, value))
            aligned = text.replace("\n", "\n" + " " * _NAMES)
            lines.append(f"{name}: ".ljust(_NAMES) + aligned)
    return "\n".join(lines)


def _write_limits(
    report: Report[Description],
    title: str,
    limits: robots.Limits,
    log: robots.LogFormat,
) -> None:
    """Add limits in the unit and sign of the logs."""
    unit = "" if log.q_unit == "1" else f" {log.q_unit}"
    for name, values in vars(limits.scaled(1 / log.q_factor)).items():
        if np.isfinite(values).any():
            numbers = listed(values, ".4g")
            value = f"{numbers}{unit}{_PER_TIME.get(name, '')}"
            report.text(f"{title}: {name} = {{value}}.", value=value)


def _write_training(report: Report[Description], training: Mapping[str, Any]) -> None:
    """Add the notes in the file; a model that was saved by hand may have few."""
    if "held_out" not in training:
        return
    report.text(
        "Fitted to {log}: {rows} rows of {n_whole}, {n_motions} motions. Model: {saved}, "
        "{chosen}. Errors on held-out motions:",
        **{name: training[name] for name in _NOTES},
    )
    errors = {}
    for name, entry in training["held_out"].items():
        errors[name] = HeldOutErrors.read(entry)
    report.errors(errors, ("mean", "p95", "max"))
