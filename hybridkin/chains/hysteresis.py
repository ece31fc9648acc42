"""Hysteresis between commands and what the actuators do: the interface of its operators."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin._core.arrays import (
    LARGEST,
    Numbers,
    check_shape,
    labels,
    real_array,
)
from hybridkin._core.kernel_numbers import HK_CREEP_ROUNDING
from hybridkin._core.runs import RunOrder
from hybridkin._core.units import LogUnit
from hybridkin.chains._stages import follow_in_numpy
from hybridkin.native.hysteresis import Stage, follow, stage_numbers
from hybridkin.native.library import available


class HysteresisOperator(ABC):
    """Hysteresis between commanded and effective changes; the operator itself has no state.

    An operator does not change: its arrays are read-only, and its attributes are set once.

    The result depends on the order of the commands, with creep on their times as well. The state is
    passed and returned, so several robots or branches of a plan can share one operator. Its rows
    are the last command, what is inside of the operator (plays, slow states), and the last result,
    which is the command of the next operator of a series.

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

    def __setattr__(self, name: str, value: Any) -> None:
        if name in vars(self):
            raise AttributeError(
                f"`{name}` of a {type(self).__name__} cannot change; make a new operator."
            )
        if isinstance(value, np.ndarray):
            value.flags.writeable = False
        super().__setattr__(name, value)

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            setattr(self, name, value)

    @property
    def time_constants(self) -> NDArray:
        """Time constants of creep (J,) [s]; empty without creep."""
        return np.empty(0)

    @property
    def parts(self) -> tuple[HysteresisOperator, ...]:
        """The operators in series that it consists of."""
        return (self,)

    def in_words(self, unit: LogUnit) -> str:
        """Return what it is, with its largest width in the unit of a log."""
        return f"{self.kind} of {unit.in_words(float(self.width.max()))}"

    def apply(
        self, q: Any, state: Numbers | None = None, dt: ArrayLike | None = None
    ) -> tuple[Any, Any]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commanded tendon length changes in order of time [m].
        state : array or Tensor of shape (R, n), optional
            State at the end of the previous motion [unit of q]. None: start without hysteresis,
            y_0 = q_0.
        dt : float or array-like of shape (T,), optional
            Time since the row before, of every row [s]. Creep needs it; without `state` the first
            one has no effect.

        Returns
        -------
        y : array or Tensor of shape (T, n)
            Effective changes [m], the input of the robot's model.
        state : array or Tensor of shape (R, n)
            State for the rows that follow [unit of q].

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        return self._moved(q, "q", state, dt)

    def command(
        self, y: Any, state: Numbers | None = None, dt: ArrayLike | None = None
    ) -> tuple[Any, Any]:
        """Return the commands that give the effective changes y: the inverse of `apply`.

        Of several commands that give the same, where a slope is zero, it is the nearest to the last
        one: an actuator without creep whose effective change stays the same keeps its command. A
        command that could only move an actuator by rounding, as almost all of its motion creeps,
        stays too. Rows in float32 are computed in float64.

        Parameters
        ----------
        y : array or Tensor of shape (T, n)
            Desired effective changes in order of time [m].
        state : array or Tensor of shape (R, n), optional
            State at the end of the previous motion [unit of q]. None: start without hysteresis,
            q_0 = y_0.
        dt : float or array-like of shape (T,), optional
            Time since the row before, of every row, as in `apply` [s].

        Returns
        -------
        q : array or Tensor of shape (T, n)
            Commands to send [m]. They jump by up to `width` when an actuator reverses.
        state : array or Tensor of shape (R, n)
            State for the rows that follow [unit of q].

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        return self._moved(y, "y", state, dt, lead=True)

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
            Time of every row, ascending in each motion [s]. Creep needs it.

        Returns
        -------
        array or Tensor of shape (N, n)
            Effective changes [m].

        Raises
        ------
        ValueError
            For wrong shapes, entries that are not finite, times that decrease, and creep without
            times.
        """
        rows = real_array(q, "q")
        motions = self._motions(rows, groups, time)
        effective = np.empty_like(rows)
        moved = self.followed(motions.rows, motions.steps)
        effective[motions.order] = _like(moved, rows, rows.dtype)
        return _like(effective, q, rows.dtype)

    def inner_states(
        self, q: NDArray, groups: ArrayLike, time: ArrayLike | None = None
    ) -> NDArray:
        """Return what is inside of the operator after every row, beside its result (N, R, n).

        The arguments are those of `apply_by_group`. A single backlash has no such states.
        """
        states = [*self.each_inner_state(q, groups, time)]
        if not states:
            return np.empty((len(q), 0, q.shape[1]))
        return np.stack(states, axis=1)

    def each_inner_state(
        self, q: NDArray, groups: ArrayLike, time: ArrayLike | None = None
    ) -> Iterator[NDArray]:
        """Yield the inner states one by one, each after every row (N, n); see `inner_states`.

        All of them at once would take a multiple of the memory of a long log.
        """
        motions = self._motions(q, groups, time)
        for state in self._each_inside(motions.rows, motions.steps):
            in_place = np.empty_like(state)
            in_place[motions.order] = state
            yield in_place

    @abstractmethod
    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as stages, for kernels."""

    def _each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the inner states (N, n) of motions in a row; the arguments are of `followed`."""
        yield from ()

    def followed(self, rows: NDArray, steps: NDArray) -> NDArray:
        """Return the effective changes (N, n) of motions in a row.

        Parameters
        ----------
        rows : ndarray of shape (N, n)
            Commands, finite, in float64.
        steps : ndarray of shape (N,)
            Time since the row before [s]; `BEGINS` where a motion begins.
        """
        if not len(rows):
            return rows
        stages = self.stages(rows.shape[1])
        state = np.empty((stage_numbers(stages).n_rows, rows.shape[1]))
        return _kernel()(stages, rows, steps, state, False)

    def _motions(
        self, q: NDArray, groups: ArrayLike, time: ArrayLike | None
    ) -> _Motions:
        """Return the motions of a log in a row; the arguments are those of `apply_by_group`."""
        check_shape(q, "q", ("N", "n"))
        names = labels(groups, len(q))
        rows = self._checked(q, "q")
        runs = RunOrder.of(names)
        if time is None:
            if self.creeps and not runs.first.all():
                raise _no_times()
            times = np.zeros(len(q))
        else:
            times = checked_times(time, names)
        return _Motions(rows[runs.order], runs.order, runs.steps(times))

    @property
    @abstractmethod
    def _size(self) -> int | str:
        """Number of actuators; "n" if any."""

    def _moved(
        self,
        motion: Any,
        name: str,
        state: Numbers | None,
        dt: ArrayLike | None,
        lead: bool = False,
    ) -> tuple[Any, Any]:
        """Return effective changes (or with `lead` commands), and the last state."""
        given = real_array(motion, name)
        rows = self._checked(given, name)
        if dt is None:
            dt = 0.0
            if self.creeps and (len(rows) > 1 or state is not None):
                raise _no_times()
        steps = _checked_steps(dt, len(rows))
        stages = self.stages(rows.shape[1])
        last = self._start(rows, name, state, stage_numbers(stages).n_rows)
        rounding = HK_CREEP_ROUNDING * float(np.finfo(given.dtype).eps)
        if len(rows):
            rows = _kernel()(stages, rows, steps, last, lead, rounding)
        return _like(rows, motion, given.dtype), _like(last, motion, given.dtype)

    def _checked(self, given: NDArray, name: str) -> NDArray:
        """Return rows (T, n) in float64, which must be finite, with the actuators in memory."""
        rows = np.array(given, np.float64, order="C")
        check_shape(rows, name, ("T", self._size))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        return _finite(rows, name)

    def _start(
        self, rows: NDArray, name: str, state: Numbers | None, n_rows: int
    ) -> NDArray:
        """Return the state (R, n) before rows (T, n): a copy of the caller's, or at rest."""
        if state is None:
            if not len(rows):
                need = "must hold at least one row if `state` is not given"
                raise ValueError(f"`{name}` {need}.")
            return np.tile(rows[0], (n_rows, 1))
        start = np.array(real_array(state, "state"), np.float64, order="C")
        check_shape(start, "state", (n_rows, rows.shape[1]), f"as {self!r} returns it")
        return _finite(start, "state")


