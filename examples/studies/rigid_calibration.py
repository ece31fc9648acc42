"""Kinematic calibration of a simulated rigid arm: errors at new postures, by what was calibrated.

The table of the docs page "Results", section "Rigid arms"::

    python examples/studies/rigid_calibration.py --out results/rigid_calibration

Two minutes on one core. An arm of five turning joints, 0.95 m long without its tool, stands in an
unknown frame: its base is turned by 2 rad and moved by 1 m. Its tool is 60 mm from the described
one. Standard deviations of the errors of the description: 1 degree of every joint zero, 1 mm of
every coordinate of a link, and 0 or 0.5 degrees of the axes about each of two directions. The
measured tips have 0.05 mm of noise in each coordinate. Errors are those from the true tips.
"""

from __future__ import annotations

import argparse
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin import HybridForwardModel, RigidChain
from hybridkin.app.workflow.report import Report

NOISE = 5e-5  # [m]
RANGE = 1.5  # [rad]
TESTED = 1000

PLACES = [[0, 0, 0.2], [0.03, 0, 0.1], [0, 0, 0.3], [0, 0.02, 0.25], [0, 0, 0.1]]
AXES = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0]]


class Case(NamedTuple):
    """How far an arm is from its description, and how many rows are measured."""

    name: str
    rows: int
    axes_off: float = 0.0  # [deg]
    reversed_ones: tuple[int, ...] = ()


CASES = [
    Case("tool, zeros, links", 300),
    Case("+ axes", 30, 0.5),
    Case("+ axes", 60, 0.5),
    Case("+ axes", 300, 0.5),
    Case("+ axes, motors 2 and 4 reversed", 60, 0.5, (1, 3)),
]
WAYS = {
    '("base",)': ("drop", ("base",)),
    '("base", "tool")': ("drop", ("base", "tool")),
    '"default"': ("drop", "default"),
    '"auto"': ("drop", "auto"),
    '"auto", error_model="auto"': ("auto", "auto"),
}
"""Columns of the table: the error model and `calibrate` of each."""


def described() -> RigidChain:
    """Return the arm of the description."""
    origins = np.tile(np.eye(4), (5, 1, 1))
    origins[:, :3, 3] = PLACES
    return RigidChain(origins, AXES)


def built(case: Case, seed: int) -> RigidChain:
    """Return an arm as it was built."""
    rng = np.random.default_rng(1000 + seed)
    arm = described()
    tool, turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((3, 3)))
    base = np.eye(4)
    base[:3, :3] = _turned(2.0 * turn)
    base[:3, 3] = move
    axes = []
    for axis, off in zip(arm.axes.numpy(), rng.standard_normal((5, 3)), strict=True):
        axes.append(_turned(np.radians(case.axes_off) * np.cross(axis, off)) @ axis)
    zeros = np.radians(1.0) * rng.standard_normal(5)
    links = arm.geometry()["links"].numpy() + 1e-3 * rng.standard_normal((5, 3))
    arm = arm.with_geometry(
        base=torch.from_numpy(base),
        tool=torch.from_numpy(0.06 * tool),
        joint_zeros=torch.from_numpy(zeros),
        links=torch.from_numpy(links),
        axes=torch.from_numpy(np.array(axes)),
    )
    return arm.with_reversed(case.reversed_ones)


def _turned(vector: NDArray) -> NDArray:
    return Rotation.from_rotvec(vector).as_matrix()


def examined(case: Case, seed: int) -> list[float]:
    """Return the mean distance from the true tips at new postures, for each of `WAYS` [mm]."""
    rng = np.random.default_rng(seed)
    arm = built(case, seed)
    q = rng.uniform(-RANGE, RANGE, (case.rows + TESTED, arm.n_actuators))
    true = arm(torch.from_numpy(q)).numpy()
    fitted = slice(case.rows)
    measured = true[fitted] + NOISE * rng.standard_normal((case.rows, 3))
    errors = []
    for error_model, names in WAYS.values():
        model = HybridForwardModel(described(), error_model, calibrate=names, random_state=0)
        with warnings.catch_warnings():  # of reversed motors
            warnings.simplefilter("ignore", UserWarning)
            model.fit(q[fitted], measured)
        off = model.predict(q[case.rows :]) - true[case.rows :]
        errors.append(1e3 * float(np.linalg.norm(off, axis=1).mean()))
    return errors


def calibration_report(seeds: int) -> Report:
    """Return the table: mean and largest of the arms."""
    report = Report("Kinematic calibration of a simulated arm of five joints", {})
    table = []
    for case in CASES:
        errors = np.array([examined(case, seed) for seed in range(seeds)])
        cells = []
        for column in errors.T:
            cells.append(f"{column.mean():.3g} ({column.max():.3g})")
        table.append([case.name, str(case.rows), *cells])
        report.record[f"{case.name}, {case.rows} rows"] = errors.tolist()
    report.table(["wrong in the description", "rows", *WAYS], table)
    report.text(
        f"Mean distance from the true tips at {TESTED} new postures in mm: mean over {seeds} "
        "simulated arms (largest of them)."
    )
    return report


def main(given: Sequence[str] | None = None) -> int:
    """Write the report."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=int, default=3, help="number of arms")
    arguments = parser.parse_args(given)
    report = calibration_report(arguments.seeds)
    report.write(arguments.out)
    print(report.plain())
    return 0


if __name__ == "__main__":
    sys.exit(main())
