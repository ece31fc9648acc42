"""The estimated error radius of a tip, computed from held-out motions."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from math import ceil, inf
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.calibration.measured import distances, folds
from hybridkin.hybrid._drift import too_far
from hybridkin.hybrid._fit import fit_hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec

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

    def __str__(self) -> str:
        covered = f"{100.0 * self.coverage:g} % of the tips"
        if self.inside < inf:
            return f"{1e3 * self.inside:.3g} mm covers {covered} inside the domain"
        return f"not known: {covered} need at least {self.least_groups} groups in the domain"


def conformal_radius(
    spec: Spec, rows: Rows, moved: Callable[[NDArray], Rows] | None = None
) -> tuple[Radius | None, list[str]]:
    """Return the radius that covers the share of held-out tips, and warnings; None without one.

    Whole groups are held out in five folds, and everything, calibration included, is fitted again
    without them. Without groups every row is a group. The errors in the domain of these fits give
    the radius; with several markers the largest error of a row counts.

    Parameters
    ----------
    spec : Spec
        Settings of the fits, and the share of the tips, its `coverage`.
    rows : Rows
        The measured rows.
    moved : callable, optional
        Returns the rows with the motion of the actuators, by hysteresis that was found without
        some of them, given as places. Default: the rows themselves.

    References
    ----------
    Lee, Barber & Willett, Distribution-free inference with hierarchical data (2023), the rank by
    groups; Vovk, Annals of Mathematics and AI 74 (2015), the pooling over folds.
    """
    coverage = spec.coverage
    if coverage is None:
        return None, []
    spec = replace(spec, held_out=False, progress=None)
    y = rows.tips
    groups = rows.groups
    if groups is None:
        groups = np.arange(len(y))
    inside = np.zeros(len(y), dtype=bool)
    errors = np.full(len(y), np.nan)
    for train, test in folds(rows.X, rows.groups):
        all_rows = rows if moved is None else moved(test)
        part = all_rows.take(train).distinct()
        if part.groups is not None and len(np.unique(part.groups)) == 1:
            part = replace(part, groups=None)  # of a single motion, rows are held out
        module = fit_hybrid(spec, part).module
        q = all_rows.take(test).q
        with torch.no_grad():
            inside[test] = module.in_domain(q).numpy()
            x = module(q).numpy()
        if not np.isfinite(x).all():
            raise too_far()
        errors[test] = np.nanmax(distances(x, y[test]), axis=1)
    names, of = np.unique(groups[inside], return_inverse=True)
    radius = _quantile(errors[inside], of, rows.counts[inside], coverage)
    estimate = Radius(radius, coverage, len(y))
    if estimate.inside < inf:
        return estimate, []
    return estimate, [
        f"`coverage` {coverage:g} needs at least {estimate.least_groups} groups (rows, if there "
        "are no groups) inside the domain of the error model when they are held out, got "
        f"{len(names)}: the radius is infinite. Record more motions, or lower `coverage`."
    ]


def _quantile(
    values: NDArray, groups: NDArray, weights: NDArray, coverage: float
) -> float:
    """Return the smallest value that covers the share; infinity if no value does.

    Each of the K groups, numbered from 0 (N,), has the mass 1 / (K + 1), divided among its values
    (N,) by their weights (N,). The rest is the mass of a new group, whose errors are not known.
    """
    totals = np.bincount(groups, weights)
    order = np.argsort(values)
    reached = np.cumsum((weights / totals[groups])[order]) / (len(totals) + 1)
    first = int(np.searchsorted(reached, coverage - _ROUNDING))
    return float(values[order][first]) if first < len(values) else inf
