"""Rotations: the exponential map, its left Jacobian, the logarithm, and the nearest rotation."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity
from hybridkin._core.stumpff import stumpff


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    x, y, z = vector.unbind(-1)
    zero = torch.zeros_like(x)
    entries = [zero, -z, y, z, zero, -x, -y, x, zero]
    return torch.stack(entries, dim=-1).unflatten(-1, (3, 3))


def rotation(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(phi) and the left Jacobian J_l(phi) of SO(3), both (..., 3, 3).

    J_l dphi/dt is the angular velocity of exp(phi). Both are entire functions of phi [rad].
    See Barfoot, State Estimation for Robotics (2017), section 7.1.
    """
    K = cross_matrix(phi)
    eye = identity(3, phi)
    functions = stumpff(phi.square().sum(-1)[..., None, None])
    f, g, c3 = functions.f, functions.g, functions.c3
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

    The unit quaternion (w, v) of R satisfies 4 w^2 = 1 + tr R, 4 w v = vee(R - R') and
    4 v v' = R + R' + (1 - tr R) 1. The largest of its four components is never small; the row of
    these products with it is divided by its norm. Then phi = 2 atan2(|v|, w) v / |v|.
    """
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    skew = R - R.mT
    vee = torch.stack([skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]], dim=-1)
    column = vee[..., None]
    squares = R + R.mT + (1.0 - trace) * identity(3, R)
    first = torch.cat([1.0 + trace, column.mT], dim=-1)
    products = torch.cat([first, torch.cat([column, squares], dim=-1)], dim=-2)
    largest = products.diagonal(dim1=-2, dim2=-1).argmax(-1)[..., None, None]
    quaternion = products.take_along_dim(largest, dim=-2)[..., 0, :]
    quaternion = nn.functional.normalize(quaternion, dim=-1)
    quaternion = torch.where(quaternion[..., :1] < 0.0, -quaternion, quaternion)
    w, v = quaternion.split([1, 3], dim=-1)
    square = v.square().sum(-1, keepdim=True)
    tiny = square < 1e-12
    size = torch.where(tiny, 1.0, square).sqrt()
    ratio = torch.where(tiny, 2.0 + square / 3.0, 2.0 * torch.atan2(size, w) / size)
    return ratio * v
