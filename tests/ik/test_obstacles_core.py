"""Obstacles in the compiled core: its steps are those of torch, and keep the body clear."""

import math
import pickle

import numpy as np
import pytest
import torch
from operators import operators, with_hysteresis

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    IKStatus,
    InverseKinematics,
    obstacles,
    robots,
)
from hybridkin._core.kernel_numbers import IK_PAIRS_MOST
from hybridkin.ik.tasks import PointsTask, PoseTask

pytestmark = pytest.mark.needs_core

TRUNK = robots.bionic_handling_assistant()
TENDONS = {"lengths": [0.08, 0.08, 0.06], "routing": "base"}
# Robot, and limits of q.
ROBOTS = {
    "trunk": (TRUNK, 0.15, 0.35),
    "one segment": (ConstantCurvatureChain([0.1]), 0.1, 0.4),
    "tendons": (ConstantCurvatureChain([0.012, 0.010, 0.008], **TENDONS), -0.02, 0.02),
    "elastic": (ElasticTendonChain([0.012, 0.010, 0.008], **TENDONS), -0.02, 0.005),
}
LAWS = {
    "speed": {},
    "acceleration": {"ddq_max": 20.0},
    "weights": {"weights": 4.0, "beta": 0.0},
    "half-spaces": {"tip_limits": True},
    "all": {"ddq_max": 20.0, "weights": 0.5, "tip_limits": True, "gain": 20.0},
}


def scene_about(draw, points, size, count):
    """Return random obstacles of every kind beside points."""
    scene = []
    for k in range(count):
        center = points[draw.integers(len(points))] + 0.15 * size * draw.standard_normal(3)
        turn, _ = np.linalg.qr(draw.standard_normal((3, 3)))
        turn *= np.sign(np.linalg.det(turn))
        way = draw.standard_normal(3)
        made = [
            obstacles.Sphere(center, size * draw.uniform(0.01, 0.08)),
            obstacles.Capsule(center, center + 0.3 * size * way, 0.02 * size),
            obstacles.Box(center, size * draw.uniform(0.02, 0.2, 3), turn, radius=0.01 * size),
            obstacles.HalfSpace(way, float(way @ center) - 0.2 * size * np.linalg.norm(way)),
        ]
        scene.append(made[k % len(made)])
    return scene


def balls(n_segments, count, radius):
    """Return points of a body, the last one its tip."""
    return [(float(at), radius) for at in np.linspace(0.0, n_segments, count + 1)[1:]]


def case(name, law, draw, count=4, **more):
    """Return inverse kinematics among obstacles, and rows of q and of targets."""
    chain, low, high = ROBOTS[name]
    q = draw.uniform(low, high, (40, chain.n_actuators))
    x = chain(torch.from_numpy(q)).numpy()
    size = float(chain.reach)
    options = {"dq_max": 2.0 * (high - low), **LAWS[law], **more}
    for key in ("ddq_max",):
        if key in options:
            options[key] = options[key] * (high - low)
    if options.get("tip_limits"):
        options["tip_limits"] = ([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [x[:, 2].mean(), 0.3 * size])
    options.setdefault("obstacles", scene_about(draw, x, size, count))
    options.setdefault("body_points", balls(chain.n_segments, 5, 0.03 * size))
    return InverseKinematics(chain, q_min=low, q_max=high, **options), q, x[::-1].copy()


def gaps(ik, q):
    clear = ik.settings.clear
    return clear.smallest(torch.from_numpy(np.atleast_2d(q)), clear.scene).numpy()


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ROBOTS)
def test_steps_are_those_of_torch(name, law):
    draw = np.random.default_rng(0)
    seen = 0
    for _ in range(3):
        ik, q, x = case(name, law, draw)
        ours = ik.step(q, x)
        theirs = ik.step(torch.from_numpy(q), torch.from_numpy(x))
        free = gaps(ik, q) > 0.0  # else rows may contradict the bounds
        seen += free.sum()
        np.testing.assert_allclose(ours.dq[free], theirs.dq.numpy()[free], rtol=0.0, atol=1e-9)
        single = np.stack([ik.step(*rows).dq for rows in zip(q[:5], x[:5], strict=True)])
        np.testing.assert_array_equal(single, ours.dq[:5])
    assert seen > 20


@pytest.mark.parametrize(
    ("kind", "ddq_max"), [("creep", 20.0), ("play", None), ("plays, creep", None)]
)
def test_a_stream_with_hysteresis_and_moving_obstacles_is_that_of_torch(kind, ddq_max):
    model = with_hysteresis(TRUNK, operators(9, 0.01)[kind])
    ball = obstacles.Sphere([0.4, 0.0, 0.7], 0.05)
    wall = obstacles.HalfSpace([0.0, -1.0, 0.0], -0.4)
    ik = InverseKinematics(
        model,
        q_min=0.15,
        q_max=0.35,
        dq_max=0.4,
        ddq_max=ddq_max,
        obstacles=[ball, wall],
        body_points=balls(3, 4, 0.05),
    )
    q0 = np.full(9, 0.25)
    ours, theirs = ik.tracker(q0), ik.tracker(torch.from_numpy(q0))
    assert ours.backend == "compiled"
    seen = set()
    for k in range(24):
        moved = [ball.moved([0.2 - 0.001 * k, 0.02 * math.sin(0.1 * k), 0.7]), wall]
        ours.obstacles = theirs.obstacles = moved
        target = np.array([0.4, 0.1 * (k % 8 < 4), 0.72])
        a, b = ours.step(target), theirs.step(target).numpy()
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-8)
        assert ours.status is theirs.status
        seen.add(ours.status)
    assert IKStatus.BLOCKED in seen


