"""Hybrid models of the pose: position and orientation errors of the tip, learned together."""

from __future__ import annotations

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import PoseModel
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin.chains.chain import Chain
from hybridkin.hybrid._module import HybridModule


class PoseHybridModule(HybridModule, PoseModel):
    """Position and frame of the tip, p = p_mech + e_p and R = exp(e_r / reach) R_mech.

    As a torch module it maps q (..., n) to tip positions (..., 3), like any other. (e_p, e_r) is
    the sum of corrections and drift of `HybridModule`, six numbers in metres. One radian counts as
    the `reach` of the chain, or as 1 m for other models. The guards weight and shorten the six
    numbers together. All vectors are in the measuring frame.

    Parameters
    ----------
    mechanical : PoseModel
        p_mech and R_mech.
    corrections : sequence of TipCorrection
        Corrections whose modules map q (..., n) to (..., 6) [m].
    weights, drift, tested, log_plane
        As for `HybridModule`.
    """

    layout = HybridModule.layout._replace(kind="pose_hybrid_module", write_plan=None)
    n_outputs = 3
    mechanical: PoseModel  # pyright: ignore[reportIncompatibleVariableOverride]

    def rows(self) -> HybridModule:
        """Return the same model with poses as rows of six numbers."""
        corrections = [correction for _, correction in self._parts()]
        return PoseRows(
            self.mechanical,
            corrections,
            self.weights,
            self.drift,
            self.tested,
            self.log_plane,
        )

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return in_blocks(self._pose, q)[0]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = in_blocks(self._pose_and_jacobian, q)
        return T, J

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        return (self.mechanical(q) + self._learned(q, None)[:, :3],)

    def _nothing(self, q: Tensor) -> Tensor:
        return q.new_zeros(len(q), 6)

    def _learned_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        return self._added(
            (self._nothing(q), q.new_zeros(len(q), 6, q.shape[1])), q, None
        )

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = self.mechanical.forward_and_jacobian(q)
        error, slope = self._learned_and_jacobian(q)
        return x + error[:, :3], J + slope[:, :3]

    def _pose(self, q: Tensor) -> tuple[Tensor]:
        error = self._learned(q, None)
        turn = rotation(error[:, 3:] / reach_of(self.mechanical))[0]
        return (_moved(self.mechanical.pose(q), error[:, :3], turn),)

    def _pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self.mechanical.pose_and_jacobian(q)
        error, slope = self._learned_and_jacobian(q)
        reach = reach_of(self.mechanical)
        turn, left = rotation(error[:, 3:] / reach)
        # exp(phi) R_mech has the angular velocity J_l(phi) dphi/dq + exp(phi) omega_mech.
        angular = left @ (slope[:, 3:] / reach) + turn @ J[:, 3:]
        J = torch.cat([J[:, :3] + slope[:, :3], angular], dim=-2)
        return _moved(T, error[:, :3], turn), J


class PoseRows(PoseHybridModule):
    """A pose model as a module q (..., n) -> (..., 6), tip position [m] and rotation vector [rad].

    Rotation vectors are at most pi long. The Jacobian is the pose Jacobian: its angular rows give
    the angular velocity, not the derivative of the rotation vector, which jumps at half turns.
    """

    n_outputs = 6

    def mechanical_part(self, q: Tensor) -> Tensor:
        """Return positions and rotation vectors of the mechanical model, shape (..., 6)."""
        return _rows(self.mechanical.pose(q))

    def error_part(self, q: Tensor) -> Tensor:
        """Return translation [m] and rotation vector [rad] from the mechanical to this pose."""
        error = super().error_part(q)
        return torch.cat(
            [error[..., :3], error[..., 3:] / reach_of(self.mechanical)], dim=-1
        )

    def _forward(self, q: Tensor) -> tuple[Tensor]:
        return (_rows(self._pose(q)[0]),)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self._pose_and_jacobian(q)
        return _rows(T), J


def pose_errors(mechanical: PoseModel, q: Tensor, y: NDArray) -> NDArray:
    """Return the residuals (e_p, e_r) of poses y for a mechanical model, (N, 6) [m]."""
    if y.ndim != 2 or y.shape[1] != 6:
        raise ValueError(
            "`y` must have shape (N, 6) with output='pose', tip position [m] and rotation vector "
            f"[rad], got {y.shape}; for positions alone use output='position'."
        )
    n, reach = q.shape[1], reach_of(mechanical)

    def errors(rows: Tensor) -> tuple[Tensor]:
        T, y = mechanical.pose(rows[:, :n]), rows[:, n:]
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
    return torch.cat([torch.cat([turn @ T[:, :3, :3], tip], -1), T[:, 3:]], -2)


def _rows(T: Tensor) -> Tensor:
    return torch.cat([T[..., :3, 3], rotation_vector(T[..., :3, :3])], dim=-1)
