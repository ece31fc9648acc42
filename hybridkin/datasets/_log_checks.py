"""Checks of a log before a fit: findings with their rows and advice."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import countable
from hybridkin._core.directions import in_terms, moved_directions
from hybridkin.datasets._log_geometry import geometry_findings, in_metres, zero_findings
from hybridkin.datasets._log_report import (
    MISREAD,
    SEVERITIES,
    LogFinding,
    LogReport,
    named_rows,
)
from hybridkin.datasets._log_residual import residual_findings
from hybridkin.datasets._logs import Log, column_names

_FROZEN_ROWS = 3  # fewer rows may be chance
_FROZEN_WAY = 0.1  # share of an actuator's range over which the tip must have moved
_JUMP = 3.0  # relative to the 90 % quantile of the steps
_GAP = 10.0  # relative to the median time step
_FEW_MOTIONS = 5
_FEW_ROWS = 30


def check_log(
    log: Log,
    *,
    chain: Any = None,
    base_is_free: bool = True,
    drop_invalid: bool = True,
) -> LogReport:
    """Return possible errors of a log: sensors, rows, times, motions, units and signs.

    The check looks for NaN and infinite rows, a frozen sensor of the tip or of an actuator while
    the rest moves, columns that never change, rows that occur twice, jumps of the tip, gaps in time
    and decreasing times, columns with the same values, a tip that lags or drifts, and too few
    motions for held-out errors. With a chain it also looks for wrong units, a wrong order or sign
    of the columns of q, actuators numbered in the other direction, rotated or left-handed axes of
    the tip, radii that are far off, and an offset or a drift of one actuator. Rows must be in order
    of time. With several markers, the last one, the tip, is checked in the rows that have it.

    Parameters
    ----------
    log : Log
        As from `load_log`; from arrays ``Log(q, x, groups)``.
    chain : ConstantCurvatureChain or ElasticTendonChain, optional
        Nominal kinematics, or a calibrated chain (``calibrate(...).chain``), which distinguishes
        orders of the columns better. None: units, order, signs and axes are not checked.
    base_is_free : bool, default=True
        Whether the pose of the base will be fitted. For tendons on a backbone of fixed length, a
        wrong sign of q then looks like a half turn of the base. It is reported if the base must
        rotate by more than 120 degrees about its axis.
    drop_invalid : bool, default=True
        Whether invalid rows are left out (a warning) or not (an error).

    Returns
    -------
    LogReport
        ``print(report)`` shows it; ``report.ok`` is False if a fit would be worthless.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import robots
    >>> from hybridkin.datasets import Log, check_log, load_trunk
    >>> data = load_trunk()
    >>> x = np.array(data.x)
    >>> x[100:140] = x[100]
    >>> report = check_log(Log(data.q, x), chain=robots.bionic_handling_assistant())
    >>> report.errors[0].kind, len(report.errors[0].rows)
    ('frozen tip', 40)
    """
    n_actuators = log.q.shape[1]
    if chain is not None and n_actuators != chain.n_actuators:
        raise ValueError(
            f"`log` must have {chain.n_actuators} actuators, as many as `chain`, got "
            f"{n_actuators}; check the columns of q."
        )
    several = log.x.shape[1] > 3
    if several:
        log = replace(log, x=log.x[:, -3:], x_names=log.x_names[-3:])
        if chain is not None:
            chain = chain.tip_model
    columns = np.column_stack([log.q, log.x]).astype(float)
    valid = np.asarray(countable(columns).all(axis=1))
    complete = valid | (several & countable(log.q).all(axis=1))
    findings = [*_invalid(log, complete, drop_invalid)]
    if valid.any():
        rows = _Rows(log.rows(valid), np.flatnonzero(valid))
        for check in (
            _frozen,
            _constant,
            _balanced,
            _same,
            _duplicates,
            _jumps,
            _times,
            _motions,
        ):
            findings += check(rows)
        geometry = [] if chain is None else [*zero_findings(rows.log, chain)]
        read, chain = in_metres(rows.log, chain)
        if chain is not None and not geometry:
            geometry = geometry_findings(read, chain, base_is_free)
        findings += geometry
        if not any(f.kind in MISREAD for f in geometry):
            findings += residual_findings(read, chain, rows.same_motion())
        columns = columns[valid]
    ranges = np.stack([columns.min(axis=0), columns.max(axis=0)], axis=1)
    return LogReport(
        tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))),
        n_rows=len(log.q),
        n_actuators=n_actuators,
        n_motions=None if log.groups is None else len(np.unique(log.groups)),
        q_range=ranges[:n_actuators],
        x_range=ranges[n_actuators:],
        duration=None if log.time is None else float(np.ptp(log.time)),
        source=log.source,
        q_unit=log.units["q"],
    )


class _Rows(NamedTuple):
    """The valid rows of a log, and their row numbers in the whole log."""

    log: Log
    numbers: NDArray

    def named(self, rows: ArrayLike) -> str:
        """Return rows as text."""
        kind, places = _places(self.log, self.numbers)
        return named_rows(places[np.asarray(rows)], kind)

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
        return [
            *zip(column_names(self.log, which), vars(self.log)[which].T, strict=True)
        ]

    def same_motion(self) -> NDArray:
        """Return whether each row and the next belong to the same motion, shape (N - 1,)."""
        if self.log.groups is None:
            groups = np.zeros(len(self.log.q))
        else:
            groups = self.log.groups
        return groups[1:] == groups[:-1]


def _places(log: Log, numbers: NDArray) -> tuple[str, NDArray]:
    """Return the places of a log's rows: "line" of a file, or "row" with the given numbers."""
    return ("row", numbers) if log.line is None else ("line", log.line)


