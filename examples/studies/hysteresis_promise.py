"""Coverage of the estimated error radius, and the domain, where actuators have hysteresis.

The tables of the docs page "Results", section "States and paces"::

    python examples/studies/hysteresis_promise.py

Some seven minutes of processor time. The trunk is the simulated one of `hysteresis.py`.
"""

from __future__ import annotations

import argparse
import warnings

import numpy as np
from hysteresis import (
    NOISE,
    ROWS,
    TRUNK,
    bouc_wen,
    by_group,
    far,
    many_plays,
    motions,
    timed,
    tips,
)
from numpy.typing import NDArray

from hybridkin import Commands, HybridForwardModel

FRICTIONS = {"25 plays": many_plays, "Bouc-Wen": bouc_wen}


def measured(friction: str, commands: Commands, rng: np.random.Generator) -> NDArray:
    """Return the measured tips (N, 3) [m]."""
    y = by_group(FRICTIONS[friction], commands.q, commands.run_of_rows)
    return tips(y) + NOISE * rng.standard_normal((len(commands), 3))


def from_the_ends(commands: Commands, rng: np.random.Generator) -> Commands:
    """Return motions that begin at the ends of the range and go to its middle."""
    late = np.linspace(0.0, 1.0, ROWS)[:, None]
    q = commands.q.reshape(-1, ROWS, 9)
    start = 0.05 * rng.choice([-1.0, 1.0], (len(q), 1, 9))
    q = 0.25 + (q - 0.25) * late + start * (1.0 - late)
    return timed(q.reshape(-1, 9), commands.run_of_rows)


def line(model: HybridForwardModel, new: Commands, x: NDArray, groups: NDArray) -> str:
    """Return errors on new motions, the share in the domain, and that within the radius."""
    error = far(model.predict(new), x)
    inside = model.in_domain(new)
    covered = []
    for name in np.unique(groups[inside]):
        of_motion = error[inside & (groups == name)]
        covered.append(np.mean(of_motion <= 1e3 * model.radius_.inside))
    share = f"{100 * np.mean(covered):.0f} %" if covered else "-"
    return f"{error.mean():.2f} mm | {100 * inside.mean():.0f} % | {share}"


def main() -> None:
    """Print the lines of the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=2)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)
    print("friction | motions in a run | new motions | error | in domain | in radius")
    for friction in FRICTIONS:
        for in_a_row in (1, 6):
            for seed in range(arguments.draws):
                rng = np.random.default_rng(200 + seed)
                q, groups = motions(rng, 24)
                commands = timed(q, groups // in_a_row)
                model = HybridForwardModel(
                    TRUNK,
                    "quadratic",
                    coupling="serial",
                    hysteresis="auto",
                    coverage=0.9,
                )
                model.fit(commands, measured(friction, commands, rng), groups=groups)
                q, groups = motions(rng, 48)
                alike = timed(q, groups // in_a_row)
                for name, new in {
                    "alike": alike,
                    "from the ends": from_the_ends(alike, rng),
                }.items():
                    x = measured(friction, new, rng)
                    words = line(model, new, x, groups)
                    print(f"{friction} | {in_a_row} | {name} | {words}", flush=True)


if __name__ == "__main__":
    main()
