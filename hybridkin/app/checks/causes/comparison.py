"""The comparison of causes: each is fitted to a part of the rows and judged by the others."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from hybridkin.app.checks.causes.body import (
    Misread,
    ModelError,
    OffPlane,
    OutsideTheLog,
    Payload,
)
from hybridkin.app.checks.causes.cause import Cause, Nothing, distances
from hybridkin.app.checks.causes.commands import (
    AllSigns,
    Dead,
    FirstRow,
    Gain,
    GainOfAll,
    Numbering,
    Sign,
    Size,
    Slip,
    Swap,
    Zero,
    ZeroDrift,
)
from hybridkin.app.checks.causes.evidence import Evidence
from hybridkin.app.checks.causes.frames import Axes, Bump, Drift, MovedBase, Units
from hybridkin.app.checks.causes.timing import Backlash, Creep, Lag

CAUSES: tuple[type[Cause], ...] = (
    Units,
    Axes,
    Sign,
    Swap,
    Numbering,
    Lag,
    Backlash,
    Zero,
    Gain,
    Dead,
    GainOfAll,
    Creep,
    Slip,
    Payload,
    MovedBase,
    Drift,
    Bump,
    OffPlane,
    Misread,
    OutsideTheLog,
    ModelError,
)
"""All causes that a comparison tries, in the order in which it names equal ones."""

READINGS: tuple[type[Cause], ...] = (AllSigns, Sign, Swap, Numbering)
"""Ways to read the columns of a log wrongly, each a single change."""

VALUES: tuple[type[Cause], ...] = (Size, FirstRow, Zero, ZeroDrift)
"""Wrong values of a log or of a description."""

LIKELY = 0.5
"""Least share of the squared error that a likely cause explains."""

_BLOCKS = 10  # of successive rows, in which errors are alike
_FOLDS = 5
_SCREENED = 100  # rows of the first fits
_ROUNDS = (1, 8, 1)  # iterations of the first fits, of the best, and in each fold
_CANDIDATES = 2  # of a kind, which are fitted to all rows
_RIVAL = 1.2  # ratio of the error of a candidate that may become the best, and of the best
_LAST_RESORT = 1.5  # ratio of the errors that a named cause and the last resort leave
_MOST_NOISE = 0.5  # of the error: largest difference that can be noise
_AS_MUCH = 0.1  # of the error: causes that differ less explain as much


@dataclass(frozen=True, eq=False)
class Explanation:
    """A cause with its fit, and its errors on rows that it was not fitted to.

    Attributes
    ----------
    cause : Cause
        The best one of its kind.
    parameters : ndarray of shape (P,)
        Its parameters, from all rows.
    errors : ndarray of shape (N,)
        Distances of the measured tips on held-out rows [m].
    body : int
        The mechanical model that it takes, of those of the evidence.
    """

    cause: Cause
    parameters: NDArray
    errors: NDArray
    body: int = 0

    def tips(self, evidence: Evidence) -> NDArray:
        """Return its tips (N, 3) on some evidence, which may be another motion [m]."""
        return self.cause.tips(evidence.with_body(self.body), self.parameters)

    @property
    def name(self) -> str:
        """Name of the cause."""
        return self.cause.name

    @cached_property
    def mean(self) -> float:
        """Mean held-out error [m]."""
        return float(self.errors.mean())


@dataclass(frozen=True, eq=False)
class CauseComparison:
    """Causes compared on the same evidence.

    Attributes
    ----------
    evidence : Evidence
        Motion, model and measured tips.
    nothing : Explanation
        The model as it is.
    explanations : list of Explanation
        One for each kind of cause.
    """

    evidence: Evidence
    nothing: Explanation
    explanations: list[Explanation]

    def share(self, explanation: Explanation) -> float:
        """Return the share of the squared error that a cause explains on held-out rows."""
        if self.nothing.mean == 0.0:
            return 0.0
        return max(0.0, 1.0 - (explanation.mean / self.nothing.mean) ** 2)

    @cached_property
    def shares(self) -> dict[str, float]:
        """Share of the squared error that each cause explains on held-out rows."""
        return {e.name: self.share(e) for e in self.explanations}

    @cached_property
    def best(self) -> Explanation:
        """The simplest cause within the noise of the best."""
        named = [e for e in self.explanations if not e.cause.is_last_resort]
        best = self.simplest([self.nothing, *named])
        others = [e for e in self.explanations if e.cause.is_last_resort]
        for other in others:
            far_better = other.mean * _LAST_RESORT < best.mean
            if far_better or self.share(best) < LIKELY < self.share(other):
                best = other
        return best

    def simplest(self, explanations: Sequence[Explanation]) -> Explanation:
        """Return the one with the fewest parameters within the noise of the best of them."""
        least = min(explanations, key=lambda e: e.mean)
        near = [e for e in explanations if self._as_good(e, least)]
        return min(near, key=lambda e: (e.cause.n_parameters, e.mean))

    @cached_property
    def likely(self) -> Explanation:
        """The best cause if it explains most of the squared error, else nothing."""
        return self.best if self.share(self.best) > LIKELY else self.nothing

    @cached_property
    def also(self) -> list[Explanation]:
        """The other causes that explain as much as the likely one."""
        likely = self.likely
        if likely is self.nothing:
            return []
        others = []
        for explanation in self.explanations:
            if explanation is not likely and self._as_good(explanation, likely):
                others.append(explanation)
        return sorted(others, key=lambda e: (e.cause.n_parameters, e.mean))

    def _as_good(self, one: Explanation, other: Explanation) -> bool:
        """Return whether a cause explains as much as another one, or more."""
        loss = one.errors - other.errors
        noise = min(self._standard_error(loss), _MOST_NOISE * other.mean)
        return bool(loss.mean() <= max(noise, _AS_MUCH * other.mean))

    def _standard_error(self, values: NDArray) -> float:
        """Return the standard error of the mean of values (N,), which are alike in blocks."""
        block = blocks(len(values))
        n_blocks = block[-1] + 1
        if n_blocks < 2:
            return float(np.abs(values).mean())
        means = np.bincount(block, values) / np.bincount(block)
        return float(means.std(ddof=1) / np.sqrt(n_blocks))


def blocks(n_rows: int) -> NDArray:
    """Return the block (N,) of successive rows."""
    return min(_BLOCKS, n_rows) * np.arange(n_rows) // n_rows


def compare_causes(evidence: Evidence, causes: Sequence[type[Cause]] = CAUSES) -> CauseComparison:
    """Return how much of the error of a model each cause explains on held-out rows.

    Parameters
    ----------
    evidence : Evidence
        Motion, model and measured tips.
    causes : sequence of type
        The kinds of causes to compare.
    """
    chosen = np.linspace(0, len(evidence.rows) - 1, min(_SCREENED, len(evidence.rows)))
    few = evidence.some(chosen.astype(int))
    explanations = []
    for kind in causes:
        explanations += _explained(evidence, few, kind)
    (nothing,) = Nothing.members(evidence)
    return CauseComparison(evidence, _judged(evidence, nothing, np.zeros(0)), explanations)


def _explained(evidence: Evidence, few: Evidence, kind: type[Cause]) -> list[Explanation]:
    """Return the best cause of a kind, judged on held-out rows, if the evidence has any."""
    n_bodies = len(evidence.bodies) if kind.moves_actuators else 1
    screened = []
    for body in range(n_bodies):
        whole = evidence.with_body(body)
        part = few.with_body(body)
        for member in kind.members(whole):
            for start in member.starts(part):
                parameters = member.fit(part, _all(part), start, _ROUNDS[0])
                error = _error(part, member, parameters)
                screened.append((error, whole, member, parameters))
    if not screened:
        return []
    screened.sort(key=lambda entry: entry[0])  # of equal ones the first stay first
    fitted = []
    least = screened[0][0]
    for error, whole, member, start in screened[:_CANDIDATES]:
        if error > _RIVAL * least:
            break
        parameters = member.fit(whole, _all(whole), start, _ROUNDS[1])
        fitted.append((_error(whole, member, parameters), whole, member, parameters))
    _, whole, cause, parameters = min(fitted, key=lambda entry: entry[0])
    return [_judged(whole, cause, parameters)]


def _judged(evidence: Evidence, cause: Cause, parameters: NDArray) -> Explanation:
    """Return a cause with its errors on rows that are held out in turn."""
    n_rows = len(evidence.rows)
    fold = blocks(n_rows) % _FOLDS
    errors = np.empty(n_rows)
    tips = cause.tips(evidence, parameters)
    for k in range(_FOLDS):
        held_out = fold == k
        if not held_out.any():
            continue
        if len(parameters):
            refitted = cause.fit(evidence, ~held_out, parameters, _ROUNDS[2])
            tips = cause.tips(evidence, refitted)
        weights = (~held_out).astype(float)
        aligned = evidence.alignment.aligned(tips, evidence.x, weights)
        errors[held_out] = distances(aligned, evidence.x)[held_out]
    errors = _with_excuse(errors, cause.excused(evidence), evidence.promised)
    return Explanation(cause, parameters, errors, evidence.body)


def _error(evidence: Evidence, cause: Cause, parameters: NDArray) -> float:
    """Return the mean error of a fitted cause on all rows [m]."""
    tips = cause.aligned(evidence, parameters, np.ones(len(evidence.rows)))
    errors = distances(tips, evidence.x)
    errors = _with_excuse(errors, cause.excused(evidence), evidence.promised)
    return float(errors.mean())


def _with_excuse(errors: NDArray, excused: NDArray, promised: float) -> NDArray:
    """Return errors (N,), of excused rows the mean of the others or that of the promise."""
    if not excused.any():
        return errors
    usual = promised
    if not excused.all():
        usual = float(errors[~excused].mean())
    elif promised == 0.0:
        return errors
    return np.where(excused, usual, errors)


def _all(evidence: Evidence) -> NDArray:
    return np.ones(len(evidence.rows), dtype=bool)
