"""Choice of the error model by errors on held-out motions, and on rows outside the fitted ones."""

from __future__ import annotations

import copy
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.linear_model import LinearRegression

from hybridkin.calibration.choice import Errors
from hybridkin.calibration.measured import distance, inner_and_outer
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.hybrid._error_models import (
    ErrorModel,
    KernelModel,
    NamedFeatures,
    NetworkModelCV,
    NoCorrection,
    RegressorModel,
    WeightedModels,
)
from hybridkin.hybrid._fit import Spec, calibrated, fit_hybrid
from hybridkin.hybrid._kernel import folds_of
from hybridkin.hybrid._module import Hybrid
from hybridkin.hybrid._rows import Rows
from hybridkin.learning.elm_cv import ELMRegressorCV

_PICKS = 10  # picks of a blend; each is a weight of 0.1
_EQUAL = 1e-8  # scores this close are equal: readouts end at 1e-9 of their gradient
_OUTSIDE = 0.1  # share of the outer rows in the score of a blend
_MOST = 2000  # rows for kernel ridge, whose cost grows with the cube of their number
# With fewer, penalties that were chosen on all rows suit them.
_FEW_MOTIONS, _FEW_ROWS = (
    40,
    100,
)
_ANEW = 3  # folds, without each of which penalties are then chosen once more


def select(
    spec: Spec,
    rows: Rows,
    progress: Callable[[int, int], None] | None = None,
) -> tuple[Spec, dict[str, Any], dict[str, Hybrid]]:
    """Return the specification with the error model of least held-out error, or a blend.

    Every candidate is fitted to all rows, which fixes its penalties. Then it is fitted to all folds
    but one, and to the inner rows, each time with the mechanical model calibrated on the same rows.
    The predictions for the held-out and the outer rows give the weights of the blend. It can be a
    single candidate. With few motions its penalties are then chosen once more without each of three
    folds: penalties that suit the held-out rows would make the error to expect too small.

    Parameters
    ----------
    spec : Spec
        With the geometry chosen, but not yet calibrated.
    rows : Rows
        Different rows.
    progress : callable, optional
        Called with (done, total) before every candidate.

    Returns
    -------
    spec : Spec
        Calibrated, with its parts.
    results : dict
        Errors of all candidates, see `HybridForwardModel.cv_results_`.
    modules : dict of str to Hybrid
        Every candidate, fitted to all rows.
    """
    y = rows.tips
    counts = rows.counts
    folds = folds_of(rows.X, rows.groups)
    fold_of = np.empty(len(y), dtype=int)
    for k, (_, test) in enumerate(folds):
        fold_of[test] = k
    weighed = replace(rows, groups=None)
    # A single held-out motion has similar ones in training; folds of motions are a harder test.
    by_fold = replace(rows, groups=None if rows.groups is None else fold_of)
    splits = [*folds, inner_and_outer(rows.X)]
    parts = [weighed.take(train) for train, _ in splits]
    alone = [calibrated(replace(spec, left_out=False), part) for part in parts]
    geometry = spec.geometry
    spec = calibrated(spec, rows)
    candidates = _candidates(spec)
    if len(y) > _MOST:
        candidates.popitem()  # the kernel
    settled: list[ErrorModel] = []
    modules: dict[str, Hybrid] = {}
    tests = np.concatenate([test for _, test in splits])
    predicted = np.empty((len(candidates), len(tests), y.shape[1]))
    for i, (name, candidate) in enumerate(candidates.items()):
        if progress is not None:
            progress(i, len(candidates))
        fitted = fit_hybrid(replace(spec, error_model=candidate), by_fold)
        modules[name] = fitted.module
        settled.append(fitted.error.settled)
        held_out = []
        for fold_spec, training_rows, (_, test) in zip(
            alone, parts, splits, strict=True
        ):
            fold_fit = fit_hybrid(
                replace(fold_spec, error_model=settled[-1]), training_rows
            )
            held_out.append(fold_fit.predict(rows.X[test]))
        predicted[i] = np.concatenate(held_out)
    # Held-out rows first, in the order of the log; then the outer ones.
    order = np.concatenate([np.argsort(tests[: len(y)]), np.arange(len(y), len(tests))])
    held_out_rows = _HeldOut.of(predicted[:, order], rows, fold_of, splits[-1][1])
    weights, results = _chosen([*candidates], held_out_rows, rows)
    few = len(y) < _FEW_ROWS
    if rows.groups is not None:
        few = len(np.unique(rows.groups)) < _FEW_MOTIONS
    if spec.left_out and few and len(folds) > 2 and weights[0] < 1.0:
        without_penalties = _blend(candidates.values(), weights)
        blended = np.tensordot(weights, held_out_rows.predicted, 1)
        before = after = 0.0
        for one, (train, test) in zip(alone[:_ANEW], folds, strict=False):
            anew = fit_hybrid(
                replace(one, error_model=without_penalties), by_fold.take(train)
            )
            before += counts[test] @ distance(blended[test], y[test])
            after += counts[test] @ distance(anew.predict(rows.X[test]), y[test])
        results["expected_distance"] *= float(after / before)
    if geometry is None:
        name = "nothing"
        errors = {}
    else:
        name = geometry.name
        errors = geometry.errors
    first_errors = {
        name: Errors(
            *(float(results[key][0]) for key in ("mean_distance", "io_distance"))
        )
    }
    results["parameters"] = name
    results["mechanical_model"] = {
        n: one.known() for n, one in (errors or first_errors).items()
    }
    return replace(spec, error_model=_blend(settled, weights)), results, modules


