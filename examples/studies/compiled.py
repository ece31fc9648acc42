"""How the compiled core agrees with torch, and how long a tick can take.

The first table and the figure of the docs page "Benchmarks", section "Control steps", and how the
results agree::

    python examples/studies/compiled.py --out results/compiled
    python examples/studies/compiled.py --out results/compiled --parts ticks --image ticks.png

An hour on one core. The parts: "agreement" of models in batches and in single rows; "steps" from
inside and outside the limits; "solve" of targets in reach and out of reach; "ticks", every one
timed alone, with clock and ctypes call.
"""

from __future__ import annotations

import argparse
import gc
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from compiled_cases import CASES, Case
from compiled_report import (
    FAR,
    MORE_RUNS,
    RUNS,
    Ticks,
    agreement_report,
    solve_report,
    steps_report,
    ticks_report,
)
from numpy.typing import NDArray
from reachable_targets import KINDS, ROBOTS, STARTS, Robot, draw

from hybridkin import InverseKinematics, as_forward_model
from hybridkin.app.workflow.report import Report
from hybridkin.ik.results import IKStatus
from hybridkin.native.library import program_of

PARTS = ("agreement", "steps", "solve", "ticks")
TICKED = (
    "trunk",
    "elastic, 9 tendons",
    "ELM, no guard",
    "ELM, leverage guard",
    "serial quadratic",
    "blend",
)
"""Cases whose ticks are timed."""

_BLOCK = 20_000  # rows of a model in torch at a time
_SETTINGS = 20  # of inverse kinematics, drawn at random
_SLOWEST = 10  # ticks under every setting, run again
_STAY = 10  # ticks from one random configuration to the next


