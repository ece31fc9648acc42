"""How fast a model is on this machine: forward kinematics, Jacobians, a step, a tick."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch

from hybridkin._core.model import forward_and_jacobian
from hybridkin.ik.solver import InverseKinematics
from hybridkin.workflow._domain import path_limits, preferred
from hybridkin.workflow.model import OpenedModel
from hybridkin.workflow.report import Progress, quiet, versions

_SECONDS = 0.3  # of every measurement, at least


def measure_speed(
    opened: OpenedModel,
    *,
    batches: Sequence[int] = (1, 100, 10_000, 100_000),
    seconds: float = _SECONDS,
    progress: Progress = quiet,
) -> dict[str, Any]:
    """Return how long a model takes on this machine.

    Parameters
    ----------
    opened : OpenedModel
        The model, as from `open_model`.
    batches : sequence of int, default=(1, 100, 10000, 100000)
        Rows at once.
    seconds : float, default=0.3
        How long every entry is measured, at least once.
    progress : callable, optional
        Handed (what, done, total).

    Returns
    -------
    dict
        "entries": each with "what", "rows" and "seconds_per_row", the median of all runs;
        "versions", "threads", "processor" and "model".
    """
    if not batches or min(batches) < 1:
        raise ValueError(f"`batches` must be numbers of rows, at least 1, got {list(batches)}.")
    rng = np.random.default_rng(0)
    limits = path_limits(opened)
    low, high, middle = limits["q_min"], limits["q_max"], preferred(opened, limits)
    ik = InverseKinematics(opened.module, q_min=low, q_max=high, q_pref=middle, dt=0.01)
    q = middle + 0.2 * (rng.uniform(low, high) - middle)
    with torch.no_grad():
        x = opened.module(torch.from_numpy(middle[None]))[0].numpy()
    tracker = ik.tracker(q)
    jobs: list[tuple[str, int, Callable[[], Any]]] = []
    for n in batches:
        rows = torch.from_numpy(rng.uniform(low, high, (n, len(low))))
        jobs.append(("forward kinematics", n, lambda rows=rows: opened.module(rows)))
        both = partial(forward_and_jacobian, opened.module, rows)
        jobs.append(("forward kinematics and Jacobian", n, both))
    jobs.append(("step of inverse kinematics (torch)", 1, lambda: ik.step(q, x)))
    jobs.append(("tick of the tracker", 1, lambda: tracker.step(x)))
    entries = []
    with torch.no_grad():
        for k, (what, n, job) in enumerate(jobs):
            entries.append({"what": what, "rows": n, "seconds_per_row": _timed(job, seconds) / n})
            progress("measuring", k + 1, len(jobs))
    return {
        "model": opened.name,
        "n_actuators": opened.n_actuators,
        "entries": entries,
        "versions": versions(),
        "threads": torch.get_num_threads(),
        "cores": os.cpu_count(),
        "processor": platform.processor() or platform.machine(),
    }


def _timed(job: Callable[[], Any], seconds: float) -> float:
    """Return the median time of a run [s], the first one, which may build things, left out."""
    job()
    runs, start = [], time.perf_counter()
    while not runs or time.perf_counter() - start < seconds:
        before = time.perf_counter()
        job()
        runs.append(time.perf_counter() - before)
    return float(np.median(runs))
