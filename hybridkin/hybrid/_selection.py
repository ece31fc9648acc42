"""Which mechanical model and which error models: chosen by errors on held-out motions."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge

from hybridkin._core.model import ForwardModel
from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.hybrid._fit import NamedFeatures, Part, Rows, Spec, calibrated, fit_hybrid
from hybridkin.hybrid._kernel import distance, folds_of
from hybridkin.hybrid._readout_fit import ReadoutFit
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

_PICKS = 10  # of a blend
_MOST = 2000  # rows for kernel ridge, whose cost grows with their cube


class Mechanics(NamedTuple):
    """A mechanical model for error_model="auto", and its errors on held-out rows."""

    spec: Spec  # with this model
    chains: list[ForwardModel | None]  # calibrated without each fold
    scores: dict[str, float]  # mean held-out distance of all models that were tried [m]

    @classmethod
    def of(cls, spec: Spec, rows: Rows) -> Mechanics:
        """Return the model of a specification, calibrated without each fold of the rows."""
        held_out, chains = np.empty(len(rows.X)), []
        alone = replace(spec, parts=(Part(1.0, "parallel", "drop"),))
        weighed = rows._replace(weights=rows.counts, groups=None)
        for train, test in folds_of(rows.X, rows.groups):
            fitted = fit_hybrid(alone, weighed.take(train))
            held_out[test] = distance(fitted.predict(rows.X[test]), rows.tips[test])
            chains.append(fitted.mechanical)
        score = float(np.average(held_out, weights=rows.counts))
        return cls(spec, chains, {type(spec.mechanical).__name__: score})


def choose_mechanics(spec: Spec, rows: Rows) -> Mechanics:
    """Return the mechanical model of least held-out distance.

    Tendons that contradict each other on a `ConstantCurvatureChain` may be slack: then elastic
    tendons of the same geometry are tried, where the geometry is to be calibrated.
    """
    tried = [Mechanics.of(one, rows) for one in _rivals(spec, rows)]
    scores = {name: score for one in tried for name, score in one.scores.items()}
    return min(tried, key=lambda one: min(one.scores.values()))._replace(scores=scores)


def select(mechanics: Mechanics, rows: Rows) -> tuple[Spec, dict[str, Any]]:
    """Return the specification with the error model of least held-out distance, or a blend.

    Every candidate is fitted to all rows, which settles its penalties; then to all but one fold,
    on the mechanical model calibrated without that fold. The held-out predictions of the
    candidates give the weights of their blend, which may be a single one.

    Parameters
    ----------
    mechanics : Mechanics
        The mechanical model, on the same rows.
    rows : Rows
        Measured rows.

    Returns
    -------
    spec : Spec
        Calibrated, with its parts.
    results : dict
        The errors of all candidates, see `HybridForwardModel.cv_results_`.
    """
    spec = calibrated(mechanics.spec, rows)
    y, counts, folds = rows.tips, rows.counts, folds_of(rows.X, rows.groups)
    fold_of = np.empty(len(y), dtype=int)
    for k, (_, test) in enumerate(folds):
        fold_of[test] = k
    weighed = rows._replace(weights=counts, groups=None)
    # A single held-out motion has similar ones in training; folds of motions judge more strictly.
    by_fold = weighed._replace(groups=None if rows.groups is None else fold_of)
    candidates = _candidates(spec)
    if len(y) > _MOST:
        del candidates["parallel kernel"]
    settled: list[Part] = []
    held_out = np.empty((len(candidates), *y.shape))
    for i, (coupling, error_model) in enumerate(candidates.values()):
        fitted = fit_hybrid(replace(spec, parts=(Part(1.0, coupling, error_model),)), by_fold)
        part = Part(1.0, coupling, _settled(error_model, fitted.error_model))
        settled.append(part)
        for (train, test), chain in zip(folds, mechanics.chains, strict=True):
            alone = replace(spec, mechanical=chain, parts=(part,))
            held_out[i, test] = fit_hybrid(alone, weighed.take(train)).predict(rows.X[test])
    shares = _shares(held_out, y, counts)
    parts = [part._replace(weight=float(w)) for w, part in zip(shares, settled, strict=True)]
    results = _results([*candidates], held_out, shares, fold_of, rows)
    results["mechanical_model"] = mechanics.scores
    return replace(spec, parts=tuple(part for part in parts if part.weight > 0.0)), results


def _results(
    names: list[str], held_out: NDArray, shares: NDArray, fold_of: NDArray, rows: Rows
) -> dict[str, Any]:
    """Return the held-out errors of all candidates and of their blend."""
    y, counts = rows.tips, rows.counts
    # The blend is judged by weights that were chosen without the fold.
    blend = np.empty_like(y)
    tests = [fold_of == fold for fold in np.unique(fold_of)]
    for test in tests:
        own = _shares(held_out[:, ~test], y[~test], counts[~test])
        blend[test] = np.tensordot(own, held_out[:, test], 1)
    distances = np.array([distance(x, y) for x in (*held_out, blend)])
    by_fold = np.array([np.average(distances[:, k], axis=1, weights=counts[k]) for k in tests]).T
    means = np.average(distances, axis=1, weights=counts)
    return {
        "candidate": [*names, "blend"],
        "mean_distance": means,
        "std_distance": by_fold.std(axis=1, ddof=1),
        "fold_distance": by_fold,
        "rank": means.argsort().argsort() + 1,
        "chosen": "blend" if (shares < 1.0).all() else names[int(shares.argmax())],
        "weights": dict(zip(names, shares.tolist(), strict=True)),
    }


def _shares(held_out: NDArray, y: NDArray, weights: NDArray) -> NDArray:
    """Return the weights (K,) of the candidates, multiples of a tenth that sum to one.

    Ten times the candidate that lowers the mean distance most is added, the same one again too.

    References
    ----------
    Caruana et al., Ensemble selection from libraries of models, ICML 2004.
    """
    picks, total = np.zeros(len(held_out)), np.zeros_like(y)
    for k in range(1, _PICKS + 1):
        means = [weights @ distance((total + x) / k, y) for x in held_out]
        best = int(np.argmin(means))
        picks[best] += 1
        total += held_out[best]
    return picks / _PICKS


def _rivals(spec: Spec, rows: Rows) -> list[Spec]:
    """Return the specifications of the mechanical models to choose from."""
    mechanical, names = spec.mechanical, spec.calibrate
    if not (isinstance(mechanical, ConstantCurvatureChain) and names):
        return [spec]
    if mechanical.lengths is None or not mechanical.contradictory(rows.q).any():
        return [spec]
    elastic = ElasticTendonChain.from_chain(mechanical)
    own = elastic.default_parameters
    if names != mechanical.default_parameters:
        # A plain chain's lengths and radii compensate slack; elastic tendons need no such change.
        kept = [name for name in names if name not in ("radii", "lengths", "actuator_zeros")]
        own = (*kept, *(name for name in own if name not in ("angles", *kept)))
    return [spec, replace(spec, mechanical=elastic, calibrate=own)]


def _candidates(spec: Spec) -> dict[str, tuple[str, Any]]:
    """Return coupling and error model by name, the simplest first: of equals it is chosen."""
    inside = ("linear", "quadratic", *(("pose",) if isinstance(spec.mechanical, ArcChain) else ()))
    network = ELMRegressorCV(250, max_hidden=1000, random_state=copy.deepcopy(spec.random_state))
    candidates: dict[str, tuple[str, Any]] = {
        "mechanical": ("parallel", "drop"),
        "parallel linear": ("parallel", NamedFeatures("linear")),
    }
    candidates |= {f"serial {kind}": ("serial", NamedFeatures(kind)) for kind in inside}
    candidates |= {f"parallel {kind}": ("parallel", NamedFeatures(kind)) for kind in inside[1:]}
    candidates["parallel ELM"] = ("parallel", network)
    candidates["parallel kernel"] = ("parallel", "kernel")
    return candidates


def _settled(error_model: Any, fitted: Any) -> Any:
    """Return the error model with the choices that its fit to all rows made."""
    if isinstance(fitted, ReadoutFit):
        return error_model._replace(alphas=fitted.alphas, noise_ratio=fitted.noise_ratio)
    if isinstance(error_model, ELMRegressorCV):
        return ELMRegressor(**fitted.best_params_)
    return clone(fitted) if isinstance(fitted, KernelRidge) else error_model
