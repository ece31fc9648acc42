"""Commands in order of time: which rows follow each other, and when."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from typing_extensions import Self

from hybridkin._core.arrays import check_shape, labels, real_array, table

__all__ = ["Commands"]


class Commands:
    """Actuator vectors in order of time: which rows follow each other, and when.

    Only models with hysteresis need it: all methods of a `HybridForwardModel` take it as `X`.
    ``commands[rows]`` are some of the rows, so scikit-learn can split them.

    Parameters
    ----------
    q : array-like of shape (N, n)
        Commands, in the unit of q.
    runs : array-like of shape (N,), optional
        Run of every row. The rows of a run follow each other without a break, and each run starts
        without hysteresis. Default: one run; for a fit with `groups`, each group.
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
        if runs is not None:
            self.runs = labels(runs, len(self), "runs")
        if time is not None:
            self.time = real_array(time, "time").astype(np.float64)
            check_shape(self.time, "time", (len(self),), "one time for each row")

    @classmethod
    def of(cls, X: Any) -> Self:
        """Return the commands of a caller, who may give an array: one run."""
        return X if isinstance(X, cls) else cls(table(X, "X"))

    @property
    def shape(self) -> tuple[int, int]:
        """Numbers of rows and actuators."""
        return self.q.shape

    @property
    def run_of_rows(self) -> NDArray:
        """The run of every row, (N,)."""
        return np.zeros(len(self)) if self.runs is None else self.runs

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.q)

    def __getitem__(self, rows: Any) -> Self:
        """Return some of the rows: a slice, indices or a mask (N,)."""
        if isinstance(rows, tuple):  # as scikit-learn indexes: (rows, ...)
            rows = rows[0]
        q = self.q.iloc[rows] if hasattr(self.q, "iloc") else self.q[rows]
        runs = None if self.runs is None else self.runs[rows]
        time = None if self.time is None else self.time[rows]
        return type(self)(q, runs, time)
