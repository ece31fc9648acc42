"""How far two trackers part that differ by rounding, as a tracker and its exported code do.

A step is a continuous function of its state, and equal in all paths to rounding. With limits of
acceleration, and targets that jump before the robot arrives, each step still multiplies a
difference: the motions part as those of a chaotic system, and come together where a target stays.
Run k has the seed k.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from _line import Line
from numpy.typing import NDArray

from hybridkin import InverseKinematics, robots

TRUNK = robots.bionic_handling_assistant()
DT, LOW, HIGH = 0.02, 0.1, 0.4
JUMPING, STAYING = 1000, 500  # periods


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    seeds = range(32 if full else 4)
    yield from _steps(seeds)
    for limited in (True, False):
        for every in (1, 5, 25):
            yield _runs(seeds, every, limited)


def _controller(rng: np.random.Generator, limited: bool) -> InverseKinematics:
    ddq_max = float(rng.choice([0.5, 2.0, 10.0])) if limited else np.inf
    dq_max = float(rng.choice([0.1, 0.3, 1.0]))
    return InverseKinematics(
        TRUNK, q_min=LOW, q_max=HIGH, q_pref=0.25, dt=DT, dq_max=dq_max, ddq_max=ddq_max
    )


def _tips(rng: np.random.Generator, n: int) -> NDArray:
    return TRUNK(torch.from_numpy(rng.uniform(0.12, 0.38, (n, 9)))).numpy()


def _steps(seeds: range) -> Iterator[Line]:
    """Compare single steps from the states that runs come through."""
    growth = {1e-8: [], 1e-6: []}
    paths = []
    for seed in seeds:
        rng = np.random.default_rng(seed)
        ik = _controller(rng, True)
        tracker = ik.tracker(rng.uniform(0.15, 0.35, 9))
        targets = _tips(rng, 200)
        q = np.array([tracker.q] + [tracker.step(x) for x in targets])
        last = np.diff(q, axis=0, prepend=q[:1])[:-1]
        here = ik.step(q[:-1], targets, dq=last).dq
        rows = (torch.from_numpy(a) for a in (q[:-1], targets, last))
        at, goal, before = rows
        in_torch = ik.step(at, goal, dq=before).dq.numpy()
        paths.append(float(np.abs(in_torch - here).max() / np.abs(here).max()))
        direction = rng.standard_normal(last.shape)
        for size, ratios in growth.items():
            change = size * direction
            beside = ik.step(q[:-1] + change, targets, dq=last + change).dq
            ratios.append(np.abs(beside - here).max() / size)
    small, large = (float(np.max(ratios)) for ratios in growth.values())
    n = f"{len(seeds)} runs of 200 targets"
    yield Line(
        "Steps with ddq_max are continuous: they multiply no difference by more than 100",
        f"{n}: at most {small:.1f} times for 1e-8, {large:.1f} times for 1e-6",
        max(small, large) < 100.0,
    )
    yield Line(
        "Steps with ddq_max, core and torch from one state: < 1e-7 of the largest step",
        f"{n}: {max(paths):.1e}",
        max(paths) < 1e-7,
    )


def _runs(seeds: range, every: int, limited: bool) -> Line:
    """Compare runs from starts that differ by 1e-15."""
    apart, errors, together = [], [], []
    within = True
    for seed in seeds:
        pair = []
        for start in (0.0, 1e-15):
            rng = np.random.default_rng(seed)
            ik = _controller(rng, limited)
            q = rng.uniform(0.15, 0.35, 9)
            targets = np.repeat(_tips(rng, JUMPING // every), every, axis=0)
            stays = TRUNK(torch.from_numpy(rng.uniform(0.2, 0.3, (1, 9)))).numpy()
            tracker = ik.tracker(q + start * rng.standard_normal(9))
            run = []
            for x in np.vstack([targets, np.repeat(stays, STAYING, axis=0)]):
                run.append((tracker.step(x), tracker.error))
            pair.append((np.array([q for q, _ in run]), np.mean([e for _, e in run[:JUMPING]])))
        (a, error), (b, other) = pair
        far = np.abs(a - b).max(axis=1) / (HIGH - LOW)
        apart.append(far[:JUMPING].max())
        together.append(far[-1])
        errors.append(abs(error / other - 1.0))
        within &= bool(((b >= LOW) & (b <= HIGH)).all())
    parted = int((np.array(apart) > 0.01).sum())
    return Line(
        f"Targets that jump every {every * DT:g} s, {'with' if limited else 'without'} ddq_max: "
        "limits hold, mean errors differ by < 5 %",
        f"{len(seeds)} runs of {JUMPING} periods: {parted} part by more than 1 % of the range, at "
        f"most {100 * max(apart):.2g} %; {STAYING} periods at one target later "
        f"{100 * max(together):.2g} %; errors differ by {100 * max(errors):.2g} %",
        bool(within and max(errors) < 0.05),
    )
