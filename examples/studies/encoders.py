"""Faults of encoders in logs: whether the check names them, and what they cost before a mend.

The table of the docs page "Results", section "Motors and encoders" and ``docs/data/encoders.csv``::

    python examples/studies/encoders.py --csv docs/data/encoders.csv

One minute. Simulated: a robot of two tendon segments whose motors count 4096 steps a turn; radii
6 % and lengths 3 % off the description, tips with 0.2 mm noise, 12 motions of 60 rows. Each fault
is tried in 10 logs, seeds 0 to 9. The error is the mean distance of the hybrid with a serial
quadratic, radii and base calibrated, on 6 new motions without faults, of the first 3 seeds.
"""

from __future__ import annotations

import argparse
import csv
import itertools
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import ConstantCurvatureChain, HybridForwardModel
from hybridkin.app import check_log
from hybridkin.datasets import Log, load_log

PERIOD = 4096.0
GAIN = 1e-5  # [m/count]
STROKE = 700.0  # [counts]
MOTIONS = 12
ROWS = 60  # of a motion
SEEDS = 10
FITTED = 3  # seeds with fits
NAMES = ("m1", "m2", "m3", "m4", "m5", "m6")
HEADER = (
    "fault",
    "named",
    "other words about columns",
    "mended",
    "mean without fault [mm]",
    "mean with it [mm]",
    "mean after --unwrap [mm]",
)


class Recording(NamedTuple):
    """Counts (N, 6), tips (N, 3) [m] and motions (N,)."""

    q: NDArray
    x: NDArray
    motions: NDArray


def robot(radius: float = 0.008, length: float = 0.1) -> ConstantCurvatureChain:
    """Return two segments of three tendons."""
    return ConstantCurvatureChain([radius] * 2, lengths=[length] * 2, routing="base", gains=GAIN)


def recording(seed: int, n_motions: int) -> Recording:
    """Return motions between random postures, and the tips of the true robot."""
    rng = np.random.default_rng(seed)
    ring = np.stack([np.cos([0.0, 2.1, 4.2]), np.sin([0.0, 2.1, 4.2])])
    bends = rng.uniform(-STROKE, STROKE, (n_motions + 1, 2, 2))
    knots = (np.cumsum(bends, axis=1) @ ring).reshape(-1, 6)
    s = np.linspace(0.0, 1.0, ROWS, endpoint=False)[:, None]
    way = s * s * (3.0 - 2.0 * s)
    q = np.concatenate([a + way * (b - a) for a, b in itertools.pairwise(knots)])
    q = np.round(q)
    x = robot(0.0085, 0.103)(torch.from_numpy(q)).numpy()
    x += 2e-4 * rng.standard_normal(x.shape)
    return Recording(q, x, np.repeat(np.arange(n_motions), ROWS))


def wraps(rng: np.random.Generator, q: NDArray) -> NDArray:
    """Return counts within a turn."""
    return np.mod(q, PERIOD)


def unsigned(rng: np.random.Generator, q: NDArray) -> NDArray:
    """Return unsigned counts of 16 bits."""
    return np.mod(q, 65536.0)


def one_wraps(rng: np.random.Generator, q: NDArray) -> NDArray:
    """Return counts of which one column is within a turn."""
    column = rng.integers(6)
    bad = q.copy()
    bad[:, column] = np.mod(q[:, column], PERIOD)
    return bad


def lost_turn(rng: np.random.Generator, q: NDArray) -> NDArray:
    """Return counts of which one column loses a turn at some row."""
    bad = q.copy()
    bad[rng.integers(60, len(q) - 60) :, rng.integers(6)] += PERIOD
    return bad


def glitches(rng: np.random.Generator, q: NDArray) -> NDArray:
    """Return counts of which four readings of one column are a turn off."""
    bad = q.copy()
    rows = rng.choice(np.arange(5, len(q) - 5), 4, replace=False)
    bad[rows, rng.integers(6)] += PERIOD * rng.choice([-1.0, 1.0], 4)
    return bad


FAULTS: dict[str, Callable[[np.random.Generator, NDArray], NDArray]] = {
    "all wrap at 4096": wraps,
    "unsigned, 16 bits": unsigned,
    "one wraps at 4096": one_wraps,
    "a turn lost at a row": lost_turn,
    "four readings a turn off": glitches,
}


def written(path: Path, log: Recording) -> dict[str, object]:
    """Write a log as CSV, and return how it is read."""
    table = np.column_stack([log.q, 1e3 * log.x, log.motions])
    header = ",".join([*NAMES, "x", "y", "z", "motion"])
    np.savetxt(path, table, "%.9g", ",", header=header, comments="")
    columns = {"q": NAMES, "x": ["x", "y", "z"], "groups": "motion"}
    return {**columns, "q_unit": "1", "x_unit": "mm"}


def error(log: Log, test: Recording) -> float:
    """Return the mean error of a hybrid on new motions [mm]."""
    start = log.q - np.median(log.q[:20], axis=0)  # counts from the first posture
    shift = np.rint((log.q[0] - start[0]) / PERIOD) * PERIOD  # whole turns
    model = HybridForwardModel(robot(), "quadratic", coupling="serial", calibrate="default")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(log.q - shift, log.x, groups=log.groups)
    tips = model.predict(test.q)
    return 1e3 * float(np.linalg.norm(tips - test.x, axis=1).mean())


def tried(fault: str, seed: int, folder: Path) -> list[float]:
    """Return the numbers of a row of the table, NaN where nothing was fitted."""
    clean = recording(seed, MOTIONS)
    bad = FAULTS[fault](np.random.default_rng(1000 + seed), clean.q)
    path = folder / "log.csv"
    reading = written(path, clean._replace(q=bad))
    read = load_log(path, **reading)
    kinds = {finding.kind for finding in check_log(read, chain=robot()).findings}
    mended = load_log(path, **reading, unwrap=PERIOD if "16" not in fault else 65536)
    off = mended.q - clean.q
    numbers = [
        "encoder" in kinds,
        bool(kinds & {"order", "sign", "numbering", "units", "offset", "drift", "size"}),
        np.ptp(off, axis=0).max() == 0.0 and not np.mod(off, PERIOD).any(),
    ]
    if seed >= FITTED:
        return [*map(float, numbers), np.nan, np.nan, np.nan]
    test = recording(seed + 500, 6)
    original = load_log(path, **written(path, clean))
    errors = [error(log, test) for log in (original, read, mended)]
    return [*map(float, numbers), *errors]


def main() -> None:
    """Print all figures, and write them as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--csv", type=Path, required=True)
    path = parser.parse_args().csv
    lines = []
    for fault in FAULTS:
        rows = np.array([tried(fault, seed, path.parent) for seed in range(SEEDS)])
        counts = [f"{count:.0f} of {SEEDS}" for count in rows[:, :3].sum(axis=0)]
        means = [f"{mean:.2f}" for mean in np.nanmean(rows[:, 3:], axis=0)]
        lines.append([fault, *counts, *means])
        print(*lines[-1], sep="  ", flush=True)
    (path.parent / "log.csv").unlink()
    with open(path, "w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows([HEADER, *lines])


if __name__ == "__main__":
    main()
