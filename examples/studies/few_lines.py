"""Logs of few lines in actuator space: where a learned correction increases the error.

Figures of the docs page "Results", section "Domain and radius"::

    python examples/studies/few_lines.py --first 40 --out results/few_lines

About five minutes on one core. Log k of the simulated robots has the seed k: one to three
extensible segments of three actuators, 5 to 12 motions along straight lines, and noise. The error
of the calibrated chain is smooth and acts inside the robot: products of actuators, which lines
along single actuators do not show, and a saturating part. Tested on random rows of the box, and
on new lines of the same kind.

A row is *harmed* where the hybrid errs more than its calibrated chain although the row lies in the
domain; also counted are rows that err more by 1 mm, twice the noise of the tip. The domain of the
guard alone is compared with the one that also keeps to the distance that held-out motions have
tested.
"""

from __future__ import annotations

import argparse
import copy
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from matplotlib.figure import Figure
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from hybridkin import ConstantCurvatureChain, HybridForwardModel
from hybridkin.app.workflow.report import Report

LINES = (
    "single actuators from the middle",
    "single actuators from the shortest",
    "random directions from the middle",
    "random directions from the shortest",
    "between random configurations",
)
MODELS: dict[str, dict[str, Any]] = {
    "auto": {"error_model": "auto"},
    "kernel ridge": {"error_model": "kernel"},
    "serial quadratic": {"error_model": "quadratic", "coupling": "serial"},
}
TESTS = ("box", "new lines")
DOMAINS = ("guard alone", "and tested distance")
SHARES = ("inside", "harmed", "by 1 mm")

_LOW, _HIGH = 0.16, 0.26  # lengths of the actuators [m]
_ERROR = 0.25  # of the inner coordinates, of their spread in the box
_NOISE = 3e-4, 5e-4  # of lengths and tip [m]
_MUCH = 2.0 * _NOISE[1]
_NEW = 30  # new lines


class Log(NamedTuple):
    """A simulated log, its robot as described, and test rows without noise."""

    kind: str
    chain: ConstantCurvatureChain
    q: NDArray
    x: NDArray
    groups: NDArray
    tests: dict[str, tuple[NDArray, NDArray]]


