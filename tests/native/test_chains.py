"""The compiled kernels of mechanical models, against the torch modules that they repeat."""

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from operators import operators

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    Hysteresis,
    RigidChain,
)
from hybridkin._core.plan import Plan
from hybridkin.hysteresis.follow import follow_in_numpy, n_state_rows
from hybridkin.native.library import Program

pytestmark = pytest.mark.needs_core
STRAIGHT = 0.25  # [m], actuators of a straight segment
ROUTINGS = ("segment", "base")


def pose_of(rng):
    """Return a random pose."""
    pose = np.eye(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] = turn * np.linalg.det(turn)
    pose[:3, 3] = 0.3 * rng.normal(size=3)
    return pose


def in_torch(chain, q):
    with torch.no_grad():
        return [part.numpy() for part in chain.forward_and_jacobian(torch.from_numpy(q))]


def check(chain, q, tol=1e-13, program=None):
    """Assert that kernels of blocks and of single rows agree with torch, relative to the robot."""
    program = program or Program(Plan(chain.stored()))
    x, J = in_torch(chain, q)
    found = program.evaluate(q, jacobian=True)[:2]
    rows = [program.evaluate(row, jacobian=True)[:2] for row in q[:9]]
    for values, right, single in zip(found, (x, J), zip(*rows, strict=True), strict=True):
        right = right.reshape(len(q), -1)
        size = np.maximum(np.abs(right).max(1, keepdims=True), 1.0)
        assert (np.abs(values.reshape(len(q), -1) - right) <= tol * size).all()
        assert np.abs(values[:9] - np.array(single)).max() <= tol * size.max()
    return found


def check_nan_row(chain, q):
    """Assert that a row with a NaN is NaN and changes no other."""
    program = Program(Plan(chain.stored()))
    broken = q[:13].copy()
    broken[5, -1] = np.nan
    good = np.arange(13) != 5
    parts = zip(program.evaluate(broken, True), program.evaluate(q[:13], True), strict=True)
    for values, right in [*parts][:2]:
        assert np.isnan(values[5]).all()
        assert_array_equal(values[good], right[good])
    for values in program.evaluate(broken[5], True)[:2]:
        assert np.isnan(values).all()


def trunk(rng, counts, **options):
    """Return a random extensible trunk and its actuators for bends of up to 2 rad."""
    radii, n = rng.uniform(0.05, 0.1, len(counts)), sum(counts)
    chain = ConstantCurvatureChain(radii, n_actuators=counts, **options)
    bends = options.get("routing") == "base"
    return chain, STRAIGHT * (1 + bends) + 0.06 * rng.uniform(-1, 1, (203, n))


def elastic(rng, counts, routing):
    """Return random elastic tendons with all that their geometry may have, and commands."""
    S, n = len(counts), sum(counts)
    radii = rng.uniform(0.004, 0.008, S)
    chain = ElasticTendonChain(
        radii,
        rng.uniform(0.05, 0.1, S),
        n_actuators=counts,
        angles=[rng.uniform(0.0, 6.3, count) for count in counts],
        routing=routing,
        bending_stiffness=rng.uniform(0.01, 0.1, S) * radii**2,
        axial_stiffness=rng.uniform(1.0, 100.0, S),
        tendon_zeros=0.002 * rng.normal(size=n),
        rest_bends=0.5 * rng.normal(size=(S, 2)),
        offsets=rng.uniform(0.0, 0.05, S),
        base=pose_of(rng),
    )
    return chain, 0.012 * rng.uniform(-1, 1, (203, n))


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize("counts", [[3], [3, 3], [3, 3, 3], [4, 4], [3, 5, 3, 4], [3] * 16])
def test_arcs(counts, routing):
    rng = np.random.default_rng(len(counts))
    S, n = len(counts), sum(counts)
    chain, q = trunk(
        rng,
        counts,
        routing=routing,
        base=pose_of(rng),
        offsets=rng.uniform(0.0, 0.1, S),
        rest_bends=rng.normal(size=(S, 2)),
        actuator_zeros=0.01 * rng.normal(size=n),
    )
    check(chain, q)
    for tip in {0.4, S - 0.5, float(S - (S > 1))}:
        check(chain.with_tip(tip), q)
    tendons = ConstantCurvatureChain(
        chain.radii, lengths=[0.1] * S, n_actuators=counts, routing=routing
    )
    check(tendons, q - q.mean())
    check_nan_row(chain, q)


@pytest.mark.parametrize("bend", [0.0, 1e-9, 1.0, 3.1415, 3.1417, 3.6, 6.3, 12.6, 1e6])
def test_bends_of_any_size(bend):
    """Around a half turn, where the polynomial ends, and at several turns."""
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.01] * 2, lengths=[0.1] * 2)
    way = rng.uniform(0.0, 2 * np.pi, (40, 2, 1))
    b = bend * np.concatenate([np.cos(way), np.sin(way)], axis=2)
    at = 2 * np.pi * np.arange(3) / 3
    q = (-0.01 * (b @ np.stack([np.cos(at), np.sin(at)]))).reshape(40, 6)
    check(chain, q, 1e-13 * max(bend, 1.0))


