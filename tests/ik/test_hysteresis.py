"""Trackers of models with hysteresis: commands within limits, that lead what the actuators do."""

import pickle

import numpy as np
import pytest
import rounding
import torch
from operators import operators, with_hysteresis

from hybridkin import HybridForwardModel, Hysteresis, InverseKinematics, robots
from hybridkin.ik.results import IKStatus

CHAIN = robots.bionic_handling_assistant()
HOME = np.full(9, 0.25)
DT = 0.01
OPERATORS = operators(9, 1e-3)
LIMITS = {
    "free": {},
    "speed": {"dq_max": 0.05},
    "acceleration": {"dq_max": 0.2, "ddq_max": 1.0},
}
KINDS = pytest.mark.parametrize("kind", OPERATORS)
WITHIN = pytest.mark.parametrize(
    "limits", ["free", "speed", pytest.param("acceleration", marks=pytest.mark.slow)]
)


def ik_of(operator, **settings):
    model = CHAIN if operator is None else with_hysteresis(CHAIN, operator)
    return InverseKinematics(model, **{"q_min": 0.15, "q_max": 0.35, "dt": DT, **settings})


def targets(n, every=40):
    """Points that stay for a while, then jump."""
    draw = np.random.default_rng(1).uniform(-1.0, 1.0, (n // every + 1, 3))
    return np.repeat([0.0, 0.0, 0.75] + draw * [0.05, 0.05, 0.02], every, axis=0)[:n]


def circle(n):
    phase = 2.0 * np.pi * np.arange(n) / n
    return np.stack([0.05 * np.cos(phase), 0.05 * np.sin(phase), np.full(n, 0.74)], axis=1)


@KINDS
@WITHIN
@pytest.mark.parametrize("backend", ["core", "torch"])
def test_commands_keep_the_limits_and_the_state_is_theirs(kind, limits, backend):
    settings = LIMITS[limits]
    tracker = ik_of(OPERATORS[kind], **settings).tracker(
        HOME if backend == "core" else torch.from_numpy(HOME)
    )
    sent = [HOME]
    effective = []
    errors = []
    for target in targets(200 if backend == "core" else 80):
        sent.append(np.asarray(tracker.step(target)))
        effective.append(np.asarray(tracker.effective))
        errors.append(tracker.error)
    sent = np.array(sent)
    assert (sent >= 0.15).all()
    assert (sent <= 0.35).all()
    steps = np.diff(sent, axis=0)
    speed = np.abs(steps).max() / DT
    assert speed <= settings.get("dq_max", np.inf) * (1.0 + 1e-12)
    change = np.abs(np.diff(steps, axis=0, prepend=0.0 * steps[:1])).max() / DT**2
    assert change <= settings.get("ddq_max", np.inf) * (1.0 + 1e-9)
    expected, _ = OPERATORS[kind].apply(sent, dt=DT)
    np.testing.assert_allclose(effective, expected[1:], rtol=0, atol=1e-12)
    np.testing.assert_array_equal(tracker.q, sent[-1])
    again, _ = OPERATORS[kind].command(np.vstack([HOME, effective]), dt=DT)
    moved, _ = OPERATORS[kind].apply(again, dt=DT)
    np.testing.assert_allclose(moved[1:], effective, rtol=0, atol=1e-9)
    # Every target is reached: the dead band is crossed.
    assert max(errors[39::40]) < 1e-6


def put_where(reference, core):
    """Put a tracker in torch where one of the core is: differences can grow in closed loops."""
    robot, compiled = reference._robot, core._robot
    robot._lead.state = compiled.hysteresis
    robot._lead.command = torch.from_numpy(core.q)[None]
    robot._lead.effective = torch.from_numpy(core.effective)[None]
    step = robot._last.step._replace(dq=compiled.last().step.dq)
    robot._last = robot._last._replace(step=step)


@pytest.mark.needs_core
@KINDS
@WITHIN
def test_the_core_commands_what_torch_does(kind, limits):
    ik = ik_of(OPERATORS[kind], **LIMITS[limits])
    core = ik.tracker(HOME)
    reference = ik.tracker(torch.from_numpy(HOME))
    assert core.backend == "compiled"
    for target in targets(400 if limits == "acceleration" else 80):
        put_where(reference, core)
        before = core.q
        command = core.step(target)
        expected = reference.step(torch.from_numpy(target))
        # Slopes of the hysteresis of at least 0.2 multiply the rounding of a step by at most 5.
        close = 5.0 * rounding.of_commands([before, expected]) + rounding.EPS
        np.testing.assert_allclose(command, expected, rtol=0, atol=close)
        np.testing.assert_allclose(core.effective, reference.effective, rtol=0, atol=close)
        assert core.status == reference.status


@pytest.mark.slow
@pytest.mark.needs_core
@KINDS
def test_the_core_follows_a_path_as_torch_does(kind):
    ik = ik_of(OPERATORS[kind], dq_max=0.5)
    core = ik.track(circle(50), q0=HOME)
    reference = ik.track(torch.from_numpy(circle(50)), q0=torch.from_numpy(HOME))
    close = 5.0 * rounding.of_commands(reference.q)
    np.testing.assert_allclose(core.q, reference.q, rtol=0, atol=close)
    np.testing.assert_allclose(core.effective, reference.effective, rtol=0, atol=close)


@KINDS
def test_without_limits_of_speed_the_tip_is_where_it_would_be_without_hysteresis(kind):
    ik = ik_of(OPERATORS[kind])
    plain = ik_of(None)
    tracker = ik.tracker(HOME)
    reference = plain.tracker(HOME)
    for target in circle(60):
        tracker.step(target)
        reference.step(target)
        np.testing.assert_allclose(tracker.effective, reference.q, rtol=0, atol=2e-9)
        assert np.abs(tracker.q - reference.q).max() < 0.02
    track = ik.track(circle(60), q0=HOME)
    np.testing.assert_allclose(track.effective, plain.track(circle(60), q0=HOME).q, atol=2e-9)
    moved, _ = OPERATORS[kind].apply(track.q, dt=DT)
    np.testing.assert_allclose(track.effective, moved, rtol=0, atol=1e-12)


def test_a_command_crosses_the_backlash_in_several_periods():
    tracker = ik_of(Hysteresis.backlash(2e-3), dq_max=0.05, q_pref=HOME, beta=0.0).tracker(HOME)
    up = tracker.x + np.array([0.0, 0.0, 0.01])
    for _ in range(60):
        tracker.step(up)
    np.testing.assert_allclose(tracker.q - tracker.effective, 1e-3, rtol=0, atol=1e-12)
    held = tracker.effective
    for _ in range(3):  # 2 mm at 0.5 mm per period
        tracker.step(up - [0.0, 0.0, 0.01])
        np.testing.assert_allclose(tracker.effective, held, rtol=0, atol=1e-12)
        assert tracker.status is IKStatus.AT_LIMITS
        assert tracker.saturated.all()
    for _ in range(2):
        tracker.step(up - [0.0, 0.0, 0.01])
    assert (tracker.effective < held).all()


def test_a_tip_at_rest_keeps_its_commands():
    tracker = ik_of(OPERATORS["play"], beta=0.0).tracker(HOME)
    target = np.array([0.05, 0.02, 0.74])
    for _ in range(12):
        q = tracker.step(target)
    for _ in range(50):
        np.testing.assert_allclose(tracker.step(target), q, rtol=0, atol=1e-11)


def test_what_is_not_known_holds_the_command():
    for backend in (HOME, torch.from_numpy(HOME)):
        tracker = ik_of(OPERATORS["plays, creep"]).tracker(backend)
        tracker.step([0.05, 0.02, 0.74])
        q = np.asarray(tracker.q)
        for bad in ([np.nan, 0.0, 0.7], [0.0, np.inf, 0.7]):
            np.testing.assert_array_equal(tracker.step(bad), q)
            assert tracker.status is IKStatus.INVALID_INPUT


@KINDS
def test_a_tracker_goes_on_from_a_state(kind):
    tracker = ik_of(OPERATORS[kind]).tracker(HOME)
    path = circle(40)
    sent = [HOME, *(tracker.step(target) for target in path[:20])]
    _, state = OPERATORS[kind].apply(np.array(sent), dt=DT)
    again = ik_of(OPERATORS[kind]).tracker(HOME)
    again.reset(tracker.q, state)
    read = ik_of(OPERATORS[kind]).tracker(HOME)
    read.reset(tracker.q, tracker.state)
    copied = pickle.loads(pickle.dumps(tracker))
    np.testing.assert_allclose(again.effective, tracker.effective, rtol=0, atol=1e-14)
    for target in path[20:]:
        q = tracker.step(target)
        np.testing.assert_allclose(again.step(target), q, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(copied.step(target), q)
        np.testing.assert_allclose(read.step(target), q, rtol=0, atol=1e-12)
    assert ik_of(None).tracker(HOME).state.shape == (0, 9)
    with pytest.raises(ValueError, match="has none"):
        ik_of(None).tracker(HOME).reset(HOME, state)


@KINDS
def test_commands_at_rest_do_not_cross_a_backlash_for_rounding(kind):
    """Creep goes on at rest, in any order of the stages."""
    tracker = ik_of(OPERATORS[kind], dq_max=0.2, beta=0.0).tracker(HOME)
    target = targets(2)[0]
    commands = [tracker.step(target) for _ in range(200)]
    assert tracker.error < 1e-8
    assert np.abs(np.diff(commands[50:], axis=0)).max() < 1e-4


@pytest.mark.parametrize("convert", [np.asarray, torch.from_numpy])
def test_a_pause_with_creep_is_part_of_the_state(convert):
    operator = OPERATORS["plays, creep"]
    tracker = ik_of(operator).tracker(convert(HOME))
    for target in circle(20):
        tracker.step(convert(target))
    _, rested = operator.apply(tracker.q[None], tracker.state, dt=[1e5])
    moved = np.abs(
        np.asarray(tracker.effective) - np.asarray(operator.apply(tracker.q[None], rested, 0.0)[0])
    )
    tracker.reset(tracker.q, rested)
    np.testing.assert_allclose(
        tracker.effective, operator.apply(tracker.q[None], rested, 0.0)[0][0], rtol=0, atol=1e-14
    )
    assert moved.max() > 1e-4
    assert type(tracker.state) is type(tracker.q)


def test_from_outside_the_limits_the_command_returns_at_its_speed():
    tracker = ik_of(OPERATORS["plays"], dq_max=0.1).tracker(np.full(9, 0.36))
    for k in range(1, 11):
        np.testing.assert_allclose(tracker.step([0.0, 0.0, 0.8]), 0.36 - 0.001 * k, atol=1e-12)
    assert (tracker.step([0.0, 0.0, 0.8]) <= 0.35).all()


def test_a_refit_keeps_the_state_of_its_hysteresis():
    rng = np.random.default_rng(0)
    q = 0.25 + 0.05 * rng.uniform(-1.0, 1.0, (60, 9))
    x = CHAIN(torch.from_numpy(q)).numpy() + 0.002
    model = HybridForwardModel(CHAIN, "linear", hysteresis=1e-3).fit(q, x)
    ik = InverseKinematics(model, q_min=0.15, q_max=0.35, dt=DT)
    for start in (HOME, torch.from_numpy(HOME)):
        tracker = ik.tracker(start)
        for target in circle(20):
            tracker.step(target)
        command, effective = np.asarray(tracker.q), np.asarray(tracker.effective)
        assert np.abs(command - effective).max() > 4e-4
        model.partial_fit(q[:10], x[:10] + 0.001)
        tracker.step([np.nan] * 3)
        np.testing.assert_array_equal(tracker.q, command)
        np.testing.assert_allclose(tracker.effective, effective, rtol=0, atol=1e-15)
        model.set_params(hysteresis=2e-3).fit(q, x)
        tracker.step([np.nan] * 3)
        np.testing.assert_array_equal(tracker.q, command)
        np.testing.assert_array_equal(tracker.effective, command)
        model.set_params(hysteresis=1e-3).fit(q, x)
