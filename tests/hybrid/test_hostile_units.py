"""Numbers in another unit: the message names the argument and the factor, and never a right one."""

import copy
import re
import warnings
from functools import partial

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    calibrate,
)
from hybridkin._core.other_units import check_tips
from hybridkin._core.units import other_unit, rough_unit

FACTORS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 1.0 / 0.0254}
DIVISOR = {"millimetres": "1000", "centimetres": "100", "inches": "39.37"}


def trunk(size=1.0):
    radii = [0.1 * size, 0.093 * size, 0.079 * size]
    return ConstantCurvatureChain(radii), 0.15 * size, 0.35 * size


def tendons(size=1.0):
    chain = ConstantCurvatureChain([0.02 * size] * 2, lengths=[0.1 * size] * 2)
    return chain, -0.02 * size, 0.02 * size


ROBOTS = {"trunk": trunk, "tendons": tendons}


def log(robot, size=1.0, seed=0, n=60):
    chain, low, high = ROBOTS[robot](size)
    rng = np.random.default_rng(seed)
    q = rng.uniform(low, high, (n, chain.n_actuators))
    if robot == "tendons":
        q -= q.reshape(n, 2, 3).mean(2).repeat(3, axis=1)
    x = chain(torch.from_numpy(q)).numpy()
    x += 1e-3 * float(chain.reach) * rng.standard_normal(x.shape)
    model = HybridForwardModel(chain, "linear").fit(q, x)
    bounds = {"q_min": low - 0.5 * (high - low), "q_max": high + 0.5 * (high - low)}
    return model, q, x, InverseKinematics(model, **bounds)


def said(call):
    """Return the error, or the warnings, of a call."""
    with warnings.catch_warnings(record=True) as seen:
        warnings.simplefilter("always")
        try:
            call()
        except ValueError as error:
            return [str(error)]
    return [str(warning.message) for warning in seen]


def calls(model, q, x, ik, k_q, k_x):
    """Return the name of the argument and a call, for all that take q or x."""
    new = HybridForwardModel(model.mechanical_model, "drop")
    short = {"restarts": 0, "max_iter": 2}
    of_q = {
        "X": [
            lambda: new.fit(k_q * q, x),
            lambda: model.predict(k_q * q),
            lambda: copy.deepcopy(model).adapt(k_q * q[:5], x[:5]),
            lambda: copy.deepcopy(model).adapt(k_q * q[:1], x[:1]),
            lambda: copy.deepcopy(model).partial_fit(k_q * q[:5], x[:5]),
            lambda: copy.deepcopy(model).partial_fit(k_q * q[:1], x[:1]),
        ],
        "q": [
            lambda: calibrate(model.mechanical_model, k_q * q, x, ("base",)),
            lambda: ik.step(k_q * q[0], x[0]),
            lambda: ik.step(k_q * q[:2], x[:2]),
            lambda: ik.tracker(q[0]).reset(k_q * q[0]),
        ],
        "q0": [
            lambda: ik.tracker(k_q * q[0]),
            lambda: ik.solve(x[0], k_q * q[0], **short),
            lambda: ik.track(x[:2], q0=k_q * q[0]),
        ],
    }
    of_x = {
        "y": [
            lambda: new.fit(q, k_x * x),
            lambda: copy.deepcopy(model).adapt(q[:5], k_x * x[:5]),
            lambda: copy.deepcopy(model).partial_fit(q[:5], k_x * x[:5]),
        ],
        "x": [lambda: calibrate(model.mechanical_model, q, k_x * x, ("base",))],
        "x_target": [
            lambda: ik.step(q[0], k_x * x[0]),
            lambda: ik.tracker(q[0]).step(k_x * x[0]),
            lambda: ik.solve(k_x * x[0], q[0], **short),
        ],
        "x_measured": [
            lambda: ik.step(q[0], x[0], x_measured=k_x * x[0]),
            lambda: ik.tracker(q[0]).step(x[0], x_measured=k_x * x[0]),
        ],
        "path": [lambda: ik.track(k_x * x[:2], q0=q[0])],
    }
    return of_q if k_q != 1.0 else of_x


# Rows far from the fit, or few steps, have further warnings, which name no unit.
def named(messages):
    return [message for message in messages if re.search("looks like|check its unit", message)]


@pytest.mark.slow
@pytest.mark.parametrize("unit", ["millimetres", "centimetres"])
@pytest.mark.parametrize("robot", ROBOTS)
def test_every_entry_names_the_argument_and_the_factor(robot, unit):
    model, q, x, ik = log(robot)
    factor = FACTORS[unit]
    for k_q, k_x in ((factor, 1.0), (1.0, factor)):
        for argument, entries in calls(model, q, x, ik, k_q, k_x).items():
            for place, call in enumerate(entries):
                messages = named(said(call))
                assert len(messages) == 1, (argument, place, messages)
                assert messages[0].startswith(f"`{argument}`"), (place, messages)
                assert unit in messages[0]
                assert f"divide by {DIVISOR[unit]}" in messages[0]


