"""Figs. 3 and 4 of Reinhart & Steil (2016): tracking of paths with the simulated trunk."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from joblib import delayed
from numpy.typing import NDArray

from hybridkin import (
    ELMRegressor,
    ForwardModel,
    HybridForwardModel,
    InverseKinematics,
    Track,
    robots,
    trajectories,
)
from hybridkin._core.turns import one_thread
from hybridkin.app.workflow.report import Progress, Report, quiet
from hybridkin.ik.trajectories import Trajectory
from hybridkin.plots import (
    ActuatorDisplay,
    ErrorBoxDisplay,
    TrackingDisplay,
    new_figure,
)
from paper.tables import PAPER_ELM, cell, chains_of, mechanical_over_hybrid, run_all
from paper.trunk import TrunkPlant

PAPER_TRACKING = {"mechanical, nominal": 4.16, "hybrid on nominal": 1.67}
"""Mean tracking error of the paper, both paths [cm]."""

PREFERRED = 0.25
"""The preferred posture: straight, at medium elongation [m] (section 4)."""

MODELS = (
    *("mechanical, nominal", "mechanical, calibrated"),
    *("hybrid on nominal", "hybrid on calibrated", "serial on calibrated"),
)
"""Models that control the trunk, in the order of the report."""

_MEASURED_SEED = 7

Tracks: TypeAlias = dict[str, dict[str, Track]]
"""By path and model."""


def tracking(
    models: Mapping[str, ForwardModel],
    paths: Mapping[str, Trajectory],
    plant_parameters: Mapping[str, Any],
    feedback: str | None = "model",
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> Tracks:
    """Return the tracks of the plant, by path and model, for commands computed on each model.

    Parameters
    ----------
    models : dict of str to nn.Module
        Forward models q -> x.
    paths : dict of str to Trajectory
        Target paths [m].
    plant_parameters : dict
        Arguments of `TrunkPlant`.
    feedback : {"model", "measured"} or None, default="model"
        "model": feed-forward, the commands are computed on the model alone; "measured": closed
        loop with the measured tips.
    n_jobs, progress
        As in `table1`.

    Returns
    -------
    dict of dict of Track
        ``result[path][model]``, with the errors of the plant.

    References
    ----------
    Reinhart & Steil (2016), section 4, Figs. 3 and 4.
    """
    pairs = [(path, model) for path in paths for model in models]
    jobs = [delayed(_one_track)(models[m], paths[p], plant_parameters, feedback) for p, m in pairs]
    runs = iter(run_all(jobs, n_jobs, progress, "tracking on the simulated trunk"))
    return {path: {model: next(runs) for model in models} for path in paths}


def paper_paths(n_points: int = 151) -> dict[str, Trajectory]:
    """Return the figure eight and the spiral that `run_paper` tracks, in the trunk's frame."""
    center = (0.0, 0.0, 0.70)
    timing: dict[str, Any] = {
        "duration": 15.0,
        "dt": 15.0 / (n_points - 1),
        "timing": "uniform",
    }
    return {
        "figure eight": trajectories.figure_eight(center, (0.50, 0.25), **timing),
        "spiral": trajectories.spiral(center, (0.05, 0.25), rise=0.08, turns=3.0, **timing),
    }


def tracked_models(q: NDArray, x: NDArray) -> dict[str, HybridForwardModel]:
    """Return the models that control the trunk, fitted to the rows of one split."""
    chains, models = chains_of(q, x), {}
    for name, chain in chains.items():
        elm = ELMRegressor(**PAPER_ELM, random_state=0)
        models[f"mechanical, {name}"] = HybridForwardModel(chain, "drop")
        models[f"hybrid on {name}"] = HybridForwardModel(chain, elm, guard=None)
    models["serial on calibrated"] = HybridForwardModel(
        chains["calibrated"], "quadratic", coupling="serial"
    )
    return {name: models[name].fit(q, x) for name in MODELS}


@one_thread()
def _one_track(
    model: ForwardModel,
    path: Trajectory,
    plant_parameters: Mapping[str, Any],
    feedback: str | None,
) -> Track:
    (low, high), dt = robots.BHA_LENGTH_LIMITS, float(path.t[1] - path.t[0])
    # Each step takes back the whole measured error, as in the paper.
    law: dict[str, Any] = {"q_pref": PREFERRED, "gain": 1.0 / dt, "dt": dt}
    ik = InverseKinematics(model, q_min=low, q_max=high, **law)
    plant = TrunkPlant(**plant_parameters, random_state=_MEASURED_SEED)
    return ik.track(path, plant=plant, feedback=feedback)


