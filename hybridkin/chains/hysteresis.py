"""Hysteresis between commands and what the actuators do: the interface of its operators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any, Generic, TypeVar

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import check_shape, labels, real_array
from hybridkin.chains._stages import follow_in_numpy
from hybridkin.native.hysteresis import Stage, follow
from hybridkin.native.library import available

_State = TypeVar("_State", bound=tuple)


class HysteresisOperator(ABC, Generic[_State]):
    """Hysteresis between commanded and effective changes; the operator itself has no state.

    The result depends on the order of the commands, with creep on their times as well. The state is
    passed and returned, so several robots or branches of a plan can share one operator.

    Attributes
    ----------
    kind : str
        What it describes, in words.
    width : ndarray of shape () or (n,)
        Largest distance between two commands with the same effective change, if actuators stay at
        each of them [unit of q].
    creeps : bool
        Whether the result depends on the times of the commands.
    """

    kind: str
    width: NDArray
    creeps = False

    @property
    def parts(self) -> tuple[HysteresisOperator, ...]:
        """The operators in series that it consists of."""
        return (self,)

    def apply(
        self, q: Any, state: _State | None = None, dt: ArrayLike = 1.0
    ) -> tuple[Any, _State]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commanded tendon length changes in order of time [m].
        state : tuple, optional
            State at the end of the previous motion. None: start without hysteresis, y_0 = q_0.
        dt : float or array-like of shape (T,), default=1.0
            Time since the row before, of every row [s]. Only creep needs it. Without `state` the
            first one has no effect.

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
        result, end = self._moved(rows, start, _checked_steps(dt, len(rows)), False)
        return _like(result, q), self._state_for(end, q)

    def command(
        self, y: Any, state: _State | None = None, dt: ArrayLike = 1.0
    ) -> tuple[Any, _State]:
        """Return the commands that give the effective changes y: the inverse of `apply`.

        An actuator without creep whose effective change stays the same keeps its command.

        Parameters
        ----------
        y : array or Tensor of shape (T, n)
            Desired effective changes in order of time [m].
        state : tuple, optional
            State at the end of the previous motion. None: start without hysteresis, q_0 = y_0.
        dt : float or array-like of shape (T,), default=1.0
            Time since the row before, of every row, as in `apply` [s].

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
        result, end = self._moved(rows, start, _checked_steps(dt, len(rows)), True)
        return _like(result, y), self._state_for(end, y)

    def apply_by_group(
        self, q: Any, groups: ArrayLike, time: ArrayLike | None = None
    ) -> Any:
        """Return the effective changes of a log of several motions, each with a new state.

        Parameters
        ----------
        q : array or Tensor of shape (N, n)
            Commanded tendon length changes, the rows of each motion in order of time [m].
        groups : array-like of shape (N,)
            Motion of every row.
        time : array-like of shape (N,), optional
            Time of every row, ascending in each motion [s]. Default: one second from row to row.

        Returns
        -------
        array or Tensor of shape (N, n)
            Effective changes [m].

        Raises
        ------
        ValueError
            For wrong shapes, entries that are not finite or times that decrease.
        """
        rows = real_array(q, "q")
        effective = np.empty_like(rows)
        for motion, steps in _motions(rows, groups, time):
            effective[motion], _ = self.apply(rows[motion], dt=steps)
        return _like(effective, q)

    def inner_states(
        self, q: NDArray, groups: ArrayLike, time: ArrayLike | None = None
    ) -> NDArray:
        """Return what is inside of the operator after every row, beside its result (N, R, n).

        The arguments are those of `apply_by_group`. A single backlash has no such states.
        """
        states = [self._inside(q[:1], 0.0)[:0]]
        order = [np.arange(0)]
        for motion, steps in _motions(q, groups, time):
            states.append(self._inside(q[motion], steps))
            order.append(motion)
        return np.concatenate(states)[np.argsort(np.concatenate(order))]

    @abstractmethod
    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as stages, for kernels."""

    def _inside(self, q: NDArray, steps: ArrayLike) -> NDArray:
        """Return the inner states (T, R, n) of a motion, see `inner_states`."""
        return np.empty((len(q), 0, q.shape[1]))

    @abstractmethod
    def packed(self, state: _State) -> NDArray:
        """Return a state as the kernels keep it (R, n): the command, what is inside, the result."""

    @abstractmethod
    def unpacked(self, rows: NDArray) -> _State:
        """Return the state of rows (R, n) of `packed`."""

    def _moved(
        self, rows: NDArray, start: _State, steps: NDArray, lead: bool
    ) -> tuple[NDArray, _State]:
        """Return effective changes (or with `lead` commands), and the last state."""
        if not len(rows):
            return rows, start
        follow_rows = follow_in_numpy
        if rows.dtype == np.float64 and available():
            follow_rows = follow
        state = self.packed(start).astype(rows.dtype)
        result = follow_rows(self.stages(rows.shape[1]), rows, steps, state, lead)
        return result, self.unpacked(state)

    @property
    @abstractmethod
    def _size(self) -> int | str:
        """Number of actuators; "n" if any."""

    @abstractmethod
    def _start(self, row: NDArray) -> _State:
        """Return the state without hysteresis at a row (n,)."""

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
            return rows, self._checked_state(state, rows.shape[1])
        if not len(rows):
            need = "must hold at least one row if `state` is not given"
            raise ValueError(f"`{name}` {need}.")
        return rows, self._start(rows[0])

    def _checked_state(self, state: Any, n: int) -> _State:
        """Return a caller's state of n actuators, of the kind and the shapes of this operator."""
        expected = self._start(np.zeros(n))
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

    def _state_for(self, state: _State, caller: NDArray | Tensor) -> _State:
        """Return a state in tensors if the caller gave one."""
        return type(state)(*(_like(part, caller) for part in state))


