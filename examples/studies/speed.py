"""How fast models are on this machine: NumPy calls against the same models in eager torch.

    python examples/studies/speed.py                       # models of a simulated trunk
    python examples/studies/speed.py model.safetensors --robot robot.toml --batches 1,1000

One thread, CPU time, the best of several runs. One line for each kind of work; the last columns are
the same work in eager torch, and how many times faster the NumPy call is. About a minute. The first
line of each model names what computes its NumPy calls.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import (
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    datasets,
    native,
    open_model,
    robots,
)
from hybridkin.app import workflow

_SHORTEST = 0.02  # [s]; shorter jobs are timed many at a time
_TARGETS = 2000


class Case(NamedTuple):
    """A fitted model, with the limits of its actuators."""

    name: str
    model: HybridForwardModel
    low: NDArray
    high: NDArray


def trunk_cases() -> list[Case]:
    """Return models of every kind, fitted to the simulated trunk and to simulated tendons."""
    data, chain = datasets.load_trunk(), robots.bionic_handling_assistant()
    limits = data.q.min(axis=0), data.q.max(axis=0)
    settings = {
        "mechanical": {"error_model": "drop"},
        "ELM, no guard": {"guard": None},
        "ELM, guard": {},
        "serial quadratic": {"error_model": "quadratic", "coupling": "serial"},
        'error_model="auto"': {"error_model": "auto"},
    }
    cases = [
        Case(
            name,
            HybridForwardModel(chain, random_state=0, **given).fit(data.q, data.x),
            *limits,
        )
        for name, given in settings.items()
    ]
    tendons = ElasticTendonChain([0.005] * 3, [0.06] * 3)
    q = np.random.default_rng(0).uniform(-0.004, 0.002, (400, 9))
    x = tendons(torch.from_numpy(q)).numpy()
    drop = HybridForwardModel(tendons, "drop").fit(q, x)
    return [*cases, Case("elastic tendons", drop, q.min(axis=0), q.max(axis=0))]


def best_time(job: Callable[[], object], seconds: float) -> float:
    """Return the least CPU time of a run [s]; the first, which may build things, is left out."""
    job()
    start = time.process_time()
    job()
    laps = max(1, round(_SHORTEST / max(time.process_time() - start, 1e-9)))
    best, until = np.inf, time.perf_counter() + seconds
    while time.perf_counter() < until:
        start = time.process_time()
        for _ in range(laps):
            job()
        best = min(best, (time.process_time() - start) / laps)
    return best


def measure(case: Case, batches: list[int], seconds: float) -> None:
    """Print a table of one model."""
    name, model, low, high = case
    module, rng = model.module_, np.random.default_rng(0)
    middle = 0.5 * (low + high)

    def draw(n: int) -> NDArray:
        return middle + 0.8 * (rng.uniform(low, high, (n, len(low))) - middle)

    ik = InverseKinematics(module, q_min=low, q_max=high, q_pref=middle, dt=0.01)
    jobs: list[tuple[str, int, Callable[[], object], Callable[[], object]]] = []
    for n in batches:
        q = draw(n)
        rows = torch.from_numpy(q)
        for what, ours, eager in (
            ("forward kinematics", model.predict, module),
            ("forward kinematics and Jacobian", model.predict_and_jacobian, None),
            ("domain", model.in_domain, module.in_domain),
        ):
            torch_call = module.forward_and_jacobian if eager is None else eager
            jobs.append((what, n, partial(ours, q), partial(torch_call, rows)))
    q, x = draw(1)[0], model.predict(draw(1))[0]
    tracker, in_torch = ik.tracker(q), ik.tracker(torch.from_numpy(q))
    jobs.append(
        (
            "step of inverse kinematics",
            1,
            partial(ik.step, q, x),
            partial(_step, ik, q, x),
        )
    )
    jobs.append(("tick of the tracker", 1, partial(tracker.step, x), partial(in_torch.step, x)))
    targets = model.predict(draw(_TARGETS))
    solve, tensors = partial(ik.solve, targets), torch.from_numpy(targets)
    jobs.append(("solve", _TARGETS, solve, partial(ik.solve, tensors)))
    print(f"{name}: {native.backend(module)}, ticks {tracker.backend}")
    with torch.no_grad():
        for what, n, ours, eager in jobs:
            numpy_time, torch_time = (best_time(job, seconds) / n for job in (ours, eager))
            ratio = f"{torch_time / numpy_time:8.1f} x"
            print(f"  {what:32s} {n:7d} {1e6 * numpy_time:10.3g} {1e6 * torch_time:10.3g} {ratio}")


def _step(ik: InverseKinematics, q: NDArray, x: NDArray) -> object:
    return ik.step(torch.from_numpy(q), x)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description="Measure how fast models are on this machine.")
    parser.add_argument("model", nargs="?", help="as for `hybridkin describe`")
    parser.add_argument("--robot", help="robot description (TOML)")
    parser.add_argument("--batches", default="1,1000,10000,100000", help="rows at once")
    parser.add_argument("--seconds", type=float, default=0.5, help="of every measurement")
    arguments = parser.parse_args()
    if arguments.model is None:
        cases = trunk_cases()
    else:
        model = open_model(arguments.model, arguments.robot)
        limits = workflow.path_limits(model)
        cases = [Case(Path(arguments.model).name, model, limits.q_min, limits.q_max)]
    torch.set_num_threads(1)
    print(f"torch {torch.__version__}, one thread; us per row: NumPy, eager torch, ratio")
    for case in cases:
        measure(case, [int(n) for n in arguments.batches.split(",")], arguments.seconds)


if __name__ == "__main__":
    main()