def test_more_pairs_than_rows():
    draw = np.random.default_rng(2)
    more = {"body_points": balls(3, 8, 0.02)}
    ik, q, x = case("trunk", "speed", draw, count=9, **more)
    assert 8 * 9 > IK_PAIRS_MOST
    ours = ik.step(q, x)
    theirs = ik.step(torch.from_numpy(q), torch.from_numpy(x))
    free = gaps(ik, q) > 0.0
    assert free.sum() > 3
    np.testing.assert_allclose(ours.dq[free], theirs.dq.numpy()[free], rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["trunk", "elastic"])
def test_ticks_from_a_free_start_never_enter_an_obstacle(name, law):
    draw = np.random.default_rng(3)
    blocked = 0
    for _ in range(4):
        ik, q, x = case(name, law, draw)
        starts = np.nonzero(gaps(ik, q) > 0.0)[0]
        if len(starts) == 0:
            continue
        settings = ik.settings
        tracker = ik.tracker(q[starts[0]])
        rows = [tracker.q]
        for k in range(120):
            rows.append(tracker.step(x[k // 30]))
            blocked += tracker.status is IKStatus.BLOCKED
        rows = np.stack(rows)
        changes = np.diff(rows, axis=0, n=2, prepend=rows[:1])
        quickest = settings.ddq_max.numpy() * settings.dt**2
        assert (np.abs(changes) <= quickest * (1.0 + 1e-9)).all()
        between = 0.5 * (rows[1:] + rows[:-1])
        assert gaps(ik, rows).min() >= -1e-9
        assert gaps(ik, between).min() >= -1e-6
        assert (rows >= settings.q_min.numpy()).all()
        assert (rows <= settings.q_max.numpy()).all()
        fastest = settings.dq_max.numpy() * settings.dt
        assert (np.abs(np.diff(rows, axis=0)) <= fastest * (1.0 + 1e-12)).all()
    assert blocked > 20


@pytest.mark.parametrize("task", ["pose", "points"])
def test_other_tasks_keep_the_body_clear(task):
    tasks = {"pose": PoseTask(TRUNK), "points": PointsTask(TRUNK, [1.5, 3.0])}
    wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.2)
    points = balls(3, 4, 0.03)
    limits = {"q_min": 0.15, "q_max": 0.35, "dq_max": 2.0}
    ik = InverseKinematics(tasks[task], obstacles=[wall], body_points=points, **limits)
    q0 = np.full(9, 0.25)
    bent = np.array([0.15, 0.3, 0.3] * 3)
    target = ik.settings.task.evaluate(torch.from_numpy(bent)[None])[0][0].numpy()
    ours, theirs = ik.tracker(q0), ik.tracker(torch.from_numpy(q0))
    assert ours.backend == "compiled"
    for _ in range(25):
        a, b = ours.step(target), theirs.step(torch.from_numpy(target)).numpy()
        np.testing.assert_allclose(a, b, rtol=0.0, atol=1e-8)
        assert gaps(ik, a).min() >= -1e-9
    assert ours.status is IKStatus.BLOCKED


@pytest.mark.parametrize("law", ["speed", "acceleration"])
def test_what_is_not_known_holds_the_robot(law):
    ik, q, x = case("trunk", law, np.random.default_rng(4))
    start = q[gaps(ik, q).argmax()]
    tracker, other = ik.tracker(start), ik.tracker(start)
    scene = tracker._robot.scene
    unknown = scene.clone()
    unknown[0, 0] = math.nan
    for _ in range(3):
        tracker._robot.scene = unknown
        np.testing.assert_array_equal(tracker.step(x[0]), start)
        tracker._robot.scene = scene
        np.testing.assert_array_equal(tracker.step([math.nan] * 3), start)
    assert tracker.status is IKStatus.INVALID_INPUT
    for _ in range(5):
        np.testing.assert_array_equal(tracker.step(x[0]), other.step(x[0]))


def test_a_copy_of_a_tracker_sees_obstacles_where_they_are():
    ball = obstacles.Sphere([0.5, 0.0, 0.7], 0.1)
    options = {"q_min": 0.15, "q_max": 0.35, "dq_max": 1.0, "body_points": balls(3, 4, 0.03)}
    ik = InverseKinematics(TRUNK, obstacles=[ball], **options)
    tracker = ik.tracker(np.full(9, 0.25))
    moved = ball.moved([0.2, 0.0, 0.75])
    tracker.obstacles = [moved]
    target = np.array([0.3, 0.0, 0.7])
    tracker.step(target)
    copy = pickle.loads(pickle.dumps(tracker))
    assert copy.obstacles[0].center.tolist() == moved.center.tolist()
    for _ in range(20):
        np.testing.assert_array_equal(copy.step(target), tracker.step(target))
    assert tracker.status is IKStatus.BLOCKED


def test_the_way_to_a_stop_does_not_pass_through_obstacles():
    """Fast and heavy: where every actuator stops by itself, the way is bent."""
    draw = np.random.default_rng(5)
    worst = math.inf
    for _ in range(12):
        points = balls(3, 4, 0.03)
        more = {"dq_max": None, "ddq_max": 5.0, "beta": 0.0, "body_points": points}
        ik, q, x = case("trunk", "speed", draw, **more)
        free = np.nonzero(gaps(ik, q) > 0.0)[0]
        if len(free) == 0:
            continue
        tracker = ik.tracker(q[free[0]])
        rows = [tracker.step(x[k // 25]) for k in range(200)]
        worst = min(worst, gaps(ik, np.stack(rows)).min())
    assert worst >= -1e-9
