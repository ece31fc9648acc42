"""Results of inverse kinematics: statuses, one step, solved targets, a tracked path."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import as_array
from hybridkin._core.html import html_table, numbers
from hybridkin.ik.tasks import Task, Tolerance

ArrayT = TypeVar("ArrayT", np.ndarray, Tensor)


class IKStatus(IntEnum):
    """Outcome for one target.

    In `InverseKinematics.track`, a step that misses its target is AT_LIMITS if a limit restricted
    the motion, SINGULAR if damping did, else MAX_ITER (one step was not enough). With
    feedback="measured" the measured error counts, by default with a `tol` of 1 mm.
    """

    CONVERGED = 0
    """The error is within `tol`."""
    AT_LIMITS = 1
    """Not converged; limits restricted the last step of the best start, which did not finish."""
    UNREACHABLE = 2
    """Out of reach for certain: farther from the base than the robot, stretched within its limits,
    is long, or outside `tip_limits`. The nearest point found is returned.

    Functions have no such bound."""
    SINGULAR = 3
    """Not converged; the Jacobian has (nearly) lost a direction."""
    MAX_ITER = 4
    """Not converged within `max_iter` iterations, or no motion within the limits brings the tip
    nearer than the best of all starts: most likely out of reach, but not for certain.

    ``IKSolution.n_starts`` is the number of starts tried; more `restarts` can help."""
    OUT_OF_DOMAIN = 5
    """Converged, but outside the domain of the model (its `in_domain` is False)."""
    INVALID_INPUT = 6
    """The target, the start, the model's output or the measured tip is not finite, or the measured
    tip was rejected."""
    NO_FURTHER = 7
    """No further one of the requested configurations (`n_solutions`) was found."""
    BLOCKED = 8
    """Not converged; obstacles, or the body itself, restricted the last step. A target inside an
    obstacle is BLOCKED too: the nearest free point found is returned."""


def statuses(
    task: Task,
    q: Tensor,
    e: Tensor,
    tol: Tolerance,
    *,
    known: Tensor,
    held: Tensor,
    singular: Tensor,
    blocked: Tensor | bool,
    inside: Tensor,
    resting: Tensor | bool = False,
    beyond: Tensor | bool = False,
) -> Tensor:
    """Return the `IKStatus` of rows, int (N,); later conditions override earlier ones.

    The one rule of `solve`, `track` and trackers.

    Parameters
    ----------
    task : Task
        Task whose errors and domain are judged.
    q : Tensor of shape (N, n)
        Configurations.
    e : Tensor of shape (N, m)
        Errors of the task there [m].
    tol : float or tuple of floats
        Largest error of a reached target.
    known, held, singular, blocked : bool Tensor of shape (N,)
        Whether all inputs are finite; limits restricted the motion; it was damped, or the Jacobian
        has lost a direction; obstacles restricted it.
    inside : bool Tensor of shape (N,)
        Whether the body is in an obstacle, or in itself, at q.
    resting, beyond : bool Tensor of shape (N,), optional
        Whether no motion lowers the error; whether the target is out of reach for certain. Default:
        nobody knows.
    """
    status = torch.full(known.shape, IKStatus.MAX_ITER.value, device=e.device)
    status[singular] = IKStatus.SINGULAR
    status[held] = IKStatus.AT_LIMITS
    status[torch.zeros_like(known) | resting] = IKStatus.MAX_ITER
    status[torch.zeros_like(known) | blocked | inside] = IKStatus.BLOCKED
    status[torch.zeros_like(known) | beyond] = IKStatus.UNREACHABLE
    reached = task.reached(e, tol) & ~inside
    status[reached] = IKStatus.CONVERGED
    status[reached & ~task.in_domain(q)] = IKStatus.OUT_OF_DOMAIN
    status[~(known & torch.isfinite(e.norm(dim=-1)))] = IKStatus.INVALID_INPUT
    return status


@dataclass(frozen=True, repr=False)
class Step(Generic[ArrayT]):
    """One control step; arrays are NumPy or torch, like the input.

    Attributes
    ----------
    dq : array of shape (..., n)
        Change of q for one period; add it to q.
    x : array of shape (..., 3)
        Tip of the model at q, before the step [m].
    error : array of shape (...,)
        Distance from the tip to the target before the step [m]; NaN or infinite if q, the target
        or the tip was not finite (such a row stops).
    sigma_min : array of shape (...,)
        Smallest singular value of the Jacobian at q; NaN if the row stops because an input was not
        finite.
    damping : array of shape (...,)
        lambda used, in the unit of `sigma_min`; 0 for the plain pseudo-inverse.
    saturated : bool array of shape (..., n)
        Actuators held at a limit of position, speed or acceleration by this step.
    """

    dq: ArrayT
    x: ArrayT
    error: ArrayT
    sigma_min: ArrayT
    damping: ArrayT
    saturated: ArrayT

    def __getattr__(self, name: str) -> Any:
        """Return a field of a step of the compiled core, extracted on access."""
        row, places = vars(self).get("_row", (None, {}))
        if name not in places:
            raise AttributeError(name)
        value = row[places[name]]
        if name == "saturated":
            return value > 0.0
        return value

    def __repr__(self) -> str:
        """Return a one-line summary."""
        held = f"{int(as_array(self.saturated).sum())} saturated"
        return f"Step(dq of shape {tuple(self.dq.shape)}, {held}, {_errors(self.error)})"


@dataclass(frozen=True, repr=False)
class IKSolution(Generic[ArrayT]):
    """Configurations found for a batch of targets; arrays are NumPy or torch, like the input.

    With `n_solutions` every target has an axis of that length: q is of shape (..., n_solutions, n).

    Attributes
    ----------
    q : array of shape (..., n)
        Best configurations found, within the limits.
    x : array of shape (..., 3)
        Tips of the model at `q` [m].
    error : array of shape (...,)
        Distances from `x` to the targets [m], computed at the returned `q`; for tasks with several
        parts the root of the weighted sum of squares.
    status : int array of shape (...,)
        `IKStatus` of every target.
    n_iter : int array of shape (...,)
        Number of iterations, including restarts.
    n_starts : int array of shape (...,)
        Number of starts tried: 1 if the first one led to the target.
    sigma_min : array of shape (...,)
        Smallest singular value of the Jacobian at `q`.
    limit_margin : array of shape (...,)
        Smallest distance of an actuator to its limits, in the unit of q; inf without limits.
    """

    q: ArrayT
    x: ArrayT
    error: ArrayT
    status: ArrayT
    n_iter: ArrayT
    n_starts: ArrayT
    sigma_min: ArrayT
    limit_margin: ArrayT

    @property
    def converged(self) -> ArrayT:
        """Whether the status is CONVERGED, bool array of shape (...,)."""
        return self.status == IKStatus.CONVERGED.value  # pyright: ignore[reportReturnType]

    def __repr__(self) -> str:
        """Return a one-line summary."""
        most = as_array(self.n_starts).max(initial=1)
        starts = f"up to {most} starts; " if most > 1 else ""
        return f"IKSolution({_tally(self.status)}; {starts}{_errors(self.error)})"


@dataclass(frozen=True, repr=False)
class Track(Generic[ArrayT]):
    """A followed path; arrays are NumPy or torch, like the input.

    Attributes
    ----------
    t : array of shape (T,)
        Times [s].
    q : array of shape (T, n)
        Commands to send. ``model.hysteresis_.apply(q, state, dt)`` returns the state of the
        hysteresis after them, for the next track.
    effective : array of shape (T, n)
        What the actuators do [unit of q]: `q` without hysteresis.
    x : array of shape (T, 3)
        Tips of the model at `effective` [m].
    x_measured : array of shape (T, 3) or None
        Tips measured on the plant, as read at the points [m], NaN if it failed; None without a
        plant.
    target : array of shape (T, 3)
        The path [m].
    error : array of shape (T,)
        Distance from the target to the measured tip, or to the model's without a plant [m]. The
        measured tip is moved by what the model moved since then, if readings are late (`delay`).
    status : int array of shape (T,)
        `IKStatus` of every point of the path.
    sigma_min : array of shape (T,)
        Smallest singular value of the Jacobian.
    limit_margin : array of shape (T,)
        Smallest distance of an actuator to its limits, in the unit of q; inf without limits.
    rejected : bool array of shape (T,) or None
        Readings that were not used because they are not plausible, see `Tracker.rejected`; None
        without feedback="measured".
    clearance : array of shape (T,)
        Smallest gap between the body, with its clearance, and obstacles or itself [m]; inf without
        obstacles.
    """

    t: ArrayT
    q: ArrayT
    effective: ArrayT
    x: ArrayT
    x_measured: ArrayT | None
    target: ArrayT
    error: ArrayT
    status: ArrayT
    sigma_min: ArrayT
    limit_margin: ArrayT
    clearance: ArrayT
    rejected: ArrayT | None = None

    @property
    def largest_step(self) -> float:
        """Largest change of one actuator from one point to the next, in the unit of q."""
        return float(np.abs(np.diff(as_array(self.q), axis=0)).max(initial=0.0))

    @property
    def score(self) -> tuple[int, int]:
        """Numbers of points reached in the domain, and reached at all: a larger one is better."""
        status = as_array(self.status)
        inside = int((status == IKStatus.CONVERGED).sum())
        outside = int((status == IKStatus.OUT_OF_DOMAIN).sum())
        return inside, inside + outside

    def __repr__(self) -> str:
        """Return a one-line summary."""
        step = f"largest step {self.largest_step:.3g}"
        return f"Track({_tally(self.status)}; {_errors(self.error)}; {step})"

    def _repr_html_(self) -> str:
        """Return the outcome of the points, the errors and the commands as an HTML table."""
        q = as_array(self.q)
        margin = as_array(self.limit_margin).min(initial=np.inf)
        tip = "tip of the model" if self.x_measured is None else "measured tip"
        ends = zip(q.min(0, initial=np.inf), q.max(0, initial=-np.inf), strict=True)
        commands = {f"q[{k}]": tuple(map(numbers, pair)) for k, pair in enumerate(ends)}
        rows = {
            "points": _tally(self.status),
            "duration": f"{np.diff(as_array(self.t)).sum():.4g} s",
            f"distance from path to {tip}": _errors(self.error),
            "largest step of an actuator": f"{self.largest_step:.3g} (unit of q)",
            "smallest distance to a limit": f"{margin:.3g} (unit of q)",
            "smallest singular value": f"{as_array(self.sigma_min).min(initial=np.inf):.3g}",
            "smallest gap to obstacles": f"{as_array(self.clearance).min(initial=np.inf):.3g} m",
            "commands": {"": ("least", "largest"), **commands},
        }
        if self.rejected is not None:
            rows["rejected readings"] = f"{int(as_array(self.rejected).sum())}"
        return html_table("Track", rows)


def _tally(status: np.ndarray | Tensor) -> str:
    codes, counts = np.unique(as_array(status), return_counts=True)
    parts = [f"{n} {IKStatus(int(c)).name}" for c, n in zip(codes, counts, strict=True)]
    return f"{counts.sum()} targets" + (": " if parts else "") + ", ".join(parts)


def _errors(error: np.ndarray | Tensor) -> str:
    finite = as_array(error)[np.isfinite(as_array(error))]
    mean_and_max = "error mean {:.3g} m, max {:.3g} m".format
    if finite.size:
        return mean_and_max(finite.mean(), finite.max())
    return "no error known"
