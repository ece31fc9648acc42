"""The robot behind a live view: targets, commands, rest and what is said of them."""

import threading

import numpy as np
import pytest

from hybridkin import (
    ConstantCurvatureChain,
    ForwardModel,
    HybridForwardModel,
    Hysteresis,
    obstacles,
    open_model,
    robots,
)
from hybridkin.app.viewer.steered import RATE, SteeredRobot
from hybridkin.app.workflow import path_limits


def steered(model, **limits):
    if isinstance(model, ForwardModel):
        model = open_model(model)
    return SteeredRobot(model, path_limits(model, **limits))


@pytest.fixture
def trunk():
    return steered(robots.bionic_handling_assistant(), q_min=0.1, q_max=0.4)


def run(robot, ticks):
    """Tick at most so often; return how often the robot moved."""
    return sum(robot.tick() for _ in range(ticks))


def test_the_tip_reaches_a_target_and_then_rests(trunk):
    trunk.follow(trunk.x + np.array([0.1, 0.05, -0.02]))
    assert not trunk.situation.reached
    moved = run(trunk, 400)
    assert trunk.situation.reached
    assert trunk.situation.words == "On target."
    assert trunk.situation.error < 1e-3 * trunk.size
    assert moved < 400
    before = trunk.q.copy()
    assert run(trunk, 5) == 0
    assert (trunk.q == before).all()


def test_limits_of_position_and_speed_are_kept():
    robot = steered(robots.bionic_handling_assistant(), q_min=0.2, q_max=0.3, dq_max=0.05)
    q = [robot.q]
    for target in ([0.5, 0.0, 0.5], [-0.5, 0.2, 0.6]):
        robot.follow(target)
        for _ in range(100):
            robot.tick()
            q.append(robot.q)
    robot.go_to(np.full(9, 1.0))
    for _ in range(200):
        robot.tick()
        q.append(robot.q)
    assert np.min(q) >= 0.2
    assert np.max(q) <= 0.3
    assert np.abs(np.diff(q, axis=0)).max() <= 0.05 / RATE * (1.0 + 1e-9)
    assert (robot.q == 0.3).all()


def test_a_command_moves_the_actuators_and_a_target_takes_over_from_there(trunk):
    goal = np.linspace(0.2, 0.3, 9)
    trunk.go_to(goal)
    run(trunk, 100)
    assert trunk.q == pytest.approx(goal)
    assert trunk.target == pytest.approx(trunk.x)
    assert np.isnan(trunk.situation.error)
    before = trunk.q
    trunk.follow(trunk.x + np.array([0.0, 0.0, 0.01]))
    trunk.tick()
    assert np.abs(trunk.q - before).max() < 0.02


@pytest.mark.slow
def test_commands_lead_the_play_and_are_in_the_unit_of_the_log():
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.01], lengths=[0.1])
    bends = 0.002 * rng.uniform(-1, 1, (60, 2))
    angles = 2 * np.pi / 3 * np.arange(3)
    q = bends @ np.stack([np.cos(angles), np.sin(angles)])
    model = HybridForwardModel(chain, "drop", hysteresis=0.0004)
    x = HybridForwardModel(chain, "drop").fit(q, np.zeros((60, 3))).predict(q)
    robot = steered(model.fit(q, x, groups=np.arange(60) // 20))
    for sign in (1.0, -1.0):
        robot.go_to(robot.q + sign * np.array([5e-4, -2.5e-4, -2.5e-4]))
        run(robot, 200)
    commands = robot.commands()
    motion, _ = Hysteresis.backlash(0.0004).apply(commands)
    assert motion[-1] == pytest.approx(robot.q, abs=1e-12)
    assert np.abs(commands[-1] - robot.q).max() == pytest.approx(0.0002)


def test_threads_may_steer_at_the_same_time(trunk):
    rng = np.random.default_rng(0)
    targets = trunk.x + rng.uniform(-0.2, 0.2, (200, 3))
    goals = rng.uniform(0.1, 0.4, (200, 9))
    threads = [
        threading.Thread(target=lambda: [trunk.follow(x) for x in targets]),
        threading.Thread(target=lambda: [trunk.go_to(q) for q in goals]),
        threading.Thread(target=lambda: run(trunk, 200)),
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert np.isfinite(trunk.commands()).all()
    assert (trunk.q >= 0.1).all()
    assert (trunk.q <= 0.4).all()


# Obstacles


def among(scene, **options):
    model = open_model(robots.bionic_handling_assistant())
    limits = path_limits(model, q_min=0.1, q_max=0.4)
    return SteeredRobot(model, limits, scene, **options)


BALL = obstacles.Sphere([0.35, 0.0, 0.55], 0.1)
FLOOR = obstacles.HalfSpace([0.0, 0.0, 1.0], -0.2)


def test_the_body_keeps_clear_of_obstacles_and_the_robot_says_what_is_in_the_way():
    robot = among([BALL, FLOOR], clearance=0.01)
    robot.follow(BALL.center.numpy())
    least = []
    for _ in range(400):
        if not robot.tick():
            break
        least.append(robot.distances[0])
    assert min(least) > 0.01 - 1e-6
    assert least[-1] < 0.02
    assert robot.situation.words.startswith("BLOCKED: an obstacle is in the way")
    assert robot.situation.out_of_reach


def test_obstacles_that_move_push_the_body_away():
    robot = among([BALL, FLOOR])
    robot.follow(robot.x)
    run(robot, 100)
    before = robot.q.copy()
    robot.move_obstacle(0, robot.x + np.array([0.12, 0.0, 0.0]))
    assert robot.distances[0] < -0.01
    assert run(robot, 300) > 5
    assert robot.distances[0] > -1e-6
    assert (robot.q != before).any()
    np.testing.assert_array_equal(robot.obstacles[1].center, FLOOR.center)


@pytest.mark.parametrize(
    "place", [[np.nan] * 3, [0.0, np.inf, 0.0], [1e9, 0.0, 0.0], [0.0, 0.0], [[0.0]] * 3, 1.0]
)
def test_obstacles_stay_where_no_place_is_given(place):
    robot = among([BALL])
    robot.move_obstacle(0, place)
    np.testing.assert_array_equal(robot.obstacles[0].center, BALL.center)
