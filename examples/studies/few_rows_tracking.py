"""How well a tip follows the paper's paths with models of 25, 100 and 1900 rows, simulated.

    python examples/studies/few_rows_tracking.py --out results/few_rows_tracking

Five minutes on two cores. few_rows_tracking.csv has the table. It needs `hybridkin[sim]` (MuJoCo).
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from csv_tables import add_csv
from numpy.typing import NDArray
from simulated_trunk import PAPER_ELM
from threadpoolctl import threadpool_limits

from hybridkin import ELMRegressor, HybridForwardModel, datasets, robots
from hybridkin.app.workflow.report import Report
from paper.tables import QUADRATIC
from paper.tracks import Tracks, paper_paths, tracking

SIZES = (25, 100, 1900)
ELM = "hybrid on nominal, the paper's ELM"
DATA = "data alone, quadratic"
LOOPS = {"without feedback": "model", "with feedback": "measured"}
"""Column of the table by the `feedback` of `InverseKinematics.track`."""


def few_rows_tracking(
    sizes: Sequence[int] = SIZES,
    n_draws: int = 3,
    *,
    n_points: int = 151,
    n_jobs: int | None = -1,
) -> list[dict[str, Any]]:
    """Return tracking errors of the simulated trunk for models of few and of many rows.

    The rows are the first of the 1900 training rows of the paper's protocol, with its noise, in
    random order. Paths, plant and its noise are those of `paper.tracks`.

    Parameters
    ----------
    sizes : sequence of int
        Numbers of rows; the paper's network and the data alone have the largest.
    n_draws : int, default=3
        Number of random orders.
    n_points : int, default=151
        Time steps of each path.
    n_jobs : int, optional
        Number of processes; -1: one per core.

    Returns
    -------
    list of dict
        One entry per model, number of rows, loop and draw: "model", "n", "loop", "draw", and
        "error", the tip errors of both paths [m].
    """
    data = datasets.load_trunk()
    paths = paper_paths(n_points)
    plant = data.parameters["plant"]
    entries = []
    for draw in range(n_draws):
        train, _ = datasets.paper_split(data, random_state=draw)
        rows = np.random.default_rng(draw).permutation(train)
        models = fitted_models(data.q[rows], data.x[rows], sizes)
        for loop, feedback in LOOPS.items():
            tracks = tracking(models, paths, plant, feedback, n_jobs=n_jobs)
            for model, n in models:
                error = _errors(tracks, (model, n))
                entries.append({"model": model, "n": n, "loop": loop, "draw": draw, "error": error})
    return entries


@threadpool_limits.wrap(limits=1)
def fitted_models(
    q: NDArray, x: NDArray, sizes: Sequence[int]
) -> dict[tuple[str, int], HybridForwardModel]:
    """Return the fitted models by name and number of rows."""
    chain = robots.bionic_handling_assistant()
    network = ELMRegressor(**PAPER_ELM, random_state=0)
    models = {}
    for n in sizes:
        models["mechanical, calibrated", n] = HybridForwardModel(chain, "drop", calibrate="default")
    for n in sizes:
        models["auto", n] = HybridForwardModel(chain, "auto", random_state=0)
    models[ELM, max(sizes)] = HybridForwardModel(chain, network, guard=None)
    models[DATA, max(sizes)] = HybridForwardModel(None, QUADRATIC, guard=None)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of few rows
        for (_, n), model in models.items():
            model.fit(q[:n], x[:n])
    return models


def _errors(tracks: Tracks, model: Any) -> NDArray:
    """Return the tip errors [m] of a model on all paths."""
    return np.concatenate([by_model[model].error for by_model in tracks.values()])


def report_of(entries: list[dict[str, Any]]) -> Report:
    """Return the report: mean ± standard deviation over the draws (largest error), in mm."""
    report = Report("Tracking with models of few rows (simulated)", {})
    lines = []
    for model, n in dict.fromkeys((e["model"], e["n"]) for e in entries):
        line = [model, str(n)]
        for loop in LOOPS:
            errors = [
                1e3 * e["error"]
                for e in entries
                if (e["model"], e["n"], e["loop"]) == (model, n, loop)
            ]
            means = [np.nanmean(error) for error in errors]
            largest = np.nanmax(errors)
            line.append(f"{np.mean(means):.2f} ± {np.std(means):.2f} ({largest:.1f})")
        lines.append(line)
    report.text(
        "Tip error on both paths in mm: mean ± standard deviation over the draws (largest of all). "
        "Steps in which the trunk did not settle are left out: "
        f"{sum(int(np.isnan(e['error']).sum()) for e in entries)}."
    )
    report.table(["model", "rows", *LOOPS], lines)
    header = ["model", "rows", *(f"{loop} [mm]" for loop in LOOPS)]
    add_csv(report, "few_rows_tracking.csv", header, lines)
    return report


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", default="results/few_rows_tracking", help="folder")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--points", type=int, default=151, help="time steps of a path")
    parser.add_argument("--jobs", type=int, default=-1, help="processes; -1: all cores")
    options = parser.parse_args(argv)
    entries = few_rows_tracking(n_draws=options.draws, n_points=options.points, n_jobs=options.jobs)
    report = report_of(entries)
    report.write(options.out)
    print(report.plain())


if __name__ == "__main__":
    main()
