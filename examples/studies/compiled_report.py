"""Tables and the figure of the study `compiled`."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin.app.workflow.report import Report
from hybridkin.plots import new_figure

FAR = 20.0  # times half the range: the farthest rows
RUNS, MORE_RUNS = 3, 100  # of every tick, and of the slowest
_QUANTILES = (0.5, 0.999, 0.9999)


class Ticks(NamedTuple):
    """Times of all ticks [us]: the first run, and the shortest of a few runs of the same tick.

    `slowest` is the longest among the shortest of many runs, of the slowest ticks.
    """

    once: NDArray
    least: NDArray
    slowest: float


Found = dict[str, dict[str, Any]]


def _table(report: Report, header: list[str], rows: list[list[Any]]) -> None:
    report.table(header, [[str(cell) for cell in row] for row in rows])


def agreement_report(report: Report, found: Found) -> None:
    """Add the table of `agreement` by case."""
    report.text(
        f"Largest differences between core and torch, of x and J relative to the largest value: "
        f"within the limits, and up to {FAR:g} times as far out."
    )
    names = ("x", "J", "distance")
    columns = [*names, *(f"{name}_far" for name in names), "single"]
    heads = [*names, *(f"{name}, far" for name in names), "row or batch"]
    rows = [
        [
            name,
            one["n"],
            *(f"{one[c]:.1g}" for c in columns),
            one["decisions"],
            one["nan"],
        ]
        for name, one in found.items()
    ]
    _table(report, ["model", "rows", *heads, "other in_domain", "other NaN"], rows)


def steps_report(report: Report, found: Found) -> None:
    """Add the table of `steps` by robot."""
    report.text("Steps: differences of J dq [m], and of dq relative to the limits.")
    report.text("Control: dq of torch, and of torch with q moved by its last bit.")
    columns = ("move", "dq", "control", "move_off", "dq_off", "control_off")
    heads = ["J dq [m]", "dq", "control"]
    heads += [f'{head}, limits="off"' for head in heads]
    rows = [
        [
            name,
            one["n"],
            *(f"{one[c]:.1g}" for c in columns),
            one["flags"],
            one["outside"],
        ]
        for name, one in found.items()
    ]
    _table(report, ["robot", "steps", *heads, "other `saturated`", "beyond limits"], rows)


def solve_report(report: Report, found: Found) -> None:
    """Add the table of `solve` by robot."""
    report.text(
        "Solutions: statuses that differ, and the differences of errors where they agree. Control: "
        "rows of torch with another q where the target moves by its last bit."
    )
    heads = ["targets", "other status", "of these of equal error", "error, reached [m]"]
    heads += ["error, not reached [m]", "other q [%]", "control [%]"]
    heads += ["CPU time, core [s]", "torch [s]"]
    rows = []
    for name, one in found.items():
        errors = [f"{one[key]:.1g}" for key in ("error_reached", "error")]
        shares = [f"{100.0 * one[key] / one['n']:.2g}" for key in ("other_q", "control")]
        seconds = [f"{one[key]:.3g}" for key in ("seconds", "seconds_torch")]
        counts = [one[key] for key in ("n", "differ", "moved")]
        rows.append([name, *counts, *errors, *shares, *seconds])
    _table(report, ["robot", *heads], rows)
    for name, one in found.items():
        for pair, count in one["statuses"].items():
            report.text(f"- {name}: {count} x {pair}")


def ticks_report(report: Report, found: dict[str, Ticks]) -> Any:
    """Add the table and the figure of `ticks` by case, and return the figure."""
    report.text(
        "Times of single calls of `hk_ik_tick` [us], clock and ctypes call included; every tick "
        f"once, and the shortest of {RUNS} runs of it, which leaves out most interruptions by the "
        f"system. Last: of the slowest ticks the shortest of {MORE_RUNS} runs."
    )
    rows = []
    for name, one in found.items():
        values = [[*np.quantile(a, _QUANTILES), a.max()] for a in (one.once, one.least)]
        numbers = (f"{value:.2f}" for value in (*values[0], *values[1], one.slowest))
        rows.append([name, str(len(one.once)), *numbers])
    report.record["ticks"] = rows
    heads = ["median", "99.9 %", "99.99 %", "worst"]
    heads += [f"{head} of {RUNS}" for head in heads]
    report.table(["model", "ticks", *heads, f"worst of {MORE_RUNS}"], rows)
    figure = _figure(found)
    caption = "Times of ticks: the shortest of three runs of each, and every one by itself."
    report.figure("ticks", figure, caption)
    return figure


def _figure(found: dict[str, Ticks]) -> Any:
    figure, axes = new_figure(8.0, 3.4, 1, 2, sharey=True)
    edges = 10.0 ** np.arange(-1.0, 4.01, 0.05)
    titles = (f"Shortest of {RUNS} runs of a tick", "Every tick by itself")
    for axis, title, what in zip(axes, titles, ("least", "once"), strict=True):
        for k, (name, one) in enumerate(found.items()):
            counts = np.histogram(getattr(one, what), edges)[0]
            axis.stairs(counts, edges, color=f"C{k}", linewidth=1.2, label=name)
        axis.set(xscale="log", yscale="log", xlim=(0.3, 3e3), ylim=(0.5, None), title=title)
        axis.set_xlabel("time of a tick [µs]")
    axes[0].set_ylabel("ticks")
    axes[0].legend(loc="upper right", fontsize="small")
    return figure
