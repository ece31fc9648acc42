"""How many reachable targets `InverseKinematics.solve` reaches, with further starts and without.

Figures of the docs page "Theory", section "Further starts", and
``docs/data/reachable_targets.csv``::

    python examples/studies/reachable_targets.py --out results/reachable_targets

A few minutes on one core. Targets are the model's own tips at q drawn inside the limits, on faces,
on edges, in corners and near the straight robot, so that every one can be reached. For hybrids q
lies in the domain of the error model as well: a draw outside it moves towards a training row until
it is inside. There OUT_OF_DOMAIN counts as not reached.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    as_forward_model,
    datasets,
)
from hybridkin.app.workflow.report import Report
from hybridkin.ik.results import IKStatus

TOL = 1e-4  # [m]
KINDS = ("inside", "face", "edge", "corner", "straight")
STARTS = ("rest", "random")
_ON_A_FACE = 0.3  # probability of an actuator
_RADII = [0.100, 0.093, 0.079]  # [m]
_TRAINING_ROWS = 600


class Robot(NamedTuple):
    """A model with its limits, and rows in the domain of its error model."""

    model: Any
    q_min: Tensor
    q_max: Tensor
    rows: Tensor | None = None


def _extensible(n_segments: int) -> Robot:
    return _limited(ConstantCurvatureChain(_RADII[:n_segments]), 0.1, 0.4)


def _tendons(n_segments: int) -> Robot:
    radii, lengths = [0.02] * n_segments, [0.1] * n_segments
    chain = ConstantCurvatureChain(radii, lengths=lengths, routing="base")
    return _limited(chain, -0.02, 0.02)


def _elastic(n_segments: int) -> Robot:
    chain = ElasticTendonChain([0.02] * n_segments, [0.1] * n_segments)
    return _limited(chain, -0.02, 0.02)


def _limited(chain: Any, low: float, high: float) -> Robot:
    like = torch.ones(chain.n_actuators, dtype=torch.float64)
    return Robot(chain, low * like, high * like)


def _hybrid(**options: Any) -> Robot:
    """Return a hybrid of the simulated trunk, within the range of its training rows."""
    data = datasets.load_trunk()
    chosen = np.random.default_rng(0).permutation(len(data.q))[:_TRAINING_ROWS]
    q, x = data.q[chosen], data.x[chosen]
    chain = ConstantCurvatureChain(_RADII)
    model = HybridForwardModel(chain, random_state=0, **options).fit(q, x).module_
    q = torch.from_numpy(q)
    return Robot(model, q.amin(0), q.amax(0), q[model.in_domain(q)])


ROBOTS: dict[str, Callable[[], Robot]] = {
    "trunk, 3 segments": lambda: _extensible(3),
    "trunk, 2 segments": lambda: _extensible(2),
    "tendons, 3 segments": lambda: _tendons(3),
    "tendons, 2 segments": lambda: _tendons(2),
    "elastic tendons, 3 segments": lambda: _elastic(3),
    "elastic tendons, 2 segments": lambda: _elastic(2),
    "hybrid, parallel ELM": lambda: _hybrid(),
    "hybrid, serial quadratic": lambda: _hybrid(coupling="serial", error_model="quadratic"),
    'hybrid, "auto"': lambda: _hybrid(error_model="auto", calibrate=("radii", "base")),
}
"""Robots of the study, by name."""


def draw(robot: Robot, kind: str, n: int, rng: torch.Generator) -> Tensor:
    """Return n configurations within the limits, and in the domain where there is one.

    Parameters
    ----------
    robot : Robot
        Model and limits.
    kind : {"inside", "face", "edge", "corner", "straight"}
        Where: evenly inside; some actuators at a limit; all but one; all; all actuators of a
        segment alike to a thousandth of the limits or less.
    n : int
        Number of configurations.
    rng : torch.Generator
        Where the draws come from.

    Returns
    -------
    Tensor of shape (n, n_actuators)
    """
    low, high = robot.q_min, robot.q_max

    def drawn(*size: int) -> Tensor:
        return torch.rand(*size, generator=rng, dtype=torch.float64)

    size = len(low)
    share = drawn(n, size)
    at_limit = {
        "inside": torch.zeros(n, size, dtype=torch.bool),
        "face": drawn(n, size) < _ON_A_FACE,
        "edge": torch.arange(size) != (size * drawn(n, 1)).long(),
        "corner": torch.ones(n, size, dtype=torch.bool),
        "straight": torch.zeros(n, size, dtype=torch.bool),
    }[kind]
    if kind == "straight":
        alike = drawn(n, size // 3, 1).expand(-1, -1, 3).flatten(1)
        share = alike + 10.0 ** (-3.0 - 3.0 * drawn(n, 1)) * (share - 0.5)
    share = torch.where(at_limit, share.round(), share).clamp(0.0, 1.0)
    q = torch.lerp(low, high, share).clamp(low, high)
    if robot.rows is None:
        return q
    anchor = robot.rows[(len(robot.rows) * drawn(n)).long()]
    inside, outside = torch.zeros(n, 1).double(), torch.ones(n, 1).double()
    for _ in range(20):  # bisection of the way from a training row
        middle = 0.5 * (inside + outside)
        good = robot.model.in_domain(torch.lerp(anchor, q, middle))[:, None]
        inside, outside = (
            torch.where(good, middle, inside),
            torch.where(good, outside, middle),
        )
    pulled = torch.lerp(anchor, q, inside).clamp(low, high)
    return torch.where(robot.model.in_domain(q)[:, None], q, pulled)


def reached_targets(
    name: str, robot: Robot, n: int, *, random_state: int = 0, **options: Any
) -> list[dict[str, Any]]:
    """Return what `solve` made of n reachable targets of every kind, from each of two starts.

    Parameters
    ----------
    name : str
        Name of the robot in the entries.
    robot : Robot
        Model and limits.
    n : int
        Targets per kind and start.
    random_state : int, default=0
        Seed of the draws.
    **options
        Handed to `InverseKinematics.solve`.

    Returns
    -------
    list of dict
        One entry per kind and start: "robot", "kind", "start", "n", the number of targets by
        status, "false" (CONVERGED, but the model's tip at the returned q is further off than the
        tolerance), "violated" (an actuator beyond a limit, by whatever little), "largest" error
        [m], "starts" (mean over the targets) and "seconds" (CPU time).
    """
    rng = torch.Generator().manual_seed(random_state)
    ik = InverseKinematics(robot.model, q_min=robot.q_min, q_max=robot.q_max)
    forward, entries = as_forward_model(robot.model), []
    for kind in KINDS:
        target = forward(draw(robot, kind, n, rng)).detach()
        anywhere = draw(robot._replace(rows=None), "inside", n, rng)
        for start in STARTS:
            q0 = None if start == "rest" else anywhere.numpy()
            began = time.process_time()
            solution = ik.solve(target.numpy(), q0, tol=TOL, **options)
            seconds = time.process_time() - began
            q = torch.from_numpy(solution.q)
            with torch.no_grad():
                error = (forward(q) - target).norm(dim=-1).numpy()
            beyond = ((q < robot.q_min) | (q > robot.q_max)).any(-1)
            statuses = [IKStatus(code).name for code in solution.status.tolist()]
            entries.append(
                {
                    "robot": name,
                    "kind": kind,
                    "start": start,
                    "n": n,
                    **{status.name: statuses.count(status.name) for status in IKStatus},
                    "false": int((solution.converged & (error > TOL)).sum()),
                    "violated": int(beyond.sum()),
                    "largest": float(error.max()),
                    "starts": float(solution.n_starts.mean()),
                    "seconds": seconds,
                }
            )
    return entries


def study(
    robots: Mapping[str, Callable[[], Robot]] | None = None,
    n: int = 20_000,
    *,
    random_state: int = 0,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[dict[str, Any]]:
    """Return the entries of all robots, with one start ("restarts" 0) and with the default.

    Parameters
    ----------
    robots : mapping of str to callable, optional
        Makes a robot by name. Default: `ROBOTS`.
    n : int, default=20_000
        Targets in all, at least.
    random_state : int, default=0
        Seed of the draws.
    progress : callable, optional
        Called with (what, done, total).

    Returns
    -------
    list of dict
        As from `reached_targets`, with "restarts".
    """
    robots, entries = ROBOTS if robots is None else robots, []
    each = -(-n // (len(robots) * len(KINDS) * len(STARTS)))
    for done, (name, make) in enumerate(robots.items(), 1):
        robot = make()
        for label, options in (("0", {"restarts": 0}), ("default", {})):
            found = reached_targets(name, robot, each, random_state=random_state, **options)
            entries += [{**entry, "restarts": label} for entry in found]
        if progress is not None:
            progress(name, done, len(robots))
    return entries


def reachable_report(entries: list[dict[str, Any]]) -> Report:
    """Return the report of what `study` returned.

    Parameters
    ----------
    entries : list of dict
        As from `study`.

    Returns
    -------
    Report
        A table by robot and one by kind; ``report.write(folder)`` writes them.
    """
    report = Report("Reachable targets", {})
    report.record.update(table=entries, tol=TOL)
    for key in ("robot", "kind", "start"):
        report.text(f"By {key}: targets not reached, with one start and with further ones.")
        rows = [_row(value, key, entries) for value in dict.fromkeys(e[key] for e in entries)]
        report.table(_HEADER, [*rows, _row("all", None, entries)])
    return report


_HEADER = [
    "",
    "targets",
    "missed, one start",
    "missed",
    "converged [%]",
    "out of domain",
    "false",
    "beyond limits",
    "largest error [mm]",
    "time / one start",
]


def _row(value: str, key: str | None, entries: list[dict[str, Any]]) -> list[str]:
    """Return the row of a table for the entries with this value."""
    chosen = [entry for entry in entries if key is None or entry[key] == value]
    once, full = ([e for e in chosen if e["restarts"] == r] for r in ("0", "default"))

    def total(part: list[dict[str, Any]], name: str) -> float:
        return sum(entry[name] for entry in part)

    n, reached = total(full, "n"), total(full, "CONVERGED")
    return [
        value,
        str(n),
        str(n - total(once, "CONVERGED")),
        str(n - reached),
        f"{100.0 * reached / n:.3f}",
        str(total(full, "OUT_OF_DOMAIN")),
        str(total(once, "false") + total(full, "false")),
        str(total(once, "violated") + total(full, "violated")),
        f"{1e3 * max(entry['largest'] for entry in full):.2g}",
        f"{total(full, 'seconds'):.3g} s / {total(once, 'seconds'):.3g} s",
    ]


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the study and write the report."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", required=True, help="folder of the report")
    parser.add_argument("--robots", nargs="+", choices=ROBOTS, default=[*ROBOTS])
    parser.add_argument("--targets", type=int, default=20_000, help="in all; default: 20000")
    parser.add_argument("--seed", type=int, default=0, help="of the draws; default: 0")
    given = parser.parse_args(arguments)

    def shown(what: str, done: int, total: int) -> None:
        print(f"{done}/{total} {what}", file=sys.stderr)

    robots = {name: ROBOTS[name] for name in given.robots}
    entries = study(robots, given.targets, random_state=given.seed, progress=shown)
    for path in reachable_report(entries).write(given.out):
        print(path)


if __name__ == "__main__":
    main()
