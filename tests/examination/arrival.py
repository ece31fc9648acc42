"""Static targets that are within reach: whether resolved rates arrive, and what is kept on the way.

Targets are the tips of random configurations within the limits, seed 0. Every tracker starts at
rest in the middle of the limits, where a chain is straight, or with all tendons slack, and takes
600 ticks. A target is reached if the error is at most 0.1 mm in each of 20 further ticks.

Some targets are missed at a local minimum of the error, e.g. straight with all tendons pulled to
their limits: of 4000 small motions within the limits none lowers the error. For chains all missed
targets must be such, for hybrids 3 % may be missed elsewhere. Local minima depend on the limits and
the start, not on the step; 3 % of the targets may end there.
"""

from __future__ import annotations

import ctypes
import math
import shutil
import subprocess
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from _line import Line
from numpy.typing import NDArray
from saved_models import elastic_chain, tendon_chain

from hybridkin import (
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    as_forward_model,
    robots,
)
from hybridkin.native import available, export_c

TICKS, HELD, TOL, DT = 600, 20, 1e-4, 0.02  # ticks, ticks at the target, [m], [s]
MISSED = 0.03  # largest share of targets
MOTIONS = 4000  # random small motions that must not lower the error at a local minimum


@dataclass(frozen=True)
class Kind:
    """A model, its limits of q, and its largest speed and acceleration."""

    model: Any
    low: float
    high: float
    start: float  # as a share of the way from low to high

    @property
    def ways(self) -> dict[str, dict]:
        """Return the settings that are examined."""
        span = self.high - self.low
        fast = {"dq_max": 2.5 * span}
        ways = {"default": {}, "gain=5": {"gain": 5.0}, "dq_max": fast}
        return ways | {"ddq_max": {**fast, "ddq_max": 50.0 * span}}


def _three(**options: Any) -> ElasticTendonChain:
    return ElasticTendonChain([0.01] * 3, lengths=[0.1] * 3, **options)


def _hybrid() -> HybridForwardModel:
    """An elastic chain with a learned error, fitted to a simulated robot with other stiffnesses."""
    q = np.random.default_rng(1).uniform(-0.01, 0.01, (300, 9))
    robot = _three(bending_stiffness=2e-6, axial_stiffness=8.0)
    x = robot(torch.from_numpy(q)).numpy()
    return HybridForwardModel(_three(), ELMRegressor(20, random_state=0), random_state=0).fit(q, x)


def _adapted() -> HybridForwardModel:
    """That hybrid on another day: base and zeros have moved."""
    q = np.random.default_rng(2).uniform(-0.009, 0.009, (8, 9))
    turn = np.array([[0.8, -0.6, 0.0], [0.6, 0.8, 0.0], [0.0, 0.0, 1.0]])
    model = _hybrid()
    return model.adapt(q - 2e-4, model.predict(q) @ turn.T + [0.02, 0.0, 0.05])


def kinds() -> dict[str, Kind]:
    """Return ten kinds of models; but for the first two with tendons that can only pull."""
    return {
        "trunk": Kind(robots.bionic_handling_assistant(), 0.1, 0.4, 0.5),
        "plain tendons": Kind(tendon_chain(), -0.004, 0.004, 0.5),
        "elastic": Kind(_three(), -0.01, 0.01, 0.5),
        "all slack": Kind(_three(), -0.01, 0.01, 0.75),
        "sheathed": Kind(_three(routing="segment"), -0.01, 0.01, 0.5),
        "pre-tension": Kind(_three(tendon_zeros=0.002), -0.01, 0.01, 0.5),
        "turned spools": Kind(_three(gains=-0.02), -0.5, 0.5, 0.5),
        "3 + 4 tendons": Kind(elastic_chain(), -0.004, 0.004, 0.5),
        "elastic hybrid": Kind(_hybrid(), -0.01, 0.01, 0.5),
        "adapted hybrid": Kind(_adapted(), -0.01, 0.01, 0.5),
    }


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    made = kinds()
    for name, kind in made.items():
        for way, settings in kind.ways.items():
            ik = InverseKinematics(kind.model, q_min=kind.low, q_max=kind.high, dt=DT, **settings)
            targets = _targets(ik, kind, 1000 if full else 20)
            start = np.full(ik.settings.n_actuators, kind.low + kind.start * (kind.high - kind.low))
            yield _arrives(
                f"{name}, {way}, torch", ik, kind, targets, _in_batch(ik, start, targets)
            )
            for backend, tracker in _trackers(ik):
                line = f"{name}, {way}, {backend}"
                if tracker is None:
                    yield Line(line, "not available here", None)
                else:
                    motions = _one_by_one(tracker, start, targets)
                    yield _arrives(line, ik, kind, targets, motions)


def _targets(ik: InverseKinematics, kind: Kind, count: int) -> NDArray:
    model = as_forward_model(kind.model)
    q = np.random.default_rng(0).uniform(kind.low, kind.high, (count, model.n_actuators))
    with torch.no_grad():
        return model(torch.from_numpy(q)).numpy()


def _trackers(ik: InverseKinematics) -> Iterator[tuple[str, Any]]:
    """Yield the compiled ways to take steps, each a tracker, or None if it is not there."""
    n = ik.settings.n_actuators
    yield "core", ik.tracker(np.zeros(n)) if available() else None
    if shutil.which("cc") is None:
        yield "exported C", None
        return
    with tempfile.TemporaryDirectory() as folder:
        yield "exported C", Exported(ik, Path(folder))


