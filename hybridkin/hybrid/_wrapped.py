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
from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import ForwardModel, PoseModel
from hybridkin._core.plan import CHAINS, NoKernel, Plan
from hybridkin._core.planes import PlaneOfQ
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin._core.stored import Layout, Stored
from hybridkin.hybrid._guards import GroupDistance, Plane
from hybridkin.hybrid._module import Hybrid, HybridModule, TipCorrection
from hybridkin.learning.regressor_modules import AffineModule


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

    layout = Layout("stacked", {}, parts=("mechanical", "tips"), write_plan=_write_stacked)
    computed = ("mechanical",)

    def __init__(self, mechanical: object, tips: Sequence[Hybrid]) -> None:
        super().__init__()
        self.tips = nn.ModuleList(tips)
        self.n_actuators = tips[0].n_actuators
        self.n_outputs = 3 * len(tips)

    @property
    def mechanical(self) -> ForwardModel | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The chain of all markers, with the geometry of the tip's."""
        chain = self.tip_model.mechanical
        if chain is None:
            return None
        return chain.joined([tip.robot for tip in self._tips()])

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
    def plane(self) -> PlaneOfQ:
        """The plane of the log, which is that of the tip."""
        return self.tip_model.plane

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return the largest distance by which a marker's target is out of its reach (...) [m]."""
        targets = x.unflatten(-1, (-1, 3)).unbind(-2)
        missed = [tip.misses(x, largest) for tip, x in zip(self._tips(), targets, strict=True)]
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
        raise NoKernel(f"a {stored.part('mechanical').kind!r} has no kernel of its pose")
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

    layout = Layout("with_pose", {}, parts=("mechanical", "learned"), write_plan=_write_with_pose)
    mechanical: ForwardModel  # pyright: ignore[reportIncompatibleVariableOverride]

    def __init__(self, mechanical: ForwardModel, learned: HybridModule) -> None:
        super().__init__()
        self.mechanical = mechanical  # pyright: ignore[reportIncompatibleVariableOverride]
        self.learned = learned
        self.n_actuators = learned.n_actuators

    @classmethod
    def of(
        cls,
        mechanical: ForwardModel,
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
    def plane(self) -> PlaneOfQ:
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
        stored.derived["radians"] = as_array(1.0 / self.mechanical.reach)
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
        turn = rotation(error[:, 3:] / self.mechanical.reach.to(error))[0]
        return (_displaced(self.mechanical.pose(q), error[:, :3], turn),)

    def _pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self.mechanical.pose_and_jacobian(q)
        error, slope = self.learned.forward_and_jacobian(q)
        reach = self.mechanical.reach.to(error)
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

    def __init__(self, model: ForwardModel) -> None:
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
        return PoseRows(model)
    return model


def pose_errors(mechanical: ForwardModel, q: Tensor, y: NDArray) -> NDArray:
    """Return the residuals (e_p, e_r) of poses y for a mechanical model, (N, 6) [m]."""
    if y.ndim != 2 or y.shape[1] != 6:
        raise ValueError(
            "`y` must have shape (N, 6) with output='pose', tip position [m] and rotation vector "
            f"[rad], got {y.shape}; for positions alone use output='position'."
        )
    with torch.no_grad():
        rows = PoseRows(mechanical)(q)
    error = pose_difference(rows, torch.from_numpy(y))
    error[:, 3:] *= mechanical.reach.to(error)
    return error.numpy()


def pose_difference(before: Tensor, after: Tensor) -> Tensor:
    """Return translation [m] and rotation vector [rad] between poses as rows (N, 6)."""
    turn = rotation(after[:, 3:])[0] @ rotation(before[:, 3:])[0].mT
    return torch.cat([after[:, :3] - before[:, :3], rotation_vector(turn)], dim=-1)


def _displaced(T: Tensor, way: Tensor, turn: Tensor) -> Tensor:
    """Return poses (N, 4, 4) translated by ways (N, 3), with their frames rotated in place."""
    tip = T[:, :3, 3:] + way[..., None]
    upper = torch.cat([turn @ T[:, :3, :3], tip], dim=-1)
    return torch.cat([upper, T[:, 3:]], dim=-2)


def _rows(T: Tensor) -> Tensor:
    return torch.cat([T[..., :3, 3], rotation_vector(T[..., :3, :3])], dim=-1)
