"""Limits of a track, and commands in the domain of a model, one of which is its posture."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin import HybridForwardModel, InverseKinematics, robots
from hybridkin.app.workflow.model import (
    domain_distance,
    half_width,
    is_fitted,
    tips_at,
    trained_range,
)
from hybridkin.app.workflow.surroundings import Surroundings
from hybridkin.arguments import real_array

_WALKERS = 256
_STEPS = 60
_STEP = 0.12  # length of a step, as a share of the range


@dataclass(frozen=True, eq=False)
class PathLimits:
    """The limits of a track.

    Attributes
    ----------
    q_min, q_max : ndarray of shape (n,)
        Least and largest value of every actuator [m]; with backlash, of the actuators' motion.
    dq_max, ddq_max : ndarray of shape (n,)
        Largest speed [m/s] and acceleration [m/s^2], infinite without a limit.
    source : str
        Source of `q_min` and `q_max`, in words.
    lead : ndarray of shape (n,) or float
        Half the width of the hysteresis [unit of q]; 0 without.
    """

    q_min: NDArray
    q_max: NDArray
    dq_max: NDArray
    ddq_max: NDArray
    source: str
    lead: NDArray | float = 0.0

    @property
    def commands(self) -> tuple[NDArray, NDArray]:
        """Limits of commands, which lead what the actuators do by up to half the width."""
        return self.q_min - self.lead, self.q_max + self.lead

    @property
    def span(self) -> NDArray:
        """The width of the range of every actuator (n,)."""
        return self.q_max - self.q_min


def path_limits(
    model: HybridForwardModel,
    q_min: ArrayLike = -np.inf,
    q_max: ArrayLike = np.inf,
    dq_max: ArrayLike = np.inf,
    ddq_max: ArrayLike = np.inf,
    *,
    within_fit: bool = True,
) -> PathLimits:
    """Return the limits of the actuators: given ones, else those of the robot description.

    By default they do not exceed the training range of the model.

    Parameters
    ----------
    model : HybridForwardModel
        The model, as from `open_model`.
    q_min, q_max, dq_max, ddq_max : float or array-like of shape (n,), optional
        Limits of the commands [m], of their speed [m/s] and acceleration [m/s^2]. An infinite one,
        the default, is that of the description; of speed and acceleration also that of the model.
    within_fit : bool, default=True
        Whether to stay within the training range if the description gives limits.

    Returns
    -------
    PathLimits
        With backlash, commands exceed these limits by half its width.

    Raises
    ------
    ValueError
        If the range of the actuators is not known.
    """
    n = model.n_features_in_
    limit_of = {"q_min": q_min, "q_max": q_max, "dq_max": dq_max, "ddq_max": ddq_max}
    limit_of = {name: _limit(value, name, n) for name, value in limit_of.items()}
    described = model.description_.limits
    trained = robots.Limits()
    if within_fit or not described.are_finite:
        trained = trained_range(model)
    usual = described.narrowed(half_width(model)).intersect(trained)
    usual = usual.intersect(_rates_of(model))
    chosen = robots.Limits(**limit_of).narrowed(half_width(model))
    limits = {}
    for name, limit in vars(chosen).items():
        # Of one given end, scaled to actuators of both signs, some entries are open.
        limit = np.where(np.isfinite(limit), limit, vars(usual)[name])
        limits[name] = np.broadcast_to(limit, n).astype(float)
    if not robots.Limits(**limits).are_finite:
        raise ValueError(
            "`q_min` and `q_max` must be given (--q-min, --q-max), or written as [limits] in the "
            "robot description, because this model has no training range."
        )
    if (limits["q_min"] > limits["q_max"]).any():
        raise ValueError(
            "`q_min` must not exceed `q_max`, including half the backlash and the training range, "
            f"got {limits['q_min']} and {limits['q_max']} m; check their unit and sign."
        )
    sources = []
    if np.isfinite(described.q_min).any():
        sources.append("robot description")
    if np.isfinite(trained.q_min).any():
        sources.append("training range")
    source = ", within the ".join(sources)
    ends = [np.isfinite(limit_of[name]).any() for name in ("q_min", "q_max")]
    if all(ends):
        source = "given"
    elif any(ends):
        source = f"given and {source}"
    return PathLimits(**limits, source=source, lead=half_width(model))


def _limit(value: ArrayLike, name: str, n: int) -> NDArray:
    """Return a limit of all actuators, or one for each."""
    limit = real_array(value, name).astype(float)
    if limit.shape not in ((), (1,), (n,)):
        raise ValueError(f"`{name}` must be one number or {n}, got {limit.size}.")
    if np.isnan(limit).any():
        raise ValueError(f"`{name}` must not hold NaN, got {limit.tolist()}.")
    return limit


def _rates_of(model: HybridForwardModel) -> robots.Limits:
    """Return the limits of speed and acceleration of the model itself."""
    limits = model.module_.tip_model.robot.limits
    rates = {name: real_array(limits[name], name) for name in ("dq_max", "ddq_max")}
    return robots.Limits(**rates)


@dataclass(frozen=True, eq=False)
class Domain:
    """The commands that a track may use: within limits, and in the domain of the model."""

    model: HybridForwardModel
    limits: PathLimits
    surroundings: Surroundings = field(default_factory=Surroundings)

    @cached_property
    def preferred(self) -> NDArray:
        """A configuration (n,) in the domain of the model, within the limits.

        It is the first of these that lies in the domain: the median of the training rows, actuator
        by actuator, the middle of the training range, no tendon pulled, the training row nearest to
        the middle. For a model without a fit it is no tendon pulled, or for other robots the middle
        of the limits.
        """
        fitted = is_fitted(self.model)
        limits = self.limits
        spanned = trained_range(self.model) if fitted else limits
        middle = 0.5 * (np.asarray(spanned.q_min) + np.asarray(spanned.q_max))
        middle = self._bent(middle)
        candidates = [middle]
        if self.all_tendons:
            candidates.append(self.rest)
            if not fitted:
                candidates.reverse()
        tested = self.model.fitted_module_.tested
        if tested is not None:
            rows = tested.rows.numpy(force=True) - self.model.change_.shift
            far = np.linalg.norm(rows - middle, axis=1)
            median = self._bent(np.median(rows, axis=0))
            candidates = [median, *candidates, rows[far.argmin()]]
        q = np.clip(candidates, limits.q_min, limits.q_max)
        distance = domain_distance(self.model, q)
        return q[np.maximum(distance, 1.0).argmin()]  # the first of those in the domain

    def _bent(self, q: NDArray) -> NDArray:
        """Return a configuration (n,) without a common pull of the tendons."""
        return self.rest + (q - self.rest) @ self.bending

    @cached_property
    def _actuators(self) -> robots.ActuatorLayout:
        return self.model.module_.tip_model.robot.actuator_layout

    @property
    def all_tendons(self) -> bool:
        """Whether all actuators are tendons of given length."""
        return bool(self._actuators.tendons.all())

    @property
    def rest(self) -> NDArray:
        """The command (n,) at which no tendon is pulled; for other robots zero."""
        if self.all_tendons:
            return self._actuators.rest
        return np.zeros(self.model.n_features_in_)

    @cached_property
    def sample(self) -> tuple[NDArray, NDArray]:
        """Commands (K, n) from the whole domain, and their tips (K, 3) [m].

        The first is near the preferred one.

        They are the ends of random walks from the preferred configuration that stay in the domain,
        because with many actuators most of the training range lies outside the domain. On a plain
        tendon chain no tendon pulls against another. Without a learned part the limits are sampled.
        """
        rng = np.random.default_rng(0)
        low = self.limits.q_min
        high = self.limits.q_max
        span = self.limits.span
        q = rng.uniform(low, high, (_WALKERS, len(low)))
        if is_fitted(self.model):
            q[:] = self.preferred
            for _ in range(_STEPS):
                step = _STEP * span * rng.standard_normal(q.shape)
                ahead = q + step @ self.bending
                inside = domain_distance(self.model, ahead) <= 1.0
                inside &= ((ahead >= low) & (ahead <= high)).all(axis=1)
                q[inside] = ahead[inside]
            # Near the preferred one, because that may be exactly straight.
            near = 0.01 * span * rng.standard_normal(len(low))
            q[0] = self.preferred + near @ self.bending
        tips = tips_at(self.model, q)
        finite = np.isfinite(tips).all(axis=1)
        return q[finite], tips[finite]

    def nearest(self, x: NDArray) -> NDArray:
        """Return the commands (..., n) of the `sample` whose tips are nearest to x (..., 3)."""
        commands, tips = self.sample
        far = np.linalg.norm(tips - x[..., None, :], axis=-1)
        return commands[far.argmin(axis=-1)]

    def solver(self, dt: float = 0.01) -> InverseKinematics:
        """Return inverse kinematics within the limits, clear of obstacles; posture: `preferred`.

        With hysteresis the limits of q are those of the commands.
        """
        limits = self.limits
        q_min, q_max = limits.commands
        return InverseKinematics(
            self.model,
            q_min=q_min,
            q_max=q_max,
            dq_max=limits.dq_max,
            ddq_max=limits.ddq_max,
            q_pref=self.preferred,
            dt=dt,
            obstacles=self.surroundings.obstacles,
            clearance=self.surroundings.clearance,
        )

    def postures(self, n: int) -> NDArray:
        """Return at most n commands from the whole range of the limits; tendons are balanced.

        The tendons of a segment do not pull against each other. If a balanced command exceeds an
        upper limit, all tendons of the segment are pulled until the slackest is at its limit.
        """
        low = self.limits.q_min
        high = self.limits.q_max
        q = np.random.default_rng(0).uniform(low, high, (n, len(low)))
        return self.model.module_.tip_model.robot.balanced(q, low, high)

    @cached_property
    def bending(self) -> NDArray:
        """The projector (n, n) of rows q on those that bend a plain tendon chain, else identity."""
        return self.model.module_.tip_model.robot.effective_directions()
