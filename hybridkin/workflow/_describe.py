"""The report on a model: geometry, training, domain, errors and the choices of its fit."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from hybridkin._core.arrays import real_array
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain
from hybridkin.chains.robots import Limits, LogFormat
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.workflow._fit_report import auto_entry, auto_in_short, radius_entry
from hybridkin.workflow.model import LoadedModel
from hybridkin.workflow.report import Report, in_millimetres, millimetres


def describe(loaded: LoadedModel) -> Report:
    """Return a report on a model; its record is in SI units and degrees.

    Parameters
    ----------
    loaded : LoadedModel
        The model, as from `open_model`.

    Returns
    -------
    Report
        Its ``record`` holds "kind", "n_actuators", "geometry" of the chain, "error_model",
        "training", "domain", "radius", "play" (width [m]), "auto", "log_format", "limits", and
        "created" and "versions" of the program that wrote the file. Unknown entries are None.
    """
    header = loaded.header or {}
    description = loaded.description
    hybrid = loaded.hybrid
    kind = type(loaded.model).__name__
    trained = loaded.trained_range
    log_format = None if description is None else description.log
    report = Report(f"{loaded.name}: {kind}, {loaded.n_actuators} actuators")
    report.record = {
        "name": loaded.name,
        "path": str(loaded.path),
        "kind": kind,
        "n_actuators": loaded.n_actuators,
        "geometry": None if loaded.chain is None else geometry(loaded.chain),
        "error_model": None,
        "play": loaded.play_width,
        "auto": None,
        "radius": None,
        "domain": None if trained is None else dict(vars(trained)),
        "log_format": None if log_format is None else dict(vars(log_format)),
        "limits": None if description is None else dict(vars(description.limits)),
        "training": header.get("training"),
        "created": header.get("created"),
        "versions": header.get("versions"),
    }
    if hybrid is not None:
        report.record |= _of_hybrid(hybrid)
    _write_geometry(report, report.record["geometry"])
    _write_model(report, loaded)
    _write_training(report, report.record["training"] or {})
    return report


def _of_hybrid(model: HybridForwardModel) -> dict[str, Any]:
    calibrated = [*(model.calibrate or ())]
    if isinstance(model.calibrate, str):
        calibrated = [model.calibrate]
    auto = None
    error: dict[str, Any] = {"kind": "none", "coupling": model.coupling}
    if model.error_model_ is not None:
        error["kind"] = type(model.error_model_).__name__
    if model.cv_results_ is not None:
        auto = auto_entry(model)
        error = {"kind": auto_in_short(auto), "coupling": None}
        calibrated = calibrated or [auto["taken"]]
    error |= {"guard": model.guard, "calibrated": calibrated}
    return {"error_model": error, "radius": radius_entry(model), "auto": auto}


def geometry(chain: Chain) -> dict[str, Any]:
    """Return the geometry of a chain.

    Returns
    -------
    dict
        "kind"; "base" position [m] and rotation vector [deg]. For chains of arcs also "routing" and
        "segments", each with radius, length and offset [m], angles and rest bend [deg], gain if it
        is not 1 [m per unit of q], and for elastic tendons stiffnesses.
    """
    pose = real_array(chain.base, "base")
    turn = Rotation.from_matrix(pose[:3, :3]).as_rotvec(degrees=True)
    base = {"position": pose[:3, 3], "rotation_vector_deg": turn}
    entries: dict[str, Any] = {"kind": type(chain).__name__, "base": base}
    if not isinstance(chain, ArcChain):
        return entries
    parts = {name: real_array(value, name) for name, value in chain.geometry().items()}
    ends = np.cumsum(chain.actuators_per_segment)[:-1]
    lengths = iter(parts.get("lengths", ()))
    columns = {
        "radius": parts["radii"],
        "length": [None if own else next(lengths) for own in chain.extensible],
        "offset": parts["offsets"],
        "angles_deg": np.split(np.degrees(parts["angles"]), ends),
        "rest_bend_deg": np.degrees(parts["rest_bends"].reshape(-1, 2)),
    }
    if not chain.in_metres:
        columns["gain"] = np.split(parts["gains"], ends)
    for name in ("bending_stiffness", "axial_stiffness"):
        if name in parts:
            columns[name] = parts[name].ravel()
    segments = []
    for row in zip(*columns.values(), strict=True):
        segments.append(dict(zip(columns, row, strict=True)))
    if chain.stage is not None:
        entries["stage"] = chain.stage
    return {**entries, "routing": chain.routing, "segments": segments}


def _write_geometry(report: Report, geometry: dict[str, Any] | None) -> None:
    if geometry is None:
        report.text("No mechanical model.")
        return
    parts = [
        f", {key} {geometry[key]}" for key in ("stage", "routing") if key in geometry
    ]
    report.text(f"Mechanical model: {geometry['kind']}{''.join(parts)}.")
    rows = []
    for k, entry in enumerate(geometry.get("segments", [])):
        if entry["length"] is None:
            length = "extensible"
        else:
            length = f"{1e3 * entry['length']:.2f}"
        cells = [
            f"{k + 1}",
            f"{1e3 * entry['radius']:.3f}",
            length,
            f"{1e3 * entry['offset']:.2f}",
        ]
        rows.append(
            [*cells, ", ".join(f"{angle:.1f}" for angle in entry["angles_deg"])]
        )
    if rows:
        header = [
            "segment",
            "radius [mm]",
            "length [mm]",
            "offset [mm]",
            "actuators at [deg]",
        ]
        report.table(header, rows)
    turn = ", ".join(f"{v:.1f}" for v in geometry["base"]["rotation_vector_deg"])
    position = in_millimetres(geometry["base"]["position"])
    report.text(f"Base at {position}, rotation vector ({turn}) deg.")


def _write_model(report: Report, loaded: LoadedModel) -> None:
    """Add error model, radius, backlash, training range, limits and the format of the logs.

    Training range and limits are in the unit and sign of the logs, if these are known.
    """
    record = report.record
    description = loaded.description
    lengths = isinstance(loaded.chain, ArcChain) and loaded.chain.in_metres
    log_format = LogFormat((), (), "mm" if lengths else "1")
    if description is not None and description.log is not None:
        log_format = description.log
    if record["error_model"] is not None:
        kind, coupling, guard, _ = record["error_model"].values()
        parts = [kind, coupling, f"guard {guard or 'none'}"]
        report.text(f"Error model: {', '.join(part for part in parts if part)}.")
    if record["radius"] is not None:
        report.text(record["radius"]["words"])
    if record["play"] is not None:
        report.text(f"Backlash (play) of the actuators: {millimetres(record['play'])}.")
    if loaded.trained_range is not None:
        _write_limits(report, "Training range:", loaded.trained_range, log_format)
    if description is not None:
        _write_limits(report, "Limits:", description.limits, log_format)
    if record["log_format"] is not None:
        q, x, q_unit, x_unit, q_sign, *_ = record["log_format"].values()
        columns = f"q in {q_unit}, q_sign {q_sign} ({', '.join(q)}), x in {x_unit} ({', '.join(x)})"
        report.text(f"Logs: {columns}.")


def _write_limits(
    report: Report, what: str, limits: Limits, log_format: LogFormat
) -> None:
    """Add limits in the unit and sign of the logs."""
    unit = "" if log_format.q_unit == "1" else f" {log_format.q_unit}"
    per_time = {"dq_max": "/s", "ddq_max": "/s^2"}
    for name, values in vars(limits.scaled(1 / log_format.q_factor)).items():
        if values is not None:
            numbers = ", ".join(f"{value:.4g}" for value in values)
            report.text(f"{what} {name} = {numbers}{unit}{per_time.get(name, '')}.")


def _write_training(report: Report, training: dict[str, Any]) -> None:
    """Add the training notes in the file; a model that was saved by hand may have few."""
    if "log" in training:
        if training["n_whole"] == training["rows"]:
            thinned = ""
        else:
            thinned = f" of {training['n_whole']}"
        report.text(
            f"Fitted to {training['log']}: {training['rows']}{thinned} rows, "
            f"{training['n_motions']} motions. Model: {training['saved']}, {training['chosen']}. "
            "Errors on held-out motions:"
        )
        report.errors(training["held_out"], ("mean", "p95", "max"))
    elif "rows" in training:
        report.text(f"Fitted to {training['rows']} rows.")
    if report.record["auto"] is not None:
        report.text(" ".join(report.record["auto"]["words"]))
    if report.record["versions"] is not None:
        versions = ", ".join(
            f"{name} {value}" for name, value in report.record["versions"].items()
        )
        report.text(f"Saved on {report.record['created']} by {versions}.")
