"""How far off a tip may be: a radius that held-out motions have confirmed."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.model_selection import GroupKFold, KFold

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


def conformal_radius(
    model: Any, X: Any, y: NDArray, weights: NDArray | None, groups: Any, coverage: float
) -> Radius:
    """Return the radius that a share `coverage` of held-out tips lies within.

    Whole groups are held out, five times, and all is fitted anew without them, calibration
    included. The errors, over the rms of errors of their kind (of the hybrid where its error model
    is trusted, of the mechanical model beyond), give the quantile.

    References
    ----------
    Papadopoulos et al., ECML (2002), normalised inductive conformal prediction; Vovk, Annals of
    Mathematics and AI 74 (2015), its pooling over folds.
    """
    n_folds = min(_FOLDS, len(y) if groups is None else len(np.unique(groups)))
    if n_folds < 2:
        raise ValueError(
            "`coverage` needs at least two groups, so that one can be held out, got one; leave "
            "`groups` out to hold out single rows, or fit with coverage=None."
        )
    splitter = KFold(n_folds, shuffle=True, random_state=0) if groups is None else None
    trust, errors, mechanical = (np.full(len(y), np.nan) for _ in range(3))
    for train, test in (splitter or GroupKFold(n_folds)).split(X, y, groups):
        part: Any = clone(model)
        given = {"sample_weight": weights, "groups": groups}
        given = {name: np.asarray(v)[train] for name, v in given.items() if v is not None}
        part.set_params(coverage=None, play=None).fit(X[train], y[train], **given)
        trust[test] = part.error_weight(X[test])
        errors[test] = distance(part.predict(X[test]), y[test])
        mechanical[test] = distance(part.predict_mechanical(X[test]), y[test])
    weights = np.ones(len(y)) if weights is None else weights
    trusted = weights * (trust >= 0.5)
    if not trusted.any():
        trusted = weights
    inside = _rms(errors, trusted)
    outside = (
        max(inside, _rms(mechanical, weights)) if model.mechanical_model is not None else inside
    )
    relative = errors / (trust * inside + (1.0 - trust) * outside)
    factor = _quantile(relative, weights, coverage)
    return Radius(factor * inside, factor * outside, coverage, len(y))


def distance(a: Any, b: NDArray) -> NDArray:
    """Return how far two sets of tips are apart, row by row, shape (N,)."""
    return np.abs(a - b) if a.ndim == 1 else np.linalg.norm(a - b, axis=1)


def _rms(values: NDArray, weights: NDArray) -> float:
    return float(np.sqrt(np.average(values**2, weights=weights)))


def _quantile(values: NDArray, weights: NDArray, coverage: float) -> float:
    """Return the smallest value that covers the share asked for, one more row counted as missed."""
    order = np.argsort(values)
    reached = np.cumsum(weights[order])
    wanted = coverage * (reached[-1] + 1.0)
    return float(values[order][min(np.searchsorted(reached, wanted), len(values) - 1)])
