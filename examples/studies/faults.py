"""Faults whose cause is known, and the cause that `verify_track` names.

The table of the docs page "Results", section "Mistakes in logs"::

    python examples/studies/faults.py --out results/faults

Three robots (`fault_robots`) with five seeds each; a hybrid is fitted to a log of 24 motions and
promises the errors of held-out motions. The robot then runs a new motion of 300 rows, once as it
was and once with each of 14 faults. A fault is

- *first* if it is the cause that `verify_track` names;
- *named* if it is that cause or one of those that explain as much on this path;
- *wrongly blamed* if another cause is named, and the fault is not among the others.

An earlier version, without causes that explain as much, is judged by the shares that it prints:
there a fault is *named* if its share is above a half.

The second table is of mistakes in the log before a fit, as `check_log` names them: *first* if the
first finding about columns, values or time has the right kind and, for signs and orders, its advice
makes the nominal model as good as on the clean log.
"""

from __future__ import annotations

import argparse
import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from csv_tables import add_csv
from fault_robots import PERIOD, ROBOTS, FaultRobot
from log_mistakes import Case, advised, fits
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from hybridkin import (
    HybridForwardModel,
    Hysteresis,
    cross_fit,
    native,
    open_model,
    save_model,
)
from hybridkin.app import check_log, workflow
from hybridkin.app.workflow.errors import Promise
from hybridkin.app.workflow.report import Report
from hybridkin.datasets import Log

N_MOTIONS, N_ROWS = 24, 80  # of the log
N_TRACK = 300  # rows
N_CLEAN = 4  # motions of each robot without a fault
LOADS = {"trunk": 0.5, "tendons": 0.02, "bellows": 0.4}  # [kg]
CLEAN = "nothing wrong"


