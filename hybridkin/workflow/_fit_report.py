"""The text, tables and figures of the report of a fit to a measured log."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin.calibration.calibrate import CalibrationResult
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.chains.chain import Chain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.plots import ErrorBoxDisplay, ErrorHistogramDisplay, new_figure
from hybridkin.workflow.log import MeasuredLog
from hybridkin.workflow.model import play_widths
from hybridkin.workflow.report import (
    IDENTIFIED,
    Report,
    geometry_entries,
    millimetres,
    statistics,
)

_SHOWN = (
    "mechanical, calibrated",
    "data-driven, linear",  # of a robot without segments
    "hybrid, ELM",
    "hybrid, parallel ELM",
    "hybrid, auto",
)
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


def write_check(report: Report, log: MeasuredLog) -> None:
    """Add the findings of the check of the log."""
    report.record["log_check"] = log.report.to_dict()
    report.text(f"## The log\n\nThe check of the log found {log.report.summary()}.")
    for f in log.report.findings:
        report.text(f"- **{f.severity}**, {f.kind}: {f.message} Advice: {f.advice}")


def write_comparison(
    report: Report, errors: dict[str, NDArray], fold: NDArray, log: MeasuredLog
) -> None:
    """Add the errors on held-out motions: table, figures, and the motions of largest error."""
    n = len(log.q)
    n_whole = report.record["n_whole"]
    n_folds = int(fold.max()) + 1
    thinned = "" if n_whole == n else f" (of {n_whole}, evenly thinned)"
    report.text(
        "## Errors on held-out motions",
        f"{n} rows{thinned}, {len(np.unique(log.motions))} {log.split}. Each of {n_folds} folds "
        "holds out whole motions. The other motions choose and fit everything: geometry, features, "
        "penalties and blend.",
        _kinds_of_models(errors),
    )
    record: dict[str, dict[str, Any]] = {}
    for name, values in errors.items():
        by_fold = np.array([values[fold == k].mean() for k in range(n_folds)])
        record[name] = {**statistics(values, log.motions), "by_fold": by_fold}
        record[name]["std_folds"] = by_fold.std()
    report.record["held_out"] = record
    report.errors(record, ("mean", "std_error", "std", "p95", "max", "std_folds"))
    report.text(
        "Std: standard deviation. The standard error of the mean counts every motion as one "
        "sample, because rows of a motion have similar errors. 95 %: quantile over rows."
    )
    present = [name for name in _SHOWN if name in record]
    first, *rivals = ((name, record[name]["mean"]) for name in present)
    ratios = [f"by that of {name}: **{first[1] / mean:.2f}**" for name, mean in rivals]
    best = min(record, key=lambda name: record[name]["mean"])
    start = "the calibrated model" if present[0] == _SHOWN[0] else "the linear model"
    report.text(
        f"Mean error of {start} divided {', '.join(ratios)}. Least mean error: {best}."
    )
    _add_figures(report, errors, (present[0], present[-1]))
    motions, counts = np.unique(log.motions, return_counts=True)
    of_present = np.column_stack([errors[name] for name in present])
    means = np.array([of_present[log.motions == m].mean(axis=0) for m in motions])
    report.text(
        f"Mean errors in mm of the five motions with the largest errors of {present[-1]}:"
    )
    rows = []
    for i in np.argsort(means[:, -1])[::-1][:5]:
        in_mm = [f"{1e3 * mean:.1f}" for mean in means[i]]
        rows.append([str(motions[i]), str(counts[i]), *in_mm])
    report.table(["motion", "rows", *present], rows)
    saved = report.record["saved"]
    chosen = report.record["chosen"]
    by_fold = "; ".join(
        choices.get(saved, "-") for choices in report.record["choices_by_fold"]
    )
    reason = "It has the least mean error of the models that can be saved."
    if saved == "hybrid, auto":
        reason = "It chooses among the other hybrids itself."
    report.text(
        f"Saved: **{saved}**, fitted to all motions: {chosen}. {reason} Settings chosen in each "
        f"fold: {by_fold}."
    )


def _kinds_of_models(errors: dict[str, NDArray]) -> str:
    """Return what the names of the compared models mean."""
    words = _MECHANICAL if _SHOWN[0] in errors else _NO_MECHANICAL
    if "mechanical, with backlash" in errors:
        words += _WITH_BACKLASH
    if "hybrid, auto" in errors:
        words += _AUTO
    return words


def write_markers(report: Report, errors: NDArray, what: str) -> None:
    """Add the errors (N, K) of several markers, one by one; NaN: not measured."""
    if errors.shape[1] == 1:
        return
    measured = [column[~np.isnan(column)] for column in errors.T]
    entries = [{"rows": len(column), **statistics(column)} for column in measured]
    report.record["markers"] = entries
    report.text(
        f"Errors of the markers, base to tip ({what}). Other tables give their mean."
    )
    columns = ("rows", "mean", "p95", "max")
    report.errors({f"marker {k}": entry for k, entry in enumerate(entries)}, columns)


def _add_figures(
    report: Report, errors: dict[str, NDArray], shown: tuple[str, str]
) -> None:
    figure, ax = new_figure(8.0, 1.5 + 0.32 * len(errors))
    ErrorBoxDisplay(errors).plot(ax, unit="mm")
    caption = "Tip error on held-out motions: quartiles, 5 and 95 %; larger errors as numbers."
    report.figure("held_out", figure, caption)
    figure, ax = new_figure(5.5, 3.8)
    ErrorHistogramDisplay({name: errors[name] for name in shown}).plot(ax, unit="mm")
    ax.set(ylabel="rows")
    report.figure("error_histogram", figure, "Tip errors on held-out motions.")


def auto_entry(model: HybridForwardModel) -> dict[str, Any]:
    """Return the choices of a fitted HybridForwardModel with error_model="auto".

    Returns
    -------
    dict
        "chosen"; "weights" of the parts; "mechanical_models": for each set of parameters the mean
        error on held-out motions, "cv", and outside the fitted rows, "io" [m]; the "taken" set;
        "candidates" with their held-out error [m]; the error "expected" on new motions [m]; "play"
        of every actuator [m] or None; "words".
    """
    results = model.cv_results_ or {}
    entry = {
        "chosen": str(results["chosen"]),
        "weights": {
            name: float(w) for name, w in results["weights"].items() if w > 0.0
        },
        "taken": results.get("parameters", type(model.mechanical_model_).__name__),
        "mechanical_models": results["mechanical_model"],
        "candidates": dict(
            zip(results["candidate"], map(float, results["mean_distance"]), strict=True)
        ),
        "expected": float(results["expected_distance"]),
        "play": play_widths(model),
        "play_asked": model.play is not None,
    }
    return {**entry, "words": _in_words(entry)}


def write_model(report: Report, model: HybridForwardModel) -> None:
    """Add the choices of auto and the estimated error radius, if the model has them."""
    if model.cv_results_ is not None:
        report.record["auto"] = auto_entry(model)
        report.text(" ".join(report.record["auto"]["words"]))
    if (radius := radius_entry(model)) is not None:
        report.record["radius"] = radius
        report.text(radius["words"])


def radius_entry(model: HybridForwardModel) -> dict[str, Any] | None:
    """Return the estimated error radius of a model, also in "words"; None without one."""
    if model.radius_ is None:
        return None
    radius = model.radius_
    text = (
        f"not known; at least {radius.least_groups} motions in the domain are needed."
    )
    if np.isfinite(radius.inside):
        text = f"{1e3 * radius.inside:.3g} mm, in the domain and for motions as in the log."
    words = f"Estimated error radius covering {100 * radius.coverage:g} % of the tips: {text}"
    return {**radius._asdict(), "words": words}


def auto_in_short(entry: dict[str, Any]) -> str:
    """Return the choices of auto in a few words: parts, mechanical model, backlash."""
    weights = sorted(entry["weights"].items(), key=lambda item: -item[1])
    words = weights[0][0]
    if len(weights) > 1:
        words = "blend of " + ", ".join(f"{w:.1f} {name}" for name, w in weights)
    if len(entry["mechanical_models"]) > 1:
        words += f" on {entry['taken']}"
    return words + (
        "" if entry["play"] is None else f", backlash {millimetres(entry['play'])}"
    )


def _in_words(entry: dict[str, Any]) -> list[str]:
    """Return the choices of auto, and the errors it compared, in sentences."""
    sentences = []
    tried = entry["mechanical_models"]
    if len(tried) > 1:
        sentences.append(
            f"Of {len(tried)} sets of parameters, auto calibrates {_of_set(entry['taken'], tried)}."
        )
    candidates = entry["candidates"]
    # A single candidate is named even if another one has less error: a gain must be clear.
    if len(entry["weights"]) > 1:
        names = {*candidates} - {"blend"}
    else:
        names = {*entry["weights"]}
    least, alone = min((candidates[name], name) for name in names)
    best = f"{1e3 * least:.2f} mm"
    without = f"{1e3 * candidates['mechanical']:.2f} mm without one."
    text = f"Auto chose the error model {alone}: {best} on held-out motions, {without}"
    if alone == "mechanical":
        text = f"Auto chose no error model: {best} on held-out motions; none is clearly better."
    if len(entry["weights"]) > 1:
        text = (
            "Auto chose a blend, the weighted mean of several hybrids: "
            f"{1e3 * candidates['blend']:.2f} mm on held-out motions, {best} with the best of them "
            f"alone ({alone}), {without}"
        )
    sentences += [
        text,
        f"Expected on new motions like these: {1e3 * entry['expected']:.2f} mm.",
    ]
    if entry["play"] is not None:
        width = millimetres(entry["play"])
        order = "Predictions depend on the order of the rows in a motion."
        sentences.append(f"Backlash (play) of the actuators: {width}. {order}")
    elif entry["play_asked"]:
        sentences.append(
            "Auto looked for backlash (play), but it did not lower the errors."
        )
    return sentences


def _of_set(name: str, errors: dict[str, dict[str, float]]) -> str:
    """Return a set of parameters in words, with its errors on held-out and on outer rows."""
    cv, io = (errors[name].get(key, np.nan) for key in ("cv", "io"))
    outside = "" if np.isnan(io) else f", {1e3 * io:.2f} mm outside the fitted rows"
    return f"{name}: {1e3 * cv:.2f} mm on held-out motions{outside}"


def write_choice(report: Report, geometry: GeometryChoice) -> None:
    """Add the set of parameters that is calibrated, and the errors of all tried sets."""
    tried = {name: errors.known() for name, errors in geometry.errors.items()}
    report.record["parameters"] = {"taken": geometry.name, "tried": tried}
    report.text(
        "## What is calibrated",
        f"Calibrated: **{geometry.name}**. The table has mean tip errors in mm: on held-out "
        "motions, and outside, on the outer 35 % of the rows after a fit to the inner 40 %. Sets "
        "with more than 1.1 times the least held-out error are excluded. The score of the others "
        "is the held-out error times the square of the error outside. Of the sets with nearly the "
        "least score, the one with the fewest parameters is calibrated.",
    )
    rows = [
        [n, *(f"{1e3 * e:.2f}" for e in errors)]
        for n, errors in geometry.errors.items()
    ]
    report.table(["parameters", "held-out motions", "outside"], rows)


def write_calibration(
    report: Report,
    chain: Chain,
    result: CalibrationResult,
    warnings: list[str],
    title: str = "Calibration on all motions",
    key: str = "calibration",
    others: Sequence[dict[str, Any]] = (),
) -> None:
    """Add the result of the calibration, and what the log does not identify.

    `others` are entries of other calibrations with nearly the same errors.
    """
    report.text(
        f"## {title}",
        f"Root mean square tip error {1000 * result.rmse:.2f} mm (training rows). Standard errors "
        "assume independent rows and are too small for rows close in time. A parameter is "
        f"identified if the data narrow its prior at least {IDENTIFIED:.0f} times, and if sets of "
        "parameters with nearly the same errors give values that differ by less than a tenth of "
        'the prior; other values are assumptions. "Not physical": this parameter, or another of '
        "its kind, has an impossible value, because it compensates an effect that the model does "
        "not describe. "
        "The base is given by its rotation from the start and its position.",
    )
    entries = geometry_entries(chain, result)
    for entry in entries:
        entry["identified"] &= _agrees(entry, others)
    report.geometry(entries)
    report.text(*(f"Warning: {message}" for message in warnings))
    if result.unidentified:
        report.text("What the log does not identify:")
        report.text("\n".join(f"- {line}" for line in result.unidentified))
    names = ("values", "std_errors", "rmse", "identifiable", "unidentified")
    report.record[key] = {name: vars(result)[name] for name in names}
    report.record[key] |= {"warnings": warnings, "entries": entries}


def _agrees(entry: dict[str, Any], others: Sequence[dict[str, Any]]) -> bool:
    """Return whether other calibrations change a value by less than a tenth of its prior."""
    prior = entry["narrowing"] * entry["std_error"]
    jumps = [
        abs(one["value"] - entry["value"])
        for one in others
        if one["name"] == entry["name"]
    ]
    if entry["unit"] == "deg":
        jumps = [min(jump, abs(360.0 - jump)) for jump in jumps]  # angles repeat
    return bool(IDENTIFIED * max(jumps, default=0.0) <= prior)


def write_elastic_calibration(
    report: Report, chain: Chain, model: HybridForwardModel
) -> None:
    """Add the calibration of the elastic tendons if auto chose them instead of the chain."""
    if (
        isinstance(model.mechanical_model_, ElasticTendonChain)
        and model.calibration_ is not None
    ):
        if isinstance(chain, ConstantCurvatureChain):
            chain = ElasticTendonChain.from_chain(chain)
        title = "Calibration of the elastic tendons that auto chose"
        write_calibration(
            report, chain, model.calibration_, [], title, "calibration_of_saved"
        )
