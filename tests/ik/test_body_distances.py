"""Distances from the body of a robot to obstacles."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, InverseKinematics, obstacles, robots
from hybridkin._core.rotations import rotation

TRUNK = robots.bionic_handling_assistant()
POINTS = [(0.5, 0.1), (1.0, 0.08), (2.0, 0.06), (3.0, 0.05)]
SCENE = [
    obstacles.Sphere([0.3, 0.1, 0.6], 0.07),
    obstacles.Capsule([-0.3, -0.2, 0.2], [-0.2, 0.4, 0.9], 0.03),
    obstacles.Box([0.0, -0.5, 0.5], [0.3, 0.1, 0.4]),
]


def solver(chain=TRUNK, scene=SCENE, **options):
    return InverseKinematics(
        chain, q_min=0.1, q_max=0.4, obstacles=scene, body_points=POINTS, **options
    )


def random_q(n, seed=0):
    return np.random.default_rng(seed).uniform(0.15, 0.35, (n, 9))


def test_a_straight_body_beside_a_wall_and_a_ball():
    wall = obstacles.HalfSpace([-1.0, 0.0, 0.0], -0.3)
    ball = obstacles.Sphere([0.2, 0.0, 0.75], 0.05)
    ik = solver(scene=[wall, ball], clearance=0.02)
    # The straight trunk is 0.75 m long; its tip has the smallest ball.
    distances = ik.body_distances(np.full(9, 0.25))
    np.testing.assert_allclose(distances, [0.3 - 0.1, 0.2 - 0.05 - 0.05], atol=1e-12)


def test_balls_lie_on_the_backbone_and_the_last_one_at_the_tip():
    ik = solver()
    points, radii = ik.body_balls(np.full(9, 0.25))
    np.testing.assert_allclose(radii, [0.1, 0.08, 0.06, 0.05])
    np.testing.assert_allclose(points[:, 2], [0.125, 0.25, 0.5, 0.75], atol=1e-12)
    q = random_q(4)
    points, _ = ik.body_balls(q)
    with torch.no_grad():
        backbone = TRUNK.backbone(torch.from_numpy(q), 2).numpy()
    np.testing.assert_allclose(points, backbone[:, [1, 2, 4, 6]], atol=1e-12)
    nearest = [obstacle.distance(points).numpy() - radii for obstacle in SCENE]
    expected = np.stack([distances.min(axis=1) for distances in nearest], axis=1)
    np.testing.assert_allclose(ik.body_distances(q), expected, atol=1e-12)


def test_a_batch_is_its_rows_in_arrays_and_tensors():
    ik = solver()
    q = random_q(6)
    distances = ik.body_distances(q)
    assert distances.shape == (6, 3)
    for row, expected in zip(q, distances, strict=True):
        np.testing.assert_allclose(ik.body_distances(row), expected, rtol=0.0, atol=1e-12)
    folded = ik.body_distances(torch.from_numpy(q).reshape(2, 3, 9))
    assert isinstance(folded, torch.Tensor)
    np.testing.assert_allclose(folded.numpy(), distances.reshape(2, 3, 3), atol=1e-12)


def test_a_base_that_moves_with_its_obstacles_changes_nothing():
    R, _ = rotation(torch.tensor([0.3, -0.8, 0.5], dtype=torch.float64))
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = R
    base[:3, 3] = torch.tensor([0.2, -0.3, 0.4])
    moved = []
    for obstacle in SCENE:
        center = base[:3, 3] + R @ obstacle.center
        axes = obstacle.axes @ R.T
        moved.append(obstacles.Obstacle(center, axes, obstacle.low, obstacle.high, obstacle.radius))
    radii = [0.1, 0.093, 0.079]
    q = random_q(5)
    plain = solver(ConstantCurvatureChain(radii)).body_distances(q)
    turned = solver(ConstantCurvatureChain(radii, base=base.numpy()), moved).body_distances(q)
    np.testing.assert_allclose(turned, plain, atol=1e-12)


def test_other_obstacles_are_those_of_another_solver():
    ik = solver()
    others = [SCENE[0].moved([0.1, 0.3, 0.5]), SCENE[2]]
    q = random_q(4)
    expected = solver(scene=others).body_distances(q)
    np.testing.assert_array_equal(ik.body_distances(q, others), expected)
    assert ik.body_distances(q, []).shape == (4, 0)


def test_a_row_that_is_not_known_has_no_distance():
    q = random_q(3)
    q[1, 2] = np.nan
    distances = solver().body_distances(q)
    assert np.isnan(distances[1]).all()
    np.testing.assert_allclose(distances[[0, 2]], solver().body_distances(q[[0, 2]]))


def test_a_solver_without_a_body_says_so():
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4)
    with pytest.raises(ValueError, match="`obstacles` or `body_points` must be given"):
        ik.body_distances(np.full(9, 0.25), SCENE)
    with pytest.raises(ValueError, match="`obstacles` or `body_points` must be given"):
        ik.body_balls(np.full(9, 0.25))
