"""Hysteresis of any kind, and models with it, for the tests of what uses them."""

from __future__ import annotations

import numpy as np
import torch

from hybridkin import Hysteresis
from hybridkin.hybrid._module import HybridModule


def seven_plays(n, width, seed=0):
    """Return friction of seven plays, with other slopes for every actuator."""
    widths = width * np.array([0.05, 0.1, 0.15, 0.25, 0.5, 1.0, 2.0])
    slopes = np.random.default_rng(seed).uniform(0.2, 1.1, (6, n))
    return Hysteresis.friction(widths, np.sort(slopes, axis=0))


def operators(n, width):
    """Return hysteresis of every kind, by name."""
    backlash = Hysteresis.backlash(width)
    plays = seven_plays(n, width)
    creep = Hysteresis.creep([0.1, 0.05], [0.5, 5.0])
    return {
        "play": backlash,
        "plays": plays,
        "creep": creep,
        "plays, creep": plays | creep,
        "creep, play, plays": creep | backlash | plays,
    }


def random_hysteresis(rng, n, most=4):
    """Return up to four stages of random kinds, in a random order."""
    hysteresis = Hysteresis()
    for kind in rng.integers(3, size=rng.integers(most + 1)):
        size = (n,) if rng.random() < 0.5 else ()
        if kind == 0:
            stage = Hysteresis.backlash(rng.uniform(0.0, 0.5, size))
        elif kind == 1:
            slopes = rng.uniform(0.1, 1.3, (2, *size))
            stage = Hysteresis.friction(np.cumsum(rng.uniform(0.01, 0.3, 3)), slopes)
        else:
            stage = Hysteresis.creep(rng.uniform(0.0, 0.3, (2, *size)), rng.uniform(0.5, 50.0, 2))
        hysteresis = hysteresis | stage
    return hysteresis


def with_hysteresis(module, hysteresis):
    """Return a model whose actuators have a hysteresis."""
    return HybridModule(module, [], torch.zeros(0, dtype=torch.float64), hysteresis=hysteresis)
