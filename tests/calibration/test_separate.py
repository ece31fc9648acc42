"""Motions that separate sets of parameters, on logs that cannot by construction."""

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    GeometryChoice,
    RigidChain,
    SeparatingMotion,
    choose_geometry,
    separating_motions,
)

NOISE = 3e-4
RADIUS = 0.006
RING = 2.0 * np.pi / 3.0 * np.arange(3)


def moved_base():
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([0.05, -0.1, 0.2])
    return base


def measured(truth, q, seed):
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(q), 3))
    return truth(torch.from_numpy(q)).numpy() + noise


def pulls(bends):
    """Return the tendons (N, 3) of a segment with bendings (N, 2)."""
    return -RADIUS * bends @ np.stack([np.cos(RING), np.sin(RING)])


def straight_log():
    """Two segments of chambers, of which the second one stays straight: is its radius wrong?"""
    rng = np.random.default_rng(0)
    first = rng.uniform(0.15, 0.3, (60, 3))
    second = rng.uniform(0.18, 0.26, (60, 1)) + rng.uniform(-5e-4, 5e-4, (60, 3))
    nominal = ConstantCurvatureChain([0.05, 0.05])
    truth = nominal.with_geometry(
        radii=torch.tensor([0.05, 0.065], dtype=torch.float64), base=moved_base()
    )
    return nominal, truth, np.hstack([first, second]), (0.15, 0.3)


def small_log():
    """Two segments of tendons, bent by up to 6 deg: is the tool longer, or the base elsewhere?"""
    bends = np.random.default_rng(0).uniform(-0.1, 0.1, (2, 60, 2))
    nominal = ConstantCurvatureChain([RADIUS, RADIUS], lengths=[0.1, 0.1])
    truth = nominal.with_geometry(
        offsets=torch.tensor([0.0, 0.03], dtype=torch.float64), base=moved_base()
    )
    return nominal, truth, np.hstack([pulls(part) for part in bends]), (-0.01, 0.01)


LOGS = {
    "base against radii": (straight_log, "base", "radii + base"),
    "base against tool": (
        small_log,
        "radii + base",
        "radii + turns + rest_bends + lengths + tool + base",
    ),
}


@pytest.mark.parametrize("name", LOGS)
def test_the_motion_separates_what_the_log_cannot(name):
    """With it, a calibration of the wrong set has large errors there; the right one has noise."""
    make, wrong, right = LOGS[name]
    nominal, truth, q, (low, high) = make()
    x = measured(truth, q, 1)
    choice = choose_geometry(nominal, q, x)
    sets = {one.name: one for one in (choice, *choice.rivals)}
    assert {wrong, right} <= {*sets}
    motions = separating_motions(choice, q, x, q_min=low, q_max=high)
    assert [motion.rival for motion in motions] == [rival.name for rival in choice.rivals]
    motion = next(m for m in motions if {m.chosen, m.rival} == {wrong, right})
    assert motion.separates
    assert motion.remaining <= motion.difference * (1.0 + 1e-9)
    assert ((motion.q >= low) & (motion.q <= high)).all()
    assert "segment 2 is bent by" in motion.motion
    assert motion.motion in str(motion)

    q_both = np.vstack([q, motion.q])
    x_both = np.vstack([x, measured(truth, motion.q, 2)])
    errors = {}
    for which in (wrong, right):
        before = sets[which].calibrate(q, x).chain(torch.from_numpy(q)).numpy() - x
        assert np.linalg.norm(before, axis=1).mean() < 2.0 * NOISE  # the log fits both
        chain = sets[which].calibrate(q_both, x_both).chain
        miss = chain(torch.from_numpy(motion.q)).numpy() - x_both[len(q) :]
        errors[which] = np.linalg.norm(miss, axis=1).mean()
    assert errors[right] < 3.0 * NOISE
    assert errors[wrong] > 30.0 * NOISE


