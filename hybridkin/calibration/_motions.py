"""Motions of a robot within limits, in words: segments that bend, turn around, become longer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from hybridkin._core.model import ForwardModel
from hybridkin._core.units import LogUnit

_BENDS = np.radians([90.0, 60.0, 40.0, 25.0, 15.0, 8.0, 4.0])  # to try, the largest first
_DIRECTIONS = 8
_STEPS = 5  # rows of a motion to one side
_OFF = 0.1  # of a bend: how far the arcs may be from those wanted
_STRAIGHT = np.radians(5.0)
_ROUNDS = 3  # Gauss-Newton, of chains whose arcs are not linear in q
_STAY = 1e-4  # weight of the distance from the start, in ranges, beside that of the arcs


class Motion(NamedTuple):
    """Rows of q (T, n) of a motion, and what they do."""

    words: str
    q: NDArray


def motions_within(chain: ForwardModel, q: NDArray, low: NDArray, high: NDArray) -> list[Motion]:
    """Return the motions to compare within limits, for a log of rows q (N, n)."""
    motions = []
    if chain.has_one_arc_per_segment:
        motions = _ArcMotions(chain, q, low, high).all()
    return motions or _actuator_motions(chain, low, high)


def _actuator_motions(chain: ForwardModel, low: NDArray, high: NDArray) -> list[Motion]:
    """Return motions of single actuators, and of pairs around an ellipse."""
    middle = 0.5 * (low + high)
    half = 0.5 * (high - low)
    n = len(low)
    units = chain.unit_of_q
    names = [units] * n if isinstance(units, str) else units
    motions = []
    for k in range(n):
        rows = np.tile(middle, (_STEPS, 1))
        rows[:, k] = np.linspace(low[k], high[k], _STEPS)
        unit = LogUnit.of(names[k])
        words = f"move q[{k}] from {unit.in_words(low[k])} to {unit.in_words(high[k])}"
        motions.append(Motion(f"{words}, the others in the middle of their range", rows))
    turn = np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS
    for i in range(n):
        for j in range(i):
            rows = np.tile(middle, (_DIRECTIONS, 1))
            rows[:, j] += half[j] * np.cos(turn)
            rows[:, i] += half[i] * np.sin(turn)
            words = f"move q[{j}] and q[{i}] together around an ellipse over their whole range"
            motions.append(Motion(f"{words}, the others in the middle", rows))
    return motions


class _ArcMotions:
    """Motions of the segments of a chain of arcs, as far as limits allow.

    Parameters
    ----------
    chain : ForwardModel
        The calibrated chain; one arc for each segment.
    q : ndarray of shape (N, n)
        Rows of the log.
    low, high : ndarray of shape (n,)
        Limits.
    """

    def __init__(self, chain: ForwardModel, q: NDArray, low: NDArray, high: NDArray) -> None:
        self.chain = chain
        self.low = low
        self.high = np.maximum(high, low + 1e-9 * (1.0 + np.abs(low)))
        self.span = self.high - self.low
        z = self.arcs(q)
        self.m = z.shape[1] // 3
        self.size = np.concatenate([z[:, : self.m].mean(axis=0), np.ones(2 * self.m)])
        self.q = np.clip(np.median(q, axis=0), self.low, self.high)
        self.straight = np.concatenate([self.size[: self.m], np.zeros(2 * self.m)])
        self.q = self.reach(self.straight)
        self.straight[: self.m] = self.arcs(self.q[None])[0, : self.m]
        turn = np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS
        self.sides = np.column_stack([np.cos(turn), np.sin(turn)])

    def arcs(self, q: NDArray) -> NDArray:
        """Return lengths, x- and y-bendings (N, 3 m) at rows q (N, n)."""
        return self.chain.coordinates(torch.from_numpy(q))[0].numpy()

    def reach(self, z: NDArray) -> NDArray:
        """Return q (n,) within the limits whose arcs are nearest to z (3 m,)."""
        q = self.q
        n = len(q)
        for _ in range(_ROUNDS):
            now, slope = self.chain.coordinates(torch.from_numpy(q[None]))
            J = slope.reshape(-1, len(z), n)[0].numpy() * self.span / self.size[:, None]
            stay = (self.q - q) / self.span
            target = np.concatenate([(z - now.numpy()[0]) / self.size, _STAY * stay])
            bounds = (self.low - q) / self.span - 1e-12, (self.high - q) / self.span + 1e-12
            step = lsq_linear(np.vstack([J, _STAY * np.eye(n)]), target, bounds).x
            q = np.clip(q + self.span * step, self.low, self.high)
            if slope.ndim == 2:
                break
        return q

    def bent(self, bends: Mapping[int, NDArray]) -> NDArray:
        """Return the arcs (3 m,) of the straight robot with other bendings of some segments."""
        z = self.straight.copy()
        for k, bend in bends.items():
            z[self.m + k] = bend[0]
            z[2 * self.m + k] = bend[1]
        return z

    def rows(self, wanted: Sequence[NDArray]) -> tuple[NDArray, bool]:
        """Return rows q (T, n) for arcs, and whether they are reached."""
        z = np.array(wanted)
        q = np.array([self.reach(row) for row in z])
        off = np.abs((self.arcs(q) - z) / self.size).max()
        return q, bool(off <= _OFF * np.abs(z[:, self.m :]).max())

    def farthest(self, segments: Sequence[int], side: NDArray) -> float:
        """Return how far segments can bend to a side together [rad]; 0: hardly at all."""
        for bend in _BENDS.tolist():
            if self.rows([self.bent({k: bend * side for k in segments})])[1]:
                return bend
        return 0.0

    def all(self) -> list[Motion]:
        """Return the motions of single segments, of all together, and of pairs."""
        m = self.m
        motions = []
        circles = {}
        for k in range(m):
            one_sided, circles[k] = self.bends([k], f"segment {k + 1}")
            motions += one_sided
            motions += self.length(k)
        if m > 1:
            motions += self.bends(range(m), "all segments")[0]
        for k, j in permutations(range(m), 2):
            bend = circles[k]
            other = min(circles[j], bend)
            if not other:
                continue
            around = [self.bent({k: bend * side, j: other * self.sides[0]}) for side in self.sides]
            words = (
                f"lead segment {k + 1} around a circle, bent by {_degrees(bend)}, while segment "
                f"{j + 1} is bent by {_degrees(other)}{self.others([k, j])}"
            )
            motions.append(Motion(words, self.rows(around)[0]))
        return motions

    def bends(self, segments: Sequence[int], name: str) -> tuple[list[Motion], float]:
        """Return the motions of segments to each side and around, and the bend of the circle."""
        motions = []
        bends = []
        for side in self.sides:
            bend = self.farthest(segments, side)
            bends.append(bend)
            if not bend:
                continue
            away = [
                self.bent({k: part * bend * side for k in segments})
                for part in np.linspace(0.0, 1.0, _STEPS)
            ]
            towards = np.degrees(np.arctan2(side[1], side[0]))
            words = (
                f"bend {name} to {_degrees(bend)} to one side (towards {towards:.0f} deg)"
                f"{self.others(segments)}"
            )
            motions.append(Motion(words, self.rows(away)[0]))
        circle = min(bends)
        if circle:
            around = [self.bent({k: circle * side for k in segments}) for side in self.sides]
            words = f"lead {name} around a circle, bent by {_degrees(circle)}"
            motions.append(Motion(words + self.others(segments), self.rows(around)[0]))
        return motions, circle

    def length(self, k: int) -> list[Motion]:
        """Return the motion that changes the length of a segment, if it can change."""
        ends = []
        for factor in (0.5, 2.0):
            z = self.straight.copy()
            z[k] *= factor
            ends.append(self.arcs(self.reach(z)[None])[0, k])
        if ends[1] - ends[0] < 0.01 * self.size[k]:
            return []
        wanted = np.tile(self.straight, (_STEPS, 1))
        wanted[:, k] = np.linspace(ends[0], ends[1], _STEPS)
        q = np.array([self.reach(z) for z in wanted])
        words = (
            f"change the length of segment {k + 1} from {1e3 * ends[0]:.0f} to "
            f"{1e3 * ends[1]:.0f} mm, straight{self.others([k])}"
        )
        return [Motion(words, q)]

    def others(self, segments: Sequence[int]) -> str:
        """Return what segments beside these do, in words."""
        still = [k for k in range(self.m) if k not in segments]
        if not still:
            return ""
        bends = self.arcs(self.q[None])[0, self.m :].reshape(2, -1)[:, still]
        largest = np.linalg.norm(bends, axis=0).max()
        names = " and ".join(str(k + 1) for k in still)
        verb = f"segment {names} stays" if len(still) == 1 else f"segments {names} stay"
        if largest <= _STRAIGHT:
            return f", while {verb} straight"
        return f", while {verb} as straight as they can be ({_degrees(largest)})"


def _degrees(angle: float) -> str:
    return f"{np.degrees(angle):.0f} deg"
