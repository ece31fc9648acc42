"""Move the simulated trunk to the commands of a file, and write what it measures, as a log in mm.

    python examples/studies/measured_trunk.py plan/next.csv log.csv

The file has the columns q1 to q9, as those of `hybridkin next` and `hybridkin track`. Lengths are
measured with 1 mm of noise, tips with 0.5 mm. It needs `hybridkin[sim]` (MuJoCo).
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence

import numpy as np
from numpy.lib.recfunctions import structured_to_unstructured
from simulated_trunk import TrunkPlant

COLUMNS = tuple(f"q{k}" for k in range(1, 10))


def measured_trunk(commands: str, log: str, seed: int = 0) -> int:
    """Write the measured lengths and tips of the trunk at rest, and return the number of rows.

    Parameters
    ----------
    commands : str
        CSV file with the commanded lengths [mm].
    log : str
        CSV file to write, with measured lengths and tips [mm].
    seed : int, default=0
        Of the noise.
    """
    plant = TrunkPlant(cable_noise=1e-3, mocap_noise=5e-4, random_state=seed)
    table = np.genfromtxt(commands, delimiter=",", names=True)
    rows = []
    for command in structured_to_unstructured(table[list(COLUMNS)]):
        q, pose = plant.settle(1e-3 * command)
        rows.append(np.concatenate([q, pose[:3, 3]]))
    header = ",".join([*COLUMNS, "x", "y", "z"])
    np.savetxt(log, 1e3 * np.array(rows), "%.2f", ",", header=header, comments="")
    return len(rows)


def main(argv: Sequence[str] | None = None) -> None:
    """Measure, see the head of the file."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("commands", help="CSV file of commands [mm]")
    parser.add_argument("log", help="CSV file to write")
    parser.add_argument("--seed", type=int, default=0, help="of the noise (0)")
    options = parser.parse_args(argv)
    n_rows = measured_trunk(options.commands, options.log, options.seed)
    print(f"Wrote {options.log}: {n_rows} rows, measured on the simulated trunk.")


if __name__ == "__main__":
    main()
