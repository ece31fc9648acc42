"""Directions that no row moves: corrections are constant along them, and the domain ends there."""

import warnings

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.linear_model import LinearRegression
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressor,
    ELMRegressorCV,
    HybridForwardModel,
)
from hybridkin._core.directions import moved_directions
from hybridkin.native.library import backend, evaluate

CHAIN = ConstantCurvatureChain([0.05, 0.05])
ELM = ELMRegressor(20, direct_link=True, random_state=0)
CV = ELMRegressorCV(20, cv=3, relevance_rounds=1, max_hidden=20, random_state=0)
PARALLEL = ["quadratic", "pose", ELM, CV, "kernel", LinearRegression()]
MODELS = [("parallel", model) for model in PARALLEL]
MODELS += [("serial", model) for model in ("quadratic", "pose", ELM, CV)]
NOISE = 1e-5 * np.random.default_rng(1).standard_normal((40, 3))
PAIRS = [("line", "leverage"), ("line", None), ("rest", "leverage")]


def tips(q):
    """The measured tips of a robot whose error depends on all actuators."""
    u = (q - 0.25) / 0.05
    error = np.stack([u[:, 0] + u[:, 3], u[:, 1] * u[:, 4], np.sin(u[:, 5] + u[:, 2])], axis=1)
    return CHAIN(torch.from_numpy(q.astype(float))).numpy() + 0.01 * error + NOISE[: len(q)]


def log(kind, n=40):
    """Rows q (n, 6) of one posture, on a line, or with one actuator at rest."""
    q = 0.25 + 0.05 * np.random.default_rng(0).uniform(-1.0, 1.0, (n, 6))
    if kind == "posture":
        q[:] = q[0]
    if kind == "line":
        q = np.linspace(q[0], q[1], n)
    if kind == "rest":
        q[:, 4] = 0.26
    return q


def fitted(q, *args, groups=None, **options):
    model = HybridForwardModel(CHAIN, *args, random_state=0, **options)
    with pytest.warns(UserWarning, match=r"the log h(olds a single|as no motion along)"):
        return model.fit(q, tips(q), groups=groups)


def across(q):
    """Steps (K, 6) of half the range along the directions that no row moves."""
    directions = moved_directions(q)
    return directions.still.T * directions.scale


@pytest.mark.parametrize("guard", ["leverage", None])
@pytest.mark.parametrize(("coupling", "error_model"), MODELS, ids=str)
def test_nothing_is_learned_from_one_posture(coupling, error_model, guard):
    q = log("posture")
    model = fitted(q, error_model, coupling=coupling, guard=guard)
    new = np.vstack([q[:1], q[:1] + 1e-4, log("all")[1:]])
    assert_array_equal(model.predict(new), model.predict_mechanical(new))
    assert_array_equal(model.in_domain(new), [True] + [False] * 40)
    assert model.error_model_ is None


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "guard"), PAIRS)
@pytest.mark.parametrize(("coupling", "error_model"), MODELS, ids=str)
def test_corrections_are_constant_where_no_row_moves(coupling, error_model, kind, guard):
    q = log(kind)
    model = fitted(q, error_model, coupling=coupling, guard=guard)
    (correction,) = model.module_.corrections
    learned = correction.module
    rows = torch.from_numpy(q[::5])
    for step in across(q):
        assert_close(learned(rows + torch.from_numpy(3 * step)), learned(rows), rtol=0, atol=1e-11)
    J = learned.forward_and_jacobian(rows)[1]
    assert (J @ torch.from_numpy(across(q).T)).abs().max() < 1e-10
    # The domain ends after a tenth of the range, where mechanics predict nothing after a hundredth.
    assert model.in_domain(q).all()
    plane = model.module_.plane
    assert (plane.n_normals == 0) == (kind == "rest")
    for step in across(q):
        assert not model.in_domain(q + 0.3 * step).any()
        assert plane.n_normals or model.in_domain(q[18:22] + 0.1 * step).all()
    for normal in plane.normals.numpy().T:
        assert not model.in_domain(q + 0.003 * normal).any()
        assert model.in_domain(q + 1e-6 * normal).all()


@pytest.mark.needs_core
@pytest.mark.parametrize("kind", ["posture", "line", "rest"])
@pytest.mark.parametrize("groups", [None, np.arange(40) // 5])
def test_one_domain_in_torch_and_compiled(kind, groups):
    q, rng = log(kind), np.random.default_rng(2)
    for coupling, error_model in (MODELS[2], MODELS[6]):
        model = fitted(q, error_model, coupling=coupling, groups=groups)
        assert backend(model.module_) == "compiled"
        steps = across(q)
        for size in (0.0, 0.05, 1.0):
            new = q[::7] + size * rng.standard_normal((6, len(steps))) @ steps
            x, J = model.predict_and_jacobian(new)
            expected = model.module_.forward_and_jacobian(torch.from_numpy(new))
            assert_allclose(x, expected[0].numpy(), rtol=0, atol=1e-10)
            assert_allclose(J, expected[1].numpy(), rtol=0, atol=1e-7)
            distance = model.module_.domain_distance(torch.from_numpy(new)).numpy()
            (found,) = evaluate(model.module_, new, value=False, distance=True)
            assert_allclose(found, distance, rtol=1e-8, atol=1e-12)


def test_a_log_that_moves_all_is_not_projected():
    q = log("all")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = HybridForwardModel(CHAIN, "linear", guard=None).fit(q, tips(q))
    assert model.module_.tested is None
    assert model.in_domain(10.0 * q).all()
    assert not moved_directions(q).still.size


def test_a_range_of_rounding_errors_is_no_motion():
    q = log("all")
    q[:, 2] = 0.1 + 0.2 - 0.05 * (1.0 + 1e-16 * np.arange(40))
    q[::2, 2] = np.nextafter(q[::2, 2], 1.0)
    directions = moved_directions(q)
    assert_allclose(np.abs(directions.still[:, 0]), np.eye(6)[2], atol=1e-12)
    assert directions.scale[2] == directions.scale.max()
