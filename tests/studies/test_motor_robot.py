from dataclasses import replace

import numpy as np
import pytest
import torch
from motor_robot import COMMANDS, MotorRobot
from motor_tracks import directions

from hybridkin import datasets, robots


@pytest.fixture(scope="module")
def robot():
    return MotorRobot.random(0)


def floating(robot):
    return replace(robot, gravity=np.zeros(3))


def test_forces_balance_and_no_other_shape_has_less_energy(robot):
    rng = np.random.default_rng(0)
    pulls = 0.008 * rng.standard_normal((5, 6))
    shapes = robot.shapes(pulls)
    tension = robot.tendon_stiffness * np.maximum(robot.stretches(shapes, pulls), 0.0)
    forces = robot.stiffness * shapes + tension @ robot.paths
    # What is left is the weight: the change of its energy for small changes of shape.
    step = 1e-6 * np.eye(22)[:, None]
    no_springs = replace(
        robot,
        bending_stiffness=np.zeros(2),
        axial_stiffness=np.zeros(2),
        tendon_stiffness=np.zeros(6),
    )

    def weight(at):
        return no_springs.energy(torch.from_numpy(at), torch.from_numpy(pulls)).numpy()

    change = np.stack([weight(shapes + s) - weight(shapes - s) for s in step], axis=1) / 2e-6
    np.testing.assert_allclose(forces + change, 0.0, atol=1e-7)
    assert abs(change).max() > 1e-3
    least = robot.energy(torch.from_numpy(shapes), torch.from_numpy(pulls))
    for _ in range(20):
        other = torch.from_numpy(shapes + 1e-3 * rng.standard_normal(shapes.shape))
        assert (robot.energy(other, torch.from_numpy(pulls)) > least).all()


def test_one_tendon_bends_its_segment_to_a_circle_of_the_moment_it_makes(robot):
    free = replace(floating(robot), pretension=np.full(6, -1.0))  # all tendons far too long
    pulls = np.array([[0.0, 1.004, 0.0, 0.0, 0.0, 0.0]])
    shape = free.shapes(pulls)
    tension = free.tendon_stiffness[1] * free.stretches(shape, pulls)[0, 1]
    bends = shape[0, :20].reshape(2, 5, 2)
    moment = free.bending_stiffness[0] * bends[0] / (free.lengths[0] / 5)
    toward = np.array([np.cos(free.angles[1]), np.sin(free.angles[1])])
    assert tension > 1.0
    np.testing.assert_allclose(moment, tension * free.radii[0] * np.tile(toward, (5, 1)))
    np.testing.assert_allclose(bends[1], 0.0, atol=1e-12)
    # The same arc in closed form, with the straight second segment and tool behind it.
    angle = 5 * np.linalg.norm(bends[0, 0])
    length, ahead = free.lengths[0] + shape[0, 20], free.lengths[1] + shape[0, 21] + free.tool
    sideways = length * (1 - np.cos(angle)) / angle + ahead * np.sin(angle)
    along = length * np.sin(angle) / angle + ahead * np.cos(angle)
    tip = free.in_camera(np.array([*(sideways * toward), along]))
    np.testing.assert_allclose(free.tips_of(pulls)[0], tip, atol=1e-12)


def test_symmetric_robot_has_symmetric_tips(robot):
    angles = np.tile(np.deg2rad([0.0, 120.0, 240.0]), 2)
    same = {name: np.full(6, vars(robot)[name][0]) for name in ("tendon_stiffness", "pretension")}
    even = replace(floating(robot), angles=angles, camera=np.eye(4), **same)
    pulls = 0.005 * np.random.default_rng(1).standard_normal((4, 6))
    mirrored = pulls[:, [0, 2, 1, 3, 5, 4]]
    np.testing.assert_allclose(even.tips_of(mirrored), even.tips_of(pulls) * [1, -1, 1], atol=1e-9)
    x, y = even.tips_of(pulls)[:, :2].T
    turned = even.tips_of(pulls[:, [2, 0, 1, 5, 3, 4]])  # by 120 degrees
    np.testing.assert_allclose(turned[:, 0], -0.5 * x - np.sqrt(0.75) * y, atol=1e-9)
    np.testing.assert_allclose(even.tips_of(np.zeros((1, 6)))[0, :2], 0.0, atol=1e-12)


