"""Models of the study `compiled`, with the limits of their actuators."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    RigidChain,
    datasets,
    robots,
)

_TRAINING_ROWS, _NEW_ROWS = 600, 20


class Case(NamedTuple):
    """A model and the limits of its actuators (n,)."""

    model: Any
    low: NDArray
    high: NDArray


def limited(chain: Any, low: float, high: float) -> Case:
    """Return a chain whose actuators all have the same limits."""
    ones = np.ones(chain.n_actuators)
    return Case(chain, low * ones, high * ones)


def _tendons(largest: float) -> Case:
    chain = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3, routing="base")
    return limited(chain, -largest, largest)


def _elastic(n_segments: int, each: int = 3) -> Case:
    radii, lengths = [0.02] * n_segments, [0.1] * n_segments
    return limited(ElasticTendonChain(radii, lengths, n_actuators=each), -0.02, 0.02)


def _arm() -> Case:
    """Return an arm of six joints, the second of them a slide."""
    rng = np.random.default_rng(0)
    origins = np.stack([np.eye(4)] * 6)
    origins[:, :3, 3] = 0.2 * rng.normal(size=(6, 3))
    kinds = ["revolute", "prismatic", *["revolute"] * 4]
    return limited(RigidChain(origins, rng.normal(size=(6, 3)), kinds=kinds), -1.5, 1.5)


def _hybrid(error_model: Any = None, *, drifts: bool = False, **options: Any) -> Case:
    """Return a hybrid of the simulated trunk, within the range of its training rows."""
    data = datasets.load_trunk()
    order = np.random.default_rng(0).permutation(len(data.q))
    rows = order[:_TRAINING_ROWS] if error_model != "auto" else np.arange(len(data.q))
    q, x = data.q[rows], data.x[rows]
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, error_model, random_state=0, **options).fit(q, x)
    if drifts:
        new = order[-_NEW_ROWS:]
        model.partial_fit(data.q[new], data.x[new] + 0.01)
    return Case(model.module_, q.min(0), q.max(0))


def _data_alone() -> Case:
    data = datasets.load_trunk()
    model = HybridForwardModel(None, random_state=0).fit(data.q[:600], data.x[:600])
    return Case(model.module_, data.q.min(0), data.q.max(0))


CASES: dict[str, Callable[[], Case]] = {
    "trunk": lambda: limited(robots.bionic_handling_assistant(), 0.1, 0.4),
    "tendons": lambda: _tendons(0.02),
    "tendons, bends to 4 pi": lambda: _tendons(4.0 * np.pi * 0.02),
    "elastic, 6 tendons": lambda: _elastic(2),
    "elastic, 9 tendons": lambda: _elastic(3),
    "elastic, 12 tendons": lambda: _elastic(3, 4),
    "rigid arm": _arm,
    "ELM, no guard": lambda: _hybrid(guard=None),
    "ELM, leverage guard": lambda: _hybrid(),
    "ELM, drift": lambda: _hybrid(drifts=True),
    "serial quadratic": lambda: _hybrid("quadratic", coupling="serial"),
    "serial hidden": lambda: _hybrid(ELMRegressor(random_state=0), coupling="serial"),
    "pose features": lambda: _hybrid("pose"),
    "serial pose features": lambda: _hybrid("pose", coupling="serial"),
    "kernel ridge": lambda: _hybrid("kernel"),
    "data alone, ELM": _data_alone,
    "blend": lambda: _hybrid("auto", calibrate="default"),
    "blend, drift": lambda: _hybrid("auto", calibrate="default", drifts=True),
}
"""Models by name; the blends take half a minute each to fit."""
