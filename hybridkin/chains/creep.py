"""Creep of actuators or of the body: part of a change comes only with time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import real_array
from hybridkin._core.kernel_numbers import HK_MAX_CREEPS
from hybridkin._core.units import LogUnit
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.native.hysteresis import Stage

__all__ = ["CreepOperator"]


class CreepOperator(HysteresisOperator):
    """Creep between commanded and effective changes, as of polymers.

    A share g_j of every change comes with the time constant tau_j, the rest at once::

        s_j,t = q_t + exp(-dt_t / tau_j) (s_j,t-1 - q_t)
        y_t = (1 - sum_j g_j) q_t + sum_j g_j s_j,t

    At rest y = q, so a static model is the limit of the model with creep.

    Parameters
    ----------
    gains : array-like of shape (J,) or (J, n)
        Shares g_j of all actuators or of each, zero or more, with a sum below 1 [1].
    times : array-like of shape (J,)
        Time constants tau_j [s].

    Attributes
    ----------
    width : ndarray of shape ()
        Zero [unit of q]: commands of effective changes at rest are these changes. The commands of a
        motion lead by more, the faster it is.

    References
    ----------
    Kuhnen & Krejci, Compensation of complex hysteresis and creep effects in piezoelectrically
    actuated systems, IEEE Transactions on Automatic Control 54, 2009: linear creep in series.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import CreepOperator
    >>> creep = CreepOperator([0.2], [10.0])
    >>> y, state = creep.apply(np.array([[0.0], [1.0], [1.0]]), dt=[0.0, 1.0, 30.0])
    >>> y.ravel().round(3)
    array([0.   , 0.819, 0.991])
    >>> creep.command(y, dt=[0.0, 1.0, 30.0])[0].ravel()
    array([0., 1., 1.])
    """

    kind = "creep"
    creeps = True

    def __init__(self, gains: ArrayLike, times: ArrayLike) -> None:
        self.gains = real_array(gains, "gains").astype(float)
        self.times = real_array(times, "times").astype(float)
        positive = np.isfinite(self.times) & (self.times > 0.0)
        some = self.times.ndim == 1 and 0 < self.times.size <= HK_MAX_CREEPS
        if not some or not positive.all():
            raise ValueError(
                f"`times` must be 1 to {HK_MAX_CREEPS} finite positive numbers, got {times!r:.200}."
            )
        shaped = self.gains.ndim in (1, 2) and len(self.gains) == len(self.times)
        if not shaped or not _are_shares(self.gains):
            raise ValueError(
                f"`gains` must have shape ({len(self.times)},), or one such column for each "
                f"actuator, and be zero or more with a sum below 1, got {gains!r:.200}."
            )
        self.width = np.zeros(())

    def __repr__(self) -> str:
        return (
            f"CreepOperator(gains={self.gains.tolist()}, times={self.times.tolist()})"
        )

    @property
    def time_constants(self) -> NDArray:
        """The time constants (J,) [s]."""
        return self.times

    @property
    def _size(self) -> int | str:
        return self.gains.shape[1] if self.gains.ndim == 2 else "n"

    def in_words(self, unit: LogUnit) -> str:
        """Return the largest share of a change that comes late, and the time constants."""
        late = 100.0 * self.gains.sum(axis=0).max()
        times = [f"{time:.3g}" for time in np.unique(self.times[[0, -1]])]
        return f"creep (up to {late:.2g} % late, with {' to '.join(times)} s)"

    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as one stage of creep."""
        size = len(self.times)
        gains = np.broadcast_to(self.gains.reshape(size, -1), (size, n))
        return [Stage(-size, (gains, self.times))]

    def _each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the slow states (N, n)."""
        for time in self.times:
            half = CreepOperator([0.5], [time])
            yield 2.0 * half.followed(rows, steps) - rows


def _are_shares(gains: NDArray) -> bool:
    """Return whether gains are zero or more and leave a part that comes at once."""
    return bool((gains >= 0.0).all() and (gains.sum(axis=0) < 1.0).all())
