"""Hybrid models compared: few rows, outside the training range, held-out motions of a robot.

The tables of the docs page "Results", sections "Few rows" to "Outside the log"::

    python examples/studies/hybrids.py --out results/hybrids

About two hours on one core. It needs `hybridkin[sim]`, and the recordings in the folder that
``--data`` or HYBRIDKIN_DATA names (`help(hybridkin.datasets.load_ftdcr)` names their sources); an
absent recording is left out with a warning. The folder gets report.md, report.json, hybrids.csv
with all errors, and two figures. Draw k of the rows and of the noise has the seed k, and so have
the networks; fold k of the motions, too. The figures of the page, from the stored errors::

    python examples/studies/hybrids.py --draw docs/data/hybrids.csv --out results/hybrids
"""

from __future__ import annotations

import argparse
import csv
import sys
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from csv_tables import add_csv
from hybrid_cases import (
    AUTO,
    CALIBRATED,
    DATA_ONLY,
    INNER,
    NOMINAL,
    PAPER,
    STRUCTURAL,
    Case,
    armlab,
    asl_trunk,
    examined,
    motion_cases,
    plain_ftdcr,
    pull_cases,
    pull_cases_of_armlab,
    recorded_cases,
    run_cases,
    trunk_cases,
)
from joblib import Parallel, delayed

from hybridkin import plots
from hybridkin.app.workflow.report import Report

SIZES = (12, 25, 50, 100, 200, 400, 800, 1600, 3200)

_PANELS = 4  # in a line of the figure outside the range
_IN_LINE = 3  # panels of the learning curves
_TICKS = (0.2, 0.5, 1, 2, 5, 10, 20, 50, 100, 200, 500)

Progress = Callable[[str, int, int], None]
"""Called with (what, done, total)."""

_LOOKS = {NOMINAL: ("black", ":"), CALIBRATED: ("black", "--")}
_LOOKS |= dict(zip(DATA_ONLY, (("#E69F00", "s-"), ("#D55E00", "o-")), strict=True))
_LOOKS |= {PAPER: ("0.6", "v-"), "parallel, quadratic": ("#F0E442", "s-")}
_LOOKS |= {
    "parallel, kernel ridge": ("#0072B2", "o-"),
    "serial, quadratic": ("#56B4E9", "s-"),
}
_LOOKS |= {"parallel, pose": ("#CC79A7", "v:"), "serial, pose": ("#CC79A7", "^-")}
_LOOKS |= {STRUCTURAL: ("#882255", "P-"), AUTO: ("#009E73", "D-")}

CURVES = tuple(_LOOKS)
"""The models that `learning_curves` compares."""


