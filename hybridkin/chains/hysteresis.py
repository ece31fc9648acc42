"""Hysteresis between commands and what the actuators do: the interface of its operators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import check_shape, labels, real_array

_State = TypeVar("_State", bound=tuple)


class HysteresisOperator(ABC, Generic[_State]):
    """Hysteresis between commanded and effective changes; the operator itself has no state.

    The result depends on the order of the commands, not on their speed. The state is passed and
    returned, so several robots or branches of a plan can share one operator.

    Attributes
    ----------
    width : ndarray of shape () or (n,)
        Largest distance between two commands with the same effective change [unit of q].
    """

    width: NDArray

    def apply(self, q: Any, state: _State | None = None) -> tuple[Any, _State]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commanded tendon length changes in order of time [m].
        state : tuple, optional
            State at the end of the previous motion. None: start without hysteresis, y_0 = q_0.

        Returns
        -------
        y : array or Tensor of shape (T, n)
            Effective changes [m], the input of the robot's model.
        state : tuple
            State for the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        rows, start = self._checked(q, state, "q")
        result, end = self._applied(rows, start)
        return _like(result, q), _like_caller(end, q)

    def command(self, y: Any, state: _State | None = None) -> tuple[Any, _State]:
        """Return the commands that give the effective changes y: the inverse of `apply`.

        An actuator whose effective change stays the same keeps its command.

        Parameters
        ----------
        y : array or Tensor of shape (T, n)
            Desired effective changes in order of time [m].
        state : tuple, optional
            State at the end of the previous motion. None: start without hysteresis, q_0 = y_0.

        Returns
        -------
        q : array or Tensor of shape (T, n)
            Commands to send [m]. They jump by up to `width` when an actuator reverses.
        state : tuple
            State for the rows that follow.

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        rows, start = self._checked(y, state, "y")
        result, end = self._commanded(rows, start)
        return _like(result, y), _like_caller(end, y)

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

    @property
    @abstractmethod
    def _size(self) -> int | str:
        """Number of actuators; "n" if any."""

    @abstractmethod
    def _start(self, row: NDArray) -> _State:
        """Return the state without hysteresis at a row (n,)."""

    @abstractmethod
    def _applied(self, rows: NDArray, start: _State) -> tuple[NDArray, _State]:
        """Return the effective changes of commands (T, n), and the last state."""

    @abstractmethod
    def _commanded(self, rows: NDArray, start: _State) -> tuple[NDArray, _State]:
        """Return the commands of effective changes (T, n), and the last state."""

    def _checked(
        self, motion: Any, state: _State | None, name: str
    ) -> tuple[NDArray, _State]:
        """Return a caller's rows (T, n) as the core reads them, and the state before them."""
        rows = np.array(real_array(motion, name), order="C")
        check_shape(rows, name, ("T", self._size))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        if not np.isfinite(rows).all():
            raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
        if state is not None:
            return rows, _checked_state(state, self._start(np.zeros(rows.shape[1])))
        if not len(rows):
            need = "must hold at least one row if `state` is not given"
            raise ValueError(f"`{name}` {need}.")
        return rows, self._start(rows[0])


def _checked_state(state: Any, expected: _State) -> _State:
    """Return a caller's state, which must have the kind and the shapes of the expected one."""
    kind = type(expected)
    if not isinstance(state, tuple) or len(state) != len(expected):
        raise TypeError(f"`state` must be a {kind.__name__}, got {state!r:.80}.")
    arrays = [real_array(part, "state") for part in state]
    shapes = [part.shape for part in expected]
    finite = all(np.isfinite(array).all() for array in arrays)
    if not finite or [array.shape for array in arrays] != shapes:
        need = f"must hold finite arrays of shapes {', '.join(map(str, shapes))}"
        raise ValueError(f"`state` {need}, got {state!r:.200}.")
    return kind(*arrays)


def _like_caller(state: _State, caller: NDArray | Tensor) -> _State:
    return type(state)(*(_like(part, caller) for part in state))


def _like(values: NDArray, caller: NDArray | Tensor) -> Any:
    """Return values as a tensor if the caller gave one."""
    if isinstance(caller, Tensor):
        return torch.tensor(values, device=caller.device)
    return values
