"""A tapered tentacle under gravity, pulled by two tendon forces: errors on loads held out.

The table of the docs page "Results", section "Forces and pressures"::

    python examples/studies/tentacle.py --jobs 2

About 70 s of processor time. It needs the recording soromox_tentacle in the folder that
``--data`` or HYBRIDKIN_DATA names (`help(hybridkin.datasets.load_soromox_tentacle)` names its
source). Each of the 22 loads is held out once; everything is fitted to the other 21.
"""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray

from hybridkin import ForceTendonChain, HybridForwardModel, calibrate, datasets

LENGTH = 0.36  # [m]
PLACES = (
    0.125,
    0.208,
    0.275,
    0.355,
)  # of the markers along the body [m], read off the recording
BASE = [
    [1, 0, 0, 0],
    [0, 0, 1, 0],
    [0, -1, 0, 0],
    [0, 0, 0, 1],
]  # the body hangs along y
PARAMETERS = (
    "bending_stiffness",
    "axial_stiffness",
    "weight",
    "taper",
    "rest_bends",
    "base",
    "marker_offsets",
)


def nominal() -> ForceTendonChain:
    """Return the tentacle before calibration: orders of magnitude, from no fit."""
    chain = ForceTendonChain(
        [0.012],
        [LENGTH],
        bending_stiffness=0.02,
        axial_stiffness=100.0,
        n_actuators=2,
        angles=np.radians([-60.0, 60.0]),
        weight=2.0,
        taper=0.5,
        gravity=[0.0, 1.0, 0.0],
        arcs=4,
        base=BASE,
    )
    return chain.with_markers([(0, place / LENGTH) for place in PLACES])


def held_out_errors(q: NDArray, x: NDArray, row: int) -> NDArray:
    """Return the distances (3, 4) [mm] of the markers of one row, fitted to all other rows.

    Models: nominal, calibrated, calibrated with a quadratic residual.
    """
    train = np.arange(len(q)) != row
    chain = nominal()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # fewer rows than parameters: priors determine some
        calibrated = calibrate(chain, q[train], x[train], PARAMETERS).chain
        errors = []
        for model, name in (
            (chain, "drop"),
            (calibrated, "drop"),
            (calibrated, "quadratic"),
        ):
            hybrid = HybridForwardModel(model, name, random_state=0)
            hybrid.fit(q[train], x[train])
            residual = hybrid.predict(q[[row]]) - x[[row]]
            errors.append(np.linalg.norm(residual.reshape(4, 3), axis=1))
    return 1e3 * np.stack(errors)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    parser.add_argument("--jobs", type=int, default=1)
    options = parser.parse_args()
    data = datasets.load_soromox_tentacle(options.data)
    rows = range(len(data.q))
    run = Parallel(options.jobs)
    errors = np.stack(run(delayed(held_out_errors)(data.q, data.x, row) for row in rows))
    print("| model | mean of four markers | largest load | tip | largest tip |")
    print("| --- | --- | --- | --- | --- |")
    for k, name in enumerate(("nominal", "calibrated", "calibrated + quadratic")):
        of_load = errors[:, k].mean(1)
        tip = errors[:, k, 3]
        numbers = (of_load.mean(), of_load.max(), tip.mean(), tip.max())
        print(f"| {name} | " + " | ".join(f"{number:.1f}" for number in numbers) + " |")
    for group, of_load in zip(data.groups, errors.mean(2), strict=True):
        print(group, np.round(of_load, 1))


if __name__ == "__main__":
    main()
