"""Times of a log file in seconds."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from hybridkin._core.arrays import number, one_of
from hybridkin._core.units import FRAMES, SECONDS


def seconds_per_unit(column: ArrayLike, time_unit: str, rate: float | None) -> float:
    """Return the seconds per unit of a column of times, after a check of the arguments.

    Parameters
    ----------
    column : array-like of shape (N,)
        The column as it is in the file; dates and durations become seconds by themselves.
    time_unit, rate
        As for `load_log`.
    """
    one_of(time_unit, "time_unit", (*SECONDS, FRAMES))
    if rate is not None and time_unit != FRAMES:
        raise ValueError(
            f'`rate` needs time_unit="frames", got {time_unit!r}: times in {time_unit} have no '
            "rate; leave it out."
        )
    if isinstance(column, np.ndarray) and column.dtype.kind in "mM":
        return 1.0
    if time_unit != FRAMES:
        return SECONDS[time_unit]
    if rate is None:
        raise ValueError(
            '`rate` must be given with time_unit="frames", in frames per second: --rate HZ, or '
            "rate = HZ in [log]."
        )
    frames_per_second = number(rate, "rate")
    if not 0.0 < frames_per_second < np.inf:
        raise ValueError(
            f"`rate` must be a finite positive number of frames per second, got {rate!r}."
        )
    return 1.0 / frames_per_second
