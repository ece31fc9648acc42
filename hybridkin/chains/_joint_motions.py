"""Motions of the joints of a rigid arm, and the frames and the tip that follow from them.

Every joint moves by T(q) = B_0 + u_1(q) B_1 + u_2(q) B_2 with three constant matrices. (u_1, u_2)
is (sin q, cos q) for a revolute joint (Rodrigues' formula) and (q, unused) for a prismatic one.
The batch comes last in the results: vectors are (3, N), in the measuring frame.
"""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.rotations import cross_matrix


def joint_motions(origins: Tensor, axes: Tensor, slides: Tensor) -> Tensor:
    """Return B_0, B_1, B_2 of every joint, including its origin, shape (n, 3, 4, 4)."""
    turning_axes = torch.where(slides[:, None], 0.0, axes)
    sliding_axes = axes - turning_axes
    # Rodrigues: the rotation is 1 + K^2 + sin q K - cos q K^2; K is 0 for a prismatic joint.
    K = cross_matrix(turning_axes)
    K_squared = K @ K
    turns = torch.stack([identity(3, axes) + K_squared, K, -K_squared], dim=1)
    shifts = torch.stack([0.0 * axes, sliding_axes, 0.0 * axes], dim=1)
    upper = torch.cat([turns, shifts[..., None]], dim=-1)
    last = torch.zeros_like(upper[:, :, :1])
    last[:, 0, 0, 3] = 1.0
    motions = torch.cat([upper, last], dim=2)
    return origins[:, None] @ motions


def joint_coefficients(z: Tensor, slides: Tensor) -> tuple[Tensor, Tensor]:
    """Return u_1 and u_2 of all joints at positions z (N, n)."""
    return torch.where(slides, z, z.sin()), z.cos()


def carried_tip(u1: Tensor, u2: Tensor, motions: Tensor, end: Tensor, base: Tensor) -> Tensor:
    """Return the tip (3, N) of a point (4,) in the last moving frame.

    Carrying one point from the last joint to the base is many times faster than `moving_frames`.
    """
    point = end[:, None].expand(4, u1.shape[0])
    joints = zip(motions.flatten(1, 2), u1.T, u2.T, strict=True)
    for motion, u1_of_joint, u2_of_joint in reversed([*joints]):
        point = _moved(motion, point, u1_of_joint, u2_of_joint)
    return base[:3] @ point


def _moved(motion: Tensor, columns: Tensor, u1: Tensor, u2: Tensor) -> Tensor:
    """Return columns (4, N) moved by one joint with B_0, B_1, B_2 stacked in `motion` (12, 4)."""
    still, by_u1, by_u2 = (motion @ columns).split(4)
    moved = torch.addcmul(still, u1, by_u1)
    return torch.addcmul(moved, u2, by_u2)


def moving_frames(u1: Tensor, u2: Tensor, motions: Tensor, base: Tensor) -> Tensor:
    """Return the base and the moving frame of every joint, shape (n + 1, 4, 3, N).

    Each is given by its three axes and its origin.
    """
    n_rows = u1.shape[0]
    # With the three coordinates of all rows side by side, a joint costs one small product.
    frame = base[:3].T.repeat_interleave(n_rows, 1)
    u1 = u1.T.repeat(1, 3)
    u2 = u2.T.repeat(1, 3)
    frames = [frame]
    joints = zip(motions.mT.flatten(1, 2), u1, u2, strict=True)
    for motion, u1_of_joint, u2_of_joint in joints:
        frame = _moved(motion, frame, u1_of_joint, u2_of_joint)
        frames.append(frame)
    return torch.stack(frames).unflatten(-1, (3, n_rows))


def as_poses(frames: Tensor) -> Tensor:
    """Return frames (K, 4, 3, N) as homogeneous matrices (N, K, 4, 4)."""
    poses = frames.permute(3, 0, 2, 1)
    last_row = identity(4, frames)[3].expand(*poses.shape[:2], 1, 4)
    return torch.cat([poses, last_row], dim=2)