@pytest.mark.parametrize("routing", ROUTINGS)
@pytest.mark.parametrize(
    "counts", [[3], [1, 1], [5, 5], [3, 3, 3], [2, 3, 1, 6], [20, 21, 21], [3] * 16]
)
def test_elastic_tendons(counts, routing):
    rng = np.random.default_rng(sum(counts))
    chain, q = elastic(rng, counts, routing)
    check(chain, q, 1e-11)
    check(chain.with_tip(len(counts) - 0.6), q, 1e-11)
    check_nan_row(chain, q)


@pytest.mark.parametrize("n", [1, 3, 7, 30])
def test_rigid_arms(n):
    rng = np.random.default_rng(n)
    arm = RigidChain(
        [pose_of(rng) for _ in range(n)],
        np.concatenate([np.eye(3)[:1], rng.normal(size=(n - 1, 3))]),
        kinds=[("revolute", "prismatic")[k % 3 == 1] for k in range(n)],
        tip=pose_of(rng),
        tool=[0.1, 0.2, 0.3],
        base=pose_of(rng),
    )
    q = rng.uniform(-7, 7, (203, n))
    check(arm, q)
    check_nan_row(arm, q)


@pytest.mark.parametrize(("joints", "n"), [(3, 1), (7, 5), (3, 6)])
def test_coupled_joints_with_zeros(joints, n):
    rng = np.random.default_rng(n)
    arm = RigidChain(
        [pose_of(rng) for _ in range(joints)],
        rng.normal(size=(joints, 3)),
        kinds=[("revolute", "prismatic")[k % 3 == 1] for k in range(joints)],
        couplings=rng.normal(size=(joints, n)),
        joint_zeros=rng.normal(size=n),
        tool=[0.1, 0.2, 0.3],
        base=pose_of(rng),
    )
    q = rng.uniform(-2, 2, (103, n))
    check(arm, q)
    check_nan_row(arm, q)
    twin = HybridForwardModel(arm, "quadratic", coupling="serial")
    x = in_torch(arm, q)[0] + 0.01 * np.sin(q[:, :1])
    check(twin.fit(q, x).module_, q, 1e-11)


@settings(max_examples=20, deadline=None)
@given(
    counts=st.lists(st.integers(3, 6), min_size=1, max_size=5),
    routing=st.sampled_from(ROUTINGS),
    tip=st.floats(0.05, 1.0),
    rows=st.integers(1, 20),
    seed=st.integers(0, 2**32 - 1),
)
def test_random_chains(counts, routing, tip, rows, seed):
    rng, at = np.random.default_rng(seed), tip * len(counts)
    chain, q = trunk(rng, counts, routing=routing, base=pose_of(rng))
    check(chain.with_tip(at), q[:rows])
    chain, q = elastic(rng, counts, routing)
    check(chain.with_tip(at), q[:rows], 1e-11)


@pytest.mark.parametrize("width", [0.0, 0.003, np.linspace(0.0, 0.004, 5)])
def test_play_to_the_bit(width):
    rng = np.random.default_rng(0)
    q = np.cumsum(np.round(rng.normal(size=(400, 5)), 1), 0) * 1e-3
    q[100:110] = q[99]
    play = Hysteresis.backlash(width)
    for way in (play.apply, play.command):
        state = reference = None
        for rows in (q[:1], q[1:200], q[200:]):
            found, state = way(rows, state)
            right, reference = way(torch.from_numpy(rows), reference)
            for ours, theirs in zip((found, state), (right, reference), strict=True):
                assert ours.dtype == np.float64
                assert_array_equal(ours, theirs.numpy())


@pytest.mark.needs_core
@pytest.mark.parametrize("kind", ["play", "plays", "creep", "plays, creep", "creep, play, plays"])
def test_hysteresis_is_that_of_numpy(kind):
    operator = operators(9, 1e-3)[kind]
    q = np.cumsum(1e-3 * np.random.default_rng(0).normal(size=(400, 9)), axis=0)
    steps = np.full(len(q), 0.01)
    rounding = 16.0 * np.finfo(np.float64).eps
    for way, lead in ((operator.apply, False), (operator.command, True)):
        state = np.tile(q[0], (n_state_rows(operator.stages), 1))
        found, end = way(q, dt=steps)
        expected = follow_in_numpy(operator.stages, q, steps, state, lead, rounding)
        np.testing.assert_allclose(found, expected, rtol=0, atol=1e-15)
        again, _ = way(q, end, dt=steps)
        expected = follow_in_numpy(operator.stages, q, steps, state, lead, rounding)
        np.testing.assert_allclose(again, expected, rtol=0, atol=1e-15)
