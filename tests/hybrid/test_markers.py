"""Hybrids of several markers: one fit inside the robot, missing markers, steering, files."""

import copy

import numpy as np
import pytest
import torch
from sklearn.linear_model import LinearRegression
from sklearn.metrics import r2_score

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    InverseKinematics,
    tasks,
)
from hybridkin.native.library import program_of

MARKERS = [(0, 1.0), (1, 1.0, (0.02, 0.0, 0.0)), (2, 1.0)]
CHAIN = ConstantCurvatureChain([0.1, 0.09, 0.08]).with_markers(MARKERS)
NOISE = 3e-4


def plant(q):
    """Return markers of a robot whose lengths are bent functions of q."""
    lengths = q + 0.1 * (q - 0.25) ** 2 + 0.03 * (q[:, [1]] - 0.25)
    with torch.no_grad():
        return CHAIN(torch.from_numpy(lengths)).numpy()


def log(n=120, seed=0):
    rng = np.random.default_rng(seed)
    q = 0.25 + 0.03 * rng.uniform(-1.0, 1.0, (n, 9))
    return q, plant(q) + NOISE * rng.standard_normal((n, 9))


def without(x, share=0.3, seed=1):
    missing = np.random.default_rng(seed).random((len(x), 3)) < share
    missing[:, 2] &= ~missing.all(axis=1)
    return np.where(missing.repeat(3, axis=1), np.nan, x)


def test_inside_the_robot_all_markers_are_learned_together():
    """25 rows of the tip cannot tell 90 coefficients of the arcs apart, those of three ends can."""
    q, _ = log(325)
    zeros = torch.full((9,), 0.02, dtype=torch.float64)
    wrong = CHAIN.with_geometry(radii=1.1 * CHAIN.radii, actuator_zeros=zeros)
    x = wrong(torch.from_numpy(q)).numpy()
    three = HybridForwardModel(CHAIN, "linear", coupling="serial").fit(q[:25], x[:25])
    one = HybridForwardModel(CHAIN.tip_model, "linear", coupling="serial").fit(q[:25], x[:25, 6:])
    far = [np.abs(model.predict(q)[25:, -3:] - x[25:, 6:]).max() for model in (one, three)]
    assert far[1] < 0.1 * far[0]


def test_a_missing_marker_drops_that_marker_alone():
    """A row without a marker is as good as a row of a robot without it."""
    q, x = log(80)
    gone = x.copy()
    gone[:, 3:6] = np.nan
    gone[::40, 3:6] = x[::40, 3:6]  # two rows keep it: then it says next to nothing
    model = HybridForwardModel(CHAIN, "linear", coupling="serial", guard=None).fit(q, gone)
    two = CHAIN.with_markers([MARKERS[0], MARKERS[2]])
    kept = HybridForwardModel(two, "linear", coupling="serial", guard=None)
    kept.fit(q, np.delete(x, np.s_[3:6], axis=1))
    new = log(20, 3)[0]
    found = np.delete(model.predict(new), np.s_[3:6], axis=1)
    far = np.abs(found - kept.predict(new)).max()
    assert far < 0.2 * np.abs(found - np.delete(plant(new), np.s_[3:6], axis=1)).max()


def test_score_counts_the_markers_that_were_measured():
    q, x = log(60)
    model = HybridForwardModel(CHAIN, "linear").fit(q, x)
    assert model.score(q, x) == pytest.approx(r2_score(x, model.predict(q)))
    missing = without(x)
    weights = np.arange(60) % 3
    columns = [~np.isnan(column) for column in missing.T]
    expected = [
        r2_score(x[k, i], model.predict(q)[k, i], sample_weight=weights[k])
        for i, k in enumerate(columns)
    ]
    assert model.score(q, missing, weights) == pytest.approx(np.mean(expected))


