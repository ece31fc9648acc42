"""Backlash (also called play) of tendons, modelled by the classical play operator."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from hybridkin._core.arrays import as_tensor, check_shape, labels, real_array
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


_Step = Callable[[Tensor, PlayState, Tensor], PlayState]  # row, state before, half the width


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

        def follow(row: Tensor, at: PlayState, half: Tensor) -> PlayState:
            return PlayState(
                row, torch.minimum(torch.maximum(at.effective, row - half), row + half)
            )

        return self._run(q, state, "q", follow, 1)

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

        def lead(row: Tensor, at: PlayState, half: Tensor) -> PlayState:
            ahead = row + half * torch.sign(row - at.effective)
            return PlayState(torch.where(row == at.effective, at.command, ahead), row)

        return self._run(y, state, "y", lead, 0)

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
        q = q if isinstance(q, Tensor) else rows
        groups = labels(groups, len(q))
        order = np.argsort(groups, kind="stable")  # a motion's rows keep their order
        starts = np.flatnonzero(groups[order][1:] != groups[order][:-1]) + 1
        parts = [self.apply(q[at])[0] for at in np.split(order, starts)]
        back = np.argsort(order)
        return torch.cat(parts)[back] if isinstance(q, Tensor) else np.concatenate(parts)[back]

    def __repr__(self) -> str:
        return f"PlayOperator(width={self.width.tolist()})"

    def _run(
        self, given: Any, state: PlayState | None, name: str, step: _Step, wanted: int
    ) -> tuple[Any, PlayState]:
        """Return the entry `wanted` of the state after every given row, and the last state."""
        as_numpy = not isinstance(given, Tensor)
        rows = real_array(given, name) if as_numpy else given.to(as_tensor(given, name).dtype)
        check_shape(rows, name, ("T", self.width.size if self.width.ndim else "n"))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        if not (rows.isfinite() if isinstance(rows, Tensor) else np.isfinite(rows)).all():
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
        if state is None and not len(rows):
            raise ValueError(f"`{name}` must hold at least one row if `state` is not given.")
        given = state if isinstance(state, (tuple, list)) else ()
        start = [rows[0]] * 2 if state is None else [real_array(part, "state") for part in given]
        shapes = [tuple(part.shape) for part in start]
        finite = state is None or all(np.isfinite(part).all() for part in start)
        if shapes != [tuple(rows.shape[1:])] * 2 or not finite:
            need = f"must hold two finite vectors of shape ({rows.shape[1]},)"
            raise ValueError(f"`state` {need}, got {state!r:.200}.")
        if isinstance(rows, np.ndarray):
            if len(rows) and rows.dtype == np.float64 and available():
                found, *last = play(rows, start, self.width / 2, wanted == 0)
                return found, PlayState(*last)
            rows = torch.tensor(rows, device="cpu")
        at = PlayState(*(torch.as_tensor(part, device=rows.device).to(rows) for part in start))
        found, half = [], as_tensor(self.width / 2, "width").to(rows)
        for row in rows:
            at = step(row, at, half)
            found.append(at[wanted])
        out = torch.stack(found) if found else rows.clone()
        if not as_numpy:
            return out, at
        return out.numpy(), PlayState(*(part.numpy() for part in at))
