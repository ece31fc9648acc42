"""Hybrid models of the whole pose: position and orientation errors of the tip, learned together."""

from __future__ import annotations

from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.blocks import in_blocks
from hybridkin._core.model import PoseModel, forward_and_jacobian
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin.hybrid._module import HybridModule
from hybridkin.ik._realtime import NumpyFunction, by_torch, numpy_function


class PoseHybridModule(HybridModule, PoseModel):
    """Position and frame of the tip, p = p_mech + w eps_p and R = exp(w eps_r / reach) R_mech.

    As a torch module it maps q (..., n) to tip positions (..., 3), like any other. All vectors are
    in the measuring frame: turning that frame turns errors, poses and Jacobians with it.

    Parameters
    ----------
    mechanical : nn.Module
        With ``poses(q)``, the last of which is the tip's, and ``pose_jacobian(q)``; a radian of
        orientation error counts as its ``reach`` [m], as 1 m where it has none.
    error : nn.Module or None
        Maps q (..., n) to (eps_p, eps_r) of shape (..., 6) [m].
    guard, drift : nn.Module or None
        As for `HybridModule`; the guard weighs and shortens all six together.
    """

    mechanical: Any

    def forward(self, q: Tensor) -> Tensor:
        """Return tip positions of shape (..., 3) [m]."""
        return self.mechanical(q) + self._learned(q)[..., :3]

    def error_part(self, q: Tensor) -> Tensor:
        """Return w(q) (eps_p, eps_r) and the drift, shape (..., 6) [m]."""
        return self._learned(q)

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, q (n,) -> tip (3,) and its Jacobian."""
        mechanical = numpy_function(self.mechanical)
        if self._correction is None:
            return mechanical
        correction = self._correction.numpy_function()

        def tip_and_jacobian(q: NDArray) -> tuple[NDArray, NDArray]:
            (x, J), (more, slope) = mechanical(q), correction(q)
            return x + more[:3], J + slope[:3]

        return tip_and_jacobian

    def pose(self, q: Tensor) -> Tensor:
        """Return the tip's pose in the measuring frame, shape (..., 4, 4)."""
        return in_blocks(self._pose, q)[0]

    def pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        """Return `pose(q)` and `pose_jacobian(q)` in one pass."""
        T, J = in_blocks(self._pose_and_jacobian, q)
        return T, J

    @property
    def rows(self) -> PoseRows:
        """The same model with poses as rows of six numbers."""
        return PoseRows(self.mechanical, self.error, self.guard, self.drift)

    @property
    def _correction(self) -> HybridModule | None:
        """All that is learned, as a module q -> (..., 6) of its own; None: nothing is."""
        if self.error is None and self.drift is None:
            return None
        return HybridModule(None, self.error, self.guard, self.drift)

    def _learned(self, q: Tensor) -> Tensor:
        correction = self._correction
        return q.new_zeros(*q.shape[:-1], 6) if correction is None else correction(q)

    def _learned_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        if self._correction is None:
            return self._learned(q), q.new_zeros(*q.shape[:-1], 6, q.shape[-1])
        return self._correction.forward_and_jacobian(q)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        x, J = forward_and_jacobian(self.mechanical, q)
        error, slope = self._learned_and_jacobian(q)
        return x + error[..., :3], J + slope[..., :3, :]

    def _pose(self, q: Tensor) -> tuple[Tensor]:
        error = self._learned(q)
        turn = rotation(error[..., 3:] / _reach(self.mechanical))[0]
        return (_moved(self.mechanical.pose(q), error[..., :3], turn),)

    def _pose_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        J = self.mechanical.pose_jacobian(q)
        error, slope = self._learned_and_jacobian(q)
        reach = _reach(self.mechanical)
        turn, left = rotation(error[..., 3:] / reach)
        # exp(phi) R_mech has the angular velocity J_l(phi) dphi/dq + exp(phi) omega_mech.
        angular = left @ (slope[..., 3:, :] / reach) + turn @ J[..., 3:, :]
        J = torch.cat([J[..., :3, :] + slope[..., :3, :], angular], dim=-2)
        return _moved(self.mechanical.pose(q), error[..., :3], turn), J


