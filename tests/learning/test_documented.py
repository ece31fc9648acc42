"""What the docstrings of the regressors say of their defaults, and of names and ranges."""

import ast
import inspect
import re

import numpy as np
import pandas as pd
import pytest
import torch

from hybridkin import ELMRegressor, ELMRegressorCV
from hybridkin.learning.regressor_modules import KernelModule


@pytest.mark.parametrize("kind", [ELMRegressor, ELMRegressorCV])
def test_documented_defaults_are_those_of_the_signature(kind):
    stated = re.findall(r"(?m)^(\w+) : .*default=(.+)$", inspect.getdoc(kind))
    given = inspect.signature(kind).parameters
    assert len(stated) > 5
    for name, text in stated:
        assert given[name].default == ast.literal_eval(text)


def test_columns_without_names_warn_where_the_fit_had_names():
    rng = np.random.default_rng(0)
    X, y = rng.standard_normal((20, 2)), rng.standard_normal(20)
    model = ELMRegressor(5, random_state=0).fit(pd.DataFrame(X, columns=["a", "b"]), y)
    with pytest.warns(UserWarning, match="does not have valid feature names"):
        model.predict(X)


def test_a_gaussian_is_at_most_one():
    """At its own row too, where rounding of large inputs could give a negative squared distance."""
    rows = 1e3 * np.random.default_rng(0).standard_normal((500, 3))
    q, ones = torch.from_numpy(rows), np.ones(3)
    for k in range(20):
        weights = np.eye(500)[:, [k]]
        assert float(KernelModule(rows, weights, 0.0, 0.0 * ones, ones)(q).max()) <= 1.0
