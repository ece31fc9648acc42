"""Which parameters are calibrated: chosen on planted robots, whose answer is known."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, HybridForwardModel
from hybridkin.calibration.calibrate import refitted
from hybridkin.calibration.choice import choose_geometry

NOISE = 5e-4


def chambers(n, spread=0.05, seed=0):
    return np.random.default_rng(seed).uniform(0.2 - spread, 0.2 + spread, (n, 3))


def measured(chain, q, seed=1):
    noise = NOISE * np.random.default_rng(seed).standard_normal((len(q), 3))
    return chain(torch.from_numpy(q)).numpy() + noise


def moved_base():
    base = torch.eye(4, dtype=torch.float64)
    base[:3, 3] = torch.tensor([0.05, -0.1, 0.2])
    return base


def bent(**geometry):
    return ConstantCurvatureChain([0.05], rest_bends=[[0.4, -0.3]], **geometry)


@pytest.mark.slow
def test_a_log_gets_the_smallest_set_that_explains_it():
    q, nominal = chambers(80), ConstantCurvatureChain([0.05])
    truths = {
        "base": ConstantCurvatureChain([0.05], base=moved_base()),
        "radii + base": ConstantCurvatureChain([0.06], base=moved_base()),
        "radii + rest_bends + base": bent(base=moved_base()),
    }
    for name, truth in truths.items():
        choice = choose_geometry(nominal, q, measured(truth, q))
        assert choice.name == name
        assert " + ".join(choice.parameters) == name
        assert choice.chain is nominal
        assert choice.errors[name].io < 3 * NOISE
        assert not choice.messages
    assert list(choice.errors)[:4] == ["nothing", *truths]


@pytest.mark.slow
def test_small_motions_do_not_calibrate_what_they_do_not_show():
    """A tenth of the range identifies the radius, and no rest bend that holds far outside."""
    truth = ConstantCurvatureChain([0.052], base=moved_base())
    near, far = chambers(80, 0.005), chambers(80, 0.05, seed=2)
    x = measured(truth, near)
    choice = choose_geometry(ConstantCurvatureChain([0.05]), near, x)
    assert choice.name == "radii + base"
    errors = []
    for names in (choice.parameters, ("radii", "angles", "rest_bends", "actuator_zeros", "base")):
        model = HybridForwardModel(ConstantCurvatureChain([0.05]), "drop", calibrate=names)
        off = model.fit(near, x).predict(far) - truth(torch.from_numpy(far)).numpy()
        errors.append(np.linalg.norm(off, axis=1).mean())
    assert errors[0] < 0.6 * errors[1]


@pytest.mark.slow
def test_slack_tendons_become_elastic():
    plain = ConstantCurvatureChain([0.005], lengths=[0.1])
    truth = ElasticTendonChain([0.005], [0.1], bending_stiffness=4e-6, axial_stiffness=8.0)
    q = np.random.default_rng(0).uniform(-0.004, 0.004, (90, 3))
    x = truth(torch.from_numpy(q)).numpy()
    choice = choose_geometry(plain, q, x + 1e-4 * np.random.default_rng(1).standard_normal(x.shape))
    assert isinstance(choice.chain, ElasticTendonChain)
    assert choice.name.startswith("elastic tendons: ")
    assert choice.errors[choice.name].cv < 0.2 * choice.errors["radii + base"].cv
    balanced = q - q.mean(axis=1, keepdims=True)
    kept = choose_geometry(plain, balanced, measured(plain, balanced))
    assert isinstance(kept.chain, ConstantCurvatureChain)
    assert not kept.messages  # a common pull bends nothing here, so that its absence is no lack


@pytest.mark.slow
def test_a_tied_log_warns_in_actuator_terms():
    nominal, q = ConstantCurvatureChain([0.05]), chambers(60)
    q[:, 2] = q[:, 0]
    x = measured(nominal, q)
    model = HybridForwardModel(nominal, "drop", calibrate="auto")
    with pytest.warns(UserWarning, match=r"log has no motion along \+1 q\[0\] -1 q\[2\] ") as said:
        model.fit(q, x)
    assert len(said) == 1
    q[:, 2] = 0.2
    with pytest.warns(UserWarning, match=r"the log has no motion along \+1 q\[2\] \("):
        model.fit(q, measured(nominal, q))


@pytest.mark.slow
def test_rows_held_out_of_a_long_log_are_predicted_from_evenly_spaced_others():
    """Of many rows 500 calibrate: with exact tips they give the robot, with noise nearly."""
    truth = bent(base=moved_base())
    q = chambers(1500)
    exact = truth(torch.from_numpy(q))
    choice = choose_geometry(ConstantCurvatureChain([0.05]), q, exact, outside=False)
    weights = torch.ones(len(q), dtype=torch.float64)
    chain = refitted(choice.start, torch.from_numpy(q), exact, weights)
    assert (chain(torch.from_numpy(q)) - exact).norm(dim=1).max() < 1e-7
    noisy = torch.from_numpy(measured(truth, q))
    chain = refitted(choice.start, torch.from_numpy(q), noisy, weights)
    assert (chain(torch.from_numpy(q)) - exact).norm(dim=1).mean() < 0.3 * NOISE
