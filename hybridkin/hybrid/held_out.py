"""Choice of the weights of error models, by their predictions for held-out and for outer rows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hybridkin.calibration.choice import Errors, GeometryChoice
from hybridkin.calibration.measured import distance
from hybridkin.hybrid.cv_results import CvResults

MEAN_LENGTH = 1.596
"""Mean length of a standard normal vector with three coordinates."""

_PICKS = 10  # picks of a blend; each is a weight of 0.1
_EQUAL = 1e-8  # scores this close are equal: readouts end at 1e-9 of their gradient
_OUTSIDE = 0.1  # share of the outer rows in the score of a blend
# Standard errors that the gain of a blend must exceed, by the first candidate: errors of the
# structure hold for rows that the log does not contain, so corrections of them must be sure.
_SURE = {"mechanical": 1.0, "structural": 2.0}


class Predictions(NamedTuple):
    """Predictions of K models for N rows, and what was measured there."""

    predicted: NDArray  # (K, N, m) [m]
    y: NDArray  # (N, m) [m]
    counts: NDArray  # (N,), number of times each row counts
    groups: NDArray | None  # (N,), motion of every row


class HeldOut(NamedTuple):
    """Predictions of all candidates for the N held-out rows, then for the outer rows."""

    predicted: NDArray  # (K, N + M, m)
    y: NDArray  # (N + M, m)
    weights: NDArray  # (N + M,), of the distances in the score of a blend
    counts: NDArray
    fold: NDArray  # (N + M,), the fold of the row
    groups: NDArray | None  # (N,), the motion of the held-out row
    n: int

    @classmethod
    def of(cls, held_out: Predictions, outer: Predictions, fold: NDArray) -> HeldOut:
        """Return both kinds of rows, weighted by the errors of the first candidate, f_mech."""
        n = len(held_out.y)
        predicted = np.concatenate([held_out.predicted, outer.predicted], axis=1)
        y = np.concatenate([held_out.y, outer.y])
        counts = np.concatenate([held_out.counts, outer.counts])
        weights = counts.copy()
        error = distance(predicted[0], y)
        eps = np.finfo(float).eps
        weights[:n] *= (1.0 - _OUTSIDE) / max(counts[:n] @ error[:n], eps)
        weights[n:] *= _OUTSIDE / max(counts[n:] @ error[n:], eps)
        return cls(predicted, y, weights, counts, fold, held_out.groups, n)

    def blend_weights(self, rows: NDArray) -> NDArray:
        """Return the weights (K,) of the candidates, multiples of 0.1 that sum to one.

        Ten times, the candidate that lowers the score most is added; repetition is allowed.

        References
        ----------
        Caruana et al., Ensemble selection from libraries of models, ICML 2004.
        """
        predicted = self.predicted[:, rows]
        y = self.y[rows]
        weights = self.weights[rows]
        picks = np.zeros(len(predicted))
        total = np.zeros_like(y)
        for k in range(1, _PICKS + 1):
            means = [weights @ distance((total + x) / k, y) for x in predicted]
            # The first of equals.
            best = int(np.argmax(means <= (1.0 + _EQUAL) * np.min(means)))
            picks[best] += 1
            total += predicted[best]
        return picks / _PICKS


def chosen_blend(
    names: list[str],
    held_out: HeldOut,
    geometry: GeometryChoice | None = None,
) -> tuple[NDArray, CvResults]:
    """Return the weights of the candidates, and the errors of all candidates and their blend.

    If the gain of the blend over the first candidate, paired by motion or fold, is within its
    standard error, or twice that over structural errors, the first candidate is chosen.
    """
    n = held_out.n
    counts = held_out.counts
    # On each fold the blend is scored with weights chosen without that fold.
    blend = np.empty_like(held_out.y)
    for fold in np.unique(held_out.fold):
        test = held_out.fold == fold
        weights = held_out.blend_weights(~test)
        blend[test] = np.tensordot(weights, held_out.predicted[:, test], 1)
    predicted = (*held_out.predicted, blend)
    distances = np.array([distance(x, held_out.y) for x in predicted])
    of_held_out = distances[:, :n]
    by_fold = _means_by(held_out.fold[:n], of_held_out, counts[:n])
    by_motion = by_fold
    if held_out.groups is not None:
        by_motion = _means_by(held_out.groups, of_held_out, counts[:n])
    gains = by_motion[0] - by_motion[-1]
    weights = held_out.blend_weights(np.ones(len(blend), dtype=bool))
    standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
    if gains.mean() <= _SURE.get(names[0], 1.0) * standard_error:
        weights = np.eye(len(weights))[0]
    held_out_means = np.average(of_held_out, axis=1, weights=counts[:n])
    outer_means = np.average(distances[:, n:], axis=1, weights=counts[n:])
    expected = held_out_means[-1]
    if weights[0] == 1.0:
        expected = held_out_means[0]
    chosen = "blend"
    if weights.max() == 1.0:
        chosen = names[int(weights.argmax())]
    parameters = "nothing"
    tried = {}
    if geometry is not None:
        parameters = geometry.name
        tried = geometry.errors
    if not tried:
        errors = Errors(float(held_out_means[0]), float(outer_means[0]))
        tried = {parameters: errors}
    return weights, {
        "candidate": [*names, "blend"],
        "mean_distance": held_out_means,
        "expected_distance": float(expected),
        "std_distance": by_fold.std(axis=1, ddof=1),
        "io_distance": outer_means,
        "chosen": chosen,
        "weights": dict(zip(names, weights.tolist(), strict=True)),
        "parameters": parameters,
        "mechanical_model": {name: both.known() for name, both in tried.items()},
    }


def _means_by(labels: NDArray, distances: NDArray, counts: NDArray) -> NDArray:
    """Return the mean distances (K, L) of K models for each of L row labels."""
    means = []
    for label in np.unique(labels):
        k = labels == label
        means.append(np.average(distances[:, k], axis=1, weights=counts[k]))
    return np.array(means).T
