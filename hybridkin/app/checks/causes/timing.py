"""Causes in time: a late camera, backlash, creep."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin import Hysteresis
from hybridkin.app.checks.causes.cause import Cause
from hybridkin.app.checks.causes.commands import ActuatorCause
from hybridkin.app.checks.causes.evidence import Evidence
from hybridkin.app.checks.causes.motion import Motion

_PERIODS = 63  # at most, as in a control loop
_MOST = 0.25  # of the duration: else the ends of the motion decide
_LAGS = (1.0, 2.0, 4.0, 8.0, 16.0, 32.0)  # periods, from which a fit begins
_WIDTHS = (0.01, 0.03, 0.1, 0.3)  # of the largest range
_TIMES = (3.0, 10.0, 40.0)  # time constants from which a fit begins, in periods
_SHARES = (0.3,)


class Lag(Cause):
    """The tips were read later, or earlier, than their commands say."""

    name = "lag"
    remedy = "synchronise the clocks; or give the lag of the camera by --delay"
    n_parameters = 1

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def _longest(self, evidence: Evidence) -> float:
        motion = evidence.motion
        return min(_PERIODS * motion.period, _MOST * motion.duration)

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return lags in both directions."""
        lags = np.array(_LAGS) * evidence.motion.period
        lags = lags[lags <= self._longest(evidence)]
        return [*lags[:, None], *-lags[:, None]]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return the period of the commands."""
        return np.array([evidence.motion.period])

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) a while before [m]."""
        longest = self._longest(evidence)
        delay = float(np.clip(parameters[0], -longest, longest))
        return evidence.motion.earlier(evidence.path, evidence.rows, delay)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the lag in words."""
        motion = evidence.motion
        delay = float(parameters[0])
        where = "after" if delay > 0.0 else "before"
        words = f"the tips were read {abs(delay) / motion.period:.3g} rows {where} their commands"
        if motion.clock == "s":
            words += f" ({abs(delay):.3g} s)"
        return words


class _Hysteresis(ActuatorCause):
    """A cause between the commands and what the actuators do, which depends on the past."""

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    @abstractmethod
    def effective(self, motion: Motion, parameters: NDArray) -> NDArray:
        """Return what the actuators do (T, n) for a motion [unit of q]."""

    def changed(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return what the actuators did (N, n) with these parameters [unit of q]."""
        return self.effective(evidence.motion, parameters)[evidence.rows]


class Backlash(_Hysteresis):
    """All actuators have backlash of one width."""

    name = "backlash"
    remedy = "fit named motions in order of time that reverse the actuators"
    n_parameters = 1

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return widths of several sizes."""
        largest = evidence.motion.span.max()
        return [np.array([share * largest]) for share in _WIDTHS]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return a tenth of the largest range."""
        return 0.1 * evidence.motion.span.max(keepdims=True)

    def effective(self, motion: Motion, parameters: NDArray) -> NDArray:
        """Return the motion (T, n) behind the backlash [unit of q]."""
        width = max(float(parameters[0]), 0.0)
        return motion.after(Hysteresis.backlash(width))

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the width in words."""
        actuators = evidence.actuators
        largest = int(evidence.motion.span.argmax())
        width = abs(parameters[0] / actuators.per_unit[largest])
        return f"{width:.3g} {actuators.unit} wide".replace("  ", " ")


class Creep(_Hysteresis):
    """A share of every change comes late."""

    name = "creep"
    remedy = "fit named motions with times (--hysteresis auto), or move slowly and wait for rest"
    n_parameters = 2

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return several times; shares are logits, times logarithms of periods."""
        beginnings = []
        for late_part in _SHARES:
            for time in _TIMES:
                beginnings.append(np.array([np.log(late_part / (1.0 - late_part)), np.log(time)]))
        return beginnings

    def steps(self, evidence: Evidence) -> NDArray:
        """Return one for both."""
        return np.ones(2)

    def _share_and_time(self, motion: Motion, parameters: NDArray) -> tuple[float, float]:
        late_part = 0.95 / (1.0 + np.exp(-np.clip(parameters[0], -30.0, 30.0)))
        longest = np.log(motion.duration / motion.period)
        time = motion.period * np.exp(np.clip(parameters[1], -1.0, max(longest, 0.0)))
        return float(late_part), float(time)

    def effective(self, motion: Motion, parameters: NDArray) -> NDArray:
        """Return the motion (T, n) of which a part comes late [unit of q]."""
        late_part, time = self._share_and_time(motion, parameters)
        return motion.after(Hysteresis.creep([late_part], [time]))

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the share and the time constant in words."""
        motion = evidence.motion
        late_part, time = self._share_and_time(motion, parameters)
        return (
            f"{100 * late_part:.0f} % of every change comes with a time constant of {time:.3g} "
            f"{motion.clock}"
        )
