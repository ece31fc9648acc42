"""ELMRegressor and ELMRegressorCV against other learners: errors on five folds, time per fit.

The tables of the docs page "Results", section "Learners"::

    python examples/studies/learners.py --out results/learners

About half an hour on one core. The folder gets report.md, report.json and the figure. To compare
learners or sets of your own, pass them to `compare_learners` and `time_learners`.
"""

from __future__ import annotations

import argparse
import sys
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from simulated_trunk import PAPER_ELM
from sklearn.compose import TransformedTargetRegressor
from sklearn.datasets import (
    load_diabetes,
    make_friedman1,
    make_friedman2,
    make_friedman3,
)
from sklearn.exceptions import ConvergenceWarning
from sklearn.gaussian_process import GaussianProcessRegressor
from sklearn.gaussian_process.kernels import RBF, ConstantKernel, WhiteKernel
from sklearn.kernel_ridge import KernelRidge
from sklearn.linear_model import RidgeCV
from sklearn.model_selection import GridSearchCV, KFold
from sklearn.neural_network import MLPRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import StandardScaler
from threadpoolctl import threadpool_limits

from hybridkin import (
    ELMRegressor,
    ELMRegressorCV,
    RigidChain,
    calibrate,
    datasets,
    plots,
    robots,
)
from hybridkin.app.workflow.report import Report

_LOOKS = ("o-#0072B2", "s-#D55E00", "D-#009E73", "^-#CC79A7")

Learner = Callable[[int, int], Any]
"""Makes an estimator from the number of inputs and a seed."""

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""

Rows = tuple[NDArray, NDArray]
"""Inputs (N, d) and targets (N,) or (N, m)."""


def _scaled(regressor: Any) -> Any:
    """Return the regressor with standardised inputs and targets."""
    pipeline = make_pipeline(StandardScaler(), regressor)
    return TransformedTargetRegressor(pipeline, transformer=StandardScaler())


def _tuned(regressor: Any, seed: int, **grid: Any) -> Any:
    folds = KFold(5, shuffle=True, random_state=seed)
    return _scaled(GridSearchCV(regressor, grid, cv=folds))


def _gaussian_process(scales: Any) -> Any:
    kernel = ConstantKernel(1.0, (1e-3, 1e5)) * RBF(scales, (1e-2, 1e4)) + WhiteKernel(0.1)
    return _scaled(GaussianProcessRegressor(kernel))


LEARNERS: dict[str, Learner] = {
    "ELMRegressor": lambda d, seed: ELMRegressor(**PAPER_ELM, random_state=seed),
    "ELMRegressorCV": lambda d, seed: ELMRegressorCV(random_state=seed),
    "RidgeCV": lambda d, seed: _scaled(RidgeCV(np.logspace(-3, 4, 15))),
    "KernelRidge": lambda d, seed: _tuned(
        KernelRidge(kernel="rbf"),
        seed,
        alpha=np.logspace(-5, 1, 7),
        gamma=np.logspace(-3, 0, 7),
    ),
    "MLP": lambda d, seed: _tuned(
        MLPRegressor(max_iter=2000, early_stopping=True, random_state=seed),
        seed,
        hidden_layer_sizes=[(100,), (100, 100)],
    ),
    "GP": lambda d, seed: _gaussian_process(np.sqrt(d)),
    "GP, ARD": lambda d, seed: _gaussian_process(np.full(d, np.sqrt(d))),
}
"""Learners of the table by name."""

TIMED = {name: LEARNERS[name] for name in ("ELMRegressorCV", "KernelRidge", "GP")} | {
    "KernelRidge, untuned": lambda d, seed: _scaled(KernelRidge(kernel="rbf"))
}
"""Learners of the speed curve."""


def make_arm(n_samples: int = 2000, random_state: int = 0, swing: float = np.pi / 2) -> Rows:
    """Return a simulated arm in the manner of kin8nm: 8 angles [rad], distance of the hand [mm].

    Eight revolute joints, links of 63 to 188 mm and twists drawn at random; angles uniform in
    -+ `swing`; distance of the hand from a point, plus noise of 10 % of the spread.
    """
    rng = np.random.default_rng(random_state)
    links, twists = rng.uniform(0.5, 1.5, 8) / 8, rng.uniform(-np.pi, np.pi, 8)
    point = 0.25 * rng.standard_normal(3)
    origins = np.tile(np.eye(4), (8, 1, 1))
    for origin, link, twist in zip(origins[1:], links, twists, strict=False):
        c, s = np.cos(twist), np.sin(twist)
        origin[1:3, 1:3], origin[0, 3] = [[c, -s], [s, c]], link
    arm = RigidChain(origins, [[0, 0, 1]] * 8, tool=[links[-1], 0, 0])
    q = rng.uniform(-swing, swing, (n_samples, 8))
    y = 1000 * np.linalg.norm(arm(torch.from_numpy(q)).numpy() - point, axis=1)
    return _noisy(q, y, rng)


