"""Chosen rows against random ones: how many random rows a chosen one is worth.

The tables of the docs page "Results", section "Rows to measure"::

    python examples/studies/next_rows.py --out results/next_rows

About a quarter of an hour on one core, and more for the rows of the simulated trunks, which
``--rows FOLDER`` keeps. It needs `hybridkin[sim]`, and for motions the recording ftdcr_v4 in the
folder that ``--data`` or HYBRIDKIN_DATA names. Draw k of pools, rows and motions has the seed k.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from csv_tables import add_csv
from hybrid_cases import PLANTS, Case, motion_cases, trunk_cases, without_noise
from numpy.typing import NDArray
from scipy.stats import qmc
from threadpoolctl import threadpool_limits

from hybridkin import (
    HybridForwardModel,
    InverseKinematics,
    choose_rows,
    datasets,
    robots,
    trajectories,
)
from hybridkin.app.workflow.report import Report

SIZES = (12, 25, 50, 100)
MORE = (
    18,
    35,
    70,
    150,
    200,
)  # of random rows, to find how many are as good as chosen ones
MOTIONS = (5, 10, 20)
CHOSEN, FARTHEST, SOBOL, RANDOM = "chosen", "farthest point", "Sobol", "random"
STRUCTURAL = "structural"  # the error model of the range and the path
_LOW, _HIGH = 0.19, 0.31  # range of the lengths [m]
_NOISE = 1e-3, 5e-4  # of lengths and tips, as the defaults of `make_trunk` [m]
_TEST_SHARE = 0.25  # of the motions


def box(
    sizes: Sequence[int] = SIZES,
    more: Sequence[int] = MORE,
    n_draws: int = 3,
    *,
    n_pool: int = 1600,
    n_test: int = 1000,
    auto: Sequence[int] = (100,),
    folder: Any = None,
    n_jobs: int | None = 1,
) -> list[dict[str, Any]]:
    """Return errors everywhere in the range of the lengths, for rows chosen in several ways.

    The pools are the training rows of the study `hybrids`: `n_pool` random rows with noise, tested
    on others without. Rows are chosen from the measured lengths, on the nominal robot. "farthest
    point": the largest distance to the rows before it, over the range of the lengths; "Sobol": the
    row nearest to each point of such a sequence; "random": two draws.

    Parameters
    ----------
    sizes, more : sequence of int
        Numbers of rows; `more` of random ones.
    n_draws : int, default=3
        Pools of each trunk.
    n_pool, n_test : int
        Rows of a pool, and of a test.
    auto : sequence of int, default=(100,)
        Numbers of rows for which ``error_model="auto"`` is fitted, too.
    folder, n_jobs
        Where rows of the trunks are kept, and processes to simulate them.

    Returns
    -------
    list of dict
        One entry per fit: "case", "draw", "way", "model", "n", "mean" and "max" [m]; of chosen rows
        also "expected" [m].
    """
    cases = trunk_cases([n_pool], n_draws, n_test, folder, n_jobs)
    return [entry for case in cases for entry in box_entries(case, sizes, more, auto)]


def box_entries(
    case: Case, sizes: Sequence[int], more: Sequence[int], auto: Sequence[int]
) -> list[dict[str, Any]]:
    """Return the entries of one pool, see `box`."""
    chosen, expected = choose_rows(case.chain, case.q, max(sizes))
    ways = {CHOSEN: [chosen], FARTHEST: [_farthest(case.q, max(sizes))]}
    ways[SOBOL] = [_nearest_to_sobol(case.q, max(sizes), case.draw)]
    ways[RANDOM] = [np.random.default_rng([case.draw, k]).permutation(len(case.q)) for k in (0, 1)]
    test = case.tests["without noise"]
    entries = []
    for way, orders in ways.items():
        for order in orders:
            for n in [*sizes, *(more if way == RANDOM else ())]:
                entries.append(
                    _entry(
                        case,
                        way,
                        STRUCTURAL,
                        case.q[order[:n]],
                        case.x[order[:n]],
                        test,
                    )
                )
                if way == CHOSEN:
                    entries[-1]["expected"] = expected[n - 1]
            for n in auto if way in (CHOSEN, RANDOM) else ():
                entries.append(
                    _entry(case, way, "auto", case.q[order[:n]], case.x[order[:n]], test)
                )
    return entries


def along_a_path(
    n: int = 50,
    more: Sequence[int] = (50, 100, 150, 200),
    n_draws: int = 3,
    *,
    n_points: int = 60,
    n_pool: int = 1600,
    n_test: int = 1000,
    folder: Any = None,
    n_jobs: int | None = 1,
) -> list[dict[str, Any]]:
    """Return errors along a figure eight, for rows chosen for it, for the range, and at random.

    The lengths along the path are those of the nominal robot; the trunk is simulated at these.

    Parameters
    ----------
    n : int, default=50
        Chosen rows.
    more : sequence of int
        Numbers of random rows.
    n_points : int, default=60
        Points of the path.
    n_draws, n_pool, n_test, folder, n_jobs
        As in `box`.

    Returns
    -------
    list of dict
        As of `box`, with the ways "chosen for the path, its own rows too" (with noise),
        "chosen for the path", "chosen" and "random".
    """
    path = trajectories.figure_eight((0.0, 0.0, 0.70), (0.50, 0.25), duration=n_points / 10, dt=0.1)
    limits = {"q_min": _LOW, "q_max": _HIGH, "q_pref": 0.25}
    ik = InverseKinematics(robots.bionic_handling_assistant(), dt=0.1, **limits)
    q = ik.track(path).q[:n_points]
    tests = {name: without_noise(name, folder, n_jobs, q_target=q) for name in PLANTS}
    entries = []
    for case in trunk_cases([n_pool], n_draws, n_test, folder, n_jobs):
        test, rng = tests[case.name], np.random.default_rng(case.draw)
        on_path = [
            part + noise * rng.standard_normal(part.shape)
            for part, noise in zip(test, _NOISE, strict=True)
        ]
        pool = case.q, case.x
        more_rows = tuple(map(np.concatenate, zip(on_path, pool, strict=True)))
        random = np.random.default_rng([case.draw, 0]).permutation(n_pool)
        ways = [
            (
                f"{CHOSEN} for the path, its own rows too",
                more_rows,
                _chosen(case, more_rows, n, q),
            ),
            (f"{CHOSEN} for the path", pool, _chosen(case, pool, n, q)),
            (CHOSEN, pool, _chosen(case, pool, n)),
            *((RANDOM, pool, random[:k]) for k in more),
        ]
        for way, (lengths, tips), rows in ways:
            entries.append(_entry(case, way, STRUCTURAL, lengths[rows], tips[rows], test))
    return entries


def _chosen(
    case: Case, pool: tuple[NDArray, ...], n: int, target: NDArray | None = None
) -> NDArray:
    return choose_rows(case.chain, pool[0], n, target=target)[0]


def motions(
    sizes: Sequence[int] = MOTIONS,
    n_draws: int = 3,
    *,
    thin: int = 4,
    data_home: Any = None,
) -> list[dict[str, Any]]:
    """Return errors on held-out motions of ftdcr_v4, for motions chosen and at random.

    A quarter of the motions is the test, the others are the pool; a calibrated elastic chain with
    quadratic features inside. Three random draws each.

    Parameters
    ----------
    sizes : sequence of int
        Numbers of motions.
    n_draws : int, default=3
        Splits into test and pool.
    thin : int, default=4
        Step between training rows.
    data_home : path-like, optional
        Folder of the recordings. Without the recording the result is empty, with a warning.

    Returns
    -------
    list of dict
        As of `box`; n counts motions.
    """
    cases = [c for c in motion_cases(data_home, None, 1) if c.name == "elastic tendons"][:1]
    if not cases:
        return []
    data, entries = datasets.load_ftdcr(data_home), []
    names = np.unique(data.groups)
    for draw in range(n_draws):
        order = np.random.default_rng(draw).permutation(names)
        n_out = int(_TEST_SHARE * len(names))
        test, pool = np.isin(data.groups, order[:n_out]), order[n_out:]
        rows = np.isin(data.groups, pool)
        case = cases[0]._replace(name="ftdcr_v4", draw=draw)
        chosen = choose_rows(case.chain, data.q[rows], max(sizes), groups=data.groups[rows])[0]
        ways = [(CHOSEN, chosen)]
        ways += [(RANDOM, np.random.default_rng([draw, k]).permutation(pool)) for k in range(3)]
        for way, some in ways:
            for n in sizes:
                log = [np.flatnonzero(data.groups == name)[::thin] for name in some[:n]]
                at = np.concatenate(log)
                measured = data.q[at], data.x[at], (data.q[test], data.x[test])
                entry = _entry(case, way, "quadratic", *measured, data.groups[at])
                entries.append({**entry, "n": n})
    return entries


@threadpool_limits.wrap(limits=1)
def _entry(
    case: Case,
    way: str,
    kind: str,
    q: NDArray,
    x: NDArray,
    test: tuple[NDArray, ...],
    groups: NDArray | None = None,
) -> dict[str, Any]:
    """Return the errors of a serial hybrid, or of "auto", fitted to some rows."""
    coupling = "parallel" if kind == "auto" else "serial"
    model = HybridForwardModel(
        case.chain,
        kind,
        coupling=coupling,
        calibrate=case.calibrate,
        random_state=case.draw,
    )
    with warnings.catch_warnings():
        # Few rows; tendons that contradict each other.
        warnings.simplefilter("ignore", UserWarning)
        model.fit(q, x, groups=groups)
        errors = np.linalg.norm(model.predict(test[0]) - test[1], axis=1)
    known = {
        "case": case.name,
        "draw": case.draw,
        "way": way,
        "model": kind,
        "n": len(q),
    }
    return {**known, "mean": float(errors.mean()), "max": float(errors.max())}


def _farthest(q: NDArray, n: int) -> NDArray:
    """Return rows that are farthest from those before, the first from the middle."""
    u = (q - _LOW) / (_HIGH - _LOW)
    distance, rows = np.linalg.norm(u - 0.5, axis=1), []
    for _ in range(n):
        rows.append(int(distance.argmax()))
        distance = np.minimum(distance, np.linalg.norm(u - u[rows[-1]], axis=1))
    return np.array(rows)


def _nearest_to_sobol(q: NDArray, n: int, seed: int) -> NDArray:
    """Return the rows nearest to the points of a Sobol sequence, each row once."""
    points = qmc.Sobol(q.shape[1], seed=seed).random(1 << (n - 1).bit_length())[:n]
    u, rows = (q - _LOW) / (_HIGH - _LOW), []
    for point in points:
        distance = np.linalg.norm(u - point, axis=1)
        distance[rows] = np.inf
        rows.append(int(distance.argmin()))
    return np.array(rows)


def worth(entries: Sequence[dict[str, Any]], case: str, error: float, key: str = "mean") -> float:
    """Return how many random rows have an error [m], between those that were fitted.

    Straight in the logarithms of rows and error; NaN where the error is not between theirs.
    """
    of = [e for e in entries if (e["case"], e["way"], e["model"]) == (case, RANDOM, STRUCTURAL)]
    sizes = sorted({e["n"] for e in of})
    means = [np.mean([e[key] for e in of if e["n"] == n]) for n in sizes]
    means = np.minimum.accumulate(means)
    found = np.interp(-np.log(error), -np.log(means), np.log(sizes), np.nan, np.nan)
    return float(np.exp(found))


def next_report(
    everywhere: list[dict[str, Any]],
    path: list[dict[str, Any]],
    moved: list[dict[str, Any]],
) -> Report:
    """Return the report of `box`, `along_a_path` and `motions`.

    Parameters
    ----------
    everywhere, path, moved : list of dict
        What the three returned, in this order.

    Returns
    -------
    Report
        Tables in mm; ``report.write(folder)`` writes them with ``report.json`` and the same
        figures in ``next_rows.csv``.
    """
    lines = []
    report = Report("Which configurations to measure next", {})
    report.record.update(box=everywhere, path=path, motions=moved)
    for title, entries in (("Range", everywhere), ("Path", path), ("Motions", moved)):
        for case, model in dict.fromkeys((e["case"], e["model"]) for e in entries):
            some = [e for e in entries if (e["case"], e["model"]) == (case, model)]
            sizes = sorted({e["n"] for e in some})
            rows = [
                [way, *(_cell(some, way, n) for n in sizes)]
                for way in dict.fromkeys(e["way"] for e in some)
            ]
            report.text(
                f"{title}: {case}, {model}; mean ± standard deviation (mean of the largest), mm"
            )
            report.table(["way", *map(str, sizes)], rows)
            lines += _lines(title, some)
            if model == STRUCTURAL:
                report.text(*_worths(some, case))
    add_csv(report, "next_rows.csv", _COLUMNS, lines)
    return report


_COLUMNS = ("study", "case", "model", "rows", "way", "mean_mm", "std_mm", "max_mm")


def _lines(study: str, entries: list[dict[str, Any]]) -> list[list[Any]]:
    """Return one line for each way and number of rows."""
    lines = []
    for way, n in dict.fromkeys((e["way"], e["n"]) for e in entries):
        some = [e for e in entries if (e["way"], e["n"]) == (way, n)]
        means = 1e3 * np.array([e["mean"] for e in some])
        errors = means.mean(), means.std(), 1e3 * np.mean([e["max"] for e in some])
        known = study.lower(), some[0]["case"], some[0]["model"], n, way
        lines.append([*known, *map(float, errors)])
    return lines


def _worths(entries: list[dict[str, Any]], case: str) -> list[str]:
    """Return how many random rows the chosen ones are worth, line by line."""
    lines = []
    for way in dict.fromkeys(e["way"] for e in entries if e["way"].startswith(CHOSEN)):
        for n in sorted({e["n"] for e in entries if e["way"] == way}):
            some = [e for e in entries if (e["way"], e["n"]) == (way, n)]
            by = [worth(entries, case, np.mean([e[k] for e in some]), k) for k in ("mean", "max")]
            lines.append(
                f"- {n} rows, {way}: worth {by[0]:.0f} random ones by the mean, {by[1]:.0f} by the "
                "largest error (nan: not between those fitted)."
            )
    return lines


def _cell(entries: list[dict[str, Any]], way: str, n: int) -> str:
    some = [e for e in entries if (e["way"], e["n"]) == (way, n)]
    if not some:
        return "-"
    means = 1e3 * np.array([e["mean"] for e in some])
    return f"{means.mean():.2f} ± {means.std():.2f} ({1e3 * np.mean([e['max'] for e in some]):.0f})"


def main(argv: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--out", default="results/next_rows", help="folder of the report")
    parser.add_argument("--draws", type=int, default=3)
    parser.add_argument("--rows", default=None, help="folder that keeps rows of the trunks")
    parser.add_argument("--data", default=None, help="folder of the recordings")
    parser.add_argument("--jobs", type=int, default=1, help="processes to simulate with")
    given = parser.parse_args(argv)
    torch.set_num_threads(1)
    common = {"n_draws": given.draws, "folder": given.rows, "n_jobs": given.jobs}
    path = along_a_path(**common)
    moved = motions(n_draws=given.draws, data_home=given.data)
    for name in next_report(box(**common), path, moved).write(given.out):
        print(name)


if __name__ == "__main__":
    main()
