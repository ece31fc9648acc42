"""Hysteresis of actuators as a weighted sum of play operators (Prandtl-Ishlinskii)."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import LARGEST, countable, real_array
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.chains.play import PlayOperator, half_widths
from hybridkin.native.hysteresis import Stage

__all__ = ["PrandtlIshlinskiiOperator"]


class PrandtlIshlinskiiOperator(HysteresisOperator):
    """A weighted sum of play operators, for friction whose loops have no sharp corners.

    With the results P_k of play operators of K widths, ``y = P_K + sum_k s_k (P_k - P_{k+1})``.
    After a reversal the first play moves first. While plays 1 to k move, y moves s_k times as far
    as the command; once all move, just as far. One play of width w has the slopes 0 below w and 1
    above it. A single width without slopes is that play.

    Parameters
    ----------
    widths : array-like of shape (K,)
        Widths of the play operators, ascending from zero or more [unit of q].
    slopes : array-like of shape (K - 1,) or (K - 1, n)
        Slopes s_k of all actuators or of each, zero or more [1].

    Attributes
    ----------
    width : ndarray of shape () or (n,)
        Largest distance between two commands with the same effective change [unit of q].

    References
    ----------
    Krasnosel'skii & Pokrovskii, Systems with Hysteresis, Springer 1989, section 34.
    Kuhnen, Modeling, identification and compensation of complex hysteretic nonlinearities,
    European Journal of Control 9, 2003: the inverse.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import PrandtlIshlinskiiOperator
    >>> hysteresis = PrandtlIshlinskiiOperator([0.0, 1.0], [0.5])
    >>> y, state = hysteresis.apply(np.array([[0.0], [0.5], [2.0], [1.5]]))
    >>> y.ravel()
    array([0.  , 0.25, 1.75, 1.5 ])
    >>> hysteresis.command(y)[0].ravel()
    array([0. , 0.5, 2. , 1.5])
    """

    kind = "hysteresis"

    def __init__(self, widths: ArrayLike, slopes: ArrayLike) -> None:
        self.widths = real_array(widths, "widths").astype(float)
        self.slopes = real_array(slopes, "slopes").astype(float)
        ascending = _are_valid(self.widths, (1,)) and len(self.widths) > 0
        if not ascending or not (np.diff(self.widths) > 0.0).all():
            raise ValueError(
                f"`widths` must be ascending finite numbers, zero or more, got {widths!r:.200}."
            )
        shape = f"({len(self.widths) - 1},)"
        valid = _are_valid(self.slopes, (1, 2)) and countable(self.slopes).all()
        if not valid or len(self.slopes) + 1 != len(self.widths):
            raise ValueError(
                f"`slopes` must have shape {shape}, or one such column for each actuator, and be "
                f"zero or more and below {LARGEST:g}, got {slopes!r:.200}."
            )

        # Bounds y = P_1 + sum_k (s_k - 1) (P_k - P_{k+1}).
        self.width = self.widths[0] + np.diff(self.widths) @ np.abs(self.slopes - 1.0)

    def __repr__(self) -> str:
        return (
            f"PrandtlIshlinskiiOperator(widths={self.widths.tolist()}, "
            f"slopes={self.slopes.tolist()})"
        )

    @property
    def _size(self) -> int | str:
        return self.slopes.shape[1] if self.slopes.ndim == 2 else "n"

    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as one stage of all plays."""
        slopes = np.ones((len(self.widths), n))  # the last are 1
        slopes[:-1] = self.slopes if self.slopes.ndim == 2 else self.slopes[:, None]
        half = np.broadcast_to(half_widths(self.widths)[:, None], slopes.shape)
        return [Stage(len(half), (half, slopes))]

    def _each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the plays (N, n)."""
        for width in self.widths:
            yield PlayOperator(width).followed(rows, steps)


def _are_valid(numbers: NDArray, dimensions: tuple[int, ...]) -> bool:
    """Return whether numbers are finite, zero or more, and have so many dimensions."""
    positive = np.isfinite(numbers) & (numbers >= 0.0)
    return numbers.ndim in dimensions and bool(positive.all())
