"""Commands in order of time: which rows follow each other, and when."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import check_shape, labels, real_array, table
from hybridkin._core.clock import ClockDoubt, clock_doubt
from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.runs import RunOrder

__all__ = ["Commands"]


class Commands:
    """Actuator vectors in order of time: which rows follow each other, and when.

    Only models with hysteresis need it: all methods of a `HybridForwardModel` take it as `X`.
    ``commands[rows]`` are some of the rows, also for the number of a single one, so scikit-learn
    can split them. They are no array: `permutation_importance`, for example, would lose the order.

    Parameters
    ----------
    q : array-like of shape (N, n)
        Commands, in the unit of q.
    runs : array-like of shape (N,), optional
        Run of every row, none missing. The rows of a run follow each other without a break, and
        each run starts without hysteresis. Default: one run; for a fit with `groups`, each group.
    time : array-like of shape (N,), optional
        Time of every row, ascending in each run [s]. Only creep needs it.

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import Commands
    >>> commands = Commands(np.zeros((4, 3)), runs=[0, 0, 1, 1], time=[0.0, 0.1, 0.0, 0.1])
    >>> commands[2:].runs
    array([1, 1])
    """

    def __init__(
        self, q: Any, runs: ArrayLike | None = None, time: ArrayLike | None = None
    ) -> None:
        self.q: Any = q if hasattr(q, "columns") else real_array(q, "q")
        self.runs: NDArray | None = None
        self.time: NDArray | None = None
        check_shape(self.q, "q", ("N", "n"), "one command in each row")
        if runs is not None:
            self.runs = labels(runs, len(self), "runs")
        if time is not None:
            self.time = real_array(time, "time").astype(np.float64)
            check_shape(self.time, "time", (len(self),), "one time for each row")

    @classmethod
    def of(cls, X: Any) -> Self:
        """Return the commands of a caller, who may give an array: one run.

        The shape of an array is not checked; scikit-learn's own checks follow.
        """
        if isinstance(X, cls):
            return X
        commands = cls(np.zeros((0, 0)))
        commands.q = table(X, "X")
        return commands

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and actuators."""
        return self.q.shape

    @property
    def run_of_rows(self) -> NDArray:
        """The run of every row, (N,)."""
        return np.zeros(len(self)) if self.runs is None else self.runs

    @property
    def order(self) -> RunOrder:
        """The order in which runs come one after the other: its rows, and where runs begin."""
        return RunOrder.of(self.run_of_rows)

    @property
    def clock_doubt(self) -> ClockDoubt:
        """Why the times seem to have another unit than seconds; its `unit` is empty if not."""
        if self.time is None:
            return ClockDoubt()
        return clock_doubt(self.time, self.run_of_rows)

    @property
    def directions(self) -> Directions:
        """The directions of q that the rows move, and those in which nothing can be learned."""
        return moved_directions(np.asarray(self.q))

    def up_to(self, rows: NDArray) -> NDArray[np.intp]:
        """Return all rows that move the actuators of some rows (K,): those before in their runs."""
        return self.order.up_to(rows)

    def spread_rows(self, most: int) -> NDArray[np.intp]:
        """Return at most `most` rows, ascending: of some of the runs, some rows of each.

        All runs are used if each can have ten rows, or all of fewer, else a part of them, spread
        over all. Each has rows in proportion to its length.
        """
        return self.order.spread_rows(most)

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.q)

    def __getitem__(self, rows: Any) -> Self:
        """Return some of the rows: a slice, indices, a mask (N,), or the number of one row."""
        if isinstance(rows, tuple):  # as scikit-learn indexes: (rows, ...)
            rows = rows[0]
        if isinstance(rows, (int, np.integer)):
            rows = [range(len(self))[rows]]
        q = self.q.iloc[rows] if hasattr(self.q, "iloc") else self.q[rows]
        runs = None if self.runs is None else self.runs[rows]
        time = None if self.time is None else self.time[rows]
        return type(self)(q, runs, time)

    def __array__(self, *_: object, **__: object) -> NDArray:
        """Raise: an array would lose the runs and the order of the rows."""
        raise TypeError(
            "Commands are no array: the order of their rows, runs and times count. Functions that "
            "change single columns or rows, such as permutation_importance, take `commands.q`, for "
            "a model without hysteresis."
        )

    def __repr__(self) -> str:
        """Return a one-line summary."""
        n_rows, n = self.shape
        parts = [f"{n_rows} rows of {n} actuators"]
        if self.runs is not None:
            parts.append(f"{len(np.unique(self.runs))} runs")
        if self.time is not None and n_rows:
            parts.append(f"time from {self.time.min():.6g} to {self.time.max():.6g} s")
        return f"{type(self).__name__}({', '.join(parts)})"
