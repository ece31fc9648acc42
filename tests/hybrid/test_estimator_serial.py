"""Errors learned inside the robot, and by name: the estimator around the serial readout."""

import copy

import numpy as np
import pytest
import sklearn
import torch
from numpy.testing import assert_allclose
from sklearn.base import clone
from sklearn.linear_model import Ridge
from sklearn.model_selection import GridSearchCV, GroupKFold
from torch.testing import assert_close

from hybridkin import (
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
    RigidChain,
    datasets,
    robots,
)

SETTINGS = {
    "serial quadratic": {"coupling": "serial", "error_model": "quadratic"},
    "serial pose": {"coupling": "serial", "error_model": "pose"},
    "serial ELM": {"coupling": "serial", "error_model": ELMRegressor(40, 1e-3, random_state=0)},
    "parallel pose": {"error_model": "pose"},
}


def bha():
    return robots.bionic_handling_assistant()


@pytest.fixture(scope="module")
def trunk():
    data = datasets.load_trunk()
    order = np.random.default_rng(0).permutation(np.flatnonzero(data.part == 3))
    return data.q[order], data.x[order]


@pytest.fixture(scope="module", params=SETTINGS)
def fitted(request, trunk):
    return HybridForwardModel(bha(), **SETTINGS[request.param]).fit(trunk[0][:200], trunk[1][:200])


def error(model, q, x):
    return np.linalg.norm(model.predict(q) - x, axis=1).mean()


@pytest.mark.slow
def test_inside_is_better_than_at_the_tip(trunk):
    q, x = trunk
    mechanical = HybridForwardModel(bha(), "drop", calibrate="default")
    parallel = HybridForwardModel(bha(), "quadratic", calibrate="default")
    network = HybridForwardModel(bha(), ELMRegressorCV(random_state=0), calibrate="default")
    serial = HybridForwardModel(bha(), "quadratic", coupling="serial", calibrate="default")
    models = (serial, parallel, network, mechanical)
    errors = [error(model.fit(q[:250], x[:250]), q[250:], x[250:]) for model in models]
    assert errors[0] < 0.97 * min(errors[1:])
    assert errors[0] < 0.7 * errors[3]


@pytest.mark.slow
def test_module_jacobian_and_parts_in_and_out_of_the_domain(fitted, trunk):
    rng = np.random.default_rng(0)
    q = torch.from_numpy(trunk[0][:30] + rng.uniform(-0.12, 0.12, (30, 9)))
    module = fitted.module_
    tips, J = module.forward_and_jacobian(q)
    assert_close(tips, module(q), rtol=0, atol=1e-12)
    assert_close(J, torch.func.vmap(torch.func.jacrev(module))(q), rtol=1e-7, atol=1e-8)
    assert_close(tips, module.mechanical(q) + module.error_part(q))
    assert not module.in_domain(q).all()
    assert module.in_domain(torch.from_numpy(trunk[0][:200])).all()
    assert_allclose(
        fitted.predict(trunk[0]),
        fitted.predict_mechanical(trunk[0]) + fitted.predict_error(trunk[0]),
    )
    single = copy.deepcopy(module).float()(q.float())
    assert single.dtype == torch.float32
    assert_close(single.double(), tips, rtol=1e-4, atol=1e-4)


@pytest.mark.slow
def test_far_out_the_mechanical_model_remains(fitted, trunk):
    far = torch.from_numpy(trunk[0][:50] * 3)
    module = fitted.module_
    longest = module.error_part(torch.from_numpy(trunk[0][:200])).norm(dim=1).max()
    assert module.error_part(far).norm(dim=1).max() < 0.05 * longest
    assert_close(module.jacobian(far), module.mechanical.jacobian(far), rtol=0, atol=0.05)


@pytest.mark.slow
def test_groups_weights_and_grid_search(trunk):
    q, x = trunk
    groups = np.arange(len(q)) // 10
    model = HybridForwardModel(bha(), coupling="serial", error_model="linear")
    by_rows, by_groups = clone(model).fit(q, x), clone(model).fit(q, x, groups=groups)
    assert not np.allclose(by_rows.error_model_.residual, by_groups.error_model_.residual)
    weights = np.random.default_rng(0).integers(0, 3, len(q))
    repeated = np.repeat(np.arange(len(q)), weights)
    weighed = clone(model).fit(q, x, sample_weight=weights)
    assert np.isnan(weighed.error_model_.residual[weights == 0]).all()
    assert error(weighed, q, x) < error(HybridForwardModel(bha(), "drop").fit(q, x), q, x)
    fixed = HybridForwardModel(
        bha(), ELMRegressor(20, 0.1, random_state=0), coupling="serial", guard=None
    )
    assert_allclose(
        clone(fixed).fit(q, x, sample_weight=weights).predict(q),
        clone(fixed).fit(q[repeated], x[repeated]).predict(q),
        atol=1e-8,
    )
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


@pytest.mark.parametrize(
    ("make", "kind", "message"),
    [
        (lambda: HybridForwardModel(bha(), Ridge(), coupling="serial"), TypeError, "inside the"),
        (lambda: HybridForwardModel(torch.nn.Linear(9, 3).double(), "pose"), TypeError, "of arcs"),
        (lambda: HybridForwardModel(None, "quadratic"), ValueError, "must be given with"),
        (
            lambda: HybridForwardModel(bha(), ELMRegressor(alpha=np.ones(3)), coupling="serial"),
            ValueError,
            "`alpha` of the error model must be one number",
        ),
        (lambda: HybridForwardModel(None, coupling="serial"), ValueError, "must be given with"),
    ],
)
def test_clear_errors(trunk, make, kind, message):
    with pytest.raises(kind, match=message):
        make().fit(*trunk)
