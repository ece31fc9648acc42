"""Search for the order and signs of the actuator columns that explain the tips best.

A way to read the columns is a matrix (n, n) of ints with one 1 or -1 in each row and column:
``q @ way`` has the columns in their true order and with their true signs.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.rotations import nearest_rotation

if TYPE_CHECKING:
    from hybridkin import LengthDrivenChain

_ROWS = 60  # rows of the search; enough to distinguish two orders
_MANY = 5  # for more actuators in a segment, or more segments, only pairs of columns are swapped
_ROUNDS = 12  # successive changes
_CANDIDATES = 10  # ways from which each round starts
_GAIN = 0.97  # largest ratio of errors after and before a further change
SIMPLE = 1.1  # an earlier change in the list is chosen if it is nearly as good


def changes(counts: Sequence[int], signed: bool) -> Iterator[NDArray]:
    """Yield the single changes that are tried, common mistakes first.

    They are: reversed numbering of all segments; all signs, or one; two columns swapped; another
    order of the columns of one segment; another order of the segments.
    """
    n = sum(counts)
    declared = np.eye(n, dtype=int)
    numbering = declared[:, other_direction(counts)]
    yield numbering
    if signed:
        yield -declared
        yield -numbering
        for i in range(n):
            one_sign = declared.copy()
            one_sign[i, i] = -1
            yield one_sign
    for i, j in itertools.combinations(range(n), 2):
        yield _reordered(declared, [i, j], [j, i])
    segments = segment_columns(counts)
    for segment in segments:
        if len(segment) <= _MANY:
            for order in [*itertools.permutations(segment)][1:]:
                yield _reordered(declared, segment, order)
    if len(segments) <= _MANY:
        for listed in itertools.permutations(range(len(segments))):
            yield declared[:, _segments_listed(counts, listed)]


def segment_columns(counts: Sequence[int]) -> list[list[int]]:
    """Return the columns of every segment."""
    ends = np.cumsum(counts)
    segments = []
    for count, end in zip(counts, ends.tolist(), strict=True):
        segments.append([*range(end - count, end)])
    return segments


def other_direction(counts: Sequence[int]) -> list[int]:
    """Return the columns with the actuators of every segment numbered in the other direction."""
    order = []
    for first, *following in segment_columns(counts):
        order += [first, *reversed(following)]
    return order


def _reordered(declared: NDArray, columns: Sequence[int], order: Sequence[int]) -> NDArray:
    """Return the way with some columns in another order."""
    way = declared.copy()
    way[:, columns] = declared[:, order]
    return way


def _segments_listed(counts: Sequence[int], listed: Sequence[int]) -> list[int]:
    """Return the columns in their true order if they list the segments in another order."""
    listed_columns = segment_columns([counts[k] for k in listed])
    order = []
    for k in range(len(counts)):
        order += listed_columns[listed.index(k)]
    return order


def misses(chain: LengthDrivenChain, qs: NDArray, x: NDArray, base_is_free: bool) -> NDArray:
    """Return for each q (N, n) of qs (K, N, n) the relative error of the chain's tips.

    This is the rms distance of the tips x (N, 3) from those of the chain, after the best shift (for
    a free base also rotation and scale), divided by the rms distance of x from its mean.
    """
    tips, measured = _centred(chain, qs, x)
    if base_is_free:
        turn, trace = nearest_rotation(measured.T @ tips)
        size = np.square(tips).sum(axis=(-2, -1)).clip(min=np.finfo(float).tiny)
        tips = (trace / size)[:, None, None] * tips @ turn.swapaxes(-2, -1)
    squared_error = np.square(tips - measured).sum(axis=-1).mean(axis=-1)
    squared_size = np.square(measured).sum(axis=-1).mean()
    return np.sqrt(squared_error / squared_size)


def base_turn(chain: LengthDrivenChain, q: NDArray, x: NDArray) -> tuple[float, float]:
    """Return the rotation of the base about its axis that fits the tips, and its tilt [deg]."""
    tips, measured = _centred(chain, q[None], x)
    base = chain.base[:3, :3].numpy(force=True).astype(float)
    motion, _ = nearest_rotation(measured.T @ tips[0])
    turn = base.T @ motion @ base
    sine = turn[1, 0] - turn[0, 1]
    cosine = turn[0, 0] + turn[1, 1]
    twist = np.arctan2(sine, cosine)
    tilt = np.arccos(np.clip(turn[2, 2], -1.0, 1.0))
    return float(np.degrees(twist)), float(np.degrees(tilt))


def _centred(chain: LengthDrivenChain, qs: NDArray, x: NDArray) -> tuple[NDArray, NDArray]:
    """Return the tips (K, N, 3) of the chain and the measured ones, each minus their mean."""
    rows = torch.from_numpy(np.ascontiguousarray(qs, dtype=np.float64))
    with torch.no_grad():
        tips = chain(rows).double().numpy()
    return tips - tips.mean(axis=1, keepdims=True), x - x.mean(axis=0)


def better_way(
    chain: LengthDrivenChain, q: NDArray, x: NDArray, base_is_free: bool
) -> tuple[NDArray, float]:
    """Return the best found way to read the columns, and its relative error (see `misses`).

    Each round tries all changes on the best ways of the previous round.
    """
    rows = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    q = q[rows]
    x = x[rows]
    tried = [*changes(chain.actuators_per_segment, not any(chain.extensible))]
    best = np.eye(q.shape[1], dtype=int)
    least = float(misses(chain, q[None], x, base_is_free)[0])
    candidates = np.array([best])
    for _ in range(_ROUNDS):
        different = {}
        for candidate in candidates:
            for change in tried:
                way = candidate @ change
                different.setdefault(way.tobytes(), way)
        ways = np.array([*different.values()])
        missed = misses(chain, q @ ways, x, base_is_free)
        if missed.min() > _GAIN * least:
            break
        candidates = ways[np.argsort(missed)[:_CANDIDATES]]
        first = np.argmax(missed <= SIMPLE * missed.min())
        best = ways[first]
        least = float(missed[first])
    return best, least
