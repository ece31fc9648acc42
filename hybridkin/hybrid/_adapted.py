"""A fitted hybrid for a robot that has changed: the base has moved, actuators have new zeros."""

from __future__ import annotations

import torch
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.blocks import check_vectors
from hybridkin._core.model import ForwardModel
from hybridkin._core.plan import Plan
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin._core.stored import Layout, Restore, Stored
from hybridkin.chains.chain import Chain
from hybridkin.hybrid._guards import GroupDistance
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._pose import PoseHybrid
from hybridkin.learning.regressor_modules import AffineModule


def _write_plan(plan: Plan, stored: Stored) -> int:
    fitted = plan.node_of(stored.part("fitted"))
    motion = stored.array("motion", (4, 4))
    n, m = plan.lengths(fitted)
    numbers = [stored.array("shift", (n,)), motion[:3, :3], motion[:3, 3]]
    return plan.node("adapted", n, m, numbers, fitted)


class AdaptedModel(Hybrid):
    """The model x = T f(q + shift) of a fitted hybrid f, with a rigid motion T of its outputs.

    The learned residual is evaluated at q + shift, in the frame before T.

    Parameters
    ----------
    fitted : Hybrid
        f, as it was fitted. If T is not the identity, its outputs are tips or poses in space.
    shift : Tensor of shape (n,)
        Shift of the actuator zeros [unit of q].
    motion : Tensor of shape (4, 4)
        T, the motion of the base in the measuring frame.
    """

    layout = Layout(
        "adapted_model",
        {"shift": "n", "motion": "44"},
        parts=("fitted",),
        write_plan=_write_plan,
    )
    fitted: Hybrid

    def __init__(self, fitted: Hybrid, shift: Tensor, motion: Tensor) -> None:
        super().__init__()
        self.fitted = fitted
        self.register_buffer("shift", shift)
        self.register_buffer("motion", motion)
        self.n_actuators = len(shift)
        self.n_outputs = fitted.n_outputs

    @classmethod
    def from_stored(cls, stored: Stored, restore: Restore) -> Self:
        """Return the model from its description; the arrays must fit the robot."""
        model = super().from_stored(stored, restore)
        try:
            _ = model.mechanical
        except RuntimeError as error:  # torch raises it for wrong sizes and types
            raise ValueError("`shift` and `motion` do not fit the robot") from error
        return model

    @property
    def mechanical(self) -> ForwardModel | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The mechanical model after the change: a chain if chains can have such zeros."""
        f = self.fitted.mechanical
        if f is None:
            return None
        if isinstance(f, Chain):
            geometry = f.geometry()
            zeros = {}
            if "actuator_zeros" in geometry:
                zeros["actuator_zeros"] = geometry["actuator_zeros"] - self.shift
            if "tendon_zeros" in geometry:
                pulled = geometry.get("gains", 1.0) * self.shift
                zeros["tendon_zeros"] = geometry["tendon_zeros"] - pulled
            if zeros or not self.shift.any():
                return f.with_geometry(base=self.motion @ geometry["base"], **zeros)
        return self.after_change(self.fitted.without_learned())

    @property
    def drift(self) -> AffineModule | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The drift, before the change."""
        return self.fitted.drift

    @property
    def tested(self) -> GroupDistance | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Distance of q + shift up to which held-out groups have tested the model."""
        return self.fitted.tested

    @property
    def corrects_inside(self) -> bool:
        """Whether a correction acts inside the robot, see `InnerCorrection`."""
        return self.fitted.corrects_inside

    @property
    def as_fitted(self) -> Hybrid:
        """The model of the fit."""
        return self.fitted

    @property
    def shift_of_zeros(self) -> Tensor:
        """Shift of the actuator zeros since the fit [unit of q]."""
        return self.shift

    @property
    def tip_model(self) -> Hybrid:
        """The model of the tip alone, after the change."""
        return self.after_change(self.fitted.tip_model)

    def after_change(self, fitted: Hybrid) -> Hybrid:
        """Return another hybrid after the same change."""
        return type(self)(fitted, self.shift, self.motion)

    def before(self, q: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return rows q (N, n) and y (N, m) as they were before the change."""
        return self._then(q), moved(y, torch.linalg.inv(self.motion))

    def forward(self, q: Tensor) -> Tensor:
        """Return x of shape (..., m) [m]."""
        return moved(self.fitted(self._then(q)), self.motion)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return x (..., m) and dx/dq (..., m, n), in closed form where the parts have one."""
        x, J = self.fitted.forward_and_jacobian(self._then(q))
        return moved(x, self.motion), turned(J.mT, self.motion).mT

    def mechanical_part(self, q: Tensor) -> Tensor:
        """Return T f_mech(q + shift), zero without a mechanical model, shape (..., m) [m]."""
        x = self.fitted.mechanical_part(self._then(q))
        return x if self.fitted.mechanical is None else moved(x, self.motion)

    def error_part(self, q: Tensor) -> Tensor:
        """Return the learned part that is added to the mechanical one, shape (..., m) [m]."""
        error = self.fitted.error_part(self._then(q))
        if self.fitted.mechanical is None:
            return moved(error, self.motion)
        return turned(error, self.motion)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the error weight, shape (...)."""
        return self.fitted.error_weight(self._then(q))

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, where it lies after the change."""
        if self.fitted.plane is None:
            return None
        point, normals = self.fitted.plane
        return point - self.shift, normals

    def misses(self, x: Tensor, largest: Tensor) -> Tensor:
        """Return by how much targets before T are out of reach of f, shape (...) [m]."""
        before = moved(x, torch.linalg.inv(self.motion))
        return self.fitted.misses(before, largest + self.shift.abs())

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance of q + shift from the training rows, shape (...)."""
        return self.fitted.domain_distance(self._then(q))

    def _then(self, q: Tensor) -> Tensor:
        check_vectors(
            q, len(self.shift), "q", f"this robot has {len(self.shift)} actuators"
        )
        return q + self.shift.to(q)


