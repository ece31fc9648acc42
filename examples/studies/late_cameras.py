"""Feedback of a camera that is late, noisy, or wrong: mean errors of a simulated trunk.

The table of the docs page "Results", section "Late cameras" and ``docs/data/late_cameras.csv``::

    python examples/studies/late_cameras.py --csv docs/data/late_cameras.csv

Twenty seconds. The robot has radii 5 % larger than the model. Its tip follows one figure eight of
10 s in periods of 10 ms. Errors are those of the true tip after the first second. Seeds 0 to 2
where something is drawn at random.
"""

from __future__ import annotations

import argparse
import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hybridkin import (
    ConstantCurvatureChain,
    InverseKinematics,
    native,
    robots,
    trajectories,
)

DT = 0.01
DELAYS = (0.0, 1.0, 2.0, 3.5, 5.0, 10.0)  # periods
GAINS = (None, 0.1, 0.2, 0.5, 1.0)  # times the period
SEEDS = 3
START = 100  # periods that do not count
HEADER = ("gain x dt", "delay [periods]", "given", "noise [mm]", "dropouts", "outliers")


@dataclass(frozen=True)
class Camera:
    """How late readings come [periods], their noise [m], and shares of missing and wrong ones."""

    delay: float
    noise: float = 0.0
    dropouts: float = 0.0
    outliers: float = 0.0

    @property
    def seeds(self) -> int:
        """Number of runs."""
        return SEEDS if self.noise > 0.0 else 1


@dataclass(frozen=True)
class Loop:
    """The gain times the period (None: the default), and whether the delay is given."""

    gain: float | None
    given: bool


def trunk(wrong: float = 1.0) -> ConstantCurvatureChain:
    """Return the trunk, with radii multiplied by a factor."""
    chain = robots.bionic_handling_assistant()
    return chain.with_geometry(radii=wrong * chain.radii)


def errors(loop: Loop, camera: Camera, seed: int) -> NDArray:
    """Return the distances (T,) of the true tip from the path [m]."""
    rng = np.random.default_rng(seed)
    robot = trunk(1.05)
    gain = None if loop.gain is None else loop.gain / DT
    ik = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, dq_max=0.5, dt=DT, gain=gain)
    path = trajectories.figure_eight((0.0, 0.0, 0.70), (0.5, 0.25), dt=DT)
    speeds = np.diff(path.x, axis=0, append=path.x[-1:]) / DT
    start = np.asarray(ik.solve(path.x[0]).q)
    tracker = ik.tracker(start, delay=loop.given * camera.delay * DT)
    tips: list[NDArray] = []
    missed = []
    for target, speed in zip(path.x, speeds, strict=True):
        tip = native.evaluate(robot, tracker.q[None])[0][0]
        tips.append(tip)
        missed.append(np.linalg.norm(tip - target))
        place = max(len(tips) - 1 - camera.delay, 0.0)
        before = int(place)
        after = min(before + 1, len(tips) - 1)
        reading = tips[before] + (place - before) * (tips[after] - tips[before])
        reading = reading + camera.noise * rng.standard_normal(3)
        if rng.random() < camera.outliers:
            way = rng.standard_normal(3)
            reading = reading + 0.2 * way / np.linalg.norm(way)
        if rng.random() < camera.dropouts:
            reading = np.full(3, np.nan)
        tracker.step(target, speed, x_measured=reading)
    return np.array(missed)


def cases() -> list[tuple[Loop, Camera]]:
    """Return every loop with every camera."""
    found = [(Loop(None, True), Camera(0.0, dropouts=1.0))]  # without feedback
    for delay in DELAYS:
        for gain in GAINS:
            for noise in (0.0, 1e-3):
                for given in (True, False):
                    if given or delay > 0.0:
                        found.append((Loop(gain, given), Camera(delay, noise)))
    for given in (True, False):
        for wrong in ((0.3, 0.0), (0.05, 0.05), (0.3, 0.05)):
            found.append((Loop(None, given), Camera(2.0, 1e-3, *wrong)))
    return found


def about(loop: Loop, camera: Camera) -> list[str | float]:
    """Return what distinguishes a case, in the order of `HEADER`."""
    gain = "default" if loop.gain is None else loop.gain
    flaws = [camera.dropouts, camera.outliers]
    return [gain, camera.delay, int(loop.given), 1e3 * camera.noise, *flaws]


def mean_error(loop: Loop, camera: Camera) -> tuple[float, float]:
    """Return the mean error over the seeds, and how far they lie apart [mm]."""
    runs = []
    for seed in range(camera.seeds):
        runs.append(1e3 * errors(loop, camera, seed)[START:].mean())
    return float(np.mean(runs)), float(np.ptp(runs))


def main() -> None:
    """Print all figures, and write them as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--csv", type=Path, required=True)
    rows = []
    for loop, camera in cases():
        figures = (f"{figure:.3g}" for figure in mean_error(loop, camera))
        rows.append([*about(loop, camera), *figures])
        print(*rows[-1], sep="  ")
    with open(parser.parse_args().csv, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*HEADER, "mean error [mm]", "spread of seeds [mm]"])
        writer.writerows(rows)


if __name__ == "__main__":
    main()
