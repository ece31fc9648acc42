"""Extreme learning machine with hyperparameters chosen by cross-validation."""

from collections.abc import Iterable
from itertools import product
from numbers import Integral
from typing import Any, NamedTuple

import numpy as np
from sklearn.base import _fit_context
from sklearn.model_selection import (
    GroupKFold,
    LeaveOneGroupOut,
    PredefinedSplit,
    check_cv,
)
from sklearn.utils import check_random_state, gen_batches
from sklearn.utils._param_validation import Interval, StrOptions
from sklearn.utils.validation import check_is_fitted

from hybridkin._core.arrays import LARGEST, labels
from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin._core.stored import plain
from hybridkin._core.turns import TURNS
from hybridkin.learning._left_out import LeftOut
from hybridkin.learning._ridge import gather
from hybridkin.learning.elm import ELMRegressor, FittedNetwork
from hybridkin.learning.hidden_layer import check_rows, device_named, draw_layer

# Times the largest eigenvalue of the features' Gram matrix.
_AUTO_ALPHAS = np.logspace(-11, 2, 40)
# Factors on the best weight scale, tried with new input scales.
_ZOOM = (
    0.5,
    1.0,
    2.0,
    4.0,
)
_WORTH_GROWING = 0.96  # of the mean squared error: 2 % of the error
_LEAST_RELEVANCE = 0.01
_ROWS_OF_JACOBIANS = 10_000
_SHARED = [
    "activation",
    "input_scaling",
    "fit_intercept",
    "direct_link",
    "block_size",
    "device",
]


