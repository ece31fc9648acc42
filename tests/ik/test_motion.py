"""Limits of motion: acceleration of the actuators, and half-spaces in which the tip stays."""

import numpy as np
import pytest
import torch
from scipy.optimize import nnls

from hybridkin import ConstantCurvatureChain, InverseKinematics, robots
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PositionTask

TRUNK = robots.bionic_handling_assistant()
TENDONS = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3, routing="base")
CHAINS = [(TRUNK, 0.1, 0.4), (TENDONS, -0.02, 0.02), (ConstantCurvatureChain([0.1]), 0.1, 0.4)]
HOME = np.full(9, 0.25) + 0.01 * np.cos(np.arange(9))
NAN = np.full(3, np.nan)
STRAIGHT = PositionTask.from_numpy(
    lambda q: q + 0.0, lambda q: np.broadcast_to(np.eye(3), (*q.shape, 3)).copy()
)


def limited(draw, chain, low, high):
    """Return inverse kinematics with tight limits, in units of the range of q."""
    n, span = chain.n_actuators, high - low
    return InverseKinematics(
        chain,
        q_min=low + 0.2 * span * draw.random(n),
        q_max=high - 0.2 * span * draw.random(n),
        dq_max=span * 10.0 ** draw.uniform(-1.0, 1.0, n),
        ddq_max=span * 10.0 ** draw.uniform(-1.0, 3.0) * draw.uniform(0.3, 1.0, n),
        dt=10.0 ** draw.uniform(-3.0, -1.0),
        beta=draw.choice([0.0, 1.0]),
        weights=None if draw.random() < 0.5 else draw.uniform(0.3, 3.0, n),
    )


def runs(draw, n_runs, n_ticks):
    """Yield q, the step before and after, and the target, of trackers with targets out of reach."""
    for k in range(n_runs):
        chain, low, high = CHAINS[k % 3]
        ik = limited(draw, chain, low, high)
        s = ik.settings
        tracker = ik.tracker(draw.uniform(s.q_min, s.q_max))
        home, before, q = tracker.x, np.zeros(chain.n_actuators), tracker.q
        for i in range(n_ticks):
            if i % 10 == 0:
                far = (high - low) * 10.0 ** draw.uniform(-2.0, 0.5)
                target = home + far * draw.standard_normal(3)
            new = tracker.step(target)
            yield ik, q, before, new - q, target
            q, before = new, new - q
        while np.abs(before).max() > 0.0:  # an unknown target: it brakes until it stands
            new = tracker.step(NAN)
            yield ik, q, before, new - q, NAN
            q, before = new, new - q


def assert_within_limits(ik, q, before, dq):
    s, dt = ik.settings, ik.settings.dt
    low, high, fast, hard = (a.numpy() for a in (s.q_min, s.q_max, s.dq_max, s.ddq_max))
    rounding = 1e-15
    assert ((q + dq >= low) & (q + dq <= high)).all()  # to the last bit
    assert (np.abs(dq) <= fast * dt + rounding).all()
    assert (np.abs(dq - before) <= hard * dt**2 + rounding).all()


@pytest.mark.slow
def test_random_tracks_keep_all_limits_and_stop():
    draw, braked = np.random.default_rng(0), 0
    for ik, q, before, dq, target in runs(draw, 100, 40):
        assert_within_limits(ik, q, before, dq)
        braked += np.isnan(target).any()
    assert braked > 100


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


def test_the_nearest_point_within_half_spaces():
    """By the conditions of optimality, with redundant and nearly parallel planes."""
    draw = np.random.default_rng(0)
    for _ in range(10):
        k = draw.integers(1, 9)
        A, b = draw.standard_normal((k, 3)), draw.uniform(0.0, 1.0, k)
        ik = InverseKinematics(TRUNK, tip_limits=(A, b))
        x = 2.0 * draw.standard_normal((4, 3))
        found = ik.settings.allowed(torch.from_numpy(x)).numpy()
        assert (found @ A.T <= b + 1e-12).all()
        for start, end in zip(x, found, strict=True):
            touched = A[A @ end > b - 1e-9]  # the way is a sum of normals, with shares >= 0
            left = nnls(touched.T, start - end)[1] if len(touched) else np.abs(start - end).max()
            assert left < 1e-9
        inner = torch.from_numpy(1e-3 * b.min() * x)
        np.testing.assert_array_equal(ik.settings.allowed(inner), inner)


