"""Small models around other models: a moved base, shifted zeros, markers, poses."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from typing_extensions import Self

from hybridkin._core.actuation import Actuation
from hybridkin._core.arrays import as_array
from hybridkin._core.blocks import check_vectors, in_blocks
from hybridkin._core.model import ForwardModel, PoseModel
from hybridkin._core.plan import CHAINS, NoKernel, Plan
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin._core.stored import Layout, Stored
from hybridkin.chains.chain import Chain
from hybridkin.chains.markers import MarkedChain
from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid._guards import GroupDistance, Plane
from hybridkin.hybrid._module import Hybrid, HybridModule, TipCorrection
from hybridkin.learning.regressor_modules import AffineModule

# Entries of a chain's geometry that are zeros of its actuators.
_ZEROS = ("actuator_zeros", "joint_zeros", "tendon_zeros")


class Wrapped(PoseModel):
    """A model that stands before or after another one, of positions or of poses.

    Parameters
    ----------
    model : ForwardModel
        The other model.
    """

    model: ForwardModel

    def __init__(self, model: ForwardModel) -> None:
        super().__init__()
        self.model = model
        self.n_actuators = model.n_actuators
        self.n_outputs = model.n_outputs

    @property
    def has_pose(self) -> bool:
        """Whether the other model has poses."""
        return self.model.has_pose

    @property
    def robot(self) -> ForwardModel:
        """The model with the geometry, changed like this one."""
        robot = self.model.robot
        return self if robot is self.model else self.around(robot)

    @property
    def tip_model(self) -> ForwardModel:
        """The model of the tip alone, changed like this one."""
        tip = self.model.tip_model
        return self if tip is self.model else self.around(tip)

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log."""
        return self.model.plane

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q."""
        return self.model.hysteresis

    @property
    def without_hysteresis(self) -> ForwardModel:
        """The model of actuators that do what they are commanded."""
        return self.around(self.model.without_hysteresis)

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model, changed like this one."""
        raise NotImplementedError

    def forward(self, q: Tensor) -> Tensor:
        """Return the outputs of the other model for what it gets, shape (..., m) [m]."""
        return self.model(self._inner(q))

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n)."""
        return self.model.forward_and_jacobian(self._inner(q))

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        return posed(self.model).pose_and_jacobian(self._inner(q))

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance from the training rows of what the other model gets, (...)."""
        return self.model.domain_distance(self._inner(q))

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the other model has a shape, (...), bool."""
        return self.model.has_shape(self._inner(q))

    def _inner(self, q: Tensor) -> Tensor:
        """Return what the other model gets for q."""
        return q


def _place_within(plan: Plan, stored: Stored, *before: str) -> int:
    """Return the place of the model within; kernels know no model of the kinds `before` there."""
    place = plan.node_of(stored.part("model"))
    if plan.kind(place) in before:
        raise NoKernel(f"a model {plan.kind(place)} within one {stored.kind}")
    return place


def _write_shifted(plan: Plan, stored: Stored) -> int:
    model = _place_within(plan, stored, "shifted")
    n, m = plan.lengths(model)
    return plan.node("shifted", n, m, [stored.array("shift", (n,))], model)


class Shifted(Wrapped):
    """The model f(q + shift) of a robot whose actuator zeros have shifted.

    Parameters
    ----------
    model : ForwardModel
        f.
    shift : Tensor of shape (n,)
        Shift of the zeros [unit of q].
    """

    layout = Layout(
        "shifted", {"shift": "n"}, parts=("model",), write_plan=_write_shifted
    )

    def __init__(self, model: ForwardModel, shift: Tensor) -> None:
        super().__init__(model)
        self.register_buffer("shift", shift)
        self.n_actuators = len(shift)

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, where it lies after the shift."""
        plane = self.model.plane
        return None if plane is None else (plane[0] - self.shift, plane[1])

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model after the same shift."""
        return shifted(model, self.shift)

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return by how much targets are out of reach of f, shape (...) [m]."""
        return self.model.misses(x, largest + self.shift.abs().to(largest.device))

    def _inner(self, q: Tensor) -> Tensor:
        check_vectors(
            q, len(self.shift), "q", f"this robot has {len(self.shift)} actuators"
        )
        return q + self.shift.to(q)


