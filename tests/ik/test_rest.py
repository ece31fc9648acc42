"""Trackers rest out of reach at the nearest point, and leave singular configurations."""

import numpy as np
import pytest
import rounding
import torch

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    Hysteresis,
    InverseKinematics,
    RigidChain,
    robots,
)
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PoseTask

TRUNK = robots.bionic_handling_assistant()
ORIGINS = np.tile(np.eye(4), (6, 1, 1))
ORIGINS[1:, 0, 3] = 0.2
SIX = RigidChain(
    ORIGINS,
    [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]],
    tool=[0.1, 0.0, 0.0],
)
TENDONS = ConstantCurvatureChain([0.01] * 2, lengths=[0.1] * 2)
ROBOTS = {
    "tendons": (TENDONS, -0.02, 0.02),
    "trunk": (TRUNK, 0.1, 0.4),
    "arm": (SIX, -2.5, 2.5),
    "elastic": (ElasticTendonChain([0.01] * 2, lengths=[0.1] * 2), -0.02, 0.02),
}
SPEEDS = {
    "none": {},
    "speed": {"dq_max": 0.5},
    "acceleration": {"dq_max": 0.5, "ddq_max": 2.0},
}


def ik_of(name, speed="none", **options):
    model, low, high = ROBOTS[name]
    limits = {key: share * (high - low) for key, share in SPEEDS[speed].items()}
    return InverseKinematics(model, q_min=low, q_max=high, **limits, **options)


def beyond(name, n, distance, seed=0):
    """Starts, and points beyond where a local search for a far target ends [m]."""
    ik = ik_of(name)
    draw = np.random.default_rng(seed)
    low, high = ROBOTS[name][1:]
    q = draw.uniform(low, high, (n, ik.settings.n_actuators))
    way = draw.standard_normal((n, 3))
    far = 5.0 * way / np.linalg.norm(way, axis=1, keepdims=True)
    end = ik.solve(far, q, restarts=0).x
    out = far - end
    return q[::-1], end + distance * out / np.linalg.norm(out, axis=1, keepdims=True)


@pytest.mark.needs_core
@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("distance", [0.002, 0.02, 3.0])
@pytest.mark.parametrize("name", ["tendons", "trunk", "arm"])
def test_it_rests_at_the_nearest_point_there_is(name, distance, speed):
    ik = ik_of(name, speed)
    span = float(ik.settings.q_max - ik.settings.q_min)
    for q, x in zip(*beyond(name, 3, distance), strict=True):
        tracker = ik.tracker(q)
        steps = [q, *(tracker.step(x) for _ in range(1000))]
        assert np.abs(np.diff(steps[-200:], axis=0)).max() < 1e-4 * span
        nearest = ik.solve(x, steps[-1], restarts=0)
        assert tracker.error <= 1.001 * nearest.error + 1e-9


@pytest.mark.needs_core
def test_elastic_tendons_rest_without_limits_of_motion():
    ik = ik_of("elastic")
    for q, x in zip(*beyond("elastic", 4, 0.02), strict=True):
        tracker = ik.tracker(q)
        steps = [tracker.step(x) for _ in range(1000)]
        assert np.abs(np.diff(steps[-200:], axis=0)).max() < 1e-4 * 0.04


@pytest.mark.needs_core
def test_a_target_that_moves_out_and_in_again_is_followed():
    ik = ik_of("tendons")
    (q,), (out,) = beyond("tendons", 1, 0.01)
    inside = ik.solve(out, restarts=0).x * [0.95, 0.95, 1.0] - [0.0, 0.0, 0.005]
    q = ik.solve(inside).q
    tracker = ik.tracker(q)
    errors = []
    for way in 0.5 - 0.5 * np.cos(np.linspace(0.0, 4.0 * np.pi, 800)):
        tracker.step(inside + way * (out - inside))
        errors.append(tracker.error)
    assert max(errors[-20:]) < 1e-3
    assert max(errors) < 0.012  # of 10 mm beyond reach


@pytest.mark.slow
@pytest.mark.needs_core
@pytest.mark.parametrize("speed", SPEEDS)
@pytest.mark.parametrize("name", ROBOTS)
def test_out_of_reach_the_core_commands_what_torch_does(name, speed):
    ik = ik_of(name, speed)
    for q, x in zip(*beyond(name, 2, 0.01, seed=3), strict=True):
        core, reference = ik.tracker(q), ik.tracker(torch.from_numpy(q.copy()))
        for k in range(12):
            expected = reference.step(torch.from_numpy(x)).numpy()
            # A model that bends multiplies the rounding of every step.
            close = 100.0**k * rounding.of_commands([q, expected])
            np.testing.assert_allclose(core.step(x), expected, rtol=0, atol=min(close, 1e-6))


