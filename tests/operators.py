"""Operators of hysteresis of any kind, for the tests of what uses them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from hybridkin import (
    CreepOperator,
    HysteresisSeries,
    PlayOperator,
    PrandtlIshlinskiiOperator,
)


def seven_plays(n, width, seed=0):
    """Return a sum of seven plays, with other slopes for every actuator."""
    widths = width * np.array([0.05, 0.1, 0.15, 0.25, 0.5, 1.0, 2.0])
    slopes = np.random.default_rng(seed).uniform(0.2, 1.1, (6, n))
    return PrandtlIshlinskiiOperator(widths, np.sort(slopes, axis=0))


def operators(n, width):
    """Return operators of every kind, by name."""
    plays = seven_plays(n, width)
    creep = CreepOperator([0.1, 0.05], [0.5, 5.0])
    return {
        "play": PlayOperator(width),
        "plays": plays,
        "creep": creep,
        "plays, creep": HysteresisSeries([plays, creep]),
    }


def with_hysteresis(module, operator):
    """Return a fitted estimator with this module and hysteresis."""
    return SimpleNamespace(module_=module, play_=operator)
