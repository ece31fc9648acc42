"""Choice of the error model by errors on held-out motions, and on rows outside the fitted ones."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression
from typing_extensions import Self

from hybridkin.calibration.choice import Errors, GeometryChoice
from hybridkin.calibration.measured import distance, inner_and_outer
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.hybrid._error_models import (
    Blend,
    KernelModel,
    LinearModel,
    NetworkModelCV,
    NoCorrection,
    QuadraticModel,
    RegressorModel,
    ShapeModel,
)
from hybridkin.hybrid._fit import FittedHybrid, fit_hybrid
from hybridkin.hybrid._kernel import folds_of
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import ErrorModel, FittedError, Seed, Spec
from hybridkin.hybrid.cv_results import CvResults
from hybridkin.learning.elm_cv import ELMRegressorCV

_PICKS = 10  # picks of a blend; each is a weight of 0.1
_EQUAL = 1e-8  # scores this close are equal: readouts end at 1e-9 of their gradient
_OUTSIDE = 0.1  # share of the outer rows in the score of a blend
_MOST = 2000  # rows for kernel ridge, whose cost grows with the cube of their number
# With fewer, penalties that were chosen on all rows suit them.
_FEW_MOTIONS = 40
_FEW_ROWS = 100
_ANEW = 3  # folds, without each of which penalties are then chosen once more
_MEAN_LENGTH = 1.596  # mean length of a standard normal vector with three coordinates


class Part(NamedTuple):
    """Rows of a log to fit to, with the mechanical model calibrated on them, and test rows."""

    spec: Spec
    rows: Rows
    train: NDArray
    test: NDArray


class Auto(ErrorModel):
    """The blend of error models with the least error on held-out groups, or rows.

    Every candidate is fitted to all rows, which fixes its penalties. Then it is fitted to all folds
    but one, and to the inner rows, each time with the mechanical model calibrated on the same rows.
    The predictions for the held-out and the outer rows give the weights of the blend. It can be a
    single candidate.

    Parameters
    ----------
    random_state : int, RandomState or None
        Seed of the network.
    """

    chooses = True
    needs_mechanical = False

    def __init__(self, random_state: Seed) -> None:
        self.random_state = random_state

    @classmethod
    def of(cls, coupling: str, random_state: Seed) -> Self:
        """Return the error model for these settings of a HybridForwardModel."""
        return cls(random_state)

    def fit(self, rows: Rows, spec: Spec) -> FittedError:
        """Return the blend, fitted to all rows, and the comparison of the candidates."""
        folds = folds_of(rows.X, rows.groups)
        fold_of = np.empty(len(rows), dtype=int)
        for k, (_, test) in enumerate(folds):
            fold_of[test] = k
        parts = []
        for train, test in [*folds, inner_and_outer(rows.X)]:
            # A single held-out motion has similar ones in training; folds are a harder test.
            training_rows = replace(rows, groups=None).take(train)
            recalibrated = spec.recalibrated(training_rows)
            parts.append(Part(recalibrated, training_rows, train, test))
        by_fold = rows
        if rows.groups is not None:
            by_fold = replace(rows, groups=fold_of)
        candidates = self._candidates(spec, len(rows))
        fits: dict[str, FittedHybrid] = {}
        predictions = []
        for name, candidate in candidates.items():
            if spec.progress is not None:
                spec.progress(len(fits), len(candidates))
            fits[name] = fit_hybrid(replace(spec, error_model=candidate), by_fold)
            settled = fits[name].error.settled
            predictions.append(_predictions(settled, parts, rows))
        outer = parts[-1].test
        held_out = HeldOut.of(np.array(predictions), rows, fold_of, outer)
        weights, comparison = chosen_blend([*candidates], held_out, rows, spec.geometry)
        if spec.expected is not None:
            comparison["expected_distance"] = spec.expected
        elif spec.held_out and weights[0] < 1.0 and _is_small(rows):
            nearby = []
            for name, candidate in candidates.items():
                nearby.append(candidate.starting_at(fits[name].error.settled))
            unsettled = blend_of(nearby, weights)
            blended = np.tensordot(weights, held_out.predicted, 1)[: len(rows)]
            comparison["expected_distance"] *= _optimism(
                unsettled, parts[:-1], by_fold, blended
            )
        settled = [fitted.error.settled for fitted in fits.values()]
        return replace(
            blend_of(settled, weights).fit(rows, spec),
            noise=comparison["expected_distance"] / _MEAN_LENGTH,
            held_out=True,
            comparison=comparison,
            candidates={name: fitted.module for name, fitted in fits.items()},
        )

    def _candidates(self, spec: Spec, n_rows: int) -> dict[str, ErrorModel]:
        """Return the error models by name; of equal candidates the first, simplest one wins."""
        network = ELMRegressorCV(
            250,
            relevance_rounds=3,
            max_hidden=1000,
            random_state=copy.deepcopy(self.random_state),
        )
        candidates: dict[str, ErrorModel] = {}
        at_tip = ""
        if spec.mechanical is None:
            candidates["linear"] = RegressorModel(LinearRegression())
        else:
            candidates["mechanical"] = NoCorrection()
            candidates["serial linear"] = LinearModel("serial")
            candidates["serial quadratic"] = QuadraticModel("serial")
            at_tip = "parallel "
            if isinstance(spec.mechanical, ArcChain):
                candidates["serial pose"] = ShapeModel("serial")
                candidates["parallel pose"] = ShapeModel("parallel")
            else:
                candidates["parallel quadratic"] = QuadraticModel("parallel")
        candidates[f"{at_tip}ELM"] = NetworkModelCV(network)
        if n_rows <= _MOST:
            candidates[f"{at_tip}kernel"] = KernelModel()
        return candidates


def _predictions(model: ErrorModel, parts: list[Part], rows: Rows) -> NDArray:
    """Return predictions (N + M, m) of the held-out rows in their order, then of the outer ones."""
    held_out = np.empty_like(rows.tips)
    predicted = held_out
    for part in parts:
        fitted = fit_hybrid(replace(part.spec, error_model=model), part.rows)
        predicted = fitted.predict(rows.X[part.test])
        if part is not parts[-1]:
            held_out[part.test] = predicted
    return np.concatenate([held_out, predicted])


def _is_small(rows: Rows) -> bool:
    """Return whether penalties chosen on all rows suit held-out ones, and folds can be refitted."""
    if rows.groups is None:
        return 2 < len(rows) < _FEW_ROWS
    return 2 < len(np.unique(rows.groups)) < _FEW_MOTIONS


def _optimism(
    model: ErrorModel, folds: list[Part], rows: Rows, blended: NDArray
) -> float:
    """Return the ratio of held-out errors with penalties chosen without a fold, to those with it.

    Penalties that suit the held-out rows would make the error to expect too small.
    """
    before = after = 0.0
    for fold in folds[:_ANEW]:
        test = rows.take(fold.test)
        anew = fit_hybrid(replace(fold.spec, error_model=model), rows.take(fold.train))
        before += test.counts @ distance(blended[fold.test], test.tips)
        after += test.counts @ distance(anew.predict(test.X), test.tips)
    return float(after / before)


def blend_of(models: Iterable[ErrorModel], weights: NDArray) -> ErrorModel:
    """Return the models of positive weight as one."""
    positive = []
    chosen = []
    for model, weight in zip(models, weights.tolist(), strict=True):
        if weight > 0.0:
            positive.append(weight)
            chosen.append(model)
    return chosen[0] if len(chosen) == 1 else Blend(positive, chosen)


class HeldOut(NamedTuple):
    """Predictions of all candidates for the N held-out rows, then for the outer rows."""

    predicted: NDArray  # (K, N + M, m)
    y: NDArray  # (N + M, m)
    weights: NDArray  # (N + M,), of the distances in the score of a blend
    counts: NDArray
    fold: NDArray  # (N + M,), the fold of the row
    n: int

    @classmethod
    def of(
        cls, predicted: NDArray, rows: Rows, fold_of: NDArray, outer: NDArray
    ) -> HeldOut:
        """Return both kinds of rows, weighted by the errors of the first candidate, f_mech."""
        n = len(rows)
        places = np.concatenate([np.arange(n), outer])
        y = rows.tips[places]
        counts = rows.counts[places]
        weights = counts.copy()
        error = distance(predicted[0], y)
        eps = np.finfo(float).eps
        weights[:n] *= (1.0 - _OUTSIDE) / max(counts[:n] @ error[:n], eps)
        weights[n:] *= _OUTSIDE / max(counts[n:] @ error[n:], eps)
        return cls(predicted, y, weights, counts, fold_of[places], n)

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
    rows: Rows,
    geometry: GeometryChoice | None = None,
) -> tuple[NDArray, CvResults]:
    """Return the weights of the candidates, and the errors of all candidates and their blend.

    If the gain of the blend over the mechanical model, paired by motion or fold, is within its
    standard error, the mechanical model is chosen.
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
    if rows.groups is not None:
        by_motion = _means_by(rows.groups, of_held_out, counts[:n])
    gains = by_motion[0] - by_motion[-1]
    weights = held_out.blend_weights(np.ones(len(blend), dtype=bool))
    standard_error = gains.std(ddof=1) / np.sqrt(len(gains))
    if gains.mean() <= standard_error:
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
