"""The check of a log for encoders that wrap, lose turns, or have readings whole turns off."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from hybridkin._core.units import UNITS
from hybridkin.datasets._encoders import GLITCH, TURNS, encoder_faults, periods_of
from hybridkin.datasets._log_columns import LogRows
from hybridkin.datasets._log_report import LogFinding
from hybridkin.datasets._logs import column_names

_ADVICE = (
    "read the log with --unwrap {period:.10g} (unwrap={period:.10g}, or unwrap = {period:.10g} in "
    "[log] of the robot description) if that is a turn of the encoder, else with its period."
)


def encoder_findings(rows: LogRows) -> Iterator[LogFinding]:
    """Yield the columns of q in which readings are whole periods off."""
    log = rows.log
    q_unit = log.file_units["q"]
    names = column_names(log, "q")
    readings = log.q / np.multiply(log.q_sign, UNITS.get(q_unit, 1.0))
    periods = [periods_of(q_unit)] * len(names)
    same_run = rows.runs[1:] == rows.runs[:-1]
    for fault in encoder_faults(readings, log.x, same_run, periods):
        where = rows.named(fault.rows)
        period = f"{fault.period:.10g}"
        name = names[fault.column]
        severity = "error"
        if fault.kind == GLITCH:
            severity = "warning"
            turns = np.unique(fault.turns[fault.rows] * fault.period)
            amounts = " or ".join(f"{amount:+.10g}" for amount in turns)
            message = (
                f"{len(fault.rows)} readings of {name!r} are off by {amounts}, whole turns of "
                f"{period}, while the tip stays ({where})."
            )
        elif fault.kind == TURNS:
            changes = np.diff(fault.turns)[fault.rows - 1] * fault.period
            amounts = ", ".join(f"{amount:+.10g}" for amount in changes)
            message = (
                f"the encoder of {name!r} changes by {amounts}, whole turns of {period}, while the "
                f"tip stays: it lost turns, as at a power cycle, from {where} on."
            )
        else:
            message = f"the readings of {name!r} wrap: they start again after {period} ({where})."
        advice = _ADVICE.format(period=fault.period)
        yield rows.finding("encoder", message, advice, fault.rows, severity)
