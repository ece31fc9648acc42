"""Half-spaces of the tip: what a step keeps exactly, to first order."""

import numpy as np
import pytest
import torch

from hybridkin import InverseKinematics, robots

TRUNK = robots.bionic_handling_assistant()
HOME = np.full(9, 0.25)


@pytest.mark.slow
def test_the_tip_can_brake_before_a_plane():
    """A straight push at full thrust: the tip stands at the plane, not beyond, within ddq_max."""
    axis = torch.tensor([[0.0], [0.0], [1.0]], dtype=torch.float64)
    model = (lambda q: q * axis[:, 0], lambda q: axis.expand(*q.shape[:-1], 3, 1))
    ik = InverseKinematics(model, ddq_max=0.5, tip_limits=([[0.0, 0.0, 2.0]], [0.3]))
    track = ik.track(np.array([[0.0, 0.0, 9.0]] * 200), q0=np.zeros(1))
    assert (track.x[:, 2] <= 0.15 + 1e-12).all()
    assert track.x[-1, 2] == pytest.approx(0.15, abs=1e-4)
    assert np.abs(np.diff(track.q[:, 0], n=2)).max() <= 0.5 * 0.01**2 + 1e-12
    assert np.diff(track.q[:, 0]).max() / 0.01 == pytest.approx(np.sqrt(0.5 * 0.15), rel=0.05)


def test_a_posture_may_be_a_function():
    draw = np.random.default_rng(0)
    ik = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, q_pref=lambda q: 0.9 * q + 0.02)
    q = HOME + 0.02 * draw.standard_normal(9)
    target = [0.1, 0.0, 0.7]
    step = ik.step(q, target)
    np.testing.assert_array_equal(ik.tracker(q).step(target), q + step.dq)
    at_q = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, q_pref=0.9 * q + 0.02)
    np.testing.assert_allclose(step.dq, at_q.step(q, target).dq, rtol=0, atol=1e-12)
    without = InverseKinematics(TRUNK, q_min=0.1, q_max=0.4, beta=0.0)
    assert np.abs(step.dq - without.step(q, target).dq).max() > 1e-6
