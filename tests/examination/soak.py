"""Months of work in minutes: a tracker that runs on, and models that learn row by row.

Robots are commanded tick by tick in processes of their own, see `_tracker_soak`, in the compiled
core and in torch; seed 0. Speeds and accelerations are compared with their limits in units of the
last place of q: the command itself is rounded to it. Time is CPU time; its change is measured
against a fixed piece of work.
"""

from __future__ import annotations

import copy
import gc
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from _line import Line
from _pace import Pace
from saved_models import trunk
from tqdm import tqdm

from hybridkin import ELMRegressor, HybridForwardModel
from hybridkin.native import available

HERE = Path(__file__).parent
COMPILED = ("plain chain", "elastic chain", "hybrid", "rigid arm", "weighed, braked")
IN_TORCH = (*COMPILED, "within a box")
MEGABYTES, OBJECTS = 4.0, 300  # allowed from first to last tenth
MOVED = 0.5  # least share of the ticks in which q changes: to stand still keeps every limit
BEYOND = 3e-3  # [m], of a tip within half-spaces, which hold to first order; steps are 3 mm


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    if available():
        yield from _tracked(COMPILED, 1_000_000 if full else 20_000)
    else:
        yield Line("robots in the compiled core", "the compiled core is missing here", None)
    if full:
        yield from _tracked(IN_TORCH, 5_000, HYBRIDKIN_NATIVE="off")
    else:
        yield from _tracked(IN_TORCH[-1:], 1_000, HYBRIDKIN_NATIVE="off")
    calls = 100_000 if full else 3_000
    for decay in (1.0, 0.98):
        yield from _elm_learns(calls, decay)
        yield from _hybrid_learns(calls, decay)


def _run(ticks: int, names: Sequence[str], **environment: str) -> list[dict]:
    paths = os.pathsep.join([*sys.path[:2], str(HERE.parents[1])])
    command = [sys.executable, str(HERE / "_tracker_soak.py"), str(ticks), *names]
    environment = {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **environment}
    return json.loads(subprocess.check_output(command, env=environment))


