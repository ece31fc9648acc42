"""The backlash (also called play), or other hysteresis, of the actuators, from a log."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.groups import Groups
from hybridkin._core.model import as_forward_model
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import HysteresisChoice, Spec
from hybridkin.hysteresis.log import HysteresisLog, which_count
from hybridkin.hysteresis.reversals import Coarseness
from hybridkin.hysteresis.search import find_hysteresis
from hybridkin.hysteresis.value import NO_HYSTERESIS, Hysteresis
from hybridkin.learning.elm_cv import ELMRegressorCV


class Past(NamedTuple):
    """Hysteresis after the last row: its run, its time [s], and the state."""

    run: object
    time: float
    state: NDArray | None

    def within(self, run: object, time: float) -> Past:
        """Return the past of rows of a run from some time on [s]: nothing of other runs."""
        return self if self.run == run else Past(run, time, None)


NO_PAST = Past(object(), 0.0, None)
_MISSED = 0.5  # largest part of a width by which rows can miss reversals
_WIDEST = 0.95  # of the range of a log, that is no limit of a backlash
_PLAIN: dict[str, Any] = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}


def choice_of(setting: ArrayLike | Hysteresis) -> HysteresisChoice:
    """Return the choice for the setting `hysteresis`: "auto", one or n widths, or a value."""
    if isinstance(setting, str):
        return FoundHysteresis()
    if isinstance(setting, Hysteresis):
        return GivenHysteresis(setting)
    return GivenHysteresis(Hysteresis.backlash(setting))


class GivenHysteresis(HysteresisChoice):
    """A hysteresis of the user."""

    def __init__(self, hysteresis: Hysteresis) -> None:
        self._hysteresis = hysteresis

    def __bool__(self) -> bool:
        """Return whether there is one."""
        return bool(self._hysteresis)

    def of(self, spec: Spec, rows: Rows) -> tuple[Hysteresis, list[str]]:
        """Return the hysteresis, and a warning if an actuator never moves."""
        hysteresis = self._hysteresis
        ranges = np.ptp(rows.X, axis=0)
        width = hysteresis.width
        if width.size not in (1, len(ranges)):
            raise ValueError(
                f"`hysteresis` must be a width or {len(ranges)} widths, got "
                f"{width.tolist()!r:.200}."
            )
        if not hysteresis or not np.any(width >= ranges):
            return hysteresis, []
        return hysteresis, [
            f"`hysteresis` of the width {width.tolist()} must be less than the range of `X`, "
            f"{ranges}: else an actuator never moves. Give it in the unit of `X`, for lengths "
            "metres."
        ]


class FoundHysteresis(HysteresisChoice):
    """The hysteresis of least error on held-out motions, maybe none."""

    def __bool__(self) -> bool:
        """Return that there may be one."""
        return True

    def of(self, spec: Spec, rows: Rows) -> tuple[Hysteresis, list[str]]:
        """Return the hysteresis, and warnings about what the log does not show."""
        measured = rows.ungrouped().take(rows.counted)
        found = choose_hysteresis(spec.calibrated(measured), rows)
        if not found:
            return found, []
        widest = np.ptp(rows.X, axis=0).max()
        single = found == Hysteresis.backlash(found.width)
        if not single or found.width < _WIDEST * widest:
            return found, coarse_in_words(found, rows)
        return found, [
            f"hysteresis='auto' found a backlash of {found.width:.3g}, as wide as the range of "
            "`X`: the log gives no upper limit. Record larger motions, or give the width as "
            "`hysteresis`."
        ]


def coarse_in_words(hysteresis: Hysteresis, rows: Rows) -> list[str]:
    """Return a warning if the rows of a log are too far apart to show reversals, else nothing.

    Parameters
    ----------
    hysteresis : Hysteresis
        What was found.
    rows : Rows
        The log, with the rows of each run in order of time.
    """
    log = Coarseness.of(rows.X, rows.runs)
    hint = "Record rows closer in time, also those without a measured tip."
    if not log.shows_reversals:
        return [
            f"hysteresis='auto' found {hysteresis.kind}, but actuators reverse at up to "
            f"{100.0 * log.reversing.max():.0f} % of the rows: what they do in between is not in "
            f"the log. {hint}"
        ]
    missed = log.missed - _MISSED * hysteresis.width
    if not np.any((missed > 0.0) & (hysteresis.width > 0.0)):
        return []
    actuator = int(np.argmax(missed))
    width = np.broadcast_to(hysteresis.width, missed.shape)[actuator]
    return [
        f"hysteresis='auto' found {hysteresis.kind} of {width:.3g}, but actuator {actuator} "
        f"reverses about {log.missed[actuator]:.3g} beyond the recorded rows. {hint}"
    ]


def choose_hysteresis(spec: Spec, rows: Rows) -> Hysteresis:
    """Return the hysteresis of least error on held-out motions; empty if none helps.

    Rows without times tell nothing of creep.

    Parameters
    ----------
    spec : Spec
        The mechanical model, calibrated without hysteresis.
    rows : Rows
        The log, with the rows of each run in order of time.
    """
    groups = Groups(rows.groups.motions).in_parts().labels
    positions = spec.positions(rows).numpy().astype(np.float64)
    usable = which_count(positions, rows.counts)
    if len(np.unique(groups[usable])) < 2:
        return NO_HYSTERESIS
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
            rows.runs,
            rows.time,
        )
    )


def continued(hysteresis: Hysteresis, rows: Rows, past: Past) -> tuple[NDArray, Past]:
    """Return the motion of the actuators (N, n), which go on from the past, and the new past."""
    moved = np.empty_like(rows.X)
    runs = rows.runs
    for run in dict.fromkeys(runs.tolist()):
        rows_of_run = np.flatnonzero(runs == run)
        in_run = rows.time[rows_of_run]
        last = past.within(run, in_run[0])
        if last.time > in_run[0]:
            raise ValueError(
                f"`time` must not decrease within a run, but {in_run[0]:g} s follows "
                f"{last.time:g} s; give a new run another name."
            )
        steps = None
        if rows.timed:
            steps = np.diff(in_run, prepend=last.time)
        moved[rows_of_run], state = hysteresis.apply(rows.X[rows_of_run], last.state, steps)
        past = Past(run, float(in_run[-1]), state)
    return moved, past
