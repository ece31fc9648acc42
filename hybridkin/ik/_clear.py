"""The body of a robot that keeps clear of obstacles, and of itself.

Points along the backbone carry balls that cover the body. A gap is what lies between such a ball
and an obstacle, or between two balls. Obstacles are convex: a point at a distance d from one, with
the direction n out of it, stays free on every way whose component along n is at least -d.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from hybridkin._core.arrays import as_array, number, whole
from hybridkin._core.constants import moved
from hybridkin._core.kernel_numbers import (
    IK_BENT_WAY,
    IK_INSIDE_OBSTACLE,
    IK_NEARER,
    IK_OBSTACLE,
    IK_PAIRS_MOST,
)
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import Plan
from hybridkin._core.portable import Portable
from hybridkin.ik._gram import apply_rows
from hybridkin.ik._nearest import Polyhedron, nearest
from hybridkin.ik._rates import places_to_stop, stopping, way_to_stop
from hybridkin.ik.obstacles import distances
from hybridkin.ik.tasks import Task

BodyPoints: TypeAlias = "int | Sequence[tuple[float, float]] | None"

_SPACING = 1.5  # of two points in radii of the body: their balls are 25 % larger than the body
_MOST_POINTS = 24
_TOUCHING = 1e-4  # a gap that stops the body [m]
_AROUND = 4  # rounds that bring a configuration out of obstacles
_AROUND_POINT = 30  # and a point


@dataclass(frozen=True, eq=False, repr=False)
class KeptClear(Portable):
    """Points of the body, and what they keep clear of; without points everything is free.

    Attributes
    ----------
    models : tuple of P ForwardModels
        Models of the points (3 outputs each), the last one of the tip.
    body : tuple of ForwardModels
        The same points from fewer models: those of the mechanical model at once, then the tip.
    radii : Tensor of shape (P,)
        Radii of the balls that cover the body [m].
    along : Tensor of shape (P,)
        Length of the backbone up to the points [m].
    keep : Tensor of shape (P,)
        The least distances of the points to obstacles [m].
    base : Tensor of shape (3,)
        Where the base of the robot is [m].
    scene : Tensor of shape (K, IK_OBSTACLE)
        The obstacles.
    """

    models: tuple[ForwardModel, ...]
    body: tuple[ForwardModel, ...]
    radii: Tensor
    along: Tensor
    keep: Tensor
    base: Tensor
    scene: Tensor

    def __bool__(self) -> bool:
        """Return whether there is anything to keep clear of."""
        return len(self.models) > 0

    @property
    def meeting(self) -> Tensor:
        """The pairs of points (2, p) that can meet: farther along the body than a half circle.

        Points nearer than that would meet only where the backbone bends more sharply than its body
        allows.
        """
        reach = self.radii[:, None] + self.radii
        apart = self.along - self.along[:, None]
        return (apart > 0.5 * math.pi * reach).nonzero().T

    def write_plan(self, plan: Plan, n: int) -> int:
        """Write the node of the body of a robot of n actuators, and return its place; -1: none."""
        if not self:
            return -1
        places = [plan.node_of(model.stored()) for model in self.models]
        first, second = self.meeting
        reach = self.radii[first] + self.radii[second]
        numbers = [as_array(part) for part in (self.keep, reach, self.along, self.base)]
        pairs = [*first.tolist(), *second.tolist()]
        return plan.node("body", n, 3, numbers, len(places), len(first), *places, *pairs)

    def points(self, q: Tensor) -> Tensor:
        """Return the points (N, P, 3) at q (N, n) [m]."""
        points = torch.cat([model(q) for model in self.body], dim=-1)
        return points.unflatten(-1, (-1, 3)).to(q)

    def points_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the points (N, P, 3) at q (N, n) [m], and their derivatives (N, P, 3, n)."""
        pairs = [model.forward_and_jacobian(q) for model in self.body]
        x = torch.cat([x for x, _ in pairs], dim=-1)
        J = torch.cat([J for _, J in pairs], dim=-2)
        return x.unflatten(-1, (-1, 3)).to(q), J.unflatten(-2, (-1, 3)).to(q)

    def gaps(self, x: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
        """Return the gaps (N, p) of points (N, P, 3) [m], and the directions (N, p, 3) out of them.

        The pairs of every point and every obstacle of a scene come first, then the pairs of points.
        The gap is infinite where no configuration makes it positive: the robot is mounted there.
        """
        scene = moved(scene, x)
        keep = moved(self.keep, x)[:, None]
        distance, normal = distances(x, scene)
        free = torch.where(self._is_never_free(scene), math.inf, distance - keep).flatten(1)
        first, second = self.meeting.to(x.device)
        apart = x[:, second] - x[:, first]
        size = apart.norm(dim=-1)
        away = apart / torch.where(size > 0.0, size, 1.0)[..., None]
        between = size - (self.radii[first] + self.radii[second]).to(x)
        gaps = torch.cat([free, between], dim=1)
        return gaps, torch.cat([normal.flatten(1, 2), away], dim=1)

    def _is_never_free(self, scene: Tensor) -> Tensor:
        """Return which points (P, K) no configuration frees: the robot is mounted there."""
        at_base, _ = distances(moved(self.base, scene), scene)
        return moved(self.keep, scene)[:, None] > at_base + moved(self.along, scene)[:, None]

    def distances(self, q: Tensor, scene: Tensor) -> Tensor:
        """Return the distances (N, K) of the body at q (N, n) to every obstacle of a scene [m].

        Those of points that are never free do not count.
        """
        scene = moved(scene, q)
        distance, _ = distances(self.points(q), scene)
        distance = distance - moved(self.radii, q)[:, None]
        return torch.where(self._is_never_free(scene), math.inf, distance).amin(1)

    def relative(self, rows: Tensor, n_obstacles: int) -> Tensor:
        """Return values of points (N, P, ...) for the pairs of `gaps`, (N, p, ...)."""
        first, second = self.meeting.to(rows.device)
        of_obstacles = rows.repeat_interleave(n_obstacles, 1)
        return torch.cat([of_obstacles, rows[:, second] - rows[:, first]], dim=1)

    def smallest(self, q: Tensor, scene: Tensor) -> Tensor:
        """Return the smallest gaps (N,) to a scene at q (N, n) [m]; infinite without any."""
        if not self or len(q) == 0:
            return torch.full_like(q[:, 0], math.inf)
        gaps, _ = self.gaps(self.points(q), scene)
        none = torch.full_like(gaps[:, :1], math.inf)
        return torch.cat([gaps, none], dim=1).amin(-1)

    def is_inside(self, q: Tensor, scene: Tensor) -> Tensor:
        """Return whether the body is in an obstacle of a scene, or in itself, bool (N,)."""
        return self.smallest(q, scene) < -IK_INSIDE_OBSTACLE

    def stops(self, q: Tensor, way: Tensor) -> Tensor:
        """Return whether a body at q touches what is in its way (N, n), bool (N,)."""
        if not self:
            return torch.zeros_like(q[:, 0], dtype=torch.bool)
        near = self.near(q, torch.full_like(q, math.inf), self.scene)
        towards = apply_rows(near.A, way) > 0.0
        return (towards & (near.gap <= _TOUCHING)).any(-1)

    def near(self, q: Tensor, change: Tensor, scene: Tensor) -> Near:
        """Return what is near the body at q (N, n); steps can change by `change` per period."""
        x, J = self.points_and_jacobian(q)
        gap, normal = self.gaps(x, scene)
        A = -(normal[:, :, None] @ self.relative(J, len(scene)))[:, :, 0]
        b = IK_NEARER * gap
        brake = torch.where(A == 0.0, 0.0, A.abs() * change[:, None]).sum(-1)
        b = torch.where(gap > 0.0, torch.minimum(b, stopping(gap, brake)), b)
        return Near(self, q, x, gap, normal, A, b, len(scene))

    def freed(self, q: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
        """Return q (N, n) moved out of obstacles by short steps, within bounds of q.

        Rows that cannot be free stay in them.
        """
        if not self:
            return q
        for _ in range(_AROUND):
            inside = self.smallest(q, self.scene) < 0.0
            rows = inside.nonzero()[:, 0]
            if rows.numel() == 0:
                break
            q = q.index_put((rows,), self._freer(q[rows], lower[rows], upper[rows]))
        return q

    def _freer(self, q: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
        """Return the nearest configurations that are free to first order, within bounds of q."""
        near = self.near(q, torch.full_like(q, math.inf), self.scene)
        A, b = near.rows(near.gap)
        size = A.norm(dim=-1)
        size = torch.where(size > 0.0, size, 1.0)
        offset = b / size
        still = torch.zeros_like(q)
        within = Polyhedron(
            A[:, :0],
            b[:, :0],
            lower - q,
            upper - q,
            A / size[..., None],
            offset,
            offset.clamp_min(0.0),
        )
        way, _ = nearest(still, within)
        return torch.maximum(torch.minimum(q + way, upper), lower)

    def freed_tip(self, x: Tensor) -> Tensor:
        """Return points (N, 3) of the tip moved out of obstacles, the nearest side first."""
        keep = self.keep[-1].to(x)
        for _ in range(_AROUND_POINT):
            distance, normal = distances(x, self.scene.to(x))
            depth, which = (keep - distance).max(-1)
            if not (depth > 0.0).any():
                break
            out = normal[torch.arange(len(x), device=x.device), which]
            x = torch.where((depth > 0.0)[:, None], x + depth[:, None] * (1.0 + 1e-9) * out, x)
        return x


class Near(NamedTuple):
    """The gaps of the body at rows q (N, n), and one-sided limits of the step for each.

    Attributes
    ----------
    clear : KeptClear
        The body.
    q : Tensor of shape (N, n)
        Configurations.
    x : Tensor of shape (N, P, 3)
        Points of the body [m].
    gap, normal : Tensor of shape (N, p) and (N, p, 3)
        Gaps, and the directions out of them.
    A, b : Tensor of shape (N, p, n) and (N, p)
        To first order ``A dq`` is what a step takes of the gaps; it must be at most b.
    n_obstacles : int
        Number of obstacles.
    """

    clear: KeptClear
    q: Tensor
    x: Tensor
    gap: Tensor
    normal: Tensor
    A: Tensor
    b: Tensor
    n_obstacles: int

    def rows(self, b: Tensor) -> tuple[Tensor, Tensor]:
        """Return the rows A (N, k, n), and of b (N, p) their limits, of the smallest gaps first."""
        count = min(IK_PAIRS_MOST, self.gap.shape[1])
        # Limits that have been tightened come before others.
        order = torch.where(b < self.b, -math.inf, self.gap)
        chosen = order.topk(count, largest=False).indices
        by_gap = self.gap.gather(1, chosen).argsort(dim=-1, stable=True)
        chosen = chosen.gather(1, by_gap)
        index = chosen[..., None].expand(-1, -1, self.q.shape[1])
        return self.A.gather(1, index), b.gather(1, chosen)

    def taken(self, way: Tensor) -> Tensor:
        """Return what ways of the actuators (N, n) really take of the gaps, (N, p) [m]."""
        moved = self.clear.points(self.q + way) - self.x
        along = self.normal * self.clear.relative(moved, self.n_obstacles)
        return -along.sum(-1)

    def farthest(self, dq: Tensor, change: Tensor) -> tuple[Tensor, Tensor]:
        """Return the first ways (N, n) after steps dq that take too much, and what they take.

        The way to a stop comes first. Where gaps are not far larger than this way, it is bent: then
        follow the step alone, and parts of the way to a stop.
        """
        way = dq + way_to_stop(dq, change)
        taken = self.taken(way)
        longest = apply_rows(self.A.abs(), way.abs())
        watched = ~(2.0 * longest < self.gap).all(-1)
        for periods in (0.0, *places_to_stop()):
            place = dq + way_to_stop(dq, change, periods)
            goes_on = watched & ~self.is_broken(taken).any(-1) & (place != way).any(-1)
            if not goes_on.any():
                break
            goes_on = goes_on[:, None]
            taken = torch.where(goes_on, self.taken(place), taken)
            way = torch.where(goes_on, place, way)
        return way, taken

    def is_broken(self, taken: Tensor) -> Tensor:
        """Return whether ways take more of gaps than there is, by more than rounding, (N, p)."""
        size = self.x.abs().flatten(1).amax(-1, keepdim=True)
        rounding = 32.0 * torch.finfo(size.dtype).eps * size
        return ~(taken <= self.gap.clamp_min(0.0) + rounding)

    def tightened(self, b: Tensor, dq: Tensor, way: Tensor, taken: Tensor) -> tuple[Tensor, Tensor]:
        """Return tighter limits b (N, p), and which part of the step to try, (N, 1).

        Steps dq, on the ways to a stop, have taken too much of some gaps. What the curvature of the
        model took is to be at most IK_BENT_WAY of the way; it shrinks with the square of the step.
        """
        broken = self.is_broken(taken)
        bent = taken - apply_rows(self.A, way)
        longest = self.A.norm(dim=-1) * way.norm(dim=-1, keepdim=True)
        straight = torch.where(broken & (bent > 0.0), IK_BENT_WAY * longest / bent, 1.0)
        part = straight.amin(-1, keepdim=True).clamp_max(1.0)
        beyond = (taken - apply_rows(self.A, dq)) * part.square()
        less = IK_NEARER * self.gap.clamp_min(0.0) - beyond
        return torch.where(broken & (less < b), less, b), part

    def is_active(self, dq: Tensor) -> Tensor:
        """Return whether steps are at a limit of the gaps, bool (N,)."""
        used = apply_rows(self.A, dq)
        size = apply_rows(self.A.abs(), dq.abs()) + self.b.abs()
        rounding = 64.0 * torch.finfo(dq.dtype).eps * size
        return (used >= self.b - rounding).any(-1)


def nowhere() -> KeptClear:
    """Return a body that keeps clear of nothing."""
    none = torch.empty(0, dtype=torch.float64, device="cpu")
    scene = torch.empty(0, IK_OBSTACLE, dtype=torch.float64, device="cpu")
    return KeptClear((), (), none, none, none, none, scene)


def kept_clear(
    task: Task, scene: Tensor, clearance: float, wanted: BodyPoints, longest: Tensor
) -> KeptClear:
    """Return the body of the robot of a task, and the obstacles that it keeps clear of.

    Parameters
    ----------
    task : Task
        The task; its first model gives the body, and the tip.
    scene : Tensor of shape (K, IK_OBSTACLE)
        The obstacles.
    clearance : float
        Least distance between body and obstacles [m].
    wanted : int, sequence of (place, radius), or None
        Number of points, or their places [segments from the base] and radii [m].
    longest : Tensor of shape () or (n,)
        Configuration in which the robot is longest.
    """
    if len(scene) == 0 and wanted is None:
        return nowhere()
    model = task.models[0]
    robot = model.robot
    q = longest.expand(robot.n_actuators)
    lengths = robot.body_lengths(q)
    if wanted is None or isinstance(wanted, int):
        along, radii = _evenly(lengths, robot.body_radii, wanted)
        models = [robot.at_length(length, q) for length in along[:-1].tolist()]
    else:
        places = [place for place, _ in wanted]
        radii = torch.tensor([radius for _, radius in wanted], dtype=torch.float64, device="cpu")
        along = torch.stack([_length_up_to(lengths, place) for place in places])
        models = [robot.with_tip(place) for place in places[:-1]]
    tip = _end_of(model, len(lengths) - 1)
    body = (robot.joined(models), tip) if models else (tip,)
    keep = radii + clearance + _expected_error(task)
    base = robot.origin.detach().cpu().double()
    return KeptClear((*models, tip), body, radii, along, keep, base, scene)


def _end_of(model: ForwardModel, n_segments: int) -> ForwardModel:
    """Return the model of the robot's end: of the tip, unless that is another point of the body."""
    tip = model.tip_model
    place = max((at for at, *_ in tip.markers), default=float(n_segments))
    if place < n_segments:
        return model.robot.with_tip(n_segments)
    return tip


def body_points(value: BodyPoints) -> BodyPoints:
    """Return an argument `body_points`, checked."""
    if value is None or isinstance(value, int):
        return value if value is None else whole(value, "body_points", 1, 1000)
    need = (
        "`body_points` must be a number of points, or pairs (place, radius): the place in segments "
        "from the base, increasing, the last one the tip, and a radius [m] that is not negative"
    )
    pairs: list[tuple[float, float]] = []
    before = 0.0
    try:
        for place, radius in value:
            pairs.append((number(place, "body_points"), number(radius, "body_points")))
    except TypeError as error:
        raise TypeError(f"{need}, got {value!r:.200}.") from error
    for place, radius in pairs:
        if not (before < place < math.inf and 0.0 <= radius < math.inf):
            raise ValueError(f"{need}, got {value!r:.200}.")
        before = place
    if not pairs:
        raise ValueError(f"{need}, got none.")
    return pairs


def _evenly(lengths: Tensor, radius: Tensor, wanted: int | None) -> tuple[Tensor, Tensor]:
    """Return how far along the body even points are, and radii of balls that cover it."""
    if not torch.isfinite(radius).all():
        raise ValueError(
            "`body_points` must give the radii of the body, which this robot does not know: pairs "
            "(place, radius), e.g. [(1.0, 0.05), (2.0, 0.04)], places in segments from the base, "
            "radii in metres."
        )
    length = float(lengths[-1])
    if not 0.0 < length < math.inf:
        raise ValueError(
            f"`q_max` must be finite, so that the length of the body is known, which is {length} m."
        )
    count = wanted
    if count is None:
        count = min(_MOST_POINTS, math.ceil(length / (_SPACING * float(radius.min())) + 0.5))
    spacing = length / (count - 0.5)
    along = spacing * (0.5 + torch.arange(count, dtype=torch.float64, device="cpu"))
    below = along[:, None] - 0.5 * spacing
    above = along[:, None] + 0.5 * spacing
    beside = (lengths[:-1] < above) & (lengths[1:] > below)
    thickest = torch.where(beside, radius.double(), 0.0).amax(-1)
    return along, torch.hypot(thickest, torch.full_like(along, 0.5 * spacing))


def _length_up_to(lengths: Tensor, place: float) -> Tensor:
    """Return the length of the body up to a place, in segments."""
    last = len(lengths) - 2
    segment = min(int(place), last)
    return torch.lerp(lengths[segment], lengths[segment + 1], min(place - segment, 1.0))


def _expected_error(task: Task) -> float:
    """Return the expected error of the tip [m], where the estimator of the model knows it."""
    radius = getattr(task.estimator, "radius_", None)
    if radius is None or not math.isfinite(radius.inside):
        return 0.0
    return float(radius.inside)
