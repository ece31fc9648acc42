"""The hybrid, chain plus learned error (H = 100), against peers: tip and Jacobian in one pass."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import jacobian
from hybridkin.native.library import evaluate

WHAT = "hybrid: tip + J"


def of_numpy(module, q):
    """Return the call that users make with NumPy: compiled where there are kernels."""
    rows = q.numpy().copy()
    return lambda: evaluate(module, rows, jacobian=True)


def test_against_eager_torch(race, hybrids, draw, batch):
    module, q = hybrids[None], draw(batch)
    ours = of_numpy(module, q)
    assert_close(torch.from_numpy(ours()[1]), module.jacobian(q))
    race(f"{WHAT}, NumPy", "eager torch", ours, lambda: module.forward_and_jacobian(q), rows=batch)


def test_against_automatic_derivatives(race, hybrids, draw, batch, autodiff):
    module, q = hybrids[None], draw(batch)
    name, derive, goal = autodiff
    assert_close(module.forward_and_jacobian(q)[1], derive(module, q))
    race(
        WHAT,
        name,
        lambda: module.forward_and_jacobian(q),
        lambda: derive(module, q),
        rows=batch,
        at_least=goal,
    )


def test_against_a_rigid_arm(race, hybrids, draw, arm, batch):
    """Another robot with as many joints: its J has six rows, ours three, with x."""
    module, q = hybrids[None], draw(batch)
    assert module.forward_and_jacobian(q)[1].shape == arm.jacobian(q)[:, :3].shape
    race(
        WHAT,
        "pytorch_kinematics (9 joints): J",
        of_numpy(module, q),
        lambda: arm.jacobian(q),
        rows=batch,
        at_least=4,
    )


@pytest.mark.parametrize("rows", ["training rows", "working box"])
def test_price_of_the_guard(race, hybrids, draw, trunk, batch, rows):
    """On the training rows the guard is at rest; in the box it is at work on a few rows."""
    plain, guarded = hybrids[None], hybrids["leverage"]
    q = draw(batch)
    if rows == "training rows":
        q = torch.from_numpy(trunk.q)[torch.arange(batch) % len(trunk.q)]
    inside = guarded.in_domain(q) & ~guarded.corrections[0].guard.is_long(guarded.error_part(q))
    assert_close(guarded.forward_and_jacobian(q)[1][inside], plain.jacobian(q)[inside])
    race(
        f"{WHAT}, guard, {rows}",
        "without guard",
        of_numpy(guarded, q),
        of_numpy(plain, q),
        rows=batch,
        at_most=1.3,
    )


class ConstantStrainTrunk:
    """The mechanical part alone in soromox: two curvatures and one stretch per segment.

    Its coordinates are affine in the chamber lengths, so both robots must give the same tip and,
    up to one constant matrix, the same Jacobian.
    """

    def __init__(self, chain, length=0.25):
        import jax
        from jax import numpy as jnp
        from soromox import PCS, LinkSpec, PCSStructure

        self.chain, self.length = chain, length
        self.block_until_ready, self.asarray = jax.block_until_ready, jnp.asarray
        link = LinkSpec.circular(
            length=length,
            radius=0.1,
            density=1.0,
            reference_strain=[0.0, 0.0, 0.0, 1.0, 0.0, 0.0],
            young_modulus=1.0,
            poisson_ratio=0.4,
        )
        active = jnp.array([False, True, True, True, False, False] * chain.n_segments)
        structure = PCSStructure(num_gauss_points=1, strain_selector=active)
        robot = PCS.from_links([link] * chain.n_segments, structure=structure)
        end = chain.n_segments * length

        def own(z):
            pose, J = robot.forward_kinematics_and_jacobian_inertialframe(z, end, backend="jax")
            return pose[:3, 3], J[3:]

        def tip(z):
            x = robot.forward_kinematics_tips(z)[-1, :3, 3]
            return x, x

        def jacrev(z):
            J, x = jax.jacrev(tip, has_aux=True)(z)
            return x, J

        self.functions = {
            "own J": jax.jit(jax.vmap(own)),
            "jacrev": jax.jit(jax.vmap(jacrev)),
        }

    def strains(self, q):
        """Return curvatures [rad/m] and stretch [-] of every segment, shape (..., 9)."""
        length, bending = self.chain.arcs(q)
        parts = torch.cat([bending, length[..., None]], dim=-1) / self.length
        return (parts - parts.new_tensor([0.0, 0.0, 1.0])).flatten(-2)


@pytest.fixture(scope="module")
def constant_strain_trunk(chain, one_thread):
    """Jax makes its threads when first used: by then there is one core."""
    jax = pytest.importorskip("jax")
    pytest.importorskip("soromox")
    with jax.enable_x64(True):
        yield ConstantStrainTrunk(chain)


@pytest.mark.parametrize("how", ["own J", "jacrev"])
def test_against_soromox(race, hybrids, chain, draw, batch, constant_strain_trunk, how):
    """Compiled, 3 segments, 9 strains, x and the linear rows of J; ours has the ELM on top."""
    peer = constant_strain_trunk
    module, q = hybrids[None], draw(batch)
    z, function = peer.asarray(peer.strains(q).numpy()), peer.functions[how]
    x, J = (torch.from_numpy(np.array(part)) for part in function(z))
    assert_close(x, chain(q))
    assert_close(J @ jacobian(peer.strains, q[0]), chain.jacobian(q))
    race(
        WHAT,
        f"soromox (no ELM): tip + {how}",
        of_numpy(module, q),
        lambda: peer.block_until_ready(function(z)),
        rows=batch,
        at_least=None if how == "jacrev" else 3 if batch <= 1_000 else 8,
    )
