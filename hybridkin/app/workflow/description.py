"""The report on a model: geometry, training, domain, errors and the choices of its fit."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from hybridkin import robots
from hybridkin.app.workflow.errors import HeldOutErrors
from hybridkin.app.workflow.model import LoadedModel
from hybridkin.app.workflow.report import Report, listed
from hybridkin.formats import visible

_NAMES = 24  # width of the names of rows
_NOTES = ("log", "rows", "n_whole", "n_motions", "saved", "chosen")
_PER_TIME = {"dq_max": "/s", "ddq_max": "/s^2"}


@dataclass(frozen=True, eq=False)
class Description:
    """What a model is, in SI units; entries that are not known are None.

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
    domain : Limits or None
        Training range.
    log_format : LogFormat
        Format of the robot's logs.
    limits : Limits or None
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
    domain: robots.Limits | None
    log_format: robots.LogFormat
    limits: robots.Limits | None
    training: Mapping[str, Any]
    created: str | None
    versions: Mapping[str, str] | None


def describe(loaded: LoadedModel) -> Report[Description]:
    """Return a report on a model.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.

    Returns
    -------
    Report of Description
        Geometry, training, domain, errors and choices.
    """
    header = loaded.header or {}
    robot = loaded.description
    hybrid = loaded.hybrid
    record = Description(
        name=loaded.name,
        path=str(loaded.path),
        kind=type(loaded.model).__name__,
        n_actuators=loaded.n_actuators,
        geometry={} if loaded.chain is None else loaded.chain.geometry(),
        auto=None if hybrid is None else hybrid.cv_results_,
        hysteresis=loaded.hysteresis_widths,
        domain=loaded.trained_range,
        log_format=loaded.log_format(),
        limits=None if robot is None else robot.limits,
        training=loaded.training,
        created=header.get("created"),
        versions=header.get("versions"),
    )
    title = f"{record.name}: {record.kind}, {record.n_actuators} actuators"
    report = Report(title, record)
    if hybrid is None:
        rows = loaded.module.html_rows()
    else:
        rows = hybrid.html_rows()
    report.verbatim(_in_lines(rows))
    if loaded.hysteresis:
        report.text(
            f"The actuators have {loaded.hysteresis.in_words(loaded.log_unit)}."
        )
    log = record.log_format
    for name, limits in {
        "Training range": record.domain,
        "Limits": record.limits,
    }.items():
        if limits is not None:
            _write_limits(report, name, limits, log)
    report.text(
        "Logs: q in {unit}, q_sign {sign} ({q}), x in {x_unit} ({x}).",
        unit=log.q_unit,
        sign=log.q_sign,
        q=", ".join(log.q),
        x_unit=log.x_unit,
        x=", ".join(log.x),
    )
    _write_training(report, record.training)
    if record.versions is not None:
        words = [f"{name} {version}" for name, version in record.versions.items()]
        report.text(
            "Saved on {date} by {versions}.",
            date=record.created,
            versions=", ".join(words),
        )
    return report


def _in_lines(rows: Mapping[str, object]) -> str:
    """Return names and values, one in a line; parts are indented."""
    lines = []
    for name, value in rows.items():
        name = visible(name)
        if isinstance(value, Mapping):
            lines += [f"{name}:", textwrap.indent(_in_lines(value), "  ")]
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
        if values is not None:
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
