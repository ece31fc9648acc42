"""A hybrid on a chain with errors of its structure, against a serial quadratic one on the chain."""

from itertools import cycle

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import HybridForwardModel, InverseKinematics
from hybridkin.chains.structural import StructuralChain
from hybridkin.hybrid._module import HybridModule
from hybridkin.ik.trajectories import figure_eight
from hybridkin.native.library import evaluate

AGAINST = "serial quadratic hybrid"
SHAPES = (3,), (3, 3), (3,), (3,)  # of the errors of a segment


@pytest.fixture(scope="module")
def quadratic(chain, trunk):
    model = HybridForwardModel(chain, "quadratic", coupling="serial", guard=None)
    return model.fit(trunk.q[::10], trunk.x[::10]).module_


@pytest.fixture(scope="module")
def structural(chain):
    rng = np.random.default_rng(0)
    errors = [torch.from_numpy(rng.normal(0.0, 0.03, (3, *shape))) for shape in SHAPES]
    lengths = torch.full((3,), 0.25, dtype=torch.float64)
    g = StructuralChain(chain, lengths, *errors, torch.eye(4, dtype=torch.float64))
    return HybridModule(g, [], lengths[:0])


def test_rows(race, structural, quadratic, draw, batch):
    q = draw(batch).numpy()
    x, J = evaluate(structural, q, jacobian=True)
    expected = structural.forward_and_jacobian(torch.from_numpy(q[:5]))
    assert_close(torch.from_numpy(x[:5]), expected[0], rtol=0, atol=1e-12)
    assert_close(torch.from_numpy(J[:5]), expected[1], rtol=0, atol=1e-11)
    race(
        "structural hybrid: tip + J",
        AGAINST,
        lambda: evaluate(structural, q, jacobian=True),
        lambda: evaluate(quadratic, q, jacobian=True),
        rows=batch,
        at_most=1.5,
    )


def test_one_row(race, structural, quadratic, draw):
    q = draw(1).numpy()
    race(
        "structural hybrid: tip + J of one row",
        AGAINST,
        lambda: evaluate(structural, q, jacobian=True),
        lambda: evaluate(quadratic, q, jacobian=True),
        at_most=1.3,
    )


def test_a_tick(race, structural, quadratic, trunk):
    path = figure_eight(trunk.x.mean(0), (0.12, 0.06), duration=2.0).x
    ticks = []
    for module in (structural, quadratic):
        ik = InverseKinematics(module, q_min=0.17, q_max=0.32, dt=0.01)
        tracker = ik.tracker(ik.solve(path[0]).q)
        for point in path:
            tracker.step(point)
        assert np.linalg.norm(tracker.x - path[-1]) < 0.01
        points = cycle(path)
        ticks.append(lambda tracker=tracker, points=points: tracker.step(next(points)))
    race("tracker, structural hybrid", AGAINST, *ticks, at_most=1.3)