class PoseRows(PoseHybridModule):
    """A pose model as a module q (..., n) -> (..., 6), tip position [m] and rotation vector [rad].

    Rotation vectors are at most pi long. The Jacobian is the pose Jacobian: its angular rows give
    the angular velocity, not the derivative of the rotation vector, which jumps at half turns.
    """

    def forward(self, q: Tensor) -> Tensor:
        """Return positions and rotation vectors, shape (..., 6)."""
        return _rows(self.pose(q))

    def mechanical_part(self, q: Tensor) -> Tensor:
        """Return the same of the mechanical model alone."""
        return _rows(self.mechanical.pose(q))

    def error_part(self, q: Tensor) -> Tensor:
        """Return the way [m] and the rotation vector [rad] from there to the hybrid's pose."""
        error = self._learned(q)
        return torch.cat([error[..., :3], error[..., 3:] / _reach(self.mechanical)], dim=-1)

    def numpy_function(self) -> NumpyFunction:
        """Return a NumPy function of one configuration, q (n,) -> row (6,), Jacobian (6, n)."""
        return by_torch(self)

    def _forward_and_jacobian(self, q: Tensor) -> tuple[Tensor, Tensor]:
        T, J = self._pose_and_jacobian(q)
        return _rows(T), J


def pose_errors(mechanical: Any, q: Tensor, y: NDArray) -> NDArray:
    """Return what a mechanical model lacks to poses y (N, 6): (eps_p, eps_r), shape (N, 6) [m]."""
    if y.ndim != 2 or y.shape[1] != 6:
        raise ValueError(
            "`y` must have shape (N, 6) with output='pose', tip position [m] and rotation vector "
            f"[rad], got {y.shape}; for positions alone use output='position'."
        )
    n, reach = q.shape[1], _reach(mechanical)

    def errors(rows: Tensor) -> tuple[Tensor]:
        T, y = mechanical.pose(rows[:, :n]), rows[:, n:]
        turn = rotation_vector(rotation(y[:, 3:])[0] @ T[:, :3, :3].mT)
        return (torch.cat([y[:, :3] - T[:, :3, 3], reach * turn], dim=-1),)

    with torch.no_grad():
        return in_blocks(errors, torch.cat([q, torch.from_numpy(y)], dim=1))[0].numpy()


def check_pose_settings(model: Any) -> None:
    """Raise where the settings of a HybridForwardModel with output="pose" cannot be met."""
    mechanical, error_model = model.mechanical_model, model.error_model
    if not (hasattr(mechanical, "poses") and hasattr(mechanical, "pose_jacobian")):
        raise TypeError(
            "`mechanical_model` must have poses(q) and pose_jacobian(q) with output='pose', as all "
            f"chains have, got {type(mechanical).__name__}; for positions use output='position'."
        )
    named = isinstance(error_model, (str, tuple))
    if (model.coupling != "parallel" or named) and error_model != "drop":
        raise ValueError(
            "`coupling` must be 'parallel' and `error_model` a regressor, None or 'drop' with "
            f"output='pose', got {model.coupling!r} and {error_model!r}; ELMRegressorCV() chooses "
            "its penalties, or use output='position'."
        )
    if model.coverage is not None:
        raise ValueError(
            f"`coverage` must be None with output='pose', got {model.coverage!r}; its radius is "
            "for tip positions: fit a model with output='position' to y[:, :3]."
        )


def _reach(mechanical: Any) -> Any:
    return getattr(mechanical, "reach", 1.0)


def _moved(T: Tensor, way: Tensor, turn: Tensor) -> Tensor:
    """Return poses (..., 4, 4) moved by ways (..., 3), their frames turned where they are."""
    tip = T[..., :3, 3:] + way[..., None]
    return torch.cat([torch.cat([turn @ T[..., :3, :3], tip], -1), T[..., 3:, :]], -2)


def _rows(T: Tensor) -> Tensor:
    return torch.cat([T[..., :3, 3], rotation_vector(T[..., :3, :3])], dim=-1)