def _invalid(log: Log, valid: NDArray, drop_invalid: bool) -> Iterator[LogFinding]:
    kind, places = _places(log, np.arange(len(valid)))
    lines = np.concatenate([places[~valid], log.invalid_lines]).astype(int)
    if len(lines) == 0:
        return
    n = len(valid) + len(log.invalid_lines)
    problem = (
        f"{len(lines)} of {n} rows have a missing, NaN or infinite value, or no motion"
    )
    problem = f"{problem} ({named_rows(lines, kind)})"
    if drop_invalid and valid.all():
        advice = "find out why: a marker that is hidden in some poses leaves a gap in the data."
        yield LogFinding(
            "invalid", "warning", f"{problem}; they were left out.", advice
        )
    else:
        advice = (
            "correct them, or leave them out with --drop-invalid (drop_invalid=True)."
        )
        yield LogFinding(
            "invalid", "error", f"{problem}.", advice, np.flatnonzero(~valid)
        )


def _runs(still: NDArray) -> list[tuple[int, int]]:
    """Return first and last row of each run in which all steps (N - 1,) are still."""
    edges = np.flatnonzero(
        np.diff(np.concatenate([[False], still, [False]]).astype(int))
    )
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _frozen(rows: _Rows) -> Iterator[LogFinding]:
    q = rows.log.q
    x = rows.log.x
    tips = np.empty(0, dtype=int)
    steps = np.diff(x, axis=0) == 0
    parts = [("the tip", "error", 1.0, steps.all(axis=1))]
    for (name, _), still in zip(rows.columns("x"), steps.T, strict=True):
        parts.append((f"column {name!r}", "warning", 0.2, still))
    for what, severity, most, still in parts:
        frozen = np.setdiff1d(_frozen_rows(q, still), tips)
        if len(frozen) and still.mean() < most:
            message = (
                f"{what} does not change at all in {len(frozen)} rows while the actuators move "
                f"({rows.named(frozen)}): the sensor was frozen or lost the marker."
            )
            advice = (
                "leave these rows out with --drop-frozen, or delete them from the log."
            )
            yield rows.finding("frozen tip", message, advice, frozen, severity)
        if what == "the tip":
            tips = np.union1d(tips, frozen)
    moved = np.linalg.norm(np.ptp(x, axis=0))
    for name, column in rows.columns("q"):
        still = np.diff(column) == 0
        runs = [run for run in _runs(still) if run[1] - run[0] >= _FROZEN_ROWS]
        if len(runs) != 1:  # commands are often constant, measured values never
            continue
        first, last = runs[0]
        elsewhere = still.sum() - (last - first)
        frozen_share = (last - first) / len(still)
        alone = (column == column[first]).sum() <= last - first + 2
        way = np.linalg.norm(np.ptp(x[first : last + 1], axis=0))
        if (
            elsewhere < 0.05 * len(still)
            and frozen_share < 0.5
            and alone
            and way > _FROZEN_WAY * moved
        ):
            frozen = np.arange(first, last + 1)
            message = (
                f"actuator {name!r}, which changes from row to row elsewhere, does not change at "
                f"all in {len(frozen)} rows ({rows.named(frozen)}) while the tip moves."
            )
            advice = "if its sensor was frozen, leave these rows out; if it was at rest, keep them."
            yield rows.finding("frozen actuator", message, advice, frozen)


