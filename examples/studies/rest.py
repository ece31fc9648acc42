"""Targets out of reach, and singular starts: where trackers come to rest.

The tables of the docs page "Reliability report" and ``docs/data/rest.csv``::

    python examples/studies/rest.py --csv docs/data/rest.csv

Ten minutes; ``--targets 10`` takes one. Starts are drawn evenly within the limits (seed 1). A
target lies 2 mm, 20 mm or far (three times the reach from the base) beyond the point where a local
search ends that starts elsewhere. Targets that `solve` reaches from other starts do not count. The
tracker gets each target for 1500 periods of 10 ms. It is at rest if none of the last 300 steps
exceeds 1e-4 of the range. mink and Pink track targets of the arm with seven joints where they are
installed.
"""

from __future__ import annotations

import argparse
import csv
import warnings
from collections.abc import Callable, Iterator
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from ik_peers import ARMS, Arm
from numpy.typing import NDArray

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    robots,
)
from hybridkin.ik.tasks import PointsTask, PoseTask

TICKS, LAST = 1500, 300
BEYOND = {"2 mm": 0.002, "20 mm": 0.02, "far": np.inf}  # [m]
AT_REST, NEAR = 1e-4, 1.05
SPEEDS = {
    "none": {},
    "dq_max": {"dq_max": 0.5},
    "ddq_max": {"dq_max": 0.5, "ddq_max": 2.0},
}
HEADER = ("robot", "limit", "beyond", "targets", "at rest", "largest late step")
HEADER += ("within 5 % of the local minimum", "within 5 % of solve", "backend")
SINGULAR = (
    "robot",
    "singular start",
    "reachable targets",
    "reached",
    "moved where out of reach",
)


class Kind(NamedTuple):
    """A robot with limits of q, and perhaps a singular configuration."""

    name: str
    model: Any
    low: float | NDArray
    high: float | NDArray
    singular: NDArray | None = None

    def ik(self, speed: str = "none") -> InverseKinematics:
        """Return inverse kinematics; limits of motion are multiples of the range."""
        span = np.subtract(self.high, self.low)
        limits = {name: share * span for name, share in SPEEDS[speed].items()}
        return InverseKinematics(self.model, q_min=self.low, q_max=self.high, **limits)


def kinds() -> Iterator[Kind]:
    """Yield robots of ten kinds."""
    trunk = robots.bionic_handling_assistant()
    tendons = {n: ConstantCurvatureChain([0.01] * n, lengths=[0.1] * n) for n in (2, 3)}
    for n, words in ((2, "two"), (3, "three")):
        yield Kind(f"{words} tendon segments", tendons[n], -0.02, 0.02, np.zeros(3 * n))
    yield Kind("trunk", trunk, 0.1, 0.4, np.full(9, 0.25))
    low, high = np.repeat([0.05, -0.02], 3), np.repeat([0.2, 0.02], 3)
    mixed = ConstantCurvatureChain([0.02, 0.03], lengths=[None, 0.1])
    yield Kind("chamber and tendon segment", mixed, low, high)
    q = np.random.default_rng(0).uniform(0.1, 0.4, (300, 9))
    x = trunk(torch.from_numpy(q)).numpy() + 0.02 * np.sin(5.0 * q[:, :3])
    hybrid = HybridForwardModel(trunk, "quadratic", coupling="serial").fit(q, x)
    yield Kind("hybrid trunk", hybrid, 0.1, 0.4)
    for n, words in ((2, "two"), (3, "three")):
        elastic = ElasticTendonChain([0.01] * n, lengths=[0.1] * n)
        yield Kind(f"{words} elastic segments", elastic, -0.02, 0.02)
    origins = np.tile(np.eye(4), (6, 1, 1))
    origins[1:, 0, 3] = 0.2
    planar = RigidChain(origins[:4], [[0, 0, 1]] * 4, tool=[0.2, 0.0, 0.0])
    yield Kind("planar arm", planar, -2.0, 2.0, np.zeros(4))
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]]
    six = RigidChain(origins, axes, tool=[0.1, 0.0, 0.0])
    yield Kind("six joints", six, -2.5, 2.5, np.zeros(6))
    arm = seven_joints()
    yield Kind("seven joints", RigidChain.from_urdf(arm.urdf(), "tip"), *arm.limits)
    yield Kind("trunk, poses", PoseTask(trunk), 0.1, 0.4)
    yield Kind("tendon segments, two points", PointsTask(tendons[2], [1.0, 2.0]), -0.02, 0.02)


