"""Limits that a caller's function adds to every step."""

import numpy as np
import pytest
import torch

from hybridkin import InverseKinematics, native, robots
from hybridkin._core.plan import NoKernel
from hybridkin.ik.limits import Bounds, Rows

TRUNK = robots.bionic_handling_assistant()
BOX = {"q_min": 0.15, "q_max": 0.35, "dq_max": 0.5}
RNG = np.random.default_rng(0)
Q = RNG.uniform(0.2, 0.3, (50, 9))
X = RNG.uniform([-0.4, -0.4, 0.5], [0.4, 0.4, 1.0], (50, 3))


def balanced(q, x, J):
    """Allow the first segment no change of its mean length."""
    total = torch.zeros_like(q)
    total[:, :3] = 1.0
    none = torch.zeros_like(q[:, 0])
    return Rows(torch.stack([total, -total], dim=1), torch.stack([none, none], dim=1))


def low(q, x, J):
    """Keep the tip below z = 0.7, to first order: J is that of the tip."""
    return Rows(J[:, 2:], 0.7 - x[:, 2:])


def still(q, x, J):
    """Hold the last segment."""
    upper = torch.full_like(q, torch.inf)
    upper[:, 6:] = 0.0
    return Bounds(-upper, upper)


def test_rows_hold_within_all_other_limits():
    step = InverseKinematics(TRUNK, limits=[balanced], **BOX).step(Q, X)
    np.testing.assert_allclose(step.dq[:, :3].sum(1), 0.0, atol=1e-15)
    assert (abs(step.dq) <= 0.005 + 1e-18).all()
    plain = InverseKinematics(TRUNK, **BOX).step(Q, X)
    assert (abs(plain.dq[:, :3].sum(1)) > 1e-3).mean() > 0.5


def test_a_row_of_the_tip_equals_a_half_space():
    own = InverseKinematics(TRUNK, limits=[low], **BOX)
    spaces = InverseKinematics(TRUNK, tip_limits=([[0.0, 0.0, 1.0]], [0.7]), **BOX)
    below = TRUNK(torch.from_numpy(Q))[:, 2].numpy() < 0.7
    np.testing.assert_allclose(own.step(Q, X).dq, spaces.step(Q, X).dq, atol=1e-12)
    assert below.any()
    assert not below.all()


def test_bounds_hold_and_the_others_move():
    step = InverseKinematics(TRUNK, limits=[still], **BOX).step(Q, X)
    assert (step.dq[:, 6:] == 0.0).all()
    assert step.saturated[:, 6:].all()
    assert (abs(step.dq[:, :6]).max(1) > 0.0).all()


def test_bounds_never_leave_the_limits_of_the_actuators():
    def far(q, x, J):
        return Bounds(torch.full_like(q, 1.0), torch.full_like(q, 2.0))

    step = InverseKinematics(TRUNK, limits=[far], **BOX).step(Q, X)
    np.testing.assert_array_equal(step.dq, 0.005)


@pytest.mark.parametrize(
    ("limits", "change"),
    [
        ([-0.004, 0.001], -0.001),  # the second one holds at rest and stays
        ([0.001, -0.004], 0.001),  # so does the first one
        ([-0.004, -0.003], 0.0),  # none does: they give way as far as rest
        ([-0.04, np.inf], -0.005),  # the speed of the actuator stays
    ],
)
def test_rows_that_contradict_give_way_at_most_to_rest(limits, change):
    def both(q, x, J):
        first = torch.zeros_like(q)
        first[:, 0] = 1.0
        b = q.new_tensor(limits).expand(len(q), 2)
        return Rows(torch.stack([first, -first], dim=1), b)

    step = InverseKinematics(TRUNK, limits=[both], **BOX).step(Q, X)
    np.testing.assert_allclose(step.dq[:, 0], change, atol=1e-15)


def test_not_a_number_holds_its_row_alone():
    def sometimes(q, x, J):
        limit = torch.where(q[:, :1] > 0.25, torch.nan, 1.0)
        return Rows(torch.ones_like(q)[:, None], limit)

    step = InverseKinematics(TRUNK, limits=[sometimes], **BOX).step(Q, X)
    plain = InverseKinematics(TRUNK, **BOX).step(Q, X)
    held = Q[:, 0] > 0.25
    assert (step.dq[held] == 0.0).all()
    np.testing.assert_allclose(step.dq[~held], plain.dq[~held], atol=1e-15)


def test_trackers_run_in_torch_and_say_why():
    ik = InverseKinematics(TRUNK, limits=[balanced], **BOX)
    tracker = ik.tracker(np.full(9, 0.25))
    for _ in range(20):
        q = tracker.step([0.1, 0.05, 0.7])
    assert abs(q[:3].sum() - 0.75) < 1e-12
    if native.available():
        assert tracker.backend == "torch: `limits` that are functions have no kernel"


def test_refused_in_exported_code(tmp_path):
    ik = InverseKinematics(TRUNK, limits=[balanced], **BOX)
    with pytest.raises(NoKernel, match="`limits` that are functions"):
        native.export_c(ik, tmp_path)


@pytest.mark.parametrize(
    ("limits", "match"),
    [
        ([1.0], "must be .*functions"),
        ([lambda q, x, J: q], "return Rows or Bounds"),
        ([lambda q, x, J: Rows(J, x[:, :2])], r"Rows.A"),
        ([lambda q, x, J: Rows(1.0, 2.0)], "torch tensors"),
    ],
)
def test_what_is_no_limit_is_refused(limits, match):
    with pytest.raises((TypeError, ValueError), match=match):
        InverseKinematics(TRUNK, limits=limits).step(Q, X)
