"""Backlash (also called play) of tendons, modelled by the classical play operator."""

from __future__ import annotations

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

    def apply(self, q: object, state: PlayState | None = None) -> tuple[Any, PlayState]:
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

    def command(
        self, y: object, state: PlayState | None = None
    ) -> tuple[Any, PlayState]:
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
        if not isinstance(q, Tensor):
            q = rows
        groups = labels(groups, len(q))
        order = np.argsort(groups, kind="stable")  # a motion's rows keep their order
        starts = np.flatnonzero(groups[order][1:] != groups[order][:-1]) + 1
        parts = [self.apply(q[at])[0] for at in np.split(order, starts)]
        back = np.argsort(order)
        if isinstance(q, Tensor):
            return torch.cat(parts)[back]
        return np.concatenate(parts)[back]

    def __repr__(self) -> str:
        return f"PlayOperator(width={self.width.tolist()})"

    def _run(
        self, motion: Any, state: PlayState | None, name: str, *, lead: bool
    ) -> tuple[Any, PlayState]:
        """Return the effective changes of commands, or the reverse (`lead`), and the last state."""
        rows = motion if isinstance(motion, Tensor) else real_array(motion, name)
        if isinstance(motion, Tensor):
            rows = motion.to(as_tensor(motion, name).dtype)
        check_shape(rows, name, ("T", self.width.size if self.width.ndim else "n"))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        if not _is_finite(rows):
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
        if state is None and not len(rows):
            raise ValueError(
                f"`{name}` must hold at least one row if `state` is not given."
            )
        if state is None:
            start = PlayState(rows[0], rows[0])
        else:
            start = _checked(state, rows.shape[1])
        if isinstance(rows, Tensor):
            return self._by_torch(rows, start, lead)
        if len(rows) and rows.dtype == np.float64 and available():
            result, *last = play(rows, start, self.width / 2, lead)
            return result, PlayState(*last)
        result, last = self._by_torch(torch.tensor(rows, device="cpu"), start, lead)
        return result.numpy(), PlayState(last.command.numpy(), last.effective.numpy())

    def _by_torch(
        self, rows: Tensor, start: PlayState, lead: bool
    ) -> tuple[Tensor, PlayState]:
        command, effective = (
            torch.as_tensor(a, device=rows.device).to(rows) for a in start
        )
        half = as_tensor(self.width / 2, "width").to(rows)
        result = []
        for row in rows:
            if lead:
                ahead = row + half * torch.sign(row - effective)
                command = torch.where(row == effective, command, ahead)
                effective = row
            else:
                effective = torch.minimum(
                    torch.maximum(effective, row - half), row + half
                )
                command = row
            result.append(command if lead else effective)
        state = PlayState(command, effective)
        return (torch.stack(result) if result else rows.clone()), state


def _is_finite(a: Any) -> bool:
    return bool((a.isfinite() if isinstance(a, Tensor) else np.isfinite(a)).all())


def _checked(state: object, n: int) -> PlayState:
    """Return a caller's state for n tendons, checked."""
    parts = state if isinstance(state, (tuple, list)) else ()
    vectors = [real_array(part, "state") for part in parts]
    good = len(vectors) == 2 and all(
        a.shape == (n,) and np.isfinite(a).all() for a in vectors
    )
    if not good:
        need = f"must hold two finite vectors of shape ({n},)"
        raise ValueError(f"`state` {need}, got {state!r:.200}.")
    return PlayState(*vectors)
