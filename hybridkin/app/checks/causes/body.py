"""Causes in the body and in the model: a load, an error, rows that it does not know."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from hybridkin import Commands
from hybridkin.app.checks.causes.cause import Cause, LinearCause
from hybridkin.app.checks.causes.evidence import Evidence

_ROWS_PER_FEATURE = 8  # least number of rows for each quadratic feature
_MOST_MISREAD = 0.25  # of the rows
_SHARP = 3.0  # least ratio of the errors of misread rows and of the others
_RIDGE = 1e-4  # penalty of features of unit size, relative to the number of rows


class Payload(LinearCause):
    """A load at the tip: a constant force, to which the body gives way."""

    name = "payload"
    remedy = "weigh what hangs at the tip; fit a log with this load"
    n_parameters = 3

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind."""
        return [cls()]

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no force."""
        return [np.zeros(3)]

    def columns(self, evidence: Evidence) -> NDArray:
        """Return the compliance (N, 3, 3) of the tip, up to a factor."""
        return evidence.compliance

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the direction of the force and the mean deflection in words."""
        direction = parameters / max(np.linalg.norm(parameters), np.finfo(float).tiny)
        moved = np.linalg.norm(evidence.compliance @ parameters, axis=1).mean()
        x, y, z = direction
        return (
            f"the tip gives way by {1e3 * moved:.3g} mm on average to a force along "
            f"({x:.2f}, {y:.2f}, {z:.2f})"
        )


class OffPlane(LinearCause):
    """The commands leave the plane of the log, where the model knows nothing."""

    name = "off the plane of the log"
    remedy = "add motions off the plane to the log, or send commands in it"
    n_parameters = 6

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, if commands are off the plane."""
        return [cls()] if evidence.off_plane.any() else []

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no error."""
        return [np.zeros(3 * evidence.n_actuators)]

    def columns(self, evidence: Evidence) -> NDArray:
        """Return the distances from the plane, for each coordinate, (N, 3, 3 n)."""
        return np.kron(np.eye(3), evidence.off_plane[:, None, :]).reshape(len(evidence.rows), 3, -1)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return how far commands are off the plane in words."""
        actuators = evidence.actuators
        far = np.abs(evidence.off_plane / actuators.per_unit).max()
        return f"commands are up to {far:.3g} {actuators.unit} off it".replace("  ", " ")


class OutsideTheLog(Cause):
    """Errors are larger where the path leaves the log."""

    name = "outside the log"
    remedy = "add motions there to the log (`hybridkin next`), or move the path inside"
    n_parameters = 20

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, if the path leaves the log."""
        return [cls()] if not evidence.inside.all() else []

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) of the model [m]."""
        return evidence.tips

    def excused(self, evidence: Evidence) -> NDArray:
        """Return the rows (N,) of bool outside the log."""
        return ~evidence.inside

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return how much of the path is outside in words."""
        return f"{100 * (~evidence.inside).mean():.0f} % of the rows"


@dataclass(frozen=True)
class Misread(Cause):
    """Some rows were misread: the marker was lost or another one was seen."""

    misread: tuple[int, ...]  # rows of the motion

    name = "misread rows"
    remedy = "look at these rows: a hidden or confused marker; leave them out"
    n_parameters = 10

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the rows that are far off while their neighbours are not, if there are any."""
        residual = evidence.x - evidence.tips
        far = np.linalg.norm(residual, axis=1)
        n_rows = len(far)
        order = np.argsort(far)
        ordered = far[order]
        first = max(1, int((1.0 - _MOST_MISREAD) * n_rows))
        if first >= n_rows:
            return []
        # The widest gap between two successive errors separates the misread rows.
        ratios = ordered[first:] / np.maximum(ordered[first - 1 : -1], 1e-12)
        place = first + int(ratios.argmax())
        misread = order[place:]
        typical = ordered[:place][int(0.9 * place) :].mean()
        if ordered[place] < _SHARP * typical:
            return cls._sudden(evidence, residual, far)
        return [cls(tuple(np.sort(evidence.rows[misread]).tolist()))]

    @classmethod
    def _sudden(cls, evidence: Evidence, residual: NDArray, far: NDArray) -> Sequence[Self]:
        """Return the one block of rows between two jumps of the residual, if it is far off."""
        jumps = np.linalg.norm(np.diff(residual, axis=0), axis=1)
        if len(jumps) < 8:
            return []
        first, last = np.sort(np.argsort(jumps)[-2:]) + 1
        block = np.zeros(len(far), dtype=bool)
        block[first:last] = True
        sharp = np.sort(jumps)[-2] > _SHARP * np.quantile(jumps, 0.95)
        larger = np.median(far[block]) > _SHARP * np.median(far[~block])
        if not sharp or not larger or block.mean() > _MOST_MISREAD:
            return []
        return [cls(tuple(evidence.rows[block].tolist()))]

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) of the model [m]."""
        return evidence.tips

    def excused(self, evidence: Evidence) -> NDArray:
        """Return the misread rows (N,) of bool."""
        return np.isin(evidence.rows, self.misread)

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return the rows in words."""
        first = self.misread[0]
        last = self.misread[-1]
        return f"{len(self.misread)} rows from {first} to {last}"


@dataclass(frozen=True, eq=False)
class ModelError(Cause):
    """The model itself is wrong: an error that is a smooth function of the motion."""

    mean: NDArray  # (n,)
    scale: NDArray  # (n,)
    moved: NDArray  # (n, k), the directions of q / scale that the motion moves
    quadratic: bool

    name = "the model"
    remedy = "add this log to the log of the fit, and fit again"
    is_last_resort = True
    n_parameters = 30

    @classmethod
    def members(cls, evidence: Evidence) -> Sequence[Self]:
        """Return the one cause of this kind, with products of the motion if there are many rows."""
        directions = Commands(evidence.motion.q).directions
        n_moved = directions.moved.shape[1]
        n_features = 1 + n_moved + n_moved * (n_moved + 1) // 2
        n_rows = len(evidence.motion.q)
        return [
            cls(
                directions.mean,
                directions.scale,
                directions.moved,
                n_rows >= _ROWS_PER_FEATURE * n_features,
            )
        ]

    def starts(self, evidence: Evidence) -> Sequence[NDArray]:
        """Return no error."""
        return [np.zeros(3 * self._features(evidence).shape[1])]

    def _features(self, evidence: Evidence) -> NDArray:
        """Return 1, the moved directions of q and, if it is quadratic, their products."""
        z = (evidence.q - self.mean) / self.scale @ self.moved
        columns = [np.ones((len(z), 1)), z]
        if self.quadratic:
            first, second = np.triu_indices(z.shape[1])
            columns.append(z[:, first] * z[:, second])
        return np.hstack(columns)

    def fit(self, evidence: Evidence, used: NDArray, start: NDArray, rounds: int) -> NDArray:
        """Return the weights (3 F,) of the features for some rows, by ridge regression."""
        features = self._features(evidence)
        fitted = features[used]
        gram = fitted.T @ fitted + _RIDGE * len(fitted) * np.eye(fitted.shape[1])
        residual = (evidence.x - evidence.tips)[used]
        return np.linalg.solve(gram, fitted.T @ residual).T.ravel()

    def tips(self, evidence: Evidence, parameters: NDArray) -> NDArray:
        """Return the tips (N, 3) with the error [m]."""
        features = self._features(evidence)
        weights = parameters.reshape(3, -1)
        return evidence.tips + features @ weights.T

    def amount(self, evidence: Evidence, parameters: NDArray) -> str:
        """Return no words."""
        return "an error that is a smooth function of the commands"
