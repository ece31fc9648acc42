"""Few rows: whether models keep their promises, and what each part of the structural model brings.

The figures of the docs page "Results", section "Few rows"::

    python examples/studies/few_rows.py --out results/few_rows

About an hour on one core. The folder gets report.md, report.json and two CSV files. It needs
`hybridkin[sim]`, and the recordings in the folder that ``--data`` or HYBRIDKIN_DATA names; an
absent recording is left out with a warning. Draw k of the rows and of the noise has the seed k.
"""

from __future__ import annotations

import argparse
import warnings
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from csv_tables import add_csv
from hybrid_cases import (
    AUTO,
    STRUCTURAL,
    Case,
    armlab,
    plain_ftdcr,
    recorded_cases,
    trunk_cases,
)
from joblib import Parallel, delayed
from threadpoolctl import threadpool_limits

from hybridkin import HybridForwardModel
from hybridkin.app.workflow.report import Report
from hybridkin.calibration.natural_scales import STRUCTURE
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._structure import fit_structure

SIZES = (12, 25, 50, 100)
COVERAGE = 0.9


def promise_cases(n_draws: int, *, data_home: Any = None, folder: Any = None) -> list[Case]:
    """Return the cases of `promises`: both simulated trunks, armlab_3cable and ftdcr_v4."""
    n_test = 1000
    cases = trunk_cases(SIZES, n_draws, n_test, folder, 1)
    for load in (armlab, plain_ftdcr):
        robot = load(data_home)
        if robot is not None:
            cases += recorded_cases(robot, SIZES, n_draws, n_test)
    return cases


def promises(
    cases: Sequence[Case],
    name: str = AUTO,
    n_covered: int = 5,
    n_jobs: int | None = 1,
) -> list[dict[str, Any]]:
    """Return what a model promises of each case, and what is true on its test rows.

    Parameters
    ----------
    cases : sequence of Case
        Training rows, and test rows that are measured, or have the noise of the training rows.
    name : {"auto", "serial, structural"}, default="auto"
        The model.
    n_covered : int, default=5
        Draws whose models also estimate the radius that covers 90 % of the tips: five more fits.
    n_jobs : int, optional
        Processes.

    Returns
    -------
    list of dict
        One for each case: "case", "model", "draw", "n", "expected" and "true", mean errors [m];
        in covered draws also "covered", the share of test rows within the radius, and its mean
        "radius" [m].
    """
    return Parallel(n_jobs)(delayed(promise)(case, name, case.draw < n_covered) for case in cases)


@threadpool_limits.wrap(limits=1)
def promise(case: Case, name: str, covered: bool) -> dict[str, Any]:
    """Return the entry of a case, see `promises`."""
    q, x = [*case.tests.values()][-1]
    model = HybridForwardModel(case.chain, AUTO, random_state=case.draw)
    if name == STRUCTURAL:
        structural = {"error_model": "structural", "coupling": "serial"}
        model.set_params(**structural, calibrate=case.calibrate)
    if covered:
        model.set_params(coverage=COVERAGE)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # few rows, slack tendons
        model.fit(case.q, case.x, groups=case.groups)
    errors = np.linalg.norm(model.predict(q) - x, axis=1)
    entry = {"case": case.name, "model": name, "draw": case.draw, "n": len(case.q)}
    entry["expected"] = expected_error(model)
    entry["true"] = float(errors.mean())
    if covered:
        _, radius = model.predict(q, return_radius=True)
        entry["covered"] = float(np.mean(errors <= radius))
        entry["radius"] = float(np.mean(radius))
    return entry


def expected_error(model: HybridForwardModel) -> float:
    """Return the mean error to expect on new rows like those of the log [m]."""
    if model.cv_results_ is not None:
        return model.cv_results_["expected_distance"]
    held_out = model.error_model_.residual
    return float(np.linalg.norm(held_out, axis=1).mean())


