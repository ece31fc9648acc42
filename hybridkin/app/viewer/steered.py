"""A robot that follows a target or a command, one tick after another, without a display."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from threading import Lock
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from hybridkin import HybridForwardModel, IKStatus, InverseKinematics, obstacles
from hybridkin.app.workflow.domain import Domain, PathLimits
from hybridkin.app.workflow.model import commands_for, domain_distance, tips_at
from hybridkin.datasets import Log

RATE = 50.0  # ticks per second
_GAIN = 8.0  # [1/s]
_TRAVEL = 1.0  # time for the whole range of an actuator without a limit of speed [s]
_CLOSE = 1e-3  # distance to a target that is reached, relative to the size of the robot
_STILL = 1e-5  # largest step of a robot at rest, relative to the range of an actuator
_REMEMBERED = 30_000  # commands kept: ten minutes
_FARTHEST = 100.0  # of an obstacle that is moved, in sizes of the robot


class Situation(NamedTuple):
    """What there is to say about a robot and its target.

    Attributes
    ----------
    words : str
        One sentence.
    reached, out_of_reach, in_domain : bool
        Whether the tip is at the target, or has stopped away from it, and whether the model knows
        this configuration.
    error : float
        Distance from the tip to the target [m]; NaN without a target.
    """

    words: str
    reached: bool
    out_of_reach: bool
    in_domain: bool
    error: float


class SteeredRobot:
    """A model that follows a target in space, or a command of all actuators.

    Its methods may be called from several threads.

    Parameters
    ----------
    model : HybridForwardModel
        The model.
    limits : PathLimits
        Limits of the actuators. Without a limit of speed the whole range takes one second.
    obstacles : sequence of Obstacle, default=()
        What the body keeps clear of while it follows a target.
    clearance : float, default=0.0
        Least distance between body and obstacles [m].

    Attributes
    ----------
    q : ndarray of shape (n,)
        Motion of the actuators, in the unit of the model.
    x, target : ndarray of shape (3,)
        Tip and target [m].
    base : ndarray of shape (4, 4)
        Pose of the base, its position in metres.
    size : float
        Largest extent of the reachable space with the base [m].
    obstacles : tuple of Obstacle
        The obstacles where they are now.
    """

    def __init__(
        self,
        model: HybridForwardModel,
        limits: PathLimits,
        obstacles: Sequence[obstacles.Obstacle] = (),
        clearance: float = 0.0,
    ) -> None:
        self.model = model
        self.limits = limits
        self.domain = Domain(model, limits)
        self.span = np.maximum(limits.q_max - limits.q_min, np.finfo(float).tiny)
        is_limited = np.isfinite(limits.dq_max)
        speed = np.where(is_limited, limits.dq_max, self.span / _TRAVEL)
        self.q = self.domain.preferred
        self.x = tips_at(model, self.q[None])[0]
        self.target = self.x
        tips = self.domain.sample[1]
        self.base = model.module_.robot.base.numpy(force=True)
        self.size = float(np.ptp(np.vstack([tips, self.base[:3, 3]]), axis=0).max())
        self._close = _CLOSE * self.size
        self._largest_step = speed / RATE
        self._ik = InverseKinematics(
            model.module_.tip_model.without_hysteresis,
            q_min=limits.q_min,
            q_max=limits.q_max,
            dq_max=speed,
            ddq_max=limits.ddq_max,
            q_pref=self.q,
            gain=_GAIN,
            dt=1.0 / RATE,
            obstacles=obstacles,
            clearance=clearance,
        )
        self._tracker = self._ik.tracker(self.q, tol=self._close)
        self.obstacles = self._tracker.obstacles
        self._goal = self.q
        self._by_hand = False  # the actuators are set, not led by the target
        self._resting = False
        self._history = deque([self.q], maxlen=_REMEMBERED)
        self._lock = Lock()

    def follow(self, target: ArrayLike) -> None:
        """Follow a target (3,) [m] from now on; one that is not finite is ignored."""
        point = np.asarray(target, dtype=float)
        if point.shape != (3,) or not np.isfinite(point).all():
            return
        with self._lock:
            if self._by_hand:
                self._tracker.reset(self.q)
                self._by_hand = False
            self.target = point
            self._resting = False

    def go_to(self, q: ArrayLike) -> None:
        """Move the actuators to q (n,), within the limits; what is not finite is ignored."""
        goal = np.asarray(q, dtype=float)
        if goal.shape != self.q.shape or not np.isfinite(goal).all():
            return
        with self._lock:
            self._goal = np.clip(goal, self.limits.q_min, self.limits.q_max)
            self._by_hand = True
            self._resting = False

    def move_obstacle(self, k: int, center: ArrayLike) -> None:
        """Move an obstacle, without a turn, to a center (3,) [m].

        A place that is not finite, or too far away to matter, is ignored.
        """
        place = np.asarray(center, dtype=float)
        if place.shape != (3,) or not (np.abs(place) <= _FARTHEST * self.size).all():
            return
        with self._lock:
            moved = [*self.obstacles]
            moved[k] = moved[k].moved(place)
            self._tracker.obstacles = moved
            self.obstacles = self._tracker.obstacles
            self._resting = False

    def tick(self) -> bool:
        """Move for one period; return whether the robot moves."""
        with self._lock:
            if self._resting:
                return False
            before = self.q
            if self._by_hand:
                way = self._goal - before
                self.q = before + np.clip(way, -self._largest_step, self._largest_step)
            else:
                self.q = np.asarray(self._tracker.step(self.target))
            self.x = tips_at(self.model, self.q[None])[0]
            if self._by_hand:
                self.target = self.x
            self._history.append(self.q)
            moved = np.abs(self.q - before) / self.span
            self._resting = bool((moved < _STILL).all())
            return True

    @property
    def goal(self) -> NDArray[np.float64]:
        """Where the actuators move (n,) [unit of q]: where they are, unless set by hand."""
        with self._lock:
            return self._goal if self._by_hand else self.q

    @property
    def situation(self) -> Situation:
        """What there is to say about robot and target."""
        with self._lock:
            inside = bool(domain_distance(self.model, self.q[None])[0] <= 1.0)
            error = float(np.linalg.norm(self.target - self.x))
            reached = error <= self._close
            out_of_reach = False
            if self._by_hand:
                words = "Actuators set by hand"
                reached = True
                error = math.nan
            elif reached:
                words = "On target"
            elif not self._resting:
                words = "Moving"
            else:
                words = "Out of reach"
                out_of_reach = True
                if self._tracker.status == IKStatus.AT_LIMITS:
                    words += ": actuators are at their limits"
                elif self._tracker.status == IKStatus.BLOCKED:
                    words = "BLOCKED: an obstacle is in the way"
            if not inside:
                words += ", outside the domain of the model"
            return Situation(f"{words}.", reached, out_of_reach, inside, error)

    @property
    def is_contradictory(self) -> bool:
        """Whether tendons pull against each other, so that the model's shape is not a robot's."""
        q = torch.from_numpy(self.q)[None]
        return bool(self.model.module_.robot.contradictions(q))

    @property
    def distances(self) -> NDArray[np.float64]:
        """The least distance (K,) of the body to every obstacle [m], negative inside."""
        with self._lock:
            return np.asarray(self._ik.body_distances(self.q, self.obstacles))

    @property
    def balls(self) -> tuple[NDArray, NDArray]:
        """Middles (P, 3) and radii (P,) of the balls that keep clear of obstacles [m]."""
        with self._lock:
            points, radii = self._ik.body_balls(self.q)
        return np.asarray(points), np.asarray(radii)

    @property
    def held(self) -> NDArray[np.bool_]:
        """Which actuators are at a limit of position (n,)."""
        close = 1e-6 * self.span
        at_low = self.q <= self.limits.q_min + close
        at_high = self.q >= self.limits.q_max - close
        return at_low | at_high

    def measured_rows(self, log: Log) -> tuple[NDArray, NDArray]:
        """Return motions of the actuators (N, n) and tips (N, 3) of the known rows of a log."""
        tips = log.x[:, -3:]
        measured = np.isfinite(log.q).all(axis=1) & np.isfinite(tips).all(axis=1)
        return self.model.effective(log.commands[measured]), tips[measured]

    def commands(self) -> NDArray:
        """Return the commands (T, n) since the start, at most ten minutes, in the log's unit.

        With backlash they are ahead of the motion of the actuators.
        """
        with self._lock:
            motion = np.array(self._history)
        sent = commands_for(self.model, motion, np.arange(len(motion)) / RATE)
        return self.model.description_.log.to_log(sent)
