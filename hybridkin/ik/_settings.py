"""The checked settings of inverse kinematics, and the conversion of the caller's arrays."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from inspect import Signature
from typing import ClassVar, TypeAlias

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
    whole,
)
from hybridkin._core.kernel_numbers import (
    IK_ACCELERATES,
    IK_LIMITED,
    IK_NORMALS,
    IK_POSTURE,
    IK_PULLS,
    IK_WEIGHTS,
)
from hybridkin._core.model import Portable
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.stored import Layout, Stored
from hybridkin.ik._box import HalfSpaces
from hybridkin.ik.tasks import PoseTask, PositionTask, Task, Tolerance

Array: TypeAlias = Numbers | Transform  # what a caller may pass
Posture: TypeAlias = Callable[[Tensor], Tensor]


def bound(
    value: Array, name: str, *, finite: bool = False, positive: bool = False
) -> Tensor:
    """Return a limit, a posture or weights as a float64 tensor of shape () or (n,)."""
    a = as_tensor(value, name).cpu().double().clone()
    good = a.ndim < 2 and a.numel() > 0 and not torch.isnan(a).any()
    require(
        good,
        f"`{name}` must be a number or of shape (n,), without NaN, got {a.tolist()}.",
    )
    good = torch.isfinite(a).all() or not finite
    require(good, f"`{name}` must be finite, got {a.tolist()}.")
    lock = "to lock an actuator, give it equal limits"
    require(
        (a > 0.0).all() or not positive,
        f"`{name}` must be positive, got {a.tolist()}; {lock}.",
    )
    return a


def limits_of(task: Task, names: Iterable[str]) -> dict[str, Tensor]:
    """Return these limits of the model of a task."""
    limits = task.models[0].robot.limits
    return {
        name: bound(limits[name], name, positive=name == "dq_max") for name in names
    }


def half_spaces(given: Sequence[Array], task: Task) -> HalfSpaces:
    """Return tip limits, a pair (A, b) with A x <= b, as half-spaces with unit normals."""
    need = "`tip_limits` must be a pair (A, b)"
    m = task.shape[0]
    got = type(task).__name__
    require(
        isinstance(task, PositionTask),
        f"`tip_limits` needs a PositionTask, got a {got}.",
    )
    require(
        isinstance(given, Sequence) and len(given) == 2, f"{need}, got {given!r:.200}."
    )
    A, b = (as_tensor(a, "tip_limits").cpu().double() for a in given)
    size = A.norm(dim=-1)
    good = A.shape == (b.numel(), m) and b.ndim == 1 and bool(torch.isfinite(b).all())
    good = good and bool((size > 0.0).all() and torch.isfinite(size).all())
    shapes = f"of shapes (k, {m}) and (k,), finite, with a direction in every row of A"
    require(good, f"{need} {shapes}, got {A.tolist()!r:.200} and {b.tolist()!r:.200}.")
    spaces = HalfSpaces(A / size[:, None], b / size)
    inside = spaces.margin(spaces.way_in(spaces.offsets[None])) >= -1e-9
    require(
        inside.all(),
        "`tip_limits` must have a common point; these half-spaces have none.",
    )
    return spaces


def require(good: bool | Tensor, message: str) -> None:
    """Raise a ValueError with this message if an argument is not good."""
    if not good:
        raise ValueError(message)


def stopping(way: Tensor, change: Tensor) -> Tensor:
    """Return the largest first step for which steps that shrink by `change` stop within `way`."""
    stops = way / (0.5 + 0.5 * (1.0 + 2.0 * (way.clamp_min(0.0) / change)).sqrt())
    return torch.where((way > 0.0) & torch.isfinite(way), stops, way)


_FAST = (
    5.0  # largest plausible speed: this many times the largest plausible q per second
)
_TURN = 2.0 * math.pi
_FULL = 0.999  # a range of this share of a turn counts as a whole turn
PLANE_ROUNDS = 8  # of alternating projections onto a plane and a box


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a step: limits, posture and weights, rates, and the plane to keep to."""
    model = plan.node_of(stored.part("model"))
    n, m = plan.lengths(model)
    if m != 3:
        raise NoKernel(f"the kernel of a step needs tips of 3 coordinates, got {m}")
    settings = stored.settings
    radian = settings["radian"]
    if radian and plan.kind(model) != "rigid":
        raise NoKernel("the kernels for poses support rigid arms only")
    names = ("q_min", "q_max", "dq_max", "ddq_max", "posture")
    vectors = [stored.array(name, [n], finite=False) for name in names]
    weights = stored.array("weights", [n])
    pulls = stored.array("pulls", [n])
    periods = stored.array("periods", [n], finite=False)
    normals = stored.array("normals").T
    if len(normals) > IK_NORMALS:
        raise NoKernel(
            f"the log leaves {len(normals)} directions of q out, more than {IK_NORMALS}"
        )
    gain = -1.0 if settings["gain"] is None else settings["gain"]
    # Steps of more than a second end at the posture.
    beta = 1.0 if settings["beta"] is None else settings["beta"]
    damping = -1.0 if settings["damping"] == "adaptive" else settings["damping"]
    rates = [gain, beta, settings["dt"], damping, radian]
    flags = IK_LIMITED * (settings["limits"] == "saturate")
    flags |= IK_POSTURE * settings["has_posture"]
    flags |= IK_WEIGHTS * bool((weights != 1.0).any())
    flags |= IK_ACCELERATES * settings["accelerates"]
    flags |= IK_PULLS * bool(pulls.any())
    numbers = [*vectors, weights**-0.5, rates, periods, pulls, normals]
    return plan.node("ik", n, 6 if radian else 3, numbers, model, flags, len(normals))


