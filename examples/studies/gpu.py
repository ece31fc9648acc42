"""Models on a GPU: first whether they agree with the CPU, then how fast they are, and the memory.

    python examples/studies/gpu.py --out results/gpu       # at most four minutes on one GPU
    python examples/studies/gpu.py --device cpu --quick    # the CPU against copies on the CPU

Needs torch, NumPy, SciPy, scikit-learn, safetensors, and hybridkin's folder on PYTHONPATH; no
installation, network, compiled core or plots. It writes `gpu.md` and `gpu.csv`, and says what it
left out. Exit code 1 if a comparison fails or a part raises; the other parts run all the same.

Tolerances, relative to the largest number compared. Models, their derivatives and fits are smooth
functions of float64 numbers, to 1e-10. A step solves normal equations damped by no less than 1e-6
of sigma_max^2, which multiplies rounding by up to 1e6: the motion J dq of 99 % of the rows agrees
to 2e-8, because tendons that get slack within a step are a choice that rounding may decide. Where
`solve` ends depends on such choices: it must state the error that the CPU's model has at its q,
stay within the limits, and reach as many targets to within 2 %.
"""

from __future__ import annotations

import argparse
import copy
import gc
import os
import pickle
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import torch
from gpu_models import KINDS, Kind, arm, arm_urdf, hybrid, log, network, segment, trunk
from gpu_report import COMPILED, CORE, Result, Study, write, written
from torch import Tensor

from hybridkin import (
    Commands,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    InverseKinematics,
    load_model,
    native,
    save_model,
)
from hybridkin._core import blocks
from hybridkin.chains.chain import Chain

SMOOTH = 1e-10
STEP = 2e-8
STEPS_COMPARED = 0.99  # part of the rows
FEWER_REACHED = 0.02  # part of the rows
TIE = 1e-8  # domain distances this close to 1 are decided by rounding
TOL = 1e-4  # of `solve` [m]
DTYPES = (torch.float64, torch.float32)


def moved(model: Any, device: torch.device | str) -> Any:
    """Return a copy of a module, or of a fitted estimator, on a device."""
    twin = copy.deepcopy(model)
    module = twin if isinstance(twin, torch.nn.Module) else twin.module_
    module.to(device)
    return twin