@dataclass(frozen=True, eq=False)
class Run:
    """A robot that runs commands, and the randomness of a fault."""

    robot: FaultRobot
    q: NDArray
    rng: np.random.Generator

    @property
    def actuator(self) -> int:
        """An actuator that moves, chosen at random."""
        return int(self.rng.integers(self.q.shape[1]))

    @property
    def middle(self) -> int:
        """A row in the middle half, chosen at random."""
        return int(self.rng.integers(len(self.q) // 4, 3 * len(self.q) // 4))

    def motion(self) -> tuple[NDArray, NDArray]:
        """Return a rotation (3, 3) and a shift (3,) of the base [m]."""
        turn = self.rng.standard_normal(3)
        turn *= np.radians(2.5) / np.linalg.norm(turn)
        shift = self.rng.standard_normal(3)
        shift *= 0.03 * self.robot.size / np.linalg.norm(shift)
        return Rotation.from_rotvec(turn).as_matrix(), shift


def _with_column(run: Run, change: Callable[[NDArray], NDArray]) -> NDArray:
    """Return the true tips (N, 3) if one actuator does something else."""
    q = run.q.copy()
    i = run.actuator
    q[:, i] = change(q[:, i])
    return run.robot.tips(q)


def _clean(run: Run) -> NDArray:
    return run.robot.tips(run.q)


def _unit(run: Run) -> NDArray:
    return 10.0 * run.robot.tips(run.q)


def _swapped(run: Run) -> NDArray:
    return run.robot.tips(run.q)[:, [1, 0, 2]]


def _mirrored(run: Run) -> NDArray:
    sign = np.ones(3)
    sign[run.rng.integers(3)] = -1.0
    return sign * run.robot.tips(run.q)


def _late(run: Run) -> NDArray:
    x = run.robot.tips(run.q)
    return np.concatenate([np.repeat(x[:1], 4, axis=0), x[:-4]])


def _moved(run: Run) -> NDArray:
    turn, shift = run.motion()
    return run.robot.tips(run.q) @ turn.T + shift


def _bump(run: Run) -> NDArray:
    x = run.robot.tips(run.q)
    turn, shift = run.motion()
    after = np.arange(len(x)) >= run.middle
    return np.where(after[:, None], x @ turn.T + shift, x)


def _zero(run: Run) -> NDArray:
    way = run.rng.choice([-1.0, 1.0])
    return _with_column(run, lambda column: column + 0.12 * way * np.ptp(column))


def _slip(run: Run) -> NDArray:
    way = run.rng.choice([-1.0, 1.0])
    after = np.arange(len(run.q)) >= run.middle
    return _with_column(run, lambda column: column + 0.15 * way * np.ptp(column) * after)


def _gain(run: Run) -> NDArray:
    rest = run.robot.rest
    i = run.actuator
    q = run.q.copy()
    q[:, i] = rest[i] + 0.75 * (q[:, i] - rest[i])
    return run.robot.tips(q)


def _dead(run: Run) -> NDArray:
    return _with_column(run, lambda column: np.full_like(column, column[0]))


def _payload(run: Run) -> NDArray:
    return run.robot.tips(run.q, LOADS[run.robot.name])


def _backlash(run: Run) -> NDArray:
    width = 0.06 * np.ptp(run.q, axis=0).max()
    return run.robot.tips(Hysteresis.backlash(width).apply(run.q)[0])


def _creep(run: Run) -> NDArray:
    steps = np.full(len(run.q), PERIOD)
    return run.robot.tips(Hysteresis.creep([0.3], [1.0]).apply(run.q, dt=steps)[0])


def _misread(run: Run) -> NDArray:
    x = run.robot.tips(run.q)
    first = run.middle
    far = run.rng.standard_normal(3)
    x[first : first + 25] += 0.2 * run.robot.size * far / np.linalg.norm(far)
    return x


FAULTS: dict[str, tuple[Callable[[Run], NDArray], str]] = {
    CLEAN: (_clean, ""),
    "tips in centimetres": (_unit, "unit of the tips"),
    "x and y swapped": (_swapped, "axes of the tips"),
    "one axis mirrored": (_mirrored, "axes of the tips"),
    "camera four rows late": (_late, "lag"),
    "moved base": (_moved, "moved base"),
    "bump half-way": (_bump, "bump"),
    "zero of one actuator": (_zero, "zero of one actuator"),
    "slip half-way": (_slip, "slip of one actuator"),
    "gain of one actuator": (_gain, "gain of one actuator"),
    "dead actuator": (_dead, "dead actuator"),
    "payload": (_payload, "payload"),
    "backlash": (_backlash, "backlash"),
    "creep": (_creep, "creep"),
    "25 rows misread": (_misread, "misread rows"),
}
"""What is done to a run, and the name of its cause."""


def fitted(robot: FaultRobot, seed: int, folder: Path) -> HybridForwardModel:
    """Return a hybrid that is fitted to a log of a robot and promises errors; it is kept."""
    path = folder / f"{robot.name}_{seed}.safetensors"
    if path.is_file():
        return open_model(path)
    rng = np.random.default_rng([seed, 1])
    q = np.concatenate([robot.motion(rng, N_ROWS) for _ in range(N_MOTIONS)])
    groups = np.repeat(np.arange(N_MOTIONS), N_ROWS)
    x = robot.tips(q)
    x += robot.noise * rng.standard_normal(x.shape)
    model = HybridForwardModel(robot.chain, random_state=0, **robot.settings)
    log = Log(q, x, groups)
    compared = cross_fit({"hybrid": model}, log, 3)
    errors = compared.distances[0]
    far = compared.distances_from_others
    held_out = {"mean": float(errors.mean()), "p95": float(np.quantile(errors, 0.95))}
    training: dict[str, Any] = {"saved": "hybrid", "held_out": {"hybrid": held_out}}
    training["promise"] = vars(Promise.of(errors, far))
    save_model(model, path, training=training)
    return open_model(path)


def _write_track(path: Path, q: NDArray, x: NDArray) -> None:
    n = q.shape[1]
    head = ["t", *(f"q{i + 1}" for i in range(n)), *"xyz"]
    head += ["target_x", "target_y", "target_z", "status"]
    t = PERIOD * np.arange(len(q))
    lines = [",".join(head)]
    for row in np.column_stack([t, q, x, x]):
        lines.append(",".join([*map(repr, map(float, row)), "CONVERGED"]))
    path.write_text("\n".join(lines), encoding="utf-8")


def verified(
    model: HybridForwardModel,
    robot: FaultRobot,
    seed: int,
    fault: str,
    folder: Path,
    number: int = 0,
) -> dict[str, Any]:
    """Return what `verify_track` says of a run with a fault; `number` is that of the motion."""
    rng = np.random.default_rng([seed, 2 + 10 * number])
    q = robot.motion(rng, N_TRACK)
    run = Run(robot, q, np.random.default_rng([seed, list(FAULTS).index(fault)]))
    x = FAULTS[fault][0](run)
    x = x + robot.noise * rng.standard_normal(x.shape)
    track = folder / "track.csv"
    _write_track(track, q, native.evaluate(model.module_, q)[0])
    began = time.process_time()
    record = workflow.verify_track(model, track, Log(q, x)).record
    others = getattr(record, "also", [])
    if not hasattr(record, "also"):
        others = [name for name, share in record.causes.items() if share > 0.5]
    path = record.parts["path"]
    return {
        "cause": record.cause,
        "also": others,
        "amount": getattr(record, "amount", ""),
        "separate": getattr(record, "separate", ""),
        "shares": dict(record.causes),
        "kept": record.kept,
        "mean": path.mean,
        "promised": path.promised,
        "seconds": time.process_time() - began,
    }


def study(seeds: Sequence[int], folder: Path, faults: Sequence[str]) -> list[dict]:
    """Return one record for each robot, seed and fault."""
    folder.mkdir(parents=True, exist_ok=True)
    records = []
    for kind in ROBOTS:
        for seed in seeds:
            robot = kind(seed)
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                model = fitted(robot, seed, folder)
                for fault in faults:
                    for number in range(N_CLEAN if fault == CLEAN else 1):
                        found = verified(model, robot, seed, fault, folder, number)
                        found |= {"robot": robot.name, "seed": seed, "fault": fault}
                        records.append(found)
    return records


def _reversed(q: NDArray, rng: np.random.Generator) -> NDArray:
    signs = np.ones(q.shape[1])
    signs[rng.integers(len(signs))] = -1.0
    return signs * q


def _two_columns(q: NDArray, rng: np.random.Generator, places: Sequence[int]) -> NDArray:
    order = np.arange(q.shape[1])
    order[[*places]] = order[[*places][::-1]]
    return q[:, order]


def _of_one_segment(q: NDArray, rng: np.random.Generator) -> NDArray:
    first = 3 * int(rng.integers(q.shape[1] // 3))
    return _two_columns(q, rng, (first, first + 1 + int(rng.integers(2))))


def _of_two_segments(q: NDArray, rng: np.random.Generator) -> NDArray:
    return _two_columns(q, rng, (int(rng.integers(3)), 3 + int(rng.integers(3))))


def _other_direction(q: NDArray, rng: np.random.Generator) -> NDArray:
    order = np.arange(q.shape[1]).reshape(-1, 3)[:, [0, 2, 1]].ravel()
    return q[:, order]


def _off(q: NDArray, rng: np.random.Generator, shape: NDArray) -> NDArray:
    q = q.copy()
    i = int(rng.integers(q.shape[1]))
    q[:, i] += rng.choice([-1.0, 1.0]) * 0.4 * np.ptp(q[:, i]) * shape
    return q


def _offset(q: NDArray, rng: np.random.Generator) -> NDArray:
    return _off(q, rng, np.ones(len(q)))


def _drifting(q: NDArray, rng: np.random.Generator) -> NDArray:
    return _off(q, rng, np.linspace(0.0, 1.0, len(q)))


_READ = ("sign", "order", "numbering")
MISTAKES: dict[str, tuple[Callable[..., NDArray], str, tuple[str, ...]]] = {
    CLEAN: (lambda q, rng: q, "q", ()),
    "one motor reversed": (_reversed, "q", _READ),
    "two columns of a segment swapped": (_of_one_segment, "q", _READ),
    "two columns of two segments swapped": (_of_two_segments, "q", _READ),
    "numbered in the other direction": (_other_direction, "q", ("numbering",)),
    "zero of one actuator": (_offset, "q", ("offset", "zeros")),
    "drift of one actuator": (_drifting, "q", ("drift",)),
    "tips in centimetres": (lambda x, rng: 10.0 * x, "x", ("units",)),
    "tips four rows late": (lambda x, rng: np.roll(x, 4, axis=0), "x", ("lag",)),
}
"""What is done to a log, to q or x, and the kinds of findings that name it."""
_ABOUT = (
    *_READ,
    "units",
    "axes",
    "size",
    "offset",
    "zeros",
    "drift",
    "lag",
    "geometry",
    "exchanged",
)


def checked(robot: FaultRobot, seed: int, mistake: str) -> dict[str, Any]:
    """Return what `check_log` says of a log with a mistake."""
    rng = np.random.default_rng([seed, 1])
    q = np.concatenate([robot.motion(rng, N_ROWS) for _ in range(N_MOTIONS)])
    groups = np.repeat(np.arange(N_MOTIONS), N_ROWS)
    x = robot.tips(q)
    x += robot.noise * rng.standard_normal(x.shape)
    log_format = robot.log_format()
    unit = "m" if robot.unit == "m" else "1"
    log = Log(q, x, groups, q_names=log_format.q, units={"q": unit, "x": "m"})
    case = Case(robot.chain, True, log, log)
    clean = fits(case)
    change, column, kinds = MISTAKES[mistake]
    rng = np.random.default_rng([seed, 100 + list(MISTAKES).index(mistake)])
    wrong = replace(log, **{column: change(getattr(log, column), rng)})
    case = replace(case, log=wrong, test=wrong)
    began = time.process_time()
    report = check_log(wrong, chain=robot.chain)
    seconds = time.process_time() - began
    found = [f for f in report.findings if f.kind in _ABOUT and f.severity != "note"]
    right = [f.kind for f in found[:1] if f.kind in kinds]
    if right and kinds == _READ:
        mended = advised(case, found[0].advice)
        if mended is None or fits(mended) > 1.1 * clean:
            right = []
    return {
        "kinds": [f.kind for f in found],
        "first": bool(right),
        "named": bool(right) or any(f.kind in kinds for f in found),
        "messages": [f"{f.message} {f.advice}" for f in found],
        "seconds": seconds,
    }


def check_study(seeds: Sequence[int]) -> list[dict]:
    """Return one record of `check_log` for each robot, seed and mistake."""
    records = []
    for kind in ROBOTS:
        for seed in seeds:
            robot = kind(seed)
            for mistake in MISTAKES:
                found = checked(robot, seed, mistake)
                records.append(found | {"robot": robot.name, "seed": seed, "fault": mistake})
    return records


def main() -> None:
    """Run the study and print its table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("results/faults"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--faults", nargs="+", default=[*FAULTS])
    options = parser.parse_args()
    report = Report("Faults with known causes (simulated robots)", {})
    records = study(options.seeds, options.out, options.faults)
    rows = []
    for fault in options.faults:
        mine = [r for r in records if r["fault"] == fault]
        truth = FAULTS[fault][1]
        first = sum(r["cause"] == truth for r in mine)
        named = sum(truth in (r["cause"], *r["also"]) for r in mine)
        wrong = sum(r["cause"] not in (None, truth) and truth not in r["also"] for r in mine)
        none = sum(r["cause"] is None for r in mine)
        rows.append(["verify", fault, len(mine), first, named, wrong, none])
    checks = check_study(options.seeds)
    for mistake in MISTAKES:
        mine = [r for r in checks if r["fault"] == mistake]
        first = sum(r["first"] for r in mine)
        named = sum(r["named"] for r in mine)
        none = sum(not r["kinds"] for r in mine)
        wrong = len(mine) - named - none
        rows.append(["check", mistake, len(mine), first, named, wrong, none])
    header = [
        "by",
        "fault",
        "runs",
        "first",
        "named",
        "wrongly blamed",
        "nothing named",
    ]
    report.table(header, [[*map(str, row)] for row in rows])
    seconds = [r["seconds"] for r in records]
    report.text(f"CPU time of a verification: at most {max(seconds):.2f} s.")
    report.record |= {"verify": records, "check": checks}
    add_csv(report, "faults.csv", header, rows)
    print(report.plain())
    report.write(options.out)


if __name__ == "__main__":
    main()