def learning_curves(
    sizes: Sequence[int] = SIZES,
    n_draws: int = 5,
    *,
    n_test: int = 1000,
    models: Sequence[str] | None = None,
    data_home: Any = None,
    folder: Any = None,
    n_jobs: int | None = 1,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the errors of all models against the number of training rows.

    Two simulated trunks: fully random rows with the noise of `make_trunk`, tested on other
    rows without noise and with it. Recorded robots: single rows, tested on a fifth of the groups:
    armlab_3cable (lines of its grid), ftdcr_v4 with a plain chain (motions), asl_trunk_static
    (runs). Sizes with more rows than there are are left out.

    Parameters
    ----------
    sizes : sequence of int
        Training rows; fewer rows are part of more rows of the same draw.
    n_draws : int, default=5
        Draws of these rows and of the noise; of recorded robots also of the groups held out.
    n_test : int, default=1000
        Test rows.
    models : sequence of str, optional
        Names of the models, as in the result. Default: `CURVES`; of the other studies all.
    data_home : path-like, optional
        Folder of the recordings, see `datasets.load_armlab`. One that is absent is left out with
        a warning.
    folder : path-like, optional
        Where rows of the simulated trunks are stored, to be loaded by the next run.
    n_jobs, progress
        Processes, and a callable that gets (what, done, total).

    Returns
    -------
    list of dict
        One entry per case and model: "case", "draw", "n", "model", "seconds" (CPU time of the fit)
        and by "errors" of every test "mean", "max" [m] and "n_test". Of "auto" also "chosen",
        "weights", "scores", its cross-validated errors by candidate, and "expected_distance" [m].
    """
    cases = trunk_cases(sizes, n_draws, n_test, folder, n_jobs)
    for load in (armlab, plain_ftdcr, asl_trunk):
        robot = load(data_home)
        if robot is not None:
            cases += recorded_cases(robot, sizes, n_draws, n_test)
    return examine(cases, CURVES if models is None else models, n_jobs, progress)


def extrapolation(
    n: int = 400,
    n_draws: int = 3,
    *,
    n_test: int = 1000,
    models: Sequence[str] | None = None,
    data_home: Any = None,
    folder: Any = None,
    n_jobs: int | None = 1,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the errors of all models outside their training range.

    The trunks: trained within the inner 60 and 80 % of the range of every length, tested on rows
    of the whole range that leave this box. armlab_3cable: trained where no cable is shortened by
    more than 6 mm, tested where one is. ftdcr_v4: the same with 60 % of the pull of every tendon.

    Parameters
    ----------
    n : int, default=400
        Training rows.
    n_draws, n_test, models, data_home, folder, n_jobs, progress
        As in `learning_curves`.

    Returns
    -------
    list of dict
        One entry per case and model, as in `learning_curves`.
    """
    trunks = (trunk_cases([n], n_draws, n_test, folder, n_jobs, inner=part) for part in INNER)
    cases = [case for one in trunks for case in one]
    cases += pull_cases_of_armlab(n, n_draws, n_test, data_home)
    cases += pull_cases(data_home, thin=2)
    return examine(cases, models, n_jobs, progress)


def held_out_motions(
    *,
    thin: int = 2,
    models: Sequence[str] | None = None,
    data_home: Any = None,
    n_jobs: int | None = 1,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the errors of all models on held-out motions of ftdcr_v4 and asl_trunk_static.

    Whole motions in five folds; all motions of a pair of segments held out, three times; and the
    motions of two segments, learned from those of a single one, where groups are the motions or the
    segments that move. Mechanical models: a constant-curvature chain, and one of elastic tendons.
    `auto, hysteresis="auto"` fits backlash as well; its predictions use the motion so far. Of
    asl_trunk_static whole runs are held out, in five folds.

    Parameters
    ----------
    thin : int, default=2
        Step between training rows: the motions are slow.
    models, data_home, n_jobs, progress
        As in `learning_curves`; without the recording the result is empty, with a warning.

    Returns
    -------
    list of dict
        One entry per case and model, as in `learning_curves`.
    """
    cases = motion_cases(data_home, thin) + run_cases(data_home, thin)
    return examine(cases, models, n_jobs, progress)


def examine(
    cases: Sequence[Case],
    models: Sequence[str] | None = None,
    n_jobs: int | None = 1,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """Return the entries of all cases, see `learning_curves`; the seed of a case is its draw."""
    table: list[dict[str, Any]] = []
    jobs = (delayed(examined)(case, models) for case in cases)
    results: Any = Parallel(n_jobs=n_jobs, return_as="generator")(jobs)
    for done, (case, entries) in enumerate(zip(cases, results, strict=True), 1):
        table += entries
        if progress is not None:
            progress(f"{case.name}, {len(case.q)} rows", done, len(cases))
    return table


def hybrids_report(
    curves: list[dict[str, Any]],
    outside: list[dict[str, Any]],
    motions: list[dict[str, Any]],
) -> Report:
    """Return the report of `learning_curves`, `extrapolation` and `held_out_motions`.

    Parameters
    ----------
    curves, outside, motions : list of dict
        What the three returned, in this order.

    Returns
    -------
    Report
        Tables in mm and two figures; ``report.write(folder)`` writes them with ``report.json``.
    """
    report = Report("Hybrid models compared", {})
    report.record.update(curves=curves, outside=outside, motions=motions)
    report.text("## Few rows", "Tip error in mm, mean ± standard deviation over draws.")
    for case, test in _tests(curves):
        means = _means(curves, case, test, by_size=True)
        sizes = sorted({n for _, n in means})
        report.text(f"{case}, {test}:")
        rows = []
        for model in dict.fromkeys(model for model, _ in means):
            cells = [_spread(means[model, n]) if (model, n) in means else "" for n in sizes]
            rows.append([model, *cells])
        report.table(["rows", *map(str, sizes)], rows)
    if curves:
        report.figure("hybrid_curves", _curves_figure(curves), "Tip error against training rows.")
    for title, entries in (
        ("Outside the training range", outside),
        ("Held-out motions", motions),
    ):
        cases = _tests(entries)
        found = [_means(entries, *case) for case in cases]
        report.text(f"## {title}", "Tip error in mm, mean over draws or folds (largest of all).")
        rows = []
        for model in dict.fromkeys(entry["model"] for entry in entries):
            values = (1e3 * np.array(means.get(model, [np.nan] * 3)) for means in found)
            rows.append([model, *(f"{mean:.2f} ({largest:.1f})" for mean, _, largest in values)])
        report.table(["model", *(", ".join(case) for case in cases)], rows)
        report.text("Choice of auto, its cross-validated error and its test error, in mm:")
        report.table(_CHOICES, [_choice(entry) for entry in entries if "scores" in entry])
    if outside:
        report.figure("hybrid_outside", _outside_figure(outside), "Tip error outside the range.")
    parts = {"few rows": curves, "outside the training range": outside}
    parts["held-out motions"] = motions
    lines = [line for study, entries in parts.items() for line in csv_lines(study, entries)]
    add_csv(report, "hybrids.csv", _COLUMNS, lines)
    return report


_COLUMNS = ("study", "case", "test", "rows", "model", "mean_mm", "std_mm", "max_mm")
_COLUMNS += ("cross_validated_mm", "expected_mm", "draws")


def stored_entries(path: Any) -> dict[str, list[dict[str, Any]]]:
    """Return by study the entries that the figures need, from a file hybrids.csv."""
    found: dict[str, list[dict[str, Any]]] = {}
    with open(path, newline="", encoding="utf-8") as file:
        for line in csv.DictReader(file):
            entry: dict[str, Any] = {key: line[key] for key in ("case", "model")}
            mean, largest = (1e-3 * float(line[key] or "nan") for key in ("mean_mm", "max_mm"))
            entry["errors"] = {line["test"]: {"mean": mean, "max": largest, "n_test": 1}}
            entry["n"] = int(line["rows"] or 0)
            found.setdefault(line["study"], []).append(entry)
    return found


def csv_lines(study: str, entries: list[dict[str, Any]]) -> list[list[Any]]:
    """Return one line for each model, size and test; of auto with the error that it expects."""
    lines, by_size = [], study == "few rows"
    for case, test in _tests(entries):
        for key, found in _means(entries, case, test, by_size=by_size).items():
            model, size = key if by_size else (key, None)
            some = [e for e in entries if (e["case"], e["model"]) == (case, model)]
            some = [e for e in some if test in e["errors"] and size in (None, e["n"])]
            scores = [e["scores"][e["chosen"]] for e in some if "scores" in e]
            rows = "" if size is None and len({e["n"] for e in some}) > 1 else some[0]["n"]
            errors = [1e3 * float(error) for error in found]
            expected = [e["expected_distance"] for e in some if "scores" in e]
            promised = ["", ""]
            if scores:
                promised = [1e3 * float(np.mean(part)) for part in (scores, expected)]
            lines.append([study, case, test, rows, model, *errors, *promised, len(some)])
    return lines


def _spread(errors: tuple[float, float, float]) -> str:
    mean, std, _ = 1e3 * np.array(errors)
    return f"{mean:.2f} ± {std:.2f}"


_CHOICES = ("case", "draw", "model", "calibrated", "chosen", "cross-validated", "test")


def _choice(entry: dict[str, Any]) -> list[str]:
    errors = next(iter(entry["errors"].values()))
    numbers = [f"{1e3 * e:.2f}" for e in (entry["scores"][entry["chosen"]], errors["mean"])]
    names = [entry[key] for key in ("model", "parameters", "chosen")]
    return [entry["case"], str(entry["draw"]), *names, *numbers]


def _tests(table: list[dict[str, Any]]) -> list[tuple[str, str]]:
    return [*dict.fromkeys((entry["case"], test) for entry in table for test in entry["errors"])]


def _means(
    table: list[dict[str, Any]], case: str, test: str, *, by_size: bool = False
) -> dict[Any, tuple[float, float, float]]:
    """Return by model the mean over draws, its spread and the largest error [m]."""
    runs: dict[Any, list[Any]] = {}
    for entry in table:
        if entry["case"] == case and test in entry["errors"]:
            key = (entry["model"], entry["n"]) if by_size else entry["model"]
            errors = entry["errors"][test]
            runs.setdefault(key, []).append([errors["mean"], errors["max"], errors["n_test"]])
    found = {}
    for key, rows in runs.items():
        means, largest, weights = np.array(rows).T
        spread = means.std(ddof=1) if len(means) > 1 else 0.0
        found[key] = np.average(means, weights=weights), spread, largest.max()
    return found


def _curves_figure(curves: list[dict[str, Any]]) -> Any:
    cases = [(case, test) for case, test in _tests(curves) if test != "with noise"]
    n_lines = -(-(len(cases) + 1) // _IN_LINE)  # the last panel is the legend
    shape = n_lines, min(_IN_LINE, len(cases) + 1)
    figure, axes = plots.new_figure(10.5, 4.0 * n_lines, *shape, squeeze=False)
    for ax, (case, test) in zip(axes.flat, cases, strict=False):
        means = _means(curves, case, test, by_size=True)
        sizes = sorted({n for _, n in means})
        for model, (color, form) in _LOOKS.items():
            by_size = np.array([means.get((model, n), [np.nan])[0] for n in sizes])
            known = np.isfinite(by_size)
            if known.any():
                x, y = np.array(sizes)[known], 1e3 * by_size[known]
                ax.loglog(x, y, form, color=color, markersize=4, label=model)
        ax.grid(alpha=0.3)
        ax.set_xlabel("training rows")
        _plain_ticks(ax.yaxis)
        ax.set_xticks(sizes[::2], [str(n) for n in sizes[::2]])
        ax.set_xticks([], minor=True)
        ax.set(title=f"{case}, {test}", ylabel="")
    for ax in axes[:, 0]:
        ax.set_ylabel("mean tip error [mm]")
    for ax in axes.flat[len(cases) :]:
        ax.set_axis_off()
    lines = axes[0, 0].get_legend_handles_labels()
    axes.flat[-1].legend(*lines, loc="center", frameon=False)
    return figure


def _outside_figure(outside: list[dict[str, Any]]) -> Any:
    cases = [(case, test) for case, test in _tests(outside) if test != "with noise"]
    n_lines = -(-len(cases) // _PANELS)
    shape = n_lines, -(-len(cases) // n_lines)
    figure, axes = plots.new_figure(9.0, 3.6 * n_lines, *shape, sharey=True, squeeze=False)
    for ax in axes.flat[len(cases) :]:
        ax.set_axis_off()
    names = list(dict.fromkeys(entry["model"] for entry in outside))
    for ax, case in zip(axes.flat, cases, strict=False):
        means = _means(outside, *case)
        shown = [name for name in names if name in means]
        places = [len(names) - names.index(name) for name in shown]
        for k, label, mark, color in (
            (0, "mean", "o", "#0072B2"),
            (2, "largest", "x", "#D55E00"),
        ):
            values = [1e3 * means[name][k] for name in shown]
            ax.plot(values, places, mark, color=color, label=label)
            least = min((NOMINAL, CALIBRATED), key=lambda name: means.get(name, [np.inf])[0])
            better = f"{label} of nominal or calibrated, the better one"
            ax.axvline(
                1e3 * means[least][k],
                color=color,
                lw=1.0,
                ls="--",
                alpha=0.6,
                label=better,
            )
        ax.set(xscale="log", xlabel="tip error [mm]")
        ax.set_title(case[0], fontsize="small")
        _plain_ticks(ax.xaxis)
        ax.set_yticks(range(len(names), 0, -1), names)
        ax.grid(alpha=0.3)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    place = {
        "loc": "outside lower center",
        "ncols": 2,
        "fontsize": "small",
        "frameon": False,
    }
    figure.legend(handles, labels, **place)
    return figure


def _plain_ticks(axis: Any) -> None:
    low, high = axis.get_view_interval()
    ticks = [t for t in _TICKS if low < t < high]
    axis.set_ticks(ticks, [f"{t:g}" for t in ticks])
    axis.set_ticks([], minor=True)


def main(arguments: Sequence[str] | None = None) -> None:
    """Run all comparisons and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--data", help="folder of the recordings; default: HYBRIDKIN_DATA")
    parser.add_argument("--rows", help="folder that stores the simulated rows for the next run")
    parser.add_argument("--sizes", type=int, nargs="+", default=SIZES, help="training rows")
    parser.add_argument("--draws", type=int, default=5, help="draws of the few rows; default: 5")
    parser.add_argument("--test-rows", type=int, default=1000, help="default: 1000")
    parser.add_argument(
        "--models",
        nargs="+",
        help="names as in the report, besides the two mechanical models; default: all",
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes; default: 1")
    parser.add_argument("--draw", metavar="CSV", help="only draw the figures of a hybrids.csv")
    given = parser.parse_args(arguments)
    if given.draw is not None:
        entries = stored_entries(given.draw)
        report = Report("Hybrid models compared", {})
        report.figure("hybrid_curves", _curves_figure(entries["few rows"]), "")
        report.figure("hybrid_outside", _outside_figure(entries["outside the training range"]), "")
        print(*report.write(given.out), sep="\n")
        return

    def shown(what: str, done: int, total: int) -> None:
        print(f"{done}/{total} {what}", file=sys.stderr)

    models = given.models
    if models is not None:  # the figures compare with the mechanical models
        models = [NOMINAL, CALIBRATED, *models]
    common = {"models": models, "data_home": given.data, "n_jobs": given.jobs}
    common["progress"] = shown
    trunks = {"n_test": given.test_rows, "folder": given.rows, **common}
    curves = learning_curves(given.sizes, given.draws, **trunks)
    outside = extrapolation(min(400, max(given.sizes)), min(3, given.draws), **trunks)
    for path in hybrids_report(curves, outside, held_out_motions(**common)).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
