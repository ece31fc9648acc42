"""Several markers on the robot: what they change about the error of the tip.

The table of the docs page "Results", section "Several markers"::

    python examples/studies/markers.py --out results/markers

About an hour on one core. It needs `hybridkin[sim]`, and asl_trunk_static in the folder that
``--data`` or HYBRIDKIN_DATA names (`help(hybridkin.datasets.load_asl_trunk)` names its source);
without it that robot is left out with a warning. Every model is fitted to the tip alone, and to the
ends of all three segments; both are tested at the tip. The two simulated trunks are those of the
study `hybrids`: random rows, 1 mm noise of the lengths and 0.5 mm of every coordinate of a marker;
draw k of rows and noise has the seed k; tested on other rows without noise. Of asl_trunk_static
whole runs are held out in five folds, and n rows are spread evenly over the others.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
from csv_tables import add_csv
from hybrid_cases import _PAIRS, PLANTS, SPOOL, recording
from joblib import Memory, Parallel, delayed
from numpy.typing import NDArray
from simulated_trunk import TrunkPlant, paper_protocol
from sklearn.model_selection import GroupKFold
from threadpoolctl import threadpool_limits

from hybridkin import ConstantCurvatureChain, HybridForwardModel, datasets, robots
from hybridkin.app.workflow.report import Report

SIZES = (25, 50, 100, 400)
ENDS = [(0, 1.0), (1, 1.0), (2, 1.0)]
MODELS: dict[str, dict[str, Any]] = {
    "calibrated chain": {"error_model": "drop"},
    "parallel quadratic": {"error_model": "quadratic"},
    "serial quadratic": {"error_model": "quadratic", "coupling": "serial"},
    "serial pose": {"error_model": "pose", "coupling": "serial"},
    "auto": {"error_model": "auto"},
}
MARKERS = {"one": slice(6, 9), "three": slice(0, 9)}

_NOISE = 1e-3, 5e-4  # of lengths and of markers [m]


class Case(NamedTuple):
    """Training and test rows; x holds the ends of the three segments."""

    robot: str
    draw: int
    chain: ConstantCurvatureChain  # of three markers
    train: tuple[NDArray, NDArray, NDArray | None]  # q, x, groups
    test: tuple[NDArray, NDArray]


def settled(name: str, targets: NDArray) -> tuple[NDArray, NDArray]:
    """Return lengths (N, 9) and the ends of the segments (N, 9) of a plant, without noise."""
    plant = TrunkPlant(**PLANTS[name])
    rows = [(plant.settle(target)[0], plant.segment_ends.ravel()) for target in targets]
    q, x = zip(*rows, strict=True)
    return np.array(q), np.array(x)


def trunks(sizes: Sequence[int], n_draws: int, n_test: int, folder: Any) -> Iterator[Case]:
    """Yield the cases of the simulated trunks."""
    for seed, name in enumerate(PLANTS):
        most = max(sizes)
        targets, _ = paper_protocol(seed, n_segment=0, n_random=n_test + n_draws * most)
        q, x = Memory(folder, verbose=0).cache(settled)(name, targets)
        test, chain = (q[:n_test], x[:n_test]), robots.bionic_handling_assistant()
        for draw in range(n_draws):
            rng = np.random.default_rng([seed, 2, draw])
            rows = slice(n_test + draw * most, n_test + (draw + 1) * most)
            noisy = [
                a[rows] + s * rng.standard_normal((most, 9))
                for a, s in zip((q, x), _NOISE, strict=True)
            ]
            for n in sizes:
                train = noisy[0][:n], noisy[1][:n], None
                yield Case(name, draw, chain.with_markers(ENDS), train, test)


def runs(sizes: Sequence[int], data_home: Any) -> Iterator[Case]:
    """Yield the cases of asl_trunk_static, none without the recording."""
    data = recording(datasets.load_asl_trunk, data_home)
    if data is None:
        return
    q = np.hstack([SPOOL * sign * data.q[:, pair] for pair in _PAIRS for sign in (-1.0, 1.0)])
    x = data.disks.reshape(-1, 9)
    chain = ConstantCurvatureChain(np.full(3, 0.02), n_actuators=4, lengths=(0.107, 0.098, 0.12))
    for fold, (train, test) in enumerate(GroupKFold(5).split(q, groups=data.groups)):
        for n in sizes:
            rows = train[np.linspace(0, len(train) - 1, n).astype(int)]
            known = q[rows], x[rows], data.groups[rows]
            marked = chain.with_markers(ENDS)
            yield Case("asl_trunk_static", fold, marked, known, (q[test], x[test]))


@threadpool_limits.wrap(limits=1)
def examined(case: Case, models: Sequence[str]) -> list[dict[str, Any]]:
    """Return the errors of the tip of every model, with one marker and with three."""
    entries, (q, x, groups), (q_test, x_test) = [], case.train, case.test
    for name in models:
        entry = {"robot": case.robot, "draw": case.draw, "n": len(q), "model": name}
        for markers, columns in MARKERS.items():
            chain = case.chain if markers == "three" else case.chain.tip_model
            how = None if name == "auto" else "default"
            model = HybridForwardModel(chain, calibrate=how, random_state=0, **MODELS[name])
            start = time.process_time()
            with warnings.catch_warnings():  # few rows; tendons that contradict each other
                warnings.simplefilter("ignore", UserWarning)
                tips = model.fit(q, x[:, columns], groups=groups).predict(q_test)[:, -3:]
            errors = np.linalg.norm(tips - x_test[:, 6:], axis=1)
            entry[markers] = {"mean": float(errors.mean()), "max": float(errors.max())}
            entry[markers] |= {
                "n_test": len(errors),
                "seconds": time.process_time() - start,
            }
            if name == "calibrated chain":
                body = model.mechanical_model_.with_markers(ENDS[:2])
                found = HybridForwardModel(body, "drop").fit(q, x[:, :6]).predict(q_test)
                far = np.linalg.norm((found - x_test[:, :6]).reshape(-1, 2, 3), axis=2)
                entry[markers]["others"] = float(far.mean())
        entries.append(entry)
    return entries


def study(
    sizes: Sequence[int] = SIZES,
    n_draws: int = 3,
    *,
    n_test: int = 500,
    models: Sequence[str] = tuple(MODELS),
    data_home: Any = None,
    folder: Any = None,
    n_jobs: int = 1,
) -> list[dict[str, Any]]:
    """Return the entries of all cases, one for each model; errors in metres."""
    cases = [*trunks(sizes, n_draws, n_test, folder), *runs(sizes, data_home)]
    found: Any = Parallel(n_jobs)(delayed(examined)(case, models) for case in cases)
    return [entry for entries in found for entry in entries]


def write(entries: list[dict[str, Any]]) -> Report:
    """Return the report of the entries: mean errors of the tip, and their spread over draws."""
    report, lines = Report("Several markers", {}), []
    report.record["entries"] = entries
    for robot in dict.fromkeys(e["robot"] for e in entries):
        own = [e for e in entries if e["robot"] == robot]
        draws = len({e["draw"] for e in own})
        tests = sorted({e["one"]["n_test"] for e in own})
        report.text(
            f"## {robot}",
            f"Mean error of the tip in mm with one marker / with three, over {draws} draws or "
            "folds, and in brackets the standard deviation over these of the change by the other "
            f"two markers; {tests[0]} to {tests[-1]} test rows. The last line is the mean error of "
            "the other two ends by the calibrated chain.",
        )
        sizes, rows = sorted({e["n"] for e in own}), []
        for model in dict.fromkeys(e["model"] for e in own):
            cells = []
            for n in sizes:
                some = [e for e in own if (e["n"], e["model"]) == (n, model)]
                both = 1e3 * np.array([[e[m]["mean"] for m in MARKERS] for e in some])
                one, three = both.mean(0)
                cells.append(f"{one:.2f} / {three:.2f} ({np.diff(both).std():.2f})")
                lines.append([robot, n, model, float(one), float(three)])
            rows.append([model, *cells])
        rows.append(["the same chain, other two ends"])
        for n in sizes:
            some = [e for e in own if e["n"] == n and "others" in e["one"]]
            both = 1e3 * np.mean([[e[m]["others"] for m in MARKERS] for e in some], axis=0)
            rows[-1].append(f"{both[0]:.2f} / {both[1]:.2f}")
            lines.append([robot, n, rows[-1][0], *map(float, both)])
        report.table(["model", *(f"n = {n}" for n in sizes)], rows)
    header = ("robot", "rows", "model", "tip_alone_mm", "three_markers_mm")
    add_csv(report, "markers.csv", header, lines)
    return report


def main() -> None:
    """Run the study from the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder for report.md and report.json")
    parser.add_argument("--data", help="folder of the recordings")
    parser.add_argument("--rows", help="folder that keeps the simulated rows")
    parser.add_argument("--models", nargs="+", default=[*MODELS], choices=MODELS)
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    given = parser.parse_args()
    entries = study(models=given.models, data_home=given.data, folder=given.rows, n_jobs=given.jobs)
    write(entries).write(given.out)


if __name__ == "__main__":
    main()
