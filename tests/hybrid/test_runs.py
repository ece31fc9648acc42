"""Runs and times: which rows follow each other, and when; names and clocks do not matter."""

import copy
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ELMRegressorCV,
    HybridForwardModel,
    Hysteresis,
    calibrate,
)
from hybridkin._core.groups import Groups
from hybridkin.hybrid import _hysteresis
from hybridkin.hybrid._error_models import NoCorrection
from hybridkin.hybrid._hysteresis import FoundHysteresis, choose_hysteresis
from hybridkin.hybrid._range import state_range
from hybridkin.hybrid._rows import Rows
from hybridkin.hybrid._spec import Spec
from hybridkin.hybrid.log_fit import Anew

CHAIN = ConstantCurvatureChain([0.05])
PLAY = Hysteresis.backlash(0.02)
FRICTION = Hysteresis.friction([0.0, 0.01, 0.02, 0.1], [0.5, 0.7, 0.8])
CREEP = Hysteresis.creep([0.15, 0.25], [3.0, 40.0])
SLIDE = PLAY | CREEP


def tips(y, noise=2e-4):
    x = CHAIN(torch.from_numpy(y)).numpy()
    return x + noise * np.random.default_rng(1).standard_normal(x.shape)


def motions(n=6, rows=20, seed=0):
    """Return commands of n motions, which begin and end at home, their runs and times."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 2.0 * np.pi, rows)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 3, 3)) @ waves).transpose(0, 2, 1).reshape(-1, 3)
    q[::rows] = q[rows - 1 :: rows] = 0.25
    return q, np.repeat(np.arange(n), rows), np.cumsum(rng.uniform(0.5, 4.0, n * rows))


@pytest.mark.parametrize("operator", [PLAY, FRICTION, CREEP, SLIDE])
def test_rows_that_are_merged_do_not_change_what_the_actuators_do(operator):
    """A run that begins where the last one ended begins anew; a rest takes its time."""
    q, runs, time = motions()
    keep = np.sort(np.append(np.arange(len(q)), [7, 7, 30, 45]))
    rests = np.isin(keep, [7, 45]).cumsum()  # some of the equal rows come minutes later
    log = Commands(q[keep], runs[keep], time[keep] + 60.0 * rests)
    x = tips(log.q, 0.0).round(3)
    weights = np.random.default_rng(2).integers(0, 3, len(keep)).astype(float)
    groups = log.runs // 2  # two runs each
    clock = log.time if operator.needs_time else None
    rows = Rows.of(log.q, x, weights, groups, log.runs, clock)
    merged = rows.in_runs()
    assert len(merged) == len(rows) - (1 if operator.needs_time else 4)
    assert_array_equal(merged.X[merged.place], rows.X)
    assert merged.counts.sum() == weights.sum()
    moved = merged.effective(operator).X[merged.place]
    assert_allclose(moved, rows.effective(operator).X, rtol=0, atol=1e-15)
    without_names = operator.apply_by_group(q, np.zeros(len(q)), time)
    with_names = operator.apply_by_group(q, runs, time)
    assert np.abs(without_names - with_names).max() > 1e-3


@pytest.mark.parametrize("error_model", ["linear", "kernel"])
def test_runs_and_times_have_no_effect_without_hysteresis(error_model):
    """Equal rows of two runs are then equal rows, which are held out together."""
    q, runs, _ = motions(4, 10)
    x = tips(q) + 0.02 * np.sin(20 * q)
    twice = np.concatenate([np.arange(40), np.arange(15)])
    names = np.append(runs, runs[:15] + 10)
    commands = Commands(q[twice], names, np.arange(55.0))
    models = []
    for X in (q[twice], commands):
        model = HybridForwardModel(CHAIN, error_model).fit(X, x[twice])
        models.append(model)
    assert_array_equal(models[1].predict(q), models[0].predict(q))
    assert models[1]._fit.error.noise == models[0]._fit.error.noise
    for X, model in zip((q[twice], commands), models, strict=True):
        model.partial_fit(X, x[twice] + 0.01)
    assert_array_equal(models[1].predict(commands), models[0].predict(q[twice]))
    for X, model in zip((q[twice], commands), models, strict=True):
        model.adapt(X, x[twice] + 0.01)
    assert_array_equal(models[1].predict(commands), models[0].predict(q[twice]))


def renamed(commands):
    """Return the same log by another clock, with other names, its motions by turns."""
    names = np.array([f"run {k}" for k in commands.runs])
    order = np.argsort(np.arange(len(names)) % 20, kind="stable")
    return Commands(commands.q, names, commands.time - 1000.0)[order], order


@pytest.mark.parametrize("operator", [PLAY, FRICTION, SLIDE])
def test_names_of_runs_and_the_start_of_the_clock_do_not_matter(operator):
    q, runs, time = motions()
    x = tips(operator.apply_by_group(q, runs, time)) + 0.02 * np.sin(20 * q)
    commands = Commands(q, runs, time)
    others, order = renamed(commands)
    one, other = (HybridForwardModel(CHAIN, "linear", hysteresis=operator) for _ in range(2))
    one.fit(commands, x, groups=runs)
    other.fit(others, x[order], groups=others.runs)
    new = Commands(*motions(6, 20, seed=3))
    new_renamed, new_order = renamed(new)

    def assert_equal_models():
        found = other.predict(new_renamed)
        assert_allclose(found, one.predict(new)[new_order], rtol=0, atol=1e-9)
        assert_array_equal(other.in_domain(new_renamed), one.in_domain(new)[new_order])
        assert_allclose(other.effective(new_renamed), one.effective(new)[new_order], atol=1e-15)

    assert_equal_models()
    moved = x + np.array([0.01, 0.0, -0.01])
    one.adapt(commands, moved, groups=runs)
    other.adapt(others, moved[order], groups=others.runs)
    assert_equal_models()
    one.partial_fit(commands, moved, decay=1.0)
    other.partial_fit(others, moved[order], decay=1.0)
    assert_equal_models()
    by_motion = one.predict(Commands(q, None, time), groups=runs)
    assert_array_equal(by_motion, one.predict(commands))
    as_one_run = one.predict(Commands(q, None, time))
    assert np.abs(as_one_run - one.predict(commands)).max() > 1e-3


def chosen(rows, calibrate=()):
    spec = Spec(CHAIN, NoCorrection(), calibrate, hysteresis=FoundHysteresis())
    return spec.hysteresis.of(spec, rows.in_runs())[0]


@pytest.mark.slow
def test_the_chosen_hysteresis_knows_no_names_and_no_clock():
    q, runs, time = motions()
    x = tips(SLIDE.apply_by_group(q, runs, time))
    found = chosen(Rows.of(q, x, None, runs, runs, time))
    others, order = renamed(Commands(q, runs, time))
    other = chosen(Rows.of(others.q, x[order], None, others.runs, others.runs, others.time))
    assert found.kind == other.kind == "backlash and creep"
    same = other.apply_by_group(q, runs, time)
    assert_allclose(same, found.apply_by_group(q, runs, time), rtol=0, atol=1e-6)


@pytest.mark.slow
def test_the_chosen_hysteresis_counts_rows_by_their_weights():
    """Half of the motions are those of a wider backlash; repetitions differ by a nanometre."""
    q, runs, _ = motions(8)
    wide = Hysteresis.backlash(0.03).apply_by_group(q, runs)
    narrow = Hysteresis.backlash(0.01).apply_by_group(q, runs)
    x = tips(np.where(runs[:, None] % 2, narrow, wide)) + np.array([0.0, 0.0, 0.01])
    weights = np.where(runs % 2, 1.0, 4.0)
    many = np.repeat(np.arange(len(q)), weights.astype(int))
    apart = x[many] + 1e-9 * np.random.default_rng(3).standard_normal((len(many), 3))
    weighed = chosen(Rows.of(q, x, weights, runs), ("base",))
    repeated = chosen(Rows.of(q[many], apart, None, runs[many]), ("base",))
    plain = chosen(Rows.of(q, x, None, runs), ("base",))
    moved = [operator.apply_by_group(q, runs) for operator in (weighed, repeated, plain)]
    assert np.abs(moved[0] - moved[1]).max() < 0.1 * np.abs(moved[0] - moved[2]).max()


@pytest.mark.slow
def test_what_is_held_out_has_no_say_in_the_hysteresis():
    """Neither rows of weight zero nor held-out ones; the actuators follow them all the same."""
    q, runs, _ = motions(4)
    log = Rows.of(q, tips(PLAY.apply_by_group(q, runs)), groups=runs)
    weights = np.where(np.arange(len(q)) % 5, 1.0, 0.0)
    measured = np.flatnonzero(weights)
    is_held_out = runs[measured] == 1
    train, test = np.flatnonzero(~is_held_out), np.flatnonzero(is_held_out)
    spec = Spec(CHAIN, NoCorrection(), hysteresis=FoundHysteresis())
    found = []
    for wrong in (0.0, 0.1):
        y = log.y.copy()
        y[weights == 0.0] += wrong
        y[measured[test]] -= wrong
        found.append(Anew(spec, replace(log, y=y, counts=weights)).held_out(train, test))
    assert_array_equal(found[1].tips, found[0].tips)
    moved = PLAY.apply_by_group(q, runs)[measured[test]]
    assert_allclose(found[0].tips[0], tips(moved), rtol=0, atol=1e-3)
    assert found[0].choice.hysteresis


@pytest.mark.parametrize("mechanical", [CHAIN, None])
def test_the_search_gets_the_rows_as_they_are(mechanical, monkeypatch):
    """Without a mechanical model, that of a network of the same rows, weights and motions."""
    monkeypatch.setattr(_hysteresis, "find_hysteresis", lambda log: log)
    q, runs, time = motions()
    groups = np.arange(len(q)) // 10
    weights = np.random.default_rng(0).integers(0, 4, len(q)).astype(float)
    x = tips(q)
    log = choose_hysteresis(
        Spec(mechanical, NoCorrection()), Rows.of(q, x, weights, groups, runs, time)
    )
    for found, given in (
        (log.q, q),
        (log.x, x),
        (log.counts, weights),
        (log.groups, groups),
        (log.runs, runs),
        (log.time, time),
    ):
        assert_array_equal(found, given)
    if mechanical is None:
        plain = {"relevance_rounds": 0, "max_hidden": 0, "random_state": 0}
        network = ELMRegressorCV(200, weight_scales=(0.4,), **plain)
        network.fit(q, x, weights, groups)
        predicted = log.model(torch.from_numpy(q)).numpy()
        assert_allclose(predicted, network.predict(q), rtol=0, atol=1e-9)


def test_the_chain_of_the_search_is_calibrated_with_the_weights(monkeypatch):
    logs = []
    found = Hysteresis()
    monkeypatch.setattr(_hysteresis, "find_hysteresis", lambda log: logs.append(log) or found)
    q, runs, _ = motions()
    weights = np.random.default_rng(0).integers(0, 4, len(q)).astype(float)
    x = tips(q) + 0.02 * np.sin(20 * q)
    assert chosen(Rows.of(q, x, weights, runs), ("base",)) == found
    found = logs[0].model
    expected, plain = (
        calibrate(CHAIN, q, x, parameters=("base",), sample_weight=counts).chain
        for counts in (weights, None)
    )
    assert_allclose(found.base, expected.base, rtol=0, atol=1e-8)
    assert (found.base - plain.base).abs().max() > 1e-5


def test_a_single_motion_that_counts_tells_nothing_of_hysteresis():
    """There is none to hold out beside those of weight zero."""
    q, runs, _ = motions()
    x = tips(PLAY.apply_by_group(q, runs))
    assert chosen(Rows.of(q, x, (runs == 2).astype(float), runs)) == Hysteresis()


def test_the_range_of_states_is_tested_by_other_groups():
    """By hand: commands span 1; the states of group 2 are 0.5 beside those of the others."""
    q = np.linspace(0.0, 1.0, 40)[:, None]
    groups = np.repeat([0, 1, 2, 3], 10)
    states = np.repeat([0.0, 0.1, 0.6, 9.0], 10)[:, None, None]
    log = Rows.of(q, q, np.where(groups == 3, 0.0, 1.0), groups)  # the last one is not measured

    def ranges(log):
        return state_range(states[log.counted], log.take(log.counted), np.ptp(q, axis=0))

    low, high = ranges(log)
    assert_allclose([low.item(), high.item()], [0.0 - 0.5, 0.6 + 0.5])
    one_run = replace(log, runs=np.zeros(40))
    assert_allclose(ranges(one_run), (low, high))
    by_run = replace(log.ungrouped(), runs=groups.astype(float))
    assert_allclose(ranges(by_run), (low, high))
    alone = replace(log, groups=Groups(np.zeros(40)))
    assert_allclose(np.ravel(ranges(alone)), [0.0 - 0.1, 0.6 + 0.1])


@pytest.mark.slow
def test_rows_of_weight_zero_have_no_say_in_a_model_with_hysteresis():
    q, runs, _ = motions()
    x = tips(FRICTION.apply_by_group(q, runs)) + 0.02 * np.sin(20 * q)
    weights = np.where(np.arange(len(q)) % 5, 1.0, 0.0)
    new, new_runs, _ = motions(6, 20, seed=3)
    results = []
    for wrong in (0.0, 0.1):
        y = x + wrong * (weights == 0.0)[:, None]
        model = HybridForwardModel(CHAIN, "linear", hysteresis=FRICTION, coverage=0.6)
        model.fit(q, y, weights, groups=runs)
        model = copy.deepcopy(model).partial_fit(Commands(q, runs), y + 0.01, weights)
        results.append((model.predict(Commands(new, new_runs)), model.radius_))
    assert_array_equal(results[1][0], results[0][0])
    assert results[1][1] == results[0][1]
    assert results[0][1].n_rows == weights.sum()
