"""What the report of a fit to a measured log says."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin import plots
from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.workflow.log import MeasuredLog
from hybridkin.workflow.report import (
    GEOMETRY_HEADER,
    TOLD,
    Report,
    geometry_entries,
    geometry_rows,
)

_SHOWN = ("mechanical, calibrated", "hybrid, ELM", "hybrid, auto")


def write_check(report: Report, log: MeasuredLog) -> None:
    """Add what the check of the log found."""
    report.record["log_check"] = log.report.to_dict()
    report.text(f"## The log\n\nIts check found {log.report.summary()}.")
    findings = log.report.findings
    if findings:
        report.table(
            ["severity", "what", "found", "advice"],
            [[f.severity, f.kind, f.message, f.advice] for f in findings],
        )


def write_comparison(
    report: Report,
    errors: dict[str, NDArray],
    fold: NDArray,
    log: MeasuredLog,
    n_whole: int,
    n_hidden: int,
) -> None:
    """Add the errors on motions held out: table, figures, and the motions that are worst."""
    n_folds, motions = int(fold.max()) + 1, log.motions
    thinned = "" if n_whole == len(motions) else f" (of {n_whole}, evenly thinned)"
    report.text(
        "## On motions it has not seen",
        f"{len(motions)} rows{thinned}, {len(np.unique(motions))} {log.split}, held out whole in "
        f"{n_folds} folds; ELM with {n_hidden} neurons, ridge weight and guard chosen by motions "
        f"held out within the training part, {report.record['n_seeds']} random hidden layers. "
        '"Auto" chooses coupling, features and penalties by motions held out there as well. '
        '"Nominal" has the geometry of the robot description with only the base pose fitted, '
        "when that is among the calibrated. Tip error in mm.",
    )
    rows, record = [], {}
    for name, values in errors.items():
        by_fold = np.array([values[fold == k].mean() for k in range(n_folds)])
        record[name] = {
            "mean": values.mean(),
            "std": values.std(),
            "p95": np.percentile(values, 95),
            "max": values.max(),
            "std_folds": by_fold.std(),
            "by_fold": by_fold,
        }
        columns = ("mean", "std", "p95", "max", "std_folds")
        rows.append([name, *(f"{1000 * record[name][column]:.2f}" for column in columns)])
    report.record["held_out"] = record
    report.table(["model", "mean", "std over rows", "95 %", "max", "std over folds"], rows)
    best = min(record, key=lambda name: record[name]["mean"])
    present = [name for name in _SHOWN if name in record]
    calibrated, *hybrids = (record[name]["mean"] for name in present)
    ratios = [
        f"over {name}: **{calibrated / mean:.2f}**"
        for name, mean in zip(present[1:], hybrids, strict=True)
    ]
    report.text(f"Calibrated mechanical model {', '.join(ratios)}. Least mean error: {best}.")
    figure, ax = plots.new_figure(7.0, 3.9)
    plots.ErrorBoxDisplay(errors).plot(ax, unit="mm")
    ax.set_xlim(0.0, 1100 * float(np.percentile(errors["mechanical, nominal"], 99)))
    report.figure(
        "held_out",
        figure,
        "Tip error on motions held out: quartiles, 5 and 95 %; larger errors lie beyond the axis.",
    )
    figure, ax = plots.new_figure(5.5, 3.4)
    shown = (present[0], present[-1])
    plots.ErrorHistogramDisplay({name: errors[name] for name in shown}).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors on motions held out.")
    names = np.unique(motions)
    means = {n: [1000 * errors[n][motions == name].mean() for name in names] for n in present}
    worst = np.argsort(means[present[-1]])[::-1][:5]
    report.text(f"The five motions that {present[-1]} predicts worst, mean error in mm:")
    report.table(
        ["motion", "rows", *present],
        [
            [
                str(names[i]),
                str((motions == names[i]).sum()),
                *(f"{means[n][i]:.1f}" for n in present),
            ]
            for i in worst
        ],
    )


def auto_entry(model: Any) -> dict[str, Any]:
    """Return what a fitted HybridForwardModel with error_model="auto" chose.

    Returns
    -------
    dict
        "chosen"; "weights" of the parts; "mechanical_models" by name with their mean distance on
        motions left out [m], and which was "taken"; "candidates" with the same distance [m]; "play"
        of every actuator [m], None without.
    """
    found = model.cv_results_
    width = None if model.play_ is None else np.ravel(model.play_.width).tolist()
    return {
        "chosen": str(found["chosen"]),
        "weights": {name: float(w) for name, w in found["weights"].items() if w > 0.0},
        "taken": type(model.mechanical_model_).__name__,
        "mechanical_models": {name: float(e) for name, e in found["mechanical_model"].items()},
        "candidates": dict(
            zip(found["candidate"], np.asarray(found["mean_distance"]).tolist(), strict=True)
        ),
        "play": width,
        "play_asked": model.play is not None,
    }


def auto_in_short(entry: dict[str, Any]) -> str:
    """Return in a few words what auto chose: parts, mechanical model, play."""
    weights = sorted(entry["weights"].items(), key=lambda item: -item[1])
    words = weights[0][0]
    if len(weights) > 1:
        words = "blend of " + ", ".join(f"{w:.1f} {name}" for name, w in weights)
    if len(entry["mechanical_models"]) > 1:
        words += f" on {entry['taken']}"
    if entry["play"] is not None:
        words += f", play {1e3 * max(entry['play']):.3g} mm"
    return words


def auto_in_words(entry: dict[str, Any]) -> list[str]:
    """Return in sentences what auto compared, by motions left out, and what it took."""
    said = []
    tried = sorted(entry["mechanical_models"].items(), key=lambda item: item[1])
    if len(tried) > 1:
        (best, least), (other, more) = tried[:2]
        said.append(
            f"Auto compared two mechanical models, each calibrated: {best} errs by "
            f"{1e3 * least:.2f} mm on motions left out, {other} by {1e3 * more:.2f} mm. It took "
            f"{entry['taken']}."
        )
    candidates = entry["candidates"]
    alone = min((e, name) for name, e in candidates.items() if name != "blend")
    if len(entry["weights"]) > 1:
        said.append(
            "The blend of auto is the weighted mean of several hybrids: "
            f"{1e3 * candidates['blend']:.2f} mm on motions left out, {1e3 * alone[0]:.2f} mm with "
            f"the best of them alone ({alone[1]}), {1e3 * candidates['mechanical']:.2f} mm without "
            "any."
        )
    else:
        said.append(
            f"Auto took the error model {alone[1]}: {1e3 * alone[0]:.2f} mm on motions left out, "
            f"{1e3 * candidates['mechanical']:.2f} mm without any."
        )
    if entry["play"] is not None:
        said.append(
            f"Play of the actuators: {1e3 * max(entry['play']):.3g} mm. Predictions follow the "
            "order of the rows, motion by motion."
        )
    elif entry["play_asked"]:
        said.append("Play of the actuators was looked for; none was worth its while.")
    return said


def write_auto(report: Report, entry: dict[str, Any]) -> None:
    """Add what auto chose for the model that is saved."""
    report.record["auto"] = {**entry, "words": auto_in_words(entry)}
    report.text(" ".join(report.record["auto"]["words"]))


def write_calibration(
    report: Report,
    chain: Any,
    result: CalibrationResult,
    warned: list[str],
    title: str = "Calibration on all motions",
    key: str = "calibration",
) -> None:
    """Add what the calibration found, and what the log leaves open, to the record as `key`."""
    entries = geometry_entries(chain, result)
    report.text(
        f"## {title}",
        f"Root mean square tip error {1000 * result.rmse:.2f} mm. Standard errors count every row "
        "as independent and are too small where rows follow each other closely. What narrows the "
        f"prior of a parameter less than {TOLD:.0f} times does not tell it: its value is an "
        "assumption. The base by its turn from the start and its position.",
    )
    report.table(GEOMETRY_HEADER, geometry_rows(entries))
    report.text(*(f"Warning: {message}" for message in warned))
    if result.unidentified:
        report.text("What the log leaves open:", *(f"- {line}" for line in result.unidentified))
    report.record[key] = {
        "values": result.values,
        "std_errors": result.std_errors,
        "rmse": result.rmse,
        "warnings": warned,
        "identifiable": result.identifiable,
        "entries": entries,
        "unidentified": result.unidentified,
    }
