"""The same bits in threads, workers, forks and spawned processes; nothing of the process changes.

A claim that takes longer than its limit ends the part with a traceback: a deadlock is a failure.
Python switches threads every 0.5 ms here, so that overlaps are frequent; seeds 0 to 7.
"""

from __future__ import annotations

import copy
import faulthandler
import hashlib
import multiprocessing
import os
import pickle
import sys
import tempfile
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import dask
import numpy as np
import threadpoolctl
import torch
from _line import Line
from joblib import Parallel, delayed
from saved_models import trunk, trunk_log
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, cross_val_predict

from hybridkin import ELMRegressor, ELMRegressorCV, HybridForwardModel, InverseKinematics, native
from hybridkin._core.turns import one_thread
from paper import make_trunk

LIMIT = 1200.0  # [s] for a claim, on a busy machine
Q, X, GROUPS = trunk_log()


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    model = hybrid(ELMRegressor(20, random_state=0)).fit(Q, X, groups=GROUPS)
    alone = [work(model, k) for k in range(8)]
    interval = sys.getswitchinterval()
    for name, run in (
        ("8 threads", lambda: in_threads(lambda k: work(model, k), 20 if full else 1)),
        ("joblib, threading", lambda: jobs(model, "threading")),
        ("joblib, loky", lambda: jobs(model, "loky")),
        ("dask, threads", lambda: tasks(model, "threads")),
        ("dask, processes", lambda: tasks(model, "processes")),
        ("multiprocessing, fork", lambda: pool(model, "fork")),
        ("multiprocessing, spawn", lambda: pool(model, "spawn")),
        ("os.fork in a thread, others at work", lambda: forked(model)),
    ):
        sys.setswitchinterval(5e-4)
        with limited(), kept() as same:
            found = run()
        sys.setswitchinterval(interval)
        right = sum(one == other for one, other in zip(found, len(found) // 8 * alone, strict=True))
        figure = f"{right} of {len(found)} results have the bits of those computed alone"
        yield Line(f"{name}: one model", figure, right == len(found))
        yield Line(f"{name}: the process", ", ".join(same) or "as before", not same)
    yield from fits(full)
    yield from n_jobs()
    yield from files()


@contextmanager
def limited() -> Iterator[None]:
    """End the process where a block takes too long."""
    faulthandler.dump_traceback_later(LIMIT, exit=True)
    try:
        yield
    finally:
        faulthandler.cancel_dump_traceback_later()


@contextmanager
def kept() -> Iterator[list[str]]:
    """Give a list of what the block has changed, filled at its end."""

    def state() -> dict[str, Any]:
        pools = threadpoolctl.threadpool_info()
        return {
            "filters": [*warnings.filters],
            "threads": (torch.get_num_threads(), [one["num_threads"] for one in pools]),
            "errors of NumPy": np.geterr(),
            "seeds": (pickle.dumps(np.random.get_state()), torch.get_rng_state().numpy().tobytes()),  # noqa: NPY002
            "gradients": (torch.is_grad_enabled(), torch.get_default_dtype()),
        }

    changed: list[str] = []
    before = state()
    yield changed
    after = state()
    changed += [f"{name} changed" for name in before if before[name] != after[name]]


def hybrid(error_model: Any, **settings: Any) -> HybridForwardModel:
    return HybridForwardModel(trunk(), error_model, random_state=0, **settings)


def work(model: HybridForwardModel, k: int) -> str:
    """Return a digest of what a model answers to one of eight users."""
    rng, digest = np.random.default_rng(k), hashlib.sha256()
    q = rng.uniform(0.2, 0.3, (40, 3))
    ik = InverseKinematics(model, q_min=0.15, q_max=0.35, dq_max=0.5)
    tracker = ik.tracker(q[0])
    x = model.predict(q)
    found = [x, *model.predict_and_jacobian(q), model.in_domain(q), ik.solve(x[:5]).q]
    found += [tracker.step(target) for target in x] + [ik.step(q[0], x[1]).dq]
    found.append(model.module_.jacobian(torch.from_numpy(q)).numpy())
    found.append(copy.deepcopy(model).partial_fit(q[:3], x[:3] + 0.01).predict(q))
    found.append(clone(model).fit(Q[k % 4 :], X[k % 4 :], groups=GROUPS[k % 4 :]).predict(q))
    for a in found:
        digest.update(np.ascontiguousarray(a).tobytes())
    return digest.hexdigest()


def in_threads(function: Callable[[int], Any], rounds: int = 1) -> list[Any]:
    """Return what a function gives for 0 to 7, in a thread each, round by round."""
    found: list[Any] = [None] * (8 * rounds)
    barrier = threading.Barrier(8)

    def run(k: int) -> None:
        for i in range(rounds):
            barrier.wait()
            try:
                found[8 * i + k] = function(k)
            except Exception as error:
                found[8 * i + k] = repr(error)

    threads = [threading.Thread(target=run, args=(k,), daemon=True) for k in range(8)]
    [thread.start() for thread in threads]
    [thread.join() for thread in threads]
    return found


def jobs(model: HybridForwardModel, backend: str) -> list[str]:
    return Parallel(2, backend=backend)(delayed(work)(model, k) for k in range(8))  # type: ignore


def tasks(model: HybridForwardModel, scheduler: str) -> list[str]:
    given = [dask.delayed(work)(model, k) for k in range(8)]  # type: ignore
    return [*dask.compute(*given, scheduler=scheduler, num_workers=2)]  # type: ignore


def pool(model: HybridForwardModel, method: str) -> list[str]:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)  # of a fork beside threads
        with multiprocessing.get_context(method).Pool(2) as workers:
            return workers.starmap_async(work, [(model, k) for k in range(8)]).get(LIMIT)


def forked(model: HybridForwardModel) -> list[str]:
    """Fork eight times while other threads fit, after torch has used two threads of OpenMP."""
    threads, stop = torch.get_num_threads(), threading.Event()
    rows = torch.linspace(0.0, 1.0, 100_000, dtype=torch.float64)

    def fit() -> None:
        while not stop.is_set():
            hybrid("kernel").fit(Q, X, groups=GROUPS)

    other, found = threading.Thread(target=fit, daemon=True), []
    torch.set_num_threads(2)
    expected = rows.sin()
    other.start()
    for k in range(8):
        reader, writer = os.pipe()
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)
            child = os.fork()
        if child == 0:
            right = torch.equal(rows.sin(), expected)
            os.write(writer, work(model, k).encode() if right else b"other rows")
            os._exit(0)
        os.close(writer)
        found.append(os.read(reader, 100).decode())
        os.waitpid(child, 0)
    stop.set()
    other.join()
    torch.set_num_threads(threads)
    return found


