"""Kernels of rigid arms: tips, frames and Jacobian columns from the motions of the joints.

Every joint moves by T(q) = B_0 + u_1(q) B_1 + u_2(q) B_2 with three constant matrices: u_1, u_2
are sin q and cos q of a revolute joint (Rodrigues' formula), q and nothing of a prismatic one.
Batches come last in the results, vectors are (3, N); all are in the base frame.
"""

from __future__ import annotations

import itertools

import torch
from torch import Tensor, nn


def joint_motions(origins: Tensor, axes: Tensor, slides: Tensor) -> Tensor:
    """Return B_0, B_1, B_2 of every joint, its origin included, shape (n, 3, 4, 4)."""
    motions = origins.new_zeros(len(axes), 3, 4, 4)
    motions[:, 0, 3, 3] = 1.0
    eye = torch.eye(3, dtype=axes.dtype, device=axes.device)
    along = axes[:, :, None] * axes[:, None, :]
    slide = slides[:, None, None]
    motions[:, 0, :3, :3] = torch.where(slide, eye, along)
    motions[:, 1, :3, :3] = torch.where(slide, 0.0, torch.linalg.cross(eye[None], axes[:, None]))
    motions[:, 2, :3, :3] = torch.where(slide, 0.0, eye - along)
    motions[:, 1, :3, 3] = torch.where(slides[:, None], axes, 0.0)
    return origins[:, None] @ motions


def column_carriers(motions: Tensor, origins: Tensor, axes: Tensor) -> Tensor:
    """Return what `last_frame_and_joints` multiplies a frame by at every joint, shape (n, 13, 4).

    From the columns of one frame to those of the next, times 1, u_1 and u_2, and to the axis.
    """
    directions = nn.functional.pad(origins[:, :3, :3] @ axes[..., None], (0, 0, 0, 1))
    return torch.cat([motions.mT.flatten(1, 2), directions.mT], dim=1)


def shares(rows: Tensor, slides: Tensor | None) -> tuple[Tensor, Tensor]:
    """Return u_1 and u_2 of every joint in rows q (N, n); `slides` is None where no joint does."""
    first = rows.sin()
    if slides is not None:
        first = torch.where(slides.to(rows.device), rows, first)
    return first, rows.cos()


def carried_tip(u1: Tensor, u2: Tensor, motions: Tensor, end: Tensor) -> Tensor:
    """Return the homogeneous tip (4, N), carried from the last joint's frame to the base."""
    p = end[:, None].expand(4, len(u1))
    joints = zip(motions.flatten(1, 2).unbind(), u1.T.unbind(), u2.T.unbind(), strict=True)
    for motion, of_u1, of_u2 in reversed([*joints]):
        still, by_u1, by_u2 = (motion @ p).split(4)
        p = torch.addcmul(torch.addcmul(still, of_u1, by_u1), of_u2, by_u2)
    return p


def frames(u1: Tensor, u2: Tensor, motions: Tensor) -> Tensor:
    """Return every joint's moving frame, shape (N, n, 4, 4)."""
    u1, u2 = (part[..., None, None] for part in (u1, u2))
    still, by_u1, by_u2 = motions.unbind(1)
    steps = torch.addcmul(torch.addcmul(still, u1, by_u1), u2, by_u2).unbind(1)
    return torch.stack([*itertools.accumulate(steps, torch.matmul)], dim=1)


def last_frame_and_joints(
    u1: Tensor, u2: Tensor, carriers: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the last moving frame (4, 3, N), joint axes and joint positions (n, 3, N).

    Of the frame these are its three axes and its origin.
    """
    n_rows, n = u1.shape
    # Three coordinates of every row side by side, so that a joint costs one small product.
    u1, u2 = (part.T.repeat(1, 3) for part in (u1, u2))
    frame = torch.eye(4, dtype=u1.dtype, device=u1.device)[:, :3].repeat_interleave(n_rows, 1)
    axes, points = [], []
    for carrier, of_u1, of_u2 in zip(carriers.unbind(), u1.unbind(), u2.unbind(), strict=True):
        still, by_u1, by_u2, axis = (carrier @ frame).split((4, 4, 4, 1))
        frame = torch.addcmul(torch.addcmul(still, of_u1, by_u1), of_u2, by_u2)
        axes.append(axis)
        points.append(frame[3:])
    joint_axes, joint_points = (torch.cat(part).reshape(n, 3, n_rows) for part in (axes, points))
    return frame.unflatten(1, (3, n_rows)), joint_axes, joint_points
