"""Reproduce the paper on the simulated trunk: tables and figures, in a report.

    python examples/paper --out results

Writes Table 1, the error histogram, the workspace, a figure eight and a spiral tracked with the
mechanical and with the hybrid model, and how well the paper's samples identify the trunk's
geometry. A minute on two cores. It needs `hybridkin[sim]` (MuJoCo).
"""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1]))  # where the package `paper` lies

from hybridkin.app.cli._terminal import Stages
from hybridkin.app.cli._values import count
from paper.report import run_paper


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study; see its --help."""
    parser = argparse.ArgumentParser(
        prog="python examples/paper",
        description=__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add(
        "--out",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="folder (results)",
    )
    add(
        "--splits",
        type=count,
        default=20,
        metavar="N",
        help="number of random test sets (20)",
    )
    add("--seeds", type=count, default=5, metavar="N", help="random networks (5)")
    add(
        "--points",
        type=count,
        default=151,
        metavar="N",
        help="time steps of each path (151)",
    )
    add(
        "--jobs",
        type=int,
        default=-1,
        metavar="N",
        help="processes; -1: one per core (-1)",
    )
    options = parser.parse_args(arguments)
    with contextlib.closing(Stages()) as stages:
        report, paths = run_paper(
            options.out,
            n_splits=options.splits,
            n_seeds=options.seeds,
            n_points=options.points,
            n_jobs=options.jobs,
            progress=stages,
        )
    print("\n  ".join([f"{report.plain()}\n\nWrote", *map(str, paths)]))


if __name__ == "__main__":
    main()
