"""Checks of a log before a fit: what is wrong with it, where, and what to do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin.datasets._log_geometry import Declared, geometry_findings
from hybridkin.datasets._log_report import SEVERITIES, LogFinding, LogReport, named_rows

__all__ = ["LogFinding", "LogReport", "check_log"]

_FROZEN_ROWS = 3  # fewer may be chance
_FROZEN_WAY = 0.1  # of an actuator's range: the tip must have moved
_JUMP = 3.0  # times what nine steps in ten stay below
_GAP = 10.0  # median steps in time
_FEW_MOTIONS = 5
_FEW_ROWS = 30


def check_log(
    data: Any,
    *,
    chain: Any = None,
    base_is_free: bool = True,
    q_sign: float | None = None,
    drop_invalid: bool = True,
) -> LogReport:
    """Return what may be wrong with a log: sensors, rows, times, motions, units and signs.

    Looked for are NaN and infinite rows, a tip or an actuator sensor that is frozen while the rest
    moves, columns that never change, rows that occur twice, jumps of the tip, gaps in time and
    times that run backwards, too few motions to hold some out; and, by the nominal chain, wrong
    units, a wrong sign of q and actuators numbered the other way round. Rows are taken to be in
    order of time.

    Parameters
    ----------
    data : Bunch or mapping
        As from `load_log`: ``q`` (N, n) [m] and ``x`` (N, 3) [m]; where there are, ``groups`` (N,),
        ``time`` (N,) [s], ``line`` (N,), ``invalid_lines``, ``q_names``, ``x_names``,
        ``file_units`` and ``source``.
    chain : ConstantCurvatureChain or ElasticTendonChain, optional
        Nominal kinematics. None: units, sign and numbering are not looked at.
    base_is_free : bool, default=True
        Whether the pose of the base will be fitted. With tendons on a backbone that does not
        stretch, a wrong sign of q then is a half turn of the base and cannot be seen.
    q_sign : float, optional
        Sign with which the log was read, for the advice.
    drop_invalid : bool, default=True
        Whether it is as wanted that the reader left out invalid rows (a warning) or not (an error).

    Returns
    -------
    LogReport
        ``print(report)`` shows it; ``report.ok`` is False where a fit would be worthless.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import robots
    >>> from hybridkin.datasets import check_log, load_trunk
    >>> data = load_trunk()
    >>> x = np.array(data.x)
    >>> x[100:140] = x[100]
    >>> report = check_log({"q": data.q, "x": x}, chain=robots.bionic_handling_assistant())
    >>> report.errors[0].kind, len(report.errors[0].rows)
    ('frozen tip', 40)
    """
    q, x = np.asarray(data["q"], dtype=float), np.asarray(data["x"], dtype=float)
    if q.ndim != 2 or x.shape != (len(q), 3) or len(q) == 0:
        raise ValueError(
            f"`data` must hold q of shape (N, n) and x of shape (N, 3), got {q.shape} and "
            f"{x.shape}."
        )
    if chain is not None and q.shape[1] != chain.n_actuators:
        raise ValueError(
            f"`data` must have {chain.n_actuators} actuators, as `chain` has, got {q.shape[1]}."
        )
    places, kind = data.get("line"), "line"
    if places is None:
        places, kind = np.arange(len(q)), "row"
    valid = np.asarray(np.isfinite(np.column_stack([q, x])).all(axis=1))
    findings = _invalid(data, valid, places, kind, drop_invalid)
    rows = np.flatnonzero(valid)
    if len(rows):
        log = _Log(data, q[rows], x[rows], rows, np.asarray(places), kind)
        for check in (_frozen, _constant, _duplicates, _jumps, _times, _motions):
            findings += check(log)
        if chain is not None and getattr(chain, "radii", None) is not None:
            units = data.get("file_units") or {"q": "m", "x": "m"}
            declared = Declared(units["q"], units["x"], q_sign)
            findings += geometry_findings(log.q, log.x, chain, declared, base_is_free)
    findings.sort(key=lambda finding: SEVERITIES.index(finding.severity))
    time, groups = data.get("time"), data.get("groups")
    part_q, part_x = (q[rows], x[rows]) if len(rows) else (0 * q[:1], 0 * x[:1])
    return LogReport(
        tuple(findings),
        n_rows=len(q),
        n_actuators=q.shape[1],
        n_motions=None if groups is None else len(np.unique(groups)),
        q_range=np.stack([part_q.min(axis=0), part_q.max(axis=0)], axis=1),
        x_range=np.stack([part_x.min(axis=0), part_x.max(axis=0)], axis=1),
        duration=None if time is None else float(np.ptp(time)),
        source=str(data.get("source") or "in memory"),
    )


class _Log:
    """The valid rows of a log, and how to name them."""

    def __init__(
        self, data: Any, q: NDArray, x: NDArray, rows: NDArray, places: NDArray, kind: str
    ) -> None:
        self.q, self.x, self.rows, self._places, self._kind = q, x, rows, places, kind
        groups, time = data.get("groups"), data.get("time")
        self.groups = None if groups is None else np.asarray(groups)[rows]
        self.time = None if time is None else np.asarray(time, dtype=float)[rows]
        n = q.shape[1]
        self.q_names = list(data.get("q_names") or (f"q[{i}]" for i in range(n)))
        self.x_names = list(data.get("x_names") or ("x[0]", "x[1]", "x[2]"))
        same = np.ones(len(q) - 1, dtype=bool)
        if self.groups is not None:
            same = self.groups[1:] == self.groups[:-1]
        self.same_motion = same  # of each row and the next

    def named(self, rows: ArrayLike) -> str:
        return named_rows(self.rows[np.asarray(rows)], self._places, self._kind)

    def finding(
        self, kind: str, severity: str, message: str, advice: str, rows: ArrayLike = ()
    ) -> LogFinding:
        return LogFinding(kind, severity, message, advice, self.rows[np.asarray(rows, dtype=int)])


def _invalid(
    data: Any, valid: NDArray, places: ArrayLike, kind: str, drop_invalid: bool
) -> list[LogFinding]:
    rows, total = np.flatnonzero(~valid), len(valid)
    lines = np.asarray(places)[rows]
    dropped = data.get("invalid_lines")
    left_out = drop_invalid and len(rows) == 0
    if dropped is not None:
        lines, total = np.concatenate([lines, dropped]), total + len(dropped)
    if len(lines) == 0:
        return []
    named = named_rows(np.arange(len(lines)), lines, kind)
    what = f"{len(lines)} of {total} rows have a missing, NaN or infinite value ({named})"
    if left_out:
        return [
            LogFinding(
                "invalid",
                "warning",
                f"{what}; they were left out.",
                "find out why: a marker that hides in some poses leaves a hole in the data there.",
            )
        ]
    advice = "correct them, or leave them out with --drop-invalid (drop_invalid=True)."
    return [LogFinding("invalid", "error", f"{what}.", advice, rows)]


def _runs(still: NDArray) -> list[tuple[int, int]]:
    """Return first and last row of stretches whose steps (N - 1,) are all still."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], still, [False]]).astype(int)))
    return [(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _frozen(log: _Log) -> list[LogFinding]:
    found = []
    spans = np.ptp(log.q, axis=0)
    spans[spans == 0] = np.inf
    tips = _frozen_rows(log, (np.diff(log.x, axis=0) == 0).all(axis=1), spans)
    if np.ptp(log.x, axis=0).any() and len(tips):
        found.append(
            log.finding(
                "frozen tip",
                "error",
                f"the tip stays exactly the same in {len(tips)} rows while the actuators move "
                f"({log.named(tips)}); its sensor was frozen or lost the marker.",
                "leave these rows out with --drop-frozen, or delete them from the log.",
                tips,
            )
        )
    for name, column in zip(log.x_names, log.x.T, strict=True):
        still = np.diff(column) == 0
        rows = np.setdiff1d(_frozen_rows(log, still, spans), tips)
        if len(rows) and np.ptp(column) > 0 and still.mean() < 0.2:
            found.append(
                log.finding(
                    "frozen tip",
                    "warning",
                    f"column {name!r} stays exactly the same in {len(rows)} rows while the "
                    f"actuators move ({log.named(rows)}).",
                    "look at these rows; leave them out where the tip did move.",
                    rows,
                )
            )
    moved = np.linalg.norm(np.ptp(log.x, axis=0))
    for name, column in zip(log.q_names, log.q.T, strict=True):
        still = np.diff(column) == 0
        runs = [run for run in _runs(still) if run[1] - run[0] >= _FROZEN_ROWS]
        if len(runs) != 1:  # commands rest often, a sensor that is measured never
            continue
        first, last = runs[0]
        others = still.sum() - (last - first)
        share = (last - first) / len(still)
        alone = (column == column[first]).sum() <= last - first + 2
        way = np.linalg.norm(np.ptp(log.x[first : last + 1], axis=0))
        if others < 0.05 * len(still) and share < 0.5 and alone and way > _FROZEN_WAY * moved:
            rows = np.arange(first, last + 1)
            found.append(
                log.finding(
                    "frozen actuator",
                    "warning",
                    f"actuator {name!r}, which changes from row to row else, stays exactly the "
                    f"same in {len(rows)} rows ({log.named(rows)}) while the tip moves.",
                    "if its sensor hung, leave these rows out; if it was at rest, all is well.",
                    rows,
                )
            )
    return found


def _frozen_rows(log: _Log, still: NDArray, spans: NDArray) -> NDArray:
    """Return rows in which something stands still while an actuator goes a good way."""
    rows = [np.empty(0, dtype=int)]
    for first, last in _runs(still):
        way = (np.ptp(log.q[first : last + 1], axis=0) / spans).max()
        if last - first + 1 >= _FROZEN_ROWS and way >= _FROZEN_WAY:
            rows.append(np.arange(first, last + 1))
    return np.concatenate(rows)


def _constant(log: _Log) -> list[LogFinding]:
    found = []
    at_rest = [n for n, c in zip(log.q_names, log.q.T, strict=True) if np.ptp(c) == 0]
    if at_rest:
        found.append(
            log.finding(
                "constant",
                "error" if len(at_rest) == len(log.q_names) else "warning",
                f"actuators that never move: {', '.join(map(repr, at_rest))}.",
                "nothing can be learned about them: record motions of each, and keep them at rest "
                "when the model is used.",
            )
        )
    flat = [n for n, c in zip(log.x_names, log.x.T, strict=True) if np.ptp(c) == 0]
    if flat:
        found.append(
            log.finding(
                "constant",
                "error" if len(flat) == 3 else "warning",
                f"tip columns that never change: {', '.join(map(repr, flat))}.",
                "check the names of the columns; a robot that moves in one plane is fitted in that "
                "plane only.",
            )
        )
    return found


def _duplicates(log: _Log) -> list[LogFinding]:
    found = []
    both = np.column_stack([log.q, log.x])
    _, first, inverse = np.unique(both, axis=0, return_index=True, return_inverse=True)
    inverse = inverse.ravel()
    rows = np.flatnonzero(first[inverse] != np.arange(len(both)))
    if len(rows):
        across = ""
        if log.groups is not None:
            n = int((log.groups[rows] != log.groups[first[inverse]][rows]).sum())
            if n:
                across = f", {n} of them in another motion"
        found.append(
            log.finding(
                "duplicates",
                "warning",
                f"{len(rows)} rows are exact copies of earlier ones{across} ({log.named(rows)}).",
                "delete them: copies in training and test part make errors look smaller than they "
                "are.",
                rows,
            )
        )
    keep = np.setdiff1d(np.arange(len(both)), rows)
    q, x = log.q[keep], log.x[keep]
    _, inverse, counts = np.unique(q, axis=0, return_inverse=True, return_counts=True)
    inverse = inverse.ravel()
    again = counts[inverse] > 1
    if again.sum() >= 10:
        means = np.stack([np.bincount(inverse, c) / counts for c in x.T], axis=1)
        freedom = again.sum() - (counts > 1).sum()
        spread = np.sqrt(((x - means[inverse])[again] ** 2).sum() / freedom)
        found.append(
            log.finding(
                "same command",
                "note",
                f"{again.sum()} rows share their command with another row, as on a way out and "
                f"back; there the tip scatters by {1e3 * spread:.3g} mm rms.",
                "this is noise, or play where the robot came from another side, which --play auto "
                "(play=) can learn; no model of the command alone errs less.",
                keep[again],
            )
        )
    return found


def _jumps(log: _Log) -> list[LogFinding]:
    if len(log.q) < _FEW_ROWS:
        return []
    dq = np.linalg.norm(np.diff(log.q, axis=0), axis=1)
    dx = np.linalg.norm(np.diff(log.x, axis=0), axis=1)
    usual = np.median(dq[log.same_motion]) if log.same_motion.any() else np.median(dq)
    ratio = dx / np.maximum(dq + usual, np.finfo(float).tiny)
    moving = ratio[dx > 0]
    if len(moving) == 0:
        return []
    steps = np.flatnonzero(ratio > _JUMP * np.quantile(moving, 0.9))
    rows = steps + 1
    if len(rows) == 0 or len(rows) > 0.1 * len(log.q):
        return []
    return [
        log.finding(
            "jumps",
            "warning",
            f"the tip jumps by up to {1e3 * dx[steps].max():.4g} mm, far more than the actuators "
            f"tell, at {len(rows)} rows ({log.named(rows)}).",
            "look at these rows: a swapped or lost marker, or a robot that snaps; --loss soft_l1 "
            "bounds what outliers do to the calibration.",
            rows,
        )
    ]


def _times(log: _Log) -> list[LogFinding]:
    if log.time is None or len(log.time) < 2:
        return []
    found = []
    step = np.diff(log.time)
    late = np.flatnonzero(step <= 0) + 1
    if len(late):
        found.append(
            log.finding(
                "time",
                "warning",
                f"times do not increase at {len(late)} rows ({log.named(late)}).",
                "sort the rows by time within each motion; play and lag are judged by the order.",
                late,
            )
        )
    inside = step[log.same_motion & (step > 0)]
    if len(inside) >= 10:
        usual = float(np.median(inside))
        gaps = np.flatnonzero(log.same_motion & (step > _GAP * usual)) + 1
        if len(gaps):
            found.append(
                log.finding(
                    "time",
                    "warning",
                    f"{len(gaps)} gaps in time within a motion, up to {step[gaps - 1].max():.4g} s "
                    f"where {usual:.4g} s is usual ({log.named(gaps)}).",
                    "rows were lost there or the robot waited; give the parts before and after "
                    "names of their own if the robot was touched in between.",
                    gaps,
                )
            )
    return found


def _motions(log: _Log) -> list[LogFinding]:
    found = []
    if len(log.q) < _FEW_ROWS:
        found.append(
            log.finding(
                "rows",
                "warning",
                f"{len(log.q)} rows are few.",
                "record some hundreds, spread over the whole workspace.",
            )
        )
    if log.groups is None:
        found.append(
            log.finding(
                "motions",
                "warning",
                "no column names the motion of a row; errors on motions held out are then guessed "
                "from stretches of the log.",
                "give `groups` (--groups COLUMN, or groups = in [log]).",
            )
        )
        return found
    n = len(np.unique(log.groups))
    if n > 0.5 * len(log.groups) and n > _FEW_MOTIONS:
        found.append(
            log.finding(
                "motions",
                "warning",
                f"{n} motions in {len(log.groups)} rows: nearly every row is a motion of its own, "
                "which makes a random split.",
                "name the same motion in all rows of one sweep; for poses taken one by one at "
                "random this is right.",
            )
        )
    elif n < _FEW_MOTIONS:
        found.append(
            log.finding(
                "motions",
                "warning",
                f"{n} motion{'s are' if n > 1 else ' is'} few: errors on motions held out are "
                "known badly.",
                "record more motions, or cut long ones into parts that differ.",
            )
        )
    return found