def seven_joints() -> Arm:
    """Return the arm with seven joints of the comparison with mink and Pink."""
    return next(arm for arm in ARMS.values() if len(arm.joints) == 7)


def targets(kind: Kind, n: int, beyond: float) -> tuple[NDArray, NDArray]:
    """Return starts and targets out of reach."""
    ik = kind.ik()
    rng = np.random.default_rng(1)
    size = ik.settings.n_actuators
    low, high = (np.broadcast_to(end, size) for end in (kind.low, kind.high))
    q = rng.uniform(low, high, (n, size))
    with torch.no_grad():
        x = ik.settings.evaluate(torch.from_numpy(q))[0].numpy()
    places = (slice(None), slice(3), 3) if ik.settings.task.has_rotation else ...
    points = x[places].reshape(n, -1, 3)
    outwards = points / np.linalg.norm(points, axis=-1, keepdims=True)
    far = x.copy()
    far[places] = (3.0 * np.abs(x).max() * outwards).reshape(x[places].shape)
    if not np.isfinite(beyond):
        return q[::-1].copy(), far
    nearest = ik.solve(far, q, restarts=0).x.copy()
    way = (far - nearest)[places].reshape(n, -1)
    way *= beyond / np.linalg.norm(way, axis=1, keepdims=True)
    nearest[places] += way.reshape(x[places].shape)
    out = ik.solve(nearest).error > 0.5 * beyond
    return q[::-1][out], nearest[out]


def late_steps(follow: Callable[[NDArray], NDArray], q: NDArray, target: NDArray) -> tuple:
    """Return where a tracker ends, and its largest late step of every actuator."""
    late = np.zeros_like(q)
    for k in range(TICKS):
        before = q
        q = follow(target)
        if k >= TICKS - LAST:
            late = np.maximum(late, np.abs(q - before))
    return q, late


def shares_at_rest(kind: Kind, ends: NDArray, goals: NDArray, late: NDArray) -> list[str]:
    """Return the share at rest, the largest late step, and the shares near both minima."""
    free = kind.ik()
    error = free.step(ends, goals).error
    local = free.solve(goals, ends, restarts=0).error
    best = np.minimum(free.solve(goals).error, local)
    shares = [np.mean(late < AT_REST), late.max()]
    shares += [np.mean(error <= NEAR * local), np.mean(error <= NEAR * best)]
    return [f"{share:.3g}" for share in shares]


def rest_line(kind: Kind, speed: str, beyond: str, n: int) -> list[Any]:
    """Return the line of `HEADER` of a robot with limits of motion, for targets beyond reach."""
    span = np.subtract(kind.high, kind.low)
    starts, goals = targets(kind, n, BEYOND[beyond])
    ik, tracker = kind.ik(speed), None
    ends, late = [], []
    for q, goal in zip(starts, goals, strict=True):
        tracker = ik.tracker(q)
        end, step = late_steps(tracker.step, q, goal)
        ends.append(end)
        late.append((step / span).max())
    shares = shares_at_rest(kind, np.array(ends), goals, np.array(late))
    backend = tracker.backend if tracker else ""
    return [kind.name, speed, beyond, len(goals), *shares, backend]


def singular_line(kind: Kind, n: int) -> list[Any]:
    """Return the line of `SINGULAR`: targets on the way to the base, and one beyond the tip."""
    ik = kind.ik()
    q = kind.singular
    tip = ik.step(q, np.zeros(3)).x
    inwards = -tip / np.linalg.norm(tip)
    goals = tip + np.linspace(0.005, 0.3, n)[:, None] * inwards
    reachable = ik.solve(goals).error < 1e-4
    reached = 0
    for goal in goals[reachable]:
        tracker = ik.tracker(q)
        for _ in range(600):
            tracker.step(goal)
        reached += tracker.error < 1e-4
    tracker = ik.tracker(q)
    for _ in range(600):
        end = tracker.step(tip - 10.0 * inwards)
    moved = np.abs(ik.step(end, tip).x - tip).max()
    name = np.array2string(q, precision=2)
    return [
        kind.name,
        name,
        int(reachable.sum()),
        int(reached),
        f"{1e3 * moved:.3g} mm",
    ]


