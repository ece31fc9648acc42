"""UNREACHABLE is a proof: the target is farther away than the stretched robot is long."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
)
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask, PositionTask

BASE = np.eye(4)
BASE[:3, 3] = [0.5, -0.3, 0.2]
TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
TENDONS = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2, offsets=[0.01, -0.02], base=BASE)
MIXED = ConstantCurvatureChain(
    [0.02, 0.03], lengths=[None, 0.1], angles=[[0.0, 1.0, 2.5], [0.3, 1.5, 4.0]], gains=0.5
).with_geometry(actuator_zeros=0.01 * torch.arange(6).double())
MARKED = TRUNK.with_markers([(0, 0.5, (0.05, 0.0, 0.1)), (2, 1.0, (0.0, 0.1, 0.02))])
PROBE = ConstantCurvatureChain([0.02], lengths=[0.1]).with_markers([(0, 1.0, (0.0, 0.0, 0.1))])
ORIGINS = np.stack([BASE, np.eye(4), BASE])
ARM = RigidChain(
    ORIGINS,
    [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
    kinds=["revolute", "prismatic", "revolute"],
    couplings=[[1.0, 0.0], [0.5, -1.0], [0.0, 1.0]],
    joint_zeros=[0.1, -0.2],
    tool=[0.1, 0.0, 0.2],
)
TASKS = {
    "trunk": (TRUNK, 0.1, 0.4),
    "tendons": (TENDONS, -0.02, 0.03),
    "mixed": (MIXED, 0.05, 0.2),
    "marker": (PROBE, -0.001, 0.001),
    "markers": (PositionTask(MARKED, size=6), 0.1, 0.4),
    "points": (PointsTask(TRUNK, [1.5, 3.0], weights=[0.5, 2.0]), 0.1, 0.4),
    "pose": (PoseTask(TENDONS), -0.02, 0.03),
    "arm": (ARM, -1.0, 2.0),
    "elastic": (ElasticTendonChain([0.02] * 2, [0.1] * 2), -0.02, 0.02),
}


def names(solution):
    return [IKStatus(int(status)).name for status in np.ravel(solution.status)]


@pytest.mark.parametrize("name", TASKS)
def test_no_tip_of_the_robot_is_beyond_its_reach(rng, name):
    task, low, high = TASKS[name]
    settings = InverseKinematics(task, q_min=low, q_max=high).settings
    share = 3.0 * torch.rand(2000, settings.n_actuators, generator=rng).double() - 1.0
    x, _ = settings.evaluate(low + (high - low) * share.clamp(0.0, 1.0))
    assert settings.misses(x).shape == (2000,)
    assert settings.misses(x).max() <= 1e-12
    assert (settings.misses(x + 100.0) > 1.0).all()


@pytest.mark.slow
@pytest.mark.parametrize("chain", [TRUNK, TRUNK.with_markers([(0, 1.0), (2, 1.0)])])
@pytest.mark.parametrize("coupling", ["parallel", "serial"])
def test_a_hybrid_reaches_farther_by_its_longest_correction(rng, chain, coupling):
    q = 0.1 + 0.3 * torch.rand(60, 9, generator=rng).double()
    error = torch.sin(10.0 * q).sum(1, keepdim=True) * torch.ones(1, chain.n_outputs).double()
    model = HybridForwardModel(chain, "quadratic", coupling=coupling)
    model.fit(q.numpy(), (chain(q) + 0.01 * error).numpy())
    before = torch.from_numpy(model.predict(q.numpy()))
    moved = before + torch.tensor([0.2, 0.0, 0.1]).double().repeat(chain.n_outputs // 3)
    target = torch.tensor([[2.0, 3.0, 4.0]]).double()
    for adapted in (False, True):
        if adapted:
            model.adapt(q.numpy(), moved.numpy())
        ik = InverseKinematics(model, q_min=0.0, q_max=0.6)
        x, _ = ik.settings.evaluate(0.6 * torch.rand(2000, 9, generator=rng).double())
        assert ik.settings.misses(x).max() <= 1e-12
        assert names(ik.solve(target, restarts=0)) == ["UNREACHABLE"]


def test_without_a_guard_nothing_is_proven(rng):
    q = 0.1 + 0.3 * torch.rand(60, 9, generator=rng).double()
    model = HybridForwardModel(TRUNK, "linear", guard=None).fit(q.numpy(), TRUNK(q).numpy())
    target = torch.tensor([[2.0, 3.0, 4.0]]).double()
    found = InverseKinematics(model, q_min=0.1, q_max=0.4).solve(target, restarts=0)
    assert "UNREACHABLE" not in names(found)


def test_the_bound_is_the_length_of_the_stretched_robot():
    d = torch.tensor([-0.1, 0.0, 0.02]).double()
    ways = torch.nn.functional.normalize(torch.tensor([[1.0, 2.0, -2.0]]).double())
    for chain, low, high, length in ((TRUNK, 0.1, 0.4, 1.2), (TENDONS, -0.02, 0.02, 0.23)):
        settings = InverseKinematics(chain, q_min=low, q_max=high).settings
        target = chain.base[:3, 3] + (length + d)[:, None] * ways
        assert_close(settings.misses(target), d, rtol=0.0, atol=1e-12)
    assert InverseKinematics(TRUNK).settings.misses(target + 1e6).max() < 0.0  # without limits


def test_tasks_of_several_parts_and_models_without_a_bound():
    pose = torch.eye(4).double()
    pose[2, 3] = 1.5
    limits = {"q_min": [0.1] * 9, "q_max": 0.4}
    assert names(InverseKinematics(PoseTask(TRUNK), **limits).solve(pose)) == ["UNREACHABLE"]
    points = torch.tensor([[0.0, 0.0, 0.3], [0.0, 0.0, 1.5]]).double()
    ik = InverseKinematics(PointsTask(TRUNK, [1, 3]), **limits)
    assert names(ik.solve(points)) == ["UNREACHABLE"]
    ik = InverseKinematics(lambda q: TRUNK(q), **limits)
    assert names(ik.solve(points[1], restarts=0)) == ["MAX_ITER"]
