"""Faults of encoders in a log: counts that wrap, turns that are lost, readings one turn off.

Motors report counts or angles of limited range. A fault is a whole number of periods, such as 4096
counts or 360 degrees, that must be subtracted from the readings of some rows of a column.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import NDArray

WRAP = "wrap"
TURNS = "turns"
GLITCH = "glitch"

_POWERS = 2.0 ** np.array([*range(8, 17), 24, 32])
_DECIMAL = np.array([1e3, 2e3, 3600.0, 4e3, 1e4, 36000.0])
_COUNTS = tuple(np.sort(np.append(_POWERS, _DECIMAL)).tolist())
_PERIODS = {
    "deg": (360.0,),
    "rad": (2.0 * np.pi,),
}  # of other units that are no lengths: counts
_GAP = 0.25  # least part of a period without readings in which a wrap is cut
_WRAPPED = 0.5  # least range of readings that wrap, in periods
_SMALL = 0.45  # largest usual step between rows, in periods
_MOST_LOSSES = 3  # of turns, in a column
_GLITCHES = 0.01  # largest share of the rows that are glitches, if not three
_MOVES = 10  # least number of other moves of the column for each that is no move
_BRIEF = 3  # most rows of a glitch
_BETTER = 0.9  # largest error of a rough model after a mend, relative to that before
_NEEDED = 1.02  # least error without the mend of one column, relative to that with it
_POSTURES = 5  # least number of different rows for each feature of that model
_SUDDEN = 0.1  # largest step without the fault, relative to the period, where that is proof
_AROUND = 5  # rows before and after a change over which a calm tip is proof
_CALM = 3.0  # largest step of the tip at a glitch, relative to the 90 % quantile of its steps
_ROWS = 4000  # of the rough model


@dataclass(frozen=True, eq=False)
class EncoderFault:
    """Readings of a column that are whole periods off.

    Attributes
    ----------
    column : int
        Place of the column in q.
    kind : str
        "wrap": the encoder starts again after a period; "turns": it lost turns at some rows;
        "glitch": single readings are off.
    period : float
        The period, in the unit of the file.
    turns : ndarray of shape (N,)
        Number of periods to subtract from every reading [1].
    """

    column: int
    kind: str
    period: float
    turns: NDArray

    @property
    def rows(self) -> NDArray:
        """The rows to name: of glitches all, else those at which the number of periods changes."""
        if self.kind == GLITCH:
            return np.flatnonzero(self.turns)
        return np.flatnonzero(np.diff(self.turns)) + 1

    def mended(self, q: NDArray) -> NDArray:
        """Return readings (N, n) with those of the column corrected."""
        corrected = q.copy()
        corrected[:, self.column] -= self.period * self.turns
        return corrected


def periods_of(q_unit: str) -> tuple[float, ...]:
    """Return the usual periods of encoders in the unit of a file; of lengths none."""
    if q_unit in ("m", "cm", "mm", "um", "in"):
        return ()
    return _PERIODS.get(q_unit, _COUNTS)


def given_periods(
    unwrap: bool | float | Mapping[str, float], names: list[str], q_unit: str
) -> list[tuple[float, ...]]:
    """Return the periods to try for every column, of the argument `unwrap`; none: leave it."""
    if unwrap is False:
        return [()] * len(names)
    if unwrap is True:
        usual = periods_of(q_unit)
        if not usual:
            raise ValueError(
                f"`unwrap` must be the period of the encoders where q is a length, in {q_unit}, "
                "got True."
            )
        return [usual] * len(names)
    by_name: Mapping[str, Any] = dict.fromkeys(names, unwrap)
    if isinstance(unwrap, Mapping):
        by_name = unwrap
    unknown = {*by_name} - {*names}
    for name, period in by_name.items():
        is_number = isinstance(period, Real) and not isinstance(period, bool)
        good = is_number and 0.0 < float(period) < np.inf
        if unknown or not good:
            raise ValueError(
                "`unwrap` must be true, a positive period in the unit of the file, or such a "
                f"period for some of the columns {names}, got {name!r}: {period!r}."
            )
    return [(float(by_name[name]),) if name in by_name else () for name in names]


def unwrapped(
    q: NDArray, x: NDArray, same_run: NDArray, periods: list[tuple[float, ...]]
) -> NDArray:
    """Return readings (N, n) without the faults that are found; a given period is believed.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Readings in the unit of the file, in order of time.
    x : ndarray of shape (N, m)
        Measured positions, NaN where they are missing.
    same_run : ndarray of shape (N - 1,)
        Whether each row and the next follow without a break.
    periods : list of tuple of float
        Periods to try for every column. A single one is that of the encoder.
    """
    for fault in encoder_faults(q, x, same_run, periods):
        q = fault.mended(q)
    for column, of_column in enumerate(periods):
        if len(of_column) == 1:
            for fault in _in_order(q, column, of_column[0]):
                q = fault.mended(q)
    return q


def encoder_faults(
    q: NDArray, x: NDArray, same_run: NDArray, periods: list[tuple[float, ...]]
) -> list[EncoderFault]:
    """Return the faults of encoders for which the tips speak; parameters as of `unwrapped`.

    A tip does not see the encoder. So it does not jump where a reading does, and a rough model of
    it is better without a fault.
    """
    # A glitch and a lost turn leave the range of one period, in which readings that wrap stay.
    wraps = []
    for column, of_column in enumerate(periods):
        candidates = [fault for p in of_column for fault in _wraps(q, column, p)]
        wraps += candidates[:1]
    wraps = _believed(q, x, same_run, wraps)
    wrapped = {fault.column for fault in wraps}
    untouched = [() if k in wrapped else p for k, p in enumerate(periods)]
    mended = q
    for fault in wraps:
        mended = fault.mended(mended)
    calm = _calm(x, same_run, 1)
    glitches = []
    for column, of_column in enumerate(untouched):
        candidates = [*_glitches(mended, column, of_column, calm)]
        glitches += _best([_error_in_rows(mended, x, f) for f in candidates], candidates)
    for fault in glitches:
        mended = fault.mended(mended)
    lost = []
    for column, of_column in enumerate(untouched):
        candidates = [*_lost_turns(mended, column, of_column)]
        lost += _best([_error(mended, x, [f]) for f in candidates], candidates)
    return [*wraps, *_believed(mended, x, same_run, lost), *glitches]


def _best(errors: list[float], candidates: list[EncoderFault]) -> list[EncoderFault]:
    """Return the fault of least error with the fewest turns, if there is any."""
    sizes = [np.abs(fault.turns).sum() for fault in candidates]
    ranked = sorted(range(len(errors)), key=lambda k: (errors[k], sizes[k]))
    return [candidates[k] for k in ranked[:1] if errors[k] < np.inf]


def _wraps(q: NDArray, column: int, period: float) -> Iterator[EncoderFault]:
    """Yield a wrap of a column whose readings lie at both ends of one period."""
    values = q[:, column]
    for low in (0.0, -0.5 * period):
        inside = low <= values.min() and values.max() < low + period
        if not inside or np.ptp(values) < _WRAPPED * period:
            continue
        levels = np.unique(values)
        gaps = np.diff(levels)
        widest = int(np.argmax(gaps))
        at_ends = period - np.ptp(values)
        if gaps[widest] >= max(_GAP * period, 2.0 * at_ends):
            turns = (values > levels[widest]).astype(int)
            yield EncoderFault(column, WRAP, period, turns)
        else:
            yield from _in_order(q, column, period)


def _in_order(q: NDArray, column: int, period: float) -> Iterator[EncoderFault]:
    """Yield the wrap that leaves no step of more than half a period from row to row."""
    steps = np.diff(q[:, column])
    changes = np.rint(steps / period).astype(int)
    left = np.abs(steps - period * changes)
    usual = left.max(initial=0.0) <= _SMALL * period
    if changes.any() and usual:
        turns = np.concatenate([[0], np.cumsum(changes)])
        yield EncoderFault(column, WRAP, period, turns - int(np.median(turns)))


def _lost_turns(q: NDArray, column: int, periods: tuple[float, ...]) -> Iterator[EncoderFault]:
    """Yield the turns that a column lost at few rows, for every period that is possible."""
    steps = np.diff(q[:, column])
    for period in periods:
        changes = np.rint(steps / period).astype(int)
        left = np.abs(steps - period * changes)
        usual = np.quantile(left[changes == 0], 0.99) if (changes == 0).any() else np.inf
        rows = np.flatnonzero(changes)
        moves = np.count_nonzero(steps) - len(rows)
        if not 0 < len(rows) <= min(_MOST_LOSSES, moves / _MOVES) or usual > _SMALL * period:
            continue
        if left[rows].max() > max(2.0 * usual, 1e-9 * period):
            continue
        turns = np.concatenate([[0], np.cumsum(changes)])
        yield EncoderFault(column, TURNS, period, turns)


def _glitches(
    q: NDArray, column: int, periods: tuple[float, ...], calm: NDArray
) -> Iterator[EncoderFault]:
    """Yield single readings that are whole periods off while the tip is calm, for every period."""
    steps = np.diff(q[:, column])
    for period in periods:
        turns = _brief(steps, period)
        rows = np.flatnonzero(turns)
        most = min(max(_GLITCHES * len(q), 3), np.count_nonzero(steps) / _MOVES)
        if not 0 < len(rows) <= most or not calm[rows].all():
            continue
        left = np.abs(np.diff(q[:, column] - period * turns))
        beside = np.unique(np.concatenate([rows - 1, rows]).clip(0, len(steps) - 1))
        elsewhere = np.delete(left, beside)
        usual = np.quantile(elsewhere, 0.99) if len(elsewhere) else np.inf
        if usual <= _SMALL * period and left[beside].max() <= 2.0 * usual:
            yield EncoderFault(column, GLITCH, period, turns)


def _brief(steps: NDArray, period: float) -> NDArray:
    """Return the periods (N,) that readings are off which return within a few rows."""
    changes = np.rint(steps / period).astype(int)
    turns = np.zeros(len(steps) + 1, dtype=int)
    starts = np.flatnonzero(changes)
    k = 0
    while k < len(starts) - 1:
        first = starts[k]
        last = starts[k + 1]
        if changes[first] == -changes[last] and last - first <= _BRIEF:
            turns[first + 1 : last + 1] = changes[first]
            k += 1
        k += 1
    return turns


def _calm(x: NDArray, same_run: NDArray, around: int) -> NDArray:
    """Return at which rows (N,) the tip moves as usual, from `around` rows before to after."""
    steps = np.linalg.norm(np.diff(x, axis=0), axis=1)
    steps = np.where(same_run & np.isfinite(steps), steps, 0.0)
    if not steps.any():
        return np.ones(len(x), dtype=bool)
    way = np.concatenate([[0.0], np.cumsum(steps)])
    rows = np.arange(len(x))
    after = way[np.minimum(rows + around, len(x) - 1)]
    before = way[np.maximum(rows - around, 0)]
    return after - before <= _CALM * np.quantile(after - before, 0.9)


def _believed(
    q: NDArray, x: NDArray, same_run: NDArray, faults: list[EncoderFault]
) -> list[EncoderFault]:
    """Return the faults that are certain by their steps, or by a rough model of the tips."""
    calm = _calm(x, same_run, _AROUND)
    believed = []
    doubtful = []
    for fault in faults:
        steps = np.abs(np.diff(fault.mended(q)[:, fault.column]))
        is_small = bool(steps.max() <= _SUDDEN * fault.period)
        if is_small and calm[fault.rows].all():
            believed.append(fault)
        else:
            doubtful.append(fault)
    certain = q
    for fault in believed:
        certain = fault.mended(certain)
    least = _error(certain, x, doubtful)
    n_postures = len(np.unique(q, axis=0))
    few = n_postures < _POSTURES * (1 + 2 * q.shape[1])
    if few or least > _BETTER * _error(certain, x, []):
        return believed
    for fault in doubtful:
        remaining = [other for other in doubtful if other is not fault]
        if _error(certain, x, remaining) > _NEEDED * least:
            believed.append(fault)
    return believed


def _error(q: NDArray, x: NDArray, faults: list[EncoderFault]) -> float:
    """Return the error of a rough model of the tips on readings without some faults."""
    for fault in faults:
        q = fault.mended(q)
    rows = _some_measured(x)
    features = _features(q[rows], q[rows])
    weights = np.linalg.lstsq(features, x[rows])[0]
    return float(np.linalg.norm(x[rows] - features @ weights))


def _error_in_rows(q: NDArray, x: NDArray, fault: EncoderFault) -> float:
    """Return the error in the rows of a glitch of a rough model of all others.

    It is infinite if the model does not explain these rows better without the glitch.
    """
    unknown = np.flatnonzero(np.isnan(x).any(axis=1))
    rows = np.setdiff1d(fault.rows, unknown)
    usual = np.setdiff1d(_some_measured(x), rows)
    weights = np.linalg.lstsq(_features(q[usual], q[usual]), x[usual])[0]
    errors = []
    for readings in (q, fault.mended(q)):
        left = x[rows] - _features(readings[rows], q[usual]) @ weights
        errors.append(float(np.linalg.norm(left)))
    return errors[1] if errors[1] < _BETTER * errors[0] else np.inf


def _some_measured(x: NDArray) -> NDArray:
    """Return rows with a measured tip, not more than a rough model needs."""
    measured = np.flatnonzero(np.isfinite(x).all(axis=1))
    few = np.linspace(0, len(measured) - 1, min(len(measured), _ROWS)).astype(int)
    return measured[few]


def _features(q: NDArray, usual: NDArray) -> NDArray:
    """Return 1, z and z^2 of readings (N, n), z from -1 to 1 over the range of usual ones."""
    low = usual.min(axis=0)
    ranges = np.ptp(usual, axis=0)
    z = 2.0 * (q - low) / np.where(ranges > 0.0, ranges, 1.0) - 1.0
    return np.hstack([np.ones((len(z), 1)), z, z**2])
