"""Search for the order and signs of the actuator columns that explain the tips best."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

_ROWS = 60  # rows of the search; enough to distinguish two orders
_MANY = 5  # for more actuators in a segment, or more segments, only pairs of columns are swapped
_ROUNDS, _KEPT = 12, 10  # successive changes; orders from which each round starts
_GAIN = 0.97  # largest ratio of errors after and before a further change
_SIMPLE = 1.1  # an earlier change in the list is chosen if it is nearly as good


class Way(NamedTuple):
    """A way of reading the columns: ``sign * q[:, order]``."""

    order: tuple[int, ...]
    sign: tuple[int, ...]

    def then(self, other: Way) -> Way:
        """Return this way followed by another one."""
        order = tuple(self.order[i] for i in other.order)
        sign = (self.sign[i] * s for i, s in zip(other.order, other.sign, strict=True))
        return Way(order, tuple(sign))

    def of(self, q: NDArray) -> NDArray:
        """Return the columns of q (N, n), read this way."""
        return np.array(self.sign) * q[:, list(self.order)]


def as_declared(n: int) -> Way:
    """Return the way that does not change n columns."""
    return Way((*range(n),), (1,) * n)


def changes(counts: list[int], signed: bool) -> Iterator[Way]:
    """Yield the single changes that are tried, common mistakes first.

    They are: reversed numbering of all segments; all signs, or one; two columns swapped; another
    order of the columns of one segment; another order of the segments.
    """
    n = sum(counts)
    start, same = as_declared(n)
    parts = _blocks(counts)
    clockwise = tuple(i for part in parts for i in (*part[:1], *part[:0:-1]))
    yield Way(clockwise, same)
    if signed:
        yield from (Way(order, (-1,) * n) for order in (start, clockwise))
        yield from (Way(start, (*same[:i], -1, *same[i + 1 :])) for i in range(n))
    orders = [{i: j, j: i} for i, j in itertools.combinations(range(n), 2)]
    for part in (part for part in parts if len(part) <= _MANY):
        orders += [dict(zip(part, o, strict=True)) for o in itertools.permutations(part)][1:]
    yield from (Way(tuple(order.get(i, i) for i in range(n)), same) for order in orders)
    for listed in itertools.permutations(range(len(parts))) if len(parts) <= _MANY else ():
        found = dict(zip(listed, _blocks([counts[k] for k in listed]), strict=True))
        yield Way(tuple(i for k in range(len(parts)) for i in found[k]), same)


def _blocks(counts: list[int]) -> list[list[int]]:
    return [part.tolist() for part in np.split(np.arange(sum(counts)), np.cumsum(counts)[:-1])]


def misses(chain: Any, qs: NDArray, x: NDArray, base_is_free: bool) -> NDArray:
    """Return for each q (N, n) of qs (K, N, n) the relative error of the chain's tips.

    This is the rms distance of the tips x (N, 3) from those of the chain, after the best shift (for
    a free base also rotation and scale), divided by the rms distance of x from its mean.
    """
    a, b = _clouds(chain, qs, x)
    if base_is_free:
        turn, scale = _turn(a, b)
        a = scale[:, None, None] * a @ turn.mT
    return ((a - b).square().sum(-1).mean(-1) / b.square().sum(-1).mean()).sqrt().numpy()


def base_turn(chain: Any, q: NDArray, x: NDArray) -> tuple[float, float]:
    """Return the rotation of the base about its axis that fits the tips, and its tilt [deg]."""
    base = chain.base[:3, :3].double()
    turn = (base.mT @ _turn(*_clouds(chain, q[None], x))[0][0] @ base).numpy()
    twist = np.arctan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
    return float(np.degrees(twist)), float(np.degrees(np.arccos(np.clip(turn[2, 2], -1.0, 1.0))))


def _clouds(chain: Any, qs: NDArray, x: NDArray) -> tuple[Tensor, Tensor]:
    """Return the tips (K, N, 3) of the chain and the measured ones, each minus their mean."""
    rows = torch.from_numpy(np.ascontiguousarray(qs, dtype=np.float64))
    with torch.no_grad():
        a = chain(rows.flatten(0, 1)).double().reshape(*rows.shape[:2], 3)
    b = torch.from_numpy(np.asarray(x, dtype=np.float64))
    return a - a.mean(dim=1, keepdim=True), b - b.mean(dim=0)


def _turn(a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations (K, 3, 3) and scales (K,) of centred points a (K, N, 3) to b (N, 3).

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991): least squares over rotations without mirror images.
    """
    u, s, vh = torch.linalg.svd(b.mT @ a)
    flip = torch.ones_like(s)
    flip[:, 2] = torch.linalg.det(u @ vh).sign()
    size = a.square().sum((-2, -1)).clamp(min=torch.finfo(a.dtype).tiny)
    return (u * flip[:, None]) @ vh, (s * flip).sum(-1) / size


def better_way(chain: Any, q: NDArray, x: NDArray, base_is_free: bool) -> tuple[Way, float]:
    """Return the best found way to read the columns, and its relative error (see `misses`).

    Each round tries all changes on the best ways of the previous round.
    """
    counts, signed = chain.actuators_per_segment, not any(chain.extensible)
    rows = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    q, x, tried = q[rows], x[rows], [*changes(counts, signed)]
    kept = [as_declared(sum(counts))]
    best, least = kept[0], float(misses(chain, q[None], x, base_is_free)[0])
    for _ in range(_ROUNDS):
        ways = [*dict.fromkeys(way.then(change) for way in kept for change in tried)]
        missed = misses(chain, np.stack([way.of(q) for way in ways]), x, base_is_free)
        kept = [ways[i] for i in np.argsort(missed)[:_KEPT]]
        if missed.min() > _GAIN * least:
            break
        first = int(np.flatnonzero(missed <= _SIMPLE * missed.min())[0])
        best, least = ways[first], float(missed[first])
    return best, least
