"""Where a calibration starts: base poses, ring turns and handedness that suit the data."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.calibration._least_squares import Rows

_ROWS = 300
_SCALES = (0.6, 1.0, 1.6)
_TURNS = tuple(0.5 * math.pi * k for k in range(4))
_SWEEPS = 2
_KEPT = 2  # starts of either handedness
_HOPELESS = 3.0  # times worse than the best start, before any fit


class Start(NamedTuple):
    """A chain to start from, how far its radii are likely off, and which rings are mirrored."""

    chain: Any
    scale: float = 1.0
    mirrored: tuple[bool, ...] = ()


def starts(chain: Any, rows: Rows, names: tuple[str, ...]) -> list[Start]:
    """Return starts worth trying, the given one first.

    A free base is laid over the tips; free rings are turned and mirrored, one after the other;
    where only the base is free, the mirror image of the whole robot is a start.
    """
    found = [Start(chain)]
    free_base = "base" in names
    if free_base:
        found.append(Start(aligned(chain, rows)))
    if {"angles", "turns"} & {*names}:
        step = max(1, len(rows.q) // _ROWS)
        few = Rows(*(part[::step] for part in rows))
        found += _searched(chain, few, free_base, "radii" in names)
    elif free_base and "angles" in chain.geometry():
        counts = chain.actuators_per_segment
        mirrored = (True,) * len(counts)
        image = aligned(_ringed(chain, mirrored, np.zeros(len(counts))), rows)
        if rows.rmse(image) < rows.rmse(found[-1].chain):
            found.append(Start(image, mirrored=mirrored))
    return found


def aligned(chain: Any, rows: Rows) -> Any:
    """Return the chain at the base pose that matches the two clouds of tips (Kabsch)."""
    tips, weight = chain(rows.q), rows.weight[:, None] / rows.weight.sum()
    here, there = (weight * tips).sum(0), (weight * rows.x).sum(0)
    u, _, vh = torch.linalg.svd((weight * (tips - here)).mT @ (rows.x - there))
    sign = torch.ones_like(here)
    sign[2] = torch.sign(torch.linalg.det(u @ vh))
    rotation = vh.mT @ (sign[:, None] * u.mT)
    move = torch.eye(4, dtype=here.dtype)
    move[:3, :3], move[:3, 3] = rotation, there - rotation @ here
    return chain.with_geometry(base=move @ chain.geometry()["base"])


def _searched(chain: Any, rows: Rows, free_base: bool, free_radii: bool) -> Iterator[Start]:
    """Yield the best starts of a search ring by ring, for several guesses of the bending."""
    found: dict[Any, tuple[float, Start]] = {}
    n_segments = len(chain.actuators_per_segment)
    for scale in _SCALES if free_radii else (1.0,):
        for hand in (False, True):
            choice = [(hand, 0.0)] * n_segments
            score = math.inf
            for _ in range(_SWEEPS):
                for k in range(n_segments):
                    for option in [(flip, turn) for flip in (hand, not hand) for turn in _TURNS]:
                        tried = [*choice[:k], option, *choice[k + 1 :]]
                        start = _chosen(chain, tried, scale, rows, free_base)
                        rms = rows.rmse(_scaled(start.chain, start.scale))
                        if rms < score * (1.0 - 1e-9):
                            score, choice = rms, tried
            start = _chosen(chain, choice, scale, rows, free_base)
            key = tuple(choice)
            if key not in found or score < found[key][0]:
                found[key] = (score, start)
    ranked = sorted(found.values(), key=lambda pair: pair[0])
    hopeful = [start for score, start in ranked if score < _HOPELESS * ranked[0][0]]
    for mirrored in (False, True):
        yield from [start for start in hopeful if any(start.mirrored) == mirrored][:_KEPT]


def _chosen(
    chain: Any, choice: list[tuple[bool, float]], scale: float, rows: Rows, align: bool
) -> Start:
    mirrored, turns = zip(*choice, strict=True)
    turned = _ringed(chain, mirrored, np.array(turns))
    if align:
        scaled = aligned(_scaled(turned, scale), rows)
        turned = turned.with_geometry(base=scaled.geometry()["base"])
    return Start(turned, scale, mirrored)


def _ringed(chain: Any, mirrored: tuple[bool, ...], turns: NDArray) -> Any:
    """Return the chain with some rings of actuators mirrored, then all turned."""
    counts = chain.actuators_per_segment
    angles = chain.geometry()["angles"]
    sign = angles.new_tensor(np.repeat(np.where(mirrored, -1.0, 1.0), counts))
    return chain.with_geometry(angles=sign * angles + angles.new_tensor(np.repeat(turns, counts)))


def _scaled(chain: Any, scale: float) -> Any:
    return chain if scale == 1.0 else chain.with_geometry(radii=scale * chain.geometry()["radii"])
