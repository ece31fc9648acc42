"""Measured rows of a log on their way through a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.digests import row_digests
from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin._core.groups import Groups
from hybridkin.hysteresis.value import Hysteresis


@dataclass(frozen=True)
class Rows:
    """Measured rows, as they were given or with equal rows merged, see `distinct`."""

    X: NDArray  # (N, n) actuator vectors, float64 or float32
    y: NDArray  # (N, m) or (N,) tips [m]
    counts: NDArray  # (N,), number of times each row counts
    groups: Groups  # motion of every row; held out together
    runs: NDArray  # (N,), which rows follow each other in time without a break
    place: NDArray  # (M,), the row here of each of the M given rows; -1: none
    # Shaped like y: measured minus mechanical model [m], in a fit; y without such a model
    residual: NDArray
    time: NDArray  # (N,) [s]; zeros without times
    timed: bool  # whether the rows have times
    commanded: Directions | None = None  # of the commands, with hysteresis before X

    @classmethod
    def of(
        cls,
        X: NDArray,
        y: NDArray,
        weights: ArrayLike | None = None,
        groups: ArrayLike | Groups | None = None,
        runs: NDArray | None = None,
        time: NDArray | None = None,
    ) -> Self:
        """Return rows as they were measured.

        Parameters
        ----------
        X, y : ndarray of shape (N, n), and of shape (N, m) or (N,)
            Actuator vectors and tips [m].
        weights : ndarray of shape (N,), optional
            Number of times each row counts. Default: ones.
        groups : Groups or array-like of shape (N,), optional
            Motion of every row. Default: every row is a group.
        runs : ndarray of shape (N,), optional
            Run of every row. Default: the groups, or one run without groups.
        time : ndarray of shape (N,), optional
            Times [s].
        """
        n_rows = len(X)
        if weights is None:
            weights = np.ones(n_rows)
        motions = Groups.of(groups, n_rows)
        if runs is None:
            runs = motions.motions
        counts = np.asarray(weights)
        times = np.zeros(n_rows)
        if time is not None:
            times = time
        place = np.arange(n_rows)
        timed = time is not None
        return cls(X, y, counts, motions, runs, place, y, times, timed)

    def __len__(self) -> int:
        return len(self.X)

    @property
    def q(self) -> Tensor:
        """Actuator vectors (N, n) in double precision."""
        return torch.from_numpy(self.X.astype(np.float64))

    @property
    def tips(self) -> NDArray:
        """Measured tips as a matrix (N, m) [m]."""
        return self.y.reshape(len(self.y), -1)

    @property
    def clock(self) -> NDArray | None:
        """The times (N,) [s] for a hysteresis, which raises if it needs some and gets None."""
        return self.time if self.timed else None

    @property
    def groups_or_runs(self) -> NDArray:
        """The group of every row (N,); without groups its run."""
        return self.groups.labels if self.groups.whole else self.runs

    @property
    def count_once(self) -> bool:
        """Whether every row counts once."""
        return bool((self.counts == 1.0).all())

    @cached_property
    def directions(self) -> Directions:
        """The directions of q that the rows move."""
        return moved_directions(self.X)

    def digests(self) -> NDArray:
        """Return a number for each row, by which it is recognised."""
        return np.unique(row_digests(self.X, self.tips))

    def take(self, rows: NDArray) -> Self:
        """Return some of the rows."""
        X = self.X[rows]
        return replace(
            self,
            X=X,
            y=self.y[rows],
            counts=self.counts[rows],
            groups=self.groups.take(rows),
            runs=self.runs[rows],
            time=self.time[rows],
            place=np.arange(len(X)),
            residual=self.residual[rows],
        )

    @property
    def counted(self) -> NDArray[np.intp]:
        """The rows that count (K,); others only move the actuators."""
        return np.flatnonzero(self.counts > 0.0)

    def counting(self, rows: NDArray) -> Self:
        """Return the log in which only some rows count; a single group is divided into rows."""
        counts = np.zeros(len(self))
        counts[rows] = self.counts[rows]
        counting = replace(self, counts=counts)
        if self.groups.take(rows).several:
            return counting
        return counting.ungrouped()

    def ungrouped(self) -> Self:
        """Return the rows without groups."""
        return replace(self, groups=Groups.rows(len(self)))

    def marker(self, k: int) -> Self:
        """Return the rows in which marker k was measured, with only its positions as tips."""
        columns = slice(3 * k, 3 * k + 3)
        tips = self.tips[:, columns]
        residual = self.residual[:, columns]
        measured = np.flatnonzero(~np.isnan(tips[:, 0]))
        if not len(measured):
            raise rare_marker(k)
        return replace(self, y=tips, residual=residual).take(measured)

    def distinct(self) -> Self:
        """Return the different rows with the number of times each counts, without an order."""
        return self._merged(self.y)

    def in_runs(self) -> Self:
        """Return the rows in order of time, without those that repeat the row before.

        What the actuators do does not change: rows at other times, and of other runs, stay apart.
        """
        columns = self.y, _numbered(self.runs), self.time
        return self._merged(np.column_stack(columns), follow=True)

    def effective(self, hysteresis: Hysteresis) -> Self:
        """Return the rows with what the actuators do in place of the commands."""
        moved = hysteresis.apply_by_group(self.X, self.runs, self.clock)
        return replace(self, X=moved)

    def _merged(self, columns: NDArray, follow: bool = False) -> Self:
        """Return the rows without those that equal another one, or `follow` it, in all columns."""
        first, counts, place = distinct_rows(
            self.X, columns, self.counts, self.groups.apart, follow
        )
        return replace(self.take(first), counts=counts, place=place)

    def thinned(self, most: int) -> Self:
        """Return every k-th row, about `most` rows."""
        return self.take(np.arange(0, len(self), 1 + len(self) // most))

    def repeated(self) -> Self:
        """Return every row as often as it counts, or these rows if they count in fractions."""
        times = self.counts.astype(int)
        if self.count_once or (times != self.counts).any():
            return self
        every = self.take(np.repeat(np.arange(len(self)), times))
        return replace(every, counts=np.ones(len(every)))

    def as_given(self, values: NDArray) -> NDArray:
        """Return values (N, ...) of these rows for the given rows (M, ...); NaN for weight 0."""
        return at_place(values, self.place)


def _numbered(names: NDArray) -> NDArray:
    """Return names (N,) as numbers."""
    return np.unique(names, return_inverse=True)[1]


def rare_marker(k: int) -> ValueError:
    """Return the error for a marker that too few rows hold."""
    return ValueError(f"`y` must hold marker {k} in at least 2 rows; remove that marker.")