def simulated_log(seed: int, n_test: int = 1000) -> Log:
    """Return the log with a seed."""
    rng, kind = np.random.default_rng([seed, 18]), LINES[seed % len(LINES)]
    n_segments = 1 + seed % 3
    n, radii, offsets = 3 * n_segments, np.full(n_segments, 0.05), [0.02] * n_segments
    robot = ConstantCurvatureChain(radii * rng.uniform(0.9, 1.1, n_segments), offsets=offsets)
    products, single = (
        np.triu(rng.standard_normal((n, n, n))) / n,
        rng.standard_normal((n, n)),
    )

    def measured(u: NDArray) -> tuple[NDArray, NDArray]:
        """Return lengths and tips at configurations u (N, n) of the box [-1, 1]."""
        q = 0.5 * (_LOW + _HIGH) + 0.5 * (_HIGH - _LOW) * u
        bent = 0.5 * np.einsum("kij,ni,nj->nk", products, u, u)
        bent += 0.3 * np.tanh(u @ single.T / np.sqrt(n))
        z = robot.coordinates(torch.from_numpy(q))[0] + torch.from_numpy(spread * bent)
        return q, robot.from_coordinates(z).numpy()

    box = torch.from_numpy(rng.uniform(_LOW, _HIGH, (500, n)))
    spread = _ERROR * robot.coordinates(box)[0].std(0).numpy()
    n_motions, n_rows = int(rng.integers(5, 13)), int(rng.integers(15, 40))
    q, x = measured(_lines(kind, n, n_motions, n_rows, rng))
    q = q + _NOISE[0] * rng.standard_normal(q.shape)
    x = x + _NOISE[1] * rng.standard_normal(x.shape)
    tests = {
        "box": measured(rng.uniform(-1.0, 1.0, (n_test, n))),
        "new lines": measured(_lines(kind, n, _NEW, max(2, n_test // _NEW), rng)),
    }
    groups = np.repeat(np.arange(n_motions), n_rows)
    return Log(kind, ConstantCurvatureChain(radii, offsets=offsets), q, x, groups, tests)


def _lines(kind: str, n: int, n_motions: int, n_rows: int, rng: np.random.Generator) -> NDArray:
    """Return rows (n_motions * n_rows, n) of motions in the box [-1, 1]."""
    start = np.full((n_motions, n), -1.0 if kind.endswith("shortest") else 0.0)
    if kind.startswith("between"):
        start, end = rng.uniform(-1.0, 1.0, (2, n_motions, n))
    elif kind.startswith("single"):
        own = np.arange(n_motions) % n == np.arange(n)[:, None]
        reach = rng.uniform(0.5, 1.0, n_motions)
        sign = np.where(np.arange(n_motions) // n % 2, -1.0, 1.0)  # there, then back
        way = 2.0 * reach if kind.endswith("shortest") else sign * reach
        end = start + (own * way).T
    elif kind.endswith("shortest"):  # about half of the actuators move
        moves = (rng.random((n_motions, n)) < 0.5) | np.eye(n, dtype=bool)[np.arange(n_motions) % n]
        end = start + 2.0 * rng.random((n_motions, n)) * moves
    else:
        way = rng.standard_normal((n_motions, n))
        reach = rng.uniform(0.6, 1.0, (n_motions, 1))
        end = reach * way / np.abs(way).max(1, keepdims=True)
    along = np.linspace(0.0, 1.0, n_rows)[:, None]
    return (start[:, None] + along * (end - start)[:, None]).reshape(-1, n)


@threadpool_limits.wrap(limits=1)
def examined(seed: int, models: Sequence[str] = (*MODELS,)) -> list[dict[str, Any]]:
    """Return, of every model of a log, its errors and shares by test and domain."""
    log, entries = simulated_log(seed), []
    for name in models:
        model = HybridForwardModel(log.chain, calibrate="default", random_state=0, **MODELS[name])
        with warnings.catch_warnings():  # of few rows
            warnings.simplefilter("ignore", UserWarning)
            model.fit(log.q, log.x, groups=log.groups)
        entry: dict[str, Any] = {"seed": seed, "lines": log.kind, "model": name}
        entry |= {
            "segments": log.chain.n_segments,
            "motions": int(log.groups.max()) + 1,
        }
        alone = copy.deepcopy(model.module_)
        alone.tested = None
        for test, (q, x) in log.tests.items():
            hybrid = np.linalg.norm(model.predict(q) - x, axis=1)
            chain = np.linalg.norm(model.predict_mechanical(q) - x, axis=1)
            harm = {"inside": hybrid > 0.0, "harmed": hybrid > chain}
            harm["by 1 mm"] = hybrid > chain + _MUCH
            inside = (alone.in_domain(torch.from_numpy(q)).numpy(), model.in_domain(q))
            entry[test] = {"hybrid": float(hybrid.mean()), "chain": float(chain.mean())}
            entry[test] |= {
                domain: {what: float((rows & some).mean()) for what, some in harm.items()}
                for domain, rows in zip(DOMAINS, inside, strict=True)
            }
        entries.append(entry)
    return entries


def write(entries: list[dict[str, Any]], seconds: float) -> Report:
    """Return the report of the entries of all logs."""
    report = Report("Logs of few lines through actuator space (simulated robots)", {})
    report.record |= {"entries": entries, "seconds": seconds}
    seeds = sorted({entry["seed"] for entry in entries})
    report.text(
        f"{len(seeds)} logs, seeds {seeds[0]} to {seeds[-1]}; {seconds:.0f} s. Harmed: in the "
        "domain, and a larger error than without correction; by 1 mm: larger by that. Shares of "
        "all rows, by the guard alone -> with the distance that held-out motions have tested, in "
        "per cent."
    )
    parts = [(f"{test}: {what}", test, what) for test in TESTS for what in SHARES]
    for name in dict.fromkeys(entry["model"] for entry in entries):
        own = [entry for entry in entries if entry["model"] == name]
        rows = []
        for kind in [k for k in LINES if any(e["lines"] == k for e in own)] + ["all"]:
            some = [entry for entry in own if kind in (entry["lines"], "all")]
            cells = []
            for _, test, what in parts:
                both = [100 * np.mean([e[test][d][what] for e in some]) for d in DOMAINS]
                cells.append(" -> ".join(f"{share:.1f}" for share in both))
            rows.append([kind, str(len(some)), *cells])
        report.table([name, "logs", *(label for label, _, _ in parts)], rows)
    caption = "Harmed rows of the box in every log"
    report.figure("few_lines", figure(entries), caption)
    return report


def figure(entries: list[dict[str, Any]]) -> Figure:
    """Return harmed rows of the box in every log, by the guard alone and in the whole domain."""
    drawn = Figure(figsize=(5.0, 4.5), layout="constrained")
    ax = drawn.subplots()
    for name, marker in zip(MODELS, "osD", strict=True):
        own = [entry["box"] for entry in entries if entry["model"] == name]
        before, after = (100 * np.array([box[d]["harmed"] for box in own]) for d in DOMAINS)
        ax.scatter(before, after, marker=marker, alpha=0.6, label=name)
    top = ax.get_xlim()[1]
    ax.plot([0, top], [0, top], color="0.7", zorder=0)
    ax.set_xlabel("harmed rows of the box [%], guard alone")
    ax.set_ylabel("with the tested distance [%]")
    ax.legend()
    return drawn


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write its report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, type=Path, help="folder of the report")
    parser.add_argument("--n", type=int, default=20, help="logs")
    parser.add_argument("--first", type=int, default=0, help="seed of the first log")
    parser.add_argument("--models", nargs="+", choices=MODELS, default=[*MODELS])
    given = parser.parse_args(arguments)
    start, entries = time.perf_counter(), []
    for seed in range(given.first, given.first + given.n):
        entries += examined(seed, given.models)
    report = write(entries, time.perf_counter() - start)
    for path in report.write(given.out):
        print(path)


if __name__ == "__main__":
    main()
