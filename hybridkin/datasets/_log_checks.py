"""Checks of a log before a fit: what is wrong with it, where, and what to do."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin.datasets._log_geometry import geometry_findings
from hybridkin.datasets._log_report import MISREAD, SEVERITIES, LogFinding, LogReport, named_rows
from hybridkin.datasets._log_residual import residual_findings
from hybridkin.datasets._logs import Log

_FROZEN_ROWS = 3  # fewer may be chance
_FROZEN_WAY = 0.1  # of an actuator's range: the tip must have moved
_JUMP = 3.0  # times what nine steps in ten stay below
_GAP = 10.0  # median steps in time
_FEW_MOTIONS = 5
_FEW_ROWS = 30


def check_log(
    log: Log,
    *,
    chain: Any = None,
    base_is_free: bool = True,
    drop_invalid: bool = True,
) -> LogReport:
    """Return what may be wrong with a log: sensors, rows, times, motions, units and signs.

    The check looks for NaN and infinite rows, a tip or an actuator sensor that is frozen while the
    rest moves, columns that never change, rows that occur twice, jumps of the tip, gaps in time and
    times that run backwards, columns that hold the same, a tip that comes late or drifts, and too
    few motions to hold some out. With a chain it also looks for wrong units, columns of q in
    another order or of another sign, actuators numbered the other way round, axes of the tip that
    are turned or left-handed, radii that are far off, and an offset or a drift of one actuator.
    Rows must be in order of time.

    Parameters
    ----------
    log : Log
        As from `load_log`; of arrays ``Log(q, x, groups)``.
    chain : ConstantCurvatureChain or ElasticTendonChain, optional
        Nominal kinematics, or a calibrated chain (``calibrate(...).chain``), which tells orders of
        the columns apart more sharply. None: units, order, signs and axes are not checked.
    base_is_free : bool, default=True
        Whether the pose of the base will be fitted. With tendons on a backbone that does not
        stretch, a wrong sign of q then is a half turn of the base, which is named where the base
        is turned by more than 120 degrees about its axis.
    drop_invalid : bool, default=True
        Whether the reader was asked to leave out invalid rows (a warning) or not (an error).

    Returns
    -------
    LogReport
        ``print(report)`` shows it; ``report.ok`` is False where a fit would be worthless.

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
    q, x = np.asarray(log.q, dtype=float), np.asarray(log.x, dtype=float)
    if chain is not None and q.shape[1] != chain.n_actuators:
        raise ValueError(
            f"`log` must have {chain.n_actuators} actuators, as `chain` has, got {q.shape[1]}."
        )
    valid = np.asarray(np.isfinite(np.column_stack([q, x])).all(axis=1))
    findings = [*_invalid(log, valid, drop_invalid)]
    if valid.any():
        rows = _Rows(log.rows(valid), np.flatnonzero(valid))
        for check in (_frozen, _constant, _same, _duplicates, _jumps, _times, _motions):
            findings += check(rows)
        found = [] if chain is None else geometry_findings(rows.log, chain, base_is_free)
        findings += found
        if not any(f.kind in MISREAD for f in found):
            findings += residual_findings(rows.log, chain, rows.same_motion())
        q, x = q[valid], x[valid]
    else:
        q, x = 0.0 * q[:1], 0.0 * x[:1]
    return LogReport(
        tuple(sorted(findings, key=lambda finding: SEVERITIES.index(finding.severity))),
        n_rows=len(log.q),
        n_actuators=q.shape[1],
        n_motions=None if log.groups is None else len(np.unique(log.groups)),
        q_range=np.stack([q.min(axis=0), q.max(axis=0)], axis=1),
        x_range=np.stack([x.min(axis=0), x.max(axis=0)], axis=1),
        duration=None if log.time is None else float(np.ptp(log.time)),
        source=log.source,
        q_unit=log.units["q"],
    )


class _Rows(NamedTuple):
    """The valid rows of a log, and their numbers in the whole of it."""

    log: Log
    numbers: NDArray

    def named(self, rows: ArrayLike) -> str:
        """Return rows in words."""
        kind, places = ("row", self.numbers) if self.log.line is None else ("line", self.log.line)
        return named_rows(rows, places, kind)

    def finding(
        self, kind: str, severity: str, message: str, advice: str, rows: ArrayLike = ()
    ) -> LogFinding:
        """Return a finding about some rows, or all of them."""
        numbers = self.numbers[np.asarray(rows, dtype=int)]
        return LogFinding(kind, severity, message, advice, numbers)

    def columns(self, which: str) -> list[tuple[str, NDArray]]:
        """Return the columns of "q" or "x" with their names."""
        names, array = vars(self.log)[f"{which}_names"], vars(self.log)[which]
        names = names or [f"{which}[{i}]" for i in range(array.shape[1])]
        return [*zip(names, array.T, strict=True)]

    def same_motion(self) -> NDArray:
        """Return whether each row and the next belong to one motion, shape (N - 1,)."""
        groups = self.log.groups
        n = len(self.log.q) - 1
        return np.ones(n, dtype=bool) if groups is None else groups[1:] == groups[:-1]


