"""When the commands of a control loop at 1 kHz are ready: Python's tracker and exported C.

The figure and the table of the docs page "Control loops"::

    python examples/studies/latency.py --out results/latency

Half a minute, on Linux with a C compiler. As root both loops run under SCHED_FIFO.
"""

from __future__ import annotations

import argparse
import gc
import os
import re
import subprocess
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    InverseKinematics,
    datasets,
)
from hybridkin.app.workflow.report import Report
from hybridkin.native import export_c
from hybridkin.plots import new_figure

LOOP = Path(__file__).parents[1] / "c" / "loop.c"
# of the circle [m]; of a turn [ticks]; [ns]
RADIUS, TURN, PERIOD = (
    0.01,
    2000,
    1_000_000,
)
BINS = 100  # ten per decade, from 1 ns


class Latencies(NamedTuple):
    """Numbers of commands by bin, and the worst [us]: ready after the deadline; the step alone."""

    after: NDArray
    step: NDArray
    worst_after: float
    worst_step: float


def trunk_ik() -> InverseKinematics:
    """Return inverse kinematics of a hybrid of the simulated trunk (ELM, leverage guard)."""
    data = datasets.load_trunk()
    model = HybridForwardModel(ConstantCurvatureChain([0.100, 0.093, 0.079]), random_state=0)
    model.fit(data.q[:600], data.x[:600])
    low, high = data.q.min(0), data.q.max(0)
    return InverseKinematics(model, q_min=low, q_max=high, dq_max=0.5, dt=1e-9 * PERIOD)


def python_loop(ik: InverseKinematics, n_ticks: int) -> Latencies:
    """Return the latencies of a loop around `tracker.step`."""
    home = ik.settings.start(ik.settings.q_min).numpy()
    tracker, rate = ik.tracker(home), 2.0 * np.pi / TURN
    angle = rate * np.arange(n_ticks)[:, None]
    path = tracker.x + RADIUS * np.hstack([np.cos(angle) - 1.0, np.sin(angle), 0.0 * angle])
    speed = RADIUS * rate * 1e9 / PERIOD * np.hstack([-np.sin(angle), np.cos(angle), 0.0 * angle])
    after, step = np.empty(n_ticks), np.empty(n_ticks)
    gc.collect()
    gc.disable()  # a collection takes milliseconds
    high = _scheduled(True)
    deadline = time.monotonic_ns()
    for i in range(n_ticks):
        deadline += PERIOD
        time.sleep(1e-9 * max(deadline - time.monotonic_ns(), 0))
        woken = time.monotonic_ns()
        tracker.step(path[i], speed[i])  # send what it returns here
        ready = time.monotonic_ns()
        after[i], step[i] = ready - deadline, ready - woken
    gc.enable()
    if high:
        _scheduled(False)
    bins = [(10.0 * np.log10(a)).astype(int).clip(0, BINS - 1) for a in (after, step)]
    counts = [np.bincount(a, minlength=BINS) for a in bins]
    return Latencies(*counts, 1e-3 * after.max(), 1e-3 * step.max())


def _scheduled(high: bool) -> bool:
    """Ask for SCHED_FIFO, or give it back, and return whether that was granted."""
    policy, priority = (os.SCHED_FIFO, 80) if high else (os.SCHED_OTHER, 0)
    try:
        os.sched_setscheduler(0, policy, os.sched_param(priority))
    except PermissionError:
        return False
    return True


def c_loop(ik: InverseKinematics, n_ticks: int, dtype: str = "float64") -> Latencies:
    """Return the latencies of examples/c/loop.c around the exported step."""
    with tempfile.TemporaryDirectory() as folder:
        export_c(ik, folder, name="robot", dtype=dtype)
        program = Path(folder) / "loop"
        options = ["-O2", f"-DTICKS={n_ticks}", f"-DRADIUS={RADIUS}", "-I", folder]
        sources = [LOOP, Path(folder) / "robot.c"]
        subprocess.run(["cc", *options, *sources, "-lm", "-o", program], check=True)
        *lines, last = subprocess.check_output([program], text=True).splitlines()
    rows = np.array([line.split() for line in lines], dtype=float)
    counts = np.zeros((2, BINS))
    counts[:, np.round(10.0 * np.log10(1e3 * rows[:, 0])).astype(int)] = rows[:, 1:].T
    worst = re.findall(r"([\d.]+) us", last)
    return Latencies(*counts, *map(float, worst))


def latency_report(found: dict[str, Latencies]) -> Report:
    """Return a table and a figure of loops by name."""
    report, rows = Report("Latency at 1 kHz", {}), []
    for name, one in found.items():
        medians = [_quantile(counts, 0.5) for counts in one[:2]]
        late = [_quantile(counts, 0.999) for counts in one[:2]]
        values = zip(medians, late, one[2:], strict=True)
        after, step = [[f"{value:.1f}" for value in row] for row in values]
        rows.append([name, str(int(one.step.sum())), *step, *after])
    report.record["table"] = rows
    step, after = "step [us]", "command after its deadline [us]"
    rest = ("99.9 % below", "worst")
    report.table(["loop", "ticks", f"{step}: median", *rest, f"{after}: median", *rest], rows)
    report.figure("latency", _figure(found), "All ticks of both loops; dashed: the worst.")
    return report


def _quantile(counts: NDArray, share: float) -> float:
    """Return the upper end of the bin [us] that a share of all ticks lies below."""
    return 1e-3 * 10.0 ** (0.1 * (1 + np.searchsorted(counts.cumsum(), share * counts.sum())))


def _figure(found: dict[str, Latencies]) -> Any:
    figure, axes = new_figure(8.0, 3.4, 1, 2, sharey=True)
    edges = 10.0 ** (0.1 * np.arange(BINS + 1) - 3.0)
    for axis, title, what in zip(axes, ("Step", "Command after its deadline"), (1, 0), strict=True):
        for k, (name, one) in enumerate(found.items()):
            axis.stairs(one[what], edges, color=f"C{k}", linewidth=1.5, label=name)
            axis.axvline(one[what + 2], color=f"C{k}", linestyle="--", linewidth=1.0)
        axis.set(xscale="log", yscale="log", xlim=(1.0, 1e4), ylim=(0.5, None), title=title)
        axis.set_xlabel("time [µs]; dashed: the worst tick")
    axes[0].set_ylabel("ticks")
    axes[0].legend(loc="upper right")
    return figure


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both loops and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--ticks", type=int, default=10_000, help="per loop (10000)")
    given = parser.parse_args(arguments)
    ik = trunk_ik()
    backend = ik.tracker(ik.settings.start(ik.settings.q_min).numpy()).backend
    found = {f"Python ({backend})": python_loop(ik, given.ticks)}
    found |= {f"C, {dtype}": c_loop(ik, given.ticks, dtype) for dtype in ("float64", "float32")}
    for path in latency_report(found).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
