"""Table 1 and Figs. 2 to 4 of Reinhart & Steil (2016), on the simulated trunk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from joblib import Parallel, delayed
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from hybridkin import datasets, plots, robots, trajectories
from hybridkin.calibration.calibrate import calibrate
from hybridkin.hybrid.estimator import HybridForwardModel
from hybridkin.ik.solver import InverseKinematics
from hybridkin.learning.elm import ELMRegressor
from hybridkin.paper.identifiability import identifiability, write_identifiability
from hybridkin.simulation import TrunkPlant
from hybridkin.workflow.report import (
    Progress,
    Report,
    check_out,
    distance,
    linear,
    quadratic,
    quiet,
)

PAPER_TABLE_1 = {
    ("mechanical, nominal", "-"): ("", "2.5 (9.3)"),
    ("data-driven", "linear"): ("3.65 ± 3.97 (44)", "9.8 ± 7.8 (43)"),
    ("data-driven", "ELM"): ("0.95 ± 1.17 (13)", "3.4 ± 2.7 (21)"),
    ("hybrid on nominal", "linear"): ("0.81 ± 0.65 (6.1)", "1.8 ± 0.8 (4.4)"),
    ("hybrid on nominal", "ELM"): ("0.57 ± 0.56 (6.5)", "1.3 ± 0.05 (3.6)"),
}
"""Table 1 of the paper, train and test [cm]; its mechanical error is over all 2000 rows."""

PAPER_TRACKING = {"mechanical, nominal": 4.16, "hybrid on nominal": 1.67}
"""Mean tracking error of the paper, both paths [cm]."""

PAPER_ELM = {"n_hidden": 100, "alpha": 0.1}
"""The paper's network, section 3.3."""

PREFERRED = 0.25
"""The preferred posture: straight, at medium elongation [m] (section 4)."""

TRACKED = (
    "mechanical, nominal",
    "mechanical, calibrated",
    "hybrid on nominal",
    "hybrid on calibrated",
)
SERIAL = "serial on calibrated"
_MEASURED_SEED = 7


