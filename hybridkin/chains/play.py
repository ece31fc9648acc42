"""Backlash (also called play) of tendons, modelled by the classical play operator."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import check_shape, labels, real_array
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


class PlayOperator:
    """Backlash (also called play) between commanded and effective tendon length changes.

    The effective change stays constant until the command is half the width away, then follows at
    that distance: ``y_t = clip(y_{t-1}, q_t - width / 2, q_t + width / 2)``. The result depends on
    the order of the commands, not on their speed. The operator itself has no state. The state is
    passed and returned, so several robots or branches of a plan can share one operator.

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

    def apply(self, q: Any, state: PlayState | None = None) -> tuple[Any, PlayState]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commanded tendon length changes in order of time [m].
        state : PlayState, optional
            State at the end of the previous motion. None: start without play, y_0 = q_0.

        Returns
        -------
        y : array or Tensor of shape (T, n)
            Effective changes [m], the input of the robot's model.
        state : PlayState
            State for the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        return self._run(q, state, "q", lead=False)

    def command(self, y: Any, state: PlayState | None = None) -> tuple[Any, PlayState]:
        """Return the commands that give the effective changes y: the inverse of `apply`.

        A moving tendon gets a command half the width ahead; a tendon at rest keeps its command.

        Parameters
        ----------
        y : array or Tensor of shape (T, n)
            Desired effective changes in order of time [m].
        state : PlayState, optional
            State at the end of the previous motion. None: start without play, q_0 = y_0.

        Returns
        -------
        q : array or Tensor of shape (T, n)
            Commands to send [m]. They jump by the width when a tendon reverses.
        state : PlayState
            State for the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        return self._run(y, state, "y", lead=True)

    def apply_by_group(self, q: Any, groups: ArrayLike) -> Any:
        """Return the effective changes of a log of several motions, each with a new state.

        Parameters
        ----------
        q : array or Tensor of shape (N, n)
            Commanded tendon length changes, the rows of each motion in order of time [m].
        groups : array-like of shape (N,)
            Motion of every row.

        Returns
        -------
        array or Tensor of shape (N, n)
            Effective changes [m].

        Raises
        ------
        ValueError
            For wrong shapes or entries that are not finite.
        """
        rows = real_array(q, "q")
        check_shape(rows, "q", ("N", "n"))
        names = labels(groups, len(rows))
        effective = np.empty_like(rows)
        for name in np.unique(names):
            effective[names == name], _ = self.apply(rows[names == name])
        return _like(effective, q)

    def __repr__(self) -> str:
        return f"PlayOperator(width={self.width.tolist()})"

    def _run(
        self, motion: Any, state: PlayState | None, name: str, *, lead: bool
    ) -> tuple[Any, PlayState]:
        """Return the effective changes of commands, or the reverse (`lead`), and the last state."""
        rows = np.array(real_array(motion, name), order="C")  # as the core reads them
        check_shape(rows, name, ("T", self.width.size if self.width.ndim else "n"))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        if not np.isfinite(rows).all():
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
        if state is not None:
            start = _checked(state, rows.shape[1])
        elif len(rows):
            start = PlayState(rows[0], rows[0])
        else:
            need = "must hold at least one row if `state` is not given"
            raise ValueError(f"`{name}` {need}.")
        half = self.width / 2
        if len(rows) and rows.dtype == np.float64 and available():
            result, command, effective = play(rows, start, half, lead)
        else:
            result, command, effective = _moved(rows, start, half, lead)
        last = PlayState(_like(command, motion), _like(effective, motion))
        return _like(result, motion), last


def _moved(
    rows: NDArray, start: PlayState, half: NDArray, lead: bool
) -> tuple[NDArray, NDArray, NDArray]:
    """Return effective changes (or with `lead` commands), last command and effective change."""
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
    return result, command, effective


def _like(values: NDArray, caller: NDArray | Tensor) -> Any:
    """Return values as a tensor if the caller gave one."""
    if isinstance(caller, Tensor):
        return torch.tensor(values, device=caller.device)
    return values


def _checked(state: PlayState, n: int) -> PlayState:
    """Return a caller's state for n tendons, checked."""
    if not isinstance(state, tuple) or len(state) != 2:
        raise TypeError(f"`state` must be a PlayState, got {state!r:.80}.")
    vectors = []
    for part in state:
        vector = real_array(part, "state")
        if vector.shape != (n,) or not np.isfinite(vector).all():
            need = f"must hold two finite vectors of shape ({n},)"
            raise ValueError(f"`state` {need}, got {state!r:.200}.")
        vectors.append(vector)
    return PlayState(*vectors)