class ELMRegressorCV(FittedNetwork):
    """Extreme learning machine with cross-validated penalty, weight scale, size and input scales.

    Every choice minimises the mean squared error on held-out rows, each row alone or by groups.
    These errors are exact for the given hidden layer and input scales. One factorisation gives
    them for the whole grid of penalties, without refits.

    In relevance rounds, each input is then scaled by how much the derivative with respect to it
    varies over the training rows. Inputs without effect, or with a linear effect, then use fewer
    hidden neurons; a direct link models the linear part. A round is kept if the error decreases.

    Parameters
    ----------
    n_hidden : int or sequence of int, default=500
        Numbers of hidden neurons to try.
    alphas : "auto" or array-like of shape (n_alphas,), default="auto"
        Penalties to try; "auto" takes 40, from 1e-11 to 100 times the largest eigenvalue of the
        features' Gram matrix.
    weight_scales : sequence of float, default=(0.1, 0.2, 0.4, 0.8, 1.6)
        Ranges of the random weights to try.
    cv : int, splitter or iterable of (train, test), default=None
        Which rows are held out together. None: each group if `fit` gets groups, else each row
        alone. Equal rows of a group are held out together, unless the splits are listed.
    relevance_rounds : int, default=5
        Largest number of relevance rounds, which rescale the inputs.
    max_hidden : int, default=2000
        The number of neurons is doubled up to this limit while each doubling reduces the error by
        at least 2 %. With 0 only `n_hidden` is tried: fewer neurons make a faster model.
    activation, input_scaling, fit_intercept, direct_link, block_size, device, random_state
        As in `ELMRegressor`. All weight scales use the same random draw.

    Attributes
    ----------
    best_params_ : dict
        ``ELMRegressor(**best_params_).fit(X, y)`` is the chosen model.
    best_estimator_ : ELMRegressor
        The chosen model, fitted to all rows.
    best_score_ : float
        Its negative mean squared error on held-out rows [unit of y^2]. It is optimistic, because
        the model was chosen by it: the error on new rows was 1.3 to 2.4 times as large with 20
        rows, 1.2 to 1.6 times with 40, 1.0 to 1.4 with 100 and 1.0 to 1.1 with 400 (means over
        draws, four data sets), and up to 19 times in single draws of 20.
    alpha_ : float
        The chosen penalty.
    left_out_errors_ : ndarray of the shape of y
        Target minus prediction of the chosen model fitted without the row [unit of y]. The mean if
        a row was held out more than once; NaN if never, or if its weight is 0.
    cv_results_ : dict of ndarray
        One row per candidate: n_hidden, weight_scale, relevance (n_inputs,), alphas and
        mean_squared_error (n_alphas,).
    module_ : ELM
        The fitted network as a torch module.
    n_features_in_ : int
        Number of inputs.
    feature_names_in_ : ndarray of shape (n_inputs,)
        Names of the columns, if `X` had any.

    See Also
    --------
    ELMRegressor : The network itself; `partial_fit` adds rows.

    References
    ----------
    .. [1] Allen, D. M. (1974). The relationship between variable selection and data augmentation
       and a method for prediction. Technometrics, 16, 125-127.

    Examples
    --------
    >>> from sklearn.datasets import make_friedman1
    >>> from hybridkin import ELMRegressorCV
    >>> X, y = make_friedman1(300, noise=0.1, random_state=0)
    >>> elm = ELMRegressorCV(n_hidden=100, random_state=0).fit(X, y)
    >>> X_new, y_new = make_friedman1(1000, random_state=1)
    >>> bool(elm.score(X_new, y_new) > 0.99)
    True
    """

    _parameter_constraints = {  # noqa: RUF012
        "n_hidden": [Interval(Integral, 1, None, closed="left"), "array-like"],
        "alphas": [StrOptions({"auto"}), "array-like"],
        "weight_scales": ["array-like"],
        "cv": ["cv_object"],
        "relevance_rounds": [Interval(Integral, 0, None, closed="left")],
        "max_hidden": [Interval(Integral, 0, None, closed="left")],
        **{
            name: ELMRegressor._parameter_constraints[name]
            for name in (*_SHARED, "random_state")
        },
    }

    def __init__(
        self,
        n_hidden=500,
        alphas="auto",
        weight_scales=(0.1, 0.2, 0.4, 0.8, 1.6),
        *,
        cv=None,
        relevance_rounds=5,
        max_hidden=2000,
        activation="logistic",
        input_scaling="minmax",
        fit_intercept=True,
        direct_link=True,
        block_size=None,
        device=None,
        random_state=None,
    ):
        self.n_hidden = n_hidden
        self.alphas = alphas
        self.weight_scales = weight_scales
        self.cv = cv
        self.relevance_rounds = relevance_rounds
        self.max_hidden = max_hidden
        self.activation = activation
        self.input_scaling = input_scaling
        self.fit_intercept = fit_intercept
        self.direct_link = direct_link
        self.block_size = block_size
        self.device = device
        self.random_state = random_state

    @_fit_context(prefer_skip_nested_validation=True)
    def fit(self, X, y, sample_weight=None, groups=None):
        """Choose the parameters by errors on held-out rows, fit to all rows, and return self.

        Parameters
        ----------
        X : array-like of shape (n_samples, n_inputs)
            Inputs.
        y : array-like of shape (n_samples,) or (n_samples, n_outputs)
            Targets.
        sample_weight : array-like of shape (n_samples,), default=None
            How often each row counts: 2 is the same as the row twice, 0 drops it. Equal rows are
            held out together.
        groups : array-like of shape (n_samples,), default=None
            Groups of rows that are held out together, e.g. the motion of each row.

        Returns
        -------
        self : ELMRegressorCV
            The fitted estimator.
        """
        X, y, sample_weight = check_rows(self, X, y, sample_weight)
        if groups is not None:
            groups = labels(groups, len(X))
        # Listed splits are used as given, even if equal rows fall into different splits.
        if isinstance(self.cv, (Iterable, PredefinedSplit)):
            apart = np.arange(len(X))
        else:
            apart = groups
        first, sample_weight, place = distinct_rows(X, y, sample_weight, apart)
        X = X[first]
        y = y[first]
        if groups is not None:
            groups = groups[first]
        if len(y) < 2:
            raise ValueError(
                f"`X` must have at least 2 different rows of positive weight, so that one can be "
                f"held out, got n_samples={len(y)}; use ELMRegressor, which holds out no rows."
            )
        weights = np.ones(len(X)) if sample_weight is None else sample_weight
        splits = _splits(self.cv, groups, len(X), place)
        task = _Task(
            X, y.reshape(len(y), -1), sample_weight, weights, splits, self.alphas
        )
        seed = self.random_state
        if not isinstance(seed, Integral):
            seed = int(check_random_state(seed).randint(2**31))
        shared = {name: vars(self)[name] for name in _SHARED} | {"random_state": seed}
        sizes = _positive(self.n_hidden, "n_hidden", integer=True)
        scales = _positive(self.weight_scales, "weight_scales")
        untouched = np.ones(X.shape[1])
        tried = []
        for size, scale in product(sizes, scales):
            params = {**shared, "n_hidden": int(size), "weight_scale": float(scale)}
            tried.append(_candidate(params, untouched, task))
        best = min(tried, key=lambda candidate: candidate.score)
        for _ in range(self.relevance_rounds):
            relevance, bounds = _relevance(best, task)
            before = best
            for zoom in _ZOOM:
                scale = zoom * before.params["weight_scale"]
                params = {
                    **before.params,
                    "weight_scale": scale,
                    "input_scaling": bounds,
                }
                tried.append(_candidate(params, relevance, task))
            best = min(
                best, *tried[-len(_ZOOM) :], key=lambda candidate: candidate.score
            )
            if best is before:
                break
        while 2 * best.params["n_hidden"] <= self.max_hidden:
            params = {**best.params, "n_hidden": 2 * best.params["n_hidden"]}
            tried.append(_candidate(params, best.relevance, task))
            if not tried[-1].score < _WORTH_GROWING * best.score:
                break
            best = tried[-1]
        self.alpha_ = best.params["alpha"]
        self.best_params_ = best.params
        self.best_score_ = -best.score
        chosen = ELMRegressor(**best.params).fit(X, y, sample_weight)
        self.best_estimator_ = chosen
        self.module_ = chosen.module_
        self.noise_variance_ = chosen.noise_variance_
        self._y_ndim = y.ndim
        self.left_out_errors_ = at_place(
            _left_out_errors(best, task).reshape(y.shape), place
        )
        names = (
            "n_hidden",
            "weight_scale",
            "relevance",
            "alphas",
            "mean_squared_error",
        )
        rows = [{**candidate.params, **candidate._asdict()} for candidate in tried]
        self.cv_results_ = {
            name: np.array([row[name] for row in rows]) for name in names
        }
        return self

    def stored(self):
        """Return the description of the chosen ELMRegressor."""
        check_is_fitted(self, "module_")
        chosen = self.best_estimator_.stored()
        chosen.settings["feature_names_in"] = plain(
            vars(self).get("feature_names_in_", [])
        )
        return chosen