def _invalid(log: Log, valid: NDArray, drop_invalid: bool) -> Iterator[LogFinding]:
    rows = np.flatnonzero(~valid)
    places, kind = (np.arange(len(valid)), "row") if log.line is None else (log.line, "line")
    lines = np.concatenate([places[rows], log.invalid_lines]).astype(int)
    if len(lines) == 0:
        return
    what = (
        f"{len(lines)} of {len(valid) + len(log.invalid_lines)} rows have a missing, NaN or "
        f"infinite value ({named_rows(np.arange(len(lines)), lines, kind)})"
    )
    if drop_invalid and len(rows) == 0:
        advice = "find out why: a marker that hides in some poses leaves a hole in the data there."
        yield LogFinding("invalid", "warning", f"{what}; they were left out.", advice)
    else:
        advice = "correct them, or leave them out with --drop-invalid (drop_invalid=True)."
        yield LogFinding("invalid", "error", f"{what}.", advice, rows)


def _runs(still: NDArray) -> list[tuple[int, int]]:
    """Return first and last row of stretches whose steps (N - 1,) are all still."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _frozen(rows: _Rows) -> Iterator[LogFinding]:
    q, x = rows.log.q, rows.log.x
    tips = _frozen_rows(q, (np.diff(x, axis=0) == 0).all(axis=1))
    if np.ptp(x, axis=0).any() and len(tips):
        yield rows.finding(
            "frozen tip",
            "error",
            f"the tip stays exactly the same in {len(tips)} rows while the actuators move "
            f"({rows.named(tips)}); its sensor was frozen or lost the marker.",
            "leave these rows out with --drop-frozen, or delete them from the log.",
            tips,
        )
    for name, column in rows.columns("x"):
        still = np.diff(column) == 0
        found = np.setdiff1d(_frozen_rows(q, still), tips)
        if len(found) and np.ptp(column) > 0 and still.mean() < 0.2:
            yield rows.finding(
                "frozen tip",
                "warning",
                f"column {name!r} stays exactly the same in {len(found)} rows while the "
                f"actuators move ({rows.named(found)}).",
                "look at these rows; leave them out where the tip did move.",
                found,
            )
    moved = np.linalg.norm(np.ptp(x, axis=0))
    for name, column in rows.columns("q"):
        still = np.diff(column) == 0
        runs = [run for run in _runs(still) if run[1] - run[0] >= _FROZEN_ROWS]
        if len(runs) != 1:  # commands rest often, a sensor that is measured never
            continue
        first, last = runs[0]
        others = still.sum() - (last - first)
        share = (last - first) / len(still)
        alone = (column == column[first]).sum() <= last - first + 2
        way = np.linalg.norm(np.ptp(x[first : last + 1], axis=0))
        if others < 0.05 * len(still) and share < 0.5 and alone and way > _FROZEN_WAY * moved:
            found = np.arange(first, last + 1)
            yield rows.finding(
                "frozen actuator",
                "warning",
                f"actuator {name!r}, which changes from row to row elsewhere, stays exactly the "
                f"same in {len(found)} rows ({rows.named(found)}) while the tip moves.",
                "if its sensor hung, leave these rows out; if it was at rest, all is well.",
                found,
            )


def _frozen_rows(q: NDArray, still: NDArray) -> NDArray:
    """Return rows in which something stands still while an actuator moves considerably."""
    spans = np.ptp(q, axis=0)
    spans[spans == 0] = np.inf
    found = [np.empty(0, dtype=int)]
    for first, last in _runs(still):
        way = (np.ptp(q[first : last + 1], axis=0) / spans).max()
        if last - first + 1 >= _FROZEN_ROWS and way >= _FROZEN_WAY:
            found.append(np.arange(first, last + 1))
    return np.concatenate(found)


_CONSTANT = {"q": "actuators that never move", "x": "tip columns that never change"}
_CONSTANT_ADVICE = {
    "q": "nothing can be learned about them: record motions of each, or keep them at rest in use.",
    "x": "check the names of the columns; motion in one plane is fitted in that plane only.",
}


def _constant(rows: _Rows) -> Iterator[LogFinding]:
    for which, what in _CONSTANT.items():
        columns = rows.columns(which)
        flat = [repr(name) for name, column in columns if np.ptp(column) == 0]
        if flat:
            severity = "error" if len(flat) == len(columns) else "warning"
            message = f"{what}: {', '.join(flat)}."
            yield rows.finding("constant", severity, message, _CONSTANT_ADVICE[which])


def _same(rows: _Rows) -> Iterator[LogFinding]:
    columns = [*rows.columns("q"), *rows.columns("x")]
    for (one, a), (other, b) in itertools.combinations(columns, 2):
        if np.ptp(a) > 0 and (a == b).all():
            message = f"columns {one!r} and {other!r} hold the same values in all rows."
            advice = "check the names of the columns; two actuators that always agree are one."
            yield rows.finding("same column", "warning", message, advice)


def _duplicates(rows: _Rows) -> Iterator[LogFinding]:
    q, x, groups = rows.log.q, rows.log.x, rows.log.groups
    _, first, inverse = np.unique(
        np.column_stack([q, x]), axis=0, return_index=True, return_inverse=True
    )
    original = first[inverse.ravel()]
    copies = np.flatnonzero(original != np.arange(len(q)))
    if len(copies):
        n = 0 if groups is None else int((groups[copies] != groups[original[copies]]).sum())
        across = f", {n} of them in another motion" if n else ""
        message = f"{len(copies)} rows are exact copies of earlier ones{across}"
        advice = "delete them: copies in training and test part make errors look too small."
        message = f"{message} ({rows.named(copies)})."
        yield rows.finding("duplicates", "warning", message, advice, copies)
    keep = np.setdiff1d(np.arange(len(q)), copies)
    q, x = q[keep], x[keep]
    _, inverse, counts = np.unique(q, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    again = counts[inverse] > 1
    if again.sum() >= 10:
        # Spread of the tips about the mean of their command, pooled over all repeated commands.
        means = np.stack([np.bincount(inverse, c) / counts for c in x.T], axis=1)
        freedom = again.sum() - (counts > 1).sum()
        spread = np.sqrt(((x - means[inverse])[again] ** 2).sum() / freedom)
        yield rows.finding(
            "same command",
            "note",
            f"{again.sum()} rows share their command with another row, as on a way out and "
            f"back; there the tip scatters by {1e3 * spread:.3g} mm rms.",
            "this is noise, or backlash (also called play) where the robot came from another side, "
            "which --play auto (play=) can learn; no model of the command alone errs less.",
            keep[again],
        )


def _jumps(rows: _Rows) -> Iterator[LogFinding]:
    q, x, same = rows.log.q, rows.log.x, rows.same_motion()
    if len(q) < _FEW_ROWS:
        return
    dq, dx = (np.linalg.norm(np.diff(array, axis=0), axis=1) for array in (q, x))
    usual = np.median(dq[same]) if same.any() else np.median(dq)
    ratio = dx / np.maximum(dq + usual, np.finfo(float).tiny)
    if not (dx > 0).any():
        return
    steps = np.flatnonzero(ratio > _JUMP * np.quantile(ratio[dx > 0], 0.9))
    if 0 < len(steps) <= 0.1 * len(q):
        yield rows.finding(
            "jumps",
            "warning",
            f"the tip jumps by up to {1e3 * dx[steps].max():.4g} mm, far more than the actuators "
            f"explain, at {len(steps)} rows ({rows.named(steps + 1)}).",
            "look at these rows: a swapped or lost marker, or a robot that snaps; --loss soft_l1 "
            "bounds what outliers do to the calibration.",
            steps + 1,
        )


def _times(rows: _Rows) -> Iterator[LogFinding]:
    if rows.log.time is None:
        return
    step, same = np.diff(rows.log.time), rows.same_motion()
    late = np.flatnonzero(step <= 0) + 1
    if len(late):
        message = f"times do not increase at {len(late)} rows ({rows.named(late)})."
        advice = "sort the rows by time within each motion; play and lag are judged by the order."
        yield rows.finding("time", "warning", message, advice, late)
    inside = step[same & (step > 0)]
    usual = float(np.median(inside)) if len(inside) >= 10 else np.inf
    gaps = np.flatnonzero(same & (step > _GAP * usual)) + 1
    if len(gaps):
        message = (
            f"{len(gaps)} gaps in time within a motion, up to {step[gaps - 1].max():.4g} s "
            f"where {usual:.4g} s is usual ({rows.named(gaps)})."
        )
        advice = "rows were lost or the robot waited; if it was touched, name the parts apart."
        yield rows.finding("time", "warning", message, advice, gaps)


def _motions(rows: _Rows) -> Iterator[LogFinding]:
    n_rows, groups = len(rows.log.q), rows.log.groups
    if n_rows < _FEW_ROWS:
        advice = "record some hundreds, spread over the whole workspace."
        yield rows.finding("rows", "warning", f"{n_rows} rows are few.", advice)
    if groups is None:
        message = "no column names the motion of a row: stretches of the log are held out instead."
        advice = "give `groups` (--groups COLUMN, or groups = in [log])."
        yield rows.finding("motions", "warning", message, advice)
        return
    n = len(np.unique(groups))
    if n > 0.5 * n_rows and n > _FEW_MOTIONS:
        message = f"{n} motions in {n_rows} rows: nearly every row is its own, a random split."
        advice = (
            "name the same motion in all rows of one sweep; for poses taken one by one at random "
            "this is right."
        )
        yield rows.finding("motions", "warning", message, advice)
    elif n < _FEW_MOTIONS:
        few = f"{n} motion{'s are' if n > 1 else ' is'} few"
        message = f"{few}: errors on held-out motions are uncertain."
        advice = "record more motions, or cut long ones into parts that differ."
        yield rows.finding("motions", "warning", message, advice)
