"""Table 1 of Reinhart & Steil (2016), on the simulated trunk."""

from __future__ import annotations

from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures
from sklearn.utils import Bunch

from hybridkin import ELMRegressor, HybridForwardModel, calibrate, robots
from hybridkin._core.turns import one_thread
from hybridkin.app.workflow.report import Progress, Report, quiet
from hybridkin.calibration.measured import distance
from hybridkin.chains.chain import Chain
from hybridkin.datasets import paper_split
from hybridkin.plots import model_color, new_figure

QUADRATIC = make_pipeline(MinMaxScaler((-1, 1)), PolynomialFeatures(2), LinearRegression())
"""A quadratic polynomial by least squares."""

PAPER_TABLE_1 = {
    ("mechanical, nominal", "-"): ("", "2.5 (9.3)"),
    ("data-driven", "linear"): ("3.65 ± 3.97 (44)", "9.8 ± 7.8 (43)"),
    ("data-driven", "ELM"): ("0.95 ± 1.17 (13)", "3.4 ± 2.7 (21)"),
    ("hybrid on nominal", "linear"): ("0.81 ± 0.65 (6.1)", "1.8 ± 0.8 (4.4)"),
    ("hybrid on nominal", "ELM"): ("0.57 ± 0.56 (6.5)", "1.3 ± 0.05 (3.6)"),
}
"""Table 1 of the paper, train and test [cm]; its mechanical error is over all 2000 rows."""

PAPER_ELM = {"n_hidden": 100, "alpha": 0.1}
"""The paper's network, section 3.3."""


def table1(
    data: Bunch,
    n_splits: int = 20,
    n_seeds: int = 5,
    *,
    n_jobs: int | None = -1,
    progress: Progress = quiet,
) -> list[dict[str, Any]]:
    """Return the errors of every model of Table 1, over random test splits and network seeds.

    Parameters
    ----------
    data : Bunch
        With ``q``, ``x`` and ``part``, as from `datasets.load_trunk`.
    n_splits : int, default=20
        Number of random draws of the 100 test rows from the fully random ones.
    n_seeds : int, default=5
        Number of random hidden layers per split.
    n_jobs : int, optional
        Number of processes; -1: one per core.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    list of dict
        One entry per model: "model", "learner", and the statistics of `summary` [m] for "train" and
        "test".

    References
    ----------
    Reinhart & Steil (2016), section 3.3, Table 1.
    """
    jobs = [delayed(_one_split)(data.q, data.x, data.part, s, n_seeds) for s in range(n_splits)]
    splits = run_all(jobs, n_jobs, progress, "Table 1, test splits")
    table = []
    for model, learner in splits[0]:
        entry: dict[str, Any] = {"model": model, "learner": learner}
        for i, part in enumerate(("train", "test")):
            entry[part] = summary([[run[i] for run in split[model, learner]] for split in splits])
        table.append(entry)
    return table


def run_all(jobs: list[Any], n_jobs: int | None, progress: Progress, what: str) -> list[Any]:
    """Return the results of delayed jobs, and report progress."""
    results = []
    for result in Parallel(n_jobs=n_jobs, return_as="generator")(jobs):
        results.append(result)
        progress(what, len(results), len(jobs))
    return results


def summary(errors: list[list[NDArray]]) -> dict[str, float]:
    """Return mean, standard deviations and maximum of errors by split and network seed.

    Parameters
    ----------
    errors : list over splits of list over seeds of ndarray of shape (N,)
        Tip distances [m].

    Returns
    -------
    dict
        "mean"; "std": standard deviation over the configurations of one test, averaged over tests;
        "max": the largest of all; "std_splits": standard deviation of the mean over splits (seeds
        averaged); "std_seeds": the same over seeds (splits averaged); "mean_max": mean maximum.
    """
    runs = [[(run.mean(), run.std(), run.max()) for run in split] for split in errors]
    mean, std, top = np.moveaxis(np.array(runs), -1, 0)  # each (splits, seeds)
    found = {
        "mean": mean.mean(),
        "std": std.mean(),
        "max": top.max(),
        "mean_max": top.mean(),
    }
    found |= {
        "std_splits": mean.mean(axis=1).std(),
        "std_seeds": mean.std(axis=1).mean(),
    }
    return {name: float(value) for name, value in found.items()}


@one_thread()  # the processes share the cores already
def _one_split(
    q: NDArray, x: NDArray, part: NDArray, split: int, n_seeds: int
) -> dict[tuple[str, str], list[tuple[NDArray, NDArray]]]:
    """Return (train, test) errors by model and learner, one pair per network seed."""
    train, test = paper_split(part, split)
    errors: dict[tuple[str, str], list[tuple[NDArray, NDArray]]] = {}

    def record(model: str, learner: str, estimator: HybridForwardModel) -> None:
        estimator.fit(q[train], x[train])
        seen, unseen = (distance(estimator.predict(q[rows]), x[rows]) for rows in (train, test))
        errors.setdefault((model, learner), []).append((seen, unseen))

    chains = chains_of(q[train], x[train])
    for name, chain in chains.items():
        record(f"mechanical, {name}", "-", HybridForwardModel(chain, "drop"))
    roles = {
        "data-driven": None,
        **{f"hybrid on {name}": c for name, c in chains.items()},
    }
    for role, chain in roles.items():
        # The paper uses the error model everywhere, without a guard.
        record(role, "linear", HybridForwardModel(chain, LinearRegression(), guard=None))
        record(role, "quadratic", HybridForwardModel(chain, QUADRATIC, guard=None))
        for seed in range(n_seeds):
            elm = ELMRegressor(**PAPER_ELM, random_state=1000 * split + seed)
            record(role, "ELM", HybridForwardModel(chain, elm, guard=None))
    return errors


