"""Control loops among random obstacles: do they keep every limit, and the body clear?

    python examples/studies/obstacles.py --out results/obstacles
    python examples/studies/obstacles.py --ticks 1000000 --out results/obstacles  # some minutes
    python examples/studies/obstacles.py --rest 100 --out results/obstacles

Simulated. For every kind of model and set of limits, robots start free among one to six random
spheres, capsules, boxes and half-spaces, and follow random targets, many of them out of reach or in
an obstacle, for 400 periods each. Commands are computed in the compiled core, in torch and by the
exported controller, and each of them is judged by torch: the largest excess of a limit, the deepest
penetration of the gap that must be kept, targets that are called CONVERGED and are not, and NaN.

With ``--rest`` robots of some kinds get one target for 1500 periods. They are at rest if none
of the last 300 steps exceeds 1e-4 of the range of q. `solve` searches from the same start.
"""

from __future__ import annotations

import argparse
import ctypes
import subprocess
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    Hysteresis,
    IKStatus,
    InverseKinematics,
    RigidChain,
    native,
    obstacles,
    robots,
)

PERIODS = 400  # of one robot among its obstacles
TARGETS = 4
MOST_OBSTACLES = 6
DT = 0.01  # [s]
HELD = 1500  # periods of a target that is held
LATE = 300  # of these, at the end
AWAY = obstacles.Sphere([900.0, 900.0, 900.0], 0.1)  # in place of one that is not there
TENDONS = {"lengths": [0.08, 0.08, 0.06], "routing": "base"}
LINK = '<link name="l{0}"/>'
JOINT = (
    '<joint name="j{1}" type="revolute"><parent link="l{0}"/><child link="l{1}"/>'
    '<origin xyz="0.02 0 0.15"/><axis xyz="{2}"/>'
    '<limit lower="-2.5" upper="2.5" effort="1" velocity="2"/></joint>'
)


@dataclass
class Robot:
    """A robot, the limits of its q, a free start, and its body."""

    model: object
    q_min: float
    q_max: float
    start: NDArray
    body_points: object
    reach: float


@dataclass
class Count:
    """What was seen of one kind of model and set of limits, with one program."""

    ticks: int = 0
    penetration: float = 0.0  # [m]
    excess: float = 0.0  # of limits, relative to the range of q
    false_converged: int = 0
    not_numbers: int = 0
    seconds: float = 0.0
    statuses: Counter = field(default_factory=Counter)


