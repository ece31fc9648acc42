"""Backlash lets actuators leave the plane of balanced commands; the model keeps to the plane."""

import numpy as np
import pytest
import torch

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    HybridForwardModel,
    Hysteresis,
    InverseKinematics,
    tasks,
)

CHAIN = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1])
WIDTH = 4e-4  # of the backlash [m]
NORMALS = np.kron(np.eye(2), np.ones((3, 1))) / np.sqrt(3.0)


def balanced_log(n=400):
    """Return commands whose sums in each segment are zero, tips behind backlash, and motions."""
    t = np.linspace(0.0, 1.0, n)[:, None]
    rates = np.array([[7.0, 11.0, 5.0, 13.0]])
    bends = 0.003 * np.sin(2.0 * np.pi * rates * t + np.arange(4.0))
    q = np.zeros((n, 6))
    for segment in range(2):
        first, second = bends[:, 2 * segment], bends[:, 2 * segment + 1]
        q[:, 3 * segment] = first
        q[:, 3 * segment + 1] = -0.5 * first + 0.5 * second
        q[:, 3 * segment + 2] = -0.5 * first - 0.5 * second
    motions = np.arange(n) * 10 // n
    moved = Hysteresis.backlash(WIDTH).apply_by_group(q, motions)
    pull = moved @ NORMALS  # shortens the robot, which its kinematics do not know
    x = CHAIN(torch.from_numpy(moved)).numpy()
    x[:, 2] += 0.5 * pull.sum(axis=1)
    return q, x + 1e-4 * np.random.default_rng(0).standard_normal(x.shape), motions


@pytest.mark.parametrize("error_model", ["quadratic", "elm"])
def test_commands_stay_as_balanced_as_those_of_the_log(error_model):
    q, x, motions = balanced_log()
    model = HybridForwardModel(CHAIN, error_model, hysteresis=WIDTH, random_state=0)
    model.fit(q, x, groups=motions)
    plane = model.module_.plane
    assert plane.normals.shape == (6, 2)
    np.testing.assert_allclose(np.abs(np.linalg.svd(NORMALS.T @ plane[1].numpy())[1]), 1.0)
    ik = InverseKinematics(tasks.PositionTask(model), dt=0.05)
    path = x[::20] + 0.002
    found = ik.track(path, q0=q[0]).q
    off = np.abs((found - plane[0].numpy()) @ NORMALS)
    assert off.max() < WIDTH
    assert model.in_domain(Commands(q[::20], motions[::20])).mean() > 0.9
    pulled = q[::20] + 10.0 * WIDTH * NORMALS.sum(axis=1)
    assert not model.module_.in_domain(torch.from_numpy(pulled)).any()