def chains_of(q: NDArray, x: NDArray) -> dict[str, Chain]:
    """Return the published mechanical model, and the same with calibrated radii and base."""
    nominal = robots.bionic_handling_assistant()
    return {"nominal": nominal, "calibrated": calibrate(nominal, q, x).chain}


def write_table1(report: Report, table: list[dict[str, Any]]) -> None:
    """Add Table 1 to a report, with the numbers of the paper beside ours."""
    report.record["table1"] = table
    means = {e["model"]: e["test"]["mean"] for e in table if e["learner"] in ("-", "ELM")}
    report.record["mechanical_over_hybrid"] = ratios = mechanical_over_hybrid(means)
    report.text(
        "## Table 1: error of the forward models",
        f"Tip error in cm: mean ± standard deviation over configurations (maximum). "
        f"{report.record['n_splits']} random draws of 100 test rows from the 500 fully random "
        f"ones; the other 1900 rows are for training. Networks: {report.record['n_seeds']} random "
        "hidden layers per draw (H = 100, lambda = 0.1). The hybrids have no guard, as in the "
        "paper. The last two columns give the standard deviation of the mean test error over draws "
        "of the test set, and over hidden layers.",
        "Test error of the mechanical model divided by that of the hybrid with an ELM on it: "
        f"**{ratios['nominal']:.2f}** for the nominal model with the published radii, "
        f"{ratios['calibrated']:.2f} for the calibrated model (radii and base); paper: 1.9 (2.5 to "
        "1.3 cm). The quadratic polynomial is not in the paper; it shows if a network is needed.",
    )
    header = ["model", "learner", "train", "paper: train", "test", "paper: test"]
    rows = []
    for entry in table:
        paper = PAPER_TABLE_1.get((entry["model"], entry["learner"]), ("", ""))
        spread = [f"{100 * entry['test'][key]:.2f}" for key in ("std_splits", "std_seeds")]
        cells = [cell(entry["train"]), paper[0], cell(entry["test"]), paper[1], *spread]
        rows.append([entry["model"], entry["learner"], *cells])
    report.table([*header, "± test sets", "± hidden layers"], rows)
    figure, ax = new_figure(7.0, 3.6)
    names = [f"{e['model']}, {e['learner']}".removesuffix(", -") for e in table]
    means, spreads = (100 * np.array([e["test"][key] for e in table]) for key in ("mean", "std"))
    places = np.arange(len(table))[::-1]
    for name, mean, spread, place in zip(names, means, spreads, places, strict=True):
        look = {"fmt": "o", "capsize": 3, "color": model_color(name)}
        ax.errorbar(mean, place, xerr=[[min(mean, spread)], [spread]], **look)
    published = [paper_test_error(entry) for entry in table]
    means, spreads = 100 * np.array(published).T
    look = {"fmt": "x", "capsize": 3, "color": "black", "elinewidth": 0.8}
    below = [np.minimum(means, spreads), spreads]
    ax.errorbar(means, places - 0.3, xerr=below, label="paper, real robot", **look)
    ax.set_yticks(places, names)
    ax.set(xlabel="test error [cm]", xlim=(0.0, None))
    ax.legend(frameon=False, loc="lower right")
    caption = (
        "Mean test error ± standard deviation over configurations: dots on the simulated trunk"
    )
    report.figure("table1", figure, f"{caption}, crosses the paper's, on the real robot.")


def paper_test_error(entry: dict[str, Any]) -> tuple[float, float]:
    """Return mean and standard deviation [m] of the paper's test error, NaN where it has none."""
    _, text = PAPER_TABLE_1.get((entry["model"], entry["learner"]), ("", "nan"))
    mean, spread, *_ = *text.partition(" (")[0].split(" ± "), "nan", "nan"
    return 0.01 * float(mean), 0.01 * float(spread)


def mechanical_over_hybrid(means: dict[str, float]) -> dict[str, float]:
    """Return the mean error of each mechanical model divided by that of the hybrid on it."""
    names = ("nominal", "calibrated")
    return {name: means[f"mechanical, {name}"] / means[f"hybrid on {name}"] for name in names}


def cell(stats: dict[str, Any]) -> str:
    """Return mean ± standard deviation (maximum) as text, converted from metres to centimetres."""
    return f"{100 * stats['mean']:.2f} ± {100 * stats['std']:.2f} ({100 * stats['max']:.1f})"
