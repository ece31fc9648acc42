"""Hysteresis between the commands and what the actuators do, as a value: stages in series."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from typing_extensions import Self

import hybridkin.hysteresis.stages as _stages  # noqa: F401  registers them for files
from hybridkin._core.actuation import Actuation, StageNumbers
from hybridkin._core.arrays import (
    LARGEST,
    Numbers,
    check_shape,
    labels,
    real_array,
)
from hybridkin._core.commands import Commands
from hybridkin._core.runs import RunOrder
from hybridkin._core.stored import Stored
from hybridkin._core.units import LogUnit
from hybridkin.hysteresis.follow import follow, followed, n_state_rows, stage_numbers
from hybridkin.hysteresis.reversals import Coarseness
from hybridkin.hysteresis.stage import STAGE_OF_KIND, Fixed, Stage
from hybridkin.hysteresis.stages.backlash import Backlash
from hybridkin.hysteresis.stages.creep import Creep
from hybridkin.hysteresis.stages.friction import Friction

__all__ = ["Hysteresis"]


class Hysteresis(Fixed, Actuation):
    """Hysteresis of actuators: stages, each of which gets the result of the one before.

    `Hysteresis()` has no stage: actuators do what they are commanded; it is falsy. `backlash`,
    `friction` and `creep` have one, and ``a | b`` has the stages of a before those of b, in any
    order. A hysteresis is a value: it has no state, does not change, and is equal to others with
    the same stages.

    The result depends on the order of the commands, with creep on their times as well. The state is
    passed and returned, so several robots or branches of a plan can share one hysteresis. Its rows
    are the command; then of every stage what is inside of it (plays, slow parts), and its result,
    which is the command of the next stage.

    Parameters
    ----------
    stages : iterable of Stage, default=()
        The stages; the first one gets the commands.

    Attributes
    ----------
    stages : tuple of Stage
        The stages.
    kind : str
        What it describes, in words.
    width : ndarray of shape () or (n,)
        Bound of the distance between two commands with the same effective change, if actuators stay
        at each of them: the sum of those of the stages [unit of q].
    needs_time : bool
        Whether the result depends on the times of the commands.
    time_constants : ndarray of shape (J,)
        Time constants of creep [s]; empty without creep.
    n_actuators : int
        Number of actuators; 0: any.

    References
    ----------
    Krasnosel'skii & Pokrovskii, Systems with Hysteresis, Springer 1989, sections 2 and 34.
    Kuhnen, Modeling, identification and compensation of complex hysteretic nonlinearities,
    European Journal of Control 9, 2003: the inverse.
    Kuhnen & Krejci, Compensation of complex hysteresis and creep effects in piezoelectrically
    actuated systems, IEEE Transactions on Automatic Control 54, 2009: linear creep in series.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import Hysteresis
    >>> hysteresis = Hysteresis.backlash(0.5) | Hysteresis.creep([0.2], [10.0])
    >>> hysteresis
    Hysteresis.backlash(width=0.5) | Hysteresis.creep(shares=[0.2], times=[10.0])
    >>> y, state = hysteresis.apply(np.array([[0.0], [1.0], [1.0]]), dt=1.0)
    >>> y.ravel().round(3)
    array([0.   , 0.614, 0.627])
    >>> hysteresis.command(y, dt=1.0)[0].ravel()
    array([0., 1., 1.])
    >>> bool(hysteresis), bool(Hysteresis())
    (True, False)
    """

    def __init__(self, stages: Iterable[Stage] = ()) -> None:
        self.stages: tuple[Stage, ...] = tuple(stages)
        for stage in self.stages:
            if not isinstance(stage, Stage):
                raise TypeError(
                    "`stages` must hold stages, e.g. those of Hysteresis.backlash(0.001).stages, "
                    f"got {stage!r:.80}."
                )
        sizes = {stage.n_actuators for stage in self.stages} - {0}
        if len(sizes) > 1:
            raise ValueError(f"`stages` must be for equally many actuators, got {sorted(sizes)}.")
        self.n_actuators = max(sizes, default=0)
        self.needs_time = any(stage.needs_time for stage in self.stages)
        widths = [np.zeros(()), *(stage.width for stage in self.stages)]
        self.width: NDArray = np.array(sum(widths))
        times = [np.empty(0), *(stage.time_constants for stage in self.stages)]
        self.time_constants: NDArray = np.concatenate(times)

    @staticmethod
    def coarseness(commands: Commands) -> Coarseness:
        """Return how coarsely commands show the reversals that hysteresis depends on.

        Parameters
        ----------
        commands : Commands
            The rows of each run in order of time.

        Returns
        -------
        Coarseness
            ``reversing`` (n,), the share of the rows within runs at which an actuator reverses;
            ``missed`` (n,), the median way beyond these rows [unit of q]; ``shows_reversals``,
            whether at most a third of the rows are reversals.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import Commands, Hysteresis
        >>> slow = np.sin(np.linspace(0.0, 9.0, 60))[:, None]
        >>> Hysteresis.coarseness(Commands(slow)).shows_reversals
        True
        >>> Hysteresis.coarseness(Commands(slow[::12])).shows_reversals
        False
        """
        return Coarseness.of(np.asarray(commands.q), commands.run_of_rows)

    @classmethod
    def backlash(cls, width: ArrayLike) -> Self:
        """Return backlash (also called play) between the commands and the effective changes.

        The effective change stays constant until the command is half the width away, then follows
        at that distance: ``y_t = clip(y_{t-1}, q_t - width / 2, q_t + width / 2)``. The result
        depends on the order of the commands, not on their speed. The commands of `command` lead by
        half the width.

        Parameters
        ----------
        width : float or array-like of shape (n,)
            Total backlash of all actuators or of each [unit of q], zero or more. If all are zero,
            there is no hysteresis.

        Returns
        -------
        Hysteresis
            One stage, or none.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import Hysteresis
        >>> backlash = Hysteresis.backlash(0.5)
        >>> y, state = backlash.apply(np.array([[0.0], [1.0], [0.75], [0.0]]))
        >>> y.ravel()
        array([0.  , 0.75, 0.75, 0.25])
        >>> q, state = backlash.command(np.array([[0.5], [0.0]]), state)
        >>> q.ravel()
        array([ 0.75, -0.25])
        """
        stage = Backlash(width)
        return cls([stage] if stage.width.any() else [])

    @classmethod
    def friction(cls, widths: ArrayLike, slopes: ArrayLike) -> Self:
        """Return friction whose loops have no sharp corners: a weighted sum of plays.

        With the results P_k of backlashes of K widths, ``y = P_K + sum_k s_k (P_k - P_{k+1})``
        (Prandtl-Ishlinskii). After a reversal the first play moves first. While plays 1 to k move,
        y moves s_k times as far as the command; once all move, just as far. One backlash of width w
        has the slopes 0 below w and 1 above it. A single width without slopes is that backlash.

        Parameters
        ----------
        widths : array-like of shape (K,)
            Widths of the plays, ascending from zero or more [unit of q].
        slopes : array-like of shape (K - 1,) or (K - 1, n)
            Slopes s_k of all actuators or of each, zero or more [1].

        Returns
        -------
        Hysteresis
            One stage.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import Hysteresis
        >>> friction = Hysteresis.friction([0.0, 1.0], [0.5])
        >>> y, state = friction.apply(np.array([[0.0], [0.5], [2.0], [1.5]]))
        >>> y.ravel()
        array([0.  , 0.25, 1.75, 1.5 ])
        >>> friction.command(y)[0].ravel()
        array([0. , 0.5, 2. , 1.5])
        """
        return cls([Friction(widths, slopes)])

    @classmethod
    def creep(cls, shares: ArrayLike, times: ArrayLike) -> Self:
        """Return creep, as of polymers: a part of every change comes only with time.

        A share g_j of every change comes with the time constant tau_j, the rest at once::

            s_j,t = q_t + exp(-dt_t / tau_j) (s_j,t-1 - q_t)
            y_t = (1 - sum_j g_j) q_t + sum_j g_j s_j,t

        At rest y = q, so a static model is the limit of the model with creep, and its width is
        zero. The commands of a motion lead by more, the faster it is.

        Parameters
        ----------
        shares : array-like of shape (J,) or (J, n)
            Shares g_j of all actuators or of each, zero or more, with a sum below 1 [1].
        times : array-like of shape (J,)
            Time constants tau_j [s].

        Returns
        -------
        Hysteresis
            One stage.

        Examples
        --------
        >>> import numpy as np
        >>> from hybridkin import Hysteresis
        >>> creep = Hysteresis.creep([0.2], [10.0])
        >>> y, state = creep.apply(np.array([[0.0], [1.0], [1.0]]), dt=[0.0, 1.0, 30.0])
        >>> y.ravel().round(3)
        array([0.   , 0.819, 0.991])
        >>> creep.command(y, dt=[0.0, 1.0, 30.0])[0].ravel()
        array([0., 1., 1.])
        """
        return cls([Creep(shares, times)])

    def __or__(self, after: Hysteresis) -> Hysteresis:
        """Return the stages of this hysteresis before those of another one."""
        if not isinstance(after, Hysteresis):
            return NotImplemented
        return Hysteresis([*self.stages, *after.stages])

    def __repr__(self) -> str:
        names = [f"Hysteresis.{stage!r}" for stage in self.stages]
        return " | ".join(names) or "Hysteresis()"

    @property
    def kind(self) -> str:
        """What it describes, in words."""
        return " and ".join(stage.kind for stage in self.stages)

    def in_words(self, unit: LogUnit) -> str:
        """Return what it is, with the largest width of each stage in the unit of a log."""
        return " and ".join(stage.in_words(unit) for stage in self.stages)

    def apply(
        self, q: Any, state: Numbers | None = None, dt: ArrayLike | None = None
    ) -> tuple[Any, Any]:
        """Return the effective changes of a motion, and the state at its end.

        Parameters
        ----------
        q : array or Tensor of shape (T, n)
            Commands in order of time [unit of q].
        state : array or Tensor of shape (R, n), optional
            State at the end of the previous motion [unit of q]. Default: start without hysteresis,
            y_0 = q_0.
        dt : float or array-like of shape (T,), optional
            Time since the row before, of every row [s]. Creep needs it; without `state` the first
            one has no effect.

        Returns
        -------
        y : array or Tensor of shape (T, n)
            Effective changes [unit of q], the input of the robot's model.
        state : array or Tensor of shape (R, n)
            State for the rows that follow [unit of q]; no rows without hysteresis.

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
            Desired effective changes in order of time [unit of q].
        state : array or Tensor of shape (R, n), optional
            State at the end of the previous motion [unit of q]. Default: start without hysteresis,
            q_0 = y_0.
        dt : float or array-like of shape (T,), optional
            Time since the row before, of every row, as in `apply` [s].

        Returns
        -------
        q : array or Tensor of shape (T, n)
            Commands to send [unit of q]. They jump by up to `width` when an actuator reverses.
        state : array or Tensor of shape (R, n)
            State for the rows that follow [unit of q].

        Raises
        ------
        ValueError
            For a wrong shape, for entries that are not finite, or for no rows without a state.
        """
        return self._moved(y, "y", state, dt, lead=True)

    def apply_by_group(self, q: Any, groups: ArrayLike, time: ArrayLike | None = None) -> Any:
        """Return the effective changes of a log of several motions, each with a new state.

        Parameters
        ----------
        q : array or Tensor of shape (N, n)
            Commands, the rows of each motion in order of time [unit of q].
        groups : array-like of shape (N,)
            Motion of every row.
        time : array-like of shape (N,), optional
            Time of every row, ascending in each motion [s]. Creep needs it.

        Returns
        -------
        array or Tensor of shape (N, n)
            Effective changes [unit of q].

        Raises
        ------
        ValueError
            For wrong shapes, entries that are not finite, times that decrease, and creep without
            times.
        """
        rows = real_array(q, "q")
        motions = self._motions(rows, groups, time)
        effective = np.empty_like(rows)
        moved = followed(self.stages, motions.rows, motions.steps)
        effective[motions.order] = _like(moved, rows, rows.dtype)
        return _like(effective, q, rows.dtype)

    def inner_states(self, q: NDArray, groups: ArrayLike, time: ArrayLike | None = None) -> NDArray:
        """Return what is inside of the stages after every row, beside their results (N, R, n).

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
        rows = motions.rows
        for stage in self.stages:
            for state in stage.each_inside(rows, motions.steps):
                in_place = np.empty_like(state)
                in_place[motions.order] = state
                yield in_place
            if stage is not self.stages[-1]:
                rows = followed([stage], rows, motions.steps)

    def stage_numbers(self, n: int) -> StageNumbers:
        """Return the stages for n actuators as the kernels read them."""
        return stage_numbers(self.stages, n)

    def stored(self) -> Stored:
        """Return the description of the hysteresis for a file."""
        parts = {str(k): stage.stored() for k, stage in enumerate(self.stages)}
        return Stored.of("hysteresis", parts=parts)

    @classmethod
    def from_stored(cls, stored: Stored, n: int) -> Self:
        """Return the hysteresis of n actuators from its description."""
        stages = []
        for part in stored.parts.values():
            kind = STAGE_OF_KIND.get(part.kind)
            if kind is None:
                raise ValueError(f"unknown kind of hysteresis {part.kind!r:.60}")
            stages.append(kind.from_stored(part))
        hysteresis = cls(stages)
        if hysteresis.n_actuators not in (0, n):
            raise ValueError(f"a hysteresis of {hysteresis.n_actuators} actuators does not fit {n}")
        return hysteresis

    def _motions(self, q: NDArray, groups: ArrayLike, time: ArrayLike | None) -> _Motions:
        """Return the motions of a log in a row; the arguments are those of `apply_by_group`."""
        check_shape(q, "q", ("N", "n"))
        names = labels(groups, len(q))
        rows = self._checked(q, "q")
        runs = RunOrder.of(names)
        if time is None:
            if self.needs_time and not runs.first.all():
                raise _no_times()
            times = np.zeros(len(q))
        else:
            times = checked_times(time, names)
        return _Motions(rows[runs.order], runs.order, runs.steps(times))

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
            if self.needs_time and (len(rows) > 1 or state is not None):
                raise _no_times()
        steps = _checked_steps(dt, len(rows))
        last = self._start(rows, name, state)
        precision = float(np.finfo(given.dtype).eps)
        rows = follow(self.stages, rows, steps, last, lead, precision)
        return _like(rows, motion, given.dtype), _like(last, motion, given.dtype)

    def _checked(self, given: NDArray, name: str) -> NDArray:
        """Return rows (T, n) in float64, which must be finite, with the actuators in memory."""
        rows = np.array(given, np.float64, order="C")
        check_shape(rows, name, ("T", self.n_actuators or "n"))
        if not rows.shape[1]:
            raise ValueError(f"`{name}` must hold at least one actuator, got none.")
        return _finite(rows, name)

    def _start(self, rows: NDArray, name: str, state: Numbers | None) -> NDArray:
        """Return the state (R, n) before rows (T, n): a copy of the caller's, or at rest."""
        n_rows = n_state_rows(self.stages)
        if state is None:
            if not len(rows):
                need = "must hold at least one row if `state` is not given"
                raise ValueError(f"`{name}` {need}.")
            return np.tile(rows[0], (n_rows, 1))
        start = np.array(real_array(state, "state"), np.float64, order="C")
        check_shape(start, "state", (n_rows, rows.shape[1]), f"as {self!r} returns it")
        return _finite(start, "state")


NO_HYSTERESIS = Hysteresis()


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


def _no_times() -> ValueError:
    """Return the error for commands without times of actuators that creep."""
    return ValueError(
        "the times of the rows [s] must be given, as the actuators creep: `dt` or `time` of a "
        "hysteresis, Commands(q, runs, time) of a model, --time of `hybridkin`."
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
