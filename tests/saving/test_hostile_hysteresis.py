"""Models with every kind of hysteresis, fitted to every kind of rows, load as they were saved."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from saved_models import trunk, trunk_log

from hybridkin import (
    Commands,
    CreepOperator,
    HybridForwardModel,
    HysteresisSeries,
    PlayOperator,
    PrandtlIshlinskiiOperator,
    load_model,
    save_model,
)

WIDTHS = [0.0, 0.01, 0.02]
SLOPES = np.array([[0.2, 0.3, 0.4], [0.7, 0.8, 1.1]])
GAINS = np.array([[0.1, 0.2, 0.3], [0.2, 0.1, 0.0]])
FRICTION = {
    "none": None,
    "backlash": PlayOperator(0.02),
    "backlash of each": PlayOperator([0.01, 0.02, 0.0]),
    "smooth": PrandtlIshlinskiiOperator(WIDTHS, SLOPES[:, 0]),
    "smooth of each": PrandtlIshlinskiiOperator(WIDTHS, SLOPES),
}
CREEP = {
    "none": None,
    "creep": CreepOperator(GAINS[:, 0], [2.0, 30.0]),
    "creep of each": CreepOperator(GAINS, [2.0, 30.0]),
}
Q, X, GROUPS = trunk_log(32)
TIME = 0.5 * np.arange(len(Q))
ROWS = {
    "rows": Q,
    "runs": Commands(Q, GROUPS),
    "times": Commands(Q, time=TIME),
    "runs and times": Commands(Q, GROUPS, TIME),
}


def operators():
    """Return all operators that a file can hold, by name."""
    found = {}
    for (name, friction), (other, creep) in itertools.product(FRICTION.items(), CREEP.items()):
        parts = [part for part in (friction, creep) if part is not None]
        if parts:
            found[f"{name}, {other}"] = parts[0] if len(parts) == 1 else HysteresisSeries(parts)
    return found


OPERATORS = operators()


def fitted(operator, rows, groups=GROUPS, **settings):
    model = HybridForwardModel(trunk(), "linear", play=operator, random_state=0, **settings)
    return model.fit(rows, X, groups=groups)


def loaded(model, folder):
    save_model(model, folder / "model.safetensors")
    twin = load_model(folder / "model.safetensors")
    assert repr(twin.play_) == repr(model.play_)
    return twin


@pytest.mark.slow
@pytest.mark.parametrize(("k", "name"), [*enumerate(OPERATORS)])
def test_every_hysteresis_of_a_fit_is_loaded(k, name, tmp_path):
    kinds = ["times", "runs and times"] if "creep" in name else [*ROWS]
    rows = ROWS[kinds[k % len(kinds)]]
    model = fitted(OPERATORS[name], rows, None if k % 3 else GROUPS)
    twin = loaded(model, tmp_path)
    assert_array_equal(twin.predict(rows), model.predict(rows))
    assert_array_equal(twin._fit.state_range, model._fit.state_range)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("smooth, none", "none, none"),
        ("backlash, none", "smooth, creep"),
        ("none, creep", "smooth, none"),
    ],
)
def test_a_hysteresis_may_be_replaced_after_the_fit(before, after, tmp_path):
    """The log knows the states of the hysteresis of the fit alone."""
    rows = ROWS["runs and times"]
    model = fitted(OPERATORS[before], rows, coverage=0.8)
    model._fit = model._fit.with_play(OPERATORS.get(after))
    twin = loaded(model, tmp_path)
    for found, expected in zip(
        twin.predict(rows, return_radius=True),
        model.predict(rows, return_radius=True),
        strict=True,
    ):
        assert_array_equal(found, expected)