def test_weight_bends_the_robot_down(robot):
    straight = np.zeros((1, 6))
    sag = robot.tips_of(straight) - floating(robot).tips_of(straight)
    assert -0.03 < sag[0, 2] < -0.001
    assert abs(sag[0, :2]).max() < abs(sag[0, 2])


def test_slack_tendon_does_not_matter(robot):
    pulls = np.array([[0.006, -0.003, -0.003, 0.0, 0.002, -0.002]])
    slack = robot.stretches(robot.shapes(pulls), pulls)[0] < 0.0
    assert slack.any()
    assert not slack.all()
    longer = pulls - 0.004 * slack
    np.testing.assert_allclose(robot.tips_of(longer), robot.tips_of(pulls), atol=1e-9)
    shorter = pulls + 0.004 * slack
    assert np.linalg.norm(robot.tips_of(shorter) - robot.tips_of(pulls)) > 1e-3


def test_backlash_keeps_the_tip_when_a_motor_reverses(robot):
    per_mm = 1e-3 * robot.signs[0] * robot.counts_per_metre[0]
    counts = np.tile(robot.zeros, (5, 1))
    counts[:, 0] += per_mm * np.array([0.0, 2.0, 1.8, 1.71, 1.6])
    tips = robot.tips(counts)
    np.testing.assert_allclose(tips[[2, 3]], tips[[1, 1]], atol=1e-9)
    assert np.linalg.norm(tips[4] - tips[1]) > 1e-4
    # 1.6 mm from above is 1.75 mm behind the backlash; the next call goes on from there.
    half = robot.behind_backlash(robot.pulls(counts))[-1]
    assert half[0] == pytest.approx(1.75e-3)
    held = robot.tips(counts[-1:], start=half)
    np.testing.assert_allclose(held[0], tips[4], atol=1e-9)
    again = robot.tips(counts[-1:])
    assert np.linalg.norm(again - tips[4]) > 1e-4
    stiff = replace(robot, backlash=0.0)
    np.testing.assert_allclose(stiff.behind_backlash(robot.pulls(counts)), robot.pulls(counts))


@pytest.mark.parametrize("commands", COMMANDS)
@pytest.mark.parametrize("tendons", [3, 4])
def test_log_and_description_are_read_with_their_truth(tmp_path, commands, tendons):
    robot = MotorRobot.random(5, tendons_per_segment=tendons)  # signs differ
    options = {"motions": 3, "rows": 12, "commands": commands}
    log = robot.write_log(tmp_path / "log.csv", 5, **options)
    robot.write_description(tmp_path / "robot.toml", 5)
    described = robots.read_description(tmp_path / "robot.toml")
    data = datasets.load_log(tmp_path / "log.csv", **described.log.reading)
    np.testing.assert_allclose(data.q, -robot.signs * log.counts, atol=1e-4)
    np.testing.assert_allclose(data.x, log.tips, atol=1e-6)
    shortening = described.chain.gains.numpy() * (data.q - described.chain.actuator_zeros.numpy())
    np.testing.assert_allclose(shortening, -robot.pulls(log.counts), rtol=0.1, atol=1e-4)
    assert np.array_equal(log.counts, np.round(log.counts)) == (commands != "exact")
    found = directions(log.counts)
    if commands == "rounded":
        assert len(found.still_rms) == 2 * (tendons - 2)  # rounding alone
        np.testing.assert_allclose(found.still_rms, 12**-0.5, rtol=0.5)
    if commands == "exact":
        assert found.still_rms.max() < 0.05 * found.moved_rms.max()
    apart = log.tips - robot.tips(log.counts)
    assert np.sqrt((apart**2).mean()) < (0.01 if commands == "noisy" else 7e-4)


def test_log_that_is_not_balanced_moves_all_directions(tmp_path, robot):
    log = robot.write_log(tmp_path / "log.csv", 0, motions=3, rows=12, balanced=False)
    assert directions(log.counts).still_rms.size == 0


def test_unknown_commands_are_refused(tmp_path, robot):
    with pytest.raises(ValueError, match="`commands` must be one of"):
        robot.write_log(tmp_path / "log.csv", 0, commands="mixed")
