"""Long logs: fewer rows count, and operators follow the rows at which actuators reverse."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin import Hysteresis, as_forward_model
from hybridkin._core.runs import RunOrder, spread
from hybridkin.hysteresis import log as hysteresis_log
from hybridkin.hysteresis.fit import HysteresisProblem, _held_back
from hybridkin.hysteresis.log import HysteresisLog
from hybridkin.hysteresis.reversals import behind, reversals
from hybridkin.hysteresis.search import find_hysteresis

M = np.array([[1.0, 0.3, 0.0], [0.0, 0.8, -0.4], [0.2, 0.0, 1.1]])
OPERATORS = {
    "backlash": Hysteresis.backlash(0.3),
    "creep": Hysteresis.creep([0.1, 0.2], [1.0, 8.0]),
    "both": Hysteresis.backlash(0.3) | Hysteresis.creep([0.2], [4.0]),
}


def long_log(operator, groups=5, rows=300, every=10):
    """Return a log at 5 Hz of a linear robot, of which every tenth row counts."""
    rng = np.random.default_rng(0)
    turn = np.linspace(0.0, 12.0, rows)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn)])
    q = (rng.uniform(-1.0, 1.0, (groups, 3, 3)) @ waves).transpose(0, 2, 1).reshape(-1, 3)
    names = np.repeat(np.arange(groups), rows)
    time = np.tile(0.2 * np.arange(rows), groups)
    y = operator.apply_by_group(q, names, time)
    x = y @ M.T + 1e-3 * rng.standard_normal(q.shape)
    model = as_forward_model(lambda q: q @ torch.from_numpy(M.T))
    counts = np.zeros(len(q))
    counts[rng.integers(0, every, len(q) // every) + np.arange(0, len(q), every)] = 1.0
    return HysteresisLog(model, q, x, counts, names, names, time), y


@pytest.mark.slow
@pytest.mark.parametrize("kind", OPERATORS)
def test_a_log_of_fewer_rows_shows_the_same_hysteresis(kind, monkeypatch):
    monkeypatch.setattr(hysteresis_log, "_MOST_FOLLOWED", 10**9)
    log, y = long_log(OPERATORS[kind])
    log_to_last = log.thinned()  # without the rows after the last one that counts
    by_all = find_hysteresis(log).apply_by_group(log.q, log.runs, log.time)
    monkeypatch.setattr(hysteresis_log, "_MOST_FOLLOWED", 500)
    few = log.thinned()
    assert len(few.q) < 0.5 * len(log.q)
    assert_array_equal(few.x[few.rows], log.x[log.rows])
    assert_allclose(few.times, log_to_last.times, rtol=1e-9)
    by_few = find_hysteresis(log).apply_by_group(log.q, log.runs, log.time)
    size = np.abs(y - log.q).mean()
    assert np.abs(by_few - y).mean() < 0.1 * size
    assert np.abs(by_few - by_all).mean() < 0.02 * size


def test_changes_of_fewer_rows_are_those_of_all(monkeypatch):
    """Plays miss the left-out reversals at most; creep knows the straight way between rows."""
    monkeypatch.setattr(hysteresis_log, "_MOST_FOLLOWED", 10**9)
    log = long_log(OPERATORS["both"])[0].thinned()
    monkeypatch.setattr(hysteresis_log, "_MOST_FOLLOWED", 500)
    few = log.thinned()
    by_all = HysteresisProblem(log, 0.3, creep=True)
    by_few = HysteresisProblem(few, 0.3, creep=True)
    size = np.ptp(log.q, axis=0).max()
    assert_allclose(by_few.changes, by_all.changes, rtol=0.0, atol=0.02 * size)
    assert_allclose(by_few.late, by_all.late, rtol=0.0, atol=0.02 * size)
    assert np.abs(by_few.late - by_all.late).mean() < 3e-4 * size
    unaware = HysteresisProblem(replace(few, spans=np.ones(())), 0.3, creep=True)
    assert len(few.times) == 6
    # A log without `spans` has other short time constants, but the same long ones.
    worse = np.abs(unaware.late[:, -2:] - by_all.late[:, -2:]).mean()
    assert worse > 5.0 * np.abs(by_few.late[:, -2:] - by_all.late[:, -2:]).mean()


def test_a_held_command_leads_to_the_state_of_equal_steps():
    rng = np.random.default_rng(0)
    for _ in range(50):
        n_steps = int(rng.integers(1, 40))
        tau = 10.0 ** rng.uniform(-2.0, 2.0)
        first, last, state = rng.standard_normal(3)
        slow = state
        for k in range(1, n_steps + 1):
            command = first + (last - first) * k / n_steps
            slow = command + np.exp(-1.0 / n_steps / tau) * (slow - command)
        share = _held_back(np.array([1.0 / tau]), np.array([n_steps])).item()
        held = last - share * (last - first)
        assert_allclose(held + np.exp(-1.0 / tau) * (state - held), slow, atol=1e-9)
    assert_array_equal(_held_back(np.array([-1.0, 0.0, 1e9]), np.array([3.0, 3.0, 3.0]))[:2], 0.0)


@pytest.mark.parametrize("seed", range(5))
def test_between_reversals_actuators_go_back_by_less_than_the_size(seed):
    rng = np.random.default_rng(seed)
    q = np.cumsum(rng.standard_normal((300, 2)), axis=0)
    runs = RunOrder.of(np.repeat([0, 1], 150))
    sizes = np.array([2.0, 0.5])
    turns = reversals(behind(q, runs, sizes), runs)
    assert turns.any(axis=0).all()
    for actuator in range(2):
        for run in (slice(0, 150), slice(150, 300)):
            places = np.flatnonzero(turns[run, actuator])
            column = q[run, actuator]
            ends = [0, *places, 149]
            for a, b in itertools.pairwise(ends):
                part = column[a : b + 1]
                back = min(
                    (np.maximum.accumulate(part) - part).max(),
                    (part - np.minimum.accumulate(part)).max(),
                )
                assert back <= sizes[actuator] + 1e-12
            # At a reversal an actuator is at an end of what it does before and after.
            for a, b, c in zip(ends[:-2], ends[1:-1], ends[2:], strict=True):
                around = column[a : c + 1]
                assert column[b] in (around.max(), around.min())


@pytest.mark.parametrize("seed", range(5))
def test_rows_up_to_the_last_one_that_counts_are_needed(seed):
    rng = np.random.default_rng(seed)
    runs = rng.integers(0, 5, 60)
    counted = np.sort(rng.choice(60, 6, replace=False))
    expected = []
    for run in np.unique(runs[counted]):
        last = counted[runs[counted] == run].max()
        expected += np.flatnonzero((runs == run) & (np.arange(60) <= last)).tolist()
    assert_array_equal(RunOrder.of(runs).up_to(counted), sorted(expected))


@pytest.mark.parametrize("seed", range(5))
def test_a_thinned_log_has_rows_of_motions_in_proportion(seed):
    rng = np.random.default_rng(seed)
    for n_motions in (3, 40, 400):
        motions = np.repeat(rng.permutation(n_motions), rng.integers(20, 60, n_motions))
        rows = RunOrder.of(motions).spread_rows(400)
        assert 300 < len(rows) <= 400 or len(rows) == len(motions) < 400
        assert (np.diff(rows) > 0).all()
        counts = np.bincount(motions[rows], minlength=n_motions)
        assert (counts > 0).sum() == min(n_motions, 40)
        if n_motions == 40:
            part = counts / np.bincount(motions)
            assert part.max() < 2.0 * part.min()
    assert_array_equal(RunOrder.of(motions[:100]).spread_rows(100), np.arange(100))
    assert len(RunOrder.of(np.arange(1000)).spread_rows(100)) <= 100  # every row is a motion


def test_spread_rows_do_not_repeat_with_a_period():
    for n, most in ((10, 20), (1000, 100), (997, 100), (7, 1)):
        places = spread(n, most)
        assert (np.diff(places) > 0).all()
        assert len(places) == min(n, most)
        assert 0 <= places.min() <= places.max() < n
    for period in (2, 5, 10, 20):
        assert len(np.unique(spread(1000, 100) % period)) == period
