"""Logs in the format of a robot description: read, checked, with named motions."""

from __future__ import annotations

import fnmatch
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin import Chain, Commands, ForwardModel, robots
from hybridkin.app import LogReport, check_log
from hybridkin.app.workflow.report import Report
from hybridkin.datasets import Log, load_log
from hybridkin.formats import LogUnit

_BLOCKS = 10


class LogError(ValueError):
    """The error for a log that does not pass its check.

    Parameters
    ----------
    report : LogReport
        The findings.
    """

    def __init__(self, report: LogReport) -> None:
        first = report.errors[0]
        if len(report.errors) > 1:
            further = f" ({len(report.errors) - 1} more above)"
        else:
            further = ""
        super().__init__(f"the log did not pass its check: {first.message} {first.advice}{further}")
        self.report = report


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class MeasuredLog(Log):
    """A checked log in which every row belongs to a motion.

    Attributes
    ----------
    report : LogReport
        Findings of the check of the whole log.
    named : bool
        Whether the log names its motions; else they are ten parts of it.
    counts : ndarray of shape (N,)
        1 where the measurement of a row counts; 0 where a row only moves the actuators [1].
    excluded : tuple of str
        Patterns of the motions that were left out.
    """

    report: LogReport
    named: bool
    counts: NDArray
    excluded: tuple[str, ...] = ()

    @property
    def motions(self) -> NDArray:
        """The motion of every row, shape (N,)."""
        return np.asarray(self.groups)

    @property
    def commands(self) -> Commands:
        """The actuator vectors with runs and times; a log without named motions is one run."""
        if not self.named and self.runs is None:
            return Commands(self.q, time=self.time)
        return super().commands

    @property
    def q_unit(self) -> LogUnit:
        """The unit of q in the file."""
        return LogUnit.of(self.file_units["q"])

    @property
    def split(self) -> str:
        """The kind of the motions, in words."""
        if self.named:
            return "motions"
        return f"parts of the log (cut into {_BLOCKS}; name a column of motions with `--groups`)"

    @property
    def n_late(self) -> int:
        """Number of rows that are earlier than the row above of the same run."""
        if self.time is None:
            return 0
        return len(self.commands.order.late(self.time))

    def check_order(self, why: str) -> None:
        """Raise if rows of a run are not in order of time; `why` begins the message."""
        if self.n_late:
            raise ValueError(
                f"{why} needs the rows of a run in order of time, but {self.n_late} rows are "
                "earlier than the row above; sort the log by run (motion) and time."
            )

    def check(self, force: bool) -> None:
        """Raise a `LogError` if the check found errors, unless `force` is set."""
        if self.report.errors and not force:
            raise LogError(self.report)

    def misread(self, calibrated: Chain) -> list[str]:
        """Return new findings on order and signs of q, from a check with the calibrated chain."""
        kinds = {f.kind for f in self.report.misread}
        misread = _check(self, calibrated).misread
        return [f"{f.message} {f.advice}" for f in misread if f.kind not in kinds]

    def rows(self, chosen: NDArray | slice) -> Self:
        """Return a log of some of the rows."""
        return replace(super().rows(chosen), counts=self.counts[chosen])

    @property
    def counted(self) -> NDArray[np.intp]:
        """The rows that count (K,)."""
        return np.flatnonzero(self.counts)

    @property
    def measured(self) -> Self:
        """The log of the rows that count alone, for models without hysteresis."""
        return self if self.counts.all() else self.rows(self.counted)

    def counting(self, rows: NDArray) -> Self:
        """Return the log in which only some rows count; those before them in a run move actuators.

        Parameters
        ----------
        rows : ndarray of int of shape (K,)
            The rows that count.
        """
        counts = np.zeros(len(self.q))
        counts[rows] = 1.0
        return replace(self, counts=counts).rows(self.commands.up_to(rows))

    def thinned(self, max_rows: int | None) -> Self:
        """Return the log with at most `max_rows` rows that count; None: all of them.

        If there are many motions, only a spread part of them counts, else some rows of each. All
        rows of these motions move the actuators, so hysteresis sees every reversal. Parts of a log
        without named motions have no hysteresis: there the other rows are left out.
        """
        if max_rows is None or len(self.q) <= max_rows:
            return self
        rows = Commands(self.q, self.motions).spread_rows(max_rows)
        return self.counting(rows) if self.named else self.rows(rows)

    def thinned_in_words(self, complete: MeasuredLog) -> str:
        """Return how a complete log was thinned to this one; empty if it was not."""
        measured = self.measured
        if len(measured.q) == len(complete.q):
            return ""
        n_motions = len(np.unique(measured.motions))
        n_whole = len(np.unique(complete.motions))
        words = f"of {len(complete.q)}, spread over "
        if n_motions < n_whole:
            words += f"{n_motions} of "
        words += f"{n_whole} {complete.split}"
        if len(self.q) > len(measured.q):
            words += f"; hysteresis follows all {len(self.q)} rows up to them"
        return words