@pytest.mark.slow
def test_it_rests_in_single_precision():
    ik = ik_of("tendons")
    (q,), (x,) = beyond("tendons", 1, 0.02)
    tracker = ik.tracker(torch.from_numpy(q.copy()).float())
    steps = [tracker.step(torch.from_numpy(x).float()).numpy() for _ in range(250)]
    assert np.abs(np.diff(steps[-50:], axis=0)).max() < 1e-4 * 0.04
    nearest = ik.solve(x, steps[-1].astype(float), restarts=0)
    assert tracker.error == pytest.approx(float(nearest.error), rel=1e-3)


@pytest.mark.needs_core
def test_hysteresis_rests_too():
    from operators import with_hysteresis

    model = with_hysteresis(TENDONS, Hysteresis.backlash(1e-4))
    ik = InverseKinematics(model, q_min=-0.02, q_max=0.02)
    for q, x in zip(*beyond("tendons", 3, 0.005), strict=True):
        tracker = ik.tracker(q)
        steps = [tracker.step(x) for _ in range(1000)]
        assert np.abs(np.diff(steps[-200:], axis=0)).max() < 1e-4 * 0.04


def test_a_path_in_reach_is_followed_as_without_damping(monkeypatch):
    ik = ik_of("trunk")
    phase = 2.0 * np.pi * np.arange(60)[:, None] / 60
    path = np.hstack([0.1 * np.cos(phase), 0.1 * np.sin(phase), 0.7 + 0.0 * phase])
    q0 = ik.solve(path[0]).q
    found = ik.track(torch.from_numpy(path), q0=torch.from_numpy(q0))
    monkeypatch.setattr("hybridkin.ik._rest.Rest.least", lambda rest, e: 0.0 * e[:, 0])
    plain = ik.track(torch.from_numpy(path), q0=torch.from_numpy(q0))
    assert torch.equal(found.q, plain.q)


# Singular configurations.

SINGULAR = {
    "tendons": (TENDONS, -0.02, 0.02, np.zeros(6)),
    "trunk": (TRUNK, 0.1, 0.4, np.full(9, 0.25)),
    "stretched trunk": (TRUNK, 0.1, 0.4, np.full(9, 0.4)),
    "arm": (SIX, -2.5, 2.5, np.zeros(6)),
    "pose": (PoseTask(SIX), -2.5, 2.5, np.zeros(6)),
}


def moved_in(x, distance):
    """A target with the tip moved towards the base."""
    goal = x.copy()
    point = goal[:3, 3] if goal.ndim == 2 else goal
    point -= distance * point / np.linalg.norm(point)
    return goal


@pytest.mark.parametrize("limits", [{}, {"dq_max": 0.5}])
@pytest.mark.parametrize(
    "backend", [np.asarray, pytest.param(torch.from_numpy, marks=pytest.mark.slow)]
)
@pytest.mark.parametrize("name", SINGULAR)
def test_a_singular_configuration_is_left(name, backend, limits):
    model, low, high, q = SINGULAR[name]
    limits = {key: share * (high - low) for key, share in limits.items()}
    ik = InverseKinematics(model, q_min=low, q_max=high, **limits)
    x = np.asarray(ik.solve(ik.settings.evaluate(torch.from_numpy(q)[None])[0].numpy()[0], q).x)
    for distance in (0.005, 0.03):
        goal = moved_in(x, distance)
        if ik.solve(goal).status != IKStatus.CONVERGED:
            continue
        tracker = ik.tracker(backend(q))
        for _ in range(120):
            tracker.step(backend(goal))
        assert tracker.error < 1e-4


@pytest.mark.parametrize("backend", [np.asarray, torch.from_numpy])
@pytest.mark.parametrize("name", ["tendons", "stretched trunk", "arm"])
def test_a_stretched_robot_stays_where_the_target_is_beyond(name, backend):
    model, low, high, q = SINGULAR[name]
    ik = InverseKinematics(model, q_min=low, q_max=high, beta=0.0)
    x = ik.step(q, np.zeros(3)).x
    tracker = ik.tracker(backend(q))
    for _ in range(20):
        end = tracker.step(backend(moved_in(x, -0.05)))
    np.testing.assert_allclose(np.asarray(end), q, rtol=0, atol=1e-9 * (high - low))
    assert tracker.status in (IKStatus.SINGULAR, IKStatus.AT_LIMITS)
