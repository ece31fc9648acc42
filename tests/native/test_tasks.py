"""Poses, several points and half-spaces of the tip: the compiled core computes what torch does."""

import pickle

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    as_forward_model,
    robots,
)
from hybridkin.ik._compiled import core_of
from hybridkin.ik.tasks import AxisTask, PointsTask, PoseTask, PositionTask

pytestmark = pytest.mark.needs_core

BHA = robots.bionic_handling_assistant()
ANGLES = np.deg2rad([10.0, 25.0, -30.0])
BASE = np.eye(4)
BASE[:3, :3] = Rotation.from_euler("xyz", ANGLES).as_matrix()
BASE[:3, 3] = [0.1, -0.2, 0.3]
TURNED = ConstantCurvatureChain([0.1, 0.09, 0.08], offsets=[0.01, 0.0, 0.05], base=BASE)
ELASTIC = ElasticTendonChain([0.02] * 3, [0.1] * 3)
MARKERS = [(0, 0.5), (1, 1.0), (2, 1.0, (0.0, 0.0, 0.02))]


def log(chain, low, high, rows=60):
    q = np.random.default_rng(0).uniform(low, high, (rows, chain.n_actuators))
    return q, chain(torch.from_numpy(q)).numpy()


def pose_hybrid():
    """A hybrid of the pose, with a guard, for a robot that has changed since."""
    q, x = log(TURNED, 0.2, 0.3)
    turns = Rotation.from_matrix(TURNED.pose(torch.from_numpy(q)).numpy()[:, :3, :3])
    changed = Rotation.from_rotvec(0.05 * np.sin(9.0 * q[:, :3])) * turns
    y = np.hstack([x + 0.01 * np.sin(9.0 * q[:, 3:6]), changed.as_rotvec()])
    model = HybridForwardModel(TURNED, ELMRegressor(9, random_state=0), output="pose").fit(q, y)
    return model, q, y


def fitted_pose():
    return as_forward_model(pose_hybrid()[0])


def adapted_pose():
    model, q, y = pose_hybrid()
    return as_forward_model(model.adapt(q[:20] + 0.002, y[:20]))


def hybrid_of_markers():
    chain = TURNED.with_markers(MARKERS)
    q, x = log(chain, 0.2, 0.3)
    x = x + 0.01 * np.sin(9.0 * q)
    return as_forward_model(HybridForwardModel(chain, ELMRegressor(9, random_state=0)).fit(q, x))


def arm():
    """Six joints of five actuators; the second one slides."""
    draw = np.random.default_rng(1)
    origins = np.tile(BASE, (6, 1, 1))
    origins[:, :3, 3] = draw.uniform(-0.3, 0.3, (6, 3))
    couplings = np.vstack([np.eye(5), [0.0, 0.0, 1.0, 0.0, -1.0]])
    kinds = ["revolute", "prismatic", *["revolute"] * 4]
    axes = draw.standard_normal((6, 3))
    return RigidChain(origins, axes, kinds=kinds, couplings=couplings, tip=BASE, tool=[0.1, 0, 0])


TASKS = {
    "pose of arcs": (lambda: PoseTask(TURNED, radian=0.2), 0.15, 0.35),
    "pose within a segment": (lambda: PoseTask(BHA.with_tip(2.5)), 0.15, 0.35),
    "pose of elastic tendons": (lambda: PoseTask(ELASTIC), -0.01, 0.01),
    "pose of an arm": (lambda: PoseTask(arm()), -2.0, 2.0),
    "pose of a hybrid": (lambda: PoseTask(fitted_pose()), 0.15, 0.35),
    "pose of an adapted hybrid": (lambda: PoseTask(adapted_pose()), 0.15, 0.35),
    "axis of arcs": (lambda: AxisTask(TURNED, [1.0, -2.0, 0.5], length=0.2), 0.15, 0.35),
    "axis within a segment": (lambda: AxisTask(BHA.with_tip(2.5)), 0.15, 0.35),
    "axis of an arm": (lambda: AxisTask(arm(), [1.0, 0.0, 0.0]), -2.0, 2.0),
    "axis of an adapted hybrid": (lambda: AxisTask(adapted_pose()), 0.15, 0.35),
    "points": (lambda: PointsTask(BHA, [1.0, 1.5, 3.0], weights=[0.5, 0.1, 1.0]), 0.15, 0.35),
    "points of tendons": (lambda: PointsTask(ELASTIC, [2.0, 3.0]), -0.01, 0.01),
    "markers": (lambda: PositionTask(TURNED.with_markers(MARKERS), size=9), 0.15, 0.35),
    "markers of a hybrid": (lambda: PositionTask(hybrid_of_markers(), size=9), 0.15, 0.35),
}
FAST = ("axis of arcs", "pose of arcs", "pose of elastic tendons", "points", "pose of a hybrid")
NAMES = [name if name in FAST else pytest.param(name, marks=pytest.mark.slow) for name in TASKS]