class _Task(NamedTuple):
    """The different rows, and which of them are held out together (None: each alone)."""

    X: np.ndarray
    targets: np.ndarray  # with two dimensions
    sample_weight: np.ndarray | None
    weights: np.ndarray  # the same, or ones
    splits: list | None
    alphas: Any


class _Candidate(NamedTuple):
    """A hidden layer, its errors for every penalty, and the parameters with the best penalty."""

    params: dict
    relevance: np.ndarray
    alphas: np.ndarray
    mean_squared_error: np.ndarray  # (n_alphas,)
    score: float
    left_out: LeftOut


@np.errstate(all="ignore")  # errors that overflow are never the smallest
def _candidate(params, relevance, task):
    X, targets, sample_weight, weights, splits, alphas = task
    candidate = ELMRegressor(**params)
    elm = draw_layer(candidate, X, sample_weight).to(device_named(candidate.device))
    stats = gather(None, elm, X, targets, sample_weight, candidate.block_size)
    left_out = LeftOut(elm, stats, X, targets, weights, candidate.fit_intercept)
    largest = left_out.eigenvalues[-1] or 1.0
    if isinstance(alphas, str):
        alphas = _AUTO_ALPHAS * largest
    else:
        alphas = _positive(alphas, "alphas")
    total = np.zeros((len(alphas), targets.shape[1]))
    weight = 0.0
    for rows, errors in _errors(left_out, splits, alphas):
        total += np.einsum("r, lrm -> lm", weights[rows], errors * errors)
        weight += weights[rows].sum()
    mse = np.where(np.isfinite(total), total / weight, np.inf).mean(axis=1)
    params = {**params, "alpha": float(alphas[mse.argmin()])}
    return _Candidate(params, relevance, alphas, mse, float(mse.min()), left_out)


