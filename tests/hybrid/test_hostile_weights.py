"""Rows of weight 0 need no tip: no answer depends on what y holds there."""

import warnings

import numpy as np
import pytest
import torch

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    calibrate,
)
from hybridkin.calibration.choice import choose_geometry

CHAIN = ConstantCurvatureChain([0.05])
N = 40
WITHOUT = (np.nan, np.inf, -1e300, 0.0, 7.0)


def log(seed):
    """Return commands, tips, weights, and tips that hold anything where the weight is 0."""
    rng = np.random.default_rng(seed)
    wave = np.sin(np.arange(N)[:, None] / 3.0 + rng.uniform(0.0, 6.0, 3))
    q = 0.25 + 0.05 * wave
    moved = Hysteresis.backlash(0.01).apply(q)[0]
    x = CHAIN(torch.from_numpy(moved)).numpy() + 0.002 * np.sin(20.0 * q)
    weights = rng.integers(0, 3, N).astype(float)
    hostile = x.copy()
    absent = weights == 0.0
    hostile[absent] = rng.choice(WITHOUT, (absent.sum(), 3))
    return Commands(q, np.arange(N) // 20, np.arange(N)), x, weights, hostile


def answers(model, commands, x, weights):
    """Return what a fit, a score and an update give."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model.fit(commands, x, weights, np.arange(N) // 5)
        fitted = model.predict(commands), model.score(commands, x, weights)
        record = model._fit
        found = record.error.noise, record.training_range, record.fitted_rows
        model.partial_fit(commands, x, weights)
        return *fitted, *found, model.predict(commands), model.effective(commands)


KINDS = {
    "drop": {"error_model": "drop", "coverage": 0.5},
    "elm": {"error_model": ELMRegressor(10, random_state=0)},
    "linear": {"error_model": "linear", "coupling": "serial"},
    "data": {"mechanical_model": None, "error_model": ELMRegressorCV(10, max_hidden=0)},
}


@pytest.mark.parametrize("width", [0.0, 0.01])
@pytest.mark.parametrize("kind", KINDS)
def test_no_answer_depends_on_tips_of_weight_zero(kind, width):
    for seed in range(2):
        commands, x, weights, hostile = log(seed)
        options = {"mechanical_model": CHAIN, "random_state": 0, "hysteresis": width, **KINDS[kind]}
        usual = answers(HybridForwardModel(**options), commands, x, weights)
        found = answers(HybridForwardModel(**options), commands, hostile, weights)
        for one, other in zip(usual, found, strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.slow
def test_the_hysteresis_that_is_found_does_not_depend_on_them():
    commands, x, weights, hostile = log(5)
    model = HybridForwardModel(CHAIN, "drop", hysteresis="auto")
    usual = answers(model, commands, x, weights)
    for one, other in zip(usual, answers(model, commands, hostile, weights), strict=True):
        np.testing.assert_array_equal(one, other)


def test_networks_and_calibrations_do_not_depend_on_them():
    for seed in range(2):
        commands, x, weights, hostile = log(seed)
        q = commands.q
        for network in (ELMRegressor(10), ELMRegressorCV(10, (0.1,), (0.4,), max_hidden=0)):
            network.set_params(random_state=0)
            usual = network.fit(q, x, weights).predict(q)
            score = network.score(q, x, weights)
            np.testing.assert_array_equal(network.fit(q, hostile, weights).predict(q), usual)
            assert network.score(q, hostile, weights) == score
        for seen in (hostile, torch.from_numpy(hostile)):
            usual = calibrate(CHAIN, q, x, ("radii",), sample_weight=weights).values["radii"]
            found = calibrate(CHAIN, q, seen, ("radii",), sample_weight=weights)
            np.testing.assert_array_equal(found.values["radii"], usual)
        names = [
            choose_geometry(CHAIN, q, tips, weights=weights, parameters=("radii",)).name
            for tips in (x, hostile)
        ]
        assert names[0] == names[1]


def test_a_row_without_a_tip_moves_the_actuators_alone():
    """One command after the other, as in a loop; in some periods the camera sees nothing."""
    commands, x, weights, hostile = log(0)
    model = HybridForwardModel(CHAIN, "linear", hysteresis=0.01)
    model.fit(commands, x)
    at_once = model.predict(commands)
    model.partial_fit(commands, hostile, weights)
    at_once = model.predict(commands)
    model.fit(commands, x)
    for k, row in enumerate(commands):
        model.partial_fit(row, hostile[k : k + 1], weights[k : k + 1])
    np.testing.assert_allclose(model.predict(commands), at_once, rtol=0, atol=1e-9)


def test_the_advice_is_true():
    commands, x, _, _ = log(0)
    x[7, 1] = np.nan
    with pytest.raises(ValueError, match=r"first: row 7\); give these rows the weight 0"):
        HybridForwardModel(CHAIN, "drop", hysteresis=0.01).fit(commands, x)
    weights = np.ones(N)
    weights[7] = 0.0
    HybridForwardModel(CHAIN, "drop", hysteresis=0.01).fit(commands, x, weights)
    with pytest.raises(ValueError, match="leave these rows out"):
        HybridForwardModel(CHAIN, "drop").fit(commands, x)
    with pytest.raises(ValueError, match="`X` must be finite"):
        HybridForwardModel(CHAIN, "drop").fit(np.where(commands.q > 0.29, np.nan, 0.2), x, weights)
