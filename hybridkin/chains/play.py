"""Backlash (also called play) of tendons, modelled by the classical play operator."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import LARGEST, real_array
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.native.hysteresis import Stage

__all__ = ["PlayOperator"]


class PlayOperator(HysteresisOperator):
    """Backlash (also called play) between commanded and effective tendon length changes.

    The effective change stays constant until the command is half the width away, then follows at
    that distance: ``y_t = clip(y_{t-1}, q_t - width / 2, q_t + width / 2)``. The result depends on
    the order of the commands, not on their speed. The commands of `command` lead by half the
    width.

    Parameters
    ----------
    width : float or array-like of shape (n,)
        Total play of all tendons or of each tendon [m], zero or more. Zero is the identity.

    References
    ----------
    Krasnosel'skii & Pokrovskii, Systems with Hysteresis, Springer 1989, section 2 (play).

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import PlayOperator
    >>> play = PlayOperator(0.5)
    >>> y, state = play.apply(np.array([[0.0], [1.0], [0.75], [0.0]]))
    >>> y.ravel()
    array([0.  , 0.75, 0.75, 0.25])
    >>> q, state = play.command(np.array([[0.5], [0.0]]), state)
    >>> q.ravel()
    array([ 0.75, -0.25])
    """

    kind = "backlash"

    def __init__(self, width: ArrayLike) -> None:
        self.width = real_array(width, "width").astype(float)
        valid = np.isfinite(self.width) & (self.width >= 0)
        if self.width.ndim > 1 or not valid.all():
            raise ValueError(
                f"`width` must be one or (n,) finite numbers, zero or more, got {width!r}."
            )

    def __repr__(self) -> str:
        return f"PlayOperator(width={self.width.tolist()})"

    @property
    def _size(self) -> int | str:
        return self.width.size if self.width.ndim else "n"

    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as one stage of one play."""
        half = np.broadcast_to(half_widths(self.width), (1, n))
        return [Stage(1, (half, np.ones((1, n))))]


def half_widths(widths: NDArray) -> NDArray:
    """Return half of the widths of plays, as far as they count: no command moves wider ones."""
    return np.minimum(0.5 * widths, 2.0 * LARGEST)