def _write_moved(plan: Plan, stored: Stored) -> int:
    model = _place_within(plan, stored, "shifted", "moved")
    n, m = plan.lengths(model)
    motion = stored.array("motion", (4, 4))
    return plan.node("moved", n, m, [motion[:3, :3], motion[:3, 3]], model)


class Moved(Wrapped):
    """The model T f(q) of a robot whose base has moved.

    Parameters
    ----------
    model : ForwardModel
        f, whose outputs are one or several tips in space.
    motion : Tensor of shape (4, 4)
        T, the motion of the base in the measuring frame.
    """

    layout = Layout(
        "moved", {"motion": "44"}, parts=("model",), write_plan=_write_moved
    )

    def __init__(self, model: ForwardModel, motion: Tensor) -> None:
        super().__init__(model)
        self.register_buffer("motion", motion)

    def around(self, model: ForwardModel) -> ForwardModel:
        """Return another model after the same motion."""
        return moved(model, self.motion)

    def forward(self, q: Tensor) -> Tensor:
        """Return T f(q), shape (..., m) [m]."""
        return moved_points(super().forward(q), self.motion)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return T f(q) (..., m) and its derivative (..., m, n)."""
        x, J = super().forward_and_jacobian(q)
        return moved_points(x, self.motion), _turned(J.mT, self.motion).mT

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = super().pose_and_jacobian(q)
        return self.motion.to(T) @ T, _turned(J.mT, self.motion).mT

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return by how much targets before T are out of reach of f, shape (...) [m]."""
        before = moved_points(x, torch.linalg.inv(self.motion))
        return self.model.misses(before, largest)


def shifted(model: ForwardModel, shift: Tensor) -> ForwardModel:
    """Return a model after a shift (n,) of its actuator zeros; a chain that has zeros stays one."""
    if not shift.any():
        return model
    if not isinstance(model, Chain):
        return Shifted(model, shift)
    geometry = model.geometry()
    zeros = {name: geometry[name] for name in _ZEROS if name in geometry}
    if not zeros:
        return Shifted(model, shift)
    if "tendon_zeros" in zeros:
        shift = geometry.get("gains", 1.0) * shift
    changed = {name: value - shift.to(value) for name, value in zeros.items()}
    return model.with_geometry(**changed)


def moved(model: ForwardModel, motion: Tensor) -> ForwardModel:
    """Return a model after a motion (4, 4) of its base; a chain stays one."""
    at_rest = torch.eye(4, dtype=motion.dtype, device=motion.device)
    if torch.equal(motion, at_rest):
        return model
    if isinstance(model, Chain):
        return model.with_geometry(base=motion.to(model.base) @ model.base)
    return Moved(model, motion)