@pytest.mark.slow
def test_the_radius_holds_for_every_marker():
    q, x = log(200)
    model = HybridForwardModel(CHAIN, "linear", coverage=0.9).fit(q, without(x))
    new, measured = log(400, 5)
    found, radius = model.predict(new, return_radius=True)
    far = np.linalg.norm((found - measured).reshape(-1, 3, 3), axis=2)
    inside = np.isfinite(radius)
    assert inside.mean() > 0.9
    assert 0.85 < (far.max(axis=1) <= radius)[inside].mean() < 0.98


def test_inverse_kinematics_steers_the_tip_or_all_markers():
    q, x = log(60)
    model = HybridForwardModel(CHAIN, "linear", coupling="serial").fit(q, x)
    target = model.predict(q[:3])
    ik = InverseKinematics(model, q_min=0.2, q_max=0.3)
    found = ik.solve(target[:, 6:], q0=q[3:6])
    assert found.converged.all()
    np.testing.assert_allclose(model.predict(found.q)[:, 6:], target[:, 6:], atol=1e-4)
    tracker = ik.tracker(q[0])
    assert (tracker.backend == "compiled") == (program_of(CHAIN.tip_model) is not None)
    every = InverseKinematics(tasks.PositionTask(model, size=9), q_min=0.2, q_max=0.3)
    found = every.solve(target, q0=q[:3] + 0.003)
    assert found.converged.all()
    np.testing.assert_allclose(model.predict(found.q), target, atol=1e-4)


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda x: x[:, :6], "`y` must have 9 columns"),
        (lambda x: np.where(np.arange(60)[:, None] == 4, np.nan, x), "first: row 4"),
        (lambda x: np.where(np.arange(9) < 3, np.nan, x), "marker 0 in at least 2 rows"),
    ],
)
def test_wrong_rows_raise(change, match):
    q, x = log(60)
    with pytest.raises(ValueError, match=match):
        HybridForwardModel(CHAIN, "linear").fit(q, change(x))


@pytest.mark.parametrize("data_alone", [False, True])
def test_new_rows_may_miss_markers(data_alone):
    """What the other markers learn is that of whole rows, and a missing one has no effect."""
    error_model = LinearRegression() if data_alone else "linear"
    model = HybridForwardModel(None if data_alone else CHAIN, error_model, random_state=0)
    model.fit(*log(80))
    q, x = log(40, 3)
    x = x + np.repeat([0.01, -0.02, 0.03], 3)
    missing, measured = x.copy(), np.arange(40) % 3 > 0
    missing[~measured, 3:5] = np.nan  # an incomplete marker is missing
    whole = copy.deepcopy(model).partial_fit(q, x, decay=1.0, alpha=1e-6)
    some = copy.deepcopy(model).partial_fit(q, missing, decay=1.0, alpha=1e-6)
    rows = copy.deepcopy(model).partial_fit(q[measured], x[measured], decay=1.0, alpha=1e-6)
    found, expected = some.predict(q), whole.predict(q)
    np.testing.assert_allclose(found[:, [0, 1, 2, 6, 7, 8]], expected[:, [0, 1, 2, 6, 7, 8]])
    np.testing.assert_allclose(found[:, 3:6], rows.predict(q)[:, 3:6], rtol=0, atol=1e-9)
    assert np.abs(found[:, 3:6] - expected[:, 3:6]).max() > 1e-6


def test_adapt_to_rows_that_miss_markers():
    """Of the changed robot: nothing but the measured markers counts."""
    model = HybridForwardModel(CHAIN, "linear", random_state=0).fit(*log(80))
    q, x = log(12, 5)
    x = x + np.tile([0.02, -0.01, 0.03], 3)
    missing = x.copy()
    missing[::2, 3:6] = np.nan
    found = copy.deepcopy(model).adapt(q, missing, groups=np.arange(12) // 4).change_.motion
    expected = copy.deepcopy(model).adapt(q, x, groups=np.arange(12) // 4).change_.motion
    np.testing.assert_allclose(found, expected, rtol=0, atol=3e-3)
    np.testing.assert_allclose(found[:3, 3], [0.02, -0.01, 0.03], rtol=0, atol=4e-3)
