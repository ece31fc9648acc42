"""A robot that is commanded for long: what it did, checked tick by tick, as JSON.

    python _tracker_soak.py TICKS ROBOT ...

Each robot makes so many ticks. Each block of ticks has other targets:
reachable ones along a path or in jumps, unreachable ones, huge ones, and some that are not finite;
measured tips with an offset that grows, noise and gaps. The hybrid robot is updated by these
measurements block by block. In the end static targets within reach show whether it arrives.
"""

from __future__ import annotations

import copy
import gc
import hashlib
import json
import sys
import time

import numpy as np
import psutil
import torch
from _pace import Pace
from arrival import is_local_minimum
from saved_models import arm, elastic_chain
from tqdm import tqdm

from hybridkin import ELMRegressor, HybridForwardModel, InverseKinematics, datasets, robots
from hybridkin.native import available

BLOCK = 500 if available() else 50
STATIC = 20 if available() else 2  # targets, with ARRIVAL ticks for each
ARRIVAL, CLOSE = 600, 1e-4  # [m]
DT, PROBE = 0.01, 500 if available() else 10  # period [s]; ticks whose time counts
FAR = (3.0, 1e3, 1e100, 1e160, 1.7e308)


def hybrid():
    """The trunk with a learned error, fitted to a part of the shipped log."""
    data = datasets.load_trunk()
    chain, elm = robots.bionic_handling_assistant(), ELMRegressor(30, random_state=0)
    return HybridForwardModel(chain, elm, random_state=0).fit(data.q[::4], data.x[::4])


ROBOTS = {
    "plain chain": (robots.bionic_handling_assistant, {"q_min": 0.12, "q_max": 0.37}),
    "elastic chain": (elastic_chain, {"q_min": -0.004, "q_max": 0.003, "dq_max": 0.02}),
    "hybrid": (hybrid, {"q_min": 0.17, "q_max": 0.33, "dq_max": 0.4, "beta": 5.0}),
    "rigid arm": (
        arm,
        {"q_min": [-2.0, 0.0, -3.0], "q_max": [2.5, 0.4, 3.0], "dq_max": 2.0, "ddq_max": 30.0},
    ),
    "weighed, braked": (
        robots.bionic_handling_assistant,
        {
            "q_min": 0.1,
            "q_max": 0.4,
            "dq_max": 0.3,
            "ddq_max": 4.0,
            "weights": np.arange(1.0, 10.0),
        },
    ),
    "within a box": (
        robots.bionic_handling_assistant,
        {"q_min": 0.1, "q_max": 0.4, "dq_max": 0.3}
        | {"tip_limits": (np.vstack([np.eye(3), -np.eye(3)]), [0.15, 0.12, 0.8, 0.1, 0.2, -0.6])},
    ),
}


def targets_of(rng, chain, low, high):
    """Targets, measured offsets of the tip, and velocities or None, of a block."""
    n = chain.n_actuators
    kind = rng.choice(["path", "jumps", "held", "far"], p=[0.4, 0.3, 0.15, 0.15])
    ends = rng.uniform(low, high, (2 if kind == "path" else BLOCK, n))
    share = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, BLOCK))[:, None]
    q = ends[0] + share * (ends[-1] - ends[0]) if kind == "path" else ends
    x = chain(torch.from_numpy(q)).numpy()
    if kind == "held":
        x[:] = x[0]
    elif kind == "far":
        x = rng.choice(FAR) * rng.uniform(-1.0, 1.0, x.shape)
    dx = np.gradient(x, DT, axis=0) if kind == "path" and rng.random() < 0.5 else None
    noise = 1e-3 * rng.standard_normal(x.shape)
    bad = np.array([np.nan, np.inf, -np.inf])
    for a, often in ((x, 0.01), (noise, 0.05)):
        hit = rng.random(len(a)) < often
        a[hit, rng.integers(3, size=hit.sum())] = rng.choice(bad, hit.sum())
    return x, noise, dx


class Checked:
    """What the commands of a robot did, against its limits."""

    def __init__(self, settings, chain):
        self.settings, self.chain, n = settings, chain, chain.n_actuators
        self.low, self.high = (a.expand(n).numpy() for a in (settings.q_min, settings.q_max))
        self.most = settings.dq_max.expand(n).numpy() * DT
        self.change = settings.ddq_max.expand(n).numpy() * DT**2
        self.found = {"not_finite": 0, "position": 0, "speed": 0.0, "acceleration": 0.0, "tip": 0.0}
        self.found["moved"] = 0  # ticks
        if settings.tip_limits.n:
            self.found["within"] = 0  # ticks whose tip must stay within its half-spaces
        self.digest, self.digests = hashlib.sha256(), []

    def start(self, q):
        """Stand at q."""
        self.q, self.dq, self.was_inside = q, np.zeros_like(q), False

    def take(self, commands):
        """Check a block of commands; speeds and accelerations in units of the last place of q."""
        found, settings = self.found, self.settings
        steps = np.diff(np.vstack([self.q, commands]), axis=0)
        found["not_finite"] += int((~np.isfinite(commands)).sum())
        found["moved"] += int((steps != 0.0).any(axis=1).sum())
        found["position"] += int(((commands < self.low) | (commands > self.high)).sum())
        ulp = np.spacing(np.maximum(abs(self.low), abs(self.high)))
        changes = np.diff(np.vstack([self.dq, steps]), axis=0)
        for name, value, most in (
            ("speed", steps, self.most),
            ("acceleration", changes, self.change),
        ):
            found[name] = max(found[name], float(((abs(value) - most) / ulp).max()))
        if settings.tip_limits.n:
            margin = settings.tip_limits.margin(self.chain(torch.from_numpy(commands))).amin(-1)
            inside = np.logical_or.accumulate(np.append(self.was_inside, margin.numpy() >= 0.0))
            found["within"] += int(inside[:-1].sum())
            beyond = -margin.numpy()[inside[:-1]]
            found["tip"] = max(found["tip"], float(beyond.max(initial=0.0)))
            self.was_inside = bool(inside[-1])
        self.q, self.dq = commands[-1], steps[-1]
        self.digest.update(commands.tobytes())
        self.digests.append(self.digest.hexdigest()[:12])  # of all until now


