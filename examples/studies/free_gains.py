"""What calibrated gains of the actuators do on held-out motions of two real robots.

The table of the docs page "Results", section "Motors and encoders"::

    python examples/studies/free_gains.py --out results/free_gains

A minute on one core. ftdcr_v4: q in the millimetres of its servos, whole motions in five folds;
asl_trunk_static: q in the units of its motor commands, whole runs in five folds. The recordings
are read from the folder that ``--data`` or HYBRIDKIN_DATA names; an absent one is left out.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from hybrid_cases import SPOOL, nine_tendons, recording, run_cases
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold

from hybridkin import calibrate, datasets
from hybridkin.app.workflow.report import Report
from hybridkin.chains.arc_chain import ArcChain

EXTRA: dict[str, tuple[str, ...]] = {
    "gains fixed": (),
    "one gain": ("gain",),
    "all": ("gains",),
}
"""What is calibrated besides the geometry."""


class Fold(NamedTuple):
    """Rows to calibrate a robot with, and held-out ones, q in the unit of the log."""

    name: str
    chain: ArcChain
    parameters: tuple[str, ...]
    train: tuple[NDArray, NDArray]
    test: tuple[NDArray, NDArray]


def folds_of(data_home: Any, thin: int = 1) -> Iterator[Fold]:
    """Yield five folds of each robot, of the models that are calibrated."""
    data = recording(datasets.load_ftdcr, data_home)
    splits = [] if data is None else GroupKFold(5).split(data.q, groups=data.groups)
    for train, test in splits:
        train = train[::thin]
        pair = tuple((1e3 * data.q[rows], data.x[rows]) for rows in (train, test))
        for name, (chain, names) in nine_tendons().items():
            counted = chain.with_geometry(gains=torch.full_like(chain.gains, 1e-3))
            yield Fold(f"ftdcr_v4, {name}", counted, names, *pair)
    for case in run_cases(data_home, thin):
        chain = case.chain.with_geometry(gains=torch.full_like(case.chain.gains, SPOOL))
        test = case.tests["5 folds"]
        pair = (case.q / SPOOL, case.x), (test[0] / SPOOL, test[1])
        yield Fold(case.name, chain, case.chain.default_parameters, *pair)


def examined(fold: Fold) -> dict[str, float]:
    """Return the mean tip distance on the held-out rows, by what was calibrated [mm]."""
    found = {}
    with warnings.catch_warnings():  # of slack tendons, and of lengths that leave what is physical
        warnings.simplefilter("ignore", UserWarning)
        for name, extra in EXTRA.items():
            names = (*fold.parameters, *extra)
            chain = calibrate(fold.chain, *fold.train, names).chain
            with torch.no_grad():
                tips = chain(torch.from_numpy(fold.test[0])).numpy()
            found[name] = 1e3 * float(np.linalg.norm(tips - fold.test[1], axis=1).mean())
    return found


def gains_report(data_home: Any, thin: int = 1) -> Report:
    """Return the table: means over the folds, and the change by the gains with its spread."""
    report = Report("Calibrated gains on held-out motions", {})
    entries: dict[str, list[dict[str, float]]] = {}
    for fold in folds_of(data_home, thin):
        entries.setdefault(fold.name, []).append(examined(fold))
    rows = []
    for name, found in entries.items():
        errors = np.array([[*one.values()] for one in found])
        changes = errors[:, 1:] - errors[:, :1]
        cells = [f"{mean:.2f}" for mean in errors.mean(0)]
        cells += [f"{c.mean():+.2f} ± {c.std(ddof=1):.2f}" for c in changes.T]
        rows.append([name, *cells])
    report.record["errors"] = entries
    changed = [f"change, {name}" for name in [*EXTRA][1:]]
    report.table(["robot", *EXTRA, *changed], rows)
    report.text("Mean tip distance in mm over five folds; changes: mean ± standard deviation.")
    return report


def main(given: Sequence[str] | None = None) -> int:
    """Write the report."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--data", type=Path)
    parser.add_argument("--thin", type=int, default=1, help="every so many rows of a fold")
    arguments = parser.parse_args(given)
    report = gains_report(arguments.data, arguments.thin)
    report.write(arguments.out)
    print(report.plain())
    return 0


if __name__ == "__main__":
    sys.exit(main())