def wait(device: torch.device) -> None:
    """Wait until a device has done its work."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


# Correctness.


def apart(expected: Any, found: Any) -> float:
    """Return the largest difference relative to the largest number; infinite for other NaN."""
    a, b = (torch.as_tensor(part).detach().cpu().double() for part in (expected, found))
    if a.shape != b.shape or not torch.equal(a.isfinite(), b.isfinite()):
        return float("inf")
    finite = a.isfinite()
    if not finite.any():
        return 0.0
    size = a[finite].abs().max().clamp_min(torch.finfo(torch.float64).tiny)
    return float((a - b)[finite].abs().max() / size)


def outputs(module: Any, q: Tensor) -> dict[str, Tensor]:
    """Return what a module computes of rows q (N, n), by name, with gradients."""
    x, J = module.forward_and_jacobian(q)
    found = {"x": x, "J": J, "domain distance": module.domain_distance(q)}
    leaf = q.clone().requires_grad_()
    (found["gradient"],) = torch.autograd.grad(module(leaf).square().sum(), leaf)
    if module.has_pose:
        found["pose"], found["pose Jacobian"] = module.pose_and_jacobian(q)
    if isinstance(module, Chain):
        found["backbone"] = module.backbone(q)
        found["frames"] = module.poses(q)
    return found


def predictions(model: Any, q: np.ndarray) -> dict[str, Any]:
    """Return what an estimator predicts of NumPy rows, by name."""
    rows: Any = q
    if getattr(model, "hysteresis_", None):
        rows = Commands(q, time=np.arange(float(len(q))))
    x, J = model.predict_and_jacobian(rows)
    found = {"predicted x": x, "predicted J": J}
    if getattr(model, "radius_", None) is not None:
        found["radius"] = model.predict(rows, return_radius=True)[1]
    return found


def compare_model(study: Study, name: str, kind: Kind, n: int) -> None:
    """Compare what a model computes, and twins by pickle and by file, on both devices."""
    q = kind.rows(n, part=1.2)  # some rows are outside of the training rows
    there = q.to(study.device)
    expected = outputs(kind.module, q)
    twin = moved(kind.model, study.device)
    of_twin = Kind(twin, kind.low, kind.high)
    found = outputs(of_twin.module, there)
    for what, numbers in expected.items():
        study.compare(name, what, apart(numbers, found[what]), SMOOTH, n)
    # A module computes where its rows are, wherever it is itself.
    crossed = {
        "rows there, module on the CPU": outputs(kind.module, there),
        "rows on the CPU, module there": outputs(of_twin.module, q),
    }
    for what, found in crossed.items():
        difference = max(apart(expected[key], found[key]) for key in expected)
        study.compare(name, what, difference, SMOOTH, n)
    distance = expected["domain distance"]
    decided = (distance - 1.0).abs() > TIE
    inside = of_twin.module.in_domain(there).cpu()
    wrong = (inside != kind.module.in_domain(q)) & decided
    study.compare(name, "rows in the domain of one alone", float(wrong.sum()), 0.0, n)
    if hasattr(kind.model, "predict_and_jacobian"):
        by_twin = predictions(twin, q.numpy())
        for what, numbers in predictions(kind.model, q.numpy()).items():
            study.compare(name, what, apart(numbers, by_twin[what]), SMOOTH, n)
    if getattr(kind.model, "hysteresis_", None):
        times = np.ones(n)
        ends = (
            kind.model.hysteresis_.apply(q, dt=times),
            twin.hysteresis_.apply(there, dt=times),
        )
        for what, end, of_end in zip(("effective q", "state"), *ends, strict=True):
            study.compare(name, what, apart(end, of_end), SMOOTH, n)
    # A file does not depend on the device of the model that was saved.
    pickled = pickle.loads(pickle.dumps(twin))
    twins = {"pickled": (moved(pickled, "cpu"), q)}
    if kind.is_saved:
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.safetensors"
            save_model(twin, path)
            twins["saved there, loaded on the CPU"] = load_model(path), q
            save_model(kind.model, path)
            loaded = load_model(path, device=study.device)
            twins["saved on the CPU, loaded there"] = loaded, there
    for what, (model, rows) in twins.items():
        x, J = Kind(model, kind.low, kind.high).module.forward_and_jacobian(rows)
        difference = max(apart(expected["x"], x), apart(expected["J"], J))
        study.compare(name, what, difference, SMOOTH, n)


def compare_inverse(study: Study, name: str, kind: Kind, n: int) -> None:
    """Compare steps and solutions, by their effect."""
    twin = moved(kind.module, study.device)
    box = {"q_min": kind.low, "q_max": kind.high}
    ours = InverseKinematics(kind.task(kind.module), **box)
    theirs = InverseKinematics(kind.task(twin), **box)
    task = ours.settings.task
    low, high = torch.from_numpy(kind.low), torch.from_numpy(kind.high)

    def outside(q: Tensor) -> float:
        return float(torch.maximum(low - q, q - high).max())

    with torch.no_grad():
        q = kind.rows(n, 1, 0.9)
        x, J = task.evaluate(q)
        near = q + 0.1 * (kind.rows(n, 2, 0.9) - q)
        target = task.evaluate(near)[0]
        dq = ours.step(q, target).dq
        there = theirs.step(q.to(study.device), target.to(study.device)).dq.cpu()
        motion = torch.linalg.vector_norm((J @ dq[..., None])[..., 0], dim=-1)
        between = (J @ (there - dq)[..., None])[..., 0]
        ways = torch.linalg.vector_norm(between, dim=-1) / motion.max()
        compared = float(ways.quantile(STEPS_COMPARED, interpolation="lower"))
        study.compare(name, "step: J dq", compared, STEP, n)
        study.compare(name, "step: outside the limits", outside(q + there), 0.0, n)

        target = task.evaluate(kind.rows(n, 3, 0.8))[0]
        restarts = 0 if study.quick else 16
        options = {"tol": TOL, "restarts": restarts}
        solution = ours.solve(target, **options)
        there = theirs.solve(target.to(study.device), **options)
        q = there.q.cpu()
        x, _ = task.evaluate(q)
        error = task.difference(x, target).norm(dim=-1)
        size = float(task.positions(x).abs().max())
        stated = float((error - there.error.cpu()).abs().max()) / size
        study.compare(name, "solve: stated error", stated, SMOOTH, n)
        study.compare(name, "solve: outside the limits", outside(q), 0.0, n)
        reached = float((solution.error <= TOL).double().mean())
        reached_there = float((error <= TOL * (1.0 + 1e-6)).double().mean())
        fewer = reached - reached_there
        study.compare(name, "solve: targets missed", fewer, FEWER_REACHED, n)


def compare_track(study: Study, name: str, kind: Kind, n: int) -> None:
    """Compare the track of a path, with hysteresis if the model has it."""
    box = {"q_min": kind.low, "q_max": kind.high, "dq_max": 0.5, "ddq_max": 20.0}
    q = kind.rows(2, part=0.5)
    fractions = torch.linspace(0.0, 1.0, n, dtype=q.dtype)[:, None]
    points = torch.lerp(*kind.module(q), fractions)
    tracks = []
    for device in (torch.device("cpu"), study.device):
        ik = InverseKinematics(moved(kind.model, device), **box)
        tracks.append(ik.track(points.to(device), q0=q[0].to(device)))
    for what in ("x", "q"):
        ends = [getattr(track, what) for track in tracks]
        study.compare(name, f"track: {what}", apart(*ends), STEP, n)


def compare_gradient(study: Study, name: str, kind: Kind, n: int) -> None:
    """Compare gradients through solutions."""
    q = kind.rows(n, part=0.5)
    target = kind.module(q).detach()
    box = {"q_min": kind.low, "q_max": kind.high}
    slopes = []
    for device in (torch.device("cpu"), study.device):
        ik = InverseKinematics(moved(kind.module, device), **box)
        leaf = target.to(device).requires_grad_()
        options = {"tol": 1e-8, "differentiable": True}
        solved = ik.solve(leaf, q[:1].to(device), **options)
        slopes += torch.autograd.grad(solved.q.square().sum(), leaf)
    # The solutions differ by up to `tol`, 1e-7 of the robot; curvature enlarges it.
    study.compare(name, "gradient through solve", apart(*slopes), 1e-5, n)


def compare_fits(study: Study) -> None:
    """Compare networks and hybrids that are fitted on both devices."""
    rng = np.random.default_rng(0)
    X = rng.uniform(0.15, 0.35, (500, 9))
    y = np.sin(10.0 * X[:, :3] + X[:, 3:6])
    weights = rng.uniform(0.5, 2.0, len(X))

    def both(name: str, fit: Callable[[Any], Any], *names: str, rows: Any = X[:100]) -> None:
        with study.attempt(name):
            models = fit(None), fit(str(study.device))
            for what in names:
                expected, found = (getattr(model, what)(rows) for model in models)
                study.compare(name, what, apart(expected, found), SMOOTH, len(X))

    def streamed(device: Any) -> Any:
        elm = ELMRegressor(60, input_scaling=[[0.15] * 9, [0.35] * 9], random_state=0)
        elm.set_params(device=device).partial_fit(X[:200], y[:200])
        other = copy.deepcopy(elm).fit(X[300:], y[300:])
        return elm.partial_fit(X[200:300], y[200:300], decay=0.9).merge(other)

    def chosen(device: Any) -> Any:
        # Large penalties, because the choice of smaller ones hangs on rounding.
        elm = ELMRegressorCV(12, cv=3, alphas=[0.01, 0.1, 1.0], max_hidden=12)
        elm.set_params(relevance_rounds=0, random_state=0, device=device)
        return elm.fit(X[:100], y[:100])

    def of_hybrid(device: Any, **settings: Any) -> Any:
        return hybrid(network(device=device), moved(segment(), device or "cpu"), **settings)

    def refitted(device: Any) -> Any:
        model = of_hybrid(None)
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "model.safetensors"
            save_model(model, path)
            model = load_model(path, device=device)
        q, x, _ = log()
        model.partial_fit(q[:5], x[:5] + 0.01)
        return model.adapt(q[:20], x[:20] + np.array([0.0, 0.01, 0.0]))

    elm = partial(ELMRegressor, 60, random_state=0)
    of_elm = ("predict", "jacobian", "leverage")
    q = log()[0]
    both("fit of a network", lambda d: elm(device=d).fit(X, y, weights), *of_elm)
    both("fit by blocks, and merged", streamed, *of_elm)
    with study.attempt("fit by cross-validation"):
        scores = [chosen(device).best_score_ for device in (None, str(study.device))]
        study.compare("fit by cross-validation", "score", apart(*scores), SMOOTH, 100)
    of_model = ("predict", "jacobian")
    both("fit of a hybrid", of_hybrid, *of_model, rows=q)
    serial = partial(of_hybrid, coupling="serial")
    both("fit of a serial hybrid", serial, *of_model, rows=q)
    both(
        "fit after calibration",
        partial(of_hybrid, calibrate=("radii",)),
        *of_model,
        rows=q,
    )
    both("loaded, then fitted further", refitted, *of_model, rows=q)


def correctness(study: Study, part: float) -> None:
    """Compare all kinds of models with their copies on the device."""
    kinds = {}
    for name, build in KINDS.items():
        if not study.has_time(name, 0.5 * part):
            continue
        with study.attempt(name):
            kinds[name] = build()
            compare_model(study, name, kinds[name], 20 if study.quick else 200)
    study.say(f"{len(kinds)} kinds of models compared")
    with study.attempt("fits"):
        compare_fits(study)
    study.say("fits compared")
    n = 5 if study.quick else 50
    for name in ("extensible segments", "backlash", "backlash and creep"):
        if name in kinds:
            with study.attempt(f"{name}: track"):
                compare_track(study, name, kinds[name], n)
    for name in ("extensible segments", "hybrid, network"):
        if name in kinds:
            with study.attempt(f"{name}: gradient through solve"):
                compare_gradient(study, name, kinds[name], n)
    solved = [*kinds.items()]
    if study.quick:
        solved = solved[::2]
        study.leave_out("steps and solutions of every other kind: --quick")
    for name, kind in solved:
        inverse = f"{name}: step and solve"
        if not kind.module.n_outputs % 3 and study.has_time(inverse, part):
            with study.attempt(inverse):
                compare_inverse(study, name, kind, 4 if study.quick else 200)
    study.say("steps and solutions compared")


# Speed and memory.


class Place(NamedTuple):
    """Where a job runs: the device, the CPU by torch, or by NumPy arrays and the compiled core."""

    name: str
    device: torch.device
    dtype: torch.dtype
    in_numpy: bool = False

    def rows(self, n: int, low: float, high: float, size: int) -> Tensor:
        """Return random rows (n, size)."""
        # In float32, so that both precisions have the same rows.
        q = np.random.default_rng(0).uniform(low, high, (n, size)).astype(np.float32)
        return torch.from_numpy(q).to(self.device, self.dtype)


Work = Callable[[], object]


class Job(NamedTuple):
    """Work of many rows; `make` returns it for a place and a number of rows."""

    name: str
    what: str
    make: Callable[[Place, int], Work]
    everywhere: bool = True  # else on the device by torch alone


def jacobian_job(model: Any, place: Place, n: int) -> Work:
    """Return the work of tips and Jacobians."""
    q = place.rows(n, 0.2, 0.3, 9)
    if place.in_numpy:
        return partial(native.evaluate, model, q.numpy(), jacobian=True)
    twin = moved(model, place.device).to(place.dtype)
    return partial(twin.forward_and_jacobian, q)


def solve_job(model: Any, place: Place, n: int) -> Work:
    """Return the work of solutions of targets in reach."""
    twin = moved(model, place.device).to(place.dtype)
    with torch.no_grad():
        target: Any = twin(place.rows(n, 0.2, 0.3, 9))
    if place.in_numpy:
        target = target.numpy()
    return partial(InverseKinematics(twin, q_min=0.1, q_max=0.4).solve, target)


def pose_job(place: Place, n: int) -> Work:
    """Return the work of poses of the arm and their Jacobians."""
    twin = arm().to(place.device, place.dtype)
    return partial(twin.pose_and_jacobian, place.rows(n, -2.0, 2.0, 7))


def peer_job(place: Place, n: int) -> Work:
    """Return the work of pytorch_kinematics for Jacobians of the same arm."""
    from pytorch_kinematics import build_serial_chain_from_urdf

    chain = build_serial_chain_from_urdf(arm_urdf(), "tip")
    chain = chain.to(device=place.device, dtype=place.dtype)
    q = place.rows(n, -2.0, 2.0, 7)
    ours = arm().to(place.device, place.dtype).pose_jacobian(q[:20])
    difference = apart(chain.jacobian(q[:20]), ours)
    if not difference < 1e-4:
        raise ValueError(f"its Jacobian differs from ours by {difference:.3g}")
    return partial(chain.jacobian, q)


def jobs() -> list[Job]:
    """Return what is timed."""
    network_hybrid = trunk_hybrid().module_
    both = "FK and J"
    listed = [
        Job("trunk, 9 chambers", both, partial(jacobian_job, trunk())),
        Job("trunk, hybrid of 100 units", both, partial(jacobian_job, network_hybrid)),
        Job("arm, 7 joints", "pose and J", pose_job, everywhere=False),
        Job("trunk, 9 chambers", "solve", partial(solve_job, trunk())),
        Job("trunk, hybrid of 100 units", "solve", partial(solve_job, network_hybrid)),
    ]
    if find_spec("pytorch_kinematics") is not None:
        name = "arm, 7 joints, pytorch_kinematics"
        listed.insert(3, Job(name, "J", peer_job, everywhere=False))
    return listed


def trunk_hybrid() -> Any:
    """Return a hybrid of the trunk with a network of 100 units and its guard."""
    q = np.random.default_rng(0).uniform(0.15, 0.35, (1000, 9))
    x = trunk()(torch.from_numpy(q)).numpy() + 0.01 * np.sin(20 * q[:, :3])
    return HybridForwardModel(trunk(), ELMRegressor(random_state=0)).fit(q, x)


def time_of(job: Work, device: torch.device, seconds: float) -> float:
    """Return the median time of a run [s], of up to seven in about these seconds.

    A first run, which may build things, is left out.
    """

    def run() -> float:
        wait(device)
        start = time.perf_counter()
        job()
        wait(device)
        return time.perf_counter() - start

    run()
    times = [run()]
    while len(times) < 7 and sum(times) < seconds:
        times.append(run())
    return float(np.median(times))


def places(study: Study) -> list[Place]:
    """Return where jobs run."""
    listed = [Place(str(study.device), study.device, dtype) for dtype in DTYPES]
    cpu = torch.device("cpu")
    if study.device != cpu:
        listed += [Place("cpu", cpu, dtype) for dtype in DTYPES]
    if native.available():
        listed.append(Place(CORE, cpu, torch.float64, in_numpy=True))
    return listed


class Seen(NamedTuple):
    """The last measurement of a job."""

    n: int
    seconds: float
    bytes_per_row: float


def speed(study: Study, part: float) -> None:
    """Time all jobs at growing numbers of rows, on the device and on the CPU."""
    if find_spec("pytorch_kinematics") is None:
        study.leave_out("pytorch_kinematics on the same device: it is not installed")
    if study.device.type != "cuda":
        study.leave_out("memory: measured on CUDA alone")
    listed: list[Job] = []
    with study.attempt("models that are timed"):
        listed = jobs()
    seen: dict[Any, Seen] = {}
    for power in [2] if study.quick else range(3, 8):
        if not study.has_time(f"speed at {10**power} rows", part):
            continue
        for job in listed:
            for place in places(study):
                if job.everywhere or place.name == str(study.device):
                    measure(study, job, place, 10**power, part, seen)
        study.say(f"speed at {10**power} rows")


def measure(
    study: Study,
    job: Job,
    place: Place,
    n: int,
    part: float,
    seen: dict[Any, Seen],
) -> None:
    """Time a job, unless its last number of rows says that it takes too long or too much."""
    device = place.device
    dtype = str(place.dtype).removeprefix("torch.")
    what = f"{job.name}, {job.what} of {n} rows, {dtype} on {place.name}"
    last = seen.get((job.name, job.what, place), Seen(n, 0.0, 0.0))
    if last.n < n // 10:
        return  # said at fewer rows
    # A job runs three times or more, and may take a tenth of the time that is left.
    seconds = 3.0 * last.seconds * n / last.n
    if seconds > 0.1 * (part * study.seconds - study.elapsed):
        study.leave_out(f"{what}: about {seconds:.3g} s")
        return
    # What it takes on the device it takes on the CPU too.
    there = seen.get((job.name, job.what, Place(str(study.device), study.device, place.dtype)))
    bytes_per_row = there.bytes_per_row if there else 0.0
    if 1.2 * bytes_per_row * n > free_memory(device):
        study.leave_out(f"{what}: about {bytes_per_row * n / 1e9:.3g} GB")
        return
    with study.attempt(what), torch.no_grad():
        run = job.make(place, n)
        bytes_per_row = peak_memory(run, device) / n
        seconds = time_of(run, device, 0.01 if study.quick else 1.0)
        seen[job.name, job.what, place] = Seen(n, seconds, bytes_per_row)
        row = (job.name, job.what, place.name, dtype, n)
        study.results.append(Result("speed", *row, 1e6 * seconds / n, "us per row"))
        if bytes_per_row > 0.0:
            memory = Result("memory", *row, bytes_per_row, "bytes per row")
            study.results.append(memory)


def peak_memory(run: Work, device: torch.device) -> float:
    """Return the peak memory of a run [bytes], with its results; 0 where it is not measured."""
    if device.type != "cuda":
        return 0.0
    gc.collect()
    torch.cuda.reset_peak_memory_stats(device)
    before = torch.cuda.memory_allocated(device)
    run()
    wait(device)
    return float(torch.cuda.max_memory_allocated(device) - before)


def free_memory(device: torch.device) -> float:
    """Return the free memory of a device [bytes]; infinite if it is not known."""
    if device.type == "cuda":
        return float(torch.cuda.mem_get_info(device)[0])
    try:
        return 0.8 * os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return float("inf")


def fits_of_many_rows(study: Study) -> None:
    """Time the fit of a network to many rows, streamed in blocks."""
    rng = np.random.default_rng(0)
    block = 10_000 if study.quick else 1_000_000
    X = rng.uniform(0.15, 0.35, (block, 9))
    y = np.sin(10.0 * X[:, :3])
    bounds = [[0.15] * 9, [0.35] * 9]
    devices = dict.fromkeys((study.device, torch.device("cpu")))
    for device in devices:
        per_row = 0.0
        for n in [block] if study.quick else [block // 10, block, 10 * block]:
            what = f"fit of a network to {n} rows on {device}"
            if not study.has_time(what, 1.0, per_row * n):
                continue
            with study.attempt(what):
                elm = ELMRegressor(input_scaling=bounds, device=str(device), random_state=0)
                elm.partial_fit(X[:1000], y[:1000])

                def fit(elm: Any = elm, n: int = n) -> None:
                    for _ in range(-(-n // block)):
                        elm.partial_fit(X[:n], y[:n])

                row = ("network of 100 units", "fit by blocks", str(device), "float64")
                wait(device)
                start = time.perf_counter()
                peak = peak_memory(fit, device)
                if not peak:
                    fit()
                per_row = (time.perf_counter() - start) / n
                result = Result("speed", *row, n, 1e6 * per_row, "us per row")
                study.results.append(result)
                if peak:
                    memory = Result("memory", *row, n, peak / n, "bytes per row")
                    study.results.append(memory)
    study.say("fits of many rows timed")


def compiled_graphs(study: Study) -> None:
    """Time tips and Jacobians as graphs compiled by torch, for any number of rows."""
    what = "graphs compiled by torch"
    if study.quick:
        study.leave_out(f"{what}: --quick")
        return
    for dtype in DTYPES:
        name = str(dtype).removeprefix("torch.")
        if not study.has_time(f"{what}, {name}", 1.0, 40.0):
            continue
        place = Place(str(study.device), study.device, dtype)
        with study.attempt(f"{what}, {name}"), torch.no_grad():
            twin = moved(trunk(), place.device).to(dtype)
            work = torch.compile(twin.forward_and_jacobian, fullgraph=True, dynamic=True)
            for n in (100_000, 1_000_000):
                seconds = time_of(partial(work, place.rows(n, 0.2, 0.3, 9)), place.device, 1.0)
                row = ("trunk, 9 chambers", COMPILED, place.name, name, n)
                study.results.append(Result("speed", *row, 1e6 * seconds / n, "us per row"))
    study.say(f"{what} timed")


def sizes_of_blocks(study: Study) -> None:
    """Time tips and Jacobians in blocks of other sizes: small blocks leave a GPU idle."""
    if study.device.type != "cuda":
        study.leave_out("sizes of blocks: of a GPU alone")
        return
    place = Place(str(study.device), study.device, torch.float64)
    models = {"trunk, 9 chambers": trunk(), "trunk, hybrid of 100 units": trunk_hybrid().module_}
    n = 1_000_000
    for times in (8, 32, 128, 512):
        what = f"FK and J, blocks of a CPU times {times}"
        for name, model in models.items():
            if not study.has_time(f"{name}, {what}", 1.0):
                continue
            with study.attempt(what), torch.no_grad(), mock.patch.object(blocks, "_ON_GPU", times):
                run = jacobian_job(model, place, n)
                row = (name, what, place.name, "float64", n)
                memory = peak_memory(run, place.device) / n
                seconds = time_of(run, place.device, 0.3)
                study.results.append(Result("speed", *row, 1e6 * seconds / n, "us per row"))
                study.results.append(Result("memory", *row, memory, "bytes per row"))
    study.say("sizes of blocks timed")


def main(arguments: Sequence[str] | None = None) -> int:
    """Compare, measure, and write the report; return the exit code."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--device", default="cuda", help="default: cuda")
    parser.add_argument("--out", default="results/gpu", help="folder of the report")
    parser.add_argument("--minutes", type=float, default=3.5, help="time after the imports (3.5)")
    parser.add_argument("--quick", action="store_true", help="few rows")
    given = parser.parse_args(arguments)
    device = torch.device(given.device)
    if device.type == "cuda" and not torch.cuda.is_available():
        parser.error(
            f"torch {torch.__version__} finds no CUDA device; install a torch build for CUDA on a "
            "machine with a GPU, or compare the CPU with itself by --device cpu --quick"
        )
    study = Study(device, given.minutes, given.quick)
    for line in study.machine:
        study.say(line)
    if not native.available():
        study.leave_out(f"the compiled core on the CPU: {native.backend(trunk())}")
    parts: dict[str, Callable[[], None]] = {
        "correctness": partial(correctness, study, 0.5),
        "speed": partial(speed, study, 0.85),
        "sizes of blocks": partial(sizes_of_blocks, study),
        "fits of many rows": partial(fits_of_many_rows, study),
        "compiled graphs": partial(compiled_graphs, study),
    }
    for name, run in parts.items():
        with study.attempt(name):
            run()
        write(study, Path(given.out))  # after each part, should the next one be killed
    print(written(study))
    study.say(f"{len(study.failed)} failed; {given.out}/gpu.md and gpu.csv are written")
    return int(bool(study.failed))


if __name__ == "__main__":
    sys.exit(main())