def write_tracking(report: Report, paths: Mapping[str, Trajectory], tracks: Tracks) -> None:
    """Add the feed-forward tracks to a report."""
    paper = {name: f"{value:.2f}" for name, value in PAPER_TRACKING.items()}
    errors = {path: {n: track.error for n, track in runs.items()} for path, runs in tracks.items()}
    errors["both"] = {n: np.concatenate([e[n] for e in errors.values()]) for n in MODELS}
    rows, record = [], {}
    for label, by_model in errors.items():
        record[label] = {}
        for name, error in by_model.items():
            lost = int(np.isnan(error).sum())
            record[label][name] = stats = {**_statistics(error), "lost_steps": lost}
            cells = [cell(stats), f"{100 * stats['p95']:.2f}", str(lost)]
            rows.append([label, name, *cells, paper.get(name, "") if label == "both" else ""])
    means = {name: stats["mean"] for name, stats in record["both"].items()}
    ratios = mechanical_over_hybrid(means)
    report.record |= {"tracking": record, "tracking_mechanical_over_hybrid": ratios}
    report.text(
        "## Figs. 3 and 4: tracking on the simulated trunk",
        f"Eq. (1) converts each path of {len(paths['spiral'].x)} points to chamber lengths with "
        "the model alone (feed-forward; preferred posture: straight, 0.25 m), which then move the "
        "simulated trunk with its noise. As in the paper, the networks are trained on the 1900 "
        "rows of one split and have no guard. The serial hybrid (quadratic features, with a guard) "
        "is not in the paper. Tip error in cm: mean ± standard deviation (maximum).",
        f"Mechanical model over hybrid: **{ratios['nominal']:.2f}** for the nominal model, "
        f"{ratios['calibrated']:.2f} for the calibrated one (paper: 2.5, from 4.16 to 1.67 cm).",
    )
    header = [
        "path",
        "model",
        "tracking error",
        "95 %",
        "steps not settled",
        "paper: mean",
    ]
    report.table(header, rows)
    _draw_tracking(report, paths, tracks)


def _draw_tracking(report: Report, paths: Mapping[str, Trajectory], tracks: Tracks) -> None:
    shown = ("mechanical, nominal", "hybrid on nominal")
    figure, axes = new_figure(8.0, 6.4, 2, 2)
    for column, (label, path) in zip(axes.T, paths.items(), strict=True):
        reached = {name: np.asarray(tracks[label][name].x_measured) for name in shown}
        TrackingDisplay(path.x, reached).plot(column[0]).plot_time(column[1])
        column[0].set_title(label)
    report.figure("tracking", figure, "Targets (black) and reached tips (Fig. 3).")
    figure, ax = new_figure(6.0, 3.0)
    ErrorBoxDisplay({f"{p}, {n}": tracks[p][n].error for p in tracks for n in shown}).plot(ax)
    report.figure(
        "tracking_error",
        figure,
        "Tracking error on the simulated trunk (Fig. 4, left).",
    )
    figure, axes = new_figure(6.0, 5.0, 3, 1, sharex=True)
    commanded = {name: tracks["figure eight"][name].q for name in shown}
    ActuatorDisplay(commanded, (3, 3, 3)).plot(axes)
    report.figure("configurations", figure, "Chamber lengths on the figure eight (Fig. 4, right).")


def write_closed_loop(report: Report, feed_forward: Tracks, closed: Tracks) -> None:
    """Add the tracks with feedback of the measured tip to a report."""
    rows, record = [], {}
    for name in MODELS:
        cells, record[name] = [], {}
        for label, tracks in (("feed-forward", feed_forward), ("closed loop", closed)):
            runs = [by_model[name] for by_model in tracks.values()]
            stats = _statistics(np.concatenate([track.error for track in runs]))
            stats["largest_step"] = step = max(track.largest_step for track in runs)
            record[name][label] = stats
            cells += [cell(stats), f"{100 * stats['p95']:.2f}", f"{1e3 * step:.1f}"]
        rows.append([name, *cells])
    report.record["closed_loop"] = record
    report.text(
        "## With feedback of the measured tip",
        "Tip error on both paths in cm: mean ± standard deviation (maximum), 95 % quantile; and "
        "the largest change of a chamber length in one time step, in mm. In the closed loop every "
        "step uses the tip measured after the previous one, with its noise. The correction of the "
        "serial hybrid acts inside the robot; it is not in the paper.",
    )
    report.table(["model", "feed-forward", "95 %", "step", "closed loop", "95 %", "step"], rows)


def _statistics(error: NDArray) -> dict[str, Any]:
    """Return statistics of tip errors [m] over the steps that settled."""
    found = {"mean": np.nanmean(error), "std": np.nanstd(error)}
    return {**found, "p95": np.nanpercentile(error, 95), "max": np.nanmax(error)}
