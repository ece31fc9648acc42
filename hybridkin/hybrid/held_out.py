"""The table of held-out predictions of a cross-fit, and what is read from it."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import Self

from hybridkin._core.groups import Groups
from hybridkin._core.simplest import simplest_within
from hybridkin.calibration.choice import NOT_CHOSEN, GeometryChoice, SetErrors
from hybridkin.calibration.measured import distance, distances
from hybridkin.hybrid._guards import GroupDistance
from hybridkin.hybrid._radius import Radius, covering_distance
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.hysteresis.value import NO_HYSTERESIS, Hysteresis

MEAN_LENGTH = 1.596
"""Mean length of a standard normal vector with three coordinates."""

_PICKS = 10  # picks of a blend; each is a weight of 0.1
_EQUAL = 1e-8  # scores this close are equal: readouts end at 1e-9 of their gradient
_OUTSIDE = 0.1  # share of the outer rows in the score of a blend
# Standard errors that the gain of a blend must exceed, by the first candidate: errors of the
# structure hold for rows that the log does not contain, so corrections of them must be sure.
_SURE = {"mechanical": 1.0, "structural": 2.0}

Split = tuple[NDArray, NDArray]
"""Places of training rows and of test rows."""


class FoldChoice(NamedTuple):
    """What the fit of a fold chose.

    Attributes
    ----------
    geometry : GeometryChoice
        The parameters to calibrate; falsy if they were not chosen.
    hysteresis : Hysteresis
        The hysteresis; empty without one.
    error_model : object
        The fitted error model, as `HybridForwardModel.error_model_`.
    """

    geometry: GeometryChoice = NOT_CHOSEN
    hysteresis: Hysteresis = NO_HYSTERESIS
    error_model: object = None

    @property
    def parameters(self) -> str:
        """Name of the chosen parameters to calibrate; empty if there was no choice."""
        if len(self.geometry.errors) < 2:
            return ""
        return self.geometry.name


class Predictions(NamedTuple):
    """Predictions of K models for N rows that they were not fitted to.

    Attributes
    ----------
    tips : ndarray of shape (K, N, m)
        Predicted tips [m].
    inside : ndarray of bool of shape (K, N)
        Whether the row is in the domain of the fit.
    choice : FoldChoice
        What the fit chose.
    """

    tips: NDArray
    inside: NDArray[np.bool_]
    choice: FoldChoice = FoldChoice()


class Outer(NamedTuple):
    """The M outer rows of a log, predicted by fits to its inner rows; M = 0: not asked for."""

    tips: NDArray  # (K, M, m) [m]
    y: NDArray  # (M, m) [m]
    counts: NDArray  # (M,)
    rows: NDArray[np.intp]  # (M,), their places in the log

    @classmethod
    def none(cls, n_candidates: int, n_outputs: int) -> Outer:
        """Return no rows."""
        nothing = np.empty(0)
        tips = np.empty((n_candidates, 0, n_outputs))
        return cls(tips, tips[0], nothing, nothing.astype(np.intp))


@dataclass(frozen=True, eq=False)
class CrossFit:
    """The tips that candidates predict for each row of a log, fitted without its fold.

    Attributes
    ----------
    names : tuple of str
        Names of the K candidates, the simplest first.
    tips : ndarray of shape (K, N, m)
        Predicted tips of the candidates [m].
    inside : ndarray of bool of shape (K, N)
        Whether a row is in the domain of the fit without its fold.
    q : ndarray of shape (N, n)
        Commands.
    y : ndarray of shape (N, m)
        Measured tips [m], NaN for missing markers.
    counts : ndarray of shape (N,)
        Number of times each row counts [1].
    groups : Groups
        Motion of every row.
    fold : ndarray of shape (N,)
        Fold in which a row was held out.
    outer : Outer
        The outer rows of the log after fits to its inner rows.
    choices : tuple of FoldChoice
        What each fold chose.
    tables : dict of str to CrossFit
        Of models: the table of the candidates of each; of candidates: none.
    models : dict of str to HybridForwardModel
        Of models: these, fitted to all rows.
    """

    names: tuple[str, ...]
    tips: NDArray
    inside: NDArray[np.bool_]
    q: NDArray
    y: NDArray
    counts: NDArray
    groups: Groups
    fold: NDArray
    outer: Outer
    choices: tuple[FoldChoice, ...] = ()
    tables: Mapping[str, CrossFit] = field(default_factory=dict)
    models: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of_models(cls, tables: Mapping[str, CrossFit], models: Mapping[str, Any]) -> CrossFit:
        """Return the table of fitted models, from a table of the candidates of each."""
        chosen = [table.chosen for table in tables.values()]
        return replace(
            next(iter(tables.values())),
            names=tuple(tables),
            tips=np.array([blend.tips for blend in chosen]),
            inside=np.array([blend.inside for blend in chosen]),
            outer=Outer.none(len(chosen), chosen[0].tips.shape[1]),
            choices=(),
            tables=tables,
            models=models,
        )

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        rows: Rows,
        splits: Sequence[Split],
        held_out: Iterable[Predictions],
        outer: Outer | None = None,
    ) -> CrossFit:
        """Return the table of what fits to all folds but one predict.

        Parameters
        ----------
        names : sequence of str
            Names of the candidates.
        rows : Rows
            The N rows.
        splits : sequence of (ndarray, ndarray)
            Training and test rows of every fold, each of shape (k,) [row numbers].
        held_out : iterable of Predictions
            Those of the test rows, fold by fold.
        outer : Outer, optional
            The outer rows. Default: none.
        """
        shape = (len(names), *rows.tips.shape)
        tips = np.empty(shape, rows.tips.dtype)
        inside = np.empty(shape[:2], dtype=bool)
        choices = []
        for (_, test), predicted in zip(splits, held_out, strict=True):
            tips[:, test] = predicted.tips
            inside[:, test] = predicted.inside
            choices.append(predicted.choice)
        return cls(
            tuple(names),
            tips,
            inside,
            rows.X,
            rows.tips,
            rows.counts,
            rows.groups,
            fold_of_rows(splits),
            outer or Outer.none(len(names), shape[2]),
            tuple(choices),
        )

    @cached_property
    def distances(self) -> NDArray:
        """Distances (K, N) of predicted from measured tips; for several markers their mean [m]."""
        return np.array([distance(tips, self.y) for tips in self.tips])

    @cached_property
    def distances_from_others(self) -> NDArray:
        """Distances (N,) of commands from those of the other folds; an actuator spans 2."""
        q = torch.from_numpy(self.q.astype(np.float64))
        groups = self.groups.labels
        far = np.empty(len(q))
        for fold in np.unique(self.fold):
            test = self.fold == fold
            far[test] = _distances_from(q[~test], groups[~test], q[test])
        return far

    @property
    def errors(self) -> dict[str, HeldOutError]:
        """Mean errors on held-out rows by candidate [m]."""
        errors = {}
        for name, far in zip(self.names, self.distances, strict=True):
            errors[name] = HeldOutError.of(far, self.groups.labels, self.counts)
        return errors

    @cached_property
    def _all_rows(self) -> _ScoredRows:
        return _ScoredRows.of(self)

    @cached_property
    def _picked_by_others(self) -> NDArray:
        """Weights (F, K) of a blend for each fold, chosen by the rows of the other folds."""
        rows = self._all_rows
        return np.array([rows.picked(rows.fold != k) for k in np.unique(self.fold)])

    @property
    def fold_weights(self) -> NDArray:
        """Weights (F, K) with which the candidates are tested on each fold."""
        if self.weights[0] == 1.0:
            return np.tile(self.weights, (len(self._picked_by_others), 1))
        return self._picked_by_others

    @cached_property
    def _blend(self) -> Blended:
        """The blend with weights that are chosen, for each fold, by the rows of the others."""
        rows = self._all_rows
        tips = np.empty_like(rows.y)
        inside = np.empty(len(self.y), dtype=bool)
        for fold, weights in zip(np.unique(self.fold), self._picked_by_others, strict=True):
            test = rows.fold == fold
            tips[test] = np.tensordot(weights, rows.tips[:, test], 1)
            of_fold = self.fold == fold
            inside[of_fold] = self.inside[weights > 0.0][:, of_fold].all(axis=0)
        return Blended(tips, inside)

    @cached_property
    def _distances_of_all(self) -> NDArray:
        """Distances (K + 1, N + M) of the candidates, then of their blend [m]."""
        rows = self._all_rows
        tips = (*rows.tips, self._blend.tips)
        return np.array([distance(x, rows.y) for x in tips])

    @cached_property
    def weights(self) -> NDArray:
        """Weights (K,) of the candidates in the blend of least error; they sum to one.

        If the gain of the blend over the first candidate, paired by motion or fold, is within its
        standard error, or twice that over structural errors, the first candidate is chosen.
        """
        of_held_out = self._distances_of_all[:, : len(self.y)]
        labels = self.groups.labels if self.groups.whole else self.fold
        means = _means_by(labels, of_held_out, self.counts)
        gains = means[0] - means[-1]
        standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
        if gains.mean() <= _SURE.get(self.names[0], 1.0) * standard_error:
            return np.eye(len(self.names))[0]
        rows = self._all_rows
        return rows.picked(np.ones(len(rows.y), dtype=bool))

    @property
    def chosen(self) -> Blended:
        """The chosen model: the first candidate, or the blend."""
        n = len(self.y)
        if self.weights[0] == 1.0:
            return Blended(self.tips[0], self.inside[0])
        return Blended(self._blend.tips[:n], self._blend.inside)

    @cached_property
    def _mean_distances(self) -> NDArray:
        """Mean distances (K + 1,) of the candidates and their blend on held-out rows [m]."""
        of_held_out = self._distances_of_all[:, : len(self.y)]
        return np.average(of_held_out, axis=1, weights=self.counts)

    @property
    def expected_error(self) -> float:
        """Mean distance to expect of the chosen model on new motions like these [m]."""
        chosen = 0 if self.weights[0] == 1.0 else -1
        return float(self._mean_distances[chosen])

    @property
    def outer_error(self) -> float:
        """Mean distance of the chosen model on the outer rows, after fits to inner ones [m]."""
        n = len(self.y)
        chosen = 0 if self.weights[0] == 1.0 else -1
        of_outer = self._distances_of_all[chosen, n:]
        return float(np.average(of_outer, weights=self.outer.counts))

    def excess_over(self, other: CrossFit) -> HeldOutError:
        """Return how much larger the errors of the chosen model are than those of another table.

        Both tables are of the same rows.
        """
        excess = distance(self.chosen.tips, self.y) - distance(other.chosen.tips, self.y)
        return HeldOutError.of(excess, self.groups.labels, self.counts)

    @property
    def groups_inside(self) -> NDArray:
        """Motions (K,) of the rows in the domain of the chosen model; without groups these rows."""
        return self.groups.labels[self.chosen.inside]

    def radius(self, coverage: float) -> Radius:
        """Return the radius about tips of the chosen model that covers a share of held-out tips.

        Errors in the domain of the fits give the radius; with several markers the largest error of
        a row counts. Without groups every row is a group.

        Parameters
        ----------
        coverage : float
            The share, between 0 and 1.

        References
        ----------
        Lee, Barber & Willett, Distribution-free inference with hierarchical data (2023), the rank
        by groups; Vovk, Annals of Mathematics and AI 74 (2015), the pooling over folds.
        """
        chosen = self.chosen
        errors = np.nanmax(distances(chosen.tips, self.y), axis=1)
        inside = chosen.inside
        _, group = np.unique(self.groups_inside, return_inverse=True)
        radius = covering_distance(errors[inside], group, self.counts[inside], coverage)
        return Radius(radius, coverage, len(self.y))

    def results(self, geometry: GeometryChoice = NOT_CHOSEN) -> CvResults:
        """Return the errors of all candidates and their blend, see `cv_results_`."""
        n = len(self.y)
        all_distances = self._distances_of_all
        held_out_means = self._mean_distances
        outer_means = np.average(all_distances[:, n:], axis=1, weights=self.outer.counts)
        by_fold = _means_by(self.fold, all_distances[:, :n], self.counts)
        chosen = "blend"
        if self.weights.max() == 1.0:
            chosen = self.names[int(self.weights.argmax())]
        parameters = geometry.name or "nothing"
        tried = geometry.errors
        if not tried:
            errors = SetErrors(float(held_out_means[0]), float(outer_means[0]))
            tried = {parameters: errors}
        return {
            "candidate": [*self.names, "blend"],
            "mean_distance": held_out_means,
            "expected_distance": self.expected_error,
            "std_distance": by_fold.std(axis=1, ddof=1),
            "io_distance": outer_means,
            "chosen": chosen,
            "weights": dict(zip(self.names, self.weights.tolist(), strict=True)),
            "parameters": parameters,
            "mechanical_model": {name: both.known() for name, both in tried.items()},
            "corrected": {name: both.known() for name, both in geometry.corrected.items()},
        }


class HeldOutError(NamedTuple):
    """Mean distance of predicted from measured tips on held-out rows [m].

    Attributes
    ----------
    mean : float
        Mean over the rows.
    std_error : float
        Its standard error over motions, because rows of a motion have similar errors.
    by_motion : dict of str to float
        Mean of every motion; without groups, of every row.
    """

    mean: float
    std_error: float
    by_motion: dict[str, float]

    @classmethod
    def of(cls, errors: NDArray, groups: NDArray, counts: NDArray) -> Self:
        """Return the mean errors from those of rows (N,) with their motions and counts (N,).

        References
        ----------
        Cochran, Sampling Techniques (1977), chapter 9A: clusters of unequal sizes.
        """
        names, motion = np.unique(groups, return_inverse=True)
        mean = np.average(errors, weights=counts)
        of_motion = np.bincount(motion, counts * errors) / np.bincount(motion, counts)
        sums = np.bincount(motion, counts * (errors - mean))
        deviation = np.sqrt(len(sums) * (sums @ sums) / (len(sums) - 1))
        by_motion = dict(zip(map(str, names), of_motion.tolist(), strict=True))
        return cls(float(mean), float(deviation / counts.sum()), by_motion)


class Blended(NamedTuple):
    """Tips (N, m) of a weighted mean of candidates [m], and whether all have the row inside."""

    tips: NDArray
    inside: NDArray[np.bool_]


class _ScoredRows(NamedTuple):
    """The N held-out rows, then the M outer ones, weighted by the errors of the first candidate."""

    tips: NDArray  # (K, N + M, m)
    y: NDArray  # (N + M, m)
    weights: NDArray  # (N + M,), of the distances in the score of a blend
    fold: NDArray  # (N + M,)

    @classmethod
    def of(cls, table: CrossFit) -> _ScoredRows:
        """Return the rows of a table."""
        n = len(table.y)
        outer = table.outer
        tips = np.concatenate([table.tips, outer.tips], axis=1)
        y = np.concatenate([table.y, outer.y])
        weights = np.concatenate([table.counts, outer.counts])
        error = distance(tips[0], y)
        eps = np.finfo(float).eps
        for part, share in ((slice(n), 1.0 - _OUTSIDE), (slice(n, None), _OUTSIDE)):
            weights[part] *= share / max(weights[part] @ error[part], eps)
        return cls(tips, y, weights, np.append(table.fold, table.fold[outer.rows]))

    def picked(self, rows: NDArray) -> NDArray:
        """Return the weights (K,) of the candidates, multiples of 0.1 that sum to one.

        Ten times, the candidate that lowers the score most is added; repetition is allowed.

        References
        ----------
        Caruana et al., Ensemble selection from libraries of models, ICML 2004.
        """
        predicted = self.tips[:, rows]
        y = self.y[rows]
        weights = self.weights[rows]
        picks = np.zeros(len(predicted))
        total = np.zeros_like(y)
        for k in range(1, _PICKS + 1):
            means = [weights @ distance((total + x) / k, y) for x in predicted]
            best = simplest_within(means, _EQUAL)
            picks[best] += 1
            total += predicted[best]
        return picks / _PICKS


def _distances_from(train: Tensor, groups: NDArray, test: Tensor) -> NDArray:
    """Return the distances of held-out rows (N, n) from training rows; an actuator spans 2."""
    measure = GroupDistance.fit(train, groups)
    if measure is None:
        return np.zeros(len(test))
    return measure.distances(test).numpy()


def fold_of_rows(splits: Sequence[Split]) -> NDArray:
    """Return the fold in which every row is held out (N,)."""
    fold = np.empty(sum(len(test) for _, test in splits), dtype=int)
    for k, (_, test) in enumerate(splits):
        fold[test] = k
    return fold


def _means_by(labels: NDArray, distances: NDArray, counts: NDArray) -> NDArray:
    """Return the mean distances (K, L) of K models for each of L row labels."""
    means = []
    for label in np.unique(labels):
        k = labels == label
        means.append(np.average(distances[:, k], axis=1, weights=counts[k]))
    return np.array(means).T