def _frozen_rows(q: NDArray, still: NDArray) -> NDArray:
    """Return the still rows during which an actuator moves considerably."""
    spans = np.ptp(q, axis=0)
    spans[spans == 0] = np.inf
    frozen = np.zeros(len(q), dtype=bool)
    for first, last in _runs(still):
        way = (np.ptp(q[first : last + 1], axis=0) / spans).max()
        frozen[first : last + 1] = (
            last - first + 1 >= _FROZEN_ROWS and way >= _FROZEN_WAY
        )
    return np.flatnonzero(frozen)


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


def _constant(rows: _Rows) -> Iterator[LogFinding]:
    for which, (what, advice) in _CONSTANT.items():
        columns = rows.columns(which)
        flat = [repr(name) for name, column in columns if np.ptp(column) == 0]
        if flat:
            severity = "error" if len(flat) == len(columns) else "warning"
            message = f"{what}: {', '.join(flat)}."
            yield rows.finding("constant", message, advice, severity=severity)


def _balanced(rows: _Rows) -> Iterator[LogFinding]:
    q = rows.log.q
    if len(q) <= q.shape[1] or not np.ptp(q, axis=0).all():
        return
    directions = moved_directions(q)
    if directions.still.size:
        still = in_terms(directions.normals(), [name for name, _ in rows.columns("q")])
        message = f"the log has no motion along {still}, or only by rounding or less than 1 %."
        advice = (
            "nothing is learned there. Commands keep to the log where the mechanical model knows "
            "no effect; record rows that move the actuators independently if you need such motions."
        )
        yield rows.finding("no motion", message, advice, severity="note")


def _same(rows: _Rows) -> Iterator[LogFinding]:
    columns = [*rows.columns("q"), *rows.columns("x")]
    for (one, a), (other, b) in itertools.combinations(columns, 2):
        if np.ptp(a) > 0 and (a == b).all():
            message = f"columns {one!r} and {other!r} hold the same values in all rows."
            advice = "check the names of the columns; equal actuators cannot be distinguished."
            yield rows.finding("same column", message, advice)


def _first_alike(columns: NDArray) -> NDArray:
    """Return for each row the first row that is equal to it."""
    _, first, inverse = np.unique(
        columns, axis=0, return_index=True, return_inverse=True
    )
    return first[inverse.ravel()]


