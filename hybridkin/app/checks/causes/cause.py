"""The base classes of all causes, and their fit to a part of the measured tips."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin.app.checks.causes.evidence import Evidence

_STEP = 1e-4  # of differences, in natural steps of the parameters
_HUBER = 2.0  # times the median distance: from there on, distances count linearly
_BETTER = 1e-4  # least relative gain of a further iteration
_HALVINGS = 4
_ROUNDS = 4  # of the weights of a linear fit


def distances(a: NDArray, b: NDArray) -> NDArray:
    """Return the distances (N,) of points (N, 3) [m]."""
    return np.linalg.norm(a - b, axis=1)


def robust_weights(far: NDArray) -> NDArray:
    """Return the weights (N,) of rows with these distances: less for outliers (Huber)."""
    limit = max(_HUBER * float(np.median(far)), np.finfo(float).tiny)
    return limit / np.maximum(far, limit)


class Cause(ABC):
    """A small change of what a model says, which would explain the measured tips.

    A subclass says what the tips would be for its parameters. Those of `starts` are the places from
    which a fit begins, and `steps` are their natural sizes.

    Attributes
    ----------
    name : str
        What it is.
    remedy : str
        What to do.
    n_parameters : int
        Number of fitted numbers: of two causes that explain as much, the one with fewer is named.
    moves_actuators : bool
        Whether the actuators do something else, which the mechanical model turns into tips.
    is_last_resort : bool
        Whether it can look like all others, and is named only if these leave far more.
    """

    name: ClassVar[str]
    remedy: ClassVar[str]
    n_parameters: ClassVar[int] = 0
    moves_actuators: ClassVar[bool] = False
    is_last_resort: ClassVar[bool] = False

    @classmethod
    @abstractmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the causes of this kind to try, for example one for each actuator."""

    @abstractmethod
    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) with these parameters (P,), before the alignment [m]."""

    @abstractmethod
    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return how large it is, and which actuator or rows, in words."""

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return parameters (P,) from which fits begin."""
        return [np.zeros(0)]

    def steps(self, evidence: Evidence) -> NDArray:
        """Return the natural sizes (P,) of changes of the parameters."""
        return np.zeros(0)

    def excused(self, evidence: Evidence) -> NDArray:
        """Return the rows (N,) of bool about which the cause says nothing."""
        return np.zeros(len(evidence.rows), dtype=bool)

    def fit(self, evidence: Evidence, used: NDArray, start: NDArray, rounds: int) -> NDArray:
        """Return the parameters (P,) for some rows: Gauss-Newton on robust distances.

        Parameters
        ----------
        evidence : Evidence
            Motion, model and measured tips.
        used : ndarray of shape (N,) of bool
            The rows to fit.
        start : ndarray of shape (P,)
            Where to begin.
        rounds : int
            Number of iterations at most.
        """
        steps = self.steps(evidence)
        parameters = start
        if not len(parameters):
            return parameters
        weights = used.astype(float)
        residual = self._residual(evidence, parameters, weights)
        for _ in range(rounds):
            weights = np.where(used, robust_weights(_lengths(residual)), 0.0)
            columns = []
            for step in np.diag(_STEP * steps):
                # At a kink, the mean of both slopes: the sign of an actuator does not matter.
                ahead = self._residual(evidence, parameters + step, weights)
                behind = self._residual(evidence, parameters - step, weights)
                columns.append((ahead - behind).ravel() / (2.0 * _STEP))
            root = np.sqrt(weights.repeat(3))
            slope = np.stack(columns, axis=1) * root[:, None]
            move, *_ = np.linalg.lstsq(slope, -root * residual.ravel(), rcond=1e-8)
            before = _cost(residual, weights)
            for halving in range(_HALVINGS):
                tried = parameters + 0.5**halving * steps * move
                ahead = self._residual(evidence, tried, weights)
                if _cost(ahead, weights) < before:
                    parameters = tried
                    residual = ahead
                    break
            if not _cost(residual, weights) < (1.0 - _BETTER) * before:
                break
        return parameters

    def aligned(self, evidence: Evidence, parameters: NDArray, weights: NDArray) -> NDArray:
        """Return the tips (N, 3) in the measuring frame, aligned by rows with weights (N,) [m]."""
        tips = self.tips(evidence, parameters)
        return evidence.alignment.aligned(tips, evidence.x, weights)

    def _residual(self, evidence: Evidence, parameters: NDArray, weights: NDArray) -> NDArray:
        return self.aligned(evidence, parameters, weights) - evidence.x


class LinearCause(Cause):
    """A cause whose tips are linear in its parameters."""

    @abstractmethod
    def columns(self, evidence: Evidence) -> NDArray:
        """Return the derivatives (N, 3, P) of the tips by the parameters."""

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) with these parameters (P,) [m]."""
        return evidence.tips + self.columns(evidence) @ parameters

    def fit(self, evidence: Evidence, used: NDArray, start: NDArray, rounds: int) -> NDArray:
        """Return the parameters (P,) for some rows, by weighted least squares."""
        columns = self.columns(evidence)[used]
        residual = (evidence.x - evidence.tips)[used]
        flat = columns.reshape(-1, columns.shape[2])
        weights = np.ones(len(columns))
        parameters = start
        for _ in range(_ROUNDS):
            root = np.sqrt(weights.repeat(3))
            parameters, *_ = np.linalg.lstsq(
                flat * root[:, None], root * residual.ravel(), rcond=1e-8
            )
            weights = robust_weights(_lengths(residual - columns @ parameters))
        return parameters


class Nothing(Cause):
    """No cause at all: the model as it is."""

    name = "nothing"
    remedy = ""

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) of the model [m]."""
        return evidence.tips

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return no words."""
        return ""


def _lengths(residual: NDArray) -> NDArray:
    return np.linalg.norm(residual, axis=1)


def _cost(residual: NDArray, weights: NDArray) -> float:
    return float(weights @ np.square(residual).sum(axis=1))
