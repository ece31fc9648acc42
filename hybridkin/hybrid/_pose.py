"""Hybrid models of the pose: position and orientation errors of the tip, learned together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import PoseModel
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin._core.stored import Layout
from hybridkin.chains.chain import Chain
from hybridkin.hybrid._guards import GroupDistance, Plane
from hybridkin.hybrid._module import Correction, Hybrid, HybridModule, TipCorrection
from hybridkin.learning.regressor_modules import AffineModule


class PoseHybrid(Hybrid, PoseModel):
    """A hybrid that is a model of the pose; `rows` gives its poses as rows of six numbers."""

    def turning_error(self, q: Tensor) -> Tensor:
        """Return translation [m] and rotation vector [rad] from f to this pose, (..., 6)."""
        raise NotImplementedError

    def rows(self) -> PoseRows:
        """Return the same model with poses as rows of six numbers."""
        return PoseRows(self)


class WithPose(PoseHybrid):
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

    layout = Layout("with_pose", {}, parts=("mechanical", "learned"))
    n_outputs = 3
    mechanical: PoseModel  # pyright: ignore

    def __init__(self, mechanical: PoseModel, learned: HybridModule) -> None:
        super().__init__()
        self.mechanical = mechanical  # pyright: ignore
        self.learned = learned
        self.n_actuators = learned.n_actuators

    @classmethod
    def of(
        cls,
        mechanical: PoseModel,
        corrections: Sequence[Correction],
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
    def corrects_inside(self) -> bool:
        """Whether a correction acts inside the robot: none does."""
        return False

    @property
    def drift(self) -> AffineModule | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The change of the robot since the fit."""
        return self.learned.drift

    @property
    def tested(self) -> GroupDistance | None:  # pyright: ignore[reportIncompatibleVariableOverride]
        """Distance up to which held-out groups have tested the model."""
        return self.learned.tested

    @property
    def plane(self) -> tuple[Tensor, Tensor] | None:
        """The plane of the log, see `Plane`."""
        return self.learned.plane

    @property
    def longest_correction(self) -> Tensor | float:
        """Upper bound of the distance from f(q) to x, infinite without guards, () [m]."""
        return self.learned.longest_correction

    def with_drift(self, drift: AffineModule | None) -> Self:
        """Return the same model with another drift; this model does not change."""
        return type(self)(self.mechanical, self.learned.with_drift(drift))

    def without_learned(self) -> Self:
        """Return the mechanical model alone, as a hybrid."""
        return self.of(self.mechanical, [], self.learned.weights[:0])

    def forward(self, q: Tensor) -> Tensor:
        """Return tip positions (..., 3) [m]."""
        return self.mechanical(q) + self.error_part(q)

    def forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return tip positions (..., 3) and dx/dq (..., 3, n)."""
        x, J = self.mechanical.forward_and_jacobian(q)
        error, slope = self.learned.forward_and_jacobian(q)
        return x + error[..., :3], J + slope[..., :3, :]

    def error_part(self, q: Tensor) -> Tensor:
        """Return what is added to the position f(q), shape (..., 3) [m]."""
        return self.learned(q)[..., :3]

    def learned_error(self, q: Tensor) -> Tensor:
        """Return the errors of position and orientation, shape (..., 6) [m]."""
        return self.learned(q)

    def turning_error(self, q: Tensor) -> Tensor:
        """Return translation [m] and rotation vector [rad] from f to this pose, (..., 6)."""
        error = self.learned(q)
        turn = error[..., 3:] / reach_of(self.mechanical)
        return torch.cat([error[..., :3], turn], dim=-1)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the error weight t(q), shape (...)."""
        return self.learned.error_weight(q)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the largest distance from the training rows of guards and groups, (...)."""
        return self.learned.domain_distance(q)

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return in_blocks(self._pose, q)[0]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = in_blocks(self._pose_and_jacobian, q)
        return T, J

    def _pose(self, q: Tensor) -> tuple[Tensor]:
        error = self.turning_error(q)
        turn = rotation(error[:, 3:])[0]
        return (_moved(self.mechanical.pose(q), error[:, :3], turn),)

    def _pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self.mechanical.pose_and_jacobian(q)
        error, slope = self.learned.forward_and_jacobian(q)
        reach = reach_of(self.mechanical)
        turn, left = rotation(error[:, 3:] / reach)
        # exp(phi) R_mech has the angular velocity J_l(phi) dphi/dq + exp(phi) omega_mech.
        angular = left @ (slope[:, 3:] / reach) + turn @ J[:, 3:]
        J = torch.cat([J[:, :3] + slope[:, :3], angular], dim=-2)
        return _moved(T, error[:, :3], turn), J


class PoseRows(Hybrid):
    """A pose model as a module q (..., n) -> (..., 6), tip position [m] and rotation vector [rad].

    Rotation vectors are at most pi long. The Jacobian is the pose Jacobian: its angular rows give
    the angular velocity, not the derivative of the rotation vector, which jumps at half turns.

    Parameters
    ----------
    model : PoseHybrid
        The model of the pose.
    """

    n_outputs = 6

    def __init__(self, model: PoseHybrid) -> None:
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

    def mechanical_part(self, q: Tensor) -> Tensor:
        """Return positions and rotation vectors of the mechanical model, shape (..., 6)."""
        return _rows(cast(PoseModel, self.model.mechanical).pose(q))

    def error_part(self, q: Tensor) -> Tensor:
        """Return translation [m] and rotation vector [rad] from the mechanical to this pose."""
        return self.model.turning_error(q)

    def error_weight(self, q: Tensor) -> Tensor:
        """Return the error weight t(q), shape (...)."""
        return self.model.error_weight(q)

    def domain_distance(self, q: Tensor) -> Tensor:
        """Return the distance from the training rows, shape (...)."""
        return self.model.domain_distance(q)


def pose_errors(mechanical: PoseModel, q: Tensor, y: NDArray) -> NDArray:
    """Return the residuals (e_p, e_r) of poses y for a mechanical model, (N, 6) [m]."""
    if y.ndim != 2 or y.shape[1] != 6:
        raise ValueError(
            "`y` must have shape (N, 6) with output='pose', tip position [m] and rotation vector "
            f"[rad], got {y.shape}; for positions alone use output='position'."
        )
    n = q.shape[1]
    reach = reach_of(mechanical)

    def errors(rows: Tensor) -> tuple[Tensor]:
        T = mechanical.pose(rows[:, :n])
        y = rows[:, n:]
        turn = rotation_vector(rotation(y[:, 3:])[0] @ T[:, :3, :3].mT)
        return (torch.cat([y[:, :3] - T[:, :3, 3], reach * turn], dim=-1),)

    with torch.no_grad():
        return in_blocks(errors, torch.cat([q, torch.from_numpy(y)], dim=1))[0].numpy()


def reach_of(mechanical: PoseModel) -> Tensor | float:
    """Return the length [m] that a radian of orientation error counts as."""
    return mechanical.reach if isinstance(mechanical, Chain) else 1.0


def _moved(T: Tensor, way: Tensor, turn: Tensor) -> Tensor:
    """Return poses (N, 4, 4) translated by ways (N, 3), with their frames rotated in place."""
    tip = T[:, :3, 3:] + way[..., None]
    upper = torch.cat([turn @ T[:, :3, :3], tip], dim=-1)
    return torch.cat([upper, T[:, 3:]], dim=-2)


def _rows(T: Tensor) -> Tensor:
    return torch.cat([T[..., :3, 3], rotation_vector(T[..., :3, :3])], dim=-1)
