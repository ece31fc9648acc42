"""Gradient boosting and random forests on the residual and alone: errors on groups held out.

The table of the docs page "Results", section "Trees"::

    python examples/studies/trees.py

About five minutes of processor time. The recordings are in the folder that ``--data`` or
HYBRIDKIN_DATA names; an absent one is left out. Whole groups (lines of a grid, motions, runs, days)
are held out in five folds.
"""

from __future__ import annotations

import argparse
import time
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from bellows import GEOMETRY, Recording, nominal
from hybrid_cases import (
    AUTO,
    CALIBRATED,
    DATA_ONLY,
    NOMINAL,
    Robot,
    armlab,
    asl_trunk,
    plain_ftdcr,
)
from sklearn.ensemble import HistGradientBoostingRegressor, RandomForestRegressor
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GroupKFold
from sklearn.multioutput import MultiOutputRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures

from hybridkin import HybridForwardModel

BOOSTING = MultiOutputRegressor(HistGradientBoostingRegressor(random_state=0))
FOREST = RandomForestRegressor(random_state=0)
QUADRATIC = make_pipeline(
    MinMaxScaler((-1, 1)),
    PolynomialFeatures(2, include_bias=False),
    RidgeCV(np.logspace(-6, 3, 19)),
)
MOST = 500  # training rows


def models(robot: Robot) -> dict[str, Any]:
    """Return the models by name."""

    def hybrid(error_model: Any, names: Any = robot.calibrate) -> HybridForwardModel:
        return HybridForwardModel(robot.chain, error_model, calibrate=names, random_state=0)

    return {
        NOMINAL: hybrid("drop", robot.frame),
        CALIBRATED: hybrid("drop"),
        DATA_ONLY[0]: QUADRATIC,
        "data alone, boosting": BOOSTING,
        "data alone, forest": FOREST,
        "quadratic on the residual": hybrid(QUADRATIC),
        "boosting on the residual": hybrid(BOOSTING),
        "forest on the residual": hybrid(FOREST),
        AUTO: HybridForwardModel(robot.chain, AUTO, random_state=0),
    }


def errors(robot: Robot) -> dict[str, list[float]]:
    """Return the mean tip error of every fold [mm], by model."""
    found: dict[str, list[float]] = {}
    folds = GroupKFold(5, shuffle=True, random_state=0)
    for train, test in folds.split(robot.q, groups=robot.groups):
        rows = train[:: max(1, round(len(train) / MOST))]
        for name, model in models(robot).items():
            motions = {}
            if isinstance(model, HybridForwardModel):
                motions = {"groups": robot.groups[rows]}
            model.fit(robot.q[rows], robot.x[rows], **motions)
            wrong = (model.predict(robot.q[test]) - robot.x[test])[:, -3:]
            mean = 1e3 * np.linalg.norm(wrong, axis=1).mean()
            found.setdefault(name, []).append(float(mean))
    return found


def bellows(data_home: Path | None) -> Robot | None:
    """Return asu_bellows at rest, groups are days; None where it is absent."""
    try:
        data = Recording(data_home)
    except FileNotFoundError as missing:
        warnings.warn(f"Left out: {missing}", stacklevel=2)
        return None
    rest = data.rest
    rows = data.q[rest], data.x[rest], data.days[rest]
    return Robot("asu_bellows", nominal(), ("base",), GEOMETRY, *rows)


def cells(robot: Robot) -> tuple[str, dict[str, str]]:
    """Return the head and the cells of a column of the table, by model."""
    found = errors(robot)
    column = {}
    for name, folds in found.items():
        column[name] = f"{np.mean(folds):.2f} ± {np.std(folds, ddof=1):.2f}"
    n_groups = len(np.unique(robot.groups))
    return f"{robot.name} ({len(robot.q)} rows, {n_groups} groups)", column


def main() -> None:
    """Print the table: mean of the folds ± their standard deviation, mm."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    options = parser.parse_args()
    warnings.simplefilter("ignore")
    columns: dict[str, dict[str, str]] = {}
    for load in (bellows, plain_ftdcr, asl_trunk, armlab):
        robot = load(options.data)
        if robot is not None:
            head, column = cells(robot)
            columns[head] = column
    print("| model | " + " | ".join(columns) + " |")
    print("| --- " * (1 + len(columns)) + "|")
    for name in next(iter(columns.values())):
        print(f"| {name} | " + " | ".join(column[name] for column in columns.values()) + " |")
    print(f"\n{time.process_time():.0f} s of processor time")


if __name__ == "__main__":
    main()
