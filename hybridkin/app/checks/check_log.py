"""The check of a log before a fit: findings with their rows and advice."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from hybridkin import ForwardModel, LengthDrivenChain
from hybridkin.app.checks.columns import COLUMN_CHECKS, LogRows
from hybridkin.app.checks.encoders import encoder_findings
from hybridkin.app.checks.geometry import geometry_findings
from hybridkin.app.checks.missing import missing_values
from hybridkin.app.checks.report import (
    MISREAD,
    SEVERITIES,
    LogFinding,
    LogReport,
)
from hybridkin.app.checks.residual import residual_findings
from hybridkin.datasets import Log
from hybridkin.formats import named_places

_LARGEST = 1e75  # fourth powers of larger numbers overflow


def check_log(
    log: Log,
    *,
    chain: ForwardModel | None = None,
    base_is_free: bool = True,
    drop_invalid: bool = True,
) -> LogReport:
    """Return possible errors of a log: sensors, rows, times, motions, units and signs.

    The check looks for NaN and infinite rows, numbers that stand for missing values, a frozen
    sensor of the tip or of an actuator while the rest moves, columns that never change, rows that
    occur twice, jumps of the tip, gaps in time and decreasing times, columns with the same values,
    a tip that lags or drifts, and too few motions for held-out errors; in columns of motors also
    encoders that wrap, lose turns, or have single readings whole turns off.

    With a chain it also looks for wrong units, a wrong order or sign of the columns of q, actuators
    numbered in the other direction, rotated or left-handed axes of the tip, radii that are far off,
    and an offset or a drift of one actuator. Rows must be in order of time. With several markers,
    the last one, the tip, is checked in the rows that have it.

    Parameters
    ----------
    log : Log
        As from `load_log`; from arrays ``Log(q, x, groups)``.
    chain : Chain, optional
        Nominal kinematics, or a calibrated chain (``calibrate(...).chain``), which distinguishes
        orders of the columns better. None, or one whose q are no lengths (forces, joint angles):
        units, order, signs and axes are not checked.
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
    >>> from hybridkin.datasets import Log, load_trunk
    >>> from hybridkin.app import check_log
    >>> data = load_trunk()
    >>> x = np.array(data.x)
    >>> x[100:140] = x[100]
    >>> report = check_log(Log(data.q, x), chain=robots.bionic_handling_assistant())
    >>> report.errors[0].kind, len(report.errors[0].rows)
    ('frozen tip', 40)
    """
    n_actuators = log.q.shape[1]
    missing = [*missing_values(LogRows(log, np.arange(len(log.q))))]
    if chain is not None and n_actuators != chain.n_actuators:
        raise ValueError(
            f"`log` must have {chain.n_actuators} actuators, as many as `chain`, got "
            f"{n_actuators}; check the columns of q."
        )
    has_markers = log.x.shape[1] > 3
    if has_markers:
        log = replace(log, x=log.x[:, -3:], x_names=log.x_names[-3:])
        if chain is not None:
            chain = chain.tip_model
    columns = np.column_stack([log.q, log.x])
    valid = _countable(columns)
    # A row of several markers may lack the tip.
    complete = _countable(log.q) if has_markers else valid
    findings = [*_invalid_rows(log, complete, drop_invalid), *missing]
    for finding in missing:
        valid[finding.rows] = False  # the other checks look at the measured rows
    if valid.any():
        columns = columns[valid]
        rows = LogRows(log.rows(valid), np.flatnonzero(valid))
        of_encoders = [*encoder_findings(rows)]
        findings += of_encoders
        for check in COLUMN_CHECKS:
            findings += check(rows)
        if of_encoders:
            chain = None  # readings that are turns off look like wrong orders, signs and units
        # Its checks compare radii, paths and lengths of arcs, which no other chain has.
        if isinstance(chain, LengthDrivenChain):
            findings += geometry_findings(rows.log, chain, base_is_free)
        if not any(finding.kind in (*MISREAD, "encoder") for finding in findings):
            residual = [*residual_findings(rows.log, chain, rows.same_motion)]
            if any(finding.kind == "lag" for finding in residual):
                # A tip of another time is not what the nominal model explains.
                findings = [f for f in findings if f.kind != "geometry"]
            findings += residual
    findings.sort(key=lambda finding: SEVERITIES.index(finding.severity))
    ranges = np.stack([columns.min(axis=0), columns.max(axis=0)], axis=1)
    return LogReport(
        tuple(findings),
        n_rows=len(log.q),
        n_actuators=n_actuators,
        n_motions=None if log.groups is None else len(np.unique(log.groups)),
        q_range=ranges[:n_actuators],
        x_range=ranges[n_actuators:],
        duration=None if log.time is None else float(np.ptp(log.time)),
        source=log.source,
        q_unit=log.units["q"],
    )


def _countable(columns: NDArray) -> NDArray[np.bool_]:
    """Return which rows (N, k) hold numbers alone whose squares can be summed (N,)."""
    return np.all(np.abs(columns) < _LARGEST, axis=1)


def _invalid_rows(log: Log, valid: NDArray, drop_invalid: bool) -> Iterator[LogFinding]:
    """Yield the invalid rows, and those that were left out when the log was read."""
    kind, places = LogRows(log, np.arange(len(valid))).places
    invalid = np.flatnonzero(~valid)
    lines = np.concatenate([places[invalid], log.invalid_lines]).astype(int)
    if len(lines) == 0:
        return
    n_rows = len(valid) + len(log.invalid_lines)
    message = (
        f"{len(lines)} of {n_rows} rows have a missing, NaN or infinite value, or no motion "
        f"({named_places(lines, kind)})"
    )
    if drop_invalid and valid.all():
        advice = "find out why: a marker that is hidden in some poses leaves a gap in the data."
        message += "; they were left out."
        yield LogFinding("invalid", "warning", message, advice)
    else:
        advice = "correct them, or leave them out with --drop-invalid (drop_invalid=True)."
        yield LogFinding("invalid", "error", f"{message}.", advice, invalid)
