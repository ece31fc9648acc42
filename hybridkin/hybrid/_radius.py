"""The estimated error radius of a tip, from its errors on held-out rows."""

from __future__ import annotations

from math import ceil, inf
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

_ROUNDING = 1e-9  # rounding error of shares


class Radius(NamedTuple):
    """Estimated error radius about a predicted tip [m]; infinite outside the domain."""

    inside: float  # in the domain of the error model; infinite: too few groups for the coverage
    coverage: float  # share of held-out tips within the radius
    n_rows: int

    def at(self, in_domain: NDArray) -> NDArray:
        """Return the radius (N,) of rows that are inside or outside the domain (N,)."""
        return np.where(in_domain, self.inside, inf)

    @property
    def least_groups(self) -> int:
        """The least number of groups that gives a finite radius."""
        return ceil(self.coverage / (1.0 - self.coverage) - _ROUNDING)

    def doubts(self, n_groups: int) -> list[str]:
        """Return a warning if this number of groups inside the domain gives an infinite radius."""
        if self.inside < inf:
            return []
        return [
            f"`coverage` {self.coverage:g} needs at least {self.least_groups} groups (rows, if "
            "there are no groups) inside the domain of the error model when they are held out, got "
            f"{n_groups}: the radius is infinite. Record more motions, or lower `coverage`."
        ]

    def __str__(self) -> str:
        covered = f"{100.0 * self.coverage:g} % of the tips"
        if self.inside < inf:
            return f"{1e3 * self.inside:.3g} mm covers {covered} inside the domain"
        return f"not known: {covered} need at least {self.least_groups} groups in the domain"


def covering_distance(values: NDArray, groups: NDArray, weights: NDArray, coverage: float) -> float:
    """Return the smallest value that covers the share; infinity if no value does.

    Each of the K groups, numbered from 0 (N,), has the mass 1 / (K + 1), divided among its values
    (N,) by their weights (N,). The rest is the mass of a new group, whose errors are not known.
    """
    totals = np.bincount(groups, weights)
    order = np.argsort(values)
    reached = np.cumsum((weights / totals[groups])[order]) / (len(totals) + 1)
    first = int(np.searchsorted(reached, coverage - _ROUNDING))
    return float(values[order][first]) if first < len(values) else inf