class Exported:
    """The exported controller, compiled, as a tracker."""

    def __init__(self, ik: InverseKinematics, folder: Path) -> None:
        export_c(ik, folder, name="robot")
        library, n = folder / "robot.so", ik.settings.n_actuators
        options = ["-std=c99", "-O2", "-shared", "-fPIC", "-o", library, folder / "robot.c", "-lm"]
        subprocess.run(["cc", *options], check=True)
        real = ctypes.c_double

        class State(ctypes.Structure):
            _fields_ = (
                ("q", real * n),
                ("dq", real * n),
                ("x", real * 3),
                ("error", real),
                ("sigma_min", real),
                ("damping", real),
                ("held", ctypes.c_ubyte * n),
                ("offset", real * 3),
                ("memory", real),
            )

        self._code, self._state = ctypes.CDLL(str(library)), State()
        self._q = np.frombuffer(self._state, np.float64, n)

    def reset(self, q: NDArray) -> None:
        """Start at rest."""
        self._code.robot_reset(ctypes.byref(self._state), ctypes.c_void_p(q.ctypes.data))

    def step(self, target: NDArray) -> NDArray:
        """Return the next command."""
        at = ctypes.c_void_p(target.ctypes.data)
        self._code.robot_step(ctypes.byref(self._state), at, None, None)
        return self._q.copy()

    @property
    def error(self) -> float:
        """Distance of the tip to the target before the last step [m]."""
        return self._state.error


class Motions(NamedTuple):
    """Motions from rest to the targets."""

    commands: NDArray  # (T + 2, N, n), the start twice before all ticks
    distances: NDArray  # (T, N) before each tick [m]


def _one_by_one(tracker: Any, start: NDArray, targets: NDArray) -> Motions:
    """Return the motions of a tracker to targets (N, 3), one after the other."""
    commands = np.tile(start, (TICKS + HELD + 2, len(targets), 1))
    distances = np.empty((TICKS + HELD, len(targets)))
    for i, x in enumerate(targets):
        tracker.reset(start)
        for tick in range(TICKS + HELD):
            commands[tick + 2, i] = tracker.step(x)
            distances[tick, i] = tracker.error
    return Motions(commands, distances)


def _in_batch(ik: InverseKinematics, start: NDArray, targets: NDArray) -> Motions:
    """Return the motions to targets (N, 3), all at once in torch."""
    rows = torch.from_numpy(np.tile(start, (len(targets), 1)))
    places = torch.from_numpy(targets)
    commands, distances, dq = [rows, rows], [], torch.zeros_like(rows)
    for _ in range(TICKS + HELD):
        step = ik.step(commands[-1], places, dq=dq)
        dq = step.dq
        commands.append(commands[-1] + dq)
        distances.append(step.error)
    return Motions(torch.stack(commands).numpy(), torch.stack(distances).numpy())


def _arrives(
    line: str, ik: InverseKinematics, kind: Kind, targets: NDArray, motions: Motions
) -> Line:
    errors = motions.distances[-HELD:].max(axis=0)
    reached = errors <= TOL
    ticks = (motions.distances[:, reached] <= TOL).argmax(axis=0)
    missed = np.flatnonzero(~reached)
    minima = sum(is_local_minimum(ik, motions.commands[-1, i], targets[i]) for i in missed)
    beyond = max(_beyond(ik, motions.commands[:, i]) for i in range(len(targets)))
    figure = f"{reached.sum():,} of {len(targets):,} reached, the median one in "
    figure += f"{np.median(ticks):.0f} ticks; {len(missed)} missed"
    if len(missed):
        figure += f", {minima} of them at a local minimum, largest {1e3 * errors.max():.2g} mm"
    figure += f"; limits exceeded by {max(beyond, 0.0):.2g} ulp of q"
    most = math.ceil(MISSED * len(targets))
    elsewhere = len(missed) - minima
    good = minima <= most and elsewhere <= most * isinstance(kind.model, HybridForwardModel)
    return Line(line, figure, bool(good and beyond <= 1.0))


def _beyond(ik: InverseKinematics, commands: NDArray) -> float:
    """Return how far q, its speed or its acceleration are beyond their limits, in ulp of q."""
    settings = ik.settings
    low, high = settings.q_min.numpy(), settings.q_max.numpy()
    steps = np.diff(commands, axis=0)
    changes = np.diff(steps, axis=0)
    ulp = np.spacing(np.maximum(abs(low), abs(high)))
    outside = np.maximum(low - commands, commands - high).max()
    fast = (abs(steps) - settings.dq_max.numpy() * DT).max()
    sudden = (abs(changes) - settings.ddq_max.numpy() * DT**2).max()
    return math.inf if outside > 0.0 else float((max(fast, sudden) / ulp).max())


def is_local_minimum(ik: InverseKinematics, q: NDArray, target: NDArray) -> bool:
    """Return whether no small motion within the limits lowers the error.

    Random motions of all sizes from 1e-5 to 1e-2 of the limits, of all actuators and of one.
    """
    low, high = ik.settings.q_min.numpy(), ik.settings.q_max.numpy()
    rng = np.random.default_rng(0)
    size = 10.0 ** rng.uniform(-5.0, -2.0, (MOTIONS, 1)) * (high - low)
    ways = rng.uniform(-1.0, 1.0, (MOTIONS, len(q)))
    single = np.eye(len(q))[rng.integers(len(q), size=MOTIONS // 2)]
    ways[: MOTIONS // 2] *= single
    rows = np.clip(q + size * ways, low, high)
    with torch.no_grad():
        x, _ = ik.settings.evaluate(torch.from_numpy(np.vstack([q, rows])))
    errors = np.linalg.norm(x.numpy() - target, axis=1)
    return bool(errors[1:].min() >= errors[0] - 1e-3 * TOL)
