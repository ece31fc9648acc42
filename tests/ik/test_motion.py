"""Limits of motion: acceleration of the actuators, and half-spaces in which the tip stays."""

import numpy as np
import pytest
import torch

from hybridkin import InverseKinematics, robots
from hybridkin.ik.results import IKStatus

TRUNK = robots.bionic_handling_assistant()
HOME = np.full(9, 0.25) + 0.01 * np.cos(np.arange(9))


def test_the_speed_stops_at_a_limit_whatever_the_periods():
    """A straight trunk that gets longer at full thrust: the closed form, and uneven periods."""
    options = {"q_min": 0.1, "q_max": 0.4, "ddq_max": 0.5}
    ik, start = InverseKinematics(TRUNK, **options), np.full(9, 0.25)
    speed, way, far = np.sqrt(0.5 * 0.15), 2.0 * np.sqrt(0.15 / 0.5), [0.0, 0.0, 9.0]
    q = ik.track([far] * 130, q0=start).q[:, 0]
    # Half of the way with constant acceleration, the other half with constant braking.
    assert np.diff(q).max() / 0.01 == pytest.approx(speed, rel=0.02)
    assert np.argmax(q > 0.4 - 1e-6) * 0.01 == pytest.approx(way, rel=0.05)
    assert q[-1] == 0.4
    periods = 10.0 ** np.random.default_rng(2).uniform(-4.0, -2.0, 1000)
    t = np.concatenate([[0.0], np.cumsum(periods)])
    q = ik.track([far] * 1001, t, q0=start).q[:, 0]
    change = np.diff(np.diff(q) / periods)
    assert q.max() == 0.4
    assert (np.abs(change) <= 0.5 * periods[1:] + 1e-11).all()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["core", "torch"])
@pytest.mark.parametrize(
    "options",
    [{"ddq_max": 5.0}, {"ddq_max": 0.5, "dq_max": 0.05, "beta": 100.0}],
)
def test_the_tip_brakes_before_the_target(kind, options):
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, **options)
    tracker = ik.tracker(kind(HOME))
    start, way = np.asarray(tracker.x), np.array([0.1, 0.05, -0.02])
    gone = []
    for _ in range(150):
        tracker.step(kind(start + way))
        gone.append((np.asarray(tracker.x) - start) @ way / (way @ way))
    assert max(gone) < 1.001
    assert tracker.status is IKStatus.CONVERGED
    assert gone[5] < 0.9  # not in one step


def test_what_cannot_be_stopped_brakes_as_hard_as_it_may():
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, ddq_max=1.0, dq_max=1.0)
    x, fast = TRUNK(torch.from_numpy(HOME)).numpy(), np.full(9, 0.05)
    step = ik.step(HOME, x, dq=fast)
    np.testing.assert_allclose(step.dq, fast - 1e-4, rtol=0.0, atol=1e-17)
    assert step.saturated.all()
    rest = ik.step(HOME, x + 0.1).dq
    np.testing.assert_array_equal(rest, ik.step(HOME, x + 0.1, dq=np.zeros(9)).dq)
    assert np.abs(rest).max() <= 1e-4
    # Outside the limits it is led back, gently.
    outside = HOME + 0.3 * (np.arange(9) == 4)
    tracker = ik.tracker(outside)
    for i in range(1, 4):
        outside = outside - 1e-4 * i * (np.arange(9) == 4)
        assert tracker.step(x)[4] == pytest.approx(outside[4], abs=1e-15)
    off = {"q_min": 0.1, "q_max": 0.4, "limits": "off"}
    free = InverseKinematics(TRUNK, ddq_max=1e-3, tip_limits=([[1, 0, 0]], [-9.0]), **off)
    np.testing.assert_array_equal(
        free.step(HOME, x + 0.1, dq=fast).dq, InverseKinematics(TRUNK, **off).step(HOME, x + 0.1).dq
    )


# ---------------------------------------------------------------- limits of the tip


def plane(distance):
    """Return a plane before the tip at HOME, and the distances of points behind it."""
    normal, x = np.array([1.0, 0.3, 0.2]), TRUNK(torch.from_numpy(HOME)).numpy()
    offset = normal @ x + distance * np.linalg.norm(normal)
    return ([normal], [offset]), lambda x: (x @ normal - offset) / np.linalg.norm(normal)


def test_the_measured_tip_counts():
    limits, beyond = plane(0.02)
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, tip_limits=limits, beta=0.0)
    x = TRUNK(torch.from_numpy(HOME)).numpy()
    off, target = np.array([0.01, 0.0, 0.0]), x + np.array([0.1, 0.0, 0.0])
    tracker = ik.tracker(HOME)
    for _ in range(10):
        seen = TRUNK(torch.from_numpy(tracker.q)).numpy() + off
        tracker.step(target, x_measured=seen)
    seen = TRUNK(torch.from_numpy(tracker.q)).numpy() + off
    assert abs(beyond(seen)) < 1e-9
    assert tracker.status is IKStatus.AT_LIMITS
    step = ik.step(HOME, target, x_measured=x + off)
    moved = TRUNK.jacobian(torch.from_numpy(HOME)).numpy() @ step.dq
    assert abs(beyond(x + off + moved)) < 1e-12
    # Outside, the tip goes back to the plane.
    back = ik.step(HOME, target, x_measured=x + 5.0 * off)
    moved = TRUNK.jacobian(torch.from_numpy(HOME)).numpy() @ back.dq
    assert abs(beyond(x + 5.0 * off + moved)) < 1e-12


def test_solutions_obey_limits_of_the_tip():
    low, high = np.array([-0.1, -0.2, 0.5]), np.array([0.12, 0.2, 0.75])
    box = np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([high, -low])
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, tip_limits=box)
    assert "tip_limits=6 half-spaces" in repr(ik)
    draw = np.random.default_rng(1)
    x = np.concatenate([draw.uniform(low, high, (40, 3)), draw.uniform(-1.5, 1.5, (60, 3))])
    x[50] = np.nan
    found, inside = ik.solve(x, tol=1e-5), ((x >= low) & (x <= high)).all(1)
    known = np.isfinite(x).all(1)
    assert ((found.x >= low - 1e-5) & (found.x <= high + 1e-5))[known].all()
    free = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4).solve(x[inside], tol=1e-5)
    np.testing.assert_array_equal(found.status[inside], free.status)
    assert (found.status[~inside & known] == IKStatus.UNREACHABLE).all()
    assert found.status[50] == IKStatus.INVALID_INPUT
    near = np.linalg.norm(np.clip(x, low, high) - found.x, axis=1)
    assert (near <= 1e-5)[known].mean() > 0.9
    np.testing.assert_allclose(found.error, np.linalg.norm(found.x - x, axis=1), atol=1e-12)