def learning_sets(n_samples: int = 2000, random_state: int = 0) -> dict[str, Rows]:
    """Return the sets of the table by name; those that are generated have `n_samples` rows.

    Diabetes and Friedman 1 to 3 are those of scikit-learn, Friedman 1 with noise 1, 2 and 3 with
    10 % of the spread. Trunk: the residual of the calibrated chain on rows of the simulated
    `datasets.load_trunk`, 2000 at most [mm]; these rows have no groups.
    """
    rng = np.random.default_rng(random_state)
    diabetes: Any = load_diabetes()
    seeded: dict[str, Any] = {"n_samples": n_samples, "random_state": random_state}
    data = datasets.load_trunk()
    rows = rng.permutation(len(data.q))[:n_samples]
    q, x = data.q[rows], data.x[rows]
    chain = calibrate(robots.bionic_handling_assistant(), q, x).chain
    residual = x - chain(torch.from_numpy(q)).numpy()
    return {
        "diabetes": (diabetes.data, diabetes.target),
        "Friedman 1": make_friedman1(noise=1.0, **seeded),
        "Friedman 2": _noisy(*make_friedman2(**seeded), rng),
        "Friedman 3": _noisy(*make_friedman3(**seeded), rng),
        "arm": make_arm(n_samples, random_state),
        "trunk": (q, 1000 * residual),
    }


