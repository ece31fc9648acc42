"""Which error model, and where it acts: chosen by errors on whole motions that were left out."""

from __future__ import annotations

import copy
import time
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GroupKFold, KFold

from hybridkin.chains.arc_chain import ArcChain
from hybridkin.chains.constant_curvature import ConstantCurvatureChain
from hybridkin.chains.elastic_tendons import ElasticTendonChain
from hybridkin.hybrid._couplings import Readout
from hybridkin.hybrid._radius import distance
from hybridkin.learning.elm import ELMRegressor
from hybridkin.learning.elm_cv import ELMRegressorCV

_FOLDS, _FOLDS_OF_FEW, _FEW = 5, 10, 200
_ALPHAS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
_PICKS = 10  # of a blend
_MOST = 2000  # rows for kernel ridge, whose cost grows with their cube
_GAMMAS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # over the mean variance of the inputs


class Mechanics(NamedTuple):
    """The mechanical model that was chosen, and how it did on rows left out."""

    model: Any
    names: tuple[str, ...]  # to calibrate
    folds: list[tuple[NDArray, NDArray]]
    chains: list[Any]  # calibrated without each fold
    scores: dict[str, float]  # mean distance of rows left out, of all that were tried [m]


class Part(NamedTuple):
    """One of the hybrids that make up the choice."""

    weight: float
    coupling: str
    error_model: Any


def rivals(mechanical: Any, names: tuple[str, ...], X: NDArray) -> list[tuple[Any, Any]]:
    """Return the mechanical models to choose from, with what to calibrate of them.

    Tendons that contradict each other on a `ConstantCurvatureChain` may be slack: then elastic
    tendons of the same geometry are tried, where the geometry is to be calibrated.
    """
    tendons = isinstance(mechanical, ConstantCurvatureChain) and mechanical.lengths is not None
    if not (tendons and names and mechanical.contradictory(torch.from_numpy(X)).any()):
        return [(mechanical, names)]
    elastic = ElasticTendonChain.from_chain(mechanical)
    if names == tuple(mechanical.default_parameters):
        return [(mechanical, names), (elastic, elastic.default_parameters)]
    # A plain chain's lengths and radii take up what slack does; elastic tendons need not.
    kept = [name for name in names if name not in ("radii", "lengths", "actuator_zeros")]
    own = [name for name in elastic.default_parameters if name not in ("angles", *kept)]
    return [(mechanical, names), (elastic, (*kept, *own))]


def choose_mechanics(
    model: Any,
    mechanicals: list[tuple[Any, Any]],
    X: NDArray,
    y: NDArray,
    weights: NDArray,
    groups: Any,
) -> Mechanics:
    """Return the mechanical model that errs least on rows left out.

    Parameters
    ----------
    model : HybridForwardModel
        Its settings, with error_model="auto".
    mechanicals : list of (nn.Module, names to calibrate)
        Those to choose from.
    X, y : ndarray of shape (N, n) and (N, m)
        Measured rows.
    weights, groups : ndarray of shape (N,), and the same or None
        How often each row counts; its motion.
    """
    folds = _folds(X, groups)
    found = []
    for mechanical, names in mechanicals:
        left_out, chains = np.empty(len(X)), []
        for train, test in folds:
            alone = _fit(
                model, mechanical, "parallel", "drop", X[train], y[train], weights[train], names
            )
            left_out[test] = distance(alone.predict(X[test]), y[test])
            chains.append(alone.mechanical_model_)
        scores = {type(mechanical).__name__: float(np.average(left_out, weights=weights))}
        found.append(Mechanics(mechanical, names, folds, chains, scores))
    scores = {name: score for one in found for name, score in one.scores.items()}
    return min(found, key=lambda one: min(one.scores.values()))._replace(scores=scores)