def fits(full: bool) -> Iterator[Line]:
    """Fits of other kinds at the same time."""
    groups = GROUPS[: len(Q)]
    cv = ELMRegressorCV(8, relevance_rounds=1, max_hidden=8, random_state=0)
    for name, model in {
        "ELMRegressor": ELMRegressor(20, random_state=0),
        "ELMRegressorCV": cv,
        'error_model="kernel"': hybrid("kernel"),
        'error_model="quadratic", calibrated': hybrid("quadratic", calibrate=("radii",)),
    }.items():
        given = {} if isinstance(model, ELMRegressor) else {"groups": groups}

        def fit(k: int, model: Any = model, given: dict = given) -> bytes:
            return clone(model).fit(Q, X, **given).predict(Q).tobytes()

        rounds = 20 if full else 1
        alone = fit(0)
        with limited(), kept() as same:
            found = in_threads(fit, rounds)
        right = sum(one == alone for one in found)
        figure = f"{right} of {len(found)} fits have the same bits; "
        good = right == len(found) and not same
        yield Line(f"{name}: fits in 8 threads", figure + (", ".join(same) or "as before"), good)
    usual = max(blas_threads())
    set_blas_threads(3)
    with limited(), kept() as same:
        found = in_threads(one_thread()(lambda _: blas_threads()), 20)
    set_blas_threads(usual)
    alone = sum(one == {1} for one in found)
    figure = f"{alone} of {len(found)} calls had one of 3 threads; "
    figure += ", ".join(same) or "as before"
    yield Line("limits of BLAS: 8 threads", figure, alone == len(found) and not same)


def blas_threads() -> set[int]:
    """Return how many threads the libraries of linear algebra may use now."""
    pools = threadpoolctl.threadpool_info()
    return {pool["num_threads"] for pool in pools if pool["user_api"] == "blas"}


def set_blas_threads(n: int) -> None:
    """Set the threads in a thread that ends: while one lives, threadpoolctl obeys no other."""
    setter = threading.Thread(target=threadpoolctl.threadpool_limits, args=(n, "blas"))
    setter.start()
    setter.join()


def n_jobs() -> Iterator[Line]:
    """One process or two."""
    cv = ELMRegressorCV(8, relevance_rounds=1, max_hidden=8, random_state=0)
    auto = hybrid("auto", calibrate=())
    for name, model in (("ELMRegressorCV", cv), ('error_model="auto"', auto)):
        with limited():
            one, two = (
                cross_val_predict(model, Q, X, groups=GROUPS, cv=GroupKFold(3), n_jobs=n)
                for n in (1, 2)
            )
        same = np.array_equal(one, two)
        figure = "the same bits" if same else f"{abs(one - two).max():.1e} m apart"
        yield Line(f"cross_val_predict, n_jobs 1 and 2: {name}", figure, same)
    with limited():
        one, two = (make_trunk(n_segment=2, n_random=30, random_state=0, n_jobs=n) for n in (1, 2))
    same = np.array_equal(one.q, two.q) and np.array_equal(one.x, two.x)
    yield Line("make_trunk, n_jobs 1 and 2", "the same bits" if same else "other bits", same)


def writes(folder: str) -> list[str]:
    """Compile, export and cache into a folder that others use at the same time."""
    sys.path.insert(0, str(Path(__file__).parents[2]))
    from hatch_build import compile_into, host

    compiled = compile_into(Path(folder, "lib"), host(), ["v2"] if host().endswith("64") else [])
    for _ in range(5):
        exported = native.export_c(trunk(), Path(folder, "c"), name="trunk")
    data = make_trunk(n_segment=2, n_random=8, random_state=0, checkpoint=Path(folder, "cache"))
    whole = hashlib.sha256(data.x.tobytes())
    for path in sorted(exported):
        if path.suffix in (".h", ".c"):
            whole.update(path.read_bytes())
    return [whole.hexdigest(), *(path.name for path in compiled)]


def files() -> Iterator[Line]:
    """Two processes that write the same files."""
    with tempfile.TemporaryDirectory() as folder, limited():
        with multiprocessing.get_context("spawn").Pool(2) as workers:
            try:
                one, two = workers.map_async(writes, [folder] * 2, chunksize=1).get(LIMIT)
            except Exception as error:
                one, two = [repr(error)], []
        left = [path.name for part in ("lib", "c") for path in Path(folder, part).iterdir()]
    litter = [name for name in left if name.startswith(("tmp", "."))]
    same = one == two and len(one) > 1 and not litter
    figure = "same files, nothing left beside them" if same else f"{one}, {two}, {litter}"
    yield Line("compile, export_c and make_trunk's cache, in two processes at once", figure, same)