class _Motions(NamedTuple):
    """The motions of a log in a row, as kernels follow them.

    Attributes
    ----------
    rows : ndarray of shape (N, n)
        Commands, motion after motion [unit of q].
    order : ndarray of int of shape (N,)
        Their rows in the log.
    steps : ndarray of shape (N,)
        Time since the row before [s]; `BEGINS` where a motion begins.
    """

    rows: NDArray
    order: NDArray[np.intp]
    steps: NDArray


def _kernel() -> Callable[..., NDArray]:
    """Return what follows rows: the compiled core, or without it NumPy."""
    return follow if available() else follow_in_numpy


def _no_times() -> ValueError:
    """Return the error for commands without times of actuators that creep."""
    return ValueError(
        "the times of the rows [s] must be given, as the actuators creep: `dt` or `time` of an "
        "operator, Commands(q, runs, time) of a model, --time of `hybridkin`."
    )


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
    late = RunOrder.of(names).late(times)
    if len(late):
        name = names[late].tolist()[0]
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


def _finite(values: NDArray, name: str) -> NDArray:
    """Return numbers as far as sums of them are finite; raise if they are not."""
    if not np.isfinite(values).all():
        raise ValueError(f"`{name}` must be finite, got NaN or infinity.")
    return values.clip(-LARGEST, LARGEST)


def _like(values: NDArray, caller: NDArray | Tensor, dtype: np.dtype) -> Any:
    """Return values in a precision, within its range, as a tensor if the caller gave one."""
    largest = min(float(np.finfo(dtype).max), float(LARGEST))
    rounded = values.clip(-largest, largest).astype(dtype)
    if isinstance(caller, Tensor):
        return torch.tensor(rounded, device=caller.device)
    return rounded