def read_log(
    path: str | Path,
    log_format: robots.LogFormat,
    *,
    chain: ForwardModel | None = None,
    base_is_free: bool = True,
    exclude: Sequence[str] = (),
    drop_invalid: bool = False,
    drop_frozen: bool = False,
    delimiter: str | None = None,
) -> MeasuredLog:
    """Return a log, read and checked; errors found by the check are in its report.

    Parameters
    ----------
    path : str or Path
        CSV, npz or parquet file.
    log_format : LogFormat
        Columns, units and sign of the log.
    chain, base_is_free
        As for `app.check_log`.
    exclude : sequence of str, optional
        Patterns of motions to leave out, for example ``"*tendon*"``.
    drop_invalid, drop_frozen : bool, default=False
        Leave out rows with missing or infinite values; rows whose tip is frozen.
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
        If columns or motions do not exist.
    """
    if not isinstance(exclude, Sequence) or not all(isinstance(p, str) for p in exclude):
        raise TypeError(f"`exclude` must be a list of patterns of names, got {exclude!r:.80}.")
    suffix = log_format.group_suffix
    reading = replace(log_format, delimiter=delimiter, drop_invalid=True).reading
    log = load_log(path, **reading)
    log = replace(log, file_units={**log.file_units, "q": log_format.q_unit})
    if log.groups is None and exclude:
        raise ValueError("`exclude` needs `groups`, the column that names the motions.")
    if log.groups is not None:
        motions = [str(name).removesuffix(suffix) for name in log.groups]
        included = np.ones(len(motions), dtype=bool)
        for pattern in exclude:
            included &= [not fnmatch.fnmatch(name, pattern) for name in motions]
        if not included.any():
            raise ValueError(
                f"`exclude` must leave at least 2 motions, but leaves none of {len({*motions})}; "
                "use fewer patterns."
            )
        log = replace(log, groups=np.array(motions)).rows(included)
    report = _check(log, chain, base_is_free, drop_invalid)
    measured = _with_motions(log, report, tuple(exclude))
    if drop_frozen:
        frozen = [f.rows for f in report.findings if f.kind == "frozen tip"]
        rows = np.setdiff1d(np.arange(len(log.q)), np.concatenate([[], *frozen]))
        measured = replace(measured.rows(rows), report=report.accepting("frozen tip"))
    return measured


def write_check(report: Report, check: LogReport) -> None:
    """Add the findings of the check of a log to a report."""
    report.text(f"## The log\n\nThe check of the log found {check.summary()}.")
    for f in check.findings:
        report.text(
            "- **{severity}**, {kind}: {message} Advice: {advice}",
            severity=f.severity,
            kind=f.kind,
            message=f.message,
            advice=f.advice,
        )


def checked(log: Log, chain: ForwardModel | None, base_is_free: bool) -> MeasuredLog:
    """Return a log with its check and its motions; a `MeasuredLog` is returned unchanged."""
    if isinstance(log, MeasuredLog):
        return log
    return _with_motions(log, _check(log, chain, base_is_free))


def _check(
    log: Log,
    chain: ForwardModel | None,
    base_is_free: bool = True,
    drop_invalid: bool = True,
) -> LogReport:
    return check_log(log, chain=chain, base_is_free=base_is_free, drop_invalid=drop_invalid)


def _with_motions(log: Log, report: LogReport, excluded: tuple[str, ...] = ()) -> MeasuredLog:
    named = log.groups is not None
    n = len(log.q)
    columns = dict(vars(log))
    if not named:
        columns["groups"] = np.arange(n) * _BLOCKS // n
    return MeasuredLog(**columns, report=report, named=named, counts=np.ones(n), excluded=excluded)
