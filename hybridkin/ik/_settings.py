"""The checked settings of inverse kinematics, and what they say about configurations."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import TypeAlias

import numpy as np
import torch
from torch import Tensor

from hybridkin._core.arrays import (
    LARGEST,
    Numbers,
    Transform,
    as_array,
    as_tensor,
    check_shape,
    countable,
    real_array,
)
from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_ACCELERATES,
    IK_AXIS,
    IK_FRACTION,
    IK_LIMITED,
    IK_NORMALS,
    IK_POSE,
    IK_POSTURE,
    IK_PULLS,
    IK_WEIGHTS,
)
from hybridkin._core.named_rows import without_warnings
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.planes import PlaneOfQ
from hybridkin._core.portable import Portable
from hybridkin.ik._clear import BodyPoints, KeptClear, kept_clear, nowhere
from hybridkin.ik._feedback import expected_innovation
from hybridkin.ik._half_spaces import HalfSpaces
from hybridkin.ik._posture import FixedPosture, Function, NoPosture, PostureFunction
from hybridkin.ik._rates import Rate, stopping
from hybridkin.ik.limits import Bounds, Limit
from hybridkin.ik.obstacles import Obstacle, as_numbers
from hybridkin.ik.tasks import (
    AxisTask,
    PointsTask,
    PoseTask,
    PositionTask,
    Task,
    Tolerance,
)

Array: TypeAlias = Numbers | Transform  # what a caller may pass

# Largest plausible speed: this many times the largest plausible q per second.
_FAST = 5.0
_TURN = 2.0 * math.pi
_FULL = 0.999  # a range of this fraction of a turn counts as a whole turn
PLANE_ROUNDS = 8  # of alternating projections onto a plane and a box


RATES = ("dq_max", "ddq_max")
"""Limits that must be positive: of speed and of acceleration."""


def require(good: bool | Tensor, message: str) -> None:
    """Raise a ValueError with this message if an argument is not good."""
    if not good:
        raise ValueError(message)


def bound(value: Array, name: str, *, finite: bool = False, positive: bool = False) -> Tensor:
    """Return a limit, a posture or weights as a float64 tensor of shape () or (n,)."""
    numbers = as_tensor(value, name).cpu().double().clone()
    good = ~numbers.isnan()
    need = "must be a number or of shape (n,), not NaN"
    if finite:
        good &= numbers.isfinite()
        need += ", finite"
    if positive:
        good &= numbers > 0.0
        need += ", positive (to lock an actuator, give it equal limits)"
    require(
        numbers.ndim < 2 and numbers.numel() > 0 and good.all(),
        f"`{name}` {need}, got {numbers.tolist()!r:.200}.",
    )
    return numbers


def limits_of(task: Task, names: Iterable[str]) -> dict[str, Tensor]:
    """Return these limits of the model of a task."""
    limits = task.models[0].robot.limits
    return {name: bound(limits[name], name, positive=name in RATES) for name in names}


def _in_words(limits: Tensor) -> str:
    """Return a number, or the smallest and the largest one; None if all are infinite."""
    if torch.isinf(limits).all():
        return "None"
    ends = (f"{float(end):.4g}" for end in (limits.min(), limits.max()))
    return " to ".join(dict.fromkeys(ends))


@dataclass(frozen=True)
class StepSettings(Portable):
    """All inputs of a step except q and the target; see `InverseKinematics`.

    Limits and weights are float64 tensors of shape () or (n,). `posture` is `q_pref`, by default
    the middle of the limits if they are finite. `of_model` names the limits taken from the
    model. `middle` is that of the limits, not finite where they are not. `periods`, shape () or
    (n,), are the periods of q: a turn for an angle with a range of a whole turn, else inf. `spans`
    are the ranges of q, at most its periods. `pulls` is that of the robot, see `ForwardModel`.
    `n_actuators` is None if neither settings nor model define it.
    """

    task: Task
    q_min: Tensor
    q_max: Tensor
    dq_max: Tensor
    ddq_max: Tensor
    q_pref: Tensor | Function | None
    beta: Rate
    gain: Rate
    damping: str | float
    limits: str
    own_limits: tuple[Limit, ...]
    dt: float
    weights: Tensor
    of_model: tuple[str, ...]
    tip_limits: HalfSpaces
    obstacles: tuple[Obstacle, ...]
    clearance: float
    body_points: BodyPoints
    posture: NoPosture = field(init=False)
    clear: KeptClear = field(init=False)
    middle: Tensor = field(init=False)
    periods: Tensor = field(init=False)
    spans: Tensor = field(init=False)
    pulls: Tensor = field(init=False)
    n_actuators: int | None = field(init=False)
    farthest: float = field(init=False)
    longest_usual: float = field(init=False)

    def __post_init__(self) -> None:
        """Check the settings against each other and the model, and derive the others."""
        model = self.task.models[0]
        vectors = {}
        for name, value in vars(self).items():
            if isinstance(value, Tensor) and value.ndim == 1:
                vectors[name] = len(value)
        sizes = {*vectors.values(), self.task.n_actuators} - {None}
        require(
            len(sizes) < 2,
            f"limits, `q_pref` and `weights` must be scalars or have one value per actuator, got "
            f"the lengths {vectors} for {self.task.n_actuators or 'n'} actuators of the model.",
        )
        require(
            (self.q_min <= self.q_max).all(),
            f"`q_min` must not exceed `q_max`, got {self.q_min.tolist()} and "
            f"{self.q_max.tolist()}; swap them.",
        )
        require(
            0.0 < self.dt < LARGEST,
            f"`dt` must be a positive period [s], got {self.dt!r}.",
        )
        self.rates(self.dt)
        require(
            self.damping == "adaptive"
            or (not isinstance(self.damping, str) and 0.0 <= self.damping < math.inf),
            f'`damping` must be "adaptive" or lambda / sigma_max >= 0, got {self.damping!r}.',
        )
        # An angle that can turn once round is periodic.
        turns = torch.as_tensor(model.turns, device="cpu") & (self.limits != "off")
        full = self.q_max - self.q_min >= _FULL * _TURN
        periods = torch.where(turns & full, self.q_max.new_tensor(_TURN), math.inf)
        vars(self).update(middle=0.5 * (self.q_min + self.q_max))
        vars(self).update(
            posture=self._posture(),
            clear=self._clear(),
            periods=periods,
            spans=torch.minimum(self.q_max - self.q_min, periods),
            pulls=bound(model.robot.pulls, "pulls"),
            n_actuators=next(iter(sizes), None),
            farthest=model.robot.farthest,
            longest_usual=model.robot.longest_usual,
        )

    def _posture(self) -> NoPosture:
        """Return the preferred configurations, on the plane of q."""
        wanted = self.q_pref
        if callable(wanted):
            return PostureFunction(wanted, self.plane.nearest)
        if wanted is None:
            wanted = self.middle
        if torch.isfinite(wanted).all():
            return FixedPosture(self.plane.nearest(wanted))
        return NoPosture()

    def _clear(self) -> KeptClear:
        """Return the body and what it keeps clear of; without limits, nothing."""
        scene = as_numbers(self.obstacles)
        longest = torch.where(torch.isfinite(self.q_max), self.q_max, 0.0)
        if self.limits == "off":
            return nowhere()
        return kept_clear(self.task, scene, self.clearance, self.body_points, longest)

    def present(self) -> StepSettings:
        """Return the settings for the model that the estimator of the task has now."""
        task = self.task.present()
        if task is self.task:
            return self
        n = task.n_actuators
        before = self.task.n_actuators
        require(
            n == before,
            f"`model` must keep its {before} actuators, but now has {n}; make a new "
            "InverseKinematics.",
        )
        return replace(self, task=task, **limits_of(task, self.of_model))

    def in_words(self) -> dict[str, str]:
        """Return the arguments of `InverseKinematics`, except the model, as short texts."""
        words = {}
        for argument in fields(self):
            name = argument.name
            value = getattr(self, name)
            if name in ("task", "of_model", "own_limits") or not argument.init:
                continue
            words[name] = repr(value)
            if isinstance(value, Tensor):
                words[name] = _in_words(value)
            if name == "weights" and not self.weighted:
                words[name] = "None"
            if name in self.of_model and words[name] != "None":
                words[name] += " of the model"
        if self.own_limits:
            words["limits"] = f"{len(self.own_limits)} functions"
        return words

    def unit_messages(self) -> list[str]:
        """Return warnings if limits or a posture seem to have another unit than the model."""
        messages = []
        for name in ("q_min", "q_max", "dq_max", "q_pref"):
            value = getattr(self, name)
            if not isinstance(value, Tensor) or name in self.of_model:
                continue
            if self.n_actuators is not None:
                q = torch.where(torch.isfinite(value), value, 0.0)
                rows = q.expand(1, self.n_actuators)
                factor = _FAST if name == "dq_max" else 1.0
                robot = self.task.models[0].robot
                messages += robot.unit_messages(rows, name, factor)
        return messages

    def derivative_messages(self) -> list[str]:
        """Return a warning if a part of a model has no derivative to follow."""
        if not any(model.is_stepwise for model in self.task.models):
            return []
        return [
            "`model` has a regressor that is constant between steps, as trees and nearest "
            "neighbours are: its derivative is zero almost everywhere. Steps follow the derivative "
            "of the mechanical model alone (without one no step approaches the target), and "
            "targets within a step of the regressor are not reached. Use such regressors for "
            "predictions, and a smooth error model for inverse kinematics, for example "
            "error_model='auto'."
        ]

    def posture_messages(self, q: Tensor, name: str) -> list[str]:
        """Return warnings if configurations (..., n) seem to have another unit than the model."""
        rows = q.reshape(-1, q.shape[-1])
        finite = rows[torch.isfinite(rows).all(-1)]
        return self.task.models[0].robot.unit_messages(finite, name)

    def far_messages(self, x: Tensor, name: str) -> list[str]:
        """Return warnings if targets lie too far from the robot to be in metres."""
        points = self.task.positions(x)
        if points.shape[-1] == 3:
            return self.task.models[0].robot.far_messages(points, name)
        return []

    def misses(self, target: Tensor) -> Tensor:
        """Return proven lower bounds (N,) of the errors at targets [m]; not positive: no proof."""
        low, high = self.box(target.double())
        largest = torch.maximum(low.abs(), high.abs()).clamp(max=LARGEST)
        return self.task.misses(target, largest)

    @property
    def accelerates(self) -> bool:
        """Whether there is a limit of acceleration."""
        return self.limits != "off" and bool(torch.isfinite(self.ddq_max).any())

    def whole_turns(self, dq: Tensor) -> Tensor:
        """Return the whole turns nearest to dq (..., n)."""
        periods = moved(self.periods, dq)
        turns = periods * (dq / periods).round()
        return torch.where(torch.isfinite(periods), turns, 0.0)

    @property
    def has_posture(self) -> bool:
        """Whether there is a preferred configuration."""
        return self.posture.exists and self.beta.per_second != 0.0

    def write_plan(self, plan: Plan) -> int:
        """Write the node of a step into a plan, after its model, and return its place.

        Raises
        ------
        TypeError
            If it could only be stored as code: a task of another class than those of
            `hybridkin.tasks`, or a posture that is a function; or if n is not known.
        """
        n = self.n_actuators
        for part in self.task.stacked:
            if type(part) not in (PositionTask, PoseTask, PointsTask, AxisTask):
                raise TypeError(f"a {type(part).__name__} has no kernel")
            if part.of_poses and len(self.task.stacked) > 1:
                raise TypeError("a Stack with poses or axes has no kernel")
        posture = self.posture.numbers
        if n is None:
            raise TypeError("the number of actuators is unknown; give one limit for each")
        if self.task.n_levels > 1:
            raise TypeError("a Stack of several levels has no kernel")
        if self.own_limits:
            raise TypeError("`limits` that are functions have no kernel")
        model = plan.stack([model.stored() for model in self.task.steered])
        scale = np.repeat(self.task.units, self.task.parts)
        plan.limit("rows of a task", len(scale))

        # Numbers of all actuators, in the kernel's order.
        weights = np.broadcast_to(as_array(self.weights), n)
        vectors = [self.q_min, self.q_max, self.dq_max, self.ddq_max, posture]
        numbers = [np.broadcast_to(as_array(vector), n) for vector in vectors]
        numbers += [weights**-0.5, self.kernel_rates(), scale]
        expected, most = expected_innovation(self)
        numbers += [as_array(expected), [most]]
        if isinstance(self.task, AxisTask):
            numbers.append(as_array(self.task.axis))
        for vector in (self.periods, self.pulls):
            numbers.append(np.broadcast_to(as_array(vector), n))

        n_normals = self.plane.n_normals
        if n_normals:
            numbers.append(as_array(self.plane.normals).T)
        if n_normals > IK_NORMALS:
            raise NoKernel(
                f"the log leaves {n_normals} directions of q out, more than {IK_NORMALS}"
            )
        n_spaces = self.tip_limits.n
        if n_spaces > 0:
            plan.limit("actuators", n_spaces)  # they share arrays of the kernels
            spaces = self.tip_limits
            numbers += [as_array(spaces.normals).T, as_array(spaces.offsets)]
        body = self.clear.write_plan(plan, n)
        numbers.append(as_array(self.clear.scene))
        stages = self.task.hysteresis.stage_numbers(n)
        numbers.append(stages.numbers)

        flags = IK_LIMITED * (self.limits == "saturate")
        flags |= IK_POSTURE * self.has_posture
        flags |= IK_WEIGHTS * self.weighted
        flags |= IK_ACCELERATES * self.accelerates
        flags |= IK_PULLS * bool(self.pulls.any())
        flags |= IK_POSE * self.task.has_rotation
        flags |= IK_AXIS * isinstance(self.task, AxisTask)
        n_obstacles = len(self.clear.scene)
        entries = [model, flags, n_normals, n_spaces, n_obstacles, body, *stages.code]
        return plan.node("ik", n, len(scale), numbers, *entries)

    def kernel_rates(self) -> list[float]:
        """Return gain (negative: 1 / period), beta, period and damping (negative: adaptive)."""
        gain = self.gain.per_second if self.gain.given else -1.0
        # Steps of more than a second end at the posture.
        beta = self.beta.per_second
        damping = -1.0 if isinstance(self.damping, str) else self.damping
        return [gain, beta, self.dt, damping]

    @property
    def fraction(self) -> float:
        """Fraction of an innovation that a reading adds to the offset; all of it for a `gain`."""
        return 1.0 if self.gain.given else IK_FRACTION

    # The plane of q to keep to, where the log lies in one.

    @property
    def plane(self) -> PlaneOfQ:
        """The plane of q, see `ForwardModel`."""
        return self.task.models[0].plane

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, ...) and J (N, m, n) of motions in the plane, at q of shape (N, n)."""
        if len(q) == 0:
            x = q.new_zeros(0, *self.task.shape)
            return x, q.new_zeros(0, sum(self.task.parts), q.shape[1])
        with without_warnings():  # a status says what is wrong
            x, J = self.task.evaluate(q)
        return x, self.plane.along(J)

    def preferred(self, q: Tensor) -> Tensor:
        """Return the preferred configurations, of shape (n,) or that of q."""
        return self.posture.at(q)

    def start(self, like: Tensor) -> Tensor:
        """Return the preferred configuration (n,); if it is a function, evaluate it mid-range."""
        n = self.n_actuators
        middle = moved(self.middle, like)
        if n is not None:
            middle = middle.expand(n)
        start = self.posture.start(middle).to(like)
        if n is None or not torch.isfinite(start).all():
            raise ValueError(
                "a start is needed: give `q0` or `q_pref` of shape (n,), or finite `q_min` and "
                "`q_max`, one value per actuator where the number of actuators is not known from "
                "the model."
            )
        return start.expand(n)

    def rates(self, period: float) -> tuple[float, float]:
        """Return gain dt and beta dt, both at most 1, for a period [s]."""
        return self.gain.fraction(period), self.beta.fraction(period)

    @property
    def weighted(self) -> bool:
        """Whether some weight is not one."""
        return bool((self.weights != 1.0).any())

    def unit(self, q: Tensor) -> Tensor:
        """Return the units of q, shape () or (n,), in which all weights are 1."""
        return moved(self.weights, q).rsqrt()

    # Limits of q and of its steps.

    def box(self, q: Tensor) -> Bounds:
        """Return the limits of q."""
        if self.limits == "off":
            return Bounds(q.new_tensor(-math.inf), q.new_tensor(math.inf))
        return Bounds(moved(self.q_min, q), moved(self.q_max, q))

    def inside(self, q: Tensor) -> Tensor:
        """Return q moved into the limits: by whole turns if q is periodic, then clipped."""
        box = self.box(q)
        middle = 0.5 * (box.lower + box.upper)
        turned = q - self.whole_turns(q - middle)
        outside = (q < box.lower) | (q > box.upper)
        return box.clip(torch.where(outside, turned, q))

    def start_at(self, q: Tensor) -> Tensor:
        """Return q moved onto the plane and into the limits."""
        if self.plane.n_normals:
            for _ in range(PLANE_ROUNDS):
                q = self.inside(self.plane.nearest(q))
        return self.inside(q)

    def allowed(self, x: Tensor) -> Tensor:
        """Return the points nearest to x within the tip limits, and outside obstacles."""
        limits = self.tip_limits
        if limits.n > 0:
            x = x + limits.way_in(limits.margin(x))
        if self.clear and self.is_in_obstacle(x).any():
            x = self.clear.freed_tip(x)
        return x

    def is_in_obstacle(self, x: Tensor) -> Tensor:
        """Return whether points that are steered (N, ...) are in an obstacle, bool (N,)."""
        if not self.clear or self.task.shape != (3,):
            return torch.zeros(len(x), dtype=torch.bool, device=x.device)
        return (self.clear.freed_tip(x) != x).any(-1)

    def change(self, q: Tensor, period: float) -> Tensor:
        """Return the largest difference between consecutive steps."""
        return moved(self.ddq_max, q) * period**2

    def step_bounds(
        self, q: Tensor, period: float | None = None, last: Tensor | float = 0.0
    ) -> Bounds:
        """Return the bounds of dq: position, and for a period [s] speed and acceleration.

        They are intersected and never empty. `last` is the previous step, scaled to this period.
        Outside the limits both bounds are the step back to them, limited by the largest step. If
        the speed cannot be stopped in time, both bounds are the hardest braking.

        With speed u = dq / period and acceleration a, the distance to a stop is at most
        u period + u^2 / (2 a), whatever the following periods are. The robot can stop within d if
        dq <= 2 d / (1 + sqrt(1 + 2 d / (a period^2))). Braking in the next period preserves this.
        """
        q_min, q_max = self.box(q)
        lower = q_min - q
        upper = q_max - q
        # q + upper <= q_max also after rounding, and so q + dq <= q_max for every dq.
        one_less = torch.nextafter(upper, torch.full_like(q, -math.inf))
        one_more = torch.nextafter(lower, torch.full_like(q, math.inf))
        upper = torch.where(q + upper > q_max, one_less, upper)
        lower = torch.where(q + lower < q_min, one_more, lower)
        if self.limits == "off" or period is None:
            return Bounds(lower, upper)
        fastest = moved(self.dq_max, q) * period
        speed = Bounds(-fastest, fastest)
        if self.accelerates:
            change = self.change(q, period)
            lower = -stopping(-lower, change)
            upper = stopping(upper, change)
            reachable = Bounds(last - change, last + change)
            speed = Bounds(reachable.clip(-fastest), reachable.clip(fastest))
        return Bounds(speed.clip(lower), speed.clip(upper))

    def margin(self, q: Tensor) -> Tensor:
        """Return the smallest distance of an actuator to its limits."""
        low = moved(self.q_min, q)
        high = moved(self.q_max, q)
        return torch.minimum(q - low, high - q).amin(-1)

    # Conversion of a caller's arrays to tensors.

    def configurations(self, value: Array, name: str, like: Tensor | None = None) -> Tensor:
        """Return q as a tensor (..., n), on the device and at least in the precision of `like`."""
        q = as_tensor(value, name, self.task.device if like is None else like.device)
        n = self.n_actuators or "n"
        check_shape(q, name, ("...", n), "one value per actuator")
        if like is None:
            return q
        return q.to(like.device, torch.promote_types(q.dtype, like.dtype))

    def points(
        self,
        value: Array,
        name: str,
        like: Tensor | None = None,
        *,
        lead: str = "...",
        shape: tuple[int, ...] | None = None,
    ) -> Tensor:
        """Return targets or tips (..., *shape), by default in the shape of the task's targets.

        `lead` gives the leading axes: "..." any, "T" one, "" none.
        """
        x = as_tensor(value, name, self.task.device)
        point = shape or self.task.shape
        need = [axis for axis in (lead, *point) if axis != ""]
        check_shape(x, name, need, "one point [m] per row")
        if shape is None:
            self.task.check(x, name)
        if like is None:
            return x
        return x.to(like)

    def readings(
        self, value: Array, name: str, like: Tensor | None = None, lead: str = "..."
    ) -> Tensor:
        """Return measured tips (..., *shape), see `points`, also from positions alone."""
        x = self.task.reading(as_tensor(value, name, self.task.device))
        return self.points(x, name, like, lead=lead)

    def times(self, t: Array | None, target: Tensor) -> tuple[Tensor, list[float]]:
        """Return the times of a path's points, and the period after each point."""
        n = len(target)
        if t is None:
            steps = torch.arange(n, dtype=target.dtype, device=target.device)
            return self.dt * steps, [self.dt] * n
        times = as_tensor(t, "t", target.device)
        check_shape(times, "t", [n], "one time per point of `path`")
        periods = times.diff().tolist()
        require(
            countable(times).all() and min(periods, default=self.dt) > 0.0,
            "`t` must be finite and increasing [s]; sort it, drop repeated times.",
        )
        self.rates(max(periods, default=self.dt))
        return times, [*periods, self.dt]

    def tolerance(self, tol: float | Sequence[float]) -> Tolerance:
        """Return one tolerance [m], or one for every part of the task."""
        tolerances = real_array(tol, "tol").astype(float)
        n = len(self.task.parts)
        good = tolerances.shape in ((), (n,)) and bool((tolerances > 0.0).all())
        require(
            good,
            f"`tol` must be positive: one number [m], or {n}, one for every part of the task; got "
            f"{tol!r:.200}.",
        )
        if tolerances.ndim == 0:
            return tolerances.item()
        return tuple(tolerances.tolist())
