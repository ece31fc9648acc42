"""Groups of rows, the motions of a log: what is held out together."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray
from sklearn.model_selection import GroupKFold, KFold
from torch import Tensor

from hybridkin._core.arrays import labels
from hybridkin._core.turns import TURNS

_PARTS = 10  # of a single motion


@dataclass(frozen=True, eq=False)
class Groups:
    """The group of every row. Without groups, every row is one.

    Attributes
    ----------
    labels : ndarray of shape (N,)
        Group of every row.
    whole : bool
        Whether the rows of a group belong together: the caller has named the groups.
    """

    labels: NDArray
    whole: bool = True

    @classmethod
    def rows(cls, n_rows: int) -> Groups:
        """Return a group for each row."""
        return cls(np.arange(n_rows), False)

    @classmethod
    def of(cls, groups: ArrayLike | Groups | None, n_rows: int) -> Groups:
        """Return the groups of a caller, checked; None gives each row a group."""
        if isinstance(groups, Groups):
            return groups
        if groups is None:
            return cls.rows(n_rows)
        return cls(labels(groups, n_rows))

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.labels)

    @cached_property
    def number(self) -> int:
        """Number of groups."""
        return len(np.unique(self.labels)) if self.whole else len(self)

    @property
    def several(self) -> bool:
        """Whether there is more than one, so that one can be held out."""
        return self.number > 1

    @property
    def motions(self) -> NDArray:
        """The motion of every row (N,); of rows without groups one motion."""
        return self.labels if self.whole else np.zeros(len(self))

    @property
    def apart(self) -> NDArray:
        """Columns (N, k) in which equal rows must be equal to be merged."""
        n_columns = 1 if self.whole else 0
        _, number = np.unique(self.labels, return_inverse=True)
        return number.reshape(-1, 1)[:, :n_columns]

    @cached_property
    def members(self) -> list[Tensor]:
        """The rows of every group."""
        _, of_row = np.unique(self.labels, return_inverse=True)
        order = torch.from_numpy(np.argsort(of_row, kind="stable"))
        return [*order.split(np.bincount(of_row).tolist())]

    def take(self, rows: NDArray) -> Groups:
        """Return the groups of some rows."""
        if not self.whole:
            return Groups.rows(len(self.labels[rows]))
        return Groups(self.labels[rows])

    def named(self, names: NDArray) -> Groups:
        """Return groups with other names (N,), if there are groups."""
        return Groups(names) if self.whole else self

    def divided(self) -> Groups:
        """Return these groups; of a single one its rows, so that they can be held out."""
        return self if self.several else Groups.rows(len(self))

    def in_parts(self) -> Groups:
        """Return these groups; of a single one its ten parts."""
        if self.several:
            return self
        return Groups(np.arange(len(self)) * _PARTS // len(self))

    def folds(self, most: int = 5, shuffle: bool = False) -> list[tuple[NDArray, NDArray]]:
        """Return training and held-out rows of at most `most` folds of whole groups.

        Single rows are always shuffled, groups of several rows only if `shuffle`.
        """
        n_folds = min(most, self.number)
        if n_folds < 2:
            raise ValueError(
                "`groups` must hold at least two motions, so that one can be held out, got one; "
                "record more motions, or leave `groups` out."
            )
        if not self.whole:
            splitter = KFold(n_folds, shuffle=True, random_state=0)
            return [*splitter.split(self.labels)]
        random_state = 0 if shuffle else None
        splitter = GroupKFold(n_folds, shuffle=shuffle, random_state=random_state)
        with TURNS.filters:
            return [*splitter.split(self.labels, groups=self.labels)]