def _motions(
    q: NDArray, groups: ArrayLike, time: ArrayLike | None
) -> Iterator[tuple[NDArray, ArrayLike]]:
    """Yield the rows of each motion, and the time since the row before of each row [s]."""
    check_shape(q, "q", ("N", "n"))
    names = labels(groups, len(q))
    times = None if time is None else checked_times(time, names)
    for name in np.unique(names):
        rows = np.flatnonzero(names == name)
        if times is None:
            yield rows, 1.0
        else:
            yield rows, np.diff(times[rows], prepend=times[rows[:1]])


def checked_times(time: ArrayLike, names: NDArray) -> NDArray:
    """Return the times (N,) of rows [s], which must not decrease within a motion.

    Parameters
    ----------
    time : array-like of shape (N,)
        Times of a caller.
    names : ndarray of shape (N,)
        Motion of every row.
    """
    times = real_array(time, "time").astype(np.float64)
    check_shape(times, "time", (len(names),), "one time for each row")
    if not np.isfinite(times).all():
        raise ValueError("`time` must be finite, got NaN or infinity.")
    for name in np.unique(names).tolist():
        if (np.diff(times[names == name]) < 0.0).any():
            raise ValueError(
                f"`time` must not decrease within a motion, but does in {name!r:.80}. Sort its "
                "rows by time, or give other motions other names."
            )
    return times


def _checked_steps(dt: ArrayLike, n_rows: int) -> NDArray:
    """Return the time since the row before, of every row (T,) [s]."""
    steps = real_array(dt, "dt").astype(np.float64)
    if steps.shape not in ((), (n_rows,)):
        raise ValueError(
            f"`dt` must be a number or have shape ({n_rows},), one time for each row, got shape "
            f"{steps.shape}."
        )
    if not (np.isfinite(steps) & (steps >= 0.0)).all():
        raise ValueError(f"`dt` must be finite, zero or more, got {dt!r:.200}.")
    return np.broadcast_to(steps, n_rows)


def _like(values: NDArray, caller: NDArray | Tensor) -> Any:
    """Return values as a tensor if the caller gave one."""
    if isinstance(caller, Tensor):
        return torch.tensor(values, device=caller.device)
    return values
