"""Outcomes of inverse kinematics: statuses, one step, solved targets, a tracked path."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any

import numpy as np

from hybridkin._core.arrays import as_array


class IKStatus(IntEnum):
    """Outcome for one target.

    In `InverseKinematics.track` a step that misses its target is AT_LIMITS where a limit held
    the motion back, SINGULAR where damping did, else MAX_ITER (one step was not enough).
    """

    CONVERGED = 0
    """The error is within `tol`."""
    AT_LIMITS = 1
    """Not converged; limits held the last step back and the search was not finished."""
    UNREACHABLE = 2
    """No motion within the limits brings the tip nearer: the nearest point is returned."""
    SINGULAR = 3
    """Not converged; the Jacobian has (nearly) lost a direction."""
    MAX_ITER = 4
    """Not converged within `max_iter` iterations."""
    OUT_OF_DOMAIN = 5
    """Converged, but where the model does not vouch for itself (its `in_domain` is False)."""
    INVALID_INPUT = 6
    """The target, the start, the model's answer or the measured tip is not finite."""


@dataclass(frozen=True, repr=False)
class Step:
    """One control step; arrays are of the kind that was given (numpy or torch).

    Attributes
    ----------
    dq : array of shape (..., n)
        Change of q for one period; add it to q.
    x : array of shape (..., 3)
        Tip of the model at q, before the step [m].
    error : array of shape (...,)
        Distance from the tip to the target before the step [m]; NaN where an input was not
        finite (such a row holds still).
    sigma_min : array of shape (...,)
        Smallest singular value of the Jacobian at q.
    damping : array of shape (...,)
        lambda used, in the unit of `sigma_min`; 0 where the step is the pseudo-inverse's.
    saturated : bool array of shape (..., n)
        Actuators held at a limit of position or speed by this step.
    scale : array of shape (...,)
        How far the step goes along the wanted change of the tip, to first order: 1 is all of it.
        With mode="direction" the share that the limits leave of it.
    """

    dq: Any
    x: Any
    error: Any
    sigma_min: Any
    damping: Any
    saturated: Any
    scale: Any

    def __repr__(self) -> str:
        """Return a one-line summary."""
        held = int(as_array(self.saturated).sum())
        return (
            f"Step(dq of shape {tuple(self.dq.shape)}, {held} saturated, "
            f"{_errors(as_array(self.error))})"
        )


@dataclass(frozen=True, repr=False)
class IKSolution:
    """Configurations found for a batch of targets, in the kind that was given.

    Attributes
    ----------
    q : array of shape (..., n)
        Best configurations found, within the limits.
    x : array of shape (..., 3)
        Tips of the model at `q` [m].
    error : array of shape (...,)
        Distances from `x` to the targets [m], computed on the returned `q`; of tasks with several
        parts the root of the weighted sum of squares.
    status : int array of shape (...,)
        `IKStatus` of every target.
    n_iter : int array of shape (...,)
        Iterations spent, restarts included.
    sigma_min : array of shape (...,)
        Smallest singular value of the Jacobian at `q`.
    limit_margin : array of shape (...,)
        Smallest distance of an actuator to its limits, in the unit of q; inf without limits.
    """

    q: Any
    x: Any
    error: Any
    status: Any
    n_iter: Any
    sigma_min: Any
    limit_margin: Any

    @property
    def converged(self) -> Any:
        """Bool array of shape (...,), true where the status is CONVERGED."""
        return self.status == IKStatus.CONVERGED.value

    def __repr__(self) -> str:
        """Return a one-line summary."""
        return f"IKSolution({_tally(self.status)}; {_errors(as_array(self.error))})"


@dataclass(frozen=True, repr=False)
class Track:
    """A followed path, in the kind that was given.

    Attributes
    ----------
    t : array of shape (T,)
        Times [s].
    q : array of shape (T, n)
        Commanded configurations.
    x : array of shape (T, 3)
        Tips of the model at `q` [m].
    x_measured : array of shape (T, 3) or None
        Tips measured on the plant [m], NaN where it failed; None without a plant.
    target : array of shape (T, 3)
        The path [m].
    error : array of shape (T,)
        Distance from the target to the measured tip, or to the model's without a plant [m].
    status : int array of shape (T,)
        `IKStatus` of every point of the path.
    sigma_min : array of shape (T,)
        Smallest singular value of the Jacobian.
    limit_margin : array of shape (T,)
        Smallest distance of an actuator to its limits, in the unit of q; inf without limits.
    """

    t: Any
    q: Any
    x: Any
    x_measured: Any
    target: Any
    error: Any
    status: Any
    sigma_min: Any
    limit_margin: Any

    @property
    def n_laps(self) -> int:
        """How often the target repeats itself; 0 for a path that does not end where it starts."""
        target = as_array(self.target).reshape(len(self.t), -1)
        near = 1e-9 + 1e-6 * float(np.ptp(target, axis=0).max())
        n = len(target) - 1
        for laps in range(n, 0, -1):
            period = n // laps
            if n % laps == 0 and np.abs(target[period:] - target[:-period]).max() <= near:
                return laps
        return 0

    @property
    def lap_gap(self) -> np.ndarray:
        """How far q ends from where it started on every lap, shape (n_laps,), in the unit of q."""
        marks = as_array(self.q)[:: (len(self.t) - 1) // self.n_laps] if self.n_laps else self.q[:1]
        return np.linalg.norm(np.diff(as_array(marks), axis=0), axis=1)

    @property
    def mean_error(self) -> float:
        """Mean of `error` over the points where it is known [m]."""
        return float(np.nanmean(as_array(self.error)))

    @property
    def p95_error(self) -> float:
        """Error that 95 % of the points stay below [m]."""
        return float(np.nanquantile(as_array(self.error), 0.95))

    @property
    def max_error(self) -> float:
        """Largest error [m]."""
        return float(np.nanmax(as_array(self.error)))

    @property
    def largest_step(self) -> float:
        """Largest change of one actuator from one point to the next, in the unit of q."""
        return float(np.abs(np.diff(as_array(self.q), axis=0)).max(initial=0.0))

    def __repr__(self) -> str:
        """Return a one-line summary."""
        return (
            f"Track({_tally(self.status)}; {_errors(as_array(self.error))}; "
            f"largest step {self.largest_step:.3g})"
        )


def _tally(status: Any) -> str:
    codes, counts = np.unique(as_array(status), return_counts=True)
    parts = [f"{n} {IKStatus(int(c)).name}" for c, n in zip(codes, counts, strict=True)]
    return f"{as_array(status).size} targets" + (": " if parts else "") + ", ".join(parts)


def _errors(error: np.ndarray) -> str:
    known = error[np.isfinite(error)]
    if known.size == 0:
        return "no error known"
    return f"error mean {known.mean():.3g} m, max {known.max():.3g} m"
