"""The error model chosen by held-out motions: what it takes, and what it reports."""

import pickle
import warnings

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from sklearn.base import clone

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    datasets,
    load_model,
    robots,
    save_model,
)

ELASTIC_SET = "base + turns + rest_bends + tool + tendon_zeros + stiffnesses"


def bha():
    return robots.bionic_handling_assistant()


@pytest.fixture(scope="module")
def trunk():
    data = datasets.load_trunk()
    order = np.random.default_rng(0).permutation(np.flatnonzero(data.part == 3))
    return data.q[order], data.x[order]


@pytest.fixture(scope="module")
def chosen(trunk):
    q, x = trunk
    model = HybridForwardModel(bha(), "auto", calibrate="default", random_state=0)
    return model.fit(q[:250], x[:250], groups=np.arange(250) // 5)


@pytest.mark.slow
def test_no_worse_than_the_single_candidates(chosen, trunk):
    q, x = trunk
    error = np.linalg.norm(chosen.predict(q[250:]) - x[250:], axis=1).mean()
    singles = [
        HybridForwardModel(bha(), name, coupling=coupling, calibrate="default")
        for name in ("linear", "quadratic", "drop")
        for coupling in ("parallel", "serial")
    ]
    errors = [
        np.linalg.norm(m.fit(q[:250], x[:250]).predict(q[250:]) - x[250:], axis=1).mean()
        for m in singles
    ]
    assert error < 1.03 * min(errors)
    assert error < 0.75 * errors[-1]


@pytest.mark.slow
def test_it_says_what_it_chose(chosen):
    results = chosen.cv_results_
    n = len(results["candidate"])
    assert len(set(results["candidate"])) == n >= 6
    shares = results["weights"]
    assert [*shares, "blend"] == results["candidate"]
    assert abs(sum(shares.values()) - 1.0) < 1e-12
    taken = [name for name, share in shares.items() if share > 0.0]
    assert results["chosen"] == (taken[0] if len(taken) == 1 else "blend")
    assert results["parameters"] == "radii + base"
    assert results["mechanical_model"].keys() == {"radii + base"}
    own = results["mechanical_model"]["radii + base"]
    assert (own["cv"], own["io"]) == (results["mean_distance"][0], results["io_distance"][0])
    assert results["io_distance"].shape == (n,)
    assert results["std_distance"].shape == (n,)
    assert results["mean_distance"][-1] < 1.01 * results["mean_distance"].min()
    # Penalties chosen on 50 motions hardly suit one of them more than new ones.
    of_chosen = 0 if shares[results["candidate"][0]] == 1.0 else -1
    assert results["expected_distance"] == results["mean_distance"][of_chosen]
    assert chosen._fit.error.noise == pytest.approx(results["expected_distance"] / 1.596)


@pytest.mark.slow
def test_candidates_are_the_models_that_auto_compared(chosen, trunk, tmp_path):
    q = torch.from_numpy(trunk[0])
    weights = chosen.cv_results_["weights"]
    assert chosen.candidates_.keys() == weights.keys()
    with torch.no_grad():
        tips = {name: module(q).numpy() for name, module in chosen.candidates_.items()}
    with torch.no_grad():
        structural = chosen.fitted_module_.mechanical(q).numpy()
    assert_allclose(tips["structural"], structural, atol=1e-12)
    blend = sum(weight * tips[name] for name, weight in weights.items())
    assert_allclose(blend, chosen.predict(trunk[0]), atol=2e-4)
    copied = pickle.loads(pickle.dumps(chosen))
    assert_array_equal(copied.candidates_["serial pose"](q).detach(), tips["serial pose"])
    assert not hasattr(clone(chosen), "candidates_")
    save_model(chosen, tmp_path / "model.safetensors")
    assert load_model(tmp_path / "model.safetensors").candidates_ is None


@pytest.mark.slow
def test_slack_tendons_get_elastic_ones():
    plain = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1], routing="base")
    stiffness = {"bending_stiffness": 4e-6, "axial_stiffness": 8.0}
    robot = ElasticTendonChain.from_chain(plain, **stiffness)
    rng = np.random.default_rng(0)
    q = rng.uniform(-0.003, 0.003, (120, 6))
    x = robot(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((120, 3))
    model = HybridForwardModel(plain, "auto", calibrate=("radii", "base"), random_state=0)
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # that the plain chain cannot know slack is no news here
        model.fit(q[:80], x[:80])
    scores = model.cv_results_["mechanical_model"]
    assert model.cv_results_["parameters"] == "elastic tendons: " + ELASTIC_SET
    assert scores["elastic tendons: " + ELASTIC_SET]["cv"] < 0.2 * scores["radii + base"]["cv"]
    assert isinstance(model.mechanical_model_, ElasticTendonChain)
    assert isinstance(model.mechanical_model, ConstantCurvatureChain)
    assert np.linalg.norm(model.predict(q[80:]) - x[80:], axis=1).mean() < 1e-3
    as_given = HybridForwardModel(plain, "auto", calibrate=(), random_state=0)
    with pytest.warns(UserWarning, match="ElasticTendonChain") as said:
        as_given.fit(q[:80], x[:80])
    assert len(said) == 1  # of all rows, not of every fold and candidate again
    assert isinstance(as_given.mechanical_model_, ConstantCurvatureChain)


@pytest.mark.slow
@pytest.mark.parametrize("groups", [None, [0, 1]])
def test_auto_takes_two_rows(groups):
    """Each is the inner row, or the training row, of the other."""
    data = datasets.load_trunk()
    model = HybridForwardModel(bha(), "auto", calibrate=(), random_state=0)
    with pytest.warns(UserWarning, match="too few to rely on"):
        model.fit(data.q[:2], data.x[:2], groups=groups)
    assert np.isfinite(model.predict(data.q[:50])).all()
    assert sum(model.cv_results_["weights"].values()) == pytest.approx(1.0)


def test_auto_without_a_mechanical_model():
    """A linear function, a network and a kernel; each wins where the data are of its kind."""
    rng = np.random.default_rng(0)
    q = rng.uniform(0.0, 1.0, (120, 2))
    bent = np.stack([np.sin(5.0 * q[:, 0]), q.prod(axis=1), np.cos(4.0 * q[:, 1])], axis=1)
    straight = q @ rng.standard_normal((2, 3)) + 0.01 * rng.standard_normal((120, 3))
    model = HybridForwardModel(None, "auto", random_state=0).fit(q, bent)
    assert [*model.candidates_] == ["linear", "ELM", "kernel"]
    assert model.cv_results_["weights"]["linear"] == 0.0
    assert np.abs(model.predict(q) - bent).max() < 0.05
    linear = HybridForwardModel(None, "auto", random_state=0).fit(q, straight)
    assert linear.cv_results_["mean_distance"][-1] < 1.1 * 0.01 * 1.6
    with pytest.raises(ValueError, match="`mechanical_model` must be given"):
        HybridForwardModel(None, "auto", coupling="serial").fit(q, bent)