@dataclass(frozen=True)
class StepSettings(Portable):
    """All inputs of a step except q and the target; see `InverseKinematics`.

    Limits, weights and a fixed posture are float64 tensors of shape () or (n,). `posture` is
    `q_pref`, or by default the middle of the limits. `of_model` names the limits taken from the
    model. `periods`, shape () or (n,), are the periods of q: a turn for an angle with a range of a
    whole turn, else inf. `pulls` is that of the robot, see `ForwardModel`.
    """

    layout: ClassVar[Layout] = Layout("inverse_kinematics", {}, write_plan=_write_plan)

    task: Task
    q_min: Tensor
    q_max: Tensor
    dq_max: Tensor
    ddq_max: Tensor
    q_pref: Tensor | Posture | None
    beta: float | None
    gain: float | None
    damping: str | float
    limits: str
    dt: float
    weights: Tensor | None
    of_model: tuple[str, ...]
    tip_limits: HalfSpaces | None
    posture: Tensor | Posture | None = field(init=False)
    periods: Tensor = field(init=False)
    pulls: Tensor = field(init=False)

    def __post_init__(self) -> None:
        """Check the settings; without `q_pref` the posture is the middle of the limits."""
        sizes = self._sizes()
        need = "give scalars or one value per actuator"
        good = len(set(sizes.values())) < 2
        names = ", ".join(f"`{name}`" for name in sizes)
        require(
            good,
            f"{names} must have the same number of actuators, got {sizes}; {need}.",
        )
        low = self.q_min.tolist()
        high = self.q_max.tolist()
        good = (self.q_min <= self.q_max).all()
        require(
            good, f"`q_min` must not exceed `q_max`, got {low} and {high}; swap them."
        )
        posture = self.middle if self.q_pref is None else self.q_pref
        if isinstance(posture, Tensor):
            posture = self.on_plane(posture)
        object.__setattr__(self, "posture", posture)
        good = 0.0 < self.dt < LARGEST
        require(good, f"`dt` must be a positive period [s], got {self.dt!r}.")
        self.rates()
        least = 0.0 if self.damping == "adaptive" else self.damping
        good = not isinstance(least, str) and 0.0 <= least < math.inf
        text = '"adaptive" or'
        require(
            good,
            f"`damping` must be {text} lambda / sigma_max >= 0, got {self.damping!r}.",
        )
        models = self.task.models
        turns = torch.stack(
            [torch.as_tensor(model.turns, device="cpu") for model in models]
        )
        full = (self.q_max - self.q_min >= _FULL * _TURN) & (self.limits != "off")
        periods = torch.where(
            turns.all(0) & full, self.q_max.new_tensor(_TURN), math.inf
        )
        object.__setattr__(self, "periods", periods)
        object.__setattr__(self, "pulls", bound(models[0].robot.pulls, "pulls"))

    def present(self) -> StepSettings:
        """Return the settings for the model that the estimator of the task has now."""
        task = self.task.present()
        if task is self.task:
            return self
        n = task.n_actuators
        before = self.task.n_actuators
        way = "make a new InverseKinematics"
        require(
            n == before,
            f"`model` must keep its {before} actuators, but now has {n}; {way}.",
        )
        return replace(self, task=task, **limits_of(task, self.of_model))

    def shown(self, arguments: Signature, defaults: bool = False) -> dict[str, str]:
        """Return the settings that differ from their defaults, or all of them, in words."""
        shown = {}
        for name, default in arguments.parameters.items():
            value = vars(self).get(name)
            if isinstance(value, Tensor):
                ends = dict.fromkeys(
                    f"{float(end):.4g}" for end in (value.min(), value.max())
                )
                whose = " of the model" if name in self.of_model else ""
                if torch.isfinite(value).any():
                    shown[name] = f"{' to '.join(ends)}{whose}"
            elif value not in (None, default.default):
                shown[name] = repr(value)
            if defaults and name != "model":
                shown.setdefault(name, repr(default.default))
        return shown

    def unit_messages(self) -> list[str]:
        """Return warnings if limits or a posture seem to have another unit than the model."""
        messages = []
        n = self.n_actuators
        for name in ("q_min", "q_max", "dq_max", "q_pref"):
            value = vars(self)[name]
            if (
                isinstance(value, Tensor)
                and n is not None
                and name not in self.of_model
            ):
                q = torch.where(torch.isfinite(value), value, 0.0).expand(1, n)
                factor = _FAST if name == "dq_max" else 1.0
                messages += self.task.models[0].robot.unit_messages(q, name, factor)
        return messages

    def far_messages(self, x: Tensor, name: str) -> list[str]:
        """Return warnings if targets lie too far from the robot to be in metres."""
        points = self._positions(x)
        if points.shape[-1] == 3:
            return self.task.models[0].robot.far_messages(points, name)
        return []

    def misses(self, target: Tensor) -> Tensor:
        """Return proven lower bounds (N,) of the errors at targets [m]; not positive: no proof."""
        low, high = self.box(target.double())
        largest = torch.maximum(low.abs(), high.abs()).clamp(max=LARGEST)
        missed = self.task.models[0].misses(self._positions(target), largest)
        return missed[..., None].flatten(1).amax(-1) * min(self.task.units)

    def _positions(self, x: Tensor) -> Tensor:
        return x[..., :3, 3] if self.task.shape == (4, 4) else x

    def _sizes(self) -> dict[str, int]:
        """Return the numbers of actuators given by the settings and the model, by name."""
        vectors = {
            k: a for k, a in vars(self).items() if isinstance(a, Tensor) and a.ndim == 1
        }
        sizes = {name: len(a) for name, a in vectors.items()}
        n = self.task.n_actuators
        return sizes if n is None else {**sizes, "model": n}

    @property
    def n_actuators(self) -> int | None:
        """Length of q, or None if neither settings nor model define it."""
        return next(iter(self._sizes().values()), None)

    @property
    def middle(self) -> Tensor | None:
        """The middle of the limits, or None if they are not finite."""
        middle = 0.5 * (self.q_min + self.q_max)
        return middle if torch.isfinite(middle).all() else None

    @property
    def accelerates(self) -> bool:
        """Whether there is a limit of acceleration."""
        return self.limits != "off" and bool(torch.isfinite(self.ddq_max).any())

    @property
    def spans(self) -> Tensor:
        """The ranges of q, shape () or (n,), at most its periods."""
        return torch.minimum(self.q_max - self.q_min, self.periods)

    def whole_turns(self, dq: Tensor) -> Tensor:
        """Return the whole turns nearest to dq (..., n)."""
        periods = self.periods.to(dq)
        return torch.where(
            torch.isfinite(periods), periods * (dq / periods).round(), 0.0
        )

    @property
    def has_posture(self) -> bool:
        """Whether there is a preferred configuration."""
        return self.posture is not None and (self.beta is None or self.beta > 0.0)

    def stored(self) -> Stored:
        """Return the description of the settings, with the model as their part.

        Raises
        ------
        TypeError
            If they could only be stored as code: tasks other than a `PositionTask` or a
            `PoseTask`, a posture that is a function, or tip limits; or if n is not known.
        """
        model = self.task.models[0]
        n = self.n_actuators
        if type(self.task) not in (PositionTask, PoseTask):
            raise TypeError(f"a {type(self.task).__name__} has no kernel")
        if callable(self.posture):
            raise TypeError("a posture that is a function has no kernel")
        if self.tip_limits is not None:
            raise TypeError("limits of the tip have no kernel")
        if n is None:
            raise TypeError(
                "the number of actuators is unknown; give one limit for each"
            )
        arrays = {
            "q_min": self.q_min,
            "q_max": self.q_max,
            "dq_max": self.dq_max,
            "ddq_max": self.ddq_max,
            "posture": 0.0 if self.posture is None else self.posture,
            "weights": 1.0 if self.weights is None else self.weights,
            "periods": self.periods,
            "pulls": self.pulls,
        }
        arrays = {name: np.broadcast_to(as_array(a), n) for name, a in arrays.items()}
        if self.plane is None:
            arrays["normals"] = np.zeros((n, 0))
        else:
            arrays["normals"] = as_array(self.plane[1])
        names = (
            "beta",
            "gain",
            "damping",
            "limits",
            "dt",
            "has_posture",
            "accelerates",
        )
        settings = {name: getattr(self, name) for name in names}
        settings["radian"] = self.task.units[1] if len(self.task.parts) > 1 else 0.0
        return Stored.of(
            self.layout.kind, arrays, {"model": model.stored()}, **settings
        )

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of q to keep to, if any, see `ForwardModel`."""
        return self.task.models[0].plane

    def in_plane(self, motion: Tensor) -> Tensor:
        """Return motions (..., n) without their part normal to the plane."""
        if self.plane is None:
            return motion
        normals = self.plane[1].to(motion)
        return motion - motion @ normals @ normals.mT

    def on_plane(self, q: Tensor) -> Tensor:
        """Return the points of the plane that are nearest to q, shape () or (..., n)."""
        if self.plane is None:
            return q
        point = self.plane[0].to(q)
        return point + self.in_plane(q - point)

    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (N, ...) and J (N, m, n) of motions in the plane, at q of shape (N, n)."""
        if len(q) > 0:
            x, J = self.task.evaluate(q)
            return x, self.in_plane(J)
        return q.new_zeros(0, *self.task.shape), q.new_zeros(
            0, sum(self.task.parts), q.shape[1]
        )

    def preferred(self, q: Tensor) -> Tensor:
        """Return the preferred configurations, of shape (n,) or that of q."""
        wanted = self.posture(q) if callable(self.posture) else self.posture
        if not isinstance(wanted, Tensor):
            got = type(wanted).__name__
            raise TypeError(
                f"`q_pref` must map torch tensors to torch tensors, got {got}."
            )
        return self.on_plane(wanted.to(q))

    def start(self, like: Tensor) -> Tensor:
        """Return the preferred configuration (n,); if it is a function, evaluate it mid-range."""
        start = self.posture if isinstance(self.posture, Tensor) else self.middle
        need = "give `q0` or `q_pref` of shape (n,)"
        if start is None:
            raise ValueError(
                f"a start is needed: {need}, or finite `q_min` and `q_max`."
            )
        if self.n_actuators is None:
            raise ValueError(
                f"the number of actuators is not known from this model; {need}."
            )
        start = start.to(like).expand(self.n_actuators)
        return self.preferred(start) if callable(self.q_pref) else start

    def rates(self, period: float | None = None) -> tuple[float, float, float]:
        """Return gain dt and beta dt, both at most 1, and dt, for a period [s], default `dt`."""
        dt = self.dt if period is None else period
        gain = 1.0 if self.gain is None else self.gain * dt
        beta = min(dt, 1.0) if self.beta is None else self.beta * dt
        for name, share, good in (
            ("gain", gain, gain > 0.0),
            ("beta", beta, beta >= 0.0),
        ):
            need = "must lie in [0, 1], and a gain above 0"
            got = f"got {share / dt:.6g} 1/s x {dt:.6g} s = {share:.4g}"
            way = f"use a {name} up to {1.0 / dt:.4g} 1/s or a shorter period"
            good = good and share <= 1.0 + 1e-9
            require(good, f"`{name}` times the period {need}, {got}; {way}.")
        return min(gain, 1.0), min(beta, 1.0), dt

    def unit(self, q: Tensor) -> Tensor:
        """Return the units of q, shape () or (n,), in which all weights are 1."""
        return q.new_ones(()) if self.weights is None else self.weights.to(q).rsqrt()

    def box(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the limits of q."""
        if self.limits == "off":
            return q.new_tensor(-math.inf), q.new_tensor(math.inf)
        return self.q_min.to(q), self.q_max.to(q)

    def inside(self, q: Tensor) -> Tensor:
        """Return q moved into the limits: by whole turns if q is periodic, then clipped."""
        low, high = self.box(q)
        turned = q - self.whole_turns(q - 0.5 * (low + high))
        return torch.clamp(torch.where((q < low) | (q > high), turned, q), low, high)

    def start_at(self, q: Tensor) -> Tensor:
        """Return q moved onto the plane and into the limits."""
        for _ in range(0 if self.plane is None else PLANE_ROUNDS):
            q = self.inside(self.on_plane(q))
        return self.inside(q)

    def allowed(self, x: Tensor) -> Tensor:
        """Return the points nearest to x within the tip limits."""
        limits = self.tip_limits
        return x if limits is None else x + limits.way_in(limits.margin(x))

    def change(self, q: Tensor, period: float) -> Tensor:
        """Return the largest difference between consecutive steps."""
        return self.ddq_max.to(q) * period**2

    def step_bounds(
        self, q: Tensor, period: float | None = None, last: Tensor | float = 0.0
    ) -> tuple[Tensor, Tensor]:
        """Return the bounds of dq: position, and for a period [s] speed and acceleration.

        They are intersected and never empty. `last` is the previous step, scaled to this period.
        Outside the limits both bounds are the step back to them, limited by the largest step. If
        the speed cannot be stopped in time, both bounds are the hardest braking. The nextafter
        ensures q + upper <= q_max after rounding, and so q + dq <= q_max for every dq.

        With speed u = dq / period and acceleration a, the distance to a stop is at most
        u period + u^2 / (2 a), whatever the following periods are. The robot can stop within d if
        dq <= 2 d / (1 + sqrt(1 + 2 d / (a period^2))). Braking in the next period preserves this.
        """
        q_min, q_max = self.box(q)
        lower = q_min - q
        upper = q_max - q
        up = torch.full_like(q, math.inf)
        down = torch.full_like(q, -math.inf)
        upper = torch.where(q + upper > q_max, torch.nextafter(upper, down), upper)
        lower = torch.where(q + lower < q_min, torch.nextafter(lower, up), lower)
        if self.limits == "off" or period is None:
            return lower, upper
        most = self.dq_max.to(q) * period
        ends = -most, most
        if self.accelerates:
            change = self.change(q, period)
            lower = -stopping(-lower, change)
            upper = stopping(upper, change)
            ends = [torch.clamp(end, last - change, last + change) for end in ends]
        return torch.clamp(lower, *ends), torch.clamp(upper, *ends)

    def margin(self, q: Tensor) -> Tensor:
        """Return the smallest distance of an actuator to its limits."""
        return torch.minimum(q - self.q_min.to(q), self.q_max.to(q) - q).amin(-1)

    # Conversion of a caller's arrays to tensors.

    def configurations(
        self, value: Array, name: str, like: Tensor | None = None
    ) -> Tensor:
        """Return q as a tensor (..., n), on the device and at least in the precision of `like`."""
        q = as_tensor(value, name, self.task.device if like is None else like.device)
        n = self.n_actuators
        check_shape(q, name, ("...", n or "n"), "one value per actuator")
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
        point_shape = shape or self.task.shape
        check_shape(
            x, name, [*filter(None, [lead]), *point_shape], "one point [m] per row"
        )
        if shape is None:
            self.task.check(x, name)
        return x if like is None else x.to(like)

    def times(self, t: Array | None, target: Tensor) -> tuple[Tensor, list[float]]:
        """Return the times of a path's points, and the period after each point."""
        n = len(target)
        dt = self.dt
        if t is None:
            return dt * torch.arange(n, dtype=target.dtype, device=target.device), [
                dt
            ] * n
        times = as_tensor(t, "t", target.device)
        check_shape(times, "t", [n], "one time per point of `path`")
        periods = times.diff().tolist()
        increasing = bool(countable(times).all()) and min(periods, default=dt) > 0.0
        require(
            increasing,
            "`t` must be finite and increasing [s]; sort it, drop repeated times.",
        )
        self.rates(max(periods, default=dt))
        return times, [*periods, dt]

    def places(self, n_solutions: int | None, differentiable: bool) -> int:
        """Return the number of configurations per target."""
        if n_solutions is None:
            return 1
        require(
            not differentiable, "`n_solutions` must be None for differentiable=True."
        )
        n_solutions = whole(n_solutions, "n_solutions", 1, 10_000)
        good = torch.isfinite(self.spans).all()
        way = "give finite `q_min` and `q_max`"
        require(
            good,
            f"`n_solutions` needs finite ranges of q to compare configurations; {way}.",
        )
        return n_solutions

    def tolerance(self, tol: float | Sequence[float]) -> Tolerance:
        """Return one tolerance [m], or one for every part of the task."""
        tolerances = np.atleast_1d(real_array(tol, "tol").astype(float))
        require(
            bool((tolerances > 0.0).all()), f"`tol` must be positive [m], got {tol!r}."
        )
        if np.ndim(tol) == 0:
            return float(tolerances[0])
        n = len(self.task.parts)
        parts = "one for every part of the task"
        require(
            tolerances.shape == (n,),
            f"`tol` must be one number [m] or {n}, {parts}, got {tol!r}.",
        )
        return tuple(tolerances.tolist())
