"""The report that reproduces the paper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from sklearn.utils import Bunch

from hybridkin import HybridForwardModel, robots
from hybridkin.app.workflow.report import Progress, Report, check_out, quiet
from hybridkin.calibration.measured import distance
from hybridkin.datasets import load_trunk, paper_split
from hybridkin.plots import ErrorHistogramDisplay, WorkspaceDisplay, new_figure
from paper import tables, tracks
from paper.identifiability import identifiability, write_identifiability
from paper.trunk import TrunkPlant


def run_paper(
    out: str | Path,
    *,
    n_splits: int = 20,
    n_seeds: int = 5,
    n_points: int = 151,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Reproduce the paper on the simulated trunk; write and return a report with figures.

    Parameters
    ----------
    out : str or Path
        Folder to write into; it is created if needed.
    n_splits, n_seeds, n_jobs, progress
        As in `table1`.
    n_points : int, default=151
        Number of time steps of each tracked path.

    Returns
    -------
    report : Report
        Its ``record`` holds every number.
    paths : list of Path
        The written files.
    """
    check_out(out, "paper", force=True)  # the folder is its own
    TrunkPlant()  # fails at once, with advice, if MuJoCo is missing
    data = load_trunk()
    table = tables.table1(data, n_splits, n_seeds, n_jobs=n_jobs, progress=progress)
    train, _ = paper_split(data, 0)
    models = tracks.tracked_models(data.q[train], data.x[train])
    modules = {name: model.module_ for name, model in models.items()}
    paths, plant = tracks.paper_paths(n_points), data.parameters["plant"]
    feed_forward, closed = (
        tracks.tracking(modules, paths, plant, feedback, n_jobs=n_jobs, progress=progress)
        for feedback in ("model", "measured")
    )
    report = Report("The paper's result on a simulated trunk", {})
    report.record.update(n_splits=n_splits, n_seeds=n_seeds, n_points=n_points)
    report.text(
        "Reinhart & Steil (2016) learn the error of a constant-curvature model of Festo's Bionic "
        "Handling Assistant and invert the sum to control its tip. Here the robot is **simulated** "
        "(MuJoCo; 1 mm noise on the chamber lengths, 0.5 mm on the tip). The numbers of the paper "
        "are from the real robot. Compare the order of the models and the ratios of their errors, "
        "not the centimetres.",
    )
    tables.write_table1(report, table)
    _write_errors(report, data, models)
    tracks.write_tracking(report, paths, feed_forward)
    tracks.write_closed_loop(report, feed_forward, closed)
    write_identifiability(report, data, identifiability(data))
    return report, report.write(out)


def _write_errors(report: Report, data: Bunch, models: dict[str, HybridForwardModel]) -> None:
    """Add Fig. 2 to a report."""
    predictions = {name: model.predict(data.q) for name, model in models.items()}
    errors = {name: distance(x, data.x) for name, x in predictions.items()}
    mechanical = "mechanical, nominal"
    report.record["errors_all_rows"] = {
        name: {"mean": e.mean(), "std": e.std(), "max": e.max()} for name, e in errors.items()
    }
    report.text(
        "## Fig. 2: errors of the mechanical model",
        f"All {len(data.q)} rows. Nominal model: mean "
        f"{100 * errors[mechanical].mean():.2f} cm, maximum "
        f"{100 * errors[mechanical].max():.1f} cm (paper: 2.5 and 9.3). The hybrid model was "
        "trained on 1900 of these rows.",
    )
    figure, ax = new_figure(5.5, 3.4)
    shown = {name: errors[name] for name in (mechanical, "hybrid on nominal")}
    ErrorHistogramDisplay(shown).plot(ax)
    report.figure("error_histogram", figure, "Tip errors over all rows (Fig. 2, right).")
    row = int(np.argsort(errors[mechanical])[int(0.95 * len(data.q))])
    chain = robots.bionic_handling_assistant()
    backbone = chain.backbone(torch.from_numpy(data.q[row])).numpy()
    figure, ax = new_figure(6.0, 5.0, subplot_kw={"projection": "3d"})
    WorkspaceDisplay(data.x, predictions[mechanical], backbone, row).plot(ax)
    report.figure("workspace", figure, "Measured tips; error of the nominal model (Fig. 2, left).")
