"""Checks of the columns of a log: sensors, equal rows, jumps, times and motions."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin import Hysteresis
from hybridkin.app.checks.report import LogFinding
from hybridkin.datasets import Log
from hybridkin.formats import FRAMES, duration_in_words, in_terms, named_places

_FROZEN_ROWS = 3  # fewer rows may be chance
_FROZEN_WAY = 0.1  # part of an actuator's range over which the tip must have moved
_OFTEN_STILL = 0.2  # part of the rows: a coordinate that rests so often is no sensor
_ABRUPT = 3.0  # least change before or after a rest that is no rounding, in smallest changes
_RESTS = 0.05  # the same for an actuator, elsewhere
_JUMP = 3.0  # relative to the 90 % quantile of the steps
_MANY_ROWS = 1000  # of longer logs chance gives larger jumps
_GAP = 10.0  # relative to the median time step
_FEW_MOTIONS = 5
_FEW_ROWS = 30
_FEW_COMMANDS = 10  # repeated commands from which the spread of the tips is known


@dataclass(frozen=True)
class LogRows:
    """The valid rows of a log, and their row numbers in the whole log."""

    log: Log
    numbers: NDArray

    @property
    def places(self) -> tuple[str, NDArray]:
        """What names the rows, "line" of a file or "row" of the log, and these numbers."""
        if self.log.line is None:
            return "row", self.numbers
        return "line", self.log.line

    def named(self, rows: NDArray) -> str:
        """Return rows as text."""
        kind, places = self.places
        return named_places(places[rows], kind)

    def finding(
        self,
        kind: str,
        message: str,
        advice: str,
        rows: ArrayLike = (),
        severity: str = "warning",
    ) -> LogFinding:
        """Return a finding about some rows, or all rows."""
        numbers = self.numbers[np.asarray(rows, dtype=int)]
        return LogFinding(kind, severity, message, advice, numbers)

    def columns(self, which: str) -> list[tuple[str, NDArray]]:
        """Return the columns of "q" or "x" with their names."""
        values = self.log.q if which == "q" else self.log.x
        return list(zip(self.log.column_names(which), values.T, strict=True))

    @property
    def same_motion(self) -> NDArray:
        """Whether each row and the next belong to the same motion, shape (N - 1,)."""
        groups = self.log.groups
        if groups is None:
            return np.ones(len(self.log.q) - 1, dtype=bool)
        return groups[1:] == groups[:-1]

    @property
    def runs(self) -> NDArray:
        """The run of every row, without such a column its motion (N,)."""
        return self.log.commands.run_of_rows


def frozen_tip(rows: LogRows) -> Iterator[LogFinding]:
    """Yield rows in which the tip, or a coordinate of it, is still while actuators move."""
    still = np.diff(rows.log.x, axis=0) == 0
    tip_still = still.all(axis=1)
    tip_frozen = _still_while_moving(rows.log.q, tip_still)
    if len(tip_frozen) and not tip_still.all():
        yield _frozen_sensor(rows, "the tip", tip_frozen, "error")
    for (name, _), coordinate_still in zip(rows.columns("x"), still.T, strict=True):
        frozen = _still_while_moving(rows.log.q, coordinate_still)
        frozen = np.setdiff1d(frozen, tip_frozen)
        if len(frozen) and coordinate_still.mean() < _OFTEN_STILL:
            yield _frozen_sensor(rows, f"column {name!r}", frozen, "warning")


def _frozen_sensor(rows: LogRows, what: str, frozen: NDArray, severity: str) -> LogFinding:
    message = (
        f"{what} does not change at all in {len(frozen)} rows while the actuators move "
        f"({rows.named(frozen)}): the sensor was frozen or lost the marker."
    )
    advice = "leave these rows out with --drop-frozen, or delete them from the log."
    return rows.finding("frozen tip", message, advice, frozen, severity)


def _still_while_moving(q: NDArray, still: NDArray) -> NDArray:
    """Return the rows of still steps (N - 1,) during which an actuator moves considerably."""
    ranges = np.ptp(q, axis=0)
    ranges[ranges == 0] = np.inf
    frozen = [np.empty(0, dtype=int)]
    for first, last in _still_periods(still):
        way = (np.ptp(q[first : last + 1], axis=0) / ranges).max()
        if way >= _FROZEN_WAY:
            frozen.append(np.arange(first, last + 1))
    return np.concatenate(frozen)


def _still_periods(still: NDArray) -> list[tuple[int, int]]:
    """Return the first and last row of each period of still steps that is not chance."""
    padded = np.concatenate([[0], still, [0]])
    changes = np.flatnonzero(np.diff(padded)).reshape(-1, 2)
    long_enough = changes[:, 1] - changes[:, 0] >= _FROZEN_ROWS - 1
    return changes[long_enough].tolist()


def frozen_actuator(rows: LogRows) -> Iterator[LogFinding]:
    """Yield actuators that change from row to row, but rest once while the tip moves.

    Commands are often constant, measured values never.
    """
    x = rows.log.x
    tip_range = np.linalg.norm(np.ptp(x, axis=0))
    for name, column in rows.columns("q"):
        steps = np.abs(np.diff(column))
        still = steps == 0
        periods = [(a, b) for a, b in _still_periods(still) if b - a >= _FROZEN_ROWS]
        if len(periods) != 1:
            continue
        first, last = periods[0]
        n_still = last - first
        way = np.linalg.norm(np.ptp(x[first : last + 1], axis=0))
        often = still.sum() - n_still >= _RESTS * len(still)
        mostly = n_still >= 0.5 * len(still)
        value_recurs = (column == column[first]).sum() > n_still + 2
        beside = steps[[max(first - 1, 0), min(last, len(steps) - 1)]].max()
        # What turns around slowly rests by rounding; a frozen sensor stops, or jumps, at once.
        slow = beside < _ABRUPT * steps[steps > 0].min(initial=np.inf)
        if often or mostly or value_recurs or slow or way <= _FROZEN_WAY * tip_range:
            continue
        frozen = np.arange(first, last + 1)
        message = (
            f"actuator {name!r}, which changes from row to row elsewhere, does not change at "
            f"all in {len(frozen)} rows ({rows.named(frozen)}) while the tip moves."
        )
        advice = "if its sensor was frozen, leave these rows out; if it was at rest, keep them."
        yield rows.finding("frozen actuator", message, advice, frozen)


_CONSTANT = {
    "q": (
        "actuators that never move",
        "their effect is not identified: record motions of each, or do not move them in use.",
    ),
    "x": (
        "tip columns that never change",
        "check the names of the columns; a motion in one plane is fitted in that plane only.",
    ),
}


def constant_columns(rows: LogRows) -> Iterator[LogFinding]:
    """Yield the columns that never change; an error if these are all of q or x."""
    for which, (what, advice) in _CONSTANT.items():
        columns = rows.columns(which)
        constant = [repr(name) for name, column in columns if np.ptp(column) == 0]
        if constant:
            severity = "error" if len(constant) == len(columns) else "warning"
            message = f"{what}: {', '.join(constant)}."
            yield rows.finding("constant", message, advice, severity=severity)


def unmoved_directions(rows: LogRows) -> Iterator[LogFinding]:
    """Yield the combinations of actuators that do not move, e.g. of tendons in balance."""
    q = rows.log.q
    if len(q) <= q.shape[1] or not np.ptp(q, axis=0).all():
        return
    directions = rows.log.commands.directions
    if directions.still.size:
        signs = np.broadcast_to(rows.log.q_sign, q.shape[1])
        of_columns = directions.normals() * signs[:, None]
        still = in_terms(of_columns, rows.log.column_names("q"))
        message = f"the log has no motion along {still}, or only by rounding or less than 1 %."
        advice = (
            "nothing is learned there. Commands keep to the log where the mechanical model knows "
            "no effect; record rows that move the actuators independently if you need such motions."
        )
        yield rows.finding("no motion", message, advice, severity="note")


def same_columns(rows: LogRows) -> Iterator[LogFinding]:
    """Yield pairs of columns with the same values."""
    columns = [*rows.columns("q"), *rows.columns("x")]
    for (first, a), (second, b) in itertools.combinations(columns, 2):
        if np.ptp(a) > 0 and (a == b).all():
            message = f"columns {first!r} and {second!r} hold the same values in all rows."
            advice = "check the names of the columns; equal actuators cannot be distinguished."
            yield rows.finding("same column", message, advice)


def duplicates(rows: LogRows) -> Iterator[LogFinding]:
    """Yield rows that are exact copies of earlier ones."""
    original = _first_equal(np.hstack([rows.log.q, rows.log.x]))
    copies = np.flatnonzero(original < np.arange(len(original)))
    if not len(copies):
        return
    message = f"{len(copies)} rows are exact copies of earlier ones"
    groups = rows.log.groups
    if groups is not None:
        n_across = (groups[copies] != groups[original[copies]]).sum()
        if n_across:
            message += f", {n_across} of them in another motion"
    advice = "delete them: copies in training and test rows make held-out errors too small."
    yield rows.finding("duplicates", f"{message} ({rows.named(copies)}).", advice, copies)


def _first_equal(values: NDArray) -> NDArray:
    """Return for each row (N, k) the first row that is equal to it (N,)."""
    values = np.ascontiguousarray(values, dtype=np.float64) + 0.0  # -0.0 equals 0.0
    whole_row = np.dtype((np.void, values.itemsize * values.shape[1]))
    keys = values.view(whole_row)[:, 0]
    _, first, place = np.unique(keys, return_index=True, return_inverse=True)
    return first[place]


def same_commands(rows: LogRows) -> Iterator[LogFinding]:
    """Yield the spread of the tips at equal commands: noise, or backlash."""
    different = np.unique(_first_equal(np.hstack([rows.log.q, rows.log.x])))
    x = rows.log.x[different]
    _, command = np.unique(_first_equal(rows.log.q[different]), return_inverse=True)
    counts = np.bincount(command)
    repeated = counts[command] > 1
    if repeated.sum() < _FEW_COMMANDS:
        return
    means = np.zeros((len(counts), x.shape[1]))
    np.add.at(means, command, x)
    means /= counts[:, None]
    squares = ((x - means[command])[repeated] ** 2).sum()
    spread = np.sqrt(squares / (repeated.sum() - (counts > 1).sum()))
    message = (
        f"{repeated.sum()} rows have the same command as another row, as in a motion out and "
        f"back; their tips differ by {1e3 * spread:.3g} mm rms."
    )
    advice = (
        "this is noise, or backlash (also called play) if the robot came from another side, "
        "which --hysteresis auto (hysteresis=) can fit; other models cannot have a smaller error."
    )
    yield rows.finding("same command", message, advice, different[repeated], "note")


def jumps(rows: LogRows) -> Iterator[LogFinding]:
    """Yield rows at which the tip moves much farther than the actuators explain."""
    ranges = np.ptp(rows.log.q, axis=0)
    unit = np.where(ranges > 0, ranges, 1.0)
    dq = np.linalg.norm(np.diff(rows.log.q / unit, axis=0), axis=1)
    dx = np.linalg.norm(np.diff(rows.log.x, axis=0), axis=1)
    n_rows = len(rows.log.q)
    if n_rows < _FEW_ROWS or not dx.any():
        return
    within = rows.same_motion
    if not within.any():
        within = np.ones_like(within)
    ratio = dx / np.maximum(dq + np.median(dq[within]), np.finfo(float).tiny)
    chance = np.sqrt(max(1.0, np.log(n_rows) / np.log(_MANY_ROWS)))
    steps = np.flatnonzero(ratio > chance * _JUMP * np.quantile(ratio[dx > 0], 0.9))
    if 0 < len(steps) <= 0.1 * n_rows:
        message = (
            f"the tip jumps by up to {1e3 * dx[steps].max():.4g} mm, far more than the actuators "
            f"explain, at {len(steps)} rows ({rows.named(steps + 1)})."
        )
        advice = (
            "look at these rows: a swapped or lost marker, or a robot that snaps; --loss soft_l1 "
            "limits the effect of outliers on the calibration."
        )
        yield rows.finding("jumps", message, advice, steps + 1)


def times(rows: LogRows) -> Iterator[LogFinding]:
    """Yield a wrong unit of time, rows whose time does not increase in a run, and gaps.

    Times may restart with each run.
    """
    time = rows.log.time
    if time is None:
        return
    commands = rows.log.commands
    doubt = commands.clock_doubt
    if doubt.unit:
        message = f"{doubt.reason}, which are hardly seconds."
        if doubt.certain:
            message = f"{doubt.reason}: these are no seconds."
        severity = "warning"
        if doubt.unit == FRAMES:
            severity = "note"
        advice = f"{doubt.way_out}."
        yield rows.finding("time", message, advice, severity=severity)
    order = commands.order
    steps = order.steps(time)
    late = np.sort(order.order[(steps <= 0.0) & ~order.first])
    if len(late):
        message = f"times do not increase at {len(late)} rows ({rows.named(late)})."
        advice = (
            "sort the rows by time in each run; backlash and lag depend on the order. If times "
            "restart with each recording, name it: --runs COLUMN, or runs = in [log]."
        )
        yield rows.finding("time", message, advice, late)
    if (steps > 0.0).sum() < 10:
        return
    usual = np.median(steps[steps > 0.0])
    is_gap = steps > _GAP * usual
    gaps = np.sort(order.order[is_gap])
    if len(gaps):
        message = (
            f"{len(gaps)} gaps in time within a run, up to "
            f"{duration_in_words(steps[is_gap].max())}; the usual step is "
            f"{duration_in_words(usual)} ({rows.named(gaps)})."
        )
        advice = "rows were lost or the robot waited; if it was touched, name two motions."
        yield rows.finding("time", message, advice, gaps)


def reversals(rows: LogRows) -> Iterator[LogFinding]:
    """Yield a finding if actuators reverse at more than a third of the rows of a run."""
    log = rows.log
    if log.groups is None and log.runs is None:
        return
    coarse = Hysteresis.coarseness(log.commands)
    if coarse.shows_reversals:
        return
    name, _ = rows.columns("q")[int(coarse.reversing.argmax())]
    message = (
        f"actuator {name!r} reverses at {100.0 * coarse.reversing.max():.0f} % of the rows within "
        "runs: what the actuators do between the rows is not in the log."
    )
    advice = (
        "this is right for postures at rest; to find backlash, friction or creep, record rows "
        "closer in time, also those without a measured tip."
    )
    yield rows.finding("reversals", message, advice, severity="note")


def few_rows(rows: LogRows) -> Iterator[LogFinding]:
    """Yield a finding if there are too few rows."""
    n_rows = len(rows.log.q)
    if n_rows < _FEW_ROWS:
        advice = "record some hundred rows, spread over the whole workspace."
        yield rows.finding("rows", f"the log has only {n_rows} rows.", advice)


def motions(rows: LogRows) -> Iterator[LogFinding]:
    """Yield a finding if the motions do not serve held-out errors."""
    n_rows = len(rows.log.q)
    if rows.log.groups is None:
        message = "no column names the motion of a row: ten parts of the log are held out instead."
        advice = "give `groups` (--groups COLUMN, or groups = in [log])."
        yield rows.finding("motions", message, advice)
        return
    n = len(np.unique(rows.log.groups))
    if n > max(0.5 * n_rows, _FEW_MOTIONS):
        message = f"{n} motions in {n_rows} rows: nearly every row is a motion, a random split."
        advice = "give rows of one motion the same name; for poses taken at random this is right."
        yield rows.finding("motions", message, advice)
    elif n < _FEW_MOTIONS:
        few = f"the log has only {n} motion{'s' if n > 1 else ''}"
        message = f"{few}: errors on held-out motions are uncertain."
        advice = "record more motions, or cut long motions into different parts."
        yield rows.finding("motions", message, advice)


COLUMN_CHECKS: tuple[Callable[[LogRows], Iterator[LogFinding]], ...] = (
    frozen_tip,
    frozen_actuator,
    constant_columns,
    unmoved_directions,
    same_columns,
    duplicates,
    same_commands,
    jumps,
    times,
    reversals,
    few_rows,
    motions,
)