def choose(
    model: Any,
    mechanical: Any,
    mechanics: Mechanics,
    X: NDArray,
    y: NDArray,
    weights: NDArray,
    groups: Any,
) -> tuple[list[Part], dict[str, Any]]:
    """Return the error model with the least mean distance on groups left out, or a blend of some.

    Every candidate is fitted to all rows, which settles its penalties; then to all but a fold,
    with the calibration made anew without it. What the candidates predict for the rows left out
    tells the weights of their blend, which may be a single one.

    Parameters
    ----------
    model : HybridForwardModel
        Its settings, with error_model="auto".
    mechanical : nn.Module
        Calibrated to all rows.
    mechanics : Mechanics
        The same without each fold.
    X, y, weights, groups
        As for `choose_mechanics`.

    Returns
    -------
    parts : list of Part
        Those of weight.
    results : dict
        How all candidates did.
    """
    folds = mechanics.folds
    fold_of = np.empty(len(X), dtype=int)
    for k, (_, test) in enumerate(folds):
        fold_of[test] = k
    # Single motions left out have siblings that stay; folds of motions judge more strictly.
    by_motion = None if groups is None else fold_of
    candidates = _candidates(mechanical, copy.deepcopy(model.random_state))
    if len(X) > _MOST:
        del candidates["parallel kernel"]
    settled, seconds = [], []
    error = y - _fit(model, mechanical, "parallel", "drop", X, y, weights).predict(X)
    for coupling, error_model in candidates.values():
        start = time.process_time()
        if isinstance(error_model, KernelRidge):
            settled.append((coupling, _tuned(X, error, weights, folds)))
        else:
            fitted = _fit(model, mechanical, coupling, error_model, X, y, weights, groups=by_motion)
            settled.append((coupling, _settled(error_model, fitted.error_model_)))
        seconds.append(time.process_time() - start)
    left_out = np.empty((len(candidates), *y.shape))
    for (train, test), chain in zip(folds, mechanics.chains, strict=True):
        for i, (coupling, error_model) in enumerate(settled):
            start = time.process_time()
            part = _fit(model, chain, coupling, error_model, X[train], y[train], weights[train])
            left_out[i, test] = part.predict(X[test])
            seconds[i] += time.process_time() - start
    blended = _blended(left_out, y, weights, fold_of)
    distances = np.array([distance(x, y) for x in (*left_out, blended)])
    by_fold = np.array(
        [
            np.average(distances[:, test], axis=1, weights=weights[test])
            for _, test in folds
            if weights[test].any()
        ]
    ).T
    means = np.average(distances, axis=1, weights=weights)
    shares = _shares(left_out, y, weights)
    best = len(candidates) if (shares < 1.0).all() else int(shares.argmax())
    names = [*candidates, "blend"]
    results = {
        "candidate": names,
        "mean_distance": means,
        "std_distance": by_fold.std(axis=1, ddof=1),
        "fold_distance": by_fold,
        "rank": means.argsort().argsort() + 1,
        "seconds": np.array([*seconds, 0.0]),
        "chosen": names[best],
        "weights": dict(zip(candidates, shares.tolist(), strict=True)),
        "mechanical_model": mechanics.scores,
    }
    parts = [Part(float(w), *one) for w, one in zip(shares, settled, strict=True) if w > 0.0]
    return parts, results


def _blended(left_out: NDArray, y: NDArray, weights: NDArray, fold_of: NDArray) -> NDArray:
    """Return what blends predict whose weights know nothing of the fold they are examined on."""
    blended = np.empty_like(y)
    for fold in np.unique(fold_of):
        test = fold_of == fold
        shares = _shares(left_out[:, ~test], y[~test], weights[~test])
        blended[test] = np.tensordot(shares, left_out[:, test], 1)
    return blended


def _shares(left_out: NDArray, y: NDArray, weights: NDArray) -> NDArray:
    """Return the weights (K,) of the candidates, multiples of a tenth that sum to one.

    Whichever lowers the mean distance most is added, ten times, the same again too.

    References
    ----------
    Caruana et al., Ensemble selection from libraries of models, ICML 2004.
    """
    picks, total = np.zeros(len(left_out)), np.zeros_like(y)
    for k in range(1, _PICKS + 1):
        means = [weights @ distance((total + x) / k, y) for x in left_out]
        best = int(np.argmin(means))
        picks[best] += 1
        total += left_out[best]
    return picks / _PICKS


