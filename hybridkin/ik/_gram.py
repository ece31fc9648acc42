"""Batched damped solves and projections for few task rows; three rows in closed form."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.kernel_numbers import IK_HEALTHY


class RowGram(NamedTuple):
    """G = J J^T of a Jacobian in parts, and the singular values of J.

    With three rows the parts are the six entries of G, so that a batch needs a few elementwise
    operations instead of a LAPACK call per matrix. Otherwise they are its eigenvalues and
    eigenvectors.
    """

    parts: tuple[Tensor, ...]
    sigma_min: Tensor
    sigma_max: Tensor

    @property
    def is_singular(self) -> Tensor:
        """Whether a direction is (nearly) lost, shape (...), bool."""
        return self.sigma_min < IK_HEALTHY * self.sigma_max


def row_gram(J: Tensor, n_free: int = 0) -> RowGram:
    """Return G = J J^T with the smallest and largest singular value of J.

    The singular values are accurate to sqrt(eps) of the largest, because G holds their squares.

    Parameters
    ----------
    J : Tensor of shape (..., m, n)
        Jacobians.
    n_free : int, default=0
        Number of directions of the rows that no motion changes, see `Task`; they do not count.

    Returns
    -------
    RowGram
        Parts of G and singular values, each of shape (...,).
    """
    if J.shape[-2] != 3:
        squares, vectors = torch.linalg.eigh(_finite_gram(J))
        roots = _roots(squares[..., n_free], squares[..., -1])
        return RowGram((squares, vectors), *roots)
    entries = _entries_3x3(J)
    return RowGram(entries, *_roots(*_extreme_eigenvalues(*entries)))


def _finite_gram(J: Tensor) -> Tensor:
    """Return J J^T, with numbers in place of NaN, which LAPACK refuses."""
    return torch.nan_to_num(J @ J.mT)


def _roots(low: Tensor, high: Tensor) -> tuple[Tensor, Tensor]:
    """Return the square roots of eigenvalues that are negative at most by rounding."""
    return low.clamp_min(0.0).sqrt(), high.clamp_min(0.0).sqrt()


def _extreme_eigenvalues(
    g11: Tensor, g21: Tensor, g31: Tensor, g22: Tensor, g32: Tensor, g33: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the smallest and the largest eigenvalue of a symmetric 3 x 3 matrix.

    This is the trigonometric solution of the cubic equation: G = mean + radius B, and the angle
    belongs to the determinant of B.
    """
    mean = (g11 + g22 + g33) / 3.0
    a = g11 - mean
    b = g22 - mean
    c = g33 - mean
    on_diagonal = a * a + b * b + c * c
    off_diagonal = g21 * g21 + g31 * g31 + g32 * g32
    radius = ((on_diagonal + 2.0 * off_diagonal) / 6.0).sqrt()

    # The determinant, along the first row.
    minor_11 = b * c - g32 * g32
    minor_21 = g21 * c - g32 * g31
    minor_31 = g21 * g32 - b * g31
    determinant = a * minor_11 - g21 * minor_21 + g31 * minor_31
    cube = radius.pow(3).clamp_min(torch.finfo(mean.dtype).tiny)
    cosine = (0.5 * determinant / cube).clamp(-1.0, 1.0)

    angle = torch.acos(cosine) / 3.0
    third_of_turn = 2.0 * math.pi / 3.0
    low = mean + 2.0 * radius * torch.cos(angle + third_of_turn)
    high = mean + 2.0 * radius * torch.cos(angle)
    return low, high


def adaptive_damping(gram: RowGram) -> Tensor:
    """Return lambda^2, eq. (18): zero for a regular J, growing smoothly as J becomes singular.

    With s = 0.02 sigma_max, lambda = s (1 - (sigma_min / s)^2) if sigma_min < s. This does not
    depend on units, and lambda^2 is once differentiable.

    Parameters
    ----------
    gram : RowGram
        From `row_gram`.

    Returns
    -------
    Tensor of shape (...,)
        lambda^2, in the unit of J J^T.

    References
    ----------
    Nakamura & Hanafusa, J. Dyn. Syst. Meas. Control 108 (1986).
    """
    threshold = IK_HEALTHY * gram.sigma_max
    ratio = gram.sigma_min / torch.where(threshold > 0.0, threshold, 1.0)
    return (threshold * (1.0 - ratio.square()).clamp_min(0.0)).square()