def main() -> None:
    """Run all cases, and write a table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--ticks", type=int, default=20_000, help="in all, in the compiled core")
    parser.add_argument("--rest", type=int, default=0, help="targets of every robot, held")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("results/obstacles"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    options.out.mkdir(parents=True, exist_ok=True)
    made = all_robots()
    if options.rest > 0:
        rows = [REST_HEAD]
        for name in ("trunk", "tendons", "elastic tendons", "arm of 7 joints"):
            rows.append(rest_among(name, made[name], options.rest, options.seed))
            print(rows[-1], flush=True)
        (options.out / "rest.md").write_text("\n".join(rows) + "\n")
        return
    cases = [(name, limits) for name in made for limits in limit_sets(made[name], name)]
    rows = [HEAD]
    for name, limits in cases:
        robot = made[name]
        settings = limit_sets(robot, name)[limits]
        for program, share in (("core", 1.0), ("C", 1.0), ("torch", 0.005)):
            ticks = int(share * options.ticks / len(cases))
            count = run(robot, settings, program, max(ticks, PERIODS), options.seed)
            rows.append(as_row(name, limits, program, count))
            print(rows[-1], flush=True)
    table = "\n".join(rows) + "\n"
    (options.out / "obstacles.md").write_text(table)


def all_robots() -> dict[str, Robot]:
    """Return the robots by name."""
    trunk = robots.bionic_handling_assistant()
    plain = ConstantCurvatureChain([0.012, 0.010, 0.008], **TENDONS)
    elastic = ElasticTendonChain([0.012, 0.010, 0.008], **TENDONS)
    axes = ["0 0 1", "0 1 0"] * 3 + ["0 0 1"]
    links = "".join(LINK.format(k) for k in range(8))
    joints = "".join(JOINT.format(k, k + 1, axis) for k, axis in enumerate(axes))
    arm = RigidChain.from_urdf(f'<robot name="arm">{links}{joints}</robot>', "l7")
    balls = [(float(k), 0.05) for k in range(1, 8)]
    draw = np.random.default_rng(1)
    q = draw.uniform(0.15, 0.35, (800, 9))
    plant = ConstantCurvatureChain([0.104, 0.095, 0.077])
    x = plant(torch.from_numpy(q)).numpy() + 0.001 * draw.normal(size=(800, 3))
    network = ELMRegressor(100, random_state=0)
    hybrid = HybridForwardModel(trunk, network).fit(q, x)
    backlash = HybridForwardModel(trunk, "linear", hysteresis=Hysteresis.backlash(0.002)).fit(q, x)
    upright = np.full(9, 0.25)
    return {
        "trunk": Robot(trunk, 0.15, 0.35, upright, 8, 0.75),
        "hybrid trunk": Robot(hybrid, 0.15, 0.35, upright, 8, 0.75),
        "trunk with backlash": Robot(backlash, 0.15, 0.35, upright, 8, 0.75),
        "tendons": Robot(plain, -0.02, 0.02, np.zeros(9), 10, 0.22),
        "elastic tendons": Robot(elastic, -0.02, 0.005, np.zeros(9), 10, 0.22),
        "arm of 7 joints": Robot(arm, -2.5, 2.5, np.full(7, 0.2), balls, 1.05),
    }


def limit_sets(robot: Robot, name: str) -> dict[str, dict]:
    """Return sets of limits by name; a robot with hysteresis has no other weights."""
    span = robot.q_max - robot.q_min
    tip = tip_of(robot)
    plane = ([[0.3, 0.1, 1.0]], [float(np.dot([0.3, 0.1, 1.0], tip)) + 0.05 * robot.reach])
    return {
        "speed": {"dq_max": 2.0 * span},
        "none but of q": {"dq_max": np.inf},
        "speed, acceleration": {"dq_max": 2.0 * span, "ddq_max": 10.0 * span},
        "speed, half-space": {"dq_max": 2.0 * span, "tip_limits": plane},
    }


def tip_of(robot: Robot) -> NDArray:
    """Return the tip at the start (3,) [m]."""
    ik = InverseKinematics(robot.model, q_min=robot.q_min, q_max=robot.q_max)
    x, _ = ik.settings.evaluate(torch.from_numpy(robot.start)[None])
    return x[0].numpy()


def scene_about(robot: Robot, tip: NDArray, draw: np.random.Generator) -> list:
    """Return one to six random obstacles."""
    scene = []
    size = robot.reach
    for _ in range(draw.integers(1, MOST_OBSTACLES + 1)):
        way = draw.normal(size=3)
        way /= np.linalg.norm(way)
        center = draw.uniform(0.3, 1.1) * tip + draw.uniform(0.2, 0.7) * size * way
        kind = draw.integers(4)
        if kind == 0:
            scene.append(obstacles.Sphere(center, size * draw.uniform(0.02, 0.15)))
        elif kind == 1:
            end = center + 0.3 * size * draw.normal(size=3)
            scene.append(obstacles.Capsule(center, end, size * draw.uniform(0.005, 0.05)))
        elif kind == 2:
            turn, _ = np.linalg.qr(draw.normal(size=(3, 3)))
            turn *= np.sign(np.linalg.det(turn))
            scene.append(obstacles.Box(center, size * draw.uniform(0.02, 0.3, 3), turn))
        else:
            normal = tip - center
            scene.append(obstacles.HalfSpace(normal, float(normal @ (center - 0.3 * normal))))
    return scene + [AWAY] * (MOST_OBSTACLES - len(scene))


def run(robot: Robot, settings: dict, program: str, ticks: int, seed: int) -> Count:
    """Return what was seen of a program."""
    draw = np.random.default_rng(seed)
    tip = tip_of(robot)
    ik = InverseKinematics(
        robot.model,
        q_min=robot.q_min,
        q_max=robot.q_max,
        dt=DT,
        obstacles=[AWAY] * MOST_OBSTACLES,
        body_points=robot.body_points,
        clearance=0.01 * robot.reach,
        **settings,
    )
    clear = ik.settings.clear
    start = torch.from_numpy(robot.start)[None]
    count = Count()
    follow = FOLLOWERS[program](ik, robot.start)
    while count.ticks < ticks:
        scene = scene_about(robot, tip, draw)
        numbers = torch.stack([obstacle.numbers for obstacle in scene])
        if float(clear.smallest(start, numbers)) < 0.0:
            continue
        places = tip + 0.5 * robot.reach * draw.normal(size=(TARGETS, 3))
        targets = places.repeat(PERIODS // TARGETS, axis=0)
        begin = time.process_time()
        q, effective, status, error = follow(scene, targets)
        count.seconds += time.process_time() - begin
        judge(count, ik, robot, numbers, q, effective, status, error)
    return count


def judge(
    count: Count,
    ik: InverseKinematics,
    robot: Robot,
    scene: torch.Tensor,
    q: NDArray,
    effective: NDArray,
    status: NDArray,
    error: NDArray,
) -> None:
    """Add what was seen of one robot: commands q, what its actuators did, statuses, errors."""
    settings = ik.settings
    span = robot.q_max - robot.q_min
    commands = np.vstack([robot.start, q])
    steps = np.diff(commands, axis=0)
    change = np.diff(np.vstack([np.zeros_like(robot.start), steps]), axis=0)
    gaps = settings.clear.smallest(torch.from_numpy(effective), scene).numpy()
    beyond = [
        robot.q_min - q,
        q - robot.q_max,
        abs(steps) - DT * settings.dq_max.numpy(),
        abs(change) - DT**2 * settings.ddq_max.numpy(),
    ]
    count.ticks += len(q)
    count.penetration = max(count.penetration, float(-gaps.min()))
    count.excess = max(count.excess, max(float(part.max()) for part in beyond) / span)
    count.not_numbers += int(np.isnan(q).any(1).sum())
    converged = status == IKStatus.CONVERGED
    before = np.concatenate([[np.inf], gaps[:-1]])
    count.false_converged += int((converged & ((error > 1e-4) | (before < -1e-6))).sum())
    names = [IKStatus(int(code)).name for code in status[status >= 0]]
    count.statuses.update(names)


def rest_among(name: str, robot: Robot, n_targets: int, seed: int) -> str:
    """Return a row of the table of targets that are held, for targets that obstacles block."""
    draw = np.random.default_rng(seed)
    tip = tip_of(robot)
    span = robot.q_max - robot.q_min
    late = []
    ratios = []
    gaps = []
    while len(late) < n_targets:
        scene = scene_about(robot, tip, draw)
        ik = InverseKinematics(
            robot.model,
            q_min=robot.q_min,
            q_max=robot.q_max,
            dq_max=span,
            dt=DT,
            obstacles=scene,
            body_points=robot.body_points,
        )
        clear = ik.settings.clear
        start = torch.from_numpy(robot.start)[None]
        target = tip + 0.5 * robot.reach * draw.normal(size=3)
        if float(clear.smallest(start, clear.scene)) < 0.0:
            continue
        tracker = ik.tracker(robot.start)
        steps = []
        q = robot.start
        for _ in range(HELD):
            new = tracker.step(target)
            steps.append(abs(new - q).max() / span)
            q = new
        if tracker.status != IKStatus.BLOCKED:
            continue
        solution = ik.solve(target, q0=robot.start, restarts=0)
        late.append(max(steps[-LATE:]))
        ratios.append(tracker.error / float(solution.error))
        gaps.append(float(clear.smallest(torch.from_numpy(q)[None], clear.scene)))
    at_rest = np.mean(np.array(late) <= 1e-4)
    near = np.mean(np.array(ratios) <= 1.05)
    return (
        f"| {name} | {n_targets} | {at_rest:.2f} | {max(late):.1e} | {near:.2f} | {min(gaps):.1e} |"
    )


class InPython:
    """A tracker of NumPy arrays in the compiled core, or of tensors in torch."""

    def __init__(self, ik: InverseKinematics, start: NDArray) -> None:
        self.tracker = ik.tracker(self.array(start))
        self.start = start

    @staticmethod
    def array(values: NDArray) -> NDArray | torch.Tensor:
        """Return an array for the tracker."""
        return values

    def __call__(self, scene: list, targets: NDArray) -> tuple[NDArray, ...]:
        """Return commands, what the actuators did, statuses and errors."""
        tracker = self.tracker
        tracker.reset(self.array(self.start))
        tracker.obstacles = scene
        rows = []
        for k, target in enumerate(targets):
            q = np.asarray(tracker.step(self.array(target)))
            code = -1
            if k % 20 == 19:  # the status evaluates the body
                code = int(tracker.status)
            rows.append((q, np.asarray(tracker.effective), code, float(tracker.error)))
        q, effective, status, error = map(np.array, zip(*rows, strict=True))
        return q, effective, status, error


class InTorch(InPython):
    """The same in torch."""

    @staticmethod
    def array(values: NDArray) -> torch.Tensor:
        """Return a tensor."""
        return torch.from_numpy(values)


class Exported:
    """The exported controller, as a shared library; it has no statuses."""

    def __init__(self, ik: InverseKinematics, start: NDArray) -> None:
        self.n = len(start)
        self.start = start
        self.ik = ik
        self.folder = tempfile.TemporaryDirectory()
        folder = Path(self.folder.name)
        native.export_c(ik, folder, name="robot")
        build = ["cc", "-std=c99", "-O2", "-shared", "-fPIC", "robot.c", "-lm", "-o", "robot.so"]
        subprocess.run(build, cwd=folder, check=True)
        self.library = ctypes.CDLL(str(folder / "robot.so"))
        self.state = np.zeros(200_000)

    def __call__(self, scene: list, targets: NDArray) -> tuple[NDArray, ...]:
        """Return commands, what the actuators did, and neither statuses nor errors."""
        place = ctypes.c_void_p(self.state.ctypes.data)
        self.library.robot_reset(place, ctypes.c_void_p(self.start.ctypes.data))
        for k, obstacle in enumerate(scene):
            numbers = np.ascontiguousarray(obstacle.numbers.numpy())
            self.library.robot_obstacle(place, k, ctypes.c_void_p(numbers.ctypes.data))
        q = np.empty((len(targets), self.n))
        for k, target in enumerate(targets):
            self.library.robot_step(place, ctypes.c_void_p(target.ctypes.data), None, None)
            q[k] = self.state[: self.n]
        effective = self.effective(q)
        none = np.full(len(q), -1)
        return q, effective, none, np.zeros(len(q))

    def effective(self, q: NDArray) -> NDArray:
        """Return what the actuators do after commands q."""
        hysteresis = self.ik.settings.task.hysteresis
        if not hysteresis:
            return q
        _, state = hysteresis.apply(torch.from_numpy(self.start)[None], None, 0.0)
        rows = []
        for command in torch.from_numpy(q):
            done, state = hysteresis.apply(command[None], state, DT)
            rows.append(done)
        return torch.cat(rows).numpy()


FOLLOWERS = {"core": InPython, "C": Exported, "torch": InTorch}
REST_HEAD = (
    "| robot | blocked targets | at rest | largest late step [of the range] | within 5 % of solve "
    "| least gap [m] |\n|---|---|---|---|---|---|"
)
HEAD = (
    "| robot | limits | program | ticks | deepest in the gap [m] | beyond limits [of the range] "
    "| false CONVERGED | NaN | µs per tick | outcomes |\n|---|---|---|---|---|---|---|---|---|---|"
)


def as_row(name: str, limits: str, program: str, count: Count) -> str:
    """Return a row of the table."""
    seen = ", ".join(f"{n} {status}" for status, n in count.statuses.most_common())
    each = 1e6 * count.seconds / count.ticks
    worst = f"{count.penetration:.1e} | {count.excess:.1e}"
    wrong = f"{count.false_converged} | {count.not_numbers}"
    case = f"{name} | {limits} | {program} | {count.ticks}"
    return f"| {case} | {worst} | {wrong} | {each:.1f} | {seen} |"


if __name__ == "__main__":
    main()
