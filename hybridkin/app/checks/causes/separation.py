"""The motion on which two causes that explain as much differ most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hybridkin.app.checks.causes.cause import distances
from hybridkin.app.checks.causes.comparison import Explanation
from hybridkin.app.checks.causes.evidence import Evidence

_ROWS = 40  # of a sweep
_HOLD = 10.0  # [s]
_SLOWER = 10.0
_CLEARLY = 1.1  # ratio of the differences on a later motion and on a simpler one
_TOLD = 3.0  # times the error that is left: least difference that tells two causes apart


@dataclass(frozen=True, eq=False)
class Separation:
    """A motion that separates two causes.

    Attributes
    ----------
    words : str
        What to do.
    difference : float
        Largest distance of the tips of both causes on it [m].
    """

    words: str
    difference: float


def separating_motion(evidence: Evidence, one: Explanation, other: Explanation) -> Separation:
    """Return the simple motion in the range of the model on which two fitted causes differ most.

    The candidates move one actuator alone out and back, all together from one end of the range to
    the other, or hold still; and each of them slowly.

    Parameters
    ----------
    evidence : Evidence
        Motion, model and measured tips.
    one, other : Explanation
        Two fitted causes.
    """
    best = Separation("", 0.0)
    for words, q, period in _candidates(evidence):
        further = evidence.followed_by(q, period)
        difference = float(distances(one.tips(further), other.tips(further)).max())
        if difference > _CLEARLY * best.difference:
            best = Separation(words, difference)
    least = _TOLD * max(one.mean, 1e-9)
    if best.difference < least:
        return Separation("", best.difference)
    return best


def _candidates(evidence: Evidence) -> list[tuple[str, NDArray, float]]:
    """Return motions (K, n) and their periods with words for them, the simple ones first."""
    straight = _posture(evidence)
    period = evidence.motion.period
    still = np.repeat(straight[None], _ROWS, axis=0)
    out_and_back = np.sin(np.linspace(0.0, np.pi, _ROWS)) ** 2
    candidates = [("hold still at the straight or middle posture", still, period)]
    for i, name in enumerate(evidence.actuators.names):
        for end in (evidence.low[i], evidence.high[i]):
            sweep = still.copy()
            sweep[:, i] += out_and_back * (end - straight[i])
            words = f"move {name} alone, out and back"
            candidates.append((words, sweep, period))
            candidates.append((f"{words}, ten times slower", sweep, _SLOWER * period))
    far = still.copy()
    far[: _ROWS // 8] = evidence.high
    pause = max(_HOLD / _ROWS, period)
    candidates.append(("go far out and back at once, then hold still for 10 s", far, pause))
    return candidates


def _posture(evidence: Evidence) -> NDArray:
    """Return the rest within the range, for actuators of absolute length the middle, (n,)."""
    actuators = evidence.actuators
    middle = 0.5 * (evidence.low + evidence.high)
    rest = np.clip(actuators.rest, evidence.low, evidence.high)
    return np.where(actuators.absolute, middle, rest)