def damped_solve(gram: RowGram, v: Tensor, damping_sq: Tensor | float = 0.0) -> Tensor:
    """Return mu with (J J^T + lambda^2 1) mu = v, so that J^T mu is the damped inverse step.

    If a row of J depends on the others, up to rounding, its inconsistent part of v is dropped. So
    without damping the result still inverts the rest.

    Parameters
    ----------
    gram : RowGram
        From `row_gram`, batch shape (...,).
    v : Tensor of shape (..., m)
        Right-hand sides.
    damping_sq : Tensor of shape (...,) or float, default=0.0
        lambda^2, in the unit of J J^T.

    Returns
    -------
    Tensor of shape (..., m)
        Multipliers mu.
    """
    if len(gram.parts) == 6:
        return _solve_3x3(gram.parts, v, damping_sq)
    squares, vectors = gram.parts
    trace = squares.clamp_min(0.0).sum(-1, keepdim=True)
    floor = 8.0 * torch.finfo(v.dtype).eps * trace
    if isinstance(damping_sq, Tensor):
        damping_sq = damping_sq[..., None]
    inverse = _reciprocal(squares + damping_sq, floor)
    along = apply_columns(vectors, v)
    return apply_rows(vectors, along * inverse)


def solve_rows(J: Tensor, v: Tensor, damping_sq: Tensor) -> Tensor:
    """Return mu with (J J^T + lambda^2 1) mu = v, quickly, without singular values.

    Unless there are three rows, lambda^2 is at least what rounding requires, so that lost
    directions of v are damped instead of dropped.
    """
    if J.shape[-2] == 3:
        return _solve_3x3(_entries_3x3(J), v, damping_sq)
    gram = _finite_gram(J)
    limits = torch.finfo(gram.dtype)
    diagonal = torch.diagonal(gram, dim1=-2, dim2=-1)
    least = 16.0 * limits.eps * diagonal.sum(-1) + limits.tiny
    diagonal += torch.maximum(damping_sq, least)[..., None]
    factor, _ = torch.linalg.cholesky_ex(gram)
    return torch.cholesky_solve(v[..., None], factor)[..., 0]


def null_projection(J: Tensor, gram: RowGram, step: Tensor) -> Tensor:
    """Return (1 - J+ J) step, the part of a step that does not move the tip.

    The projector is undamped: a damped one would leak lambda^2 / (sigma^2 + lambda^2) of the step
    into the task. It is applied twice, which removes the rounding of an ill-conditioned J.

    Parameters
    ----------
    J : Tensor of shape (..., m, n)
        Jacobians.
    gram : RowGram
        Their `row_gram`.
    step : Tensor of shape (..., n)
        Steps.

    Returns
    -------
    Tensor of shape (..., n)
        Projected steps.
    """
    for _ in range(2):
        mu = damped_solve(gram, apply_rows(J, step))
        step = step - apply_columns(J, mu)
    return step


def apply_rows(J: Tensor, step: Tensor) -> Tensor:
    """Return J step, shape (..., m), for steps of shape (..., n)."""
    return (J @ step[..., None])[..., 0]


def apply_columns(J: Tensor, mu: Tensor) -> Tensor:
    """Return J^T mu, shape (..., n), for mu of shape (..., m)."""
    return (mu[..., None, :] @ J)[..., 0, :]


def _entries_3x3(J: Tensor) -> tuple[Tensor, ...]:
    """Return the lower half of J J^T, column by column."""
    first, second, third = (J @ J.mT).unbind(-1)
    return (
        *first.unbind(-1),
        *second[..., 1:].unbind(-1),
        third[..., 2],
    )


def _solve_3x3(entries: tuple[Tensor, ...], v: Tensor, damping_sq: Tensor | float) -> Tensor:
    """Solve a symmetric semidefinite 3 x 3 system plus damping by LDL^T without pivoting."""
    g11, g21, g31, g22, g32, g33 = entries
    v1, v2, v3 = v.unbind(-1)
    g11 = g11 + damping_sq
    g22 = g22 + damping_sq
    g33 = g33 + damping_sq

    # The factors: L has the entries l21, l31, l32, and D the inverses i1, i2, i3.
    floor = 8.0 * torch.finfo(v.dtype).eps * (g11 + g22 + g33)
    i1 = _reciprocal(g11, floor)
    l21 = g21 * i1
    l31 = g31 * i1
    i2 = _reciprocal(g22 - l21 * g21, floor)
    rest = g32 - l31 * g21
    l32 = rest * i2
    i3 = _reciprocal(g33 - l31 * g31 - l32 * rest, floor)

    # Forwards through L, then backwards through D and L^T.
    v2 = v2 - l21 * v1
    v3 = v3 - l31 * v1 - l32 * v2
    x3 = v3 * i3
    x2 = v2 * i2 - l32 * x3
    x1 = v1 * i1 - l21 * x2 - l31 * x3
    return torch.stack([x1, x2, x3], dim=-1)


def _reciprocal(pivot: Tensor, floor: Tensor) -> Tensor:
    """Return 1 / pivot, or 0 if the pivot is only rounding error."""
    sound = pivot > floor
    return torch.where(sound, 1.0 / torch.where(sound, pivot, 1.0), 0.0)