def probed(tracker, way):
    """Return the CPU time [s] of a tick of a copy of the tracker, with all that it has gathered."""
    twin = copy.deepcopy(tracker)
    twin.step(way[0])
    begin = time.process_time()
    for target in way:
        twin.step(target)
    return (time.process_time() - begin) / len(way)


def missed(ik, chain, checked, rng):
    """Return how many static targets were missed, those at a local minimum of the error apart."""
    elsewhere, minima = 0, 0
    tracker = ik.tracker(0.5 * checked.low + 0.5 * checked.high)
    limits = ik.settings.tip_limits
    for _ in range(STATIC):
        inside = False
        while not inside:
            q = torch.from_numpy(rng.uniform(checked.low, checked.high))
            x = chain(q)
            inside = limits.n == 0 or bool((limits.margin(x[None]) > 0.0).all())
        tracker.reset(0.5 * checked.low + 0.5 * checked.high)
        for _ in range(ARRIVAL):
            end = tracker.step(x.numpy())
        if not tracker.error <= CLOSE:
            at_minimum = is_local_minimum(ik, end, x.numpy())
            minima += at_minimum
            elsewhere += not at_minimum
    return {"targets": STATIC, "minima": minima, "elsewhere": elsewhere}


def soak(robot, ticks, seed):
    """Return what was found."""
    make, settings = ROBOTS[robot]
    rng, model = np.random.default_rng(seed), make()
    learns = isinstance(model, HybridForwardModel)
    chain = model.mechanical_model_ if learns else model
    ik = InverseKinematics(model, dt=DT, **settings)
    checked = Checked(ik.settings, chain)
    checked.start(
        0.5 * checked.low + 0.5 * checked.high + 1e-3 * np.cos(np.arange(len(checked.low)))
    )
    tracker, offset, home = ik.tracker(checked.q, memory=0.5), np.zeros(3), checked.q
    way = chain(torch.from_numpy(home)).numpy() + 0.05 * np.linspace(0.0, 1.0, PROBE)[:, None]
    pace, memory, objects = Pace(), [], []
    every = max(1, ticks // BLOCK // 40)
    for block in tqdm(range(ticks // BLOCK), desc=robot, mininterval=20.0, file=sys.stderr):
        if block % 20 == 19:  # somewhere else, at rest
            checked.start(rng.uniform(checked.low, checked.high))
            tracker.reset(checked.q)
        x, noise, dx = targets_of(rng, chain, checked.low, checked.high)
        offset = 0.99 * offset + 2e-3 * rng.standard_normal(3)
        feed = [None] * BLOCK if dx is None else dx
        with np.errstate(over="ignore", invalid="ignore"):
            tips = x + offset + noise
        seen = [None] * BLOCK if block % 3 == 0 or "tip_limits" in settings else tips
        commands, step = np.empty((BLOCK, len(checked.q))), tracker.step
        for i, (target, speed, tip) in enumerate(zip(x, feed, seen, strict=True)):
            commands[i] = step(target, speed, x_measured=tip)
        pace.add(probed(tracker, way))
        checked.take(commands)
        if learns:
            q = commands[::50]
            model.partial_fit(q, chain(torch.from_numpy(q)).numpy() + offset)
            if block % 4 == 3:  # goes on, from rest, with the model as it is now
                ik = InverseKinematics(model, dt=DT, **settings)
                tracker = ik.tracker(checked.q, memory=0.5)
                checked.start(checked.q)
        if block % every == 0:
            gc.collect()
            memory.append(psutil.Process().memory_info().rss / 2**20)
            objects.append(len(gc.get_objects()))
    few = max(1, len(memory) // 10)
    model_now = ik.settings.task.models[0]
    return checked.found | {
        **missed(ik, model_now, checked, rng),
        "backend": tracker.backend,
        "ticks": len(checked.digests) * BLOCK,
        "digests": checked.digests,
        "us": 1e6 * np.median(pace.seconds),
        "slower": pace.slowdown(),
        "steady": pace.is_steady(),
        # After a first tenth, in which memory is taken that stays.
        "mb": np.median(memory[-few:]) - np.median(memory[few : 2 * few + 1]),
        "objects": np.median(objects[-few:]) - np.median(objects[few : 2 * few + 1]),
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    ticks, *names = sys.argv[1:]
    print(json.dumps([soak(name, int(ticks), 0) for name in names]))