def mink_follower(arm: Arm, q: NDArray) -> Callable[[NDArray], NDArray]:
    """Return mink's tracker with limits of q, whole steps."""
    mink, mujoco = import_module("mink"), import_module("mujoco")
    header = '="arm"><mujoco><compiler fusestatic="false" discardvisual="false"/></mujoco>'
    model = mujoco.MjSpec.from_string(arm.urdf().replace('="arm">', header)).compile()
    configuration = mink.Configuration(model)
    configuration.update(q)
    limits = [mink.ConfigurationLimit(model)]
    task = mink.FrameTask("tip", "body", position_cost=1.0, orientation_cost=0.0)

    def follow(target: NDArray) -> NDArray:
        task.set_target(mink.SE3.from_translation(target))
        speed = mink.solve_ik(configuration, [task], 1.0, "daqp", damping=1e-9, limits=limits)
        configuration.integrate_inplace(speed, 1.0)
        return configuration.q.copy()

    return follow


def pink_follower(arm: Arm, q: NDArray) -> Callable[[NDArray], NDArray]:
    """Return Pink's tracker with limits of q, whole steps."""
    pink, pinocchio = import_module("pink"), import_module("pinocchio")
    model = pinocchio.buildModelFromXML(arm.urdf())
    configuration = pink.Configuration(model, model.createData(), q)
    limits = [pink.limits.ConfigurationLimit(model)]
    task = pink.FrameTask("tip", position_cost=1.0, orientation_cost=0.0)

    def follow(target: NDArray) -> NDArray:
        task.set_target(pinocchio.SE3(np.eye(3), target))
        options = {
            "solver": "daqp",
            "damping": 1e-9,
            "limits": limits,
            "safety_break": False,
        }
        speed = pink.solve_ik(configuration, [task], 1.0, **options)
        configuration.integrate_inplace(speed, 1.0)
        return configuration.q.copy()

    return follow


def peer_lines(n: int) -> Iterator[list[Any]]:
    """Yield lines of mink and Pink for the arm with seven joints, where they are installed."""
    arm = seven_joints()
    low, high = arm.limits
    kind = Kind("seven joints", RigidChain.from_urdf(arm.urdf(), "tip"), low, high)
    followers = {"mink": mink_follower, "pink": pink_follower}
    for program, follower in followers.items():
        try:
            import_module(program)
        except ImportError:
            print(f"{program} is not installed")
            continue
        for beyond, distance in BEYOND.items():
            starts, goals = targets(kind, n, distance)
            late, ends = [], []
            for q, goal in zip(starts, goals, strict=True):
                end, step = late_steps(follower(arm, q), q, goal)
                ends.append(np.clip(end, low, high))
                late.append((step / (high - low)).max())
            shares = shares_at_rest(kind, np.array(ends), goals, np.array(late))
            yield [kind.name, "none", beyond, len(goals), *shares, program]


def main() -> None:
    """Print both tables, and write that of rest as CSV."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--csv", type=Path, required=True)
    parser.add_argument("--targets", type=int, default=100)
    arguments = parser.parse_args()
    warnings.simplefilter("ignore", UserWarning)  # of tendons that are slack
    lines = []
    for kind in kinds():
        for speed in SPEEDS:
            for beyond in BEYOND:
                lines.append(rest_line(kind, speed, beyond, arguments.targets))
                print(*lines[-1], sep="  ", flush=True)
    for line in peer_lines(min(arguments.targets, 30)):
        lines.append(line)
        print(*line, sep="  ", flush=True)
    with open(arguments.csv, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(HEADER)
        writer.writerows(lines)
    print(*SINGULAR, sep="  ")
    for kind in kinds():
        if kind.singular is not None:
            print(*singular_line(kind, arguments.targets), sep="  ", flush=True)


if __name__ == "__main__":
    main()
