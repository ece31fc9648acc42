"""What the paper's sampling protocol tells about the simulated trunk's geometry."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from hybridkin import datasets, robots
from hybridkin.calibration.calibrate import calibrate
from hybridkin.workflow.report import (
    GEOMETRY_HEADER,
    IDENTIFIED,
    Report,
    distance,
    geometry_entries,
    geometry_rows,
)

ASKED = ("radii", "turns", "rest_bends", "actuator_zeros", "tool", "base")
"""The geometry that `identifiability` asks for at once."""

TELLABLE = ("radii", "rest_bends", "tool", "base")
"""What remains of it where each thing that the samples cannot tell apart is asked for once."""


def identifiability(data: Any, split: int = 0) -> dict[str, Any]:
    """Return what the training rows of the paper's protocol tell about the trunk's geometry.

    Parameters
    ----------
    data : Bunch
        As for `table1`.
    split : int, default=0
        Which of the fully random rows are kept for the test.

    Returns
    -------
    dict
        "n_train", "n_single" (rows in which one segment moves) and "n_random"; then by "asked",
        "tellable" and "default" (radii and base) a dict of "parameters", "entries" (one for each
        free parameter, see `geometry_entries`), "unidentified" (a sentence for each direction
        left open), and "rmse", "test" and "test_max", tip errors on the training rows and on the
        test rows [m].
    """
    train, test = datasets.paper_split(data, split)
    chain = robots.bionic_handling_assistant()
    n_random = int((data.part[train] == 3).sum())
    found: dict[str, Any] = {"n_train": len(train), "n_random": n_random}
    found["n_single"] = len(train) - n_random
    for label, names in (
        ("asked", ASKED),
        ("tellable", TELLABLE),
        ("default", chain.default_parameters),
    ):
        result = calibrate(chain, data.q[train], data.x[train], names)
        with torch.no_grad():
            tips = result.chain(torch.from_numpy(data.q[test])).numpy()
        errors = distance(tips, data.x[test])
        found[label] = {
            "parameters": names,
            "entries": geometry_entries(chain, result),
            "unidentified": result.unidentified,
            "rmse": result.rmse,
            "test": errors.mean(),
            "test_max": errors.max(),
        }
    return found


def write_identifiability(report: Report, data: Any, found: dict[str, Any]) -> None:
    """Add what `identifiability` found to a report."""
    report.record["identifiability"] = found
    asked, tellable, default = (found[label] for label in ("asked", "tellable", "default"))
    identified = sum(entry["identified"] for entry in asked["entries"])
    report.text(
        "## What the samples tell about the geometry",
        f"Everything asked at once ({', '.join(ASKED)}) of the {found['n_train']} training rows of "
        f"one split of the **simulated** data: {found['n_single']} rows of one segment moving "
        f"alone and {found['n_random']} fully random ones. A parameter is identified where the "
        f"rows narrow its prior at least {IDENTIFIED:.0f} times; other values are assumptions, "
        f"near the published geometry. Identified: {identified} of {len(asked['entries'])} "
        "parameters. The base by its turn from the start and its position.",
    )
    report.table(GEOMETRY_HEADER, geometry_rows(asked["entries"]))
    report.text("What the samples leave open, and what settles it:")
    report.text("\n".join(f"- {sentence}" for sentence in asked["unidentified"]))
    report.text(
        f"Without turns and actuator zeros ({', '.join(TELLABLE)}) all is identified:"
        if all(entry["identified"] for entry in tellable["entries"])
        else f"Without turns and actuator zeros ({', '.join(TELLABLE)}):"
    )
    report.table(GEOMETRY_HEADER, geometry_rows(tellable["entries"]))
    base = {entry["name"]: entry for entry in tellable["entries"]}
    true = dict(zip("xyz", 1e3 * np.array(data.parameters["plant"]["base_error"][:3]), strict=True))
    away = {axis: base[f"base[{axis}]"]["value"] - true[axis] for axis in true}
    far = max(abs(away[axis]) / base[f"base[{axis}]"]["std_error"] for axis in away)
    found["base_position_error"] = list(away.values())
    report.text(
        "The tip hardly cares: mean error on the 100 test rows "
        f"{100 * asked['test']:.2f} cm with everything fitted, {100 * tellable['test']:.2f} cm "
        f"without turns and actuator zeros, {100 * default['test']:.2f} cm with radii and base "
        "alone. Standard errors say how far noise moves a value, not how far a wrong model does: "
        f"the simulated trunk sags and is no chain of arcs ({100 * tellable['rmse']:.2f} cm rms "
        "remain), and its base, known in the simulation, is missed by "
        f"{', '.join(f'{value:+.1f}' for value in away.values())} mm, up to {far:.0f} standard "
        "errors."
    )