def _tracked(names: Sequence[str], ticks: int, **environment: str) -> Iterator[Line]:
    runs = _run(ticks, names, **environment)
    twins = _run(ticks // 5, names, **environment)
    for robot, found, again in zip(names, runs, twins, strict=True):
        name, n = f"{robot}, {found['backend']}", found["ticks"]
        broken = found["not_finite"] + found["position"]
        far = max(found["speed"], found["acceleration"])
        figure = f"{n:,} ticks: {found['not_finite']} commands not finite, {found['position']} "
        figure += f"beyond q_min or q_max; speed and acceleration beyond by {far:.2g} ulp of q"
        good = not broken and far <= 1.0 and found["tip"] <= BEYOND
        good = good and n == ticks and found["moved"] >= MOVED * n
        if "within" in found:
            figure += f"; tip beyond its half-spaces by {1e3 * found['tip']:.2g} mm"
            good = good and found["within"] > 0
        yield Line(f"{name}: limits", figure, good)
        minima, elsewhere = found["minima"], found["elsewhere"]
        figure = f"{found['targets']} static targets: {elsewhere} missed, {minima} more at a local "
        yield Line(f"{name}: arrival", f"{figure}minimum of the error", elsewhere == 0)
        figure = f"{found['us']:.3g} us a tick, last tenth / first {found['slower']:.2f}; "
        figure += f"{found['mb']:+.1f} MB, {found['objects']:+.0f} objects after the first tenth"
        flat = found["mb"] < MEGABYTES and found["objects"] < OBJECTS
        yield Line(f"{name}: time and memory", figure, flat and found["steady"])
        blocks = len(again["digests"])
        same = blocks > 0 and again["digests"] == found["digests"][:blocks]
        figure = "the same bits" if same else "other bits"
        yield Line(f"{name}: {again['ticks']:,} ticks again", figure, same)


def _rows(calls: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a walk of q that stands still for a fifth of the time, and what its residual is."""
    rng = np.random.default_rng(1)
    q = 0.25 + 0.05 * np.sin(0.01 * np.cumsum(rng.uniform(0.0, 2.0, (calls, 3)), axis=0))
    q[int(0.4 * calls) : int(0.6 * calls)] = q[int(0.4 * calls)]
    return q, 0.01 * np.sin(20.0 * q) + 1e-3 * rng.standard_normal(q.shape)


def _stream(what: str, learn: Any, calls: int) -> tuple[str, bool]:
    """Return figure and outcome of calls of ``learn(i)``, a hundred at a time."""
    pace, memory = Pace(), []
    for start in tqdm(range(0, calls, 100), desc=what, mininterval=20.0, file=sys.stderr):
        begin = time.process_time()
        for i in range(start, start + 100):
            learn(i)
        pace.add(time.process_time() - begin)
        if start % max(100, calls // 3000 * 100) == 0:
            gc.collect()
            memory.append(psutil.Process().memory_info().rss / 2**20)
    few = max(1, len(memory) // 10)
    mb = np.median(memory[-few:]) - np.median(memory[few : 2 * few])
    figure = f"{calls:,} calls of {1e4 * np.median(pace.seconds):.3g} us, last tenth / first "
    figure += f"{pace.slowdown():.2f}"
    return f"{figure}; {mb:+.1f} MB", bool(pace.is_steady() and mb < MEGABYTES)


def _elm_learns(calls: int, decay: float) -> Iterator[Line]:
    q, y = _rows(calls)
    settings = {"input_scaling": [[0.2] * 3, [0.3] * 3], "fit_intercept": True, "random_state": 0}
    elm, name = ELMRegressor(20, 1e-3, **settings), f"ELMRegressor.partial_fit, decay {decay}"
    figure, flat = _stream(
        name, lambda i: elm.partial_fit(q[i : i + 1], y[i : i + 1], decay=decay), calls
    )
    weights = decay ** np.arange(calls)[::-1].astype(float)
    kept = weights > 1e-30
    whole = ELMRegressor(20, 1e-3, **settings).fit(q[kept], y[kept], weights[kept])
    yield Line(name, figure, flat)
    yield _agrees(name, elm.predict(q), whole.predict(q), 1e-8)


def _hybrid_learns(calls: int, decay: float) -> Iterator[Line]:
    q, y = _rows(calls)
    x = HybridForwardModel(trunk(), "drop").fit(q[:30], y[:30]).predict(q) + y
    error_model = ELMRegressor(10, random_state=0)
    model = HybridForwardModel(trunk(), error_model, random_state=0).fit(q[:500], x[:500])
    x[:, 0] += 0.01 * np.linspace(0.0, 1.0, calls)  # the robot changes
    at_once, name = copy.deepcopy(model), f"HybridForwardModel.partial_fit, decay {decay}"
    figure, flat = _stream(
        name, lambda i: model.partial_fit(q[i : i + 1], x[i : i + 1], decay=decay, alpha=0.1), calls
    )
    fitted = at_once.predict(q)
    at_once.partial_fit(q, x, decay=decay, alpha=0.1)
    moved = float(abs(model.predict(q) - fitted).max())
    yield Line(name, f"{figure}; {1e3 * moved:.2g} mm learned", flat and moved > 1e-3)
    yield _agrees(name, model.predict(q), at_once.predict(q), 1e-8)


def _agrees(name: str, streamed: np.ndarray, whole: np.ndarray, tolerance: float) -> Line:
    apart = float(abs(streamed - whole).max() / abs(whole).max())
    good = np.isfinite(streamed).all() and apart < tolerance
    what = f"{name}: against all rows at once"
    return Line(what, f"{apart:.1e} of the largest, required {tolerance:g}", bool(good))