class AdaptedPoseModel(AdaptedModel, PoseHybrid):  # pyright: ignore[reportIncompatibleVariableOverride]
    """An `AdaptedModel` of a model of the pose."""

    layout = AdaptedModel.layout._replace(kind="adapted_pose_model", write_plan=None)
    fitted: PoseHybrid  # pyright: ignore[reportIncompatibleVariableOverride]

    def before(self, q: Tensor, y: Tensor) -> tuple[Tensor, Tensor]:
        """Return rows q (N, n) and poses y (N, 6) as they were before the change."""
        motion = torch.linalg.inv(self.motion).to(y)
        R = motion[:3, :3] @ rotation(y[:, 3:])[0]
        return self._then(q), torch.cat(
            [moved(y[:, :3], motion), rotation_vector(R)], 1
        )

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        T = self.fitted.pose(self._then(q))
        return self.motion.to(T) @ T

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = self.fitted.pose_and_jacobian(self._then(q))
        return self.motion.to(T) @ T, turned(J.mT, self.motion).mT

    def turning_error(self, q: Tensor) -> Tensor:
        """Return translation [m] and rotation vector [rad] from f to this pose, (..., 6)."""
        return turned(self.fitted.turning_error(self._then(q)), self.motion)


def turned(v: Tensor, motion: Tensor) -> Tensor:
    """Return vectors (..., 3), or several of them in (..., m), rotated by a motion (4, 4)."""
    if v.shape[-1] % 3:
        return v  # not in space: for such models only the zeros are adapted
    return (v.unflatten(-1, (-1, 3)) @ motion[:3, :3].to(v).mT).flatten(-2)


def moved(x: Tensor, motion: Tensor) -> Tensor:
    """Return points (..., 3), or several of them in (..., m), moved by a motion (4, 4)."""
    if x.shape[-1] % 3:
        return x
    return turned(x, motion) + motion[:3, 3].to(x).repeat(x.shape[-1] // 3)
