"""Resolved rates on tendons that can only pull arrive at static targets."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ElasticTendonChain, HybridForwardModel, InverseKinematics
from hybridkin._core.model import Shifted
from hybridkin.ik.results import IKStatus

LIMITS = {"q_min": -0.01, "q_max": 0.01, "dt": 0.02}
FAST = {"dq_max": 0.05}
WAYS = {
    "default": {},
    "dq_max": FAST,
    "gain": {**FAST, "gain": 5.0},
    "ddq_max": {**FAST, "ddq_max": 1.0},
    "weights": {**FAST, "weights": np.arange(1.0, 10.0)},
}
MINIMUM = 32  # this target is missed at a local minimum: all tendons at q_min, straight


def chain(**options):
    return ElasticTendonChain([0.01] * 3, lengths=[0.1] * 3, **options)


def targets(count):
    q = np.random.default_rng(0).uniform(-0.01, 0.01, (40, 9))
    return np.delete(chain()(torch.from_numpy(q)).numpy(), MINIMUM, axis=0)[:count]


def keeps_limits(ik, commands):
    """Whether commands keep the limits of q, of its speed and of its acceleration."""
    s, rounding = ik.settings, np.spacing(0.01)
    steps = np.diff(commands, axis=0)
    fast = abs(steps).max() <= float(s.dq_max) * s.dt + rounding
    sudden = abs(np.diff(steps, axis=0)).max() <= float(s.ddq_max) * s.dt**2 + rounding
    return abs(commands).max() <= 0.01 and fast and sudden


@pytest.mark.slow
@pytest.mark.needs_core
@pytest.mark.parametrize("start", [0.0, 0.005])  # straight; all tendons slack
@pytest.mark.parametrize("way", WAYS)
def test_static_targets_are_reached_within_the_limits(way, start):
    ik = InverseKinematics(chain(), **LIMITS, **WAYS[way])
    tracker, errors = ik.tracker(np.zeros(9)), []
    assert tracker.backend == "compiled"
    for x in targets(12):
        tracker.reset(np.full(9, start))
        commands, distances = [np.full(9, start)] * 2, []
        for _ in range(240):
            commands.append(tracker.step(x))
            distances.append(tracker.error)
        assert keeps_limits(ik, np.array(commands))
        errors.append(max(distances[-20:]))
    assert max(errors) < 1e-4


@pytest.mark.slow
def test_steps_of_a_batch_arrive_in_torch():
    ik = InverseKinematics(chain(), **LIMITS, **FAST)
    x = torch.from_numpy(targets(6))
    q = 0.0025 * torch.arange(6.0).double()[:, None].expand(6, 9) - 0.005
    alone = ik.step(q[3], x[3]).dq
    assert_close(ik.step(q, x).dq[3], alone, rtol=0, atol=1e-12)
    for _ in range(40):
        step = ik.step(q, x)
        q = q + step.dq
    assert_close(ik.step(q, x).error, torch.zeros(6).double(), rtol=0, atol=1e-4)


def test_without_limits_slack_tendons_cannot_be_pulled_in():
    for q in (np.full(9, 0.005), torch.full((9,), 0.005, dtype=torch.float64)):
        tracker = InverseKinematics(chain(), dt=0.02).tracker(q)
        command = tracker.step(targets(1)[0])
        assert_close(torch.as_tensor(command), torch.as_tensor(q), rtol=0, atol=0)
        assert tracker.status == IKStatus.SINGULAR


def test_which_actuators_only_pull():
    expected = torch.tensor([-1.0, 1.0, -1.0]).double().repeat_interleave(3)
    assert_close(chain(gains=[1.0, -2.0, 3.0]).pulls, expected)
    q = np.random.default_rng(0).uniform(-0.01, 0.01, (60, 9))
    x = chain()(torch.from_numpy(q)).numpy() + 1e-3 * np.sin(300 * q[:, :3])
    model = HybridForwardModel(chain(), "linear").fit(q, x)
    assert (InverseKinematics(model).settings.pulls == -1.0).all()
    model.adapt(q[:8] + 1e-4, model.predict(q[:8]))
    assert isinstance(model.module_, Shifted)
    assert (InverseKinematics(model).settings.pulls == -1.0).all()
