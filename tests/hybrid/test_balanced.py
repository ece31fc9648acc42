"""Directions that a log never moves: balanced tendons."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ELMRegressor, HybridForwardModel


@pytest.mark.parametrize("coupling", ["parallel", "serial"])
@pytest.mark.parametrize("direct_link", [False, True])
def test_a_network_has_no_slope_where_the_log_never_moved(coupling, direct_link):
    """Balanced pairs: on the rows it is the same network, together they move nothing."""
    rng = np.random.default_rng(0)
    chain = ConstantCurvatureChain([0.006, 0.005], lengths=[0.08, 0.07], n_actuators=2)
    pulls = rng.uniform(-0.004, 0.004, (80, 2))
    q = np.stack([pulls[:, 0], -pulls[:, 0], pulls[:, 1], -pulls[:, 1]], axis=1)
    x = chain(torch.from_numpy(q)).numpy() + 0.3 * (q[:, :1] ** 2 * [1.0, 2.0, 3.0]) / 0.004
    elm = ELMRegressor(40, 1e-6, direct_link=direct_link, random_state=0)
    model = HybridForwardModel(chain, elm, coupling=coupling, guard=None).fit(q, x)
    assert np.linalg.norm(model.predict(q) - x, axis=1).max() < 2e-4
    together = np.array([[1.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.0]]).T
    J = model.jacobian(q)
    assert np.abs(J @ together).max() < 1e-9 * np.abs(J).max()
    moved = torch.from_numpy(q + 0.001 * together.sum(axis=1))
    assert_close(model.module_(moved), torch.from_numpy(model.predict(q)), rtol=0.0, atol=1e-12)
    if coupling == "parallel":
        learned = model.predict_mechanical(q) + model.error_model_.predict(q)
        np.testing.assert_allclose(model.predict(q), learned, atol=1e-12)


@pytest.mark.parametrize("input_scaling", ["minmax", "standard", None])
def test_columns_of_unlike_ranges_that_move_together(input_scaling):
    """Two drums of 1 and 3 on one motor: nothing is learned of one by itself."""
    rng = np.random.default_rng(2)
    pulls = rng.uniform(-0.5, 1.0, (80, 2))
    q = np.stack([pulls[:, 0], 3.0 * pulls[:, 0], pulls[:, 1], 1.0 - pulls.sum(axis=1)], axis=1)
    x = np.sin(pulls @ [[1, 2, 0], [0, 1, 1]])
    elm = ELMRegressor(30, 1e-8, input_scaling=input_scaling, random_state=0)
    model = HybridForwardModel(None, elm).fit(q, x)
    assert np.linalg.norm(model.predict(q) - x, axis=1).max() < 0.05
    np.testing.assert_allclose(model.predict(q), model.error_model_.predict(q), atol=1e-8)
    _, spread, axes = np.linalg.svd((q - q.mean(0)) / np.ptp(q, axis=0), full_matrices=False)
    still = axes[spread < 0.01 * spread[0]] * np.ptp(q, axis=0)
    assert len(still) == 2
    J = model.jacobian(q)
    assert np.abs(J @ still.T).max() < 1e-9 * np.abs(J).max()
