"""Rows whose unit is wrong, that were scaled, or that are not finite."""

import warnings

import numpy as np
import pytest
import torch
from sklearn.compose import TransformedTargetRegressor
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, StandardScaler

from hybridkin import ConstantCurvatureChain, HybridForwardModel, datasets, robots

TENDONS = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1])


@pytest.fixture(params=["tendons", "chambers"])
def rows(request):
    """A chain, and rows of a robot like it."""
    if request.param == "chambers":
        data = datasets.load_trunk()
        return robots.bionic_handling_assistant(), data.q[:100], data.x[:100]
    q = 0.003 * np.random.default_rng(0).standard_normal((100, 2, 3))
    q = (q - q.mean(axis=2, keepdims=True)).reshape(100, 6)
    return TENDONS, q, TENDONS(torch.from_numpy(q)).numpy() + 1e-4


@pytest.mark.parametrize("scaler", [StandardScaler(), MinMaxScaler()])
@pytest.mark.parametrize("calibrate", [(), "default"])
def test_a_scaler_before_the_hybrid_is_refused(rows, scaler, calibrate):
    chain, q, x = rows
    model = HybridForwardModel(chain, "linear", calibrate=calibrate)
    with pytest.raises(ValueError, match=rf"`X` must hold .* output of {type(scaler).__name__}"):
        make_pipeline(scaler, model).fit(q, x)
    with pytest.raises(ValueError, match=r"`y` must hold tip positions.* out of the pipeline"):
        TransformedTargetRegressor(model, transformer=StandardScaler()).fit(q, x)


@pytest.mark.parametrize("name", ["X", "y"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_rows_that_are_not_finite_have_a_way_out(rows, name, bad):
    chain, q, x = rows
    given = {"X": q.copy(), "y": x.copy()}
    given[name][[3, 8], 1] = bad
    model = HybridForwardModel(chain, "linear")
    with pytest.raises(ValueError, match=rf"`{name}` .* in 2 of 100 rows \(first: row 3\)") as info:
        model.fit(**given)
    assert "drop_invalid=True" in str(info.value)
    kept = np.isfinite(np.hstack([given["X"], given["y"]])).all(axis=1)
    fitted = model.fit(given["X"][kept], given["y"][kept])
    with pytest.raises(ValueError, match=rf"`{name}` must be finite"):
        fitted.partial_fit(**given)


@pytest.mark.parametrize("calibrate", [(), ("base",)])
@pytest.mark.parametrize("factor", [100.0, 1000.0])
def test_small_motions_in_another_unit_are_noticed(factor, calibrate):
    q = 0.0005 * np.array([[1, -0.5, -0.5, 0, 0, 0], [-0.5, 1, -0.5, 0.5, -0.5, 0]]) @ np.eye(6)
    q = np.linspace(-1, 1, 20)[:, None] * q[0] + np.linspace(0, 1, 20)[:, None] ** 2 * q[1]
    x = TENDONS(torch.from_numpy(q)).numpy()
    assert np.ptp(x, axis=0).max() < 0.1 * TENDONS.reach
    model = HybridForwardModel(TENDONS, "drop", calibrate=calibrate)
    model.fit(q, x)
    with pytest.warns(UserWarning, match="hybridkin works in metres"):
        model.fit(q, factor * x)


def test_predictions_at_millimetres_and_updates_by_millimetres_warn(rows):
    chain, q, x = rows
    model = HybridForwardModel(chain, "linear").fit(q, x)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.predict(q)
        model.partial_fit(q[:3], x[:3] + 0.01)
    with pytest.warns(UserWarning, match=r"`X` reaches .* looks like millimetres"):
        model.predict(1000 * q)
    with pytest.warns(UserWarning, match=r"`y` spans .* works in metres"):
        model.partial_fit(q[:1], 1000 * x[:1])
