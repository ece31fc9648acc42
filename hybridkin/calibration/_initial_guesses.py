"""Initial guesses of a calibration: base poses, ring turns and handedness that fit the data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from itertools import product
from typing import NamedTuple, TypeVar

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.rotations import rigid_motion
from hybridkin.calibration._least_squares import Rows
from hybridkin.calibration.measured import points
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.chain import Chain

_Chain = TypeVar("_Chain", bound=Chain)

_ROWS = 300
_SCALES = (0.6, 1.0, 1.6)
_TURNS = tuple(0.5 * math.pi * k for k in range(4))
_SWEEPS = 2
_KEPT = 2  # guesses per handedness
_HOPELESS = (
    3.0  # times the error of the best guess, before any fit; worse ones are dropped
)


class Guess(NamedTuple):
    """A chain to start from, a likely factor on its radii, and which rings are mirrored."""

    chain: Chain
    scale: float = 1.0
    mirrored: tuple[bool, ...] = ()


def initial_guesses(chain: Chain, rows: Rows, names: tuple[str, ...]) -> list[Guess]:
    """Return the guesses to try, the given chain first.

    A free base is aligned with the tips. Free rings are turned and mirrored, one after the other.
    If only the base is free, the mirror image of the whole robot is a guess.
    """
    guesses = [Guess(chain)]
    free_base = "base" in names
    if free_base:
        guesses.append(Guess(aligned(chain, rows)))
    if isinstance(chain, ArcChain) and {"angles", "turns"} & {*names}:
        step = max(1, len(rows.q) // _ROWS)
        few = rows.take(slice(None, None, step))
        guesses += _searched(chain, few, free_base, "radii" in names)
    elif free_base and isinstance(chain, ArcChain):
        counts = chain.actuators_per_segment
        mirrored = (True,) * len(counts)
        image = aligned(_ringed(chain, mirrored, np.zeros(len(counts))), rows)
        if rows.rmse(image) < rows.rmse(guesses[-1].chain):
            guesses.append(Guess(image, mirrored=mirrored))
    return guesses


def aligned(chain: _Chain, rows: Rows) -> _Chain:
    """Return the chain at the base pose that aligns predicted and measured tips."""
    x = torch.from_numpy(points(rows.x.numpy())[rows.seen])
    tips = x + torch.from_numpy(rows.residual(chain)).to(x)
    motion = rigid_motion(tips, x, torch.from_numpy(rows.weights).to(x))
    return chain.with_geometry(base=motion @ chain.geometry()["base"])


def _searched(
    chain: ArcChain, rows: Rows, free_base: bool, free_radii: bool
) -> Iterator[Guess]:
    """Yield the best guesses of a search ring by ring, for several scales of the radii."""
    best: dict[tuple, tuple[float, Guess]] = {}
    n_segments = len(chain.actuators_per_segment)
    for scale in _SCALES if free_radii else (1.0,):
        for hand in (False, True):
            choice = [(hand, 0.0)] * n_segments
            score = math.inf
            for _ in range(_SWEEPS):
                for k in range(n_segments):
                    for option in product((hand, not hand), _TURNS):
                        tried = [*choice[:k], option, *choice[k + 1 :]]
                        rms = _chosen(chain, tried, scale, rows, free_base)[1]
                        if rms < score * (1.0 - 1e-9):
                            score = rms
                            choice = tried
            guess, _ = _chosen(chain, choice, scale, rows, free_base)
            key = tuple(choice)
            if key not in best or score < best[key][0]:
                best[key] = (score, guess)
    ranked = sorted(best.values(), key=lambda pair: pair[0])
    hopeful = [guess for score, guess in ranked if score < _HOPELESS * ranked[0][0]]
    for mirrored in (False, True):
        alike = [guess for guess in hopeful if any(guess.mirrored) == mirrored]
        yield from alike[:_KEPT]


def _chosen(
    chain: ArcChain,
    choice: list[tuple[bool, float]],
    scale: float,
    rows: Rows,
    align: bool,
) -> tuple[Guess, float]:
    """Return a guess, and the root mean square tip distance of its chain with scaled radii."""
    mirrored, turns = zip(*choice, strict=True)
    turned = _ringed(chain, mirrored, np.array(turns))
    scaled = _scaled(turned, scale)
    if align:
        scaled = aligned(scaled, rows)
        turned = turned.with_geometry(base=scaled.geometry()["base"])
    return Guess(turned, scale, mirrored), rows.rmse(scaled)


def _ringed(chain: ArcChain, mirrored: tuple[bool, ...], turns: NDArray) -> ArcChain:
    """Return the chain with some rings of actuators mirrored, then all turned."""
    counts = chain.actuators_per_segment
    angles = chain.geometry()["angles"]
    sign = angles.new_tensor(np.repeat(np.where(mirrored, -1.0, 1.0), counts))
    return chain.with_geometry(
        angles=sign * angles + angles.new_tensor(np.repeat(turns, counts))
    )


def _scaled(chain: _Chain, scale: float) -> _Chain:
    if scale == 1.0:
        return chain
    return chain.with_geometry(radii=scale * chain.geometry()["radii"])
