"""Coverage of the error radius for the same motions at other speeds, with creep and with backlash.

The table of the docs page "Results", section "States and paces"::

    python examples/studies/paces.py --out results/paces

The simulated trunk of ``hysteresis.py``; between two rows commands go on a straight line in ten
steps, which the log does not show. A few minutes of processor time.
"""

from __future__ import annotations

import argparse
import csv
from pathlib import Path

import numpy as np
from hysteresis import TRUNK, by_group, tips
from numpy.typing import NDArray

from hybridkin import Commands, HybridForwardModel, Hysteresis

ROWS = 60  # in a motion
STEPS = 10  # of the robot between two rows
NOISE = 5e-4  # [m]
MOTIONS = 24
NEW = 40
SPEEDS = (0.05, 0.2, 0.5, 1.0, 2.0, 3.0, 10.0)
CREEP = Hysteresis.creep([0.12, 0.1, 0.08], [1.2, 9.0, 45.0])
BACKLASH = Hysteresis.backlash(0.02)
KINDS: dict[str, Hysteresis] = {
    "creep": CREEP,
    "backlash and creep": BACKLASH | CREEP,
    "backlash": BACKLASH,
}
HEADER = ["hysteresis", "seed", "speed", "rows", "in the domain", "of these covered"]
HEADER += ["covered of all rows", "mean error [mm]"]


def motions(rng: np.random.Generator, n: int, speed: float = 1.0) -> Commands:
    """Return commands of n motions of 21 to 42 s, at a multiple of this speed."""
    turn = np.linspace(0.0, 2.0 * np.pi, ROWS)
    shapes = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ shapes).transpose(0, 2, 1)
    steps = np.repeat(0.5 * rng.uniform(0.7, 1.4, n) / speed, ROWS)
    return Commands(q.reshape(-1, 9), np.repeat(np.arange(n), ROWS), np.cumsum(steps))


def measured(commands: Commands, operator: Hysteresis, rng: np.random.Generator) -> NDArray:
    """Return the tips (N, 3) of the robot, whose commands go on between the rows [m]."""

    def moved(rows: NDArray) -> NDArray:
        time, q = rows[:, 0], rows[:, 1:]
        fine = np.linspace(time[0], time[-1], STEPS * (len(q) - 1) + 1)
        dense = np.stack([np.interp(fine, time, column) for column in q.T], axis=1)
        steps = np.diff(fine, prepend=fine[0])
        return operator.apply(dense, dt=steps)[0][::STEPS]

    rows = np.column_stack([commands.time, commands.q])
    x = tips(by_group(moved, rows, commands.run_of_rows))
    return x + NOISE * rng.standard_normal(x.shape)


def table_of(kind: str, seed: int) -> list[list[str]]:
    """Return the rows of the table of a kind of hysteresis."""
    operator = KINDS[kind]
    rng = np.random.default_rng(seed)
    commands = motions(rng, MOTIONS)
    x = measured(commands, operator, rng)
    settings = {"coupling": "serial", "play": "auto", "coverage": 0.9}
    model = HybridForwardModel(TRUNK, "quadratic", **settings)
    model.fit(commands, x, groups=commands.runs)
    rows = []
    for speed in SPEEDS:
        new = motions(np.random.default_rng(1000 + seed), NEW, speed)
        error = np.linalg.norm(model.predict(new) - measured(new, operator, rng), axis=1)
        inside = model.in_domain(new)
        covered = error <= model.radius_.inside
        shares = [inside.mean(), covered[inside].mean(), covered.mean()]
        texts = [f"{share:.2f}" for share in shares]
        rows.append([kind, str(seed), f"{speed:g}", str(len(error)), *texts])
        rows[-1].append(f"{1e3 * error.mean():.2f}")
    return rows


def main() -> None:
    """Write paces.csv into the folder of the arguments."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("results/paces"))
    parser.add_argument("--seeds", type=int, default=2)
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    with (arguments.out / "paces.csv").open("w", newline="") as file:
        table = csv.writer(file)
        table.writerow(HEADER)
        for kind in KINDS:
            for seed in range(arguments.seeds):
                table.writerows(table_of(kind, seed))
                file.flush()


if __name__ == "__main__":
    main()
