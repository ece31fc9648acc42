"""Parameters and columns of scikit-learn estimators, as models store them."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
from sklearn.base import BaseEstimator

from hybridkin._core.stored import Stored, plain

_Estimator = TypeVar("_Estimator", bound=BaseEstimator)


def params_of(estimator: BaseEstimator) -> dict[str, Any]:
    """Return the parameters of an estimator as JSON values.

    The device, and a random state that is not a number, become None.
    """
    params = plain(estimator.get_params(deep=False))
    for name in {"device", "random_state"} & {*params}:
        if type(params[name]) is not int:
            params[name] = None
    return params


def estimator_of(cls: type[_Estimator], params: dict[str, Any]) -> _Estimator:
    """Return an estimator with the given parameters; unknown ones are ignored."""
    defaults = cls().get_params(deep=False)
    settings = {}
    for name, value in params.items():
        if name not in defaults:
            continue
        if isinstance(defaults[name], tuple) and type(value) is list:
            value = tuple(value)
        settings[name] = value
    return cls(**settings)


def restore_columns(estimator: Any, stored: Stored, n: int) -> None:
    """Set the number of columns, and their names if there are any, as scikit-learn keeps them."""
    estimator.n_features_in_ = n
    names = stored.list_of(str, "feature_names_in")
    if names and len(names) != n:
        raise ValueError(f"`feature_names_in` must be {n} names, got {len(names)}")
    if names:
        estimator.feature_names_in_ = np.array(names, dtype=object)