def promise_lines(entries: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """Return one line for each case and size, with the columns of `PROMISES`."""
    lines = []
    by_point: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for entry in entries:
        point = entry["case"], entry["model"], entry["n"]
        by_point.setdefault(point, []).append(entry)
    for point, draws in by_point.items():
        expected = np.array([entry["expected"] for entry in draws])
        true = np.array([entry["true"] for entry in draws])
        ratios = expected / true
        covered = [entry for entry in draws if "covered" in entry]
        shares = [entry["covered"] for entry in covered]
        radii = [1e3 * entry["radius"] for entry in covered]
        lines.append(
            [
                *point,
                len(draws),
                1e3 * float(expected.mean()),
                1e3 * float(true.mean()),
                float(expected.mean() / true.mean()),
                float(np.median(ratios)),
                float(ratios.min()),
                float(ratios.max()),
                len(covered),
                float(np.mean(shares)) if covered else "",
                float(np.min(shares)) if covered else "",
                float(np.mean(radii)) if covered else "",
            ]
        )
    return lines


PROMISES = (
    "case",
    "model",
    "rows",
    "draws",
    "expected_mm",
    "true_mm",
    "ratio_of_means",
)
PROMISES += ("median_ratio", "least_ratio", "largest_ratio")
PROMISES += ("covered_draws", "mean_coverage", "least_coverage", "mean_radius_mm")

WHOLE = "all blocks"
LEFT_OUT = {
    "the base": ("base turn", "base move"),
    "zeros": ("zero lengths", "zero bends"),
    "rings": ("ring stretch", "ring turn"),
    "free maps of rings": ("ring maps",),
    "twist and sag by a common load": ("gravity",),
    "twist and sag of each segment": ("twists", "sags"),
    "any sag": ("sag of a twist", "sags"),
    "any twist and sag": ("gravity", "twists", "sags"),
}
"""Blocks of the prior by what is left out of the structural model."""

FACTORS = {"the prior times 1/3": 1.0 / 3.0, "the prior times 3": 3.0}


def ablation(
    sizes: Sequence[int], n_draws: int, *, folder: Any = None, n_jobs: int | None = 1
) -> list[dict[str, Any]]:
    """Return the errors of the structural model on both trunks, with parts of its prior left out.

    Parameters
    ----------
    sizes : sequence of int
        Training rows.
    n_draws : int
        Draws of these rows and of the noise.
    folder : path-like, optional
        Where rows of the simulated trunks are stored, to be loaded by the next run.
    n_jobs : int, optional
        Processes.

    Returns
    -------
    list of dict
        One for each case and prior: "case", "draw", "n", "prior" and "error", the mean on test rows
        without noise [m].
    """
    cases = trunk_cases(sizes, n_draws, 1000, folder, n_jobs)
    found = Parallel(n_jobs)(delayed(without_blocks)(case) for case in cases)
    return [entry for entries in found for entry in entries]


@threadpool_limits.wrap(limits=1)
def without_blocks(case: Case) -> list[dict[str, Any]]:
    """Return the entries of a case, see `ablation`; all share one calibration to its rows."""
    chain = HybridForwardModel(case.chain, "drop", calibrate=case.calibrate)
    chain = chain.fit(case.q, case.x).mechanical_model_
    rows = Rows(case.q, case.x)
    q, x = case.tests["without noise"]
    entries = []
    for name, factor, scales in priors():
        fit = fit_structure(chain, rows, factor, left_out=False, scales=scales)
        errors = np.linalg.norm(fit.model(torch.from_numpy(q)).numpy() - x, axis=1)
        entry = {"case": case.name, "draw": case.draw, "n": len(case.q)}
        entries.append({**entry, "prior": name, "error": float(errors.mean())})
    return entries


def priors() -> Iterator[tuple[str, float, dict[str, float]]]:
    """Yield name, common factor and scales of the priors that are compared."""
    yield WHOLE, 1.0, STRUCTURE
    for name, blocks in LEFT_OUT.items():
        yield f"without {name}", 1.0, STRUCTURE | dict.fromkeys(blocks, 0.0)
    for name, factor in FACTORS.items():
        yield name, factor, STRUCTURE


def ablation_lines(entries: Sequence[dict[str, Any]]) -> list[list[Any]]:
    """Return one line for each case, prior and size, with the columns of `ABLATION`."""
    errors: dict[tuple[str, str, int], list[float]] = {}
    for entry in entries:
        key = entry["case"], entry["prior"], entry["n"]
        errors.setdefault(key, []).append(1e3 * entry["error"])
    lines = []
    for (name, prior, n), of_draws in errors.items():
        spread = float(np.std(of_draws, ddof=1)) if len(of_draws) > 1 else 0.0
        whole = np.mean(errors[name, WHOLE, n])
        mean = float(np.mean(of_draws))
        lines.append([name, prior, n, len(of_draws), mean, spread, float(mean / whole)])
    return lines


ABLATION = ("case", "prior", "rows", "draws", "mean_mm", "std_mm", "ratio_to_all")


def few_rows_report(promised: Sequence[Sequence[Any]], ablated: Sequence[Sequence[Any]]) -> Report:
    """Return the report of `promise_lines` and `ablation_lines`, with their tables as files."""
    report = Report("Few rows", {})
    report.text("## What the models promise", "Errors on rows with noise.")
    report.table(PROMISES, [_texts(line) for line in promised])
    report.text("## Parts of the structural model", "Errors on rows without noise.")
    report.table(ABLATION, [_texts(line) for line in ablated])
    add_csv(report, "few_rows_promises.csv", PROMISES, promised)
    add_csv(report, "few_rows_ablation.csv", ABLATION, ablated)
    return report


def _texts(line: Sequence[Any]) -> list[str]:
    return [f"{cell:.2f}" if isinstance(cell, float) else str(cell) for cell in line]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run both parts and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--data", help="folder of the recordings; default: HYBRIDKIN_DATA")
    parser.add_argument("--rows", help="folder that stores the simulated rows")
    parser.add_argument("--draws", type=int, default=20, help="default: 20")
    parser.add_argument(
        "--covered", type=int, default=5, help="draws of auto with a radius; default: 5"
    )
    parser.add_argument("--jobs", type=int, default=1, help="processes; default: 1")
    given = parser.parse_args(arguments)
    cases = promise_cases(given.draws, data_home=given.data, folder=given.rows)
    promised = []
    for name, n_covered in ((STRUCTURAL, given.draws), (AUTO, given.covered)):
        promised += promise_lines(promises(cases, name, n_covered, given.jobs))
    ablated = ablation_lines(ablation((25, 100, 400), 5, folder=given.rows, n_jobs=given.jobs))
    for path in few_rows_report(promised, ablated).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
