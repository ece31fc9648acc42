"""Backlash (also called play) of tendons, modelled by the classical play operator."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.arrays import real_array
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.native.library import available, play

__all__ = ["PlayOperator", "PlayState"]


class PlayState(NamedTuple):
    """State of a play operator, passed from one call to the next.

    Attributes
    ----------
    command : array or Tensor of shape (n,)
        Last command q [m].
    effective : array or Tensor of shape (n,)
        Last effective change y [m], at most half the width from the command.
    """

    command: Any
    effective: Any


class PlayOperator(HysteresisOperator[PlayState]):
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

    def _start(self, row: NDArray) -> PlayState:
        return PlayState(row, row)

    def _applied(
        self, rows: NDArray, start: PlayState, steps: NDArray
    ) -> tuple[NDArray, PlayState]:
        return _moved(rows, start, self.width / 2, lead=False)

    def _commanded(
        self, rows: NDArray, start: PlayState, steps: NDArray
    ) -> tuple[NDArray, PlayState]:
        return _moved(rows, start, self.width / 2, lead=True)


def played(
    rows: NDArray, command: NDArray, effective: NDArray, half: NDArray
) -> NDArray:
    """Return the results (T, n) of a play operator of half the width `half`.

    Parameters
    ----------
    rows : ndarray of shape (T, n)
        Commands.
    command, effective : ndarray of shape (n,)
        State before the first row.
    half : ndarray of shape () or (n,)
        Half the width.
    """
    return _moved(rows, PlayState(command, effective), half, lead=False)[0]


def _moved(
    rows: NDArray, start: PlayState, half: NDArray, *, lead: bool
) -> tuple[NDArray, PlayState]:
    """Return effective changes (or with `lead` commands), and the last state."""
    if len(rows) and rows.dtype == np.float64 and available():
        result, command, effective = play(rows, start, half, lead)
        return result, PlayState(command, effective)
    command, effective = start
    most = np.finfo(rows.dtype).max / 4  # wider ones never move a tendon
    half = np.minimum(half, most).astype(rows.dtype)
    result = np.empty_like(rows)
    for t, row in enumerate(rows):
        if lead:
            ahead = row + half * np.sign(row - effective)
            command = np.where(row == effective, command, ahead)
            effective = row
            result[t] = command
        else:
            effective = np.clip(effective, row - half, row + half)
            command = row
            result[t] = effective
    return result, PlayState(command, effective)
