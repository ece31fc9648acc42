"""Errors learned inside the robot, and by name: the estimator around the serial readout."""

import numpy as np
import pytest
import sklearn
import torch
from sklearn.model_selection import GridSearchCV, GroupKFold

from hybridkin import (
    HybridForwardModel,
    RigidChain,
    datasets,
    robots,
)


def bha():
    return robots.bionic_handling_assistant()


@pytest.fixture(scope="module")
def trunk():
    data = datasets.load_trunk()
    order = np.random.default_rng(0).permutation(np.flatnonzero(data.part == 3))
    return data.q[order], data.x[order]


def error(model, q, x):
    return np.linalg.norm(model.predict(q) - x, axis=1).mean()


@pytest.mark.slow
def test_a_grid_search_hands_groups_on(trunk):
    q, x = trunk
    groups = np.arange(len(q)) // 10
    with sklearn.config_context(enable_metadata_routing=True):
        search = GridSearchCV(
            HybridForwardModel(bha(), "linear").set_fit_request(groups=True),
            {"coupling": ["parallel", "serial"], "error_model": ["linear", "drop"]},
            cv=GroupKFold(3),
            scoring="neg_mean_squared_error",
        ).fit(q, x, groups=groups)
    assert search.best_params_["coupling"] == "serial"


def test_other_mechanical_models_take_the_error_on_q():
    rng = np.random.default_rng(0)
    origins = np.tile(np.eye(4), (3, 1, 1))
    origins[1:, 0, 3] = 0.3
    arm = RigidChain(origins, [[0, 0, 1], [0, 1, 0], [0, 1, 0]], tool=[0.2, 0, 0])
    q = rng.uniform(-1, 1, (300, 3))
    bent = q + 0.1 * np.sin(q) * q[:, ::-1]  # joints that miss their commands
    x = arm(torch.from_numpy(bent)).numpy()
    serial, parallel = (
        HybridForwardModel(arm, "quadratic", coupling=coupling).fit(q[:200], x[:200])
        for coupling in ("serial", "parallel")
    )
    assert error(serial, q[200:], x[200:]) < 0.5 * error(parallel, q[200:], x[200:])
