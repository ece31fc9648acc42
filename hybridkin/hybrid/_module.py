"""Mechanical model and learned corrections as one torch module q -> x."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, cast

import torch
from torch import Tensor, nn
from typing_extensions import Self

from hybridkin._core.actuation import DIRECT, Actuation
from hybridkin._core.blocks import in_blocks
from hybridkin._core.chosen import chosen
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import CHAINS, NoKernel, Plan
from hybridkin._core.planes import PlaneOfQ
from hybridkin._core.portable import PortableModule
from hybridkin._core.stored import Layout, Stored
from hybridkin.hybrid._guards import GroupDistance, Guard, LeverageGuard, Plane
from hybridkin.learning.regressor_modules import AffineModule

_ROUNDING = 1e-7  # of weights that sum to one


class Inside:
    """The mechanical model at rows q (N, n): inner coordinates z (N, C) and dz/dq."""

    def __init__(self, mechanical: ForwardModel, q: Tensor) -> None:
        self.mechanical = mechanical
        self.z, self.slope = mechanical.coordinates(q)
        # Computed once for all corrections. Not by cached_property, which torch cannot compile.
        self._x: Tensor | None = None
        self._x_and_jacobian: tuple[Tensor, Tensor] | None = None

    @property
    def x(self) -> Tensor:
        """The tip f(q) = F(z), (N, m)."""
        if self._x is None:
            self._x = self.mechanical.from_coordinates(self.z)
        return self._x

    @property
    def x_and_jacobian(self) -> tuple[Tensor, Tensor]:
        """The tip f(q) (N, m), and df/dq (N, m, n)."""
        if self._x_and_jacobian is None:
            x, slope = self.mechanical.from_coordinates_and_jacobian(self.z)
            self._x_and_jacobian = x, slope @ self.slope
        return self._x_and_jacobian


class Fading(NamedTuple):
    """The weight g(q) of a correction (N, 1), and its slope dg/dq (N, 1, n)."""

    weight: Tensor
    slope: Tensor

    @classmethod
    def of(cls, guard: Guard, q: Tensor, distance: Tensor) -> Self | None:
        """Return the fading at rows q (N, n) at this distance (N,), None if all weights are 1."""
        fades = ~(distance <= guard.FULL)  # written so that NaN is included
        # Few rows fade, and their leverage takes as long as all of the rest.
        fading = chosen(fades, costly=True)
        if fading.is_empty:
            return None
        weight, slope = guard.weight_and_jacobian(fading.take(q))
        weights = fading.put(q.new_ones(q.shape[0], 1), weight)
        slopes = fading.put(q.new_zeros(q.shape[0], 1, q.shape[1]), slope)
        return cls(weights, slopes)

    def times(self, x: Tensor, J: Tensor) -> tuple[Tensor, Tensor]:
        """Return the weight times x (N, m), and its derivative from J = dx/dq (N, m, n)."""
        return self.weight * x, self.weight[..., None] * J + x[..., None] * self.slope


class TipCorrection(PortableModule):
    """A learned correction at the tip, c(q) = eps(q).

    s(q) is c(q) times the weight g(q) of the guard, shortened if it is too long.

    Parameters
    ----------
    module : ForwardModel
        eps, q (..., n) -> (..., m) [m]: the torch module of a regressor, or a readout of features.
    guard : Guard or None
        Its weight and largest length. None: no limits.
    """

    layout = Layout("tip_correction", {}, parts=("module", "guard"))
    inside = False

    def __init__(self, module: ForwardModel, guard: Guard | None = None) -> None:
        super().__init__()
        self.module = module
        self.guard = guard

    def take_low_rank(self, q: Tensor) -> None:
        """Give the network and its guard a leverage of low rank, for training rows q (N, n)."""
        if isinstance(self.guard, LeverageGuard) and self.guard.model is self.module:
            self.guard = self.guard.of_low_rank(q)
            self.module = self.guard.model

    def value(self, q: Tensor, inside: Inside | None) -> Tensor:
        """Return c(q) at rows q (N, n), shape (N, m) [m]."""
        return self.module(q)

    def value_and_jacobian(self, q: Tensor, inside: Inside | None) -> tuple[Tensor, Tensor]:
        """Return c(q) (N, m) and dc/dq (N, m, n) at rows q (N, n)."""
        return self.module.forward_and_jacobian(q)

    def guarded_and_jacobian(
        self, q: Tensor, inside: Inside | None
    ) -> tuple[Tensor, Tensor, Fading | None]:
        """Return s (N, m) and ds/dq (N, m, n) at rows q (N, n), and the fading."""
        guard = self.guard
        if guard is None:
            return *self.value_and_jacobian(q, inside), None
        if isinstance(guard, LeverageGuard) and guard.model is self.module:
            # Value and leverage share the features, which halves the time.
            x, J, leverage = guard.model.forward_jacobian_and_leverage(q)
            distance = leverage / guard.limit.to(q)
        else:
            x, J = self.value_and_jacobian(q, inside)
            distance = guard.domain_distance(q)
        fading = Fading.of(guard, q, distance)
        if fading is not None:
            x, J = fading.times(x, J)
        return *guard.shortened_with_jacobian(x, J), fading


class InnerCorrection(TipCorrection):
    """A learned correction inside the robot, c(q) = F(z(q) + W phi(q)) - f(q); serial coupling.

    z and F are `coordinates` and `from_coordinates` of the mechanical model, so f(q) = F(z(q)).

    Parameters
    ----------
    module : ForwardModel
        W phi(q), the change of the inner coordinates [unit of z].
    guard : Guard or None
        Its weight and largest length. None: no limits.
    """

    layout = Layout("inner_correction", {}, parts=("module", "guard"))
    inside = True

    def value(self, q: Tensor, inside: Inside | None) -> Tensor:
        """Return F(z + W phi) - f at rows q (N, n), shape (N, m) [m]."""
        assert inside is not None
        moved = inside.mechanical.from_coordinates(inside.z + self.module(q))
        return moved - inside.x

    def value_and_jacobian(self, q: Tensor, inside: Inside | None) -> tuple[Tensor, Tensor]:
        """Return c(q) (N, m) and dc/dq (N, m, n) at rows q (N, n)."""
        assert inside is not None
        delta, turn = self.module.forward_and_jacobian(q)
        x, columns = inside.mechanical.from_coordinates_and_jacobian(inside.z + delta)
        before, J = inside.x_and_jacobian
        return x - before, columns @ (inside.slope + turn) - J


class Hybrid(ForwardModel):
    """A mechanical model f plus what was learned of its residual, as it was fitted.

    Attributes
    ----------
    mechanical : ForwardModel or None
        f; None: zero.
    tested : GroupDistance or None
        Distance up to which held-out groups have tested the model.
    """

    mechanical: ForwardModel | None
    tested: GroupDistance | None

    @property
    def robot(self) -> ForwardModel:
        """The robot of the mechanical model, or the module itself without one."""
        return self if self.mechanical is None else self.mechanical.robot

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction acts inside the robot, see `InnerCorrection`."""
        return False

    def with_drift(self, drift: AffineModule) -> Self:
        """Return the same model with another drift; this model does not change."""
        raise NotImplementedError

    def behind(self, hysteresis: Actuation) -> Self:
        """Return the same model with another hysteresis; this model does not change."""
        raise NotImplementedError

    @property
    def without_hysteresis(self) -> Self:
        """The model of actuators that do what they are commanded."""
        return self.behind(DIRECT)

    def error_part(self, q: Tensor) -> Tensor:
        """Return what was learned, corrections and drift, in the form of the residuals [m]."""
        raise NotImplementedError

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the weight of the learned part, shape (...)."""
        raise NotImplementedError


def _write_plan(plan: Plan, stored: Stored) -> int:
    """Write the node of a hybrid: places of its parts, and for each correction three entries."""

    def place_of(name: str) -> int:
        return plan.node_of(stored.part(name)) if name in stored.parts else -1

    base = place_of("mechanical")
    drift = place_of("drift")
    tested = place_of("tested")
    if base >= 0 and plan.kind(base) not in CHAINS:
        raise NoKernel(f"the mechanical part {stored.part('mechanical').kind!r} is not a chain")
    entries = []
    acts_inside = []
    for correction in stored.part("corrections").parts.values():
        acts_inside.append(correction.kind == "inner_correction")
        entries += [acts_inside[-1], *_places_of(plan, correction)]
    weights = stored.array("weights")
    left = 1.0 - weights[acts_inside].sum()  # weight of f beside inner corrections
    numbers = [weights, [left * (abs(left) > _ROUNDING), any(acts_inside)]]
    n, m = plan.lengths(base if base >= 0 else entries[1])
    return plan.node("hybrid", n, m, numbers, base, drift, tested, len(weights), *entries)


def _places_of(plan: Plan, correction: Stored) -> tuple[int, int]:
    """Return the places of the regressor of a correction and of its guard; -1: no guard."""
    regressor = correction.part("module")
    if "guard" not in correction.parts:
        return plan.node_of(regressor), -1
    guard = correction.part("guard")
    place = plan.node_of(guard)
    if [_content(part) for part in guard.parts.values()] == [_content(regressor)]:
        return plan.entry(place, 0), place  # value and leverage share the features
    return plan.node_of(regressor), place


def _content(stored: Stored) -> tuple:
    """Return a tuple that is equal for equal descriptions without parts."""
    arrays = {name: array.tobytes() for name, array in stored.arrays.items()}
    return stored.kind, stored.settings, arrays


class HybridModule(Hybrid):
    """The sum x = f(q) + sum_k w_k s_k(q) + t(q) d(q) as a torch module q (..., n) -> x (..., m).

    f is the mechanical model. s_k is a learned correction c_k times the weight g_k of its guard,
    shortened if it is too long. d is a drift, weighted by the error weight
    t(q) = 1 - sum_k w_k (1 - g_k(q)). f is evaluated once for any number of corrections.

    A plain hybrid has one correction of weight 1, a blend has several. Their weights sum to less
    than 1 if the mechanical model alone is part of the blend.

    Parameters
    ----------
    mechanical : ForwardModel or None
        f; None: zero.
    corrections : sequence of TipCorrection or InnerCorrection
        c_k with their guards.
    weights : Tensor of shape (K,)
        w_k.
    drift : AffineModule or None
        d, the change of the robot since the fit.
    tested : GroupDistance or None
        Distance up to which held-out groups have tested the corrections, if the rows have groups.
    log_plane : Plane or None
        The plane of q to keep to, if the rows lie in one.
    hysteresis : Hysteresis
        What is between commands and q. It is no part of the state: an estimator stores it.
    """

    layout = Layout(
        "hybrid_module",
        {"weights": "k"},
        parts=("mechanical", "corrections", "drift", "tested", "log_plane"),
        write_plan=_write_plan,
    )

    def __init__(
        self,
        mechanical: ForwardModel | None,
        corrections: Sequence[TipCorrection],
        weights: Tensor,
        drift: AffineModule | None = None,
        tested: GroupDistance | None = None,
        log_plane: Plane | None = None,
        hysteresis: Actuation = DIRECT,
    ) -> None:
        super().__init__()
        total = float(weights.sum())
        if not (total <= 1.0 + _ROUNDING and bool((weights >= 0.0).all())):
            raise ValueError(
                f"`weights` must be zero or more and sum to at most 1, got {weights.tolist()}."
            )
        if len(weights) != len(corrections):
            raise ValueError(
                f"`weights` must hold one number for each of {len(corrections)} corrections, got "
                f"{len(weights)}."
            )
        self.mechanical = mechanical
        self.corrections = nn.ModuleList(corrections)
        self.register_buffer("weights", weights)
        self.drift = drift
        self.tested = tested
        self.log_plane = log_plane
        self._hysteresis = hysteresis
        sized = corrections[0].module if mechanical is None else mechanical
        self.n_actuators = sized.n_actuators
        self.n_outputs = sized.n_outputs

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction acts inside the robot: an `InnerCorrection`, or its structure."""
        mechanical = self.mechanical
        if mechanical is not None and mechanical.without_errors is not mechanical:
            return True
        return self._has_inner_corrections

    @property
    def plane(self) -> PlaneOfQ:
        """The plane of the log, see `Plane`."""
        if self.log_plane is None:
            return PlaneOfQ.whole()
        return PlaneOfQ(self.log_plane.point, self.log_plane.normals)

    @property
    def longest_correction(self) -> Tensor | float:
        """Upper bound of the distance from f(q) to x, infinite without guards, () [m]."""
        longest = 0.0 if self.drift is None else torch.inf
        for weight, correction in self._parts(self.weights):
            guard = correction.guard
            if guard is None:
                return torch.inf
            longest = longest + weight * guard.MOST * guard.largest
        return longest

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return how much farther targets are than f reaches with the longest correction."""
        if self.mechanical is None:
            return super().misses(x, largest)
        longest = torch.as_tensor(self.longest_correction, device=x.device)
        return self.mechanical.misses(x, largest) - longest

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q."""
        return self._hysteresis

    def with_drift(self, drift: AffineModule) -> Self:
        """Return the same model with another drift; this model does not change."""
        return self._with(drift, self._hysteresis)

    def behind(self, hysteresis: Actuation) -> Self:
        """Return the same model with another hysteresis; this model does not change."""
        return self._with(self.drift, hysteresis)

    def _with(self, drift: AffineModule | None, hysteresis: Actuation) -> Self:
        arguments = self.weights, drift, self.tested, self.log_plane, hysteresis
        return type(self)(self.mechanical, self._corrections, *arguments)

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m) [m]."""
        return in_blocks(self._forward, q)[0]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n), in closed form where the parts have one."""
        x, J = in_blocks(self._forward_and_jacobian, q)
        return x, J

    def error_part(self, q: Tensor) -> Tensor:
        """Return the sum of corrections and drift, which is added to f(q), (..., m) [m]."""
        return in_blocks(self._learned, q)[0]

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the error weight t(q), shape (...)."""
        return in_blocks(self._learned, q)[1][..., 0]

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest distance from the training rows of guards and groups, (...)."""
        return in_blocks(lambda rows: (self._distance(rows),), q)[0][..., 0]

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the mechanical model has a shape at q, shape (...), bool."""
        if self.mechanical is None:
            return super().has_shape(q)
        return self.mechanical.has_shape(q)

    @property
    def _has_inner_corrections(self) -> bool:
        return any(correction.inside for correction in self._corrections)

    @property
    def _corrections(self) -> list[TipCorrection]:
        return cast("list[TipCorrection]", [*self.corrections])

    def _parts(self, like: Tensor) -> list[tuple[Tensor, TipCorrection]]:
        """Return pairs of weight () and correction, weights on the device and in the dtype of q."""
        weights = self.weights.to(like).unbind()
        return [*zip(weights, self._corrections, strict=True)]

    def _inside(self, q: Tensor) -> Inside | None:
        """Return the mechanical model inside at rows q, where a correction acts there."""
        if self.mechanical is None or not self._has_inner_corrections:
            return None
        return Inside(self.mechanical, q)

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        inside = self._inside(q)
        learned, _ = self._learned(q, inside)
        if inside is not None:
            return (inside.x + learned,)
        if self.mechanical is not None:
            return (self.mechanical(q) + learned,)
        return (learned,)

    def _learned(self, q: Tensor, inside: Inside | None = None) -> tuple[Tensor, Tensor]:
        """Return the sum of corrections and drift at rows q, (N, m) [m], and t(q), (N, 1).

        The sum is zero (N, 1) without any.
        """
        if inside is None:
            inside = self._inside(q)
        trust = q.new_ones(q.shape[0], 1)
        total = q.new_zeros(q.shape[0], 1)
        for weight, correction in self._parts(q):
            value = correction.value(q, inside)
            guard = correction.guard
            if guard is not None:
                inside_domain = guard(q)
                value = guard.shortened(inside_domain * value)
                trust = trust - weight * (1.0 - inside_domain)
            total = total + weight * value
        if self.drift is not None:
            total = total + trust * self.drift(q)
        return total, trust

    def _distance(self, q: Tensor) -> Tensor:
        """Return the largest distance of any guard, and of the groups, at rows q, (N, 1)."""
        guards = [correction.guard for correction in self._corrections]
        farthest = q.new_zeros(q.shape[0])
        for measure in (*guards, self.tested):
            if measure is not None:
                farthest = torch.maximum(farthest, measure.domain_distance(q))
        return farthest[:, None]

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        inside = self._inside(q)
        total = None
        if inside is not None:
            total = inside.x_and_jacobian
        elif self.mechanical is not None:
            total = self.mechanical.forward_and_jacobian(q)
        trust = Fading(q.new_ones(1, 1), q.new_zeros(1, 1, 1))
        for weight, correction in self._parts(q):
            x, J, fading = correction.guarded_and_jacobian(q, inside)
            total = _plus(total, weight, x, J)
            if fading is not None:
                trust = Fading(
                    trust.weight + weight * (fading.weight - 1.0),
                    trust.slope + weight * fading.slope,
                )
        if self.drift is not None:
            whole = q.new_ones(())
            total = _plus(total, whole, *trust.times(*self.drift.forward_and_jacobian(q)))
        assert total is not None, "a hybrid needs a mechanical model or a correction"
        return total


def _plus(
    total: tuple[Tensor, Tensor] | None, weight: Tensor, x: Tensor, J: Tensor
) -> tuple[Tensor, Tensor]:
    """Return a sum plus the weighted x and J."""
    if total is None:
        return weight * x, weight * J
    return torch.addcmul(total[0], x, weight), torch.addcmul(total[1], J, weight)
