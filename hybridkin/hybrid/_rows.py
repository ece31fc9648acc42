"""Measured rows of a log on their way through a fit."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.digests import row_digests
from hybridkin._core.directions import Directions, moved_directions
from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin.hysteresis.value import Hysteresis


@dataclass(frozen=True)
class Rows:
    """Measured rows, as they were given or with equal rows merged, see `distinct`."""

    X: NDArray  # (N, n) actuator vectors, float64 or float32
    y: NDArray  # (N, m) or (N,) tips [m]
    weights: NDArray | None = None  # (N,), number of times each row counts
    groups: NDArray | None = None  # (N,), motion of every row; held out together
    # (N,), which rows follow each other in time without a break; None: those of a group
    runs: NDArray | None = None
    time: NDArray | None = None  # (N,) [s]
    # (M,), the row here of each of the M given rows; -1: none
    place: NDArray | None = None
    # Shaped like y: measured minus mechanical model [m], in a fit
    residual: NDArray | None = None
    commanded: Directions | None = None  # of the commands, with hysteresis before X

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
    def counts(self) -> NDArray:
        """Number of times each row counts, (N,)."""
        return np.ones(len(self.X)) if self.weights is None else self.weights

    @property
    def run_of_rows(self) -> NDArray:
        """The run of every row, (N,)."""
        if self.runs is not None:
            return self.runs
        return np.zeros(len(self)) if self.groups is None else self.groups

    @cached_property
    def directions(self) -> Directions:
        """The directions of q that the rows move."""
        return moved_directions(self.X)

    def digests(self) -> NDArray:
        """Return a number for each row, by which it is recognised."""
        return np.unique(row_digests(self.X, self.tips))

    def take(self, rows: NDArray) -> Self:
        """Return some of the rows."""
        return replace(
            self,
            X=self.X[rows],
            y=self.y[rows],
            weights=_some(self.weights, rows),
            groups=_some(self.groups, rows),
            runs=_some(self.runs, rows),
            time=_some(self.time, rows),
            place=None,
            residual=_some(self.residual, rows),
        )

    @property
    def counted(self) -> NDArray[np.intp]:
        """The rows that count (K,); others only move the actuators."""
        return np.flatnonzero(self.counts > 0.0)

    def counting(self, rows: NDArray) -> Self:
        """Return the log in which only some rows count; a single group is divided into rows."""
        weights = np.zeros(len(self))
        weights[rows] = self.counts[rows]
        groups = self.groups
        if groups is not None and len(np.unique(groups[rows])) == 1:
            groups = None  # of a single motion, rows are held out
        return replace(self, weights=weights, groups=groups, runs=self.run_of_rows)

    def marker(self, k: int) -> Self:
        """Return the rows in which marker k was measured, with only its positions as tips."""
        columns = slice(3 * k, 3 * k + 3)
        tips = self.tips[:, columns]
        residual = None if self.residual is None else self.residual[:, columns]
        measured = np.flatnonzero(~np.isnan(tips[:, 0]))
        if not len(measured):
            raise rare_marker(k)
        return replace(self, y=tips, residual=residual).take(measured)

    def distinct(self) -> Self:
        """Return the different rows with the number of times each counts, without an order."""
        return replace(self, runs=None, time=None)._merged(self.y)

    def in_runs(self) -> Self:
        """Return the rows in order of time, without those that repeat the row before.

        What the actuators do does not change: rows at other times, and of other runs, stay apart.
        """
        columns = [self.y, _numbered(self.run_of_rows)]
        if self.time is not None:
            columns.append(self.time)
        return self._merged(np.column_stack(columns), follow=True)

    def effective(self, hysteresis: Hysteresis) -> Self:
        """Return the rows with what the actuators do in place of the commands."""
        moved = hysteresis.apply_by_group(self.X, self.run_of_rows, self.time)
        return replace(self, X=moved, runs=None, time=None)

    def _merged(self, columns: NDArray, follow: bool = False) -> Self:
        """Return the rows without those that equal another one, or `follow` it, in all columns."""
        first, counts, place = distinct_rows(
            self.X, columns, self.weights, self.groups, follow
        )
        return replace(self.take(first), weights=counts, place=place)

    def thinned(self, most: int) -> Self:
        """Return every k-th row, about `most` rows."""
        return self.take(np.arange(0, len(self), 1 + len(self) // most))

    def repeated(self) -> Self:
        """Return every row as often as it counts, or these rows if they count in fractions."""
        times = self.counts.astype(int)
        if self.weights is None or (times != self.weights).any():
            return self
        return replace(self.take(np.repeat(np.arange(len(self)), times)), weights=None)

    def as_given(self, values: NDArray) -> NDArray:
        """Return values (N, ...) of these rows for the given rows (M, ...); NaN for weight 0."""
        return values if self.place is None else at_place(values, self.place)


def _numbered(names: NDArray) -> NDArray:
    """Return names (N,) as numbers."""
    return np.unique(names, return_inverse=True)[1]


def _some(values: NDArray | None, rows: NDArray) -> NDArray | None:
    return None if values is None else values[rows]


def rare_marker(k: int) -> ValueError:
    """Return the error for a marker that too few rows hold."""
    return ValueError(
        f"`y` must hold marker {k} in at least 2 rows; remove that marker."
    )
