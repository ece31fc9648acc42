"""Stages of any kind in any order: the value, its laws, and the core against NumPy."""

import copy
import pickle

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from operators import random_hysteresis

from hybridkin import ConstantCurvatureChain, Hysteresis
from hybridkin._core.stored import Stored
from hybridkin.hysteresis import follow

BACKLASH = Hysteresis.backlash([0.2, 0.1, 0.0])
FRICTION = Hysteresis.friction([0.0, 0.5, 2.0], [0.25, 0.5])
CREEP = Hysteresis.creep([[0.1, 0.3, 0.2], [0.2, 0.0, 0.1]], [2.0, 9.0])


def draw(seed, n=3, rows=60):
    """Return a random hysteresis, commands (rows, n) and the time before each."""
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.normal(size=(rows, n)), axis=0) * 0.2
    q[10:20:2] = q[11:21:2]  # rests
    return random_hysteresis(rng, n), q, rng.uniform(0.0, 3.0, rows)


def test_a_value_is_equal_to_its_copies_and_does_not_change():
    for hysteresis in (Hysteresis(), BACKLASH, FRICTION | CREEP, CREEP | BACKLASH | CREEP):
        for twin in (copy.deepcopy(hysteresis), pickle.loads(pickle.dumps(hysteresis))):
            assert twin == hysteresis
            assert hash(twin) == hash(hysteresis)
            assert eval(repr(twin)) == hysteresis
            with pytest.raises(AttributeError, match="cannot change"):
                twin.width = 1.0
            with pytest.raises(ValueError, match="read-only"):
                twin.width[...] = 1.0
    assert BACKLASH | CREEP != CREEP | BACKLASH
    assert BACKLASH != Hysteresis.backlash([0.2, 0.1, 0.1])
    assert BACKLASH != "backlash"
    with pytest.raises(TypeError, match="unsupported operand"):
        BACKLASH | 0.1


def test_the_empty_one_changes_nothing():
    none = Hysteresis()
    assert not none
    assert none == Hysteresis.backlash(0.0) == ConstantCurvatureChain([0.05]).hysteresis
    assert none | CREEP == CREEP == CREEP | none
    assert (none.kind, none.width, none.needs_time, len(none.time_constants)) == ("", 0, False, 0)
    q = np.random.default_rng(0).normal(size=(5, 3))
    for way in (none.apply, none.command):
        moved, state = way(q)
        assert_array_equal(moved, q)
        assert state.shape == (0, 3)
        assert_array_equal(way(q, state)[0], q)
    assert_array_equal(none.apply_by_group(q, [0, 1, 0, 1, 0]), q)
    assert none.inner_states(q, np.zeros(5)).shape == (5, 0, 3)


def test_stages_follow_each_other():
    _, q, _ = draw(0)
    first, end = CREEP.apply(q, dt=0.7)
    second, end_of_play = BACKLASH.apply(first)
    y, state = (CREEP | BACKLASH).apply(q, dt=0.7)
    assert_array_equal(y, second)
    assert_array_equal(state, np.concatenate([end, end_of_play[1:]]))
    assert_array_equal((CREEP | BACKLASH).width, BACKLASH.width)
    assert_allclose((FRICTION | CREEP | BACKLASH).width, FRICTION.width + BACKLASH.width)
    assert (CREEP | FRICTION).kind == "creep and friction"
    inner = (CREEP | FRICTION).inner_states(q, np.zeros(60), 0.7 * np.arange(60))
    assert inner.shape == (60, 5, 3)
    _, state = (CREEP | FRICTION).apply(q, dt=np.where(np.arange(60) > 0, 0.7, 0.0))
    assert_allclose(inner[-1], state[[1, 2, 4, 5, 6]], atol=1e-14)


@pytest.mark.parametrize("seed", range(40))
def test_commands_are_the_inverse_and_parts_are_the_whole(seed):
    hysteresis, y, dt = draw(seed)
    _, past = hysteresis.apply(y[::-1], dt=1.0)
    for before in (None, past):
        q, sent = hysteresis.command(y, before, dt)
        reached, state = hysteresis.apply(q, before, dt)
        assert_allclose(reached, y, rtol=0, atol=1e-11)
        assert_allclose(state, sent, rtol=0, atol=1e-10)
        first, middle = hysteresis.command(y[:25], before, dt[:25])
        second, _ = hysteresis.command(y[25:], middle, dt[25:])
        assert_array_equal(np.concatenate([first, second]), q)


@pytest.mark.needs_core
@pytest.mark.parametrize("seed", range(40))
def test_the_core_does_what_numpy_does(seed, monkeypatch):
    hysteresis, q, dt = draw(seed)
    found = hysteresis.apply(q, None, dt), hysteresis.command(q, None, dt)
    monkeypatch.setattr(follow, "available", lambda: False)
    expected = hysteresis.apply(q, None, dt), hysteresis.command(q, None, dt)
    for of_core, of_numpy in zip(found, expected, strict=True):
        assert_allclose(of_core[0], of_numpy[0], rtol=0, atol=1e-12)
        assert_allclose(of_core[1], of_numpy[1], rtol=0, atol=1e-12)


def test_descriptions_are_read_and_checked():
    hysteresis = CREEP | FRICTION | BACKLASH
    stored = hysteresis.stored()
    assert Hysteresis.from_stored(stored, 3) == hysteresis
    assert Hysteresis.from_stored(Hysteresis().stored(), 7) == Hysteresis()
    with pytest.raises(ValueError, match="of 3 actuators does not fit 4"):
        Hysteresis.from_stored(stored, 4)
    with pytest.raises(ValueError, match="unknown kind of hysteresis 'magic'"):
        Hysteresis.from_stored(Stored.of("hysteresis", parts={"0": Stored("magic")}), 3)
    del stored.parts["0"].arrays["times"]
    with pytest.raises(ValueError, match="'times' of 'creep' is missing"):
        Hysteresis.from_stored(stored, 3)
