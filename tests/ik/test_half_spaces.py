"""Half-spaces of the tip: what a step keeps exactly, to first order."""

import numpy as np
import pytest
import torch

from hybridkin import InverseKinematics, robots

TRUNK = robots.bionic_handling_assistant()
HOME = np.full(9, 0.25)


def plane(distance):
    """Return a plane before the tip at HOME, and a function of how far points lie behind it."""
    normal = np.array([1.0, 0.3, 0.2])
    length = np.linalg.norm(normal)
    offset = normal @ TRUNK(torch.from_numpy(HOME)).numpy() + distance * length
    return ([normal], [offset]), lambda x: (x @ normal - offset) / length


@pytest.mark.slow
@pytest.mark.parametrize("dq_max", [None, 0.05, 0.01])
def test_the_linearised_tip_stays_within(dq_max):
    """Also where speeds and positions bind as well."""
    draw = np.random.default_rng(3)
    options = {"q_min": 0.15, "q_max": 0.35, "dq_max": dq_max}
    limits, beyond = plane(0.02)
    free = InverseKinematics(TRUNK, **options)
    ik = InverseKinematics(TRUNK, **options, tip_limits=limits)
    q = draw.uniform(0.2, 0.3, (200, 9))
    q[::4] = np.where(draw.random((50, 9)) < 0.4, 0.35, q[::4])
    on = ik.settings.allowed(TRUNK(torch.from_numpy(q))).numpy()
    on -= np.where(np.arange(200) % 2, 0.0, 1e-4)[:, None] * limits[0]
    start = free.solve(on, q, tol=1e-12)
    q = start.q[start.converged]
    x = start.x[start.converged]
    assert len(q) > 150
    J = TRUNK.jacobian(torch.from_numpy(q)).numpy()
    way = 10.0 ** draw.uniform(-3.0, 0.0, (len(q), 1)) * draw.standard_normal(x.shape)
    dq = ik.step(q, x + way).dq
    moved = (J @ dq[..., None])[..., 0]
    plain = (J @ free.step(q, x + way).dq[..., None])[..., 0]
    without = beyond(x + plain)
    assert (beyond(x + moved) <= np.maximum(beyond(x), 0.0) + 1e-14).all()
    assert (without > 1e-5).sum() > 40
    # It goes on along the plane, at no less than a fifth of the speed in all but a few cases.
    speeds = np.linalg.norm(moved, axis=1) / np.linalg.norm(plain, axis=1)
    assert np.quantile(speeds[without > 1e-5], 0.1) > 0.2
    assert ((q + dq >= 0.15) & (q + dq <= 0.35)).all()
    assert np.abs(dq).max() <= 0.01 * (dq_max or np.inf)
    inside = (beyond(x + way) <= 0.0) & (without <= 0.0)
    np.testing.assert_allclose(moved[inside], plain[inside], rtol=0.0, atol=1e-9)


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
    np.testing.assert_array_equal(ik.tracker(q).step(target), q + ik.step(q, target).dq)
