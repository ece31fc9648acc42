"""Checks of the rows of an ELM, and its random hidden layer."""

import math

import numpy as np
import torch
from sklearn.utils import check_random_state
from sklearn.utils.validation import _check_sample_weight, validate_data

from hybridkin._core.arrays import real_array, table
from hybridkin._core.distinct import targets_that_count
from hybridkin._core.finite_rows import check_entries
from hybridkin.learning.network import ELM

DTYPES = (np.float64, np.float32)
_FEW = 64  # numbers that Python adds in less time than NumPy


def scaling(X, sample_weight, input_scaling):
    """Return center and scale (d,) that map the columns of `X` to about [-1, 1]."""
    n_inputs = X.shape[1]
    eps = np.finfo(X.dtype).eps
    if input_scaling is None:
        return np.zeros(n_inputs), np.ones(n_inputs)
    if isinstance(input_scaling, str):
        bounds = np.array([X.min(axis=0), X.max(axis=0)], dtype=np.float64)
    else:
        bounds = real_array(input_scaling, "input_scaling").astype(np.float64)
    shaped = bounds.shape == (2, n_inputs) and np.isfinite(bounds).all()
    if not shaped or (bounds[0] > bounds[1]).any():
        raise ValueError(
            f"`input_scaling` given as bounds must be a finite array [low, high] of shape "
            f"(2, {n_inputs}) with low <= high, got {bounds.tolist()} of shape {bounds.shape}; "
            f'give the limits of each column of `X`, or use "minmax".'
        )
    low, high = bounds / 2  # halved first: the widest range must not overflow
    center = low + high
    scale = high - low
    # Do not divide by the range of a column that is constant up to rounding.
    constant = scale <= 4 * eps * np.abs(center)
    scale = np.where(constant, 1.0, scale)
    if isinstance(input_scaling, str) and input_scaling == "standard":
        u = (X - center) / scale
        mean = np.average(u, axis=0, weights=sample_weight)
        std = np.sqrt(np.average((u - mean) ** 2, axis=0, weights=sample_weight))
        center = center + mean * scale
        scale = scale * np.where(constant, 1.0, std)
    return center, scale


def check_rows(estimator, X, y, sample_weight, reset=True):
    """Return the rows, `y` in float64, and their weights; `y` of rows of weight 0 is ignored.

    Further rows of a fitted estimator (not `reset`) may all have the weight 0.
    """
    y = targets_that_count(y, sample_weight, "y")
    X, y, sample_weight = map(table, (X, y, sample_weight), ("X", "y", "sample_weight"))
    good = _is_finite(y, 1) or _is_finite(y, 2)
    checks = {"multi_output": True, "y_numeric": True}
    X, y = _validated(estimator, X, y, good=good, reset=reset, **checks)
    y = y.astype(np.float64, copy=False)
    if sample_weight is None:
        return X, y, np.ones(len(X))
    weights = np.asarray(sample_weight, dtype=np.float64)
    good = _is_finite(weights, 1) and len(weights) == len(X)
    if not good or weights.min() < 0.0 or (reset and not weights.any()):
        weights = _check_sample_weight(sample_weight, X, dtype=np.float64, ensure_non_negative=True)
    return X, y, weights


def check_inputs(estimator, X):
    """Return rows of new inputs for a fitted estimator, with the checks of scikit-learn.

    A plain array that meets all requirements passes a faster test.
    """
    if _is_finite(X, 2) and X.shape[1] == estimator.n_features_in_:
        if "feature_names_in_" not in vars(estimator):
            return np.ascontiguousarray(X)
    return _validated(estimator, table(X, "X"), reset=False)[0]


def _is_finite(a, ndim):
    """Return whether an object is a plain array of real, finite numbers."""
    if type(a) is not np.ndarray or a.ndim != ndim:
        return False
    if a.dtype not in DTYPES or not a.size:
        return False
    if a.size <= _FEW:
        return math.isfinite(sum(a.ravel().tolist()))
    with np.errstate(all="ignore"):
        return bool(np.isfinite(a.sum()))


def _check_finite(X):
    """Raise if rows hold NaN or infinity; other faults are for the checks of scikit-learn."""
    if X is None:
        return
    rows = real_array(X, "X")
    if rows.ndim == 2 and rows.dtype.kind == "f":
        check_entries(np.isfinite(rows), "X")


def _validated(estimator, X, *y, good=True, **checks):
    """Return X and y, checked by scikit-learn.

    Its array checks change the warning filters of all threads, so they are skipped for arrays that
    are known to be valid.
    """
    if not _is_finite(X, 2):
        _check_finite(X)
    good = good and _is_finite(X, 2) and all(len(X) == len(a) for a in y)
    checks |= {"dtype": DTYPES, "order": "C", "skip_check_array": good}
    with np.errstate(invalid="ignore"):  # a sum of both infinities
        validated = validate_data(estimator, X, *y, **checks)
    if good:
        return [X, *y]
    return [*map(np.asarray, validated if y else [validated])]


def draw_layer(params, X, sample_weight):
    """Return the hidden layer for an estimator's parameters, with a readout of zeros."""
    rng = check_random_state(params.random_state)
    shape = (params.n_hidden, X.shape[1])
    W = rng.uniform(-params.weight_scale, params.weight_scale, shape)
    b = rng.uniform(-params.weight_scale, params.weight_scale, params.n_hidden)
    center, scale = scaling(X, sample_weight, params.input_scaling)
    n_features = params.n_hidden + params.direct_link * X.shape[1]
    return ELM(
        params.activation,
        input_weights=W,
        input_bias=b,
        input_center=center,
        input_scale=scale,
        output_weights=np.zeros((n_features, 0)),
        intercept=np.zeros(0),
        leverage_center=np.zeros(n_features),
        leverage_factor=np.zeros((n_features, 0)),
        leverage_offset=np.zeros(()),
    )


def device_named(name):
    """Return the torch device of a name (None: the CPU); raise if it lacks float64."""
    try:
        device = torch.device("cpu" if name is None else name)
        torch.zeros(1, dtype=torch.float64, device=device).item()
    except (RuntimeError, AssertionError, TypeError, ValueError) as error:
        raise RuntimeError(
            f"`device` must name a device on which torch can compute in float64, got "
            f"{str(name)!r}; use device=None for the CPU."
        ) from error
    return device
