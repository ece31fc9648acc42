"""Rotations: the exponential map, its left Jacobian, the logarithm, and the nearest rotation."""

from __future__ import annotations

import torch
from torch import Tensor

from hybridkin._core.arrays import identity
from hybridkin._core.stumpff import stumpff


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).unflatten(
        -1, (3, 3)
    )


def rotation(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(phi) and the left Jacobian J_l(phi) of SO(3), both (..., 3, 3).

    J_l dphi/dt is the angular velocity of exp(phi). Both are entire functions of phi [rad].
    See Barfoot, State Estimation for Robotics (2017), section 7.1.
    """
    K = cross_matrix(phi)
    eye = identity(3, phi)
    _, f, g, c3, _ = (part[..., None, None] for part in stumpff(phi.square().sum(-1)))
    return eye + f * K + g * K @ K, eye + g * K + c3 * K @ K


def nearest_rotation(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations R (..., 3, 3) of largest trace(R^T M), and that trace (...,).

    For centred points a and b (N, 3) and moments M = b^T a, R brings a nearest to b; the trace over
    the sum of squares of a is then the best scale.

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991): least squares over rotations without mirror images.
    """
    left, stretch, right = torch.linalg.svd(moments)
    sign = torch.ones_like(stretch)
    sign[..., 2] = torch.linalg.det(left @ right).sign()
    return (left * sign[..., None, :]) @ right, (stretch * sign).sum(-1)


def rigid_motion(
    points: Tensor, targets: Tensor, weights: Tensor | None = None
) -> Tensor:
    """Return the motion (4, 4) that brings points (N, 3) nearest to their targets (N, 3).

    `weights` (N,) are those of the squared distances, by default equal.
    """
    if weights is None:
        weights = points.new_ones(len(points))
    weights = (weights / weights.sum())[:, None]
    center = (weights * points).sum(0)
    target_center = (weights * targets).sum(0)
    moments = (weights * (targets - target_center)).mT @ (points - center)
    motion = identity(4, points)
    motion[:3, :3] = nearest_rotation(moments)[0]
    motion[:3, 3] = target_center - motion[:3, :3] @ center
    return motion


def rotation_vector(R: Tensor) -> Tensor:
    """Return the logarithm (..., 3) of rotations (..., 3, 3) [rad], valid up to half turns.

    It divides by the largest component of the unit quaternion, which is never small.
    """
    r = [[R[..., i, j] for j in range(3)] for i in range(3)]
    skew = torch.stack(
        [r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]], dim=-1
    )
    diagonal = torch.stack([r[0][0], r[1][1], r[2][2]], dim=-1)
    trace = diagonal.sum(-1, keepdim=True)
    # Row k: 4 q_k times the quaternion (w, x, y, z).
    symmetric = R + R.mT - torch.diag_embed(2.0 * diagonal)
    inner = symmetric + torch.diag_embed(1.0 + 2.0 * diagonal - trace)
    first = torch.cat([1.0 + trace, skew], dim=-1)[..., None, :]
    whole = torch.cat([first, torch.cat([skew[..., None], inner], dim=-1)], dim=-2)
    largest = torch.diagonal(whole, dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    row = whole.gather(-2, largest.expand(*largest.shape[:-1], 4))[..., 0, :]
    row = row / torch.linalg.vector_norm(row, dim=-1, keepdim=True)
    row = torch.where(row[..., :1] < 0.0, -row, row)
    w = row[..., :1]
    axis = row[..., 1:]
    square = axis.square().sum(-1, keepdim=True)
    tiny = square < 1e-12
    size = torch.where(tiny, 1.0, square).sqrt()
    ratio = torch.where(tiny, 2.0 + square / 3.0, 2.0 * torch.atan2(size, w) / size)
    return ratio * axis
