"""The lag between the clocks of two recordings: where the commands explain the tips best."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from hybridkin.datasets.encoders import _features as rough_features
from hybridkin.datasets.timed_columns import TimedColumns, commands_at

_CELLS = 2**14  # of the coarse search, at most
_OVERLAP = 0.5  # of the shorter recording, at least
_CANDIDATES = 16  # lags of the coarse search that are compared
_SURE = 0.6  # least score of a candidate, relative to the best
_VALLEY = 0.5  # largest score between two candidates, relative to the lesser one
_ALIKE = 0.05  # of the variance of the commands: those of two lags that differ by less are alike
_NAMED = 6  # candidates in a message, at most
_ROWS = 2000  # camera rows that are compared, at most
_FEATURES = 250  # of the rough model, at most
_ROWS_PER_FEATURE = 5  # at least, of polynomials
_WINDOWS = 30  # of the fine search, at most
_DEGREES = (1, 2, 3)  # of the polynomials that explain tips
_EXACT = 1e-3  # what a right lag can leave unexplained; a wrong one only where a motion repeats
_RIDGE = 1e-9  # relative to the mean square of a feature
_PARTS = 3  # of a log, each explained by the others; short ones agree with anything smooth
EXPLAINED = 0.8  # least share of the motion that the commands explain at the lag
_RIVAL = 2.0  # least ratio of what the second best lag leaves to what the best leaves


class Candidate(NamedTuple):
    """A lag [s] with the share of the motion that it leaves, and the width of its search [s]."""

    unexplained: float
    lag: float
    width: float

    @property
    def as_good(self) -> float:
        """Return up to which share another lag is as good."""
        return max(_RIVAL * self.unexplained, _EXACT)


def candidate_lags(motors: TimedColumns, camera: TimedColumns, hold: bool) -> list[Candidate]:
    """Return lags at which the commands can explain the tips, the best first.

    Of lags so near to each other that the commands hardly change in between, only the best.
    """
    fits = []
    for lag, width in _coarse_lags(motors, camera):
        fits.append(_refined(motors, camera, lag, width, hold))
    candidates = []
    for fit in sorted(fits, key=lambda fit: fit.unexplained):
        if all(not _alike(motors, fit, better) for better in candidates):
            candidates.append(fit)
    return candidates


def _alike(motors: TimedColumns, a: Candidate, b: Candidate) -> bool:
    """Return whether the commands hardly change while the lag goes from one to another."""
    away = abs(a.lag - b.lag)
    if away <= a.width:
        return True
    rows = np.linspace(0, len(motors.time) - 1, min(len(motors.time), _ROWS)).astype(int)
    time = motors.time[rows]
    q = motors.values[rows]
    least = _ALIKE * np.square(q - q.mean(axis=0)).sum()
    for shift in [*np.arange(a.width, away, a.width), away]:
        change = commands_at(motors, time + shift) - q
        if np.square(change).sum() >= least:
            return False
    return True


def unclear(motors: TimedColumns, camera: TimedColumns, candidates: Sequence[Candidate]) -> str:
    """Return the message that no lag is clearly the best, with the lags to try."""
    lags = []
    for candidate in candidates[:_NAMED]:
        lags.append(f"{candidate.lag:.3f} s ({1.0 - candidate.unexplained:.1%})")
    return (
        f"The lag between {motors.source} and {camera.source} is not clear: {', '.join(lags)}. In "
        "brackets: how much of the motion of the tip the commands explain in a third of the rows, "
        "by a rough model of the other two thirds. One lag must explain "
        f"{100.0 * EXPLAINED:.0f} %, and others clearly less. Several lags fit where a motion "
        "repeats, or where all motions last equally long. If both files record the same motion, "
        "try these lags as `lag` (--lag), or 0 if both share a clock; or record motions that "
        "differ in duration."
    )


def _coarse_lags(motors: TimedColumns, camera: TimedColumns) -> list[tuple[float, float]]:
    """Return lags [s] at which motors and camera move at the same times, and their accuracy.

    The correlation of the speeds of both over every overlap of at least half the shorter recording.
    """
    duration = max(np.ptp(motors.time), np.ptp(camera.time))
    step = max(2.0 * float(np.median(np.diff(camera.time))), duration / _CELLS)
    q_speed = _speed(motors.values, motors.time, step)
    x_speed = _speed(_tip(camera.values), camera.time, step)
    score, shift = _correlation(x_speed, q_speed)
    peaks = np.flatnonzero(
        (score >= np.append(score[1:], -np.inf)) & (score > np.append(-np.inf, score[:-1]))
    )
    peaks = peaks[score[peaks] >= _SURE * score[peaks].max()]
    best = []
    for peak in peaks[np.argsort(-score[peaks])]:
        between = [score[min(peak, other) : max(peak, other)].min() for other in best]
        if max(between, default=-np.inf) < _VALLEY * score[peak]:
            best.append(peak)
    best = best[:_CANDIDATES]
    start = camera.time[0] - motors.time[0]
    return [(float(start - shift[k] * step), float(2.0 * step)) for k in best]


def _tip(x: NDArray) -> NDArray:
    """Return the positions (N, 3) of the last marker that is never or least often missing."""
    markers = x.reshape(len(x), -1, 3)
    n_known = np.isfinite(markers).all(axis=2).sum(axis=0)
    last = len(n_known) - 1 - int(np.argmax(n_known[::-1]))
    return markers[:, last]


def _speed(values: NDArray, time: NDArray, step: float) -> NDArray:
    """Return the root of the speed of rows in cells of equal time, columns by their range.

    The root makes single outliers less heavy.
    """
    complete = np.isfinite(values).all(axis=1)
    values = values[complete]
    ranges = np.ptp(values, axis=0)
    scaled = values / np.where(ranges > 0.0, ranges, 1.0)
    steps = np.linalg.norm(np.diff(scaled, axis=0), axis=1)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    edges = np.arange(time[0], time[-1] + step, step)
    return np.sqrt(np.diff(np.interp(edges, time[complete], way)))


def _correlation(a: NDArray, b: NDArray) -> tuple[NDArray, NDArray]:
    """Return how surely a (k,) follows b (m,), and at which shift of a by cells.

    The score is the coefficient of correlation of the overlapping cells, times the root of their
    number. The sums over all overlaps are products of Fourier transforms.
    """
    size = len(a) + len(b) - 1
    length = 1 << (size - 1).bit_length()

    def sums(of_a: NDArray, of_b: NDArray) -> NDArray:
        product = np.fft.rfft(of_b, length) * np.conj(np.fft.rfft(of_a, length))
        return np.roll(np.fft.irfft(product, length), len(a) - 1)[:size]

    a = a - a.mean()
    b = b - b.mean()
    ones_a = np.ones(len(a))
    ones_b = np.ones(len(b))
    n = np.rint(sums(ones_a, ones_b)).clip(1.0)
    sum_a = sums(a, ones_b)
    sum_b = sums(ones_a, b)
    covariance = sums(a, b) - sum_a * sum_b / n
    least = 1e-9 * (np.square(a).sum() + np.square(b).sum()) + np.finfo(float).tiny
    variance_a = np.maximum(sums(a**2, ones_b) - sum_a**2 / n, least)
    variance_b = np.maximum(sums(ones_a, b**2) - sum_b**2 / n, least)
    score = covariance / np.sqrt(variance_a * variance_b) * np.sqrt(n)
    score[n < _OVERLAP * min(len(a), len(b))] = -np.inf
    return score, np.arange(size) - (len(a) - 1)


def _refined(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float, hold: bool
) -> Candidate:
    """Return the best lag nearby."""
    tips = _surely_covered(motors, camera, lag, width)
    shifts = np.linspace(-width, width, 17)
    for _ in range(_WINDOWS):
        if not len(tips.time):
            return Candidate(1.0, lag, width)
        errors = [_left_at(shift, lag, motors, tips, hold, 2) for shift in shifts]
        best = int(np.argmin(errors))
        lag += float(shifts[best])
        if 0 < best < len(shifts) - 1:
            break
        tips = _surely_covered(motors, camera, lag, width)
    q = commands_at(motors, tips.time - lag, hold)
    return Candidate(1.0 - explained_share(q, tips.values)[0], lag, width)


def polished(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float, hold: bool
) -> float:
    """Return the best lag near one of the fine search, by a polynomial of the commands."""
    tips = _surely_covered(motors, camera, lag, width)
    if not len(tips.time):
        return lag
    _, degree = explained_share(commands_at(motors, tips.time - lag, hold), tips.values)
    fit = minimize_scalar(
        _left_at,
        args=(lag, motors, tips, hold, degree),
        bounds=(-width, width),  # its tolerance is relative, and a lag can be years
        method="bounded",
        options={"xatol": 1e-4 * width},
    )
    return lag + float(fit.x)  # pyright: ignore[reportAttributeAccessIssue]


def _surely_covered(
    motors: TimedColumns, camera: TimedColumns, lag: float, width: float
) -> TimedColumns:
    """Return some tips within the motor rows at every lag of a window; none if they are too short.

    So every lag of a window is judged by the same rows.
    """
    tips = _tip(camera.values)
    first = camera.time - lag - width
    inside = (first >= motors.time[0]) & (first + 2.0 * width <= motors.time[-1])
    rows = np.flatnonzero(inside & np.isfinite(tips).all(axis=1))
    rows = rows[np.linspace(0, len(rows) - 1, min(len(rows), _ROWS)).astype(int)]
    shortest = _OVERLAP * min(np.ptp(motors.time), np.ptp(camera.time)) - 2.0 * width
    if len(rows) < 3 or np.ptp(camera.time[rows]) < shortest:
        rows = rows[:0]
    return TimedColumns(tips[rows], camera.time[rows])


def _left_at(
    shift: float,
    lag: float,
    motors: TimedColumns,
    tips: TimedColumns,
    hold: bool,
    degree: int,
) -> float:
    """Return the share of the variance of tips that the commands leave at a shifted lag."""
    q = commands_at(motors, tips.time - lag - shift, hold)
    return _unexplained(q, tips.values, degree)


def _unexplained(q: NDArray, x: NDArray, degree: int) -> float:
    """Return the share of the variance of tips that a polynomial of the commands leaves."""
    features = _features(q, degree)
    weights = _weights(features, x)
    n_free = max(len(x) - features.shape[1], 1)
    left = np.square(x - features @ weights).sum() * len(x) / n_free
    total = np.square(x - x.mean(axis=0)).sum()
    return float(left / total) if total > 0.0 else 1.0


def explained_share(q: NDArray, x: NDArray) -> tuple[float, int]:
    """Return the share of the variance of tips that the commands explain in other parts of a log.

    That of three parts in a row, each from the other two, by a polynomial of the best degree, and
    that degree. Smooth motions that have nothing to do with each other agree within one part.
    """
    tips = _tip(x)
    complete = np.isfinite(tips).all(axis=1)
    q = q[complete]
    tips = tips[complete]
    few = np.linspace(0, len(q) - 1, min(len(q), _ROWS)).astype(int)
    q = q[few]
    tips = tips[few]
    total = np.square(tips - tips.mean(axis=0)).sum()
    if not total > 0.0:
        return 0.0, 1
    explained = []
    for degree in _DEGREES:
        features = _features(q, degree)
        left = 0.0
        for part in np.array_split(np.arange(len(q)), _PARTS):
            rows = np.delete(np.arange(len(q)), part)
            weights = _weights(features[rows], tips[rows])
            left += np.square(tips[part] - features[part] @ weights).sum()
        explained.append(1.0 - float(left / total))
    best = int(np.argmax(explained))
    return max(explained[best], 0.0), _DEGREES[best]


def _weights(features: NDArray, x: NDArray) -> NDArray:
    """Return the weights (k, 3) of least squares; a tiny ridge keeps rows at rest solvable."""
    gram = features.T @ features
    ridge = _RIDGE * np.trace(gram) / len(gram)
    return np.linalg.solve(gram + ridge * np.eye(len(gram)), features.T @ x)


def _features(q: NDArray, degree: int) -> NDArray:
    """Return the products of up to `degree` of 1 and z for commands (N, n), z from -1 to 1.

    Where these are too many for the rows, products of fewer; at least z^2 where `degree` is 2.
    """
    n = q.shape[1]
    rough = rough_features(q, q)
    if degree == 1:
        return rough[:, : 1 + n]
    most = min(_FEATURES, len(q) / _ROWS_PER_FEATURE)
    if math.comb(n + degree, degree) > most:
        return rough if degree == 2 else _features(q, degree - 1)
    factors = rough[:, : 1 + n].T  # of which the first is 1
    chosen = itertools.combinations_with_replacement(factors, degree)
    return np.stack([np.prod(product, axis=0) for product in chosen], axis=1)
