"""The domain and the radius of models with hysteresis: states that the log had, and others."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from hybridkin import (
    Commands,
    HybridForwardModel,
    Hysteresis,
    load_model,
    robots,
    save_model,
)
from hybridkin.hybrid._pace import each_pace

CHAIN = robots.bionic_handling_assistant()
FRICTION = Hysteresis.friction([0.0, 0.01, 0.02, 0.2], [0.5, 0.7, 0.8])
CREEP = Hysteresis.creep([0.1, 0.2], [4.0, 400.0])
ROWS = 40


def motions(n, seed, corner=0.0):
    """Return motions back and forth, which begin at 0.25 m or up to `corner` away from it."""
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 2.0 * np.pi, ROWS)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn) - 1.0])
    q = 0.25 + (rng.uniform(-0.03, 0.03, (n, 9, 3)) @ waves).transpose(0, 2, 1)
    late = np.linspace(0.0, 1.0, ROWS)[:, None]
    start = corner * rng.choice([-1.0, 1.0], (n, 1, 9))
    q = q + (1.0 - late) * (start if corner else 0.0)
    runs = np.repeat(np.arange(n), ROWS)
    return Commands(q.reshape(-1, 9), runs, np.arange(len(runs), dtype=float))


def many_plays(commands):
    """Return the sum of 25 plays of widths up to 8 cm, none of them those of a fit."""
    half = np.linspace(0.0, 0.04, 25)
    density = np.exp(-half / 0.012)
    plays = [Hysteresis.backlash(2.0 * r).apply_by_group(commands.q, commands.runs) for r in half]
    return np.tensordot(density / density.sum(), plays, 1)


def tips(y, noise=0.0):
    with torch.no_grad():
        bent = torch.from_numpy(y) + 0.03 * torch.from_numpy(y[:, ::-1] - 0.25).square()
        x = CHAIN(bent).numpy()
    return x + noise * np.random.default_rng(1).standard_normal(x.shape)


def distances(model, commands, x):
    return np.linalg.norm(model.predict(commands) - x, axis=1)


def fitted(operator, **settings):
    commands = motions(16, seed=0)
    x = tips(operator.apply_by_group(commands.q, commands.runs, commands.time))
    model = HybridForwardModel(CHAIN, "linear", hysteresis=operator, **settings)
    return model.fit(commands, x, groups=commands.runs)


@pytest.mark.slow
def test_runs_that_begin_elsewhere_are_outside_the_domain(tmp_path):
    model = fitted(FRICTION, coverage=0.9)
    assert model.in_domain(motions(8, seed=2)).mean() > 0.9
    elsewhere = motions(8, seed=3, corner=0.05)
    y = torch.from_numpy(model.effective(elsewhere))
    assert model.module_.in_domain(y).float().mean() > 0.2  # for what the actuators do
    assert not model.in_domain(elsewhere).any()
    _, radius = model.predict(elsewhere, return_radius=True)
    assert np.isinf(radius).all()
    save_model(model, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    q = np.concatenate([motions(8, seed=2).q, elsewhere.q])
    both = Commands(q, np.arange(len(q)) // ROWS, np.arange(float(len(q))))
    assert_array_equal(loaded.in_domain(both), model.in_domain(both))
    assert 0.4 < model.in_domain(both).mean() < 0.5


def test_states_follow_the_zeros_of_the_actuators():
    model = fitted(FRICTION)
    today = motions(8, seed=2)
    shift = np.full(9, 0.02)
    x = tips(FRICTION.apply_by_group(today.q, today.runs))
    moved = Commands(today.q - shift, today.runs, today.time)
    before = model.in_domain(today)
    model.adapt(moved, x, parameters=["actuator_zeros"], groups=moved.runs)
    np.testing.assert_allclose(model.change_.shift, shift, atol=2e-3)
    assert (model.in_domain(moved) == before).mean() > 0.95


def test_creep_after_a_long_rest_at_an_end_is_outside_the_domain():
    model = fitted(CREEP)
    commands = motions(8, seed=2)
    swing = np.abs(commands.q - 0.25).reshape(8, ROWS, 9).sum(axis=2)
    end = swing.argmax(axis=1) + ROWS * np.arange(8)  # of every motion, where it rests
    runs = np.insert(commands.runs, end, commands.runs[end])
    q = np.insert(commands.q, end, commands.q[end], axis=0)
    rests = np.zeros(len(q), dtype=bool)
    rests[end + 1 + np.arange(8)] = True
    later = np.concatenate([np.maximum.accumulate(rests[runs == run]) for run in range(8)])
    for pause, least, most in ((1.0, 0.8, 1.0), (3600.0, 0.0, 0.5)):
        time = np.arange(float(len(q))) + pause * np.cumsum(rests)
        inside = model.in_domain(Commands(q, runs, time))
        assert inside[~later].mean() > 0.9
        assert least <= inside[later].mean() <= most


def at_pace(commands, speed):
    return Commands(commands.q, commands.runs, commands.time / speed)


@pytest.mark.slow
def test_paces_that_the_log_lacks_are_outside_the_domain(tmp_path):
    """With creep; friction and backlash do not know how fast they are moved."""
    new = motions(8, seed=2)
    usual = fitted(CREEP, coverage=0.9)
    save_model(usual, tmp_path / "model.safetensors")
    loaded = load_model(tmp_path / "model.safetensors")
    inside = usual.in_domain(new)
    assert inside.mean() > 0.8
    for speed, most in ((0.05, 0.3), (0.2, 0.5), (5.0, 0.2), (20.0, 0.1)):
        other = at_pace(new, speed)
        assert usual.in_domain(other).mean() < most
        assert_array_equal(loaded.in_domain(other), usual.in_domain(other))
        _, radius = usual.predict(other, return_radius=True)
        assert_array_equal(np.isinf(radius), ~usual.in_domain(other))
    without_times = fitted(FRICTION)
    for speed in (0.05, 20.0):
        other = at_pace(new, speed)
        assert_array_equal(without_times.in_domain(other), without_times.in_domain(new))


@pytest.mark.parametrize("seed", range(3))
def test_the_pace_is_a_mean_speed_in_which_the_past_fades(seed):
    rng = np.random.default_rng(seed)
    runs = rng.integers(0, 3, 60)
    q = rng.standard_normal((60, 2)).cumsum(axis=0)
    time = np.cumsum(rng.uniform(0.1, 2.0, 60))
    for tau, pace in zip((0.5, 20.0), each_pace(q, runs, time, np.array([0.5, 20.0])), strict=True):
        for run in range(3):
            rows = np.flatnonzero(runs == run)
            steps = np.diff(time[rows])
            moved = np.abs(np.diff(q[rows], axis=0))
            for k in range(1, len(rows)):
                age = time[rows[k]] - time[rows[1 : k + 1]]
                weights = np.exp(-age / tau)
                speed = weights @ moved[:k] / (weights @ steps[:k])
                np.testing.assert_allclose(pace.speeds[rows[k]], speed, rtol=1e-9)
            assert not pace.shown[rows[0]]
    constant = Commands(0.3 * time[:, None] * [1.0, 2.0], np.zeros(60), time)
    (pace,) = each_pace(constant.q, constant.runs, time, np.array([5.0]))
    np.testing.assert_allclose(pace.speeds[1:], np.tile([0.3, 0.6], (59, 1)))


@pytest.mark.parametrize("operator", [FRICTION, CREEP, FRICTION | CREEP, CREEP | FRICTION])
def test_inner_states_are_those_of_single_steps(operator):
    commands = motions(3, seed=0)
    order = np.argsort(np.arange(120) % ROWS, kind="stable")  # motions by turns
    commands = commands[order]
    states = operator.inner_states(commands.q, commands.runs, commands.time)
    ends = np.cumsum([stage.n_inside + 1 for stage in operator.stages])
    for run in range(3):
        state = None
        rows = np.flatnonzero(commands.runs == run)
        for row, step in zip(rows, np.diff(commands.time[rows], prepend=0.0), strict=True):
            _, state = operator.apply(commands.q[row : row + 1], state, [step])
            inside = np.delete(state, [0, *ends], axis=0)
            np.testing.assert_allclose(states[row], inside, atol=1e-14)
    assert Hysteresis.backlash(0.01).inner_states(commands.q, commands.runs).shape == (120, 0, 9)


@pytest.mark.slow
def test_the_radius_covers_new_motions_with_hysteresis():
    commands = motions(24, seed=0)
    x = tips(many_plays(commands), 5e-4)
    model = HybridForwardModel(
        CHAIN, "quadratic", coupling="serial", hysteresis="auto", coverage=0.9
    )
    model.fit(commands, x, groups=commands.runs)
    new = motions(48, seed=1)
    error = distances(model, new, tips(many_plays(new), 5e-4))
    inside = model.in_domain(new)
    moved = model.module_.in_domain(torch.from_numpy(model.effective(new))).float().mean()
    assert inside.mean() > 0.9 * moved  # states of motions like these leave most of the domain
    covered = (error <= model.radius_.inside)[inside].mean()
    assert 0.84 < covered < 0.97
    elsewhere = motions(24, seed=2, corner=0.05)
    assert distances(model, elsewhere, tips(many_plays(elsewhere))).mean() > model.radius_.inside
    assert not model.in_domain(elsewhere).any()
