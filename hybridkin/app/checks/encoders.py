"""The check of a log for encoders that wrap, lose turns, or have readings whole turns off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from hybridkin.app.checks.columns import LogRows
from hybridkin.app.checks.report import LogFinding
from hybridkin.datasets import EncoderFault

_ADVICE = (
    "read the log with --unwrap {period:.10g} (unwrap={period:.10g}, or unwrap = {period:.10g} in "
    "[log] of the robot description) if that is a turn of the encoder, else with its period; "
    "`zeros` can then be whole turns off."
)


def encoder_findings(rows: LogRows) -> Iterator[LogFinding]:
    """Yield the columns of q in which readings are whole periods off."""
    names = rows.log.column_names("q")
    wraps: dict[float, list[EncoderFault]] = {}
    for fault in rows.log.encoder_faults():
        if fault.kind == "wrap":
            wraps.setdefault(fault.period, []).append(fault)
        elif fault.kind == "turns":
            yield _lost_turns(rows, names[fault.column], fault)
        else:
            yield _glitches(rows, names[fault.column], fault)
    for period, faults in wraps.items():
        columns = ", ".join(repr(names[fault.column]) for fault in faults)
        places = np.unique(np.concatenate([fault.rows for fault in faults]))
        message = (
            f"the readings of {columns} wrap: they start again after {period:.10g} "
            f"({rows.named(places)})."
        )
        yield _finding(rows, message, period, places, "error")


def _lost_turns(rows: LogRows, name: str, fault: EncoderFault) -> LogFinding:
    changes = np.diff(fault.turns)[fault.rows - 1] * fault.period
    amounts = ", ".join(f"{amount:+.10g}" for amount in changes)
    message = (
        f"the encoder of {name!r} changes by {amounts}, whole turns of {fault.period:.10g}, while "
        f"the tip stays: it lost turns, as at a power cycle, from {rows.named(fault.rows)} on."
    )
    return _finding(rows, message, fault.period, fault.rows, "error")


def _glitches(rows: LogRows, name: str, fault: EncoderFault) -> LogFinding:
    turns = np.unique(fault.turns[fault.rows] * fault.period)
    amounts = " or ".join(f"{amount:+.10g}" for amount in turns)
    message = (
        f"{len(fault.rows)} readings of {name!r} are off by {amounts}, whole turns of "
        f"{fault.period:.10g}, while the tip stays ({rows.named(fault.rows)})."
    )
    return _finding(rows, message, fault.period, fault.rows, "warning")


def _finding(
    rows: LogRows, message: str, period: float, places: NDArray, severity: str
) -> LogFinding:
    advice = _ADVICE.format(period=period)
    return rows.finding("encoder", message, advice, places, severity)
