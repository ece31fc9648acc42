"""Which error model, and where it acts: chosen by errors on whole motions that were left out."""

from __future__ import annotations

import copy
import time
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from sklearn.base import clone
from sklearn.kernel_ridge import KernelRidge
from sklearn.model_selection import GroupKFold, KFold

from hybridkin._arc_chain import ArcChain
from hybridkin._couplings import Readout
from hybridkin.elm import ELMRegressor
from hybridkin.elm_cv import ELMRegressorCV

_FOLDS, _FOLDS_OF_FEW, _FEW = 5, 10, 200
_ALPHAS = (1e-5, 1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
_MOST = 2000  # rows for kernel ridge, whose cost grows with their cube
_GAMMAS = (0.003, 0.01, 0.03, 0.1, 0.3, 1.0)  # over the mean variance of the inputs


class Choice(NamedTuple):
    """What was chosen: where the error acts, the error model, and how all candidates did."""

    coupling: str
    error_model: Any
    results: dict[str, Any]


def choose(
    model: Any, mechanical: Any, X: NDArray, y: NDArray, weights: Any, groups: Any
) -> Choice:
    """Return the error model with the least mean distance on groups left out.

    Every candidate is fitted to all rows, which settles its penalties; then to all but a fold,
    with the calibration made anew without it.

    Parameters
    ----------
    model : HybridForwardModel
        Its settings, with error_model="auto".
    mechanical : nn.Module
        Calibrated to all rows.
    X, y : ndarray of shape (N, n) and (N, m)
        Measured rows.
    weights, groups : ndarray of shape (N,) or None
        How often each row counts; its motion.
    """
    weights = np.ones(len(X)) if weights is None else weights
    folds = _folds(X, groups)
    fold_of = np.empty(len(X), dtype=int)
    for k, (_, test) in enumerate(folds):
        fold_of[test] = k
    # Single motions left out have siblings that stay; folds of motions judge more strictly.
    by_motion = None if groups is None else fold_of
    seed = copy.deepcopy(model.random_state)
    candidates = _candidates(mechanical, seed)
    if len(X) > _MOST:
        del candidates["parallel kernel"]
    settled, seconds = [], []
    error = y - _fit(model, mechanical, "parallel", "drop", X, y, weights, None).predict(X)
    for coupling, error_model in candidates.values():
        start = time.process_time()
        if isinstance(error_model, KernelRidge):
            settled.append((coupling, _tuned(X, error, weights, folds)))
        else:
            fitted = _fit(model, mechanical, coupling, error_model, X, y, weights, by_motion)
            settled.append((coupling, _settled(error_model, fitted.error_model_)))
        seconds.append(time.process_time() - start)
    distances = np.empty((len(candidates), len(X)))
    for train, test in folds:
        alone: Any = clone(model).set_params(  # pyright: ignore[reportAttributeAccessIssue]
            error_model="drop", coverage=None
        )
        chain = alone.fit(X[train], y[train], sample_weight=weights[train]).mechanical_model_
        for i, (coupling, error_model) in enumerate(settled):
            start = time.process_time()
            part = _fit(
                model, chain, coupling, error_model, X[train], y[train], weights[train], None
            )
            errors = (part.predict(X[test]) - y[test]).reshape(len(test), -1)
            distances[i, test] = np.linalg.norm(errors, axis=1)
            seconds[i] += time.process_time() - start
    by_fold = np.array(
        [
            np.average(distances[:, test], axis=1, weights=weights[test])
            for _, test in folds
            if weights[test].any()
        ]
    ).T
    means = np.average(distances, axis=1, weights=weights)
    best = int(means.argmin())
    results = {
        "candidate": [*candidates],
        "mean_distance": means,
        "std_distance": by_fold.std(axis=1, ddof=1),
        "fold_distance": by_fold,
        "rank": means.argsort().argsort() + 1,
        "seconds": np.array(seconds),
        "chosen": [*candidates][best],
    }
    coupling, error_model = settled[best]
    return Choice(coupling, error_model, results)


def _candidates(mechanical: Any, seed: Any) -> dict[str, tuple[str, Any]]:
    """Return coupling and error model by name, the simplest first: of equals it is chosen."""
    inside = ("linear", "quadratic", *(("pose",) if isinstance(mechanical, ArcChain) else ()))
    network = ELMRegressorCV(max_hidden=1000, random_state=seed)
    candidates: dict[str, tuple[str, Any]] = {
        "mechanical": ("parallel", "drop"),
        "parallel linear": ("parallel", Readout("linear")),
    }
    candidates |= {f"serial {kind}": ("serial", Readout(kind)) for kind in inside}
    candidates["parallel quadratic"] = ("parallel", Readout("quadratic"))
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
                left = (error[test] - part.predict(X[test])).reshape(len(test), -1)
                missed[place] += weights[test] @ np.linalg.norm(left, axis=1)
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
        return error_model._replace(alphas=fitted.alphas)
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
    groups: Any,
) -> Any:
    part: Any = clone(model)
    part.set_params(
        mechanical_model=mechanical,
        error_model=error_model,
        coupling=coupling,
        calibrate=(),
        coverage=None,
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
