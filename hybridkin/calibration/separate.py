"""Motions that separate geometries with nearly equal errors on a log."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import lsq_linear

from hybridkin._core.arrays import Numbers, real_array
from hybridkin._core.model import ForwardModel
from hybridkin._core.units import LogUnit
from hybridkin.calibration._least_squares import TipRows
from hybridkin.calibration._search import search
from hybridkin.calibration.calibrate import check_data, refitted
from hybridkin.calibration.choice import GeometryChoice
from hybridkin.calibration.measured import evenly_spaced, points
from hybridkin.chains.chain import Chain

__all__ = ["SeparatingMotion", "separating_motions"]

_MOST = 200  # rows of the log
_BEYOND = 0.25  # of the range of the log, on both sides, without limits
_BENDS = np.radians([90.0, 60.0, 40.0, 25.0, 15.0, 8.0])  # to try, the largest first
_DIRECTIONS = 8
_STEPS = 5  # rows of a motion to one side
_OFF = 0.1  # of a bend: how far the arcs may be from those wanted
_STRAIGHT = np.radians(5.0)
_ROUNDS = 3  # Gauss-Newton, of chains whose arcs are not linear in q
_STAY = 1e-4  # weight of the distance from the start, in ranges, beside that of the arcs
_TRIED = 4  # motions after which both sets are calibrated again


@dataclass(frozen=True)
class SeparatingMotion:
    """A motion that shows which of two sets of parameters suits a robot.

    Attributes
    ----------
    chosen, rival : str
        Names of the two sets, see `GeometryChoice.errors`.
    motion : str
        What to do, in words.
    q : ndarray of shape (T, n_actuators)
        Rows of the motion, in order [unit of q].
    difference : float
        Largest distance along the motion between the tips of both models, each calibrated on the
        log and moved by its mean residual [m].
    remaining : float
        The part of it that a calibration on the log and this motion cannot remove: the root mean
        square error on the motion, if the robot is one of both models and the other one is
        calibrated [m].
    noise : float
        Root mean square error of the chosen set on the log [m].
    """

    chosen: str
    rival: str
    motion: str
    q: NDArray
    difference: float
    remaining: float
    noise: float

    @property
    def separates(self) -> bool:
        """Whether the difference that remains is larger than the errors on the log."""
        return self.remaining > self.noise

    def __str__(self) -> str:
        sets = f"{self.chosen!r} and {self.rival!r}"
        if self.separates:
            return (
                f"{self.motion}: {sets} differ by up to {1e3 * self.difference:.2g} mm there "
                f"({1e3 * self.remaining:.2g} mm rms after a new calibration; errors on the log "
                f"{1e3 * self.noise:.2g} mm)"
            )
        return (
            f"no motion within the limits separates {sets}: the best one leaves "
            f"{1e3 * self.remaining:.2g} mm rms, errors on the log are {1e3 * self.noise:.2g} mm"
        )


class _Motion(NamedTuple):
    """Rows of q (T, n) of a motion, and what they do."""

    words: str
    q: NDArray


def separating_motions(
    choice: GeometryChoice,
    q: Numbers,
    x: Numbers,
    *,
    q_min: ArrayLike | None = None,
    q_max: ArrayLike | None = None,
) -> tuple[SeparatingMotion, ...]:
    """Return for each rival of a choice the motion that best shows which of the two is right.

    A log can leave open which parameters of the robot are wrong: `GeometryChoice.rivals` have
    nearly the errors of the chosen set. All are calibrated on the log. Motions within the limits
    are compared: each segment bends to one side, goes around a circle, or changes its length, while
    the others stay straight; all segments bend together; one goes around a circle while another is
    bent. Of chains without one arc for each segment single actuators and pairs of them move. Of the
    motions with the largest differences the one is taken of which most remains after a calibration
    on the log and this motion.

    Parameters
    ----------
    choice : GeometryChoice
        As from `choose_geometry`, or `HybridForwardModel.geometry_` after a fit.
    q : array or Tensor of shape (N, n_actuators)
        Actuator vectors of the log of the choice [unit of q].
    x : array or Tensor of shape (N, 3) or (N, 3 K)
        Measured tip positions [m].
    q_min, q_max : float or array-like of shape (n_actuators,), optional
        Limits [unit of q]. Default: the range of the log, and a quarter of it beyond both ends.

    Returns
    -------
    tuple of SeparatingMotion
        One for each rival; a `SeparatingMotion` can say that no motion separates the two.

    Raises
    ------
    ValueError
        For limits that are not finite or of a wrong shape, and as for `calibrate`.

    Examples
    --------
    A log of one segment that only becomes longer does not show its radius.

    >>> import torch
    >>> from hybridkin import ConstantCurvatureChain, choose_geometry, separating_motions
    >>> q = torch.linspace(0.2, 0.3, 30, dtype=torch.float64)[:, None].repeat(1, 3)
    >>> q = q + 1e-4 * torch.randn(q.shape, generator=torch.manual_seed(0), dtype=torch.float64)
    >>> noise = 1e-4 * torch.randn(q.shape, generator=torch.manual_seed(1), dtype=torch.float64)
    >>> x = ConstantCurvatureChain([0.05])(q) + noise
    >>> choice = choose_geometry(ConstantCurvatureChain([0.06]), q, x)
    >>> motions = separating_motions(choice, q, x, q_min=0.2, q_max=0.3)
    """
    chain = choice.chain.frozen().cpu()
    q, x, _ = check_data(chain, q, x)
    rows = q.numpy()
    margin = _BEYOND * np.ptp(rows, axis=0)
    low = _limit(q_min, "q_min", rows.min(axis=0) - margin)
    high = _limit(q_max, "q_max", rows.max(axis=0) + margin)
    if (low > high).any():
        raise ValueError(f"`q_min` must not exceed `q_max`, got {low} and {high}.")
    if not choice.rivals:
        return ()
    log = TipRows(q, x, q.new_ones(len(q))).take(evenly_spaced(len(q), _MOST))
    chosen = _Calibrated.of(_started(choice, log), log)
    with torch.no_grad():
        motions = _motions(chosen.chain, rows, low, high)
    found = []
    for rival in choice.rivals:
        other = _Calibrated.of(_started(rival, log), log)
        found.append(_separating(chosen, other, log, motions))
    return tuple(found)


def _started(choice: GeometryChoice, log: TipRows) -> GeometryChoice:
    """Return a choice with a start of its fit, which is searched if there is none."""
    if choice.start.n_free or not choice.parameters:
        return choice
    chain = choice.chain.frozen().cpu()
    return replace(choice, start=search(chain, log, choice.parameters, "linear"))


def _limit(value: ArrayLike | None, name: str, usual: NDArray) -> NDArray:
    """Return a finite limit of each actuator (n,)."""
    if value is None:
        return usual
    limit = real_array(value, name).astype(float)
    if limit.shape not in ((), usual.shape) or not np.isfinite(limit).all():
        raise ValueError(f"`{name}` must be one finite number or {len(usual)}, got {value!r:.200}.")
    return np.broadcast_to(limit, usual.shape)


class _Calibrated(NamedTuple):
    """A set of parameters, calibrated on rows, and the mean of the residual that is left (m,)."""

    choice: GeometryChoice
    chain: Chain
    offset: NDArray

    @classmethod
    def of(cls, choice: GeometryChoice, rows: TipRows) -> _Calibrated:
        """Return the calibration of a set on rows."""
        chain = choice.chain.frozen().cpu()
        if choice.parameters:
            chain = refitted(choice.start, rows.q, rows.x, rows.weight)
        residual = rows.x.numpy() - _tips(chain, rows.q.numpy())
        weights = np.where(np.isnan(residual), 0.0, rows.weight.numpy()[:, None])
        offset = np.average(np.nan_to_num(residual), axis=0, weights=weights)
        return cls(choice, chain, offset)

    def tips(self, q: NDArray) -> NDArray:
        """Return the tips at rows q (T, n), shape (T, m) [m]."""
        return _tips(self.chain, q) + self.offset


def _tips(chain: Chain, q: NDArray) -> NDArray:
    with torch.no_grad():
        return chain(torch.from_numpy(q)).numpy()


def _lengths(difference: NDArray) -> NDArray:
    """Return the largest distance of a marker in each row (T,); missing markers have none."""
    return np.nanmax(np.linalg.norm(points(difference), axis=2), axis=1)


def _rms(difference: NDArray) -> float:
    return float(np.sqrt(np.mean(_lengths(difference) ** 2)))


def _separating(
    chosen: _Calibrated, rival: _Calibrated, log: TipRows, motions: Sequence[_Motion]
) -> SeparatingMotion:
    """Return the best motion for two sets: the first ones by their difference are tried."""
    differences = [chosen.tips(motion.q) - rival.tips(motion.q) for motion in motions]
    order = np.argsort([-_rms(difference) for difference in differences], kind="stable")
    best = 0
    remaining = -1.0
    for k in order[:_TRIED].tolist():
        q = motions[k].q
        left = max(_left(chosen, rival, log, q), _left(rival, chosen, log, q))
        if left > remaining:
            best = k
            remaining = left
    return SeparatingMotion(
        chosen=chosen.choice.name,
        rival=rival.choice.name,
        motion=motions[best].words,
        q=motions[best].q,
        difference=float(_lengths(differences[best]).max()),
        remaining=remaining,
        noise=_rms(log.x.numpy() - chosen.tips(log.q.numpy())),
    )


def _left(truth: _Calibrated, imitation: _Calibrated, log: TipRows, q: NDArray) -> float:
    """Return the error on a motion q (T, n) of a set that is calibrated on it and on the log [m].

    The tips are those of the other set. The motion counts as much as the log.
    """
    tips = truth.tips(q)
    weights = torch.cat([log.weight, log.weight.new_full((len(q),), len(log.q) / len(q))])
    both = TipRows(
        torch.cat([log.q, torch.from_numpy(q)]),
        torch.cat([log.x, torch.from_numpy(tips)]),
        weights,
    )
    anew = _Calibrated.of(imitation.choice, both)
    return _rms(anew.tips(q) - tips)


def _motions(chain: Chain, q: NDArray, low: NDArray, high: NDArray) -> list[_Motion]:
    """Return the motions to compare within limits, for a log of rows q (N, n)."""
    if chain.has_one_arc_per_segment:
        return _ArcMotions(chain, q, low, high).all()
    return _actuator_motions(chain, low, high)


def _actuator_motions(chain: ForwardModel, low: NDArray, high: NDArray) -> list[_Motion]:
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
        motions.append(_Motion(f"{words}, the others in the middle of their range", rows))
    turn = np.arange(_DIRECTIONS) * 2.0 * np.pi / _DIRECTIONS
    for i in range(n):
        for j in range(i):
            rows = np.tile(middle, (_DIRECTIONS, 1))
            rows[:, j] += half[j] * np.cos(turn)
            rows[:, i] += half[i] * np.sin(turn)
            words = f"move q[{j}] and q[{i}] together around an ellipse over their whole range"
            motions.append(_Motion(f"{words}, the others in the middle", rows))
    return motions


class _ArcMotions:
    """Motions of the segments of a chain of arcs, as far as limits allow.

    Parameters
    ----------
    chain : Chain
        The calibrated chain; one arc for each segment.
    q : ndarray of shape (N, n)
        Rows of the log.
    low, high : ndarray of shape (n,)
        Limits.
    """

    def __init__(self, chain: Chain, q: NDArray, low: NDArray, high: NDArray) -> None:
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

    def bent(self, bends: dict[int, NDArray]) -> NDArray:
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
            if self.rows([self.bent(dict.fromkeys(segments, bend * side))])[1]:
                return bend
        return 0.0

    def all(self) -> list[_Motion]:
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
            motions.append(_Motion(words, self.rows(around)[0]))
        return motions

    def bends(self, segments: Sequence[int], name: str) -> tuple[list[_Motion], float]:
        """Return the motions of segments to each side and around, and the bend of the circle."""
        motions = []
        bends = []
        for side in self.sides:
            bend = self.farthest(segments, side)
            bends.append(bend)
            if not bend:
                continue
            away = [
                self.bent(dict.fromkeys(segments, part * bend * side))
                for part in np.linspace(0.0, 1.0, _STEPS)
            ]
            towards = np.degrees(np.arctan2(side[1], side[0]))
            words = (
                f"bend {name} to {_degrees(bend)} to one side (towards {towards:.0f} deg)"
                f"{self.others(segments)}"
            )
            motions.append(_Motion(words, self.rows(away)[0]))
        circle = min(bends)
        if circle:
            around = [self.bent(dict.fromkeys(segments, circle * side)) for side in self.sides]
            words = f"lead {name} around a circle, bent by {_degrees(circle)}"
            motions.append(_Motion(words + self.others(segments), self.rows(around)[0]))
        return motions, circle

    def length(self, k: int) -> list[_Motion]:
        """Return the motion that changes the length of a segment, if it can change."""
        ends = []
        for factor in (0.5, 2.0):
            z = self.straight.copy()
            z[k] *= factor
            ends.append(self.arcs(self.reach(z)[None])[0, k])
        if ends[1] - ends[0] < 0.01 * self.size[k]:
            return []
        wanted = np.tile(self.straight, (_STEPS, 1))
        wanted[:, k] = np.linspace(*ends, _STEPS)
        q = np.array([self.reach(z) for z in wanted])
        words = (
            f"change the length of segment {k + 1} from {1e3 * ends[0]:.0f} to "
            f"{1e3 * ends[1]:.0f} mm, straight{self.others([k])}"
        )
        return [_Motion(words, q)]

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
