"""A model on a log: errors by motion, the share it vouches for, where in space it errs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin import plots, robots
from hybridkin.workflow._fit_report import write_check
from hybridkin.workflow.log import OnCheck, check, not_told, read_log
from hybridkin.workflow.model import OpenedModel
from hybridkin.workflow.report import Report, check_out, distance

_COLUMNS = ("mean", "median", "p95", "max")


def evaluate_log(
    opened: OpenedModel,
    log: str | Path,
    out: str | Path | None = None,
    *,
    log_format: robots.LogFormat | None = None,
    exclude: Sequence[str] = (),
    drop_invalid: bool = False,
    drop_frozen: bool = False,
    delimiter: str | None = None,
    force: bool = False,
    on_check: OnCheck = not_told,
) -> tuple[Report, list[Path]]:
    """Return the errors of a model on a log, and write them with figures when asked to.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    log : str or Path
        CSV, npz or parquet file.
    out : str or Path, optional
        Folder to write into. Default: nothing is written.
    log_format : LogFormat, optional
        How the log is written. Default: as the robot's description says.
    exclude, drop_invalid, drop_frozen, delimiter, force, on_check
        As for `fit_log`.

    Returns
    -------
    report : Report
        Its ``record`` holds "all" and "motions" with mean, median, p95 and max [m], and where the
        model knows them "share_in_domain" and "share_in_radius".
    paths : list of Path
        What was written.
    """
    if out is not None:
        check_out(out)
    log_format = log_format or opened.log_format()
    data = read_log(
        log,
        log_format,
        chain=opened.chain if opened.path.suffix == ".toml" else None,
        base_is_free=False,
        exclude=exclude,
        drop_invalid=drop_invalid,
        drop_frozen=drop_frozen,
        delimiter=delimiter,
    )
    if data.q.shape[1] != opened.n_actuators:
        raise ValueError(
            f"`q` must name {opened.n_actuators} columns, as many as the model has actuators, got "
            f"{data.q.shape[1]}."
        )
    check(data, on_check, force)
    motion = data.motions if data.named else np.zeros(len(data.q))  # else it is one
    if opened.play is not None:
        data.check_order("A model with play")
    predicted = opened.predict(data.q, motion)
    errors = distance(predicted, data.x)
    inside = opened.in_domain(data.q, motion)
    radius = None
    if getattr(opened.model, "radius_", None) is not None:
        radius = opened.model.predict(data.q, return_radius=True, groups=motion)[1]
    names = list(dict.fromkeys(data.motions.tolist()))
    motions = {str(name): _entry(errors, inside, radius, data.motions == name) for name in names}
    everything = _entry(errors, inside, radius, np.ones(len(errors), dtype=bool))
    report = Report(f"{opened.name}: errors on {Path(log).name}")
    report.record.update(
        model=str(opened.path), log=str(log), all=everything, motions=motions, split=data.split
    )
    if radius is not None:
        report.record["coverage_asked"] = opened.model.radius_.coverage
    write_check(report, data)
    _write_errors(report, everything, motions)
    if out is None:
        return report, []
    figure, ax = plots.new_figure(6.0, 3.6)
    plots.ErrorHistogramDisplay({opened.name: errors}).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors of all rows.")
    figure, ax = plots.new_figure(6.4, 5.2, subplot_kw={"projection": "3d"})
    row = int(np.argsort(errors)[int(0.95 * len(errors))])
    display = plots.WorkspaceDisplay(data.x, predicted, _body(opened, data.q, motion, row), row)
    display.plot(ax, unit="mm")
    report.figure("workspace", figure, "Measured tips, coloured by the model's error.")
    return report, report.write(out)


def _body(opened: OpenedModel, q: NDArray, motion: NDArray, row: int) -> NDArray | None:
    """Return points along the robot in one row (P, 3) [m], where the model has a body."""
    if not hasattr(opened.chain, "backbone"):
        return None
    effective = opened.effective(q, motion)[row]
    return plots.BackboneDisplay.from_estimator(opened.chain, effective).points[0]


def _entry(
    errors: NDArray, inside: NDArray | None, radius: NDArray | None, rows: NDArray
) -> dict[str, Any]:
    part = errors[rows]
    entry: dict[str, Any] = {"rows": int(rows.sum()), "mean": part.mean()}
    entry |= {"median": np.median(part), "p95": np.percentile(part, 95), "max": part.max()}
    if inside is not None:
        entry["share_in_domain"] = inside[rows].mean()
    if radius is not None:
        entry["share_in_radius"] = (part <= radius[rows]).mean()
    return entry


def _write_errors(
    report: Report, everything: dict[str, Any], motions: dict[str, dict[str, Any]]
) -> None:
    header = ["motion", "rows", *_COLUMNS]
    shares = [key for key in everything if key.startswith("share")]
    header += [key.replace("share_", "").replace("_", " ") + " [%]" for key in shares]
    rows = []
    for name, entry in {"all": everything, **motions}.items():
        cells = [f"{1000 * entry[key]:.2f}" for key in _COLUMNS]
        cells += [f"{100 * entry[key]:.0f}" for key in shares]
        rows.append([name, str(entry["rows"]), *cells])
    report.text("## Tip errors [mm]")
    report.table(header, rows)
