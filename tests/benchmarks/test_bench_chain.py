"""Chains alone: tip and Jacobian in one pass against automatic derivation and another library."""

from functools import partial

import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, RigidChain, jacobian
from hybridkin.native.library import evaluate


@pytest.mark.slow
def test_against_automatic_derivatives(race, chain, draw, batch, autodiff):
    q = draw(batch)
    name, derive, goal = autodiff
    assert_close(chain.forward_and_jacobian(q)[1], derive(chain, q))
    race(
        "chain: tip + J",
        name,
        lambda: chain.forward_and_jacobian(q),
        lambda: derive(chain, q),
        rows=batch,
        at_least=goal,
    )


def test_against_a_rigid_arm(race, chain, draw, arm, batch):
    """Another robot with as many joints: its J has six rows, ours three, with x."""
    q = draw(batch)
    assert chain.jacobian(q).shape == arm.jacobian(q)[:, :3].shape
    race(
        "chain: tip + J",
        "pytorch_kinematics (9 joints): J",
        lambda: chain.forward_and_jacobian(q),
        lambda: arm.jacobian(q),
        rows=batch,
        at_least=4,
    )


@pytest.mark.slow
@pytest.mark.parametrize("what", ["tip", "tip + J"])
def test_tendons_that_can_only_pull(race, batch, what):
    """What slack costs: half of the rows have slack tendons."""
    elastic = ElasticTendonChain([0.0045] * 3, [0.06] * 3)
    plain = ConstantCurvatureChain([0.0045] * 3, lengths=[0.06] * 3, routing="base")
    generator = torch.Generator().manual_seed(0)
    q = 0.01 * (torch.rand(batch, 9, dtype=torch.float64, generator=generator) - 0.5)
    ours, peer, goal = elastic, plain, 5
    if what == "tip + J":
        ours, peer, goal = elastic.forward_and_jacobian, plain.forward_and_jacobian, 4
    assert_close(elastic.jacobian(q), jacobian(lambda q: elastic(q), q))
    race(
        f"elastic tendon chain: {what}",
        "constant-curvature chain",
        lambda: ours(q),
        lambda: peer(q),
        rows=batch,
        at_most=goal,
    )


def test_one_configuration(race, chain, draw, arm):
    q = draw(1)[0]
    x, J = chain.forward_and_jacobian(q)
    assert_close(J, jacobian(lambda q: chain(q), q))
    assert_close(x, chain(q))
    race(
        "chain: tip + J, NumPy",
        "pytorch_kinematics (9 joints): J",
        partial(evaluate, chain, q.numpy(), jacobian=True),
        lambda: arm.jacobian(q),
    )


def test_rigid_chain(race, urdf, arm, batch):
    ours = RigidChain.from_urdf(urdf, "link9")
    q = torch.randn(batch, 9, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    assert_close(ours.forward_and_jacobian(q)[1], arm.jacobian(q)[:, :3])
    race(
        "rigid chain (9 joints): tip + J",
        "pytorch_kinematics (9 joints): J",
        lambda: ours.forward_and_jacobian(q),
        lambda: arm.jacobian(q),
        rows=batch,
    )