def _candidates(mechanical: Any, seed: Any) -> dict[str, tuple[str, Any]]:
    """Return coupling and error model by name, the simplest first: of equals it is chosen."""
    inside = ("linear", "quadratic", *(("pose",) if isinstance(mechanical, ArcChain) else ()))
    network = ELMRegressorCV(250, max_hidden=1000, random_state=seed)
    candidates: dict[str, tuple[str, Any]] = {
        "mechanical": ("parallel", "drop"),
        "parallel linear": ("parallel", Readout("linear")),
    }
    candidates |= {f"serial {kind}": ("serial", Readout(kind)) for kind in inside}
    candidates |= {f"parallel {kind}": ("parallel", Readout(kind)) for kind in inside[1:]}
    candidates["parallel ELM"] = ("parallel", network)
    candidates["parallel kernel"] = ("parallel", KernelRidge(kernel="rbf"))
    return candidates


def _tuned(X: NDArray, error: NDArray, weights: NDArray, folds: list[Any]) -> KernelRidge:
    """Return kernel ridge with the width and the penalty that err least on the folds."""
    spread = X.var(axis=0).mean() or 1.0
    missed: dict[tuple[int, int], float] = {}

    def ridge(place: tuple[int, int]) -> Any:
        gamma = _GAMMAS[place[0]] / spread
        return KernelRidge(kernel="rbf", gamma=gamma).set_params(alpha=_ALPHAS[place[1]])

    def error_left_out(place: tuple[int, int]) -> float:
        if place not in missed:
            missed[place] = 0.0
            for train, test in folds:
                part = ridge(place).fit(X[train], error[train], sample_weight=weights[train])
                left = distance(part.predict(X[test]), error[test])
                missed[place] += float(weights[test] @ left)
        return missed[place]

    widths, penalties = range(len(_GAMMAS)), range(len(_ALPHAS))
    best = min(product(widths[::2], penalties[1::2]), key=error_left_out)
    previous = None
    while best != previous:
        width, penalty = best
        near = product(range(width - 1, width + 2), range(penalty - 1, penalty + 2))
        inside = (place for place in near if place[0] in widths and place[1] in penalties)
        previous, best = best, min(inside, key=error_left_out)
    return ridge(best)


def _settled(error_model: Any, fitted: Any) -> Any:
    """Return the error model with the choices that its fit to all rows made."""
    if isinstance(error_model, Readout):
        return error_model._replace(alphas=fitted.alphas, noise_ratio=fitted.noise_ratio)
    if isinstance(error_model, ELMRegressorCV):
        return ELMRegressor(**fitted.best_params_)
    return error_model


def _fit(
    model: Any,
    mechanical: Any,
    coupling: str,
    error_model: Any,
    X: NDArray,
    y: NDArray,
    weights: NDArray,
    names: tuple[str, ...] = (),
    groups: Any = None,
) -> Any:
    part: Any = clone(model)
    part.set_params(
        mechanical_model=mechanical,
        error_model=error_model,
        coupling=coupling,
        calibrate=names,
        coverage=None,
        play=None,
    )
    return part.fit(X, y, sample_weight=weights, groups=groups)


def _folds(X: NDArray, groups: Any) -> list[tuple[NDArray, NDArray]]:
    n_folds = _FOLDS if len(X) >= _FEW else _FOLDS_OF_FEW
    if groups is None:
        n_folds = min(n_folds, len(X))
        return [*KFold(n_folds, shuffle=True, random_state=0).split(X)]
    n_folds = min(n_folds, len(np.unique(groups)))
    if n_folds < 2:
        raise ValueError(
            "`groups` must hold at least two motions with error_model='auto', so that one can be "
            "left out, got one; leave `groups` out to leave out single rows."
        )
    return [*GroupKFold(n_folds, shuffle=True, random_state=0).split(X, groups=groups)]
