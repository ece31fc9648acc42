"""Entire functions of the bend angle, for arcs without a singular point at straight."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from hybridkin._core.constants import constant

# [rad^2]; above it the trigonometric forms lose no digits by cancellation
_SERIES_END = 1.0
# Coefficients of c3 and c4 by powers of s, highest first; float32 needs fewer.
_DEGREE = {torch.float64: 7, torch.float32: 4}
_SERIES = {}  # of c_k and c_(k + 1)
for _k in (3, 5):
    _pairs = []
    for _j in range(7, -1, -1):
        _sign = (-1.0) ** _j
        _pair = (
            _sign / math.factorial(2 * _j + _k),
            _sign / math.factorial(2 * _j + _k + 1),
        )
        _pairs.append(_pair)
    _SERIES[_k] = tuple(_pairs)


class Stumpff(NamedTuple):
    """Entire functions of s = theta^2, with theta the bend angle of an arc.

    c = cos(theta), f = sin(theta)/theta, g = (1 - cos(theta))/theta^2,
    c3 = (theta - sin(theta))/theta^3, c4 = (cos(theta) - 1 + theta^2/2)/theta^4.
    With respect to s: 2 f' = c3 - g, 2 g' = 2 c4 - c3, 2 c' = -f.
    """

    c: Tensor
    f: Tensor
    g: Tensor
    c3: Tensor
    c4: Tensor


def stumpff(s: Tensor) -> Stumpff:
    """Return the Stumpff functions of s = theta^2, smooth through theta = 0.

    Up to one radian this is the power series, without square root or division. Above, it is the
    trigonometric form, which has no cancellation there. Both agree to rounding at one radian.

    Parameters
    ----------
    s : Tensor
        Squared bend angles [rad^2], any shape.

    Returns
    -------
    Stumpff
        Five tensors of the shape of `s`.
    """
    c3, c4 = _power_series(s, 3)
    far = s.clamp(min=_SERIES_END)
    theta = far.sqrt()
    c = torch.cos(theta)
    far_c3 = (1.0 - torch.sin(theta) / theta) / far
    far_c4 = (0.5 - (1.0 - c) / far) / far
    bent = s > _SERIES_END
    c3 = torch.where(bent, far_c3, c3)
    c4 = torch.where(bent, far_c4, c4)
    f = 1.0 - s * c3
    g = 0.5 - s * c4
    return Stumpff(torch.where(bent, c, 1.0 - s * g), f, g, c3, c4)


def next_stumpff(s: Tensor, c3: Tensor, c4: Tensor) -> tuple[Tensor, Tensor]:
    """Return c5 and c6 of s from c3 and c4: c_(k + 2) = (1/k! - c_k) / s, near zero the series."""
    c5, c6 = _power_series(s, 5)
    far = s.clamp(min=_SERIES_END)
    bent = s > _SERIES_END
    c5 = torch.where(bent, (1.0 / 6.0 - c3) / far, c5)
    c6 = torch.where(bent, (1.0 / 24.0 - c4) / far, c6)
    return c5, c6


def _power_series(s: Tensor, k: int) -> tuple[Tensor, ...]:
    """Return c_k and c_(k + 1) of s up to one radian, and beyond it those at one radian."""
    # Both together need one multiply-add per power, which is fast for small batches too.
    powers = constant(_SERIES[k][-1 - _DEGREE.get(s.dtype, 7) :], s)
    powers = powers.reshape(-1, 2, *(1,) * s.ndim).unbind()
    near = s.clamp(max=_SERIES_END)
    both = powers[0]
    for power in powers[1:]:
        both = torch.addcmul(power, both, near)
    return both.expand(2, *s.shape).unbind()
