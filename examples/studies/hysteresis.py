"""Hysteresis of actuators: one backlash, or what `hysteresis="auto"` finds.

The tables and the figure of the docs page "Results", section "Hysteresis and creep"::

    python examples/studies/hysteresis.py --out results/hysteresis

About eight minutes of processor time. The simulated trunk is the chain of the library with an error
to learn; what its actuators do has hysteresis of three kinds, none of which is the operator that
is fitted. The recordings are in the folder that ``--data`` or HYBRIDKIN_DATA names; an absent one
is left out (`help(hybridkin.datasets.load_asl_trunk)` names its source).
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import torch
from hybrid_cases import Case, motion_cases, run_cases
from numpy.typing import NDArray
from scipy.signal import lfilter
from sklearn.base import clone

from hybridkin import (
    Commands,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    datasets,
    robots,
)
from hybridkin.hysteresis.log import HysteresisLog
from hybridkin.hysteresis.search import search_width

TRUNK = robots.bionic_handling_assistant()
ROWS = 40  # in a motion
NOISE = 5e-4  # [m]
Motion = Callable[[NDArray], NDArray]


def many_plays(q: NDArray) -> NDArray:
    """Return the sum of 25 plays with widths up to 8 cm (T, n) [m]."""
    half = np.linspace(0.0, 0.04, 25)
    density = np.exp(-half / 0.012)
    plays = [Hysteresis.backlash(2.0 * r).apply(q)[0] for r in half]
    return np.tensordot(density / density.sum(), plays, 1)


def bouc_wen(q: NDArray) -> NDArray:
    """Return commands minus the inner force of a Bouc-Wen model (T, n) [m]."""
    force = np.zeros(q.shape[1])
    effective = q.copy()
    for t in range(1, len(q)):
        step = (q[t] - q[t - 1]) / 10
        for _ in range(10):
            turn = 0.5 * (np.abs(step) * force + step * np.abs(force))
            force = force + step - turn / 0.015
        effective[t] = q[t] - 0.8 * force
    return effective


def creep(q: NDArray) -> NDArray:
    """Return 60 % of the commands plus 10 % of each of four averages of the past (T, n) [m]."""
    effective = 0.6 * q
    for rate in (0.7, 0.25, 0.1, 0.03):
        start = (1.0 - rate) * q[:1]
        effective += 0.1 * lfilter([rate], [1.0, rate - 1.0], q, axis=0, zi=start)[0]
    return effective


def by_group(function: Callable[[NDArray], NDArray], q: NDArray, groups: NDArray) -> NDArray:
    """Return a function of the rows of each motion, for all rows."""
    parts = [function(q[groups == name]) for name in np.unique(groups)]
    order = np.concatenate([np.flatnonzero(groups == name) for name in np.unique(groups)])
    result = np.empty((len(q), *parts[0].shape[1:]))
    result[order] = np.concatenate(parts)
    return result


def motions(rng: np.random.Generator, n: int) -> tuple[NDArray, NDArray]:
    """Return commands of n motions back and forth (n ROWS, 9) [m], and their groups."""
    turn = np.linspace(0.0, 2.0 * np.pi, ROWS)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ waves).transpose(0, 2, 1)
    return q.reshape(-1, 9), np.repeat(np.arange(n), ROWS)


def tips(y: NDArray) -> NDArray:
    """Return the tips of the simulated trunk at effective lengths y (N, 9) [m]."""
    moved = y + 0.03 * (y[:, ::-1] - 0.25) ** 2
    with torch.no_grad():
        return TRUNK(torch.from_numpy(moved)).numpy()


def far(a: NDArray, b: NDArray) -> NDArray:
    """Return distances (N,) of rows in mm."""
    return 1e3 * np.linalg.norm(a - b, axis=1)


def timed(q: NDArray, runs: NDArray) -> Commands:
    """Return commands with one second from row to row of a run."""
    time = np.empty(len(q))
    for name in np.unique(runs):
        time[runs == name] = np.arange((runs == name).sum())
    return Commands(q, runs, time)


def fits(
    model: HybridForwardModel,
    q: NDArray,
    x: NDArray,
    groups: NDArray,
    runs: NDArray | None = None,
    weights: NDArray | None = None,
) -> dict[str, HybridForwardModel]:
    """Return models without hysteresis, with one backlash, and with what "auto" finds.

    Parameters
    ----------
    model : HybridForwardModel
        Its settings, but for `hysteresis`.
    q, x, groups, runs, weights : ndarray
        Rows as for its `fit`.
    """

    def fitted(hysteresis: float | str) -> HybridForwardModel:
        hybrid = clone(model).set_params(hysteresis=hysteresis)
        rows = timed(q, groups if runs is None else runs)
        return hybrid.fit(rows, x, weights, groups)

    none = fitted(0.0)
    used = slice(None) if weights is None else weights > 0.0
    groups_used = groups[used]
    time = np.arange(len(groups_used), dtype=float)
    log = HysteresisLog(
        none.mechanical_model_,
        q[used],
        x[used],
        np.ones(len(time)),
        groups_used,
        groups_used,
        time,
    )
    widest = np.ptp(q, axis=0).max()
    widths = [0.0, *(widest * np.geomspace(0.003, 0.8, 30))]
    single = search_width(log.thinned(), widths).best
    return {"none": none, "one backlash": fitted(single.width), "auto": fitted("auto")}


def trunk_model() -> HybridForwardModel:
    """Return the settings of the models of the simulated trunk."""
    return HybridForwardModel(TRUNK, "quadratic", coupling="serial")


def commands(model: HybridForwardModel, y: NDArray, groups: NDArray) -> NDArray:
    """Return the commands for motions y (N, n) of the actuators."""
    hysteresis = model.hysteresis_
    return by_group(lambda rows: hysteresis.command(rows, dt=1.0)[0], y, groups)


def simulated(kind: str, hysteresis: Motion, draws: int) -> list[list[str]]:
    """Return lines of the table: errors on 12 new motions, and of commands for 12 paths."""
    errors: dict[str, list[tuple[float, float]]] = {}
    for seed in range(draws):
        rng = np.random.default_rng(seed)
        q, groups = motions(rng, 24)
        x = tips(by_group(hysteresis, q, groups))
        x += NOISE * rng.standard_normal(x.shape)
        q_new, new = motions(rng, 12)
        x_new = tips(by_group(hysteresis, q_new, new))

        for name, model in fits(trunk_model(), q, x, groups).items():
            predicted = far(model.predict(timed(q_new, new)), x_new).mean()
            sent = commands(model, q_new, new)
            with torch.no_grad():
                promised = model.module_(torch.from_numpy(q_new)).numpy()
            reached = tips(by_group(hysteresis, sent, new))
            values = predicted, far(reached, promised).mean()
            errors.setdefault(name, []).append(values)
    lines = []
    for name, values in errors.items():
        means, spreads = np.mean(values, axis=0), np.std(values, axis=0)
        columns = [f"{m:.2f} ± {s:.2f}" for m, s in zip(means, spreads, strict=True)]
        lines.append([kind, name, *columns])
    return lines


def trunk_of_motors(cases: list[Case], data_home: str | None) -> list[list[str]]:
    """Return lines of the table of asl_trunk_static: an ELM on what the actuators do."""
    if not cases:
        return []
    recording = datasets.load_asl_trunk(data_home)
    places = np.array([_FOLLOWS[name] for name in recording.run_names])
    joined = places[recording.groups]
    errors: dict[tuple[str, str], list[NDArray]] = {}
    for case in cases:
        q, x, groups = _all_rows(case)
        test = np.isin(groups, case.tests["5 folds"][2])
        known = np.where(test[:, None], x[~test].mean(axis=0), x)
        weights = (~test).astype(float)  # held-out rows still move the motors

        nominal = HybridForwardModel(case.chain, "drop", calibrate="default")
        for start, runs in {"run": groups, "runs in a row": joined}.items():
            models = fits(nominal, q, known, groups, runs, weights)
            for name, model in models.items():
                y = model.effective(timed(q, runs))
                network = ELMRegressorCV(200, relevance_rounds=0, random_state=0)
                network.fit(y[~test], x[~test], groups=groups[~test])
                error = far(network.predict(y[test]), x[test])
                errors.setdefault((name, start), []).append(error)
    return [[name, start, *_by_fold(parts)] for (name, start), parts in errors.items()]


def nine_tendons(cases: list[Case]) -> list[list[str]]:
    """Return lines of the table of ftdcr_v4: elastic tendons without learning."""
    errors: dict[str, list[NDArray]] = {}
    for case in cases:
        q_new, x_new, new = case.tests["5 folds"]

        nominal = HybridForwardModel(case.chain, "drop", calibrate=case.calibrate)
        for name, model in fits(nominal, case.q, case.x, case.groups).items():
            error = far(model.predict(timed(q_new, new)), x_new)
            errors.setdefault(name, []).append(error)
    return [[name, *_by_fold(parts)] for name, parts in errors.items()]


_FOLLOWS: dict[str, int] = {}  # place of each run's uninterrupted row of runs
for place, names in enumerate(
    (
        "beta0 beta1 beta2",
        "beta4 beta5 beta6 beta7",
        "targeted1 targeted2 targeted3 targeted4",
        "circle0",
        "circle2 circle3 circle4 circle5 circle6 circle7 circle8",
        "circle10",
    )
):
    _FOLLOWS |= dict.fromkeys(names.split(), place)


def _all_rows(case: Case) -> tuple[NDArray, NDArray, NDArray]:
    """Return all rows of a recording in its order, from training and test rows."""
    q, x, groups = case.tests["5 folds"]
    q = np.vstack([case.q, q])
    x = np.vstack([case.x, x])
    groups = np.concatenate([case.groups, groups])
    order = np.argsort(groups, kind="stable")
    return q[order], x[order], groups[order]


def _by_fold(errors: list[NDArray]) -> list[str]:
    """Return the mean over all rows, and those of the folds, in words."""
    mean = np.concatenate(errors).mean()
    return [f"{mean:.2f}", ", ".join(f"{error.mean():.1f}" for error in errors)]


def draw_loops(path: Path) -> None:
    """Draw loops of one actuator of the trunk with Bouc-Wen friction, and of three models."""
    rng = np.random.default_rng(0)
    q, groups = motions(rng, 24)
    x = tips(by_group(bouc_wen, q, groups)) + NOISE * rng.standard_normal((len(q), 3))

    models = fits(trunk_model(), q, x, groups).values()

    turn = np.linspace(0.0, 4.0 * np.pi, 300)
    swing = np.linspace(1.0, 0.4, len(turn)) * np.sin(turn)
    loop = 0.25 + np.outer(swing, 0.04 * np.eye(9)[0])
    figure, axes = plt.subplots(1, 3, figsize=(9.0, 3.2), sharey=True, layout="constrained")
    titles = "no hysteresis", "one backlash", "found by auto"
    for ax, title, model in zip(axes, titles, models, strict=True):
        ax.plot(
            1e3 * loop[:, 0],
            1e3 * tips(bouc_wen(loop))[:, 0],
            "0.6",
            lw=3,
            label="robot",
        )
        ax.plot(1e3 * loop[:, 0], 1e3 * model.predict(loop)[:, 0], "C0", label="model")
        ax.set(title=title, xlabel="command [mm]")
    axes[0].set_ylabel("tip x [mm]")
    axes[0].legend(frameon=False)
    figure.savefig(path, dpi=150)


def main() -> None:
    """Write the tables and the figure."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/hysteresis"))
    parser.add_argument("--data", default=None, help="folder of the recordings")
    parser.add_argument("--draws", type=int, default=3)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    warnings.simplefilter("ignore", UserWarning)
    lines = []
    for kind, hysteresis in {
        "none": np.array,
        "25 plays": many_plays,
        "Bouc-Wen": bouc_wen,
        "creep": creep,
    }.items():
        lines += simulated(kind, hysteresis, arguments.draws)
    lines += trunk_of_motors(run_cases(arguments.data, 1), arguments.data)
    motion = [
        case
        for case in motion_cases(arguments.data, 2)
        if "elastic" in case.name and "5 folds" in case.tests
    ]
    lines += nine_tendons(motion)
    table = "\n".join(f"| {' | '.join(line)} |" for line in lines)
    table += f"\n\n{time.process_time():.0f} s of processor time\n"
    (arguments.out / "report.md").write_text(table, encoding="utf-8")
    print(table)
    draw_loops(arguments.out / "hysteresis_loops.png")


if __name__ == "__main__":
    main()