def table1(
    data: Any,
    n_splits: int = 20,
    n_seeds: int = 5,
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> list[dict[str, Any]]:
    """Return the errors of every model of Table 1 over random test splits and network seeds.

    Parameters
    ----------
    data : Bunch
        With ``q``, ``x`` and ``part``, as from `datasets.load_trunk`.
    n_splits : int, default=20
        Draws of the 100 test rows among the fully random ones.
    n_seeds : int, default=5
        Random hidden layers per split.
    n_jobs : int, optional
        Processes; -1: one per core.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    list of dict
        One entry per model: "model", "learner", and for "train" and "test" the statistics of
        `summary` [m].

    References
    ----------
    Reinhart & Steil (2016), section 3.3, Table 1.
    """
    jobs = (delayed(_one_split)(data.q, data.x, data.part, s, n_seeds) for s in range(n_splits))
    splits = []
    for split in Parallel(n_jobs=n_jobs, return_as="generator")(jobs):
        splits.append(split)
        progress("Table 1, test splits", len(splits), n_splits)
    table = []
    for model, learner in splits[0]:
        entry: dict[str, Any] = {"model": model, "learner": learner}
        for i, part in enumerate(("train", "test")):
            entry[part] = summary([[run[i] for run in split[model, learner]] for split in splits])
        table.append(entry)
    return table


def summary(errors: list[list[NDArray]]) -> dict[str, float]:
    """Return mean, spread and maximum of errors by split and network seed.

    Parameters
    ----------
    errors : list over splits of list over seeds of ndarray of shape (N,)
        Tip distances [m].

    Returns
    -------
    dict
        "mean"; "std": over the configurations of one test, averaged over tests; "max": the
        largest of all; "std_splits": of the mean over splits, seeds averaged; "std_seeds": of the
        mean over seeds, averaged over splits; "mean_max": the maximum of one test, averaged.
    """
    means = np.array([[run.mean() for run in split] for split in errors])
    return {
        "mean": float(means.mean()),
        "std": float(np.mean([[run.std() for run in split] for split in errors])),
        "max": float(max(run.max() for split in errors for run in split)),
        "mean_max": float(np.mean([[run.max() for run in split] for split in errors])),
        "std_splits": float(means.mean(axis=1).std()),
        "std_seeds": float(means.std(axis=1).mean()),
    }


def tracking(
    models: dict[str, Any],
    paths: dict[str, Any],
    plant_parameters: dict[str, Any],
    *,
    feedback: str | None = "model",
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> dict[str, dict[str, Any]]:
    """Return, by path and model, how the plant follows commands computed on each model.

    Parameters
    ----------
    models : dict of str to nn.Module
        Forward models q -> x.
    paths : dict of str to Trajectory
        Target paths [m].
    plant_parameters : dict
        Arguments of `simulation.TrunkPlant`.
    feedback : {"model", "measured"} or None, default="model"
        "model": feed-forward, the commands are computed on the model alone; "measured": the loop is
        closed over the measured tips.
    n_jobs, progress
        As in `table1`.

    Returns
    -------
    dict of dict of Track
        ``result[path][model]``; errors are those of the plant.

    References
    ----------
    Reinhart & Steil (2016), section 4, Figs. 3 and 4.
    """
    pairs = [(path, model) for path in paths for model in models]
    jobs = (delayed(_one_track)(models[m], paths[p], plant_parameters, feedback) for p, m in pairs)
    result: dict[str, dict[str, Any]] = {path: {} for path in paths}
    runs = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
    for i, ((path, model), track) in enumerate(zip(pairs, runs, strict=True)):
        result[path][model] = track
        progress("tracking on the simulated trunk", i + 1, len(pairs))
    return result


def paper_paths(n_points: int = 151) -> dict[str, trajectories.Trajectory]:
    """Return the figure eight and the spiral that `run_paper` tracks, in the trunk's frame."""
    center = (0.0, 0.0, 0.70)
    timing: dict[str, Any] = {"duration": 15.0, "dt": 15.0 / (n_points - 1), "timing": "uniform"}
    return {
        "figure eight": trajectories.figure_eight(center, (0.50, 0.25), **timing),
        "spiral": trajectories.spiral(center, (0.05, 0.25), rise=0.08, turns=3.0, **timing),
    }


@threadpool_limits.wrap(limits=1)  # the processes share the cores already
def _one_split(
    q: NDArray, x: NDArray, part: NDArray, split: int, n_seeds: int
) -> dict[tuple[str, str], list[tuple[NDArray, NDArray]]]:
    """Return (train, test) errors by model and learner, one pair per network seed."""
    train, test = datasets.paper_split(part, split)
    errors: dict[tuple[str, str], list[tuple[NDArray, NDArray]]] = {}

    def record(model: str, learner: str, estimator: HybridForwardModel) -> None:
        estimator.fit(q[train], x[train])
        seen, unseen = (distance(estimator.predict(q[rows]), x[rows]) for rows in (train, test))
        errors.setdefault((model, learner), []).append((seen, unseen))

    chains = _chains(q[train], x[train])
    for name, chain in chains.items():
        record(f"mechanical, {name}", "-", HybridForwardModel(chain, "drop"))
    roles = {"data-driven": None, **{f"hybrid on {name}": c for name, c in chains.items()}}
    for role, chain in roles.items():
        record(role, "linear", HybridForwardModel(chain, linear()))
        record(role, "quadratic", HybridForwardModel(chain, quadratic()))
        for seed in range(n_seeds):
            elm = ELMRegressor(**PAPER_ELM, random_state=1000 * split + seed)
            record(role, "ELM", HybridForwardModel(chain, elm))
    return errors


def _chains(q: NDArray, x: NDArray) -> dict[str, Any]:
    nominal = robots.bionic_handling_assistant()
    return {"nominal": nominal, "calibrated": calibrate(nominal, q, x).chain}


def _tracked_models(q: NDArray, x: NDArray) -> dict[str, HybridForwardModel]:
    models = {}
    for name, chain in _chains(q, x).items():
        elm = ELMRegressor(**PAPER_ELM, random_state=0)
        models[f"mechanical, {name}"] = HybridForwardModel(chain, "drop").fit(q, x)
        models[f"hybrid on {name}"] = HybridForwardModel(chain, elm).fit(q, x)
        if name == "calibrated":
            models[SERIAL] = HybridForwardModel(chain, "quadratic", coupling="serial").fit(q, x)
    return {name: models[name] for name in (*TRACKED, SERIAL)}


@threadpool_limits.wrap(limits=1)
def _one_track(
    model: Any, path: Any, plant_parameters: dict[str, Any], feedback: str | None
) -> Any:
    low, high = robots.BHA_LENGTH_LIMITS
    ik = InverseKinematics(
        model, q_min=low, q_max=high, q_pref=PREFERRED, dt=float(path.t[1] - path.t[0])
    )
    plant = TrunkPlant(**plant_parameters, random_state=_MEASURED_SEED)
    return ik.track(path, plant=plant, feedback=feedback)


def run_paper(
    out: str | Path,
    *,
    n_splits: int = 20,
    n_seeds: int = 5,
    n_points: int = 151,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> tuple[Report, list[Path]]:
    """Reproduce the paper on the simulated trunk and write report.md, report.json and figures.

    Parameters
    ----------
    out : str or Path
        Folder to write into; it is made when absent.
    n_splits, n_seeds, n_jobs, progress
        As in `table1`.
    n_points : int, default=151
        Time steps of each tracked path.

    Returns
    -------
    report : Report
        Its ``record`` holds every number.
    paths : list of Path
        What was written.
    """
    check_out(out)
    TrunkPlant()  # fails at once, with advice, where MuJoCo is missing
    data = datasets.load_trunk()
    table = table1(data, n_splits, n_seeds, n_jobs=n_jobs, progress=progress)
    train, _ = datasets.paper_split(data, 0)
    models = _tracked_models(data.q[train], data.x[train])
    modules = {name: model.module_ for name, model in models.items()}
    paths = paper_paths(n_points)
    plant = data.parameters["plant"]
    tracks, closed = (
        tracking(modules, paths, plant, feedback=feedback, n_jobs=n_jobs, progress=progress)
        for feedback in ("model", "measured")
    )
    report = Report("The paper's result on a simulated trunk")
    report.record.update(n_splits=n_splits, n_seeds=n_seeds, n_points=n_points)
    report.text(
        "Reinhart & Steil (2016) learn the error of a constant-curvature model of Festo's Bionic "
        "Handling Assistant and invert the sum to steer its tip. Here the robot is **simulated** "
        "(MuJoCo; 1 mm noise on the chamber lengths, 0.5 mm on the tip). The paper's own numbers, "
        "from the real robot, stand "
        "beside ours: what can be compared is the order of the models and the factors between "
        "them, not the centimetres.",
    )
    _write_table1(report, table)
    _write_errors(report, data, models)
    _write_tracking(report, paths, tracks)
    _write_closed_loop(report, tracks, closed)
    write_identifiability(report, data, identifiability(data))
    return report, report.write(out)


def _write_table1(report: Report, table: list[dict[str, Any]]) -> None:
    report.record["table1"] = table
    report.text(
        "## Table 1: error of the forward models",
        f"Tip error in cm: mean ± standard deviation over configurations (maximum). "
        f"{report.record['n_splits']} random draws of the 100 test rows among the 500 fully random "
        f"ones, the other 1900 rows for training; networks with {report.record['n_seeds']} random "
        "hidden layers per draw (H = 100, lambda = 0.1). The last columns tell the other two kinds "
        "of spread: of the mean test error over draws of the test set, and over hidden layers.",
    )
    header = ["model", "learner", "train", "paper: train", "test", "paper: test"]
    rows = []
    for entry in table:
        paper = PAPER_TABLE_1.get((entry["model"], entry["learner"]), ("", ""))
        spread = [f"{100 * entry['test'][key]:.2f}" for key in ("std_splits", "std_seeds")]
        cells = [_cell(entry["train"]), paper[0], _cell(entry["test"]), paper[1], *spread]
        rows.append([entry["model"], entry["learner"], *cells])
    report.table([*header, "± test sets", "± hidden layers"], rows)
    test = {(e["model"], e["learner"]): e["test"]["mean"] for e in table}
    report.record["mechanical_over_hybrid"] = ratios = {
        name: test[f"mechanical, {name}", "-"] / test[f"hybrid on {name}", "ELM"]
        for name in ("nominal", "calibrated")
    }
    report.text(
        f"Mechanical over hybrid ELM, test error: **{ratios['nominal']:.2f}** on the nominal "
        f"mechanical model, {ratios['calibrated']:.2f} on the calibrated one (radii and base); "
        'paper: 1.9 (2.5 to 1.3 cm). "Nominal" has the published radii, as in the paper. The '
        "quadratic polynomial is not in the paper; it tells how much of the gain needs a network."
    )
    figure, ax = plots.new_figure(7.0, 3.6)
    names = [f"{e['model']}, {e['learner']}".removesuffix(", -") for e in table]
    means = [100 * e["test"]["mean"] for e in table]
    spreads = [100 * e["test"]["std"] for e in table]
    plots.BarDisplay(names, means, spreads).plot(ax, label="test error [cm]")
    report.figure(
        "table1", figure, "Mean test error, ± one standard deviation over configurations."
    )


def _write_errors(report: Report, data: Any, models: dict[str, HybridForwardModel]) -> None:
    predictions = {name: model.predict(data.q) for name, model in models.items()}
    errors = {name: distance(x, data.x) for name, x in predictions.items()}
    mechanical = "mechanical, nominal"
    report.record["errors_all_rows"] = {
        name: {"mean": e.mean(), "std": e.std(), "max": e.max()} for name, e in errors.items()
    }
    report.text(
        "## Fig. 2: where the mechanical model errs",
        f"All {len(data.q)} rows. Nominal mechanical model: "
        f"mean {100 * errors[mechanical].mean():.2f} cm, maximum "
        f"{100 * errors[mechanical].max():.1f} cm "
        "(paper: 2.5 and 9.3). The hybrid model was trained on 1900 of these rows.",
    )
    figure, ax = plots.new_figure(5.5, 3.4)
    shown = {name: errors[name] for name in (mechanical, "hybrid on nominal")}
    plots.ErrorHistogramDisplay(shown).plot(ax)
    report.figure("error_histogram", figure, "Tip errors over all rows (Fig. 2, right).")
    row = int(np.argsort(errors[mechanical])[int(0.95 * len(data.q))])
    chain = robots.bionic_handling_assistant()
    backbone = chain.backbone(torch.from_numpy(data.q[row])).numpy()
    figure, ax = plots.new_figure(6.0, 5.0, subplot_kw={"projection": "3d"})
    plots.WorkspaceDisplay(data.x, predictions[mechanical], backbone, row).plot(ax)
    report.figure(
        "workspace", figure, "Measured tips and the nominal model's error there (Fig. 2, left)."
    )


def _write_tracking(
    report: Report, paths: dict[str, Any], tracks: dict[str, dict[str, Any]]
) -> None:
    paper = {name: f"{value:.2f}" for name, value in PAPER_TRACKING.items()}
    rows, record = [], {}
    overall = {
        name: np.concatenate([t[name].error for t in tracks.values()])
        for name in (*TRACKED, SERIAL)
    }
    for label, errors in [
        *((p, {n: t.error for n, t in runs.items()}) for p, runs in tracks.items()),
        ("both", overall),
    ]:
        record[label] = {}
        for name, error in errors.items():
            lost = int(np.isnan(error).sum())
            stats = {
                "mean": np.nanmean(error),
                "std": np.nanstd(error),
                "p95": np.nanpercentile(error, 95),
                "max": np.nanmax(error),
                "lost_steps": lost,
            }
            record[label][name] = stats
            cells = [_cell(stats), f"{100 * stats['p95']:.2f}", str(lost)]
            rows.append([label, name, *cells, paper.get(name, "") if label == "both" else ""])
    report.record["tracking"] = record
    both = record["both"]
    ratios = {
        name: both[f"mechanical, {name}"]["mean"] / both[f"hybrid on {name}"]["mean"]
        for name in ("nominal", "calibrated")
    }
    report.record["tracking_mechanical_over_hybrid"] = ratios
    report.text(
        "## Figs. 3 and 4: tracking on the simulated trunk",
        f"Each path of {len(paths['spiral'].x)} points becomes chamber lengths by eq. (1) on "
        "the model alone (feed-forward; preferred posture: straight, 0.25 m), then carried out on "
        "the simulated trunk with its measurement noise. The networks are trained on the 1900 rows "
        "of one split. Tip error in cm: mean ± standard deviation (maximum).",
    )
    header = ["path", "model", "tracking error", "95 %", "steps not settled", "paper: mean"]
    report.table(header, rows)
    report.text(
        f"Mechanical over hybrid: **{ratios['nominal']:.2f}** on the nominal model, "
        f"{ratios['calibrated']:.2f} on the calibrated one (paper: 2.5, from 4.16 to 1.67 cm)."
    )
    shown = ("mechanical, nominal", "hybrid on nominal")
    figure, axes = plots.new_figure(8.0, 6.4, 2, 2)
    for column, (label, path) in zip(axes.T, paths.items(), strict=True):
        reached = {name: tracks[label][name].x_measured for name in shown}
        display = plots.TrackingDisplay(path.x, reached)
        display.plot(column[0])
        display.plot_time(column[1])
        column[0].set_title(label)
    report.figure("tracking", figure, "Targets (black) and reached tips (Fig. 3).")
    figure, ax = plots.new_figure(6.0, 3.0)
    plots.ErrorBoxDisplay({f"{p}, {n}": tracks[p][n].error for p in tracks for n in shown}).plot(ax)
    report.figure("tracking_error", figure, "Tracking error on the simulated trunk (Fig. 4, left).")
    figure, axes = plots.new_figure(6.0, 5.0, 3, 1, sharex=True)
    commanded = {name: tracks["figure eight"][name].q for name in shown}
    plots.ActuatorDisplay(commanded, (3, 3, 3)).plot(axes)
    report.figure(
        "configurations", figure, "Chamber lengths along the figure eight (Fig. 4, right)."
    )


def _write_closed_loop(
    report: Report, feed_forward: dict[str, dict[str, Any]], closed: dict[str, dict[str, Any]]
) -> None:
    rows, record = [], {}
    for name in (*TRACKED, SERIAL):
        cells, record[name] = [], {}
        for label, tracks in (("feed-forward", feed_forward), ("closed loop", closed)):
            error = np.concatenate([runs[name].error for runs in tracks.values()])
            stats = {
                "mean": np.nanmean(error),
                "std": np.nanstd(error),
                "p95": np.nanpercentile(error, 95),
                "max": np.nanmax(error),
                "largest_step": max(runs[name].largest_step for runs in tracks.values()),
            }
            record[name][label] = stats
            cells += [
                _cell(stats),
                f"{100 * stats['p95']:.2f}",
                f"{1e3 * stats['largest_step']:.1f}",
            ]
        rows.append([name, *cells])
    report.record["closed_loop"] = record
    report.text(
        "## With the measured tip fed back",
        "Both paths, in cm: mean ± standard deviation (maximum), 95 %; and the largest change of "
        "a chamber from one time step to the next, in mm. In the closed loop every step takes the "
        "tip measured after the last one, noise included. The serial model has its error inside "
        "the robot; it is not in the paper.",
    )
    header = ["model", "feed-forward", "95 %", "step", "closed loop", "95 %", "step"]
    report.table(header, rows)


def _cell(stats: dict[str, Any]) -> str:
    return f"{100 * stats['mean']:.2f} ± {100 * stats['std']:.2f} ({100 * stats['max']:.1f})"