def rows_of(name, count=48):
    """Rows of q inside, outside and at the limits, and nearly straight, and targets near them."""
    make, low, high = TASKS[name]
    task, draw = make(), np.random.default_rng(3)
    q = draw.uniform(low, high, (count, task.n_actuators))
    q[::4] += 0.3 * (high - low) * draw.standard_normal(q[::4].shape)
    q[1::4] = np.where(draw.random(q[1::4].shape) < 0.4, low, q[1::4])
    near = q + 10.0 ** draw.uniform(-4, -1, (count, 1)) * (high - low) * draw.standard_normal(
        q.shape
    )
    with torch.no_grad():
        return task, q, task.evaluate(torch.from_numpy(near))[0].numpy(), low, high


def in_torch(*arrays):
    return [torch.from_numpy(a) for a in arrays]


@pytest.mark.parametrize("name", NAMES)
def test_values_and_derivatives_are_those_of_torch(name):
    task, q, _, low, high = rows_of(name)
    q[2::8] = q[2::8, :1] + 1e-6 * (q[2::8] - low)  # nearly straight
    q[3] = 0.5 * (low + high)
    core = core_of(InverseKinematics(task).settings)
    for rows in (q, q[:1], q[5:8]):
        with torch.no_grad():
            expected = task.evaluate(torch.from_numpy(rows))
        for ours, theirs in zip(core.evaluate(torch.from_numpy(rows)), expected, strict=True):
            size = max(1.0, float(theirs.abs().max()))
            assert_allclose(ours, theirs, rtol=0.0, atol=1e-12 * size)
    inside = core.settings.task.domain_distance(torch.from_numpy(q))
    assert_allclose(inside, task.domain_distance(torch.from_numpy(q)), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("options", [{}, {"dq_max": 1.0}, {"ddq_max": 20.0, "weights": 3.0}])
@pytest.mark.parametrize("name", NAMES)
def test_steps_are_those_of_torch(name, options):
    task, q, x, low, high = rows_of(name)
    n, m = q.shape[1], sum(task.parts)
    if "weights" in options:
        options = {**options, "weights": np.linspace(1.0, 2.0, n), "dq_max": 5.0}
    ik = InverseKinematics(task, q_min=low, q_max=high, damping=0.02, **options)
    x[5], q[6, 0] = np.nan, np.inf
    dx = 0.1 * np.random.default_rng(1).standard_normal((len(q), m))
    ours, theirs = ik.step(q, x, dx), ik.step(*in_torch(q, x, dx))
    size = high - low
    for field, atol in dict(dq=1e-9 * size, x=1e-12, error=1e-11, sigma_min=1e-7).items():
        a, b = (np.delete(np.asarray(getattr(s, field)), 6, axis=0) for s in (ours, theirs))
        assert_allclose(a, b, rtol=1e-7, atol=atol, err_msg=field)
    assert_array_equal(ours.dq[6], theirs.dq[6])
    assert np.isnan(ours.x[6]).any()
    assert (ours.saturated != theirs.saturated.numpy()).mean() < 5e-3
    one = ik.step(q[1], x[1], dx[1])
    for field in ("dq", "x", "error", "sigma_min", "damping", "saturated"):
        assert_array_equal(getattr(one, field), getattr(ours, field)[1])
    good = ((q >= low) & (q <= high)).all(1)
    new = (q + ours.dq)[good]
    assert ((new >= low) & (new <= high)).all()


@pytest.mark.parametrize("memory", [np.inf, 0.05])
@pytest.mark.parametrize("name", NAMES)
def test_a_stream_is_that_of_torch(name, memory):
    """With readings that come and go, and targets that are not known."""
    task, q, x, low, high = rows_of(name)
    ik = InverseKinematics(task, q_min=low, q_max=high, dq_max=5.0 * (high - low), damping=0.02)
    start = np.clip(q[3], low, high)
    ours = ik.tracker(start, memory=memory)
    theirs = ik.tracker(torch.from_numpy(start), memory=memory)
    assert ours.backend == "compiled"
    for i in range(20):
        target = np.full_like(x[0], np.nan) if i == 9 else x[i // 5]
        tip = {"x_measured": x[i // 5 + 8]} if i % 3 == 1 else {}
        if i == 10:
            tip = {"x_measured": np.full_like(target, np.nan)}
        command = ours.step(target, np.full(sum(task.parts), 1e-3), **tip)
        expected = theirs.step(
            *in_torch(target),
            **{k: torch.from_numpy(a) for k, a in tip.items()},
            dx=torch.full((sum(task.parts),), 1e-3).double(),
        )
        assert_allclose(command, expected.numpy(), rtol=0.0, atol=1e-8 * (high - low))
        assert_allclose(ours.x, theirs.x.numpy(), rtol=0.0, atol=1e-7)
        assert ours.status is theirs.status
    assert ours.x.shape == task.shape
    assert_array_equal(pickle.loads(pickle.dumps(ours)).step(x[1]), ours.step(x[1]))


def test_a_target_that_is_no_rotation_is_refused():
    ik = InverseKinematics(PoseTask(BHA), q_min=0.1, q_max=0.4)
    tracker, start = ik.tracker(np.full(9, 0.25)), np.full(9, 0.25)
    assert tracker.backend == "compiled"
    bad, mirrored = np.eye(4), np.diag([-1.0, 1.0, 1.0, 1.0])
    bad[0, 1] = 0.1
    for target in (bad, mirrored):
        with pytest.raises(ValueError, match="must hold rotations"):
            tracker.step(target)
        with pytest.raises(ValueError, match="must hold rotations"):
            tracker.step(np.eye(4), x_measured=target)
        with pytest.raises(ValueError, match="must hold rotations"):
            ik.step(start, target)
    assert_array_equal(tracker.q, start)


# ---------------------------------------------------------------- half-spaces


def planes(seed, count, x):
    normals = np.random.default_rng(seed).standard_normal((count, x.shape[1]))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    return normals, normals @ x.mean(axis=0) + 0.02


def motions(seed, chain=BHA, low=0.1, high=0.4):
    draw = np.random.default_rng(seed)
    q = draw.uniform(low, high, (80, chain.n_actuators))
    q[draw.random(q.shape) < 0.3] = high
    x = chain(torch.from_numpy(q)).numpy()
    return q, x, x + 0.1 * np.ptp(x) * draw.standard_normal(x.shape)


SPEEDS = [{}, {"dq_max": 1.0}, {"dq_max": 1.0, "ddq_max": 20.0, "weights": 2.0}]


@pytest.mark.parametrize("options", SPEEDS)
@pytest.mark.parametrize("count", [1, 3, 12])
def test_steps_within_half_spaces_are_those_of_torch(count, options):
    q, x, target = motions(count)
    normals, offsets = planes(count, count, x)
    ik = InverseKinematics(
        BHA, q_min=0.1, q_max=0.4, damping=0.01, tip_limits=(normals, offsets), **options
    )
    assert ik.tracker(q[0]).backend == "compiled"
    ours, theirs = ik.step(q, target), ik.step(*in_torch(q, target))
    assert_allclose(ours.dq, theirs.dq.numpy(), rtol=0.0, atol=1e-9)


@pytest.mark.parametrize("core", [True, False])
@pytest.mark.parametrize("count", [2, 3, 5])
def test_no_step_leads_farther_out_of_any_half_space(count, core):
    """From outside several of them, at speeds that do not suffice to return in one period."""
    several = 0
    for seed in range(3):
        q, x, target = motions(seed)
        normals, offsets = planes(seed, count, x)
        before = x @ normals.T - offsets
        several += ((before > 0.0).sum(1) > 1).sum()
        limits = {"q_min": 0.1, "q_max": 0.4, "dq_max": 1.0}
        ik = InverseKinematics(BHA, **limits, tip_limits=(normals, offsets))
        arguments = (q, target) if core else in_torch(q, target)
        dq = np.asarray(ik.step(*arguments).dq)
        J = BHA.jacobian(torch.from_numpy(q)).numpy()
        after = before + np.einsum("rij,rj->ri", J, dq) @ normals.T
        assert (after <= np.maximum(before, 0.0) + 2e-14).all()
        assert ((q + dq >= 0.1) & (q + dq <= 0.4)).all()
        assert np.abs(dq).max() <= 0.01 + 1e-15
        # Most that are outside come nearer to the half-space that they have left farthest.
        out = before.max(1) > 1e-3
        assert (after.max(1) < before.max(1))[out].mean() > 0.7
    assert several > 30


@pytest.mark.parametrize("core", [True, False])
def test_braking_does_not_lead_out_of_a_half_space(core):
    """Near a plane the last steps still move the tip outwards, and actuators brake slowly."""
    phase = np.linspace(0.0, 2.0 * np.pi, 251)[:35]
    loop = np.stack([np.sin(phase), np.cos(phase) - 1.0, 0.4 * np.sin(2.0 * phase)], axis=1)
    normal = np.array([1.0, 0.3, 0.2]) / np.linalg.norm([1.0, 0.3, 0.2])
    start = np.full(9, 0.25) + 0.01 * np.cos(np.arange(9.0))
    tip = BHA(torch.from_numpy(start)).numpy()
    offset = normal @ tip + 0.05
    speeds = {"dq_max": 0.05, "ddq_max": 0.2, "dt": 0.02}
    ik = InverseKinematics(BHA, q_min=0.1, q_max=0.4, **speeds, tip_limits=([normal], [offset]))
    path = tip + 0.15 * loop
    path, start = (path, start) if core else in_torch(path, start)
    x = np.asarray(ik.track(path, q0=start).x)
    assert -1e-4 < (x @ normal - offset).max() < 5e-6
