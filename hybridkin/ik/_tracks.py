"""A path followed from one start, by the model or on a robot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor

from hybridkin._core.arrays import as_array, give_back
from hybridkin._core.progress import quiet
from hybridkin.ik._feedback import Feedback
from hybridkin.ik._settings import StepSettings
from hybridkin.ik.results import Track, statuses
from hybridkin.ik.tasks import Tolerance
from hybridkin.ik.tracker import Plant, Tracker


@dataclass(frozen=True)
class Path:
    """Points to follow (T, ...), their times (T,), and the period after each."""

    points: Tensor
    t: Tensor
    periods: list[float]
    tol: Tolerance  # of a reached point
    as_numpy: bool  # type of the results


@dataclass(frozen=True)
class Loop:
    """What closes the loop, see `InverseKinematics.track`."""

    plant: Plant | None = None
    feedback: str | None = "model"
    readings: Feedback = field(default_factory=Feedback)
    progress: Callable[[int, int], None] = quiet


def followed(
    settings: StepSettings, q0: Tensor, path: Path, loop: Loop, state: Any = None
) -> Track:
    """Return the track from one start (n,), with the state of hysteresis there."""
    task = settings.task
    start = settings.configurations(q0, "q0", path.points)
    target = path.points.to(start.dtype)
    command = as_array(start) if path.as_numpy else start
    tracker = Tracker(settings, command, path.tol, loop.readings, state)
    columns = tracker.follow(target, path.periods, loop.plant, loop.feedback, loop.progress)
    q, effective, x, measured, e, rejected, sigma_min, held, damped, blocked = columns
    judged = e
    if loop.feedback != "measured":
        e = task.difference(task.completed(measured, x), target)
        judged = task.difference(x, target)
    error = e.norm(dim=-1)
    scene = settings.clear.scene
    status = statuses(
        task,
        effective,
        judged,
        path.tol,
        known=torch.isfinite(error) & ~rejected,
        held=held,
        singular=damped,
        blocked=blocked,
        inside=settings.clear.is_inside(effective, scene),
    )
    margin = settings.margin(q)
    clearance = settings.clear.smallest(effective, scene)
    rows = (path.t, q, effective, x, measured, target, error, status, sigma_min, margin, clearance)
    results = give_back((*rows, rejected), (len(target),), path.as_numpy)
    track = Track(*results)
    if loop.feedback != "measured":
        track = replace(track, rejected=None)
    if loop.plant is None:
        track = replace(track, x_measured=None)
    return track