def test_a_circle_is_a_circle_and_others_stay_straight():
    """The words of a motion say what the chosen chain does along its rows."""
    nominal, truth, q, (low, high) = small_log()
    x = measured(truth, q, 1)
    choice = choose_geometry(nominal, q, x)
    (circle, _) = separating_motions(choice, q, x, q_min=low, q_max=high)
    assert circle.motion.startswith("lead segment 1 around a circle, bent by 90 deg")
    assert circle.motion.endswith("while segment 2 stays straight")
    chain = choice.calibrate(q, x).chain
    arcs = chain.coordinates(torch.from_numpy(circle.q))[0].numpy()
    np.testing.assert_allclose(np.hypot(arcs[:, 2], arcs[:, 4]), np.pi / 2.0, rtol=0.1)
    assert np.hypot(arcs[:, 3], arcs[:, 5]).max() < 0.1
    turn = np.unwrap(np.arctan2(arcs[:, 4], arcs[:, 2]))
    np.testing.assert_allclose(np.diff(turn), np.pi / 4.0, atol=0.1)


def test_narrow_limits_leave_no_motion_that_separates():
    nominal, truth, q, _ = small_log()
    x = measured(truth, q, 1)
    choice = choose_geometry(nominal, q, x)
    usual = separating_motions(choice, q, x)
    low, high = q.min(axis=0), q.max(axis=0)
    margin = 0.25 * (high - low)
    for motion in usual:
        assert ((motion.q >= low - margin) & (motion.q <= high + margin)).all()
    for motion in separating_motions(choice, q, x, q_min=low, q_max=high):
        assert not motion.separates
        assert str(motion).startswith("no motion within the limits separates")
    locked = separating_motions(choice, q, x, q_min=0.0, q_max=0.0)
    assert [motion.separates for motion in locked] == [False] * len(choice.rivals)


def test_a_clear_choice_has_nothing_to_separate():
    nominal, truth, _, (low, high) = small_log()
    bends = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 80, 2))
    q = np.hstack([pulls(part) for part in bends])
    x = measured(truth, q, 1)
    choice = choose_geometry(nominal, q, x)
    assert not choice.rivals
    assert separating_motions(choice, q, x, q_min=low, q_max=high) == ()


def test_robots_without_arcs_move_actuators():
    """An arm whose base has moved: a log of its last joint alone cannot show its first one."""
    T = np.stack([np.eye(4), np.eye(4), np.eye(4)])
    T[1:, 0, 3] = 0.2
    nominal = RigidChain(T, [[0, 0, 1], [0, 1, 0], [0, 1, 0]], tool=[0.1, 0.0, 0.0])
    q = np.random.default_rng(0).uniform(-0.2, 0.2, (40, 3))
    q[:, :2] = 0.0
    x = measured(nominal, q, 1)
    choice = GeometryChoice(
        nominal, (), name="nothing", rivals=(GeometryChoice(nominal, ("base",), name="base"),)
    )
    (motion,) = separating_motions(choice, q, x, q_min=-1.0, q_max=1.0)
    assert isinstance(motion, SeparatingMotion)
    assert "q[" in motion.motion
    assert np.abs(motion.q).max() == 1.0


@pytest.mark.parametrize("limits", [{"q_min": np.nan}, {"q_max": [0.1, 0.2]}, {"q_min": 1.0}])
def test_limits_must_be_limits(limits):
    nominal, truth, q, _ = small_log()
    x = measured(truth, q, 1)
    name = next(iter(limits))
    with pytest.raises(ValueError, match=name):
        separating_motions(GeometryChoice(nominal, ()), q, x, **limits)


def test_a_marker_that_was_never_measured_has_no_offset():
    chain = ConstantCurvatureChain([0.05]).with_markers([(0, 0.5), (0, 1.0)])
    q = np.random.default_rng(0).uniform(0.2, 0.3, (30, 3))
    x = chain.with_geometry(radii=torch.tensor([0.06]).double())(torch.from_numpy(q)).numpy()
    x[:, :3] = np.nan
    radii = GeometryChoice(chain, ("radii", "base"), name="radii + base")
    choice = GeometryChoice(chain, ("base",), name="base", rivals=(radii,))
    (motion,) = separating_motions(choice, q, x)
    assert motion.separates
    assert np.isfinite([motion.difference, motion.noise]).all()
