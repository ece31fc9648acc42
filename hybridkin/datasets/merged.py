"""One log from two recordings: commands by the motors, tips by the camera, merged by time."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.arrays import countable, number
from hybridkin._core.units import METRES
from hybridkin.datasets._lag import EXPLAINED, candidate_lags, explained_share, polished, unclear
from hybridkin.datasets.logs import Log
from hybridkin.datasets.timed_columns import TimedColumns, commands_at, row_before

_GAP = 5.0  # usual periods of the motor rows: longer ones are gaps


class Merged(NamedTuple):
    """A log merged from two recordings.

    Attributes
    ----------
    log : Log
        The camera rows with the command of their time; `time` is that of the motors.
    lag : float
        How much later than the clock of the motors that of the camera is [s].
    explained : float
        Share of the variance of the tips that a rough model of the commands explains at this lag,
        in thirds of the log that it was not fitted to.
    is_estimated : bool
        Whether the lag was estimated.
    n_left_out : int
        Number of camera rows without a tip, or without motor rows around them.
    """

    log: Log
    lag: float
    explained: float
    is_estimated: bool
    n_left_out: int

    def __str__(self) -> str:
        """Return the lag and the rows in words."""
        how = "estimated from when both move" if self.is_estimated else "given"
        n_rows = len(self.log.q)
        return (
            f"The camera's clock is {self.lag:.4f} s later than that of the motors ({how}); the "
            f"commands then explain {self.explained:.1%} of the motion of the tip in one third of "
            f"the rows by a rough model of the other two thirds. {n_rows} of "
            f"{n_rows + self.n_left_out} camera rows have a tip and commands around them."
        )


def merge_logs(
    motors: TimedColumns,
    camera: TimedColumns,
    *,
    lag: float | None = None,
    tolerance: float | None = None,
    hold: bool = False,
) -> Merged:
    """Return the log of a camera's tips with the motors' commands of the same time.

    The lag between the two clocks is that at which the commands explain the tips best. It includes
    the time that the robot takes to follow a command, so backlash and inertia make it longer.

    Parameters
    ----------
    motors : TimedColumns
        Commands or encoder readings, as from `read_columns`.
    camera : TimedColumns
        Tip positions [m], three columns for each marker, as from `read_columns`.
    lag : float or None, default=None
        How much later than the clock of the motors that of the camera is [s]; 0 if both share one.
        None: it is estimated, to a few milliseconds.
    tolerance : float or None, default=None
        Longest time between two motor rows of which a command is made [s]; camera rows in longer
        gaps are left out. Default: 5 usual periods of the motor rows; with `hold`, no limit.
    hold : bool, default=False
        Whether a command holds until the next one, as in a log of set points. Default: commands are
        linear between two rows.

    Returns
    -------
    Merged
        The log, the lag, and how well the two recordings fit each other. Without groups of the
        motors, a new run starts after every gap.

    Raises
    ------
    ValueError
        If the camera has no three columns for each marker, no rows are left, or no lag is clearly
        the best one: where nothing moves, or a motion repeats.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin.datasets import TimedColumns, merge_logs
    >>> def q(t):
    ...     return np.stack([np.sin(t), np.sin(1.7 * t), np.sin(0.6 * t**1.2)], axis=1)
    >>> t = np.arange(0, 20, 0.01)
    >>> seen = np.arange(2, 15, 0.03)
    >>> motors = TimedColumns(q(t), t)
    >>> camera = TimedColumns(0.05 * q(seen) + 0.1, seen + 1234.5)
    >>> round(merge_logs(motors, camera).lag, 3)
    1234.5
    """
    for name, recording in (("motors", motors), ("camera", camera)):
        if not isinstance(recording, TimedColumns):
            raise TypeError(
                f"`{name}` must be a recording as from `read_columns`, or `TimedColumns`, got "
                f"{type(recording).__name__}."
            )
    if camera.values.shape[1] % 3:
        raise ValueError(
            "`camera` must have three columns for each marker, got "
            f"{camera.values.shape[1]}: {list(camera.names)}."
        )
    commands = motors.complete()
    tips = _measured(camera)
    if len(commands.time) < 3 or len(tips.time) < 3:
        raise ValueError(
            "`motors` and `camera` must have at least 3 complete rows each, got "
            f"{len(commands.time)} and {len(tips.time)}."
        )
    is_estimated = lag is None
    candidates = []
    if lag is None:
        candidates = candidate_lags(commands, tips, hold)
        if len(candidates) > 1 and candidates[1].unexplained < candidates[0].as_good:
            raise ValueError(unclear(motors, camera, candidates))
        best = candidates[0]
        lag = polished(commands, tips, best.lag, best.width, hold)
    else:
        lag = number(lag, "lag")
    time = tips.time - lag
    is_covered, runs = _covered(commands, time, _longest_gap(commands, tolerance, hold))
    if not is_covered.any():
        raise ValueError(
            f"No camera row lies between two motor rows: at the lag of {lag:.4f} s the camera "
            f"records from {time[0]:.6g} to {time[-1]:.6g} s, the motors from "
            f"{commands.time[0]:.6g} to {commands.time[-1]:.6g} s; give `lag`, or a larger "
            "`tolerance`."
        )
    q = commands_at(commands, time[is_covered], hold)
    x = tips.values[is_covered]
    groups = commands.groups
    if groups is not None:
        groups = groups[row_before(commands, time[is_covered])]
    log = Log(
        q,
        x,
        groups=groups,
        time=time[is_covered],
        runs=runs[is_covered],
        q_names=motors.names,
        x_names=camera.names,
        units={"q": _si_unit(motors.unit), "x": "m"},
        file_units={"q": motors.unit, "x": camera.unit},
        source=f"{motors.source} and {camera.source}",
    )
    explained, _ = explained_share(q, x)
    if is_estimated and explained < EXPLAINED:
        raise ValueError(unclear(motors, camera, candidates))
    n_left_out = len(camera.time) - int(is_covered.sum())
    return Merged(log, lag, explained, is_estimated, n_left_out)


def _measured(camera: TimedColumns) -> TimedColumns:
    """Return the camera rows in which a marker is complete; other markers are NaN."""
    markers = camera.values.reshape(len(camera.time), -1, 3)
    complete = countable(markers).all(axis=2)
    values = np.where(complete.repeat(3, axis=1), camera.values, np.nan)
    is_complete = complete.any(axis=1)
    return TimedColumns(
        values[is_complete],
        camera.time[is_complete],
        camera.names,
        camera.unit,
        None,
        camera.source,
    )


def _longest_gap(motors: TimedColumns, tolerance: float | None, hold: bool) -> float:
    if tolerance is None:
        return np.inf if hold else _GAP * float(np.median(np.diff(motors.time)))
    if not number(tolerance, "tolerance") > 0.0:
        raise ValueError(f"`tolerance` must be a positive time [s], got {tolerance!r}.")
    return tolerance


def _covered(motors: TimedColumns, time: NDArray, longest: float) -> tuple[NDArray, NDArray]:
    """Return which times lie between two motor rows of a motion, and their runs."""
    is_gap = np.diff(motors.time) > longest
    if motors.groups is not None:
        is_gap |= motors.groups[1:] != motors.groups[:-1]
    runs = np.concatenate([[0], np.cumsum(is_gap)])
    row = row_before(motors, time)
    # The last row has none after it, but the camera may take a tip at the very same time.
    in_gap = np.append(is_gap, False)[row] & (time > motors.time[row])
    inside = (time >= motors.time[0]) & (time <= motors.time[-1])
    return inside & ~in_gap, runs[row]


def _si_unit(unit: str) -> str:
    if unit in METRES:
        return "m"
    return unit if unit == "1" else "rad"