@pytest.mark.parametrize("unit", FACTORS)
@pytest.mark.parametrize("robot", ROBOTS)
def test_adapt_refuses_the_argument_that_has_the_factor(robot, unit):
    """Nothing changes; the base did not move by metres."""
    factor = FACTORS[unit]
    for seed, size in enumerate([0.02, 1.0, 5.0]):
        model, q, x, _ = log(robot, size, seed)
        rows = np.random.default_rng(seed).choice(60, 6, replace=False)
        with pytest.raises(ValueError, match=rf"`X` must .* looks like {unit}: divide by") as seen:
            model.adapt(factor * q[rows], x[rows])
        assert DIVISOR[unit] in str(seen.value)
        with pytest.raises(ValueError, match=rf"`y` must .* looks like {unit}: divide by"):
            model.adapt(q[rows], factor * x[rows])
        with pytest.raises(ValueError, match=rf"`X` must .* like {unit}"):
            model.partial_fit(factor * q[rows[:1]], x[rows[:1]])
        assert np.array_equal(model.change_.motion, np.eye(4))
        with pytest.raises(ValueError, match=r"`y` must .* kilometres: multiply by 1000"):
            model.adapt(q[rows], 1e-3 * x[rows])
    if robot == "trunk":
        with pytest.raises(ValueError, match=r"`X` must .* kilometres: multiply by 1000"):
            model.adapt(1e-3 * q[rows], x[rows])


def test_adapt_refuses_degrees():
    origins = np.tile(np.eye(4), (3, 1, 1))
    origins[1:, 0, 3] = 0.3
    arm = RigidChain(origins, [[0, 0, 1], [0, 1, 0], [0, 0, 1]], tool=[0.2, 0.0, 0.0])
    q = np.random.default_rng(0).uniform(-1.5, 1.5, (40, 3))
    x = arm(torch.from_numpy(q)).numpy()
    model = HybridForwardModel(arm, "linear").fit(q, x + 1e-3 * np.sin(9 * x))
    with pytest.raises(ValueError, match=r"`X` must .* degrees: take numpy\.radians"):
        model.adapt(np.degrees(q[:6]), x[:6])


@pytest.mark.slow
@pytest.mark.parametrize("robot", ROBOTS)
def test_legitimate_rows_of_any_size_pass(robot):
    """Robots of 2 mm to 20 m, moved bases, small and large motions, one posture, one row."""
    rng = np.random.default_rng(0)
    for seed in range(4):
        size = np.exp(rng.uniform(np.log(0.002), np.log(9.0)))
        model, q, x, ik = log(robot, size, seed)
        middle = q.mean(0)
        for part in (0.02, 0.3, 1.0, 2.0):
            few = middle + part * (q[:6] - middle)
            tips = model.predict(few)
            turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
            moved = tips @ turn.T + size * rng.normal(size=3)
            for rows in (slice(None), slice(1)):
                adapt = copy.deepcopy(model).adapt
                assert not named(said(partial(adapt, few[rows], moved[rows])))
                update = copy.deepcopy(model).partial_fit
                assert not named(said(partial(update, few[rows], tips[rows])))
        for nearly in (1.0, 1.0 + 1e-9):  # arguments of x, and of q
            for argument in calls(model, q, x, ik, nearly, 1.0).values():
                for call in argument:
                    assert not named(said(call)), size


def test_a_robot_that_did_not_move_is_no_other_unit():
    """Tips of one posture have no size; those of a robot that lay still differ by noise alone."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        size = np.exp(rng.uniform(-6, 3))
        posture = size * rng.normal(size=3)
        check_tips(posture + 1e-3 * size * rng.normal(size=(6, 3)), np.tile(posture, (6, 1)), "y")
        check_tips(rng.normal(size=(1, 3)), rng.normal(size=(1, 3)), "y")


def test_factors_are_recognised_within_a_factor_of_two():
    rng = np.random.default_rng(0)
    for unit, factor in FACTORS.items():
        for _ in range(100):
            off = np.exp(rng.uniform(-0.4, 0.4))
            assert other_unit(factor * off).name == unit
    assert other_unit(10.0) is None
    assert other_unit(57.0, angle=True).name == "degrees"
    assert [rough_unit(r).symbol for r in (40.0, 100.0, 1000.0)] == ["cm", "cm", "mm"]


def test_a_tracker_looks_at_its_first_target_and_measurement_alone():
    _, q, x, ik = log("tendons")
    tracker = ik.tracker(q[0])
    assert not named(said(lambda: tracker.step(np.full(3, np.nan))))
    assert named(said(lambda: tracker.step(1e3 * x[0])))
    assert not named(said(lambda: tracker.step(1e3 * x[0])))
    assert named(said(lambda: tracker.step(x[0], x_measured=1e3 * x[0])))
    tracker.reset(q[0])
    assert named(said(lambda: tracker.step(1e3 * x[0])))