def compare_learners(
    sets: Mapping[str, Rows] | None = None,
    learners: Mapping[str, Learner] | None = None,
    *,
    n_folds: int = 5,
    random_state: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the error and the time of every learner on every set, over the same random folds.

    Parameters
    ----------
    sets, learners : mapping of str to Rows and to Learner, optional
        Default: `learning_sets` and `LEARNERS`.
    n_folds, random_state : int, default=5 and 0
        Folds of rows drawn at random; fold k is learned with the seed ``random_state + k``.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    list of dict
        One entry per set and learner: "set", "learner", "n" (rows), "n_inputs"; by fold "seeds",
        "rmse" (of several outputs that of the distance) and "seconds" (CPU time of the fit,
        choices included).
    """
    sets = learning_sets(random_state=random_state) if sets is None else sets
    learners = LEARNERS if learners is None else learners
    splitter = KFold(n_folds, shuffle=True, random_state=random_state)
    seeds = [random_state + k for k in range(n_folds)]
    table: list[dict[str, Any]] = []
    for name, (X, y) in sets.items():
        folds = list(zip(splitter.split(X), seeds, strict=True))
        for label, learner in learners.items():
            runs = [_fit(learner, X, y, train, test, seed) for (train, test), seed in folds]
            rmse, seconds = (list(values) for values in zip(*runs, strict=True))
            entry = {"set": name, "learner": label, "n": len(X), "n_inputs": X.shape[1]}
            table.append({**entry, "seeds": seeds, "rmse": rmse, "seconds": seconds})
            if progress is not None:
                progress(f"{label} on {name}", len(table), len(sets) * len(learners))
    return table


def time_learners(
    learners: Mapping[str, Learner] | None = None,
    sizes: Sequence[int] = (250, 500, 1000, 2000, 4000),
    *,
    longest: float = 60.0,
    n_test: int = 2000,
    random_state: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return CPU time per fit and the error reached against the number of rows, on the arm.

    Parameters
    ----------
    learners : mapping of str to Learner, optional
        Default: `TIMED`.
    sizes : sequence of int, default=(250, 500, 1000, 2000, 4000)
        Training rows, ascending.
    longest : float, default=60.0
        A learner whose fit took more CPU seconds is not tried on more rows.
    n_test : int, default=2000
        Test rows.
    random_state, progress
        As in `compare_learners`.

    Returns
    -------
    list of dict
        One entry per fit: "learner", "n", "seconds" (CPU time) and "rmse" [mm].
    """
    learners = TIMED if learners is None else learners
    X, y = make_arm(n_test + max(sizes), random_state)
    test, rows = np.split(np.arange(len(X)), [n_test])
    curve = []
    for done, (name, learner) in enumerate(learners.items(), 1):
        for n in sizes:
            rmse, seconds = _fit(learner, X, y, rows[:n], test, random_state)
            curve.append({"learner": name, "n": n, "seconds": seconds, "rmse": rmse})
            if seconds > longest:
                break
        if progress is not None:
            progress(f"time per fit of {name}", done, len(learners))
    return curve


def learners_report(table: list[dict[str, Any]], curve: list[dict[str, Any]]) -> Report:
    """Return the report of what `compare_learners` and `time_learners` returned.

    Parameters
    ----------
    table : list of dict
        As from `compare_learners`.
    curve : list of dict
        As from `time_learners`.

    Returns
    -------
    Report
        Tables of errors and CPU times, and a figure; ``report.write(folder)`` writes them.
    """
    report = Report("Learners compared", {})
    report.record.update(table=table, curve=curve)
    header = ["set", *dict.fromkeys(entry["learner"] for entry in table)]
    errors, seconds = [], []
    for name in dict.fromkeys(entry["set"] for entry in table):
        row = [entry for entry in table if entry["set"] == name]
        label = f"{name}, {row[0]['n']} x {row[0]['n_inputs']}"
        mean, std = np.array([(np.mean(e["rmse"]), np.std(e["rmse"], ddof=1)) for e in row]).T
        cells = [f"{m:.4g} ± {s:.2g}" for m, s in zip(mean, std, strict=True)]
        cells[mean.argmin()] = f"**{cells[mean.argmin()]}**"
        errors.append([label, *cells])
        seconds.append([label, *(f"{np.mean(entry['seconds']):.2g}" for entry in row)])
    report.text("Root mean square error on held-out rows, mean ± standard deviation over folds.")
    report.table(header, errors)
    report.text("CPU seconds per fit on one thread, choices included, mean over folds.")
    report.table(header, seconds)
    if curve:
        report.figure("elm_speed", _speed_figure(curve), "CPU time per fit and test error, arm.")
    return report


def _speed_figure(curve: list[dict[str, Any]]) -> Any:
    figure, axes = plots.new_figure(8.0, 3.4, 1, 2)
    sizes = sorted({entry["n"] for entry in curve})
    labels = ("CPU time per fit [s]", "error on other rows [mm]")
    for ax, key, label in zip(axes, ("seconds", "rmse"), labels, strict=True):
        for name, look in zip(dict.fromkeys(e["learner"] for e in curve), _LOOKS, strict=False):
            n, values = zip(*((e["n"], e[key]) for e in curve if e["learner"] == name), strict=True)
            ax.plot(n, values, look[:2], color=look[2:], label=name)
        ax.set(xlabel="training rows", ylabel=label, xscale="log")
        ax.set_xticks(sizes, [str(n) for n in sizes])
        ax.minorticks_off()
    axes[0].set(yscale="log")
    axes[1].set_ylim(bottom=0.0)
    axes[1].legend(frameon=False, fontsize="small")
    return figure


@threadpool_limits.wrap(limits=1)  # CPU time of one thread
def _fit(
    learner: Learner, X: NDArray, y: NDArray, train: NDArray, test: NDArray, seed: int
) -> tuple[float, float]:
    """Return the error on the rows `test` and the CPU seconds of the fit to the rows `train`."""
    estimator = learner(X.shape[1], seed)
    with warnings.catch_warnings():  # a length scale at its bound is an answer
        warnings.simplefilter("ignore", ConvergenceWarning)
        start = time.process_time()
        estimator.fit(X[train], y[train])
        seconds = time.process_time() - start
    errors = (y[test] - estimator.predict(X[test])).reshape(len(test), -1)
    return float(np.sqrt((errors**2).sum(axis=1).mean())), seconds


def _noisy(X: NDArray, y: NDArray, rng: np.random.Generator) -> Rows:
    return X, y + 0.1 * y.std() * rng.standard_normal(y.shape)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both comparisons and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--learners", nargs="+", choices=LEARNERS, default=[*LEARNERS])
    parser.add_argument("--rows", type=int, default=2000, help="rows of a set; default: 2000")
    parser.add_argument(
        "--sizes",
        type=int,
        nargs="+",
        default=(250, 500, 1000, 2000, 4000),
        help="timed rows",
    )
    given = parser.parse_args(arguments)

    def shown(what: str, done: int, total: int) -> None:
        print(f"{done}/{total} {what}", file=sys.stderr)

    learners = {name: LEARNERS[name] for name in given.learners}
    timed = {name: learner for name, learner in TIMED.items() if name.split(",")[0] in learners}
    table = compare_learners(learning_sets(given.rows), learners, progress=shown)
    curve = time_learners(timed, given.sizes, progress=shown)
    for path in learners_report(table, curve).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
