"""A log as a robot description says it is written: read, checked, its motions named."""

from __future__ import annotations

import fnmatch
import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin import datasets, robots

_BLOCKS = 10

OnCheck = Callable[[datasets.LogReport], None]
"""Called with what the check of a log found, before any work is done."""


class LogError(ValueError):
    """A log that does not pass its check.

    Parameters
    ----------
    report : LogReport
        What was found.
    """

    def __init__(self, report: datasets.LogReport) -> None:
        first = report.errors[0]
        more = f" ({len(report.errors) - 1} more above)" if len(report.errors) > 1 else ""
        super().__init__(f"the log did not pass its check: {first.message} {first.advice}{more}")
        self.report = report


class MeasuredLog(NamedTuple):
    """A log in SI units.

    Parameters
    ----------
    q, x : ndarray of shape (N, n) and (N, 3)
        Actuator vectors and tips [m].
    motions : ndarray of shape (N,)
        Motion of every row.
    named : bool
        Whether the log names them; else they are stretches of it.
    split : str
        What the motions are, in words.
    late : ndarray of shape (k,)
        Rows that come before the row above them in time, within their motion.
    report : LogReport
        What the check of the whole log found.
    """

    q: NDArray
    x: NDArray
    motions: NDArray
    named: bool
    split: str
    late: NDArray
    report: datasets.LogReport

    def check_order(self, why: str) -> None:
        """Raise where rows of a motion are not in the order of time; `why` begins the message."""
        if len(self.late):
            raise ValueError(
                f"{why} needs the rows of a motion in the order of time, but {len(self.late)} come "
                "before the row above them; sort the log by motion and time."
            )

    def thinned(self, max_rows: int | None) -> MeasuredLog:
        """Return every k-th row, so that at most `max_rows` are left; None: all."""
        if max_rows is None or len(self.q) <= max_rows:
            return self
        kept = slice(None, None, -(-len(self.q) // max_rows))
        return self._replace(q=self.q[kept], x=self.x[kept], motions=self.motions[kept])


def _late(motions: NDArray, time: NDArray | None) -> NDArray:
    """Return rows whose time is before that of the row above them in their motion."""
    if time is None:
        return np.empty(0, dtype=int)
    order = np.argsort(motions, kind="stable")
    same = motions[order][1:] == motions[order][:-1]
    return np.sort(order[1:][same & (np.diff(time[order]) < 0)])


def read_log(
    path: str | Path,
    log_format: robots.LogFormat,
    *,
    chain: Any = None,
    base_is_free: bool = True,
    exclude: Sequence[str] = (),
    drop_invalid: bool = False,
    drop_frozen: bool = False,
    delimiter: str | None = None,
) -> MeasuredLog:
    """Return a log, read and checked; errors that the check finds are in its report.

    Parameters
    ----------
    path : str or Path
        CSV, npz or parquet file.
    log_format : LogFormat
        Its columns, units and sign.
    chain, base_is_free
        As for `datasets.check_log`.
    exclude : sequence of str, optional
        Patterns of motions to leave out.
    drop_invalid, drop_frozen : bool, default=False
        Leave out rows with missing values; rows whose tip is frozen.
    delimiter : str or None, default=None
        As for `datasets.load_log`.

    Returns
    -------
    MeasuredLog
        In SI units, with the report of its check.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If columns or motions are not there.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "The `.` columns span")  # the check says it better
        data = datasets.load_log(
            path,
            log_format.q,
            log_format.x,
            log_format.groups,
            time=log_format.time,
            q_unit=log_format.q_unit,
            x_unit=log_format.x_unit,
            q_sign=log_format.q_sign,
            delimiter=delimiter,
            drop_invalid=True,
        )
    if data.groups is None:
        if exclude:
            raise ValueError("`exclude` needs `groups`, the column that names the motions.")
        motions = np.arange(len(data.q)) * _BLOCKS // len(data.q)
        split = f"{_BLOCKS} stretches of the log (no column of motions was named: give `--groups`)"
    else:
        suffix = log_format.group_suffix
        motions = np.array([str(name).removesuffix(suffix) for name in data.groups])
        data.groups = motions
        split = f"motions of column `{log_format.groups}`"
    kept = np.array([not any(fnmatch.fnmatch(str(m), p) for p in exclude) for m in motions])
    n = len(np.unique(motions))
    if not kept.any():
        raise ValueError(
            f"at least 2 motions must be left, but `exclude` leaves none of {n}; keep some."
        )
    for name in ("q", "x", "line", "groups", "time"):
        if data[name] is not None:
            data[name] = data[name][kept]
    report = datasets.check_log(
        data,
        chain=chain,
        base_is_free=base_is_free,
        q_sign=log_format.q_sign,
        drop_invalid=drop_invalid,
    )
    rows = np.ones(len(data.q), dtype=bool)
    if drop_frozen:
        for finding in report.findings:
            rows[finding.rows] &= finding.kind != "frozen tip"
        report = report.accepting("frozen tip")
    motions, named = motions[kept][rows], data.groups is not None
    late = _late(motions, None if data.time is None else data.time[rows])
    return MeasuredLog(data.q[rows], data.x[rows], motions, named, split, late, report)


def check(log: MeasuredLog, on_check: OnCheck, force: bool) -> None:
    """Hand on the report of a log that holds no error, or where `force` is set.

    Raises
    ------
    LogError
        If the check found errors.
    """
    if log.report.errors and not force:
        raise LogError(log.report)
    on_check(log.report)


def not_told(report: datasets.LogReport) -> None:
    """Tell nobody."""
