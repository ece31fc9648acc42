"""Commands keep to the plane of a log: balanced tendons stay in balance."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, HybridForwardModel, InverseKinematics

ANGLES = 2 * np.pi / 3 * np.arange(3)
CHAIN = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
COUNT = 1e-5  # one motor count [m]


def balanced(n, seed=0):
    """Rows of two balanced segments in whole counts [m]."""
    bend = np.random.default_rng(seed).uniform(-3e-3, 3e-3, (n, 2, 2))
    q = (bend @ np.stack([np.cos(ANGLES), np.sin(ANGLES)])).reshape(n, 6)
    return COUNT * np.round(q / COUNT)


@pytest.fixture(scope="module")
def model():
    q = balanced(200)
    x = CHAIN(torch.from_numpy(q + 15.0 * q**2)).numpy()
    return HybridForwardModel(CHAIN, "quadratic").fit(q, x)


@pytest.fixture(scope="module")
def targets(model):
    return model.predict(balanced(30, seed=1))


def solver(model, **options):
    q = balanced(200)
    limits = {"q_min": q.min(axis=0), "q_max": q.max(axis=0)}
    return InverseKinematics(model, **limits, **{"dt": 0.02, "dq_max": 0.01, **options})


def off_plane(model, q):
    point, normals = (a.numpy() for a in model.module_.plane)
    return np.abs((np.asarray(q) - point) @ normals).max()


def test_the_plane_is_that_of_balanced_tendons(model):
    normals = model.module_.plane[1].numpy()
    pulls = np.kron(np.eye(2), np.ones((3, 1))) / 3**0.5
    assert np.abs(pulls - normals @ (normals.T @ pulls)).max() < 1e-3


@pytest.mark.needs_core
@pytest.mark.parametrize("options", [{}, {"weights": [1.0, 2, 3, 4, 5, 6]}, {"ddq_max": 0.3}])
def test_ticks_arrive_in_the_plane_at_the_limits_too(model, targets, options):
    ik = solver(model, **options)
    tracker = ik.tracker(balanced(1)[0])
    assert tracker.backend == "compiled"
    reached = 0
    for target in targets:
        for _ in range(300):
            tracker.step(target)
            assert off_plane(model, tracker.q) < 5 * COUNT  # not far from the rows of the log
        reached += tracker.error < 1e-4
    assert reached >= len(targets) - 1
    start = balanced(1)[0] + 50 * COUNT  # off balance: it returns
    tracker.reset(start)
    for _ in range(300):
        tracker.step(targets[0])
    assert off_plane(model, tracker.q) < COUNT


def test_solutions_lie_in_the_plane(model, targets):
    ik = solver(model)
    found = ik.solve(targets, q0=balanced(1)[0] + 50 * COUNT)
    assert (found.error < 1e-4).all()
    assert off_plane(model, found.q) < COUNT
    assert model.in_domain(found.q).all()
    in_torch = ik.solve(torch.from_numpy(targets[:4]), q0=torch.from_numpy(balanced(1)[0]))
    assert off_plane(model, in_torch.q) < COUNT


@pytest.mark.parametrize("weights", [None, [1.0, 2, 3, 4, 5, 6], [6.0, 5, 4, 3, 2, 1]])
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["core", "torch"])
def test_a_step_keeps_to_the_plane_whatever_the_weights(model, targets, weights, kind):
    q = balanced(30, seed=2)
    found = []
    for factor in (1.0, 4.0**6, 4.0**-6):  # only ratios of weights count
        scaled = None if weights is None else factor * np.array(weights)
        step = solver(model, weights=scaled).step(kind(q), kind(targets))
        found.append(np.asarray(step.dq))
        assert np.asarray(step.saturated).any()
        assert off_plane(model, q + found[-1]) < 5 * COUNT
    # Steps in a box are good to 1e-8 of themselves.
    for dq in found[1:]:
        np.testing.assert_allclose(dq, found[0], rtol=0, atol=1e-7 * np.abs(found[0]).max())
