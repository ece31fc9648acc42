"""Models with every kind of hysteresis, fitted to every kind of rows, load as they were saved."""

import itertools

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from saved_models import trunk, trunk_log

from hybridkin import Commands, HybridForwardModel, Hysteresis, load_model, save_model

WIDTHS = [0.0, 0.01, 0.02]
SLOPES = np.array([[0.2, 0.3, 0.4], [0.7, 0.8, 1.1]])
GAINS = np.array([[0.1, 0.2, 0.3], [0.2, 0.1, 0.0]])
NONE = Hysteresis()
FRICTION = {
    "none": NONE,
    "backlash": Hysteresis.backlash(0.02),
    "backlash of each": Hysteresis.backlash([0.01, 0.02, 0.0]),
    "smooth": Hysteresis.friction(WIDTHS, SLOPES[:, 0]),
    "smooth of each": Hysteresis.friction(WIDTHS, SLOPES),
}
CREEP = {
    "none": NONE,
    "creep": Hysteresis.creep(GAINS[:, 0], [2.0, 30.0]),
    "creep of each": Hysteresis.creep(GAINS, [2.0, 30.0]),
}
Q, X, GROUPS = trunk_log(32)
TIME = 0.5 * np.arange(len(Q))
ROWS = {
    "rows": Q,
    "runs": Commands(Q, GROUPS),
    "times": Commands(Q, time=TIME),
    "runs and times": Commands(Q, GROUPS, TIME),
}


def all_kinds():
    """Return values of every kind, in both orders, by name."""
    found = {}
    for (name, friction), (other, creep) in itertools.product(FRICTION.items(), CREEP.items()):
        found[f"{name}, {other}"] = friction | creep
        found[f"{other}, {name}"] = creep | friction
    return found


KINDS = all_kinds()


def fitted(hysteresis, rows, groups=GROUPS, **settings):
    model = HybridForwardModel(trunk(), "linear", hysteresis=hysteresis, random_state=0, **settings)
    return model.fit(rows, X, groups=groups)


def loaded(model, folder):
    save_model(model, folder / "model.safetensors")
    twin = load_model(folder / "model.safetensors")
    assert twin.hysteresis_ == twin.hysteresis == model.hysteresis_
    return twin


@pytest.mark.slow
@pytest.mark.parametrize(("k", "name"), [*enumerate(KINDS)])
def test_every_hysteresis_of_a_fit_is_loaded(k, name, tmp_path):
    kinds = ["times", "runs and times"] if "creep" in name else [*ROWS]
    rows = ROWS[kinds[k % len(kinds)]]
    model = fitted(KINDS[name], rows, None if k % 3 else GROUPS)
    twin = loaded(model, tmp_path)
    assert_array_equal(twin.predict(rows), model.predict(rows))
    if model.hysteresis_:
        assert_array_equal(twin._fit.state_range, model._fit.state_range)
