"""Search for the order and signs of the actuator columns that explain the tips best."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.rotations import nearest_rotation

_ROWS = 60  # rows of the search; enough to distinguish two orders
_MANY = 5  # for more actuators in a segment, or more segments, only pairs of columns are swapped
_ROUNDS = 12  # successive changes
_KEPT = 10  # orders from which each round starts
_GAIN = 0.97  # largest ratio of errors after and before a further change
_SIMPLE = 1.1  # an earlier change in the list is chosen if it is nearly as good


class Way(NamedTuple):
    """A way of reading the columns: ``sign * q[:, order]``."""

    order: tuple[int, ...]
    sign: tuple[int, ...]

    def then(self, other: Way) -> Way:
        """Return this way followed by another one."""
        order = np.array(self.order)[[*other.order]]
        sign = np.array(self.sign)[[*other.order]] * other.sign
        return Way(tuple(order.tolist()), tuple(sign.tolist()))

    def of(self, q: NDArray) -> NDArray:
        """Return the columns of q (N, n), read this way."""
        return np.array(self.sign) * q[:, list(self.order)]


def as_declared(n: int) -> Way:
    """Return the way that does not change n columns."""
    return Way(tuple(range(n)), (1,) * n)


def changes(counts: list[int], signed: bool) -> Iterator[Way]:
    """Yield the single changes that are tried, common mistakes first.

    They are: reversed numbering of all segments; all signs, or one; two columns swapped; another
    order of the columns of one segment; another order of the segments.
    """
    n = sum(counts)
    declared = as_declared(n)
    clockwise = _clockwise(counts)
    yield clockwise
    if signed:
        yield Way(declared.order, (-1,) * n)
        yield Way(clockwise.order, (-1,) * n)
        for i in range(n):
            sign = [1] * n
            sign[i] = -1
            yield Way(declared.order, tuple(sign))
    for i, j in itertools.combinations(range(n), 2):
        yield _reordered(n, (i, j), (j, i))
    segments = _segments(counts)
    for segment in segments:
        if len(segment) <= _MANY:
            for order in [*itertools.permutations(segment)][1:]:
                yield _reordered(n, segment, order)
    if len(segments) <= _MANY:
        for listed in itertools.permutations(range(len(segments))):
            yield _segments_listed(counts, listed)


def _segments(counts: Sequence[int]) -> list[list[int]]:
    """Return the columns of every segment."""
    return [
        part.tolist()
        for part in np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])
    ]


def _clockwise(counts: list[int]) -> Way:
    """Return the way with the actuators of every segment numbered in the other direction."""
    order = []
    for first, *others in _segments(counts):
        order += [first, *others[::-1]]
    return as_declared(len(order))._replace(order=tuple(order))


def _reordered(n: int, columns: Sequence[int], order: Sequence[int]) -> Way:
    """Return the way with some of n columns in another order."""
    way = [*range(n)]
    for column, other in zip(columns, order, strict=True):
        way[column] = other
    return as_declared(n)._replace(order=tuple(way))


def _segments_listed(counts: list[int], listed: Sequence[int]) -> Way:
    """Return the way for columns that list the segments in another order."""
    columns = _segments([counts[k] for k in listed])
    order = []
    for k in range(len(counts)):
        order += columns[listed.index(k)]
    return as_declared(len(order))._replace(order=tuple(order))


def misses(chain: object, qs: NDArray, x: NDArray, base_is_free: bool) -> NDArray:
    """Return for each q (N, n) of qs (K, N, n) the relative error of the chain's tips.

    This is the rms distance of the tips x (N, 3) from those of the chain, after the best shift (for
    a free base also rotation and scale), divided by the rms distance of x from its mean.
    """
    tips, measured = _centred(chain, qs, x)
    if base_is_free:
        turn, trace = nearest_rotation(measured.mT @ tips)
        size = tips.square().sum((-2, -1)).clamp(min=torch.finfo(tips.dtype).tiny)
        tips = (trace / size)[:, None, None] * tips @ turn.mT
    squares = (tips - measured).square().sum(-1).mean(-1)
    return (squares / measured.square().sum(-1).mean()).sqrt().numpy()


def base_turn(chain: Any, q: NDArray, x: NDArray) -> tuple[float, float]:
    """Return the rotation of the base about its axis that fits the tips, and its tilt [deg]."""
    tips, measured = _centred(chain, q[None], x)
    turn, _ = nearest_rotation(measured.mT @ tips[0])
    base = chain.base[:3, :3].double()
    turn = (base.mT @ turn @ base).numpy()
    twist = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    tilt = np.arccos(np.clip(turn[2, 2], -1.0, 1.0))
    return float(np.degrees(twist)), float(np.degrees(tilt))


def _centred(chain: Any, qs: NDArray, x: NDArray) -> tuple[Tensor, Tensor]:
    """Return the tips (K, N, 3) of the chain and the measured ones, each minus their mean."""
    rows = torch.from_numpy(np.ascontiguousarray(qs, dtype=np.float64))
    with torch.no_grad():
        tips = chain(rows.flatten(0, 1)).double().reshape(*rows.shape[:2], 3)
    measured = torch.from_numpy(np.asarray(x, dtype=np.float64))
    return tips - tips.mean(dim=1, keepdim=True), measured - measured.mean(dim=0)


def better_way(
    chain: Any, q: NDArray, x: NDArray, base_is_free: bool
) -> tuple[Way, float]:
    """Return the best found way to read the columns, and its relative error (see `misses`).

    Each round tries all changes on the best ways of the previous round.
    """
    rows = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    q = q[rows]
    x = x[rows]
    tried = [*changes(chain.actuators_per_segment, not any(chain.extensible))]
    best = as_declared(q.shape[1])
    least = float(misses(chain, q[None], x, base_is_free)[0])
    candidates = [best]
    for _ in range(_ROUNDS):
        ways = [
            *dict.fromkeys(way.then(change) for way in candidates for change in tried)
        ]
        missed = misses(chain, np.stack([way.of(q) for way in ways]), x, base_is_free)
        candidates = [ways[i] for i in np.argsort(missed)[:_KEPT]]
        if missed.min() > _GAIN * least:
            break
        first = int(np.flatnonzero(missed <= _SIMPLE * missed.min())[0])
        best = ways[first]
        least = float(missed[first])
    return best, least