def rows_of(case: Case, n: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Return rows q (n, n_actuators), 1 % with a NaN, and which fifth of them lies far out."""
    middle, half = 0.5 * (case.low + case.high), 0.5 * (case.high - case.low)
    far = rng.random(n) < 0.2
    spread = np.where(far, np.exp(rng.uniform(0.0, np.log(FAR), n)), 1.0)
    q = middle + spread[:, None] * half * rng.uniform(-1.0, 1.0, (n, len(half)))
    broken = np.flatnonzero(rng.random(n) < 0.01)
    q[broken, rng.integers(0, len(half), len(broken))] = np.nan
    return q, far


def agreement(case: Case, n: int, rng: np.random.Generator, n_single: int = 2000) -> dict[str, Any]:
    """Return how far the core is from torch at random rows.

    Returns
    -------
    dict
        Largest difference of "x", "J" and "distance" near the limits, "x_far", "J_far" and
        "distance_far"; those of x and J relative to the largest value of the group, those of the
        distance relative to itself or to 1. "decisions": rows that are in the domain for one of
        the two; "nan": rows that are NaN for one of the two; "single": the largest difference
        between a row by itself and in its batch, by the same measures.
    """
    q, far = rows_of(case, n, rng)
    program = program_of(case.model)
    assert program is not None
    batch: Any = program.evaluate(q, True, True)
    parts = [_in_torch(case.model, some) for some in torch.from_numpy(q).split(_BLOCK)]
    right = [np.concatenate(part) for part in zip(*parts, strict=True)]
    found: dict[str, Any] = {"n": n, "single": 0.0, "nan": 0}
    some = np.concatenate([np.arange(min(n, n_single)), np.flatnonzero(np.isnan(q).any(1))])
    single: Any = [program.evaluate(row, True, True) for row in q[some]]
    for k, name in enumerate(("x", "J", "distance")):
        sizes = _sizes(right[k], far, name == "distance")
        apart = _apart(batch[k], right[k]) / sizes
        found[name], found[f"{name}_far"] = (
            apart[~far].max(),
            apart[far].max(initial=0.0),
        )
        ones = np.stack([row[k] for row in single])
        alone = (_apart(ones, batch[k][some]) / sizes[some]).max()
        found["single"] = max(found["single"], alone)
        found["nan"] += int(np.isinf(apart).sum())
    found["decisions"] = int(((batch[2] <= 1.0) != right[3]).sum())
    return found


@torch.no_grad()
def _in_torch(model: Any, q: torch.Tensor) -> list[NDArray]:
    parts = (
        *model.forward_and_jacobian(q),
        model.domain_distance(q),
        model.in_domain(q),
    )
    return [part.numpy() for part in parts]


def _apart(a: NDArray, b: NDArray) -> NDArray:
    """Return the largest difference in every row; infinite where only one of two has a NaN."""
    a, b = a.reshape(len(a), -1), b.reshape(len(b), -1)
    none, other = np.isnan(a).any(axis=1), np.isnan(b).any(axis=1)
    with np.errstate(invalid="ignore"):
        apart = np.where(a == b, 0.0, np.abs(a - b)).max(axis=1)
    return np.where(none & other, 0.0, np.where(none | other, np.inf, apart))


def _sizes(right: NDArray, far: NDArray, own: bool) -> NDArray:
    """Return for every row what a difference is small against."""
    size = np.nan_to_num(np.abs(right), posinf=0.0).reshape(len(right), -1).max(axis=1)
    if own:
        return np.maximum(size, 1.0)
    return np.where(far, size[far].max(initial=0.0), size[~far].max())


def random_settings(low: NDArray, high: NDArray, rng: np.random.Generator) -> dict[str, Any]:
    """Return settings of inverse kinematics."""
    n, span, narrower = len(low), high - low, 0.3 * rng.integers(0, 2, 2)
    chosen: dict[str, Any] = {
        "q_min": low + narrower[0] * span * rng.random(n),
        "q_max": high - narrower[1] * span * rng.random(n),
        "beta": float(rng.choice([0.0, 1.0, 100.0])),
        "damping": ["adaptive", "adaptive", "adaptive", 0.0, 0.05][rng.integers(5)],
    }
    more = {
        "dq_max": span * 10.0 ** rng.uniform(-1.0, 2.0, n),
        "weights": 10.0 ** rng.uniform(-1.0, 1.0, n),
        "gain": 50.0,
        "limits": "off",
        "q_pref": rng.uniform(low, high, n),
        "ddq_max": span * 10.0 ** rng.uniform(1.0, 4.0, n),
    }
    return chosen | {name: value for name, value in more.items() if rng.random() < 0.3}


def _starts_of_steps(
    low: NDArray, high: NDArray, n: int, rng: np.random.Generator
) -> tuple[NDArray, NDArray]:
    """Return q inside, outside and at the limits, bent and nearly straight; and others to go to."""
    span, size = high - low, len(low)
    q = rng.uniform(low, high, (n, size))
    q[::4] += 0.3 * span * rng.standard_normal((len(q[::4]), size))
    at_limit = rng.random((len(q[1::4]), size)) < 0.4
    ends = np.where(rng.random(at_limit.shape) < 0.5, low, high)
    q[1::4] = np.where(at_limit, ends, q[1::4])
    q[2::8] = low + span * rng.random((len(q[2::8]), 1))
    q[2::8] += 10.0 ** rng.uniform(-8, -3) * span * rng.standard_normal((len(q[2::8]), size))
    return q, np.where(rng.random((n, 1)) < 0.5, q, rng.uniform(low, high, (n, size)))


def steps(robot: Robot, n: int, rng: np.random.Generator) -> dict[str, Any]:
    """Return how far steps of the core are from those of torch, from n random states.

    Returns
    -------
    dict
        For limits="saturate", and "off": the largest difference of J dq [m] ("move") and of dq,
        relative to the span of the limits; "control_off": that of dq between torch and torch with q
        moved by its last bit; "flags": `saturated` flags that differ; "outside": rows q + dq beyond
        the limits, from starts within them.
    """
    low, high = robot.q_min.numpy(), robot.q_max.numpy()
    forward = as_forward_model(robot.model)
    names = ("move", "dq", "control", "move_off", "dq_off", "control_off")
    found: dict[str, Any] = {
        "n": n,
        "flags": 0,
        "outside": 0,
        **dict.fromkeys(names, 0.0),
    }
    for _ in range(_SETTINGS):
        given = random_settings(low, high, rng)
        ik = InverseKinematics(robot.model, **given)
        q, goal = _starts_of_steps(given["q_min"], given["q_max"], -(-n // _SETTINGS), rng)
        with torch.no_grad():
            x, J = (
                forward(torch.from_numpy(goal)),
                forward.jacobian(torch.from_numpy(q)).numpy(),
            )
        x = x.numpy() + 10.0 ** rng.uniform(-4.0, -1.0, (len(q), 1)) * rng.standard_normal(x.shape)
        dx = rng.choice([0.0, 0.1]) * rng.standard_normal(x.shape)
        near = np.nextafter(q, 0.5 * (low + high))
        ours = ik.step(q, x, dx)
        theirs, control = (ik.step(*map(torch.from_numpy, (at, x, dx))) for at in (q, near))
        apart = ours.dq - theirs.dq.numpy()
        ending = "_off" if "limits" in given else ""
        seen = {
            "move": np.linalg.norm(np.einsum("bij,bj->bi", J, apart), axis=1),
            "dq": np.abs(apart) / (high - low),
            "control": np.abs((control.dq - theirs.dq).numpy()) / (high - low),
        }
        for name, values in seen.items():
            found[name + ending] = max(found[name + ending], values.max())
        if not ending:
            found["flags"] += int((ours.saturated != theirs.saturated.numpy()).sum())
            ends = given["q_min"], given["q_max"]
            held = ((q >= ends[0]) & (q <= ends[1])).all(1)
            new = q[held] + ours.dq[held]
            found["outside"] += int(((new < ends[0]) | (new > ends[1])).any(1).sum())
    return found


def solve(robot: Robot, n: int, n_beyond: int, random_state: int = 0) -> dict[str, Any]:
    """Return how `solve` by the core differs from torch, for n targets in reach and others.

    Returns
    -------
    dict
        "statuses": pairs that differ with their number; "error": largest difference of the errors
        of targets with equal statuses [m], "error_reached" of those within the tolerance; "moved":
        rows of other statuses where both errors are equal to 1e-9 m; "other_q": rows with another q
        (1e-6 of the limits), "control" those of torch where the target moves by its last bit;
        "seconds" and "seconds_torch" of CPU time.
    """
    generator = torch.Generator().manual_seed(random_state)
    ik = InverseKinematics(robot.model, q_min=robot.q_min, q_max=robot.q_max)
    forward = as_forward_model(robot.model)
    found: dict[str, Any] = {
        "n": 0,
        "differ": 0,
        "statuses": {},
        "moved": 0,
        "other_q": 0,
        "control": 0,
    }
    found |= dict.fromkeys(("error", "error_reached", "seconds", "seconds_torch"), 0.0)
    span = (robot.q_max - robot.q_min).numpy()
    jobs = [(kind, start, n) for kind in KINDS for start in STARTS]
    for kind, start, total in [*jobs, ("inside", "rest", 10 * n_beyond)]:
        each = -(-total // 10)
        with torch.no_grad():
            x = forward(draw(robot, kind, each, generator))
        if total != n:  # out of reach, a little or far
            x = x * (1.2 + torch.rand(each, 1, generator=generator, dtype=x.dtype))
        anywhere = draw(robot._replace(rows=None), "inside", each, generator)
        q0 = None if start == "rest" else anywhere
        began = time.process_time()
        ours = ik.solve(x.numpy(), None if q0 is None else q0.numpy())
        between = time.process_time()
        theirs = ik.solve(x, q0)
        found["seconds_torch"] += time.process_time() - between
        found["seconds"] += between - began
        apart = np.abs(ours.error - theirs.error.numpy())
        other = ours.status != theirs.status.numpy()
        reached = (ours.status == IKStatus.CONVERGED) & ~other
        found["n"] += each
        found["differ"] += int(other.sum())
        found["moved"] += int((other & (apart < 1e-9)).sum())
        found["error"] = max(found["error"], apart[~other & ~reached].max(initial=0.0))
        found["error_reached"] = max(found["error_reached"], apart[reached].max(initial=0.0))
        control = ik.solve(torch.nextafter(x, torch.zeros_like(x)), q0)
        for key, q in (("other_q", ours.q), ("control", control.q.numpy())):
            far = (np.abs(q - theirs.q.numpy()) / span).max(axis=1) > 1e-6
            found[key] += int(far.sum())
        pairs = zip(ours.status[other], theirs.status.numpy()[other], strict=True)
        for pair in (f"{IKStatus(a).name}, torch {IKStatus(b).name}" for a, b in pairs):
            found["statuses"][pair] = found["statuses"].get(pair, 0) + 1
    return found


def ticks(case: Case, n: int, rng: np.random.Generator) -> Ticks:
    """Return the times of n calls of `hk_ik_tick` by ctypes, every one taken by itself.

    A robot follows targets near and far from random configurations, under random settings.
    """
    low, high = case.low, case.high
    span, each = high - low, -(-n // _SETTINGS)
    once, least, slowest = [], [], 0
    gc.collect()
    gc.disable()  # a collection takes milliseconds
    for k in range(_SETTINGS):
        options: dict[str, Any] = {"beta": float(rng.choice([0.0, 1.0, 50.0]))}
        if k % 4 != 3:
            options["dq_max"] = span * 10.0 ** rng.uniform(-0.5, 2.0, len(low))
        if k % 4 == 2:
            options["weights"] = 10.0 ** rng.uniform(-1.0, 1.0, len(low))
        ik = InverseKinematics(case.model, q_min=low, q_max=high, **options)
        q, goal = _starts_of_steps(low, high, each, rng)
        q = q.clip(low, high)
        program = program_of(ik.settings.task.models[0])
        assert program is not None
        x = program.evaluate(goal)[0]
        x += 10.0 ** rng.uniform(-4.0, -0.5, (each, 1)) * rng.standard_normal(x.shape)
        times, at = _timed(ik, q, x)
        once.append(times[:, 0])
        least.append(times.min(axis=1))
        worst = np.argsort(least[-1])[-_SLOWEST:]
        again, _ = _timed(ik, at[worst].repeat(MORE_RUNS, 0), x[worst].repeat(MORE_RUNS, 0), 1)
        slowest = max(slowest, int(again.reshape(len(worst), -1).min(axis=1).max()))
    gc.enable()
    return Ticks(1e-3 * np.concatenate(once), 1e-3 * np.concatenate(least), 1e-3 * slowest)


def _timed(ik: InverseKinematics, q: NDArray, x: NDArray, stay: int = _STAY) -> tuple[NDArray, ...]:
    """Return times [ns] of a few runs of every tick, and the configurations they started at."""
    robot: Any = ik.tracker(q[0])._robot
    robot.tick(x[0], None, None)  # sets what is given
    # The call alone: `tracker.step` adds Python around it.
    call, place, at = robot._follow, robot._call.place, robot.q
    target = robot._inputs[0].numbers
    times, starts = np.empty((len(q), RUNS), dtype=np.int64), np.empty_like(q)
    clock = time.perf_counter_ns
    for i in range(len(q)):
        if i % stay == 0:
            at[:] = q[i]
        target[:] = x[i]
        starts[i] = at
        for run in range(RUNS):
            at[:] = starts[i]
            began = clock()
            call(place)
            times[i, run] = clock() - began
    return times, starts


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the chosen parts and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--parts", nargs="+", choices=PARTS, default=PARTS)
    parser.add_argument(
        "--cases",
        nargs="+",
        choices=CASES,
        metavar="CASE",
        help="of agreement and ticks",
    )
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, metavar="ROBOT", default=[*ROBOTS])
    parser.add_argument("--rows", type=int, default=100_000, help="of each model (100000)")
    parser.add_argument("--steps", type=int, default=10_000, help="of each robot (10000)")
    parser.add_argument("--targets", type=int, default=10_000, help="in reach, each robot (10000)")
    parser.add_argument("--ticks", type=int, default=1_000_000, help="of each model (1000000)")
    parser.add_argument("--seed", type=int, default=0, help="of the draws; default: 0")
    parser.add_argument("--image", type=Path, help="file that the figure goes to as well")
    given = parser.parse_args(arguments)
    torch.set_num_threads(1)
    report = Report("The compiled core against torch", {})

    def run(part: str, names: Sequence[str], study: Callable[[str], Any]) -> dict[str, Any]:
        found = {}
        for done, name in enumerate(names, 1):
            found[name] = study(name)
            print(f"{part} {done}/{len(names)} {name}", file=sys.stderr, flush=True)
        return found

    def draws() -> np.random.Generator:
        return np.random.default_rng(given.seed)

    cases, ticked = given.cases or CASES, given.cases or TICKED
    seed, n_beyond = given.seed, given.targets // 10
    studies: dict[str, tuple[Any, Callable[[str], Any], Callable[..., Any]]] = {
        "agreement": (
            cases,
            lambda k: agreement(CASES[k](), given.rows, draws()),
            agreement_report,
        ),
        "steps": (
            given.robots,
            lambda k: steps(ROBOTS[k](), given.steps, draws()),
            steps_report,
        ),
        "solve": (
            given.robots,
            lambda k: solve(ROBOTS[k](), given.targets, n_beyond, seed),
            solve_report,
        ),
        "ticks": (
            ticked,
            lambda k: ticks(CASES[k](), given.ticks, draws()),
            ticks_report,
        ),
    }
    figure = None
    for part in given.parts:
        names, study, write = studies[part]
        found = run(part, [*names], study)
        if part != "ticks":
            report.record[part] = found
        figure = write(report, found)
    print(report.plain())
    if given.image is not None and figure is not None:
        figure.savefig(given.image)
    for path in report.write(given.out):
        print(path)


if __name__ == "__main__":
    main()