def plane(distance):
    """Return a plane before the tip at HOME, and the distances of points behind it."""
    normal, x = np.array([1.0, 0.3, 0.2]), TRUNK(torch.from_numpy(HOME)).numpy()
    offset = normal @ x + distance * np.linalg.norm(normal)
    return ([normal], [offset]), lambda x: (x @ normal - offset) / np.linalg.norm(normal)


@pytest.mark.slow
def test_a_track_slides_along_a_plane():
    """The tip follows the nearest allowed points, and leaves the plane by micrometres only."""
    phase = np.linspace(0.0, 2.0 * np.pi, 251)
    loop = np.stack([np.sin(phase), np.cos(phase) - 1.0, 0.4 * np.sin(2.0 * phase)], axis=1)
    path, (limits, beyond) = TRUNK(torch.from_numpy(HOME)).numpy() + 0.15 * loop, plane(0.05)
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, dt=0.02, tip_limits=limits)
    track = ik.track(path, q0=HOME)
    allowed = ik.settings.allowed(torch.from_numpy(path)).numpy()
    assert (beyond(path) > 0.01).mean() > 0.2
    assert beyond(track.x).max() < 5e-6
    assert np.linalg.norm(track.x - allowed, axis=1).max() < 5e-5
    out = beyond(path) > 1e-3
    assert (track.status[out] == IKStatus.AT_LIMITS).all()
    assert (track.status[~out & (beyond(path) < -1e-3)] == IKStatus.CONVERGED).all()
    slow = InverseKinematics(
        TRUNK, q_min=0.1, q_max=0.4, dq_max=0.05, ddq_max=0.2, dt=0.02, tip_limits=limits
    ).track(path, q0=HOME)
    assert beyond(slow.x).max() < 5e-6
    assert np.ptp(slow.x @ np.array([0.0, 1.0, 0.0])) > 0.05  # it does not stop at the plane
    assert ik.tracker(HOME).backend == "compiled"


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


def test_solutions_near_targets_out_of_reach_obey_too():
    """The nearest point of the workspace lies outside a half-space that holds the target."""
    target = np.array([[0.6, 0.0, 1.3], [2.0, 0.0, 0.5]])
    nearest = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4).solve(target).x[:, 2].max()
    upper = ([[0.0, 0.0, -1.0]], [-nearest - 0.03])
    found = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, tip_limits=upper).solve(target)
    assert (found.status == IKStatus.UNREACHABLE).all()
    assert (found.x[:, 2] >= nearest + 0.03 - 1e-4).all()


@pytest.mark.parametrize(("dq_max", "ddq_max"), [(None, None), (5.0, None), (1.0, None), (5.0, 90)])
def test_two_planes_and_the_limits_of_q_hold_together(dq_max, ddq_max):
    """Of a linear model a step ends within the planes, or from outside no further from them."""
    draw, planes, offsets = (
        np.random.default_rng(0),
        [[1.0, 0.2, 0.1], [0.1, 1.0, -0.3]],
        [1.0, 0.8],
    )
    A = torch.from_numpy(draw.standard_normal((3, 5)))
    model = (lambda q: q @ A.T, lambda q: A.expand(*q.shape[:-1], 3, 5))
    options = {"q_min": -1.0, "q_max": 1.0, "dq_max": dq_max, "ddq_max": ddq_max, "q_pref": 0.0}
    ik = InverseKinematics(model, **options, tip_limits=(planes, offsets))
    q = draw.uniform(-1.0, 1.0, (200, 5))
    q[draw.random((200, 5)) < 0.4] = 1.0
    x = q @ A.numpy().T
    q_new = q + ik.step(q, x + draw.standard_normal((200, 3))).dq
    before, after = (offsets - tips @ np.transpose(planes) for tips in (x, q_new @ A.numpy().T))
    assert (before < 0.0).any(axis=1).sum() > 50
    assert (after >= np.minimum(before, 0.0) - 1.5e-14).all()
    assert (np.abs(q_new) <= 1.0).all()
    assert np.abs(q_new - q).max() <= 0.01 * (dq_max or np.inf) + 1e-15
    assert (np.abs(q_new - q).max(axis=1) > 1e-6).mean() > 0.9  # most of them move
