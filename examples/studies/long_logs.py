"""Long logs: what more rows give, where the past matters, and what they cost.

The table of the docs page "Results", section "Long logs"::

    python examples/studies/long_logs.py --out results/long_logs

A simulated trunk with hysteresis of three kinds, as in ``hysteresis.py``: one backlash, 25 plays,
and four averages of the past. A fit with the default settings of ``hybridkin fit`` uses the tips of
at most 2000 rows, whatever the length of the log. About twenty minutes of processor time.
"""

from __future__ import annotations

import argparse
import csv
import resource
import subprocess
import sys
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
from hysteresis import TRUNK, by_group, creep, many_plays, tips
from numpy.typing import NDArray

from hybridkin import Commands, Hysteresis, load_model, robots
from hybridkin.app import workflow
from hybridkin.datasets import Log

ROWS = 60  # in a motion
NOISE = 5e-4  # [m]
PERIOD = 1.0  # from row to row [s]
KINDS = {
    "backlash": lambda q: Hysteresis.backlash(0.02).apply(q)[0],
    "smooth friction": many_plays,
    "creep": creep,
}
SIZES = (24, 240, 2400)
NEW = 48  # motions
HEADER = ["hysteresis", "motions", "rows", "seed", "error on new motions [mm]"]
HEADER += ["held-out error in the fit, with noise [mm]", "CPU [s]"]


def motions(
    rng: np.random.Generator, n: int, rows: int = ROWS, waves: int = 1
) -> tuple[NDArray, NDArray]:
    """Return commands of n motions back and forth (n rows, 9) [m], and their motions."""
    turn = np.linspace(0.0, 2.0 * np.pi * waves, rows)
    shapes = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ shapes).transpose(0, 2, 1)
    return q.reshape(-1, 9), np.repeat(np.arange(n), rows)


def measured(q: NDArray, groups: NDArray, kind: str) -> NDArray:
    """Return the tips (N, 3) of the robot without noise [m]."""
    return tips(by_group(KINDS[kind], q, groups))


def log_of(kind: str, n_motions: int, seed: int) -> Log:
    """Return a log of the robot, as a lab records it."""
    rng = np.random.default_rng(seed)
    q, groups = motions(rng, n_motions)
    x = measured(q, groups, kind)
    x += NOISE * rng.standard_normal(x.shape)
    return Log(q, x, groups, time=PERIOD * np.arange(len(q)))


def fitted_errors(kind: str, n_motions: int, seed: int) -> list[str]:
    """Return a row of the table: the error of the saved model on new motions."""
    log = log_of(kind, n_motions, seed)
    robot = robots.RobotDescription("trunk", TRUNK, "auto", None)
    before = time.process_time()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        settings = workflow.FitSettings(n_folds=2)
        report = workflow.fit_log(log, robot, folder, settings, n_jobs=1)
        model = load_model(Path(folder) / "model.safetensors")
    seconds = time.process_time() - before
    q, groups = motions(np.random.default_rng(1000 + seed), NEW)
    commands = Commands(q, groups, PERIOD * np.arange(len(q)))
    error = np.linalg.norm(model.predict(commands) - measured(q, groups, kind), axis=1)
    record = report.record
    promised = record.held_out[record.saved].mean
    values = (1e3 * error.mean(), 1e3 * promised)
    return [
        kind,
        str(n_motions),
        str(len(log.q)),
        str(seed),
        *(f"{value:.3f}" for value in values),
        f"{seconds:.0f}",
    ]


def write_long_log(path: Path, n_rows: int) -> None:
    """Write a log at 100 Hz of motions of a minute, with backlash, and its robot description."""
    rng = np.random.default_rng(0)
    rows = 6000
    q, groups = motions(rng, n_rows // rows, rows, waves=6)
    x = measured(q, groups, "backlash")
    x += NOISE * rng.standard_normal(x.shape)
    columns = {"q": q, "x": x, "motion": groups, "time": 0.01 * np.arange(len(q))}
    np.savez(path, **columns)
    text = "".join(f"[[segment]]\nradius = {radius}\n" for radius in (0.1, 0.093, 0.079))
    Path(path).with_suffix(".toml").write_text(
        f'name = "trunk"\ncalibrate = "auto"\n{text}'
        f"[log]\nq = {[f'q[{i}]' for i in range(9)]}\nx = {[f'x[{i}]' for i in range(3)]}\n"
        'groups = "motion"\ntime = "time"\n'
    )


def cost(n_rows: int) -> list[str]:
    """Return CPU [s] and peak memory [MiB] of ``hybridkin fit`` in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "log.npz"
        write_long_log(path, n_rows)
        robot = str(path.with_suffix(".toml"))
        command = [
            sys.executable,
            "-m",
            "hybridkin",
            "fit",
            str(path),
            "--robot",
            robot,
        ]
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        done = subprocess.run(
            [*command, "--out", f"{folder}/m", "--jobs", "1", "--quiet"],
            capture_output=True,
            text=True,
            check=False,
        )
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        done.check_returncode()
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return [str(n_rows), f"{seconds:.0f}", f"{after.ru_maxrss / 1024:.0f}"]


def cases(seeds: int) -> list[tuple[str, int, int]]:
    """Return the kinds of hysteresis, numbers of motions and seeds of the table."""
    every = []
    for kind in KINDS:
        for n_motions in SIZES:
            every += [(kind, n_motions, seed) for seed in range(seeds)]
    return every


def main() -> None:
    """Write long_logs.csv and long_logs_cost.csv into the folder of the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/long_logs"))
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--cost", type=int, nargs="*", default=[120_000, 1_020_000])
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (arguments.out / "long_logs.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HEADER)
        for case in cases(arguments.seeds):
            table.writerow(fitted_errors(*case))
            file.flush()
    with (arguments.out / "long_logs_cost.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(["rows at 100 Hz", "CPU [s]", "peak memory [MiB]"])
        for n_rows in arguments.cost:
            table.writerow(cost(n_rows))


if __name__ == "__main__":
    main()