def _errors(left_out, splits, alphas):
    """Yield held-out rows and their errors (n_alphas, n_rows, n_outputs)."""
    if splits is None:
        return left_out.alone(alphas)
    return left_out.together(splits, alphas)


def _left_out_errors(best, task):
    total = np.zeros(task.targets.shape)
    count = np.zeros((len(task.X), 1))
    alpha = np.array([best.params["alpha"]])
    for rows, errors in _errors(best.left_out, task.splits, alpha):
        total[rows] += errors[0]
        count[rows] += 1
    return total / np.where(count > 0, count, np.nan)


def _relevance(best, task):
    """Return how much the derivative along each input varies (at most 1), and matching bounds.

    The derivative refers to inputs in their initial scaling.
    """
    model = ELMRegressor(**best.params).fit(task.X, task.targets, task.sample_weight)
    center, scale = (
        model.module_.get_buffer(name).numpy(force=True)
        for name in ("input_center", "input_scale")
    )
    scale = scale * best.relevance
    total = 0.0
    squares = 0.0
    weight = 0.0
    for batch in gen_batches(len(task.X), _ROWS_OF_JACOBIANS):
        J = model.jacobian(task.X[batch]) * scale
        w = task.weights[batch]
        total = total + np.tensordot(w, J, 1)
        squares = squares + np.tensordot(w, J * J, 1)
        weight = weight + w.sum()
    spread = np.sqrt(
        np.maximum(squares / weight - (total / weight) ** 2, 0.0).sum(axis=0)
    )
    relevance = np.maximum(spread / (spread.max() or 1.0), _LEAST_RELEVANCE)
    half = scale / relevance
    return relevance, np.array([center - half, center + half])


def _splits(cv, groups, n_rows, place):
    """Return (rows out, rows asked) of every split of the different rows.

    Splits listed by the user refer to all rows; `place` maps them to the different rows. An
    integer or a splitter gets only the different rows.
    """
    if groups is None and cv is None:
        return None
    if groups is not None and cv is None:
        cv = LeaveOneGroupOut()
    elif groups is not None and isinstance(cv, Integral):
        cv = GroupKFold(int(cv))
    if not isinstance(cv, (Iterable, PredefinedSplit)):
        place = np.arange(n_rows)
    splits = []
    rows = np.arange(len(place))
    splitter: Any = check_cv(cv)  # pyright: ignore[reportArgumentType]
    with TURNS.filters:
        all_splits = [*splitter.split(rows, rows, groups)]
    for train, test in all_splits:
        if np.isin(rows[test], rows[train]).any():
            raise ValueError(
                "`cv` must not test on rows that it trains on, but one of its splits does; use a "
                "splitter of sklearn.model_selection."
            )
        out = np.ones(n_rows + 1, dtype=bool)
        tested = np.zeros(n_rows + 1, dtype=bool)
        # The last: rows of weight 0.
        out[place[train]], tested[place[test]] = (
            False,
            True,
        )
        splits.append(
            (np.flatnonzero((out | tested)[:-1]), np.flatnonzero(tested[:-1]))
        )
    return [split for split in splits if len(split[1])]


def _positive(values, name, integer=False):
    array = np.atleast_1d(np.asarray(values))
    kind = np.integer if integer else np.number
    fits = array.ndim == 1 and array.size and np.issubdtype(array.dtype, kind)
    if not fits or not (np.isfinite(array) & (array > 1.0 / LARGEST)).all():
        if integer:
            need = "positive integers"
        else:
            need = f"positive numbers, over {1.0 / LARGEST:g}"
        raise ValueError(f"`{name}` must be one or more {need}, got {values!r}.")
    return array