def moved_points(x: Tensor, motion: Tensor) -> Tensor:
    """Return points (..., 3), or several of them in (..., m), moved by a motion (4, 4)."""
    return _turned(x, motion) + motion[:3, 3].to(x).repeat(x.shape[-1] // 3)


def _turned(v: Tensor, motion: Tensor) -> Tensor:
    """Return vectors (..., 3), or several of them in (..., m), rotated by a motion (4, 4)."""
    return (v.unflatten(-1, (-1, 3)) @ motion[:3, :3].to(v).mT).flatten(-2)


def _write_stacked(plan: Plan, stored: Stored) -> int:
    return plan.stack(stored.part("tips").parts.values())


class Stacked(Hybrid):
    """The hybrids of all markers of a chain as one torch module q (..., n) -> x (..., 3 K).

    A row is in the domain if it is in the domains of all markers. The error weight is the least.

    Parameters
    ----------
    mechanical : MarkedChain or None
        The chain of all markers; it follows from the others.
    tips : sequence of HybridModule
        The hybrid of every marker, on the chain of that marker alone.
    """

    layout = Layout(
        "stacked", {}, parts=("mechanical", "tips"), write_plan=_write_stacked
    )
    computed = ("mechanical",)

    def __init__(self, mechanical: object, tips: Sequence[Hybrid]) -> None:
        super().__init__()
        self.tips = nn.ModuleList(tips)
        self.n_actuators = tips[0].n_actuators
        self.n_outputs = 3 * len(tips)

    @property
    def mechanical(self) -> MarkedChain | StructuralChain | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The chain of all markers, with the geometry of the tip's."""
        chain = self.tip_model.mechanical
        if not isinstance(chain, (MarkedChain, StructuralChain)):
            return None
        chains = cast("list[MarkedChain]", [tip.mechanical for tip in self._tips()])
        return chain._marked([chain.markers[-1] for chain in chains])

    def stored(self) -> Stored:
        """Return the description of the model, with the chain of all markers."""
        stored = super().stored()
        if self.mechanical is not None:
            stored.parts["mechanical"] = self.mechanical.stored()
        return stored

    @property
    def tip_model(self) -> Hybrid:
        """The hybrid of the last marker alone."""
        return self._tips()[-1]

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction of the tip acts inside the robot."""
        return self.tip_model.corrects_inside

    @property
    def tested(self) -> GroupDistance | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Distance up to which held-out groups have tested the model of the tip."""
        return self.tip_model.tested

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, which is that of the tip."""
        return self.tip_model.plane

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return the largest distance by which a marker's target is out of its reach (...) [m]."""
        targets = x.unflatten(-1, (-1, 3)).unbind(-2)
        missed = [
            tip.misses(x, largest) for tip, x in zip(self._tips(), targets, strict=True)
        ]
        return torch.stack(missed).amax(0)

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q, which is that of the tip."""
        return self.tip_model.hysteresis

    def behind(self, hysteresis: Actuation) -> Self:
        """Return the same model with another hysteresis; this model does not change."""
        tips = [tip.behind(hysteresis) for tip in self._tips()]
        return type(self)(self.mechanical, tips)

    def with_drift(self, drift: AffineModule) -> Self:
        """Return the same model with another drift; this model does not change."""
        tips = []
        for k, tip in enumerate(self._tips()):
            rows = slice(3 * k, 3 * k + 3)
            part = AffineModule(drift.coef[rows], drift.bias[rows])
            tips.append(tip.with_drift(part))
        return type(self)(self.mechanical, tips)

    def forward(self, q: Tensor) -> Tensor:
        """Return the positions of all markers, shape (..., 3 K) [m]."""
        return torch.cat([tip(q) for tip in self._tips()], dim=-1)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return the positions of all markers (..., 3 K) and their derivative (..., 3 K, n)."""
        positions = []
        jacobians = []
        for tip in self._tips():
            x, J = tip.forward_and_jacobian(q)
            positions.append(x)
            jacobians.append(J)
        return torch.cat(positions, dim=-1), torch.cat(jacobians, dim=-2)

    def error_part(self, q: Tensor) -> Tensor:
        """Return the learned parts of all markers, shape (..., 3 K) [m]."""
        parts = [tip.error_part(q).expand(*q.shape[:-1], 3) for tip in self._tips()]
        return torch.cat(parts, dim=-1)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the least error weight of a marker, shape (...)."""
        weights = [tip.error_weight(q) for tip in self._tips()]
        return torch.stack(weights).amin(0)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest distance from the training rows of a marker, shape (...)."""
        distances = [tip.domain_distance(q) for tip in self._tips()]
        return torch.stack(distances).amax(0)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the mechanical models of all markers have a shape, (...), bool."""
        return torch.stack([tip.has_shape(q) for tip in self._tips()]).all(0)

    def _tips(self) -> list[Hybrid]:
        return cast("list[Hybrid]", [*self.tips])


def _write_with_pose(plan: Plan, stored: Stored) -> int:
    chain = plan.node_of(stored.part("mechanical"))
    if plan.kind(chain) not in CHAINS:
        raise NoKernel(
            f"a {stored.part('mechanical').kind!r} has no kernel of its pose"
        )
    learned = plan.node_of(stored.part("learned"))
    radians = stored.derived["radians"]
    return plan.node("with_pose", plan.lengths(chain)[0], 3, [radians], chain, learned)


class WithPose(Hybrid, PoseModel):
    """Position and frame of the tip, p = p_mech + e_p and R = exp(e_r / reach) R_mech.

    As a torch module it maps q (..., n) to tip positions (..., 3), like any other. One radian
    counts as the `reach` of the chain, or as 1 m for other models. All vectors are in the
    measuring frame.

    Parameters
    ----------
    mechanical : PoseModel
        p_mech and R_mech.
    learned : HybridModule
        (e_p, e_r), six numbers in metres, without a mechanical model of its own. Its guards weight
        and shorten the six numbers together.
    """

    layout = Layout(
        "with_pose", {}, parts=("mechanical", "learned"), write_plan=_write_with_pose
    )
    mechanical: PoseModel  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, mechanical: PoseModel, learned: HybridModule) -> None:
        super().__init__()
        self.mechanical = mechanical  # pyright: ignore[reportIncompatibleVariableOverride]
        self.learned = learned
        self.n_actuators = learned.n_actuators

    @classmethod
    def of(
        cls,
        mechanical: PoseModel,
        corrections: Sequence[TipCorrection],
        weights: Tensor,
        tested: GroupDistance | None = None,
        log_plane: Plane | None = None,
    ) -> Self:
        """Return the model with these corrections, or with an error of zero if there are none."""
        if not corrections:
            nothing = AffineModule(weights.new_zeros(6, mechanical.n_actuators), 0.0)
            corrections = [TipCorrection(nothing)]
            weights = weights.new_ones(1)
        learned = HybridModule(None, corrections, weights, None, tested, log_plane)
        return cls(mechanical, learned)

    @property
    def tested(self) -> GroupDistance | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Distance up to which held-out groups have tested the model."""
        return self.learned.tested

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, see `Plane`."""
        return self.learned.plane

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return how much farther targets are than f reaches with the longest correction."""
        longest = torch.as_tensor(self.learned.longest_correction, device=x.device)
        return self.mechanical.misses(x, largest) - longest

    @property
    def hysteresis(self) -> Actuation:
        """The hysteresis between commands and q."""
        return self.learned.hysteresis

    def behind(self, hysteresis: Actuation) -> Self:
        """Return the same model with another hysteresis; this model does not change."""
        return type(self)(self.mechanical, self.learned.behind(hysteresis))

    def with_drift(self, drift: AffineModule) -> Self:
        """Return the same model with another drift; this model does not change."""
        return type(self)(self.mechanical, self.learned.with_drift(drift))

    def stored(self) -> Stored:
        """Return the description of the model, for kernels with the radians per metre of e_r."""
        stored = super().stored()
        stored.derived["radians"] = as_array(1.0 / reach_of(self.mechanical))
        return stored

    def forward(self, q: Tensor) -> Tensor:
        """Return tip positions (..., 3) [m]."""
        return self.mechanical(q) + self.learned(q)[..., :3]

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return tip positions (..., 3) and dx/dq (..., 3, n)."""
        x, J = self.mechanical.forward_and_jacobian(q)
        error, slope = self.learned.forward_and_jacobian(q)
        return x + error[..., :3], J + slope[..., :3, :]

    def error_part(self, q: Tensor) -> Tensor:
        """Return the errors of position and orientation, (e_p, e_r), shape (..., 6) [m]."""
        return self.learned(q)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the error weight t(q), shape (...)."""
        return self.learned.error_weight(q)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest distance from the training rows of guards and groups, (...)."""
        return self.learned.domain_distance(q)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the mechanical model has a shape, (...), bool."""
        return self.mechanical.has_shape(q)

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return in_blocks(self._pose, q)[0]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = in_blocks(self._pose_and_jacobian, q)
        return T, J

    def _pose(self, q: Tensor) -> tuple[Tensor]:
        error = self.learned(q)
        turn = rotation(error[:, 3:] / reach_of(self.mechanical).to(error))[0]
        return (_displaced(self.mechanical.pose(q), error[:, :3], turn),)

    def _pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self.mechanical.pose_and_jacobian(q)
        error, slope = self.learned.forward_and_jacobian(q)
        reach = reach_of(self.mechanical).to(error)
        turn, left = rotation(error[:, 3:] / reach)
        # exp(phi) R_mech has the angular velocity J_l(phi) dphi/dq + exp(phi) omega_mech.
        angular = left @ (slope[:, 3:] / reach) + turn @ J[:, 3:]
        J = torch.cat([J[:, :3] + slope[:, :3], angular], dim=-2)
        return _displaced(T, error[:, :3], turn), J


class PoseRows(ForwardModel):
    """A pose model as a module q (..., n) -> (..., 6), tip position [m] and rotation vector [rad].

    Rotation vectors are at most pi long. The Jacobian is the pose Jacobian: its angular rows give
    the angular velocity, not the derivative of the rotation vector, which jumps at half turns.

    Parameters
    ----------
    model : PoseModel
        The model of the pose.
    """

    n_outputs = 6

    def __init__(self, model: PoseModel) -> None:
        super().__init__()
        self.model = model
        self.n_actuators = model.n_actuators

    def forward(self, q: Tensor) -> Tensor:
        """Return positions and rotation vectors, shape (..., 6)."""
        return _rows(self.model.pose(q))

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return positions and rotation vectors (..., 6), and the pose Jacobian (..., 6, n)."""
        T, J = self.model.pose_and_jacobian(q)
        return _rows(T), J

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance from the training rows, shape (...)."""
        return self.model.domain_distance(q)

    def has_shape(self, q: Tensor) -> Tensor:
        """Return whether the model has a shape, (...), bool."""
        return self.model.has_shape(q)


def in_columns(model: ForwardModel, output: str) -> ForwardModel:
    """Return the model whose outputs are the columns of measured y, for this kind of `output`."""
    if output == "pose":
        return PoseRows(posed(model))
    return model


def posed(model: ForwardModel | None) -> PoseModel:
    """Return a model that is known to have poses."""
    assert isinstance(model, PoseModel)
    return model


def pose_errors(mechanical: PoseModel, q: Tensor, y: NDArray) -> NDArray:
    """Return the residuals (e_p, e_r) of poses y for a mechanical model, (N, 6) [m]."""
    if y.ndim != 2 or y.shape[1] != 6:
        raise ValueError(
            "`y` must have shape (N, 6) with output='pose', tip position [m] and rotation vector "
            f"[rad], got {y.shape}; for positions alone use output='position'."
        )
    with torch.no_grad():
        rows = PoseRows(mechanical)(q)
    error = pose_difference(rows, torch.from_numpy(y))
    error[:, 3:] *= reach_of(mechanical).to(error)
    return error.numpy()


def pose_difference(before: Tensor, after: Tensor) -> Tensor:
    """Return translation [m] and rotation vector [rad] between poses as rows (N, 6)."""
    turn = rotation(after[:, 3:])[0] @ rotation(before[:, 3:])[0].mT
    return torch.cat([after[:, :3] - before[:, :3], rotation_vector(turn)], dim=-1)


def reach_of(mechanical: PoseModel) -> Tensor:
    """Return the length [m] that a radian of orientation error counts as, shape ()."""
    if isinstance(mechanical, Chain):
        return mechanical.reach
    return torch.ones((), dtype=torch.float64, device="cpu")


def _displaced(T: Tensor, way: Tensor, turn: Tensor) -> Tensor:
    """Return poses (N, 4, 4) translated by ways (N, 3), with their frames rotated in place."""
    tip = T[:, :3, 3:] + way[..., None]
    upper = torch.cat([turn @ T[:, :3, :3], tip], dim=-1)
    return torch.cat([upper, T[:, 3:]], dim=-2)


def _rows(T: Tensor) -> Tensor:
    return torch.cat([T[..., :3, 3], rotation_vector(T[..., :3, :3])], dim=-1)
