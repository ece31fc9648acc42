"""Logs that cannot show which parameters of a robot are wrong, and the motion that can.

The table of the docs page "Results", section "Rows to measure"; simulated robots and
armlab_3cable, two minutes of processor time::

    python examples/studies/separating.py
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch
from hybrid_cases import armlab
from numpy.typing import NDArray

from hybridkin import ConstantCurvatureChain, choose_geometry, separating_motions

SEEDS = 3
DRAWS = 5
PULL = 4e-3  # [m]
ROWS = 60
NOISE = 3e-4  # [m]
RADIUS = 0.006  # [m]
RING = 2.0 * np.pi / 3.0 * np.arange(3)
Chain = ConstantCurvatureChain

BASE = torch.eye(4, dtype=torch.float64)
BASE[:3, 3] = torch.tensor([0.05, -0.1, 0.2])


def measured(truth: Chain, q: NDArray, rng: np.random.Generator) -> NDArray:
    """Return tips with noise (N, 3) [m]."""
    return truth(torch.from_numpy(q)).numpy() + NOISE * rng.standard_normal((len(q), 3))


def straight(rng: np.random.Generator) -> tuple[Chain, Chain, NDArray]:
    """Return nominal chain, truth and log of chambers, of which the second ones stay straight."""
    nominal = ConstantCurvatureChain([0.05, 0.05])
    truth = nominal.with_geometry(radii=torch.tensor([0.05, 0.065]).double(), base=BASE)
    second = rng.uniform(0.18, 0.26, (ROWS, 1)) + rng.uniform(-5e-4, 5e-4, (ROWS, 3))
    return nominal, truth, np.hstack([rng.uniform(0.15, 0.3, (ROWS, 3)), second])


def hardly_bent(rng: np.random.Generator) -> tuple[Chain, Chain, NDArray]:
    """Return nominal chain, truth and log of tendons that bend two segments by up to 6 deg."""
    nominal = ConstantCurvatureChain([RADIUS, RADIUS], lengths=[0.1, 0.1])
    truth = nominal.with_geometry(offsets=torch.tensor([0.0, 0.03]).double(), base=BASE)
    bends = rng.uniform(-0.1, 0.1, (ROWS, 2, 2))
    return nominal, truth, -RADIUS * (bends @ [np.cos(RING), np.sin(RING)]).reshape(ROWS, 6)


TOOL = "radii + turns + rest_bends + lengths + tool + base"
LOGS = {
    "segment 2 straight": (straight, 0.15, 0.3, ("base", "radii + base")),
    "bends up to 6 deg": (hardly_bent, -0.01, 0.01, ("radii + base", TOOL)),
}


def main() -> None:
    """Print the tables: mean tip errors in mm, one number for each seed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, help="folder of the recordings")
    small_pulls(parser.parse_args().data)
    print("| log | set | on the log | on the motion | on the motion, with it |")
    print("| --- | --- | --- | --- | --- |")
    for name, (make, low, high, pair) in LOGS.items():
        errors: dict[str, list[list[float]]] = {one: [] for one in pair}
        words = []
        for seed in range(SEEDS):
            rng = np.random.default_rng(seed)
            nominal, truth, q = make(rng)
            x = measured(truth, q, rng)
            choice = choose_geometry(nominal, q, x)
            sets = {one.name: one for one in (choice, *choice.rivals)}
            if not {*pair} <= {*sets}:
                words.append(f"seed {seed}: {choice.name!r} alone")
                continue
            motions = separating_motions(choice, q, x, q_min=low, q_max=high)
            (motion,) = [m for m in motions if {m.chosen, m.rival} == {*pair}]
            words.append(f"seed {seed}: {motion}")
            q_new = motion.q
            x_new = measured(truth, q_new, rng)
            for one in pair:
                before = sets[one].calibrate(q, x).chain
                after = sets[one].calibrate(np.vstack([q, q_new]), np.vstack([x, x_new])).chain
                tests = (before, q, x), (before, q_new, x_new), (after, q_new, x_new)
                errors[one].append([error(*test) for test in tests])
        for one in pair:
            columns = np.transpose(errors[one])
            cells = [", ".join(f"{value:.2f}" for value in column) for column in columns]
            print(f"| {name} | {one} | {' | '.join(cells)} |")
        print("\n".join(words), flush=True)


def small_pulls(data_home: Path | None) -> None:
    """Print errors of armlab_3cable outside a log of 40 rows with pulls up to 4 mm [mm].

    Eight rows are added: those nearest to the named motion, or random ones of the whole range.
    """
    robot = armlab(data_home)
    if robot is None:
        return
    near = (robot.q >= -PULL).all(axis=1)
    beyond = np.flatnonzero(~near)[::7]
    print("\n| draw | log alone | with the motion | with random rows |")
    print("| --- | --- | --- | --- |")
    for seed in range(DRAWS):
        rng = np.random.default_rng(seed)
        log = rng.permutation(np.flatnonzero(near))[:40]
        choice = choose_geometry(robot.chain, robot.q[log], robot.x[log])
        low = robot.q.min(axis=0)
        high = robot.q.max(axis=0)
        motions = separating_motions(choice, robot.q[log], robot.x[log], q_min=low, q_max=high)
        if not motions:
            print(f"| {seed} | {choice.name!r} alone |  |  |")
            continue
        motion = max(motions, key=lambda m: m.remaining / m.noise)
        far = np.linalg.norm((robot.q[:, None] - motion.q) / (high - low), axis=2)
        added = np.unique(far.argmin(axis=0))
        others = rng.permutation(len(robot.q))[: len(added)]
        cells = []
        for more in (log[:0], added, others):
            rows = np.concatenate([log, more])
            chosen = choose_geometry(robot.chain, robot.q[rows], robot.x[rows])
            chain = chosen.calibrate(robot.q[rows], robot.x[rows]).chain
            miss = error(chain, robot.q[beyond], robot.x[beyond])
            cells.append(f"{miss:.2f} ({chosen.name})")
        print(f"| {seed} | {' | '.join(cells)} |  {motion}", flush=True)


def error(chain: Chain, q: NDArray, x: NDArray) -> float:
    """Return the mean tip error of a calibrated chain [mm]."""
    miss = chain(torch.from_numpy(q)).numpy() - x
    return 1e3 * float(np.linalg.norm(miss, axis=1).mean())


if __name__ == "__main__":
    main()
