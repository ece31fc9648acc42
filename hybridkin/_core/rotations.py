"""Rotations: the exponential map, its left Jacobian, the logarithm, the nearest, the least one."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from hybridkin._core.arrays import identity
from hybridkin._core.kernel_numbers import HK_ASIDE
from hybridkin._core.stumpff import stumpff


def cross_matrix(vector: Tensor) -> Tensor:
    """Return the cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    axes = identity(3, vector).expand(*vector.shape, 3)
    return torch.linalg.cross(vector[..., None], axes, dim=-2)  # column by column


def rotation(phi: Tensor) -> tuple[Tensor, Tensor]:
    """Return exp(phi) and the left Jacobian J_l(phi) of SO(3), both (..., 3, 3).

    J_l dphi/dt is the angular velocity of exp(phi). Both are entire functions of phi [rad].
    See Barfoot, State Estimation for Robotics (2017), section 7.1.
    """
    K = cross_matrix(phi)
    K_squared = K @ K
    eye = identity(3, phi)
    angle_squared = phi.square().sum(-1)[..., None, None]
    _, f, g, c3, _ = stumpff(angle_squared)
    turned = eye + f * K + g * K_squared
    left_jacobian = eye + g * K + c3 * K_squared
    return turned, left_jacobian


def nearest_rotation(moments: Tensor) -> tuple[Tensor, Tensor]:
    """Return the rotations R (..., 3, 3) of largest trace(R^T M), and that trace (...,).

    For centred points a and b (N, 3) and moments M = b^T a, R brings a nearest to b; the trace over
    the sum of squares of a is then the best scale.

    References
    ----------
    Umeyama, IEEE PAMI 13 (1991): least squares over rotations without mirror images.
    """
    left, stretch, right = torch.linalg.svd(moments)
    # The least stretched axis is reversed where the product would be a mirror image.
    sign = torch.ones_like(stretch)
    sign[..., 2] = torch.linalg.det(left @ right).sign()
    nearest = (left * sign[..., None, :]) @ right
    trace = (stretch * sign).sum(-1)
    return nearest, trace


def rigid_motion(points: Tensor, targets: Tensor, weights: Tensor | None = None) -> Tensor:
    """Return the motion (4, 4) that brings points (N, 3) nearest to their targets (N, 3).

    `weights` (N,) are those of the squared distances, by default equal.
    """
    if weights is None:
        weights = points.new_ones(len(points))
    weights = weights / weights.sum()
    center = weights @ points
    target_center = weights @ targets
    weighted_targets = weights[:, None] * (targets - target_center)
    moments = weighted_targets.mT @ (points - center)
    turned, _ = nearest_rotation(moments)

    motion = identity(4, points)
    motion[:3, :3] = turned
    motion[:3, 3] = target_center - turned @ center
    return motion


def rotation_vector(R: Tensor) -> Tensor:
    """Return the logarithm (..., 3) of rotations (..., 3, 3) [rad], valid up to half turns.

    The unit quaternion (w, v) of R satisfies 4 w^2 = 1 + tr R, 4 w v = vee(R - R') and
    4 v v' = R + R' + (1 - tr R) 1. The largest of its four components is never small; the row of
    these products with it is divided by its norm. Then phi = 2 atan2(|v|, w) v / |v|.
    """
    # The products 4 (w, v) (w, v)'.
    trace = R.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    skew = R - R.mT
    v_products = R + R.mT + (1.0 - trace) * identity(3, R)
    wv = [skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]]
    wv_products = torch.stack(wv, dim=-1)[..., None]
    w_row = torch.cat([1.0 + trace, wv_products.mT], dim=-1)
    v_rows = torch.cat([wv_products, v_products], dim=-1)
    products = torch.cat([w_row, v_rows], dim=-2)

    # The row of the largest component, with w >= 0.
    squares = products.diagonal(dim1=-2, dim2=-1)
    largest = squares.argmax(-1)[..., None, None]
    row = products.take_along_dim(largest, dim=-2)[..., 0, :]
    row = torch.where(row[..., :1] < 0.0, -row, row)
    w, v = nn.functional.normalize(row, dim=-1).split([1, 3], dim=-1)

    # Near zero the series of 2 asin(|v|) / |v|.
    square = v.square().sum(-1, keepdim=True)
    tiny = square < 1e-12
    size = torch.where(tiny, 1.0, square).sqrt()
    near = 2.0 + square / 3.0
    far = 2.0 * torch.atan2(size, w) / size
    return torch.where(tiny, near, far) * v


def least_turn(a: Tensor, b: Tensor) -> Tensor:
    """Return the rotation vectors (..., 3) of least angle from directions a to b (..., 3) [rad].

    Their lengths do not matter. Opposite directions, to half of the digits, have many such turns:
    the one about the cross product of a and the first coordinate axis that is not along it.
    """
    a = nn.functional.normalize(a, dim=-1)
    b = nn.functional.normalize(b, dim=-1)
    normal = torch.linalg.cross(a, b, dim=-1)
    cosine = (a * b).sum(-1, keepdim=True)
    square = normal.square().sum(-1, keepdim=True)

    # Near zero the series of asin(s) / s, with s the sine of the angle.
    tiny = (cosine > 0.0) & (square < 1e-12)
    opposite = (cosine < 0.0) & (square <= torch.finfo(a.dtype).eps)
    sine = torch.where(tiny | opposite, 1.0, square).sqrt()
    ratio = torch.where(tiny, 1.0 + square / 6.0, torch.atan2(sine, cosine) / sine)
    return torch.where(opposite, _half_turn(a), ratio * normal)


def _half_turn(a: Tensor) -> Tensor:
    """Return a half turn (..., 3) that reverses unit vectors a (..., 3)."""
    x, y, z = a.unbind(-1)
    zero = torch.zeros_like(x)
    by_x = torch.stack([zero, z, -y], dim=-1)
    by_y = torch.stack([-z, zero, x], dim=-1)
    by_z = torch.stack([y, -x, zero], dim=-1)
    axis = torch.where(y.abs()[..., None] < HK_ASIDE, by_y, by_z)
    axis = torch.where(x.abs()[..., None] < HK_ASIDE, by_x, axis)
    return math.pi * nn.functional.normalize(axis, dim=-1)
