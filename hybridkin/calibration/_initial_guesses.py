"""Initial guesses of a calibration: base poses, ring turns and handedness that fit the data."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cache, partial
from itertools import product
from typing import NamedTuple, TypeVar

import torch
from torch import Tensor

from hybridkin._core.rotations import rigid_motion
from hybridkin.calibration._least_squares import TipRows
from hybridkin.calibration.measured import points
from hybridkin.chains.chain import Chain

_Chain = TypeVar("_Chain", bound=Chain)

_ROWS = 300
_SCALES = (0.6, 1.0, 1.6)
_TURNS = tuple(0.5 * math.pi * k for k in range(4))
_SWEEPS = 2
_MOST = 2  # guesses per handedness
_HOPELESS = 3.0  # times the least error of a guess, before any fit; worse ones are dropped

_Rings = tuple[tuple[bool, float], ...]  # for every ring: mirrored or not, and its turn


class Guess(NamedTuple):
    """A chain to start from, a likely factor on its radii, and whether a ring is mirrored."""

    chain: Chain
    scale: float = 1.0
    mirrored: bool = False


def initial_guesses(chain: Chain, rows: TipRows, names: tuple[str, ...]) -> list[Guess]:
    """Return the guesses to try, the given chain first.

    A free base is aligned with the tips. Free rings are turned and mirrored, one after the other.
    If only the base is free, the mirror image of the whole robot is a guess. Without rows the given
    chain is the only guess.
    """
    guesses = [Guess(chain)]
    if not len(rows.q):
        return guesses
    free_base = "base" in names
    if free_base:
        guesses.append(Guess(aligned(chain, rows)))
    if not chain.rings:
        return guesses
    if "angles" in names or "turns" in names:
        step = max(1, len(rows.q) // _ROWS)
        few = rows.take(slice(None, None, step))
        scales = _SCALES if "radii" in names else (1.0,)
        guesses += _best_rings(chain, few, free_base, scales)
    elif free_base:
        mirrored = [(True, 0.0)] * len(chain.rings)
        image = aligned(_with_rings(chain, mirrored), rows)
        if rows.rmse(image) < rows.rmse(guesses[-1].chain):
            guesses.append(Guess(image, mirrored=True))
    return guesses


def aligned(chain: _Chain, rows: TipRows) -> _Chain:
    """Return the chain at the base pose that aligns predicted and measured tips."""
    motion, _ = _alignment(chain, rows)
    return chain.with_geometry(base=motion @ chain.geometry()["base"])


def _alignment(chain: Chain, rows: TipRows) -> tuple[Tensor, float]:
    """Return the motion of the base that aligns the tips, and their rms distance after it."""
    x = torch.from_numpy(points(rows.x.numpy())[rows.seen])
    tips = x + torch.from_numpy(rows.residual(chain)).to(x)
    weights = torch.from_numpy(rows.weights).to(x)
    motion = rigid_motion(tips, x, weights)
    squares = (tips @ motion[:3, :3].mT + motion[:3, 3] - x).square().sum(1)
    return motion, float(weights @ squares / weights.sum()) ** 0.5


def _best_rings(
    chain: Chain, rows: TipRows, free_base: bool, scales: tuple[float, ...]
) -> list[Guess]:
    """Return the best guesses of a search ring by ring, for several scales of the radii."""
    error_of = cache(partial(_error, chain, rows, free_base))
    best: dict[_Rings, tuple[float, float]] = {}  # least error, and its scale
    n_segments = len(chain.rings)
    for scale, mirrored in product(scales, (False, True)):
        rings: _Rings = ((mirrored, 0.0),) * n_segments
        error = math.inf
        for _, k in product(range(_SWEEPS), range(n_segments)):
            for ring in product((mirrored, not mirrored), _TURNS):
                changed = (*rings[:k], ring, *rings[k + 1 :])
                tried = error_of(changed, scale)
                if tried < error * (1.0 - 1e-9):
                    error = tried
                    rings = changed
        if rings not in best or error < best[rings][0]:
            best[rings] = error, scale
    ranked = sorted(best, key=lambda rings: best[rings][0])
    limit = _HOPELESS * best[ranked[0]][0]
    likely: dict[bool, list[Guess]] = {False: [], True: []}
    for rings in ranked:
        error, scale = best[rings]
        mirrored = any(mirrored for mirrored, _ in rings)
        if error < limit and len(likely[mirrored]) < _MOST:
            guess = _with_rings(chain, rings)
            if free_base:
                base = aligned(_scaled(guess, scale), rows).geometry()["base"]
                guess = guess.with_geometry(base=base)
            likely[mirrored].append(Guess(guess, scale, mirrored))
    return [*likely[False], *likely[True]]


def _error(chain: Chain, rows: TipRows, align: bool, rings: _Rings, scale: float) -> float:
    """Return the root mean square tip distance with these rings and scaled radii."""
    changed = _scaled(_with_rings(chain, rings), scale)
    return _alignment(changed, rows)[1] if align else rows.rmse(changed)


def _scaled(chain: Chain, scale: float) -> Chain:
    """Return the chain with all radii times a factor."""
    if scale == 1.0:
        return chain
    return chain.with_geometry(radii=scale * chain.geometry()["radii"])


def _with_rings(chain: Chain, rings: Sequence[tuple[bool, float]]) -> Chain:
    """Return the chain with every ring of actuators mirrored or not, then turned."""
    angles = chain.geometry()["angles"]
    changed = []
    for ring, (mirrored, turn) in zip(chain.rings, rings, strict=True):
        sign = -1.0 if mirrored else 1.0
        changed.append(sign * angles[ring] + turn)
    return chain.with_geometry(angles=torch.cat(changed))
