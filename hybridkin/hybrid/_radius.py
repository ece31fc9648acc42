"""How far off a tip may be: a radius confirmed by held-out motions."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.model_selection import GroupKFold, KFold

from hybridkin.hybrid._fit import Rows, Spec, fit_hybrid
from hybridkin.hybrid._kernel import distance
from hybridkin.hybrid._selection import choose_mechanics, select

_FOLDS = 5


class Radius(NamedTuple):
    """Radii about a predicted tip [m]: where the error model is trusted, and where it is not."""

    inside: float
    outside: float
    coverage: float  # the share of held-out tips within
    n_rows: int

    def at(self, weight: NDArray) -> NDArray:
        """Return the radius (N,) at weights (N,) of the error model."""
        return weight * self.inside + (1.0 - weight) * self.outside


def conformal_radius(spec: Spec, rows: Rows, coverage: float) -> Radius:
    """Return the radius that covers a share `coverage` of held-out tips.

    Whole groups are held out, five times, and everything is fitted anew without them, calibration
    included. The errors, over the rms of errors of their kind (of the hybrid where its error model
    is trusted, of the mechanical model outside), give the quantile.

    References
    ----------
    Papadopoulos et al., ECML (2002), normalised inductive conformal prediction; Vovk, Annals of
    Mathematics and AI 74 (2015), its pooling over folds.
    """
    given, (rows, place) = rows, rows.distinct()
    X, y, groups, weights = rows.X, rows.tips, rows.groups, rows.counts
    n_folds = min(_FOLDS, len(y) if groups is None else len(np.unique(groups)))
    if n_folds < 2:
        raise ValueError(
            "`coverage` needs at least two groups, so that one can be held out, got one; leave "
            "`groups` out to hold out single rows, or fit with coverage=None."
        )
    splitter = KFold(n_folds, shuffle=True, random_state=0) if groups is None else None
    trust, errors, mechanical = (np.full(len(y), np.nan) for _ in range(3))
    for train, test in (splitter or GroupKFold(n_folds)).split(X, y, groups):
        part = given.take(np.isin(place, train))
        chosen = spec if spec.parts else select(choose_mechanics(spec, part), part)[0]
        module = fit_hybrid(chosen, part).module
        q = torch.from_numpy(X[test].astype(np.float64))
        with torch.no_grad():
            trust[test] = module.error_weight(q).numpy()
            errors[test] = distance(module(q).numpy(), y[test])
            mechanical[test] = distance(module.mechanical_part(q).numpy(), y[test])
    trusted = weights * (trust >= 0.5)
    inside = _rms(errors, trusted if trusted.any() else weights)
    outside = inside if spec.mechanical is None else max(inside, _rms(mechanical, weights))
    relative = errors / (trust * inside + (1.0 - trust) * outside)
    factor = _quantile(relative, weights, coverage)
    return Radius(factor * inside, factor * outside, coverage, len(y))


def _rms(values: NDArray, weights: NDArray) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))


def _quantile(values: NDArray, weights: NDArray, coverage: float) -> float:
    """Return the smallest value that covers the share, with one more row counted as not covered."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    wanted = coverage * (reached[-1] + 1.0)
    return float(values[order][min(np.searchsorted(reached, wanted), len(values) - 1)])
