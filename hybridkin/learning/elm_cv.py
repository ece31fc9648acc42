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

from hybridkin._core.arrays import LARGEST
from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin._core.groups import Groups
from hybridkin._core.stored import plain
from hybridkin._core.turns import TURNS
from hybridkin.learning._left_out import LeftOut, left_out
from hybridkin.learning._ridge import Statistics, gather
from hybridkin.learning.elm import ELMRegressor, FittedNetwork
from hybridkin.learning.hidden_layer import (
    check_rows,
    device_named,
    draw_layer,
    scaling,
)

# Times the largest eigenvalue of the features' Gram matrix.
_AUTO_ALPHAS = np.logspace(-11, 2, 40)
_ZOOM = (0.5, 1.0, 2.0, 4.0)  # times the best weight scale, with new input scales
_WORTH_GROWING = 0.96  # of the mean squared error: 2 % of the error
_LEAST_RELEVANCE = 0.01
_NEVER = 1e30  # range of an input that never moved: nothing is learned of it
_ROWS_OF_JACOBIANS = 10_000
_SHARED = ("activation", "input_scaling", "fit_intercept", "direct_link")
_SHARED += ("block_size", "device")


class ELMRegressorCV(FittedNetwork):
    """Extreme learning machine with cross-validated penalty, weight scale, size and input scales.

    Every choice minimises the mean squared error on held-out rows, each row alone or by groups.
    These errors are exact for the given hidden layer and input scales. One factorisation gives
    them for the whole grid of penalties, without refits. Inputs that never moved in the training
    rows have no effect on predictions.

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
        **{name: ELMRegressor._parameter_constraints[name] for name in (*_SHARED, "random_state")},
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
        motions = Groups.of(groups, len(X))
        apart = motions.apart
        # Listed splits are used as given, even if equal rows fall into different splits.
        if _is_listed(self.cv):
            apart = np.arange(len(X))[:, None]
        first, sample_weight, place = distinct_rows(X, y, sample_weight, apart)
        X = X[first]
        y = y[first]
        motions = motions.take(first)
        if len(y) < 2:
            raise ValueError(
                f"`X` must have at least 2 different rows of positive weight, so that one can be "
                f"held out, got n_samples={len(y)}; use ELMRegressor, which holds out no rows."
            )
        splits = _splits(self.cv, motions, place)
        targets = y.reshape(len(y), -1)
        search = _Search(X, targets, sample_weight, splits, self.alphas)
        self._try_sizes_and_scales(search)
        for _ in range(self.relevance_rounds):
            if not _rescale_inputs(search):
                break
        best = _grown(search, self.max_hidden)
        self.alpha_ = best.params["alpha"]
        self.best_params_ = best.params
        self.best_score_ = -best.score
        # Without a warning: the caller does not choose the penalty.
        best_estimator = ELMRegressor(**best.params)
        self.best_estimator_ = best_estimator._learn(X, y, sample_weight, first=True)
        self.module_ = self.best_estimator_.module_
        self.noise_variance_ = self.best_estimator_.noise_variance_
        self._y_ndim = y.ndim
        errors = search.held_out_errors(best).reshape(y.shape)
        self.left_out_errors_ = at_place(errors, place)
        self.cv_results_ = search.results()
        return self

    def _try_sizes_and_scales(self, search):
        seed = self.random_state
        if not isinstance(seed, Integral):
            seed = int(check_random_state(seed).randint(2**31))
        params = {name: vars(self)[name] for name in _SHARED}
        params["random_state"] = seed
        if search.still.any():
            params["input_scaling"] = search.bounds(self.input_scaling)
        sizes = _positive(self.n_hidden, "n_hidden", integer=True)
        scales = _positive(self.weight_scales, "weight_scales")
        for size, scale in product(sizes, scales):
            params["n_hidden"] = int(size)
            params["weight_scale"] = float(scale)
            search.add(params, np.ones(search.X.shape[1]))

    def stored(self):
        """Return the description of the chosen ELMRegressor."""
        check_is_fitted(self, "module_")
        chosen = self.best_estimator_.stored()
        chosen.settings["feature_names_in"] = plain(vars(self).get("feature_names_in_", []))
        return chosen


def growing_network(random_state=None):
    """Return the network of comparisons: 250 to 1000 neurons, input scales in three rounds."""
    return ELMRegressorCV(
        250,
        weight_scales=(0.1, 0.4, 1.6),
        relevance_rounds=3,
        max_hidden=1000,
        random_state=random_state,
    )


class _Candidate(NamedTuple):
    """A hidden layer, its errors for every penalty, and the parameters with the best penalty."""

    params: dict
    relevance: np.ndarray
    alphas: np.ndarray
    mean_squared_error: np.ndarray  # (n_alphas,)
    score: float
    left_out: LeftOut


class _Search:
    """The candidates tried, on different rows.

    Parameters
    ----------
    X, targets : ndarray of shape (n, d) and (n, m)
        The rows.
    weights : ndarray of shape (n,)
        Their weights.
    splits : list
        Which rows are held out together, see `LeftOut.together`. Empty: each alone.
    alphas : "auto" or array-like
        Penalties.
    """

    def __init__(self, X, targets, weights, splits, alphas):
        self.X = X
        self.targets = targets
        self.weights = weights
        self.splits = splits
        self.alphas = alphas
        low = X.min(axis=0)
        high = X.max(axis=0)
        largest = np.maximum(np.abs(low), np.abs(high))
        self.still = high - low <= 4.0 * np.finfo(X.dtype).eps * largest
        self.tried: list[_Candidate] = []

    def bounds(self, input_scaling):
        """Return the bounds of an input scaling, far apart for inputs that never moved.

        Random weights would else give the network an arbitrary slope along these inputs.
        """
        center, scale = scaling(self.X, self.weights, input_scaling)
        scale[self.still] = _NEVER
        return np.array([center - scale, center + scale])

    @property
    def best(self):
        """The first candidate with the smallest error."""
        return min(self.tried, key=lambda candidate: candidate.score)

    @np.errstate(all="ignore")  # errors that overflow are never the smallest
    def add(self, params, relevance):
        """Try a hidden layer with all penalties."""
        candidate = ELMRegressor(**params)
        elm = draw_layer(candidate, self.X, self.weights)
        elm = elm.to(device_named(candidate.device))
        rows = self.X, self.targets, self.weights
        none = Statistics.none(len(elm.output_weights) + self.targets.shape[1])
        stats = gather(none, elm, *rows, candidate.block_size)
        held_out = left_out(elm, stats, *rows, candidate.fit_intercept)
        if isinstance(self.alphas, str):
            alphas = _AUTO_ALPHAS * (held_out.eigenvalues[-1] or 1.0)
        else:
            alphas = _positive(self.alphas, "alphas")
        total = np.zeros((len(alphas), self.targets.shape[1]))
        weight = 0.0
        for rows_out, errors in self._errors(held_out, alphas):
            w = self.weights[rows_out]
            total += np.einsum("r, lrm -> lm", w, errors * errors)
            weight += w.sum()
        mse = np.where(np.isfinite(total), total / weight, np.inf).mean(axis=1)
        params = {**params, "alpha": float(alphas[mse.argmin()])}
        score = float(mse.min())
        self.tried.append(_Candidate(params, relevance, alphas, mse, score, held_out))

    def _errors(self, held_out, alphas):
        """Yield held-out rows and their errors (n_alphas, n_rows, n_outputs)."""
        if self.splits:
            return held_out.together(self.splits, alphas)
        return held_out.alone(alphas)

    def held_out_errors(self, candidate):
        """Return target minus prediction of every row, held out; a mean over splits, or NaN."""
        total = np.zeros(self.targets.shape)
        count = np.zeros((len(self.X), 1))
        alpha = np.array([candidate.params["alpha"]])
        for rows, errors in self._errors(candidate.left_out, alpha):
            total[rows] += errors[0]
            count[rows] += 1
        return total / np.where(count > 0, count, np.nan)

    def results(self):
        """Return what was tried, as `ELMRegressorCV.cv_results_`."""
        tried = self.tried
        sizes = [candidate.params["n_hidden"] for candidate in tried]
        scales = [candidate.params["weight_scale"] for candidate in tried]
        errors = [candidate.mean_squared_error for candidate in tried]
        return {
            "n_hidden": np.array(sizes),
            "weight_scale": np.array(scales),
            "relevance": np.array([candidate.relevance for candidate in tried]),
            "alphas": np.array([candidate.alphas for candidate in tried]),
            "mean_squared_error": np.array(errors),
        }


def _rescale_inputs(search):
    """Try input scales that follow the relevance of the inputs, and return whether it helped."""
    before = search.best
    relevance, bounds = _relevance(before, search)
    for zoom in _ZOOM:
        params = dict(before.params)
        params["weight_scale"] = zoom * before.params["weight_scale"]
        params["input_scaling"] = bounds
        search.add(params, relevance)
    return search.best is not before


def _grown(search, max_hidden):
    """Return the best candidate, with as many doublings of its neurons as are worth it."""
    best = search.best
    while 2 * best.params["n_hidden"] <= max_hidden:
        params = {**best.params, "n_hidden": 2 * best.params["n_hidden"]}
        search.add(params, best.relevance)
        if not search.tried[-1].score < _WORTH_GROWING * best.score:
            break
        best = search.tried[-1]
    return best


def _relevance(best, search):
    """Return how much the derivative along each input varies (at most 1), and matching bounds.

    The derivative refers to inputs in their initial scaling.
    """
    model = ELMRegressor(**best.params)
    model.fit(search.X, search.targets, search.weights)
    center = model.module_.input_center.numpy(force=True)
    scale = model.module_.input_scale.numpy(force=True) * best.relevance
    total = 0.0
    squares = 0.0
    for batch in gen_batches(len(search.X), _ROWS_OF_JACOBIANS):
        J = model.jacobian(search.X[batch]) * scale
        weights = search.weights[batch]
        total = total + np.tensordot(weights, J, 1)
        squares = squares + np.tensordot(weights, J * J, 1)
    weight = search.weights.sum()
    variance = squares / weight - (total / weight) ** 2
    spread = np.sqrt(np.maximum(variance, 0.0).sum(axis=0))
    spread[search.still] = 0.0
    relevance = np.maximum(spread / (spread.max() or 1.0), _LEAST_RELEVANCE)
    half = scale / relevance
    return relevance, np.array([center - half, center + half])


def _is_listed(cv):
    """Return whether `cv` names the rows of every split."""
    return isinstance(cv, (Iterable, PredefinedSplit))


def _splits(cv, motions, place):
    """Return (rows out, rows asked) of every split of the different rows; none: each row alone.

    Splits listed by the user refer to all rows; `place` maps them to the different rows. An
    integer or a splitter gets only the different rows.
    """
    if cv is None and not motions.whole:
        return []
    n_rows = len(motions)
    groups = motions.labels if motions.whole else None
    if cv is None:
        cv = LeaveOneGroupOut()
    elif motions.whole and isinstance(cv, Integral):
        cv = GroupKFold(int(cv))
    if not _is_listed(cv):
        place = np.arange(n_rows)
    rows = np.arange(len(place))
    splitter: Any = check_cv(cv)  # pyright: ignore[reportArgumentType]
    with TURNS.filters:
        all_splits = [*splitter.split(rows, rows, groups)]
    splits = []
    for train, test in all_splits:
        if np.isin(rows[test], rows[train]).any():
            raise ValueError(
                "`cv` must not test on rows that it trains on, but one of its splits does; use a "
                "splitter of sklearn.model_selection."
            )
        # The place after the last row is that of all rows of weight 0.
        trained = np.zeros(n_rows + 1, dtype=bool)
        tested = np.zeros(n_rows + 1, dtype=bool)
        trained[place[train]] = True
        tested[place[test]] = True
        out = ~trained | tested
        held_out = np.flatnonzero(out[:-1])
        asked = np.flatnonzero(tested[:-1])
        if len(asked):
            splits.append((held_out, asked))
    return splits


def _positive(values, name, integer=False):
    array = np.atleast_1d(np.asarray(values))
    kind = np.number
    need = f"positive numbers, over {1.0 / LARGEST:g}"
    if integer:
        kind = np.integer
        need = "positive integers"
    fits = array.ndim == 1 and array.size and np.issubdtype(array.dtype, kind)
    if not fits or not (np.isfinite(array) & (array > 1.0 / LARGEST)).all():
        raise ValueError(f"`{name}` must be one or more {need}, got {values!r}.")
    return array
