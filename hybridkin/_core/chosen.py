"""Work for some rows of many: for these alone, or for all where counting them would wait."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor


class Apart(NamedTuple):
    """Rows at these places (k,), computed apart from the others."""

    places: Tensor

    @property
    def is_empty(self) -> bool:
        """Whether there is no row to compute."""
        return self.places.numel() == 0

    def take(self, rows: Tensor) -> Tensor:
        """Return the chosen ones of rows (N, ...)."""
        return rows[self.places]

    def put(self, rows: Tensor, new: Tensor) -> Tensor:
        """Return rows (N, ...) with others in the chosen places."""
        return rows.index_copy(0, self.places, new)


class AmongAll(NamedTuple):
    """Rows of a mask (N,), which are computed with all others."""

    mask: Tensor

    @property
    def is_empty(self) -> bool:
        """Whether there is no row to compute: nobody knows without waiting."""
        return False

    def take(self, rows: Tensor) -> Tensor:
        """Return all rows."""
        return rows

    def put(self, rows: Tensor, new: Tensor) -> Tensor:
        """Return rows (N, ...) with others where the mask holds."""
        mask = self.mask.reshape(-1, *[1] * (new.ndim - 1))
        return torch.where(mask, new, rows)


Chosen: TypeAlias = Apart | AmongAll


def chosen(mask: Tensor, costly: bool) -> Chosen:
    """Return the rows where a mask (N,) holds.

    In a compiled graph sizes must not depend on numbers: there all rows are computed, and so they
    are on a GPU, which would have to tell their number, unless that is costly. Then the results of
    the other rows are dropped; they must be finite, because derivatives of NaN are NaN.
    """
    asks = costly or mask.device.type == "cpu"
    if asks and not torch.compiler.is_compiling():
        return Apart(mask.nonzero()[:, 0])
    return AmongAll(mask)