def _blend(models: Iterable[ErrorModel], shares: NDArray) -> ErrorModel:
    """Return the models of positive weight as one."""
    weights = []
    chosen = []
    for model, weight in zip(models, shares.tolist(), strict=True):
        if weight > 0.0:
            weights.append(weight)
            chosen.append(model)
    return chosen[0] if len(chosen) == 1 else WeightedModels(weights, chosen)


class _HeldOut(NamedTuple):
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
    ) -> _HeldOut:
        """Return both kinds of rows, weighted by the errors of the first candidate, f_mech."""
        n = len(rows.X)
        at = np.concatenate([np.arange(len(rows.X)), outer])
        y = rows.tips[at]
        counts = rows.counts[at]
        weights = counts.copy()
        for part, share in ((slice(0, n), 1.0 - _OUTSIDE), (slice(n, None), _OUTSIDE)):
            total = counts[part] @ distance(predicted[0, part], y[part])
            weights[part] *= share / max(total, np.finfo(float).eps)
        return cls(predicted, y, weights, counts, fold_of[at], n)

    def shares(self, rows: NDArray) -> NDArray:
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


def _chosen(
    names: list[str], found: _HeldOut, rows: Rows
) -> tuple[NDArray, dict[str, Any]]:
    """Return the weights of the candidates, and the errors of all candidates and their blend.

    If the gain of the blend over the mechanical model, paired by motion or fold, is within its
    standard error, the mechanical model is chosen.
    """
    n = found.n
    counts = found.counts
    # On each fold the blend is scored with weights chosen without that fold.
    blend = np.empty_like(found.y)
    for fold in np.unique(found.fold):
        test = found.fold == fold
        blend[test] = np.tensordot(found.shares(~test), found.predicted[:, test], 1)
    distances = np.array([distance(x, found.y) for x in (*found.predicted, blend)])
    held_out = distances[:, :n]
    outer = distances[:, n:]
    by_fold = _means_by(found.fold[:n], held_out, counts[:n])
    weights = found.shares(np.ones(len(blend), dtype=bool))
    if rows.groups is None:
        units = by_fold
    else:
        units = _means_by(rows.groups, held_out, counts[:n])
    gains = units[0] - units[-1]
    if gains.mean() <= gains.std(ddof=1) / np.sqrt(len(gains)):
        weights = np.eye(len(weights))[0]
    means = np.average(held_out, axis=1, weights=counts[:n])
    return weights, {
        "candidate": [*names, "blend"],
        "mean_distance": means,
        "expected_distance": float(means[0 if weights[0] == 1.0 else -1]),
        "std_distance": by_fold.std(axis=1, ddof=1),
        "fold_distance": by_fold,
        "io_distance": np.average(outer, axis=1, weights=counts[n:]),
        "rank": means.argsort().argsort() + 1,
        "chosen": "blend" if (weights < 1.0).all() else names[int(weights.argmax())],
        "weights": dict(zip(names, weights.tolist(), strict=True)),
    }


def _means_by(labels: NDArray, distances: NDArray, counts: NDArray) -> NDArray:
    """Return the mean distances (K, L) of K models for each of L row labels."""
    parts = [labels == label for label in np.unique(labels)]
    return np.array(
        [np.average(distances[:, k], axis=1, weights=counts[k]) for k in parts]
    ).T


def _candidates(spec: Spec) -> dict[str, ErrorModel]:
    """Return the error models by name; of equal candidates the first, simplest one wins."""
    network = ELMRegressorCV(
        250, max_hidden=1000, random_state=copy.deepcopy(spec.random_state)
    )
    if spec.mechanical is None:
        return {
            "linear": RegressorModel(LinearRegression()),
            "ELM": NetworkModelCV(network),
            "kernel": KernelModel(),
        }
    features = ["linear", "quadratic"]
    if isinstance(spec.mechanical, ArcChain):
        features.append("pose")
    candidates: dict[str, ErrorModel] = {
        "mechanical": NoCorrection(),
        "parallel linear": NamedFeatures("linear", "parallel"),
    }
    for coupling in ("serial", "parallel"):
        for name in features:
            candidates[f"{coupling} {name}"] = NamedFeatures(name, coupling)
    candidates["parallel ELM"] = NetworkModelCV(network)
    candidates["parallel kernel"] = KernelModel()
    return candidates
