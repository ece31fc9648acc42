"""Times of a log: units, and numbers that cannot be seconds."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.runs import RunOrder
from hybridkin._core.units import FRAMES, SECONDS, duration_in_words

_EPOCH = 1e9, 4e9  # [s] since 1970: the years 2001 to 2096
_LONG_STEP = 1000.0  # [s]; nobody records rows so far apart
_USUAL_STEP = 2.0  # [s]
_LONG_RUN = 48.0 * 3600.0  # [s]
_LONGER_STEP = 2.0  # [s], of a recording that is no time series of seconds if it takes days
_EQUAL = 0.9  # part of the steps that are one: frames are counted


class ClockDoubt(NamedTuple):
    """Why times seem to have another unit than seconds.

    Attributes
    ----------
    unit : str
        The unit that they seem to have, a key of `units.SECONDS` or "frames"; empty: no doubt.
    reason : str
        What shows it.
    certain : bool
        Whether they cannot be seconds.
    """

    unit: str = ""
    reason: str = ""
    certain: bool = False

    @property
    def way_out(self) -> str:
        """How to read the log instead."""
        if self.unit == FRAMES:
            return (
                'if they are frames, read the log with time_unit = "frames" and rate = frames per '
                "second in [log], or --time-unit frames --rate HZ"
            )
        return f'read the log with time_unit = "{self.unit}" in [log], or --time-unit {self.unit}'


def clock_doubt(time: NDArray, runs: NDArray) -> ClockDoubt:
    """Return whether times seem to have another unit than seconds.

    Parameters
    ----------
    time, runs : ndarray of shape (N,)
        Time and run of every row.
    """
    size = float(np.median(np.abs(time))) if len(time) else 0.0
    for unit, seconds in SECONDS.items():
        low, high = _EPOCH
        if unit != "s" and low <= size * seconds <= high:
            reason = f"times about {size:.3g} are {unit} since 1970"
            return ClockDoubt(unit, reason, certain=True)
    order = RunOrder.of(runs)
    steps = order.steps(time)
    steps = steps[steps > 0.0]
    if len(steps) < 3:
        return ClockDoubt()
    usual = float(np.median(steps))
    if usual >= _LONG_STEP:
        unit = _likely_unit(usual)
        reason = f"the usual step from row to row is {duration_in_words(usual)}"
        return ClockDoubt(unit, reason, certain=True)
    in_order = time[order.order]
    longest = float((in_order[order.ends] - in_order[order.starts]).max())
    if usual >= _LONGER_STEP and longest > _LONG_RUN:
        reason = f"a run takes {duration_in_words(longest)}, in steps of {usual:.3g} s"
        return ClockDoubt("ms", reason)
    whole = bool((time == np.round(time)).all())
    if whole and usual == 1.0 and (steps == 1.0).mean() >= _EQUAL:
        return ClockDoubt(FRAMES, "the times are consecutive whole numbers")
    return ClockDoubt()


def _likely_unit(step: float) -> str:
    """Return the largest unit below seconds in which a step is a usual one."""
    units = [unit for unit in SECONDS if unit != "s"]
    for unit in units:
        if step * SECONDS[unit] <= _USUAL_STEP:
            return unit
    return units[-1]


def check_seconds(time: NDArray, runs: NDArray) -> None:
    """Raise if times cannot be seconds; the arguments are those of `clock_doubt`."""
    doubt = clock_doubt(time, runs)
    if doubt.certain:
        raise ValueError(
            f"`time` must be in seconds, for creep, but {doubt.reason}; {doubt.way_out}; or give "
            f"time * {SECONDS[doubt.unit]:g} in Commands(q, runs, time)."
        )
