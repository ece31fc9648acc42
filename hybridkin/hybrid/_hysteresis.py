"""The backlash (also called play), or other hysteresis, of the actuators, from a log."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.model import as_forward_model
from hybridkin.calibration.hysteresis_log import HysteresisLog, which_count
from hybridkin.calibration.hysteresis_search import find_hysteresis
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.chains.play import PlayOperator
from hybridkin.chains.reversals import Coarseness
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec
from hybridkin.learning.elm_cv import ELMRegressorCV


class Past(NamedTuple):
    """Hysteresis after the last row: its run, its time [s], and the state of the operator."""

    run: object
    time: float
    state: NDArray


_MISSED = 0.5  # largest part of a width by which rows can miss reversals
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def play_of(spec: Spec, rows: Rows) -> tuple[HysteresisOperator | None, list[str]]:
    """Return the hysteresis for the setting `play`, and warnings about it.

    Parameters
    ----------
    spec : Spec
        The setting, the mechanical model, and its parameters to calibrate first.
    rows : Rows
        The log, with the rows of each run in order of time.
    """
    play = spec.play
    if play is None:
        return None, []
    ranges = np.ptp(rows.X, axis=0)
    if isinstance(play, str):
        measured = replace(rows, groups=None).take(rows.counted)
        chosen = choose_hysteresis(spec.calibrated(measured), rows)
        if chosen is None:
            return None, []
        coarse = coarse_in_words(chosen, rows)
        single = isinstance(chosen, PlayOperator)
        if not single or chosen.width < 0.95 * ranges.max():
            return chosen, coarse
        return chosen, [
            f"play='auto' found a backlash of {chosen.width:.3g}, as wide as the range of "
            "`X`: the log gives no upper limit. Record larger motions, or give the width as `play`."
        ]
    operator = play
    if not isinstance(operator, HysteresisOperator):
        operator = PlayOperator(operator)
    if operator.width.size not in (1, len(ranges)):
        raise ValueError(
            f"`play` must be a width or {len(ranges)} widths, got {play!r:.200}."
        )
    if not np.any(operator.width >= ranges):
        return operator, []
    return operator, [
        f"`play` {play!r} must be less than the range of `X`, {ranges}: else an actuator never "
        "moves. Give `play` in the unit of `X`, for lengths metres."
    ]


def coarse_in_words(operator: HysteresisOperator, rows: Rows) -> list[str]:
    """Return a warning if the rows of a log are too far apart to show reversals, else nothing.

    Parameters
    ----------
    operator : HysteresisOperator
        What was found.
    rows : Rows
        The log, with the rows of each run in order of time.
    """
    log = Coarseness.of(rows.X, rows.run_of_rows)
    hint = "Record rows closer in time, also those without a measured tip."
    if not log.shows_reversals:
        return [
            f"play='auto' found {operator.kind}, but actuators reverse at up to "
            f"{100.0 * log.reversing.max():.0f} % of the rows: what they do in between is not in "
            f"the log. {hint}"
        ]
    missed = log.missed - _MISSED * operator.width
    if not np.any((missed > 0.0) & (operator.width > 0.0)):
        return []
    actuator = int(np.argmax(missed))
    width = np.broadcast_to(operator.width, missed.shape)[actuator]
    return [
        f"play='auto' found {operator.kind} of {width:.3g}, but actuator {actuator} reverses about "
        f"{log.missed[actuator]:.3g} beyond the recorded rows. {hint}"
    ]


def choose_hysteresis(spec: Spec, rows: Rows) -> HysteresisOperator | None:
    """Return the hysteresis of least error on held-out motions; None if none helps.

    Rows without times tell nothing of creep.

    Parameters
    ----------
    spec : Spec
        The mechanical model, calibrated without hysteresis.
    rows : Rows
        The log, with the rows of each run in order of time.
    """
    groups = np.zeros(len(rows)) if rows.groups is None else rows.groups
    positions = spec.positions(rows).numpy().astype(np.float64)
    usable = which_count(positions, rows.counts)
    if len(np.unique(groups)) == 1:  # a single motion is cut into ten
        groups = np.arange(len(rows)) * 10 // len(rows)
    if len(np.unique(groups[usable])) < 2:
        return None
    model = spec.mechanical
    if model is None:
        network = ELMRegressorCV(200, weight_scales=(0.4,), **_PLAIN)
        network.fit(
            rows.X[usable],
            np.nan_to_num(positions[usable]),
            rows.counts[usable],
            groups[usable],
        )
        model = as_forward_model(network)
    return find_hysteresis(
        HysteresisLog(
            model,
            rows.q.numpy(),
            positions,
            rows.counts,
            groups,
            rows.run_of_rows,
            np.zeros(len(rows)) if rows.time is None else rows.time,
        )
    )


def continued(
    operator: HysteresisOperator, rows: Rows, past: Past | None
) -> tuple[NDArray, Past | None]:
    """Return the motion of the actuators (N, n), which go on from the past, and the new past."""
    moved = np.empty_like(rows.X)
    runs = rows.run_of_rows
    for run in dict.fromkeys(runs.tolist()):
        rows_of_run = np.flatnonzero(runs == run)
        last = past if past is not None and past.run == run else None
        steps = None
        end = 0.0
        if rows.time is not None:
            times = rows.time[rows_of_run]
            before = times[0] if last is None else last.time
            if before > times[0]:
                raise ValueError(
                    f"`time` must not decrease within a run, but {times[0]:g} s follows "
                    f"{before:g} s; give a new run another name."
                )
            steps = np.diff(times, prepend=before)
            end = float(times[-1])
        state = None if last is None else last.state
        moved[rows_of_run], state = operator.apply(rows.X[rows_of_run], state, steps)
        past = Past(run, end, state)
    return moved, past
