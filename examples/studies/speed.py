"""How fast a model is on this machine: forward kinematics, Jacobians, a step, a tick.

    python examples/studies/speed.py                       # the hybrid of the simulated trunk
    python examples/studies/speed.py model.safetensors --robot robot.toml --batches 1,1000

Prints one line for each kind of work, in some ten seconds.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch

from hybridkin import HybridForwardModel, InverseKinematics, datasets, robots, workflow


def trunk_model() -> workflow.LoadedModel:
    """Return a hybrid of the trunk's nominal chain and an ELM, fitted to simulated data."""
    data, chain = datasets.load_trunk(), robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, random_state=0).fit(data.q, data.x)
    return workflow.LoadedModel("simulated trunk, hybrid ELM", Path("trunk"), model)


def median_time(job: Callable[[], object], seconds: float) -> float:
    """Return the median time of a run [s]; the first one, which may build things, is left out."""
    job()
    runs, start = [], time.perf_counter()
    while not runs or time.perf_counter() - start < seconds:
        before = time.perf_counter()
        job()
        runs.append(time.perf_counter() - before)
    return float(np.median(runs))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure how fast a model is on this machine.")
    parser.add_argument("model", nargs="?", help="as for `hybridkin describe`")
    parser.add_argument("--robot", help="robot description (TOML)")
    parser.add_argument("--batches", default="1,100,10000,100000", help="rows at once")
    parser.add_argument("--seconds", type=float, default=0.3, help="of every measurement")
    arguments = parser.parse_args()
    loaded = trunk_model()
    if arguments.model is not None:
        loaded = workflow.open_model(arguments.model, arguments.robot)
    limits, rng, module = workflow.path_limits(loaded), np.random.default_rng(0), loaded.module
    low, high = limits.q_min, limits.q_max
    middle = 0.5 * (low + high)
    ik = InverseKinematics(module, q_min=low, q_max=high, q_pref=middle, dt=0.01)
    q = middle + 0.2 * (rng.uniform(low, high) - middle)
    x = loaded.predict(middle[None])[0]
    tracker = ik.tracker(q)
    jobs: list[tuple[str, int, Callable[[], object]]] = []
    for n in map(int, arguments.batches.split(",")):
        rows = torch.from_numpy(rng.uniform(low, high, (n, len(low))))
        jobs.append(("forward kinematics", n, partial(module, rows)))
        both = partial(module.forward_and_jacobian, rows)
        jobs.append(("forward kinematics and Jacobian", n, both))
    jobs.append(("step of inverse kinematics", 1, lambda: ik.step(q, x)))
    jobs.append(("tick of the tracker", 1, lambda: tracker.step(x)))
    print(f"{loaded.name}, torch {torch.__version__}, {torch.get_num_threads()} threads")
    with torch.no_grad():
        for what, n, job in jobs:
            per_row = median_time(job, arguments.seconds) / n
            print(f"  {what:32s} {n:7d} rows at once {1e6 * per_row:10.3g} us per row")


if __name__ == "__main__":
    main()
