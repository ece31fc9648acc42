"""Single precision against double precision, for every kind of model that can be saved.

Both are given the same numbers, rounded to float32, so that the differences are those of the
computation. Estimators compute in double precision and round; modules compute as they are cast.
Seed 0.
"""

from __future__ import annotations

import copy
from collections.abc import Iterator
from typing import Any

import numpy as np
import torch
from _line import Line
from numpy.typing import NDArray
from saved_models import elastic_chain, models, predictions, trunk, trunk_log
from sklearn.base import clone

from hybridkin import HybridForwardModel, InverseKinematics, calibrate, trajectories
from hybridkin.native import backend

ROUNDING = 1e-7  # of a float32
KINDS = 12  # of models, at least, that a line must have compared


def examine(full: bool) -> Iterator[Line]:
    made = models()
    yield _predictions(made)
    yield _modules(made)
    yield _fits(made)
    yield _calibrations()
    yield from _inverse(2000 if full else 200)


def _far(found: Any, expected: Any) -> float:
    """Return the largest difference over the largest number."""
    found, expected = (np.asarray(value, np.float64) for value in (found, expected))
    same = found == expected  # infinite radii among them
    return float(
        np.where(same, 0.0, abs(found - expected)).max() / abs(expected[~same]).max(initial=1e-30)
    )


def _worst(differences: dict[str, float]) -> str:
    name = max(differences, key=lambda key: np.nan_to_num(differences[key], nan=np.inf))
    return f"{len(differences)} kinds, largest relative difference {differences[name]:.1e} ({name})"


def _below(differences: dict[str, float], bound: float) -> bool:
    """Return whether there are differences and all are below a bound, which a NaN is not."""
    return len(differences) >= KINDS and all(value < bound for value in differences.values())


def _predictions(made: dict[str, tuple[Any, NDArray]]) -> Line:
    differences, types = {}, set()
    for name, (model, q) in made.items():
        if isinstance(model, torch.nn.Module):
            continue
        rounded = q.astype(np.float32)
        double, single = predictions(model, rounded.astype(float)), predictions(model, rounded)
        types |= {single[key].dtype.name for key in single if key != "in_domain"}
        differences[name] = float(np.max([_far(single[key], double[key]) for key in double]))
    holds = types == {"float32"} and _below(differences, 10 * ROUNDING)
    return Line(
        "Estimators: tips, Jacobians, domain and radius, < 1e-6", _worst(differences), holds
    )


def _modules(made: dict[str, tuple[Any, NDArray]]) -> Line:
    differences, types = {}, set()
    for name, (model, q) in made.items():
        module = model if isinstance(model, torch.nn.Module) else model.module_
        double, single = copy.deepcopy(module).double(), copy.deepcopy(module).float()
        rounded = torch.from_numpy(q).float()
        pairs = zip(
            single.forward_and_jacobian(rounded),
            double.forward_and_jacobian(rounded.double()),
            strict=True,
        )
        pairs = [(a.numpy(force=True), b.numpy(force=True)) for a, b in pairs]
        types |= {a.dtype.name for a, _ in pairs}
        differences[name] = float(np.max([_far(a, b) for a, b in pairs]))
    holds = types == {"float32"} and _below(differences, 1e-3)
    return Line("Modules cast to float32: tips and Jacobians, < 1e-3", _worst(differences), holds)


def _fits(made: dict[str, tuple[Any, NDArray]]) -> Line:
    q, x, groups = trunk_log()
    q, x = q.astype(np.float32), x.astype(np.float32)
    differences = {}
    for name, (model, rows) in made.items():
        settings = isinstance(model, HybridForwardModel) and model.get_params(deep=False)
        if not settings or rows.shape != q.shape or settings["output"] == "pose":
            continue
        if name.startswith(("rigid", "adapted")):  # of another robot, or of another day
            continue
        single = clone(model).fit(q, x, groups=groups)
        double = clone(model).fit(q.astype(float), x.astype(float), groups=groups)
        if single.predict(q).dtype != np.float32:
            differences[name] = np.inf
        else:
            differences[name] = _far(single.predict(q), double.predict(q.astype(float)))
    holds = _below(differences, 10 * ROUNDING)
    return Line("Hybrids fitted to float32 rows, < 1e-6", _worst(differences), holds)


def _calibrations() -> Line:
    q, x, _ = trunk_log()
    q, x = (torch.from_numpy(rows).float() for rows in (q, x))
    single = calibrate(trunk(), q, x, ("radii", "offsets"))
    double = calibrate(trunk(), q.double(), x.double(), ("radii", "offsets"))
    difference = abs(single.rmse / double.rmse - 1.0)
    return Line(
        "calibrate of float32 rows, < 1e-6", f"rmse differs by {difference:.1e}", difference < 1e-6
    )


def _inverse(n_targets: int) -> Iterator[Line]:
    rng = np.random.default_rng(0)
    for name, chain, limits in (
        ("trunk", trunk(dtype=torch.float32), {"q_min": 0.15, "q_max": 0.35}),
        ("elastic tendons", elastic_chain(dtype=torch.float32), {"q_min": -0.003, "q_max": 0.003}),
    ):
        low, high = (np.float32(limits[key]) for key in ("q_min", "q_max"))
        q = rng.uniform(low, high, (n_targets, chain.n_actuators)).astype(np.float32)
        targets = chain(torch.from_numpy(q))
        ik = InverseKinematics(chain, **limits)
        path = trajectories.line(targets[0].numpy(), targets[1].numpy(), duration=1.0)
        for kind, of in (("compiled", np.asarray), ("torch", torch.as_tensor)):
            what = f"{name}, {kind}: limits and type kept, >= 99 % of reachable targets reached"
            if kind == "compiled" and backend(chain) != "compiled":
                yield Line(what, backend(chain), None)
                continue
            solution = ik.solve(of(targets))
            track = ik.track(of(path.x.astype(np.float32)), path.t, q0=of(q[0]))
            moves = [np.asarray(part) for part in (solution.q, track.q)]
            kept = all(((part >= low) & (part <= high)).all() for part in moves)
            single = all(part.dtype == np.float32 for part in moves)
            share = np.asarray(solution.converged).mean()
            yield Line(
                what,
                f"n = {n_targets}, seed 0: {100 * share:.2f} % reached",
                bool(kept and single and share >= 0.99),
            )