def _duplicates(rows: _Rows) -> Iterator[LogFinding]:
    q = rows.log.q
    x = rows.log.x
    groups = rows.log.groups
    original = _first_alike(np.column_stack([q, x]))
    copies = np.flatnonzero(original != np.arange(len(q)))
    if len(copies):
        if groups is None:
            n = 0
        else:
            n = int((groups[copies] != groups[original[copies]]).sum())
        across = f", {n} of them in another motion" if n else ""
        message = f"{len(copies)} rows are exact copies of earlier ones{across}"
        advice = "delete them: copies in training and test rows make held-out errors too small."
        yield rows.finding(
            "duplicates", f"{message} ({rows.named(copies)}).", advice, copies
        )
    keep = np.setdiff1d(np.arange(len(q)), copies)
    command = _first_alike(q[keep])
    counts = np.bincount(command)
    again = counts[command] > 1
    if again.sum() >= 10:
        # Standard deviation of the tips about the mean of their command, over repeated commands.
        sums = np.stack([np.bincount(command, c) for c in x[keep].T], axis=1)
        errors = x[keep] - (sums[command] / counts[command, None])
        spread = np.sqrt(
            (errors[again] ** 2).sum() / (again.sum() - (counts > 1).sum())
        )
        message = (
            f"{again.sum()} rows have the same command as another row, as in a motion out and "
            f"back; their tips differ by {1e3 * spread:.3g} mm rms."
        )
        advice = (
            "this is noise, or backlash (also called play) if the robot came from another side, "
            "which --play auto (play=) can fit; other models cannot have a smaller error."
        )
        yield rows.finding("same command", message, advice, keep[again], "note")


def _jumps(rows: _Rows) -> Iterator[LogFinding]:
    q = rows.log.q
    x = rows.log.x
    same = rows.same_motion()
    dq, dx = (np.linalg.norm(np.diff(array, axis=0), axis=1) for array in (q, x))
    if len(q) < _FEW_ROWS or not dx.any():
        return
    usual = np.median(dq[same] if same.any() else dq)
    ratio = dx / np.maximum(dq + usual, np.finfo(float).tiny)
    steps = np.flatnonzero(ratio > _JUMP * np.quantile(ratio[dx > 0], 0.9))
    if 0 < len(steps) <= 0.1 * len(q):
        message = (
            f"the tip jumps by up to {1e3 * dx[steps].max():.4g} mm, far more than the actuators "
            f"explain, at {len(steps)} rows ({rows.named(steps + 1)})."
        )
        advice = (
            "look at these rows: a swapped or lost marker, or a robot that snaps; --loss soft_l1 "
            "limits the effect of outliers on the calibration."
        )
        yield rows.finding("jumps", message, advice, steps + 1)


def _times(rows: _Rows) -> Iterator[LogFinding]:
    if rows.log.time is None:
        return
    step = np.diff(rows.log.time)
    same = rows.same_motion()
    late = np.flatnonzero(step <= 0) + 1
    if len(late):
        message = f"times do not increase at {len(late)} rows ({rows.named(late)})."
        advice = "sort the rows by time in each motion; backlash and lag depend on the order."
        yield rows.finding("time", message, advice, late)
    inside = step[same & (step > 0)]
    usual = float(np.median(inside)) if len(inside) >= 10 else np.inf
    gaps = np.flatnonzero(same & (step > _GAP * usual)) + 1
    if len(gaps):
        message = (
            f"{len(gaps)} gaps in time within a motion, up to {step[gaps - 1].max():.4g} s; the "
            f"usual step is {usual:.4g} s ({rows.named(gaps)})."
        )
        advice = (
            "rows were lost or the robot waited; if it was touched, name two motions."
        )
        yield rows.finding("time", message, advice, gaps)


def _motions(rows: _Rows) -> Iterator[LogFinding]:
    n_rows = len(rows.log.q)
    groups = rows.log.groups
    if n_rows < _FEW_ROWS:
        advice = "record some hundred rows, spread over the whole workspace."
        yield rows.finding("rows", f"the log has only {n_rows} rows.", advice)
    n = 0 if groups is None else len(np.unique(groups))
    if groups is None:
        message = "no column names the motion of a row: ten parts of the log are held out instead."
        advice = "give `groups` (--groups COLUMN, or groups = in [log])."
    elif n > max(0.5 * n_rows, _FEW_MOTIONS):
        message = f"{n} motions in {n_rows} rows: nearly every row is a motion, a random split."
        advice = "give rows of one motion the same name; for poses taken at random this is right."
    elif n < _FEW_MOTIONS:
        few = f"the log has only {n} motion{'s' if n > 1 else ''}"
        message = f"{few}: errors on held-out motions are uncertain."
        advice = "record more motions, or cut long motions into different parts."
    else:
        return
    yield rows.finding("motions", message, advice)
