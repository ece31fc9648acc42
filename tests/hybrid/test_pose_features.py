import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, robots
from hybridkin.hybrid._features import Features, PoseFeatures

TURNED = torch.tensor(
    [[0.0, -1.0, 0.0, 0.3], [0.6, 0.0, -0.8, 0.1], [0.8, 0.0, 0.6, -0.2], [0.0, 0.0, 0.0, 1.0]],
    dtype=torch.float64,
)


def elastic(**options):
    stiffness = dict(bending_stiffness=[4e-7, 3e-7, 2e-7], axial_stiffness=5.0)
    options = dict(routing="base", tendon_zeros=0.001, **stiffness, **options)
    return ElasticTendonChain([0.005] * 3, [0.06, 0.05, 0.04], offsets=0.005, **options)


ROBOTS = {
    "trunk": lambda: (robots.bionic_handling_assistant(), 0.25, 0.05),
    "turned trunk, steered at 1.5": lambda: (
        robots.bionic_handling_assistant().with_geometry(base=TURNED).with_tip(1.5),
        *(0.25, 0.05),
    ),
    "one segment of chambers": lambda: (ConstantCurvatureChain([0.03], base=TURNED), 0.2, 0.05),
    "cables": lambda: (
        ConstantCurvatureChain([0.01] * 3, lengths=[0.1, 0.08, 0.06], offsets=[0.01, 0.0, 0.02]),
        *(0.0, 0.005),
    ),
    "one segment of cables": lambda: (ConstantCurvatureChain([0.01], lengths=[0.1]), 0.0, 0.005),
    "elastic tendons": lambda: (elastic(), 0.0, 0.002),
}
every_robot = pytest.mark.parametrize("robot", ROBOTS)


def uniform(rng, *shape):
    return 2.0 * torch.rand(*shape, generator=rng, dtype=torch.float64) - 1.0


def rows_of(robot, rng, n):
    """Return a chain and rows: the first straight, or nearly, the second beside it."""
    chain, middle, width = ROBOTS[robot]()
    move = width * uniform(rng, n, chain.n_actuators)
    move[0] = 0.0
    move[1] *= 1e-6
    return chain, middle + move


def features_of(chain, q):
    return PoseFeatures.of_range(q, chain)


def expected_features(chain, q):
    """Return axes and moments from the poses of the chain, by vector products."""
    poses = torch.linalg.solve(chain.base, chain.poses(q))
    R, p = poses[..., :3, :3], poses[..., :3, 3] / chain.reach
    lever = p[..., -1:, :] - p
    parts = [torch.ones_like(q[..., :1]), Features.of_range(q)(q)[..., 1:], lever[..., 0, :]]
    for s in range(1, chain.n_segments + 1):
        axes = R[..., s, :, :].mT
        parts.append(axes.flatten(-2))
        if s < chain.n_segments:
            moments = torch.linalg.cross(axes, lever[..., s, None, :].expand_as(axes), dim=-1)
            parts.append(moments.flatten(-2))
    return torch.cat(parts, -1)


@every_robot
def test_values_are_axes_and_moments_of_the_poses(robot, rng):
    chain, q = rows_of(robot, rng, 30)
    phi = features_of(chain, q)(q)
    S = chain.n_segments
    assert phi.shape == (30, 1 + chain.n_actuators + 9 * S + 3 + 9 * (S - 1))
    assert_close(phi, expected_features(chain, q), atol=1e-13, rtol=0)
    assert phi.abs().max() < 2.0


@every_robot
def test_slope(robot, rng):
    chain, q = rows_of(robot, rng, 12)
    features = features_of(chain, q)
    weights = uniform(rng, 5, features(q).shape[1])
    value, slope = features.readout(q, weights)
    assert_close(value, features(q) @ weights.mT, atol=1e-12, rtol=0)
    exact = [
        torch.autograd.functional.jacobian(lambda q: features(q) @ weights.mT, row) for row in q
    ]
    assert_close(slope, torch.stack(exact), atol=1e-10, rtol=1e-9)


def test_turning_the_base_turns_nothing(rng):
    chain, q = rows_of("trunk", rng, 20)
    turned = chain.with_geometry(base=TURNED)
    assert_close(features_of(turned, q)(q), features_of(chain, q)(q), atol=0, rtol=0)


def test_size_of_the_robot_changes_nothing(rng):
    q = 0.2 + 0.03 * uniform(rng, 10, 6)
    small = ConstantCurvatureChain([0.03, 0.02], offsets=0.01)
    large = ConstantCurvatureChain([0.3, 0.2], offsets=0.1)
    assert_close(features_of(small, q)(q), features_of(large, 10 * q)(10 * q))
