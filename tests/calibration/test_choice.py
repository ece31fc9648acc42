"""Which parameters are calibrated: chosen on planted robots, whose answer is known."""

import numpy as np
import pytest
import torch

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    GeometryChoice,
    HybridForwardModel,
    RigidChain,
    calibrate,
)
from hybridkin._core.groups import Groups
from hybridkin.calibration.calibrate import refitted
from hybridkin.calibration.choice import choose_geometry
from hybridkin.calibration.measured import inner_and_outer

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


PLANAR = RigidChain(
    np.stack([np.eye(4), *2 * [[[1, 0, 0, 0.2], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]]]),
    [[0, 0, 1], [0, 1, 0], [0, 1, 0]],
    tool=[0.1, 0.0, 0.0],
)


def log_of_motions(n=30):
    """Rows of an arm with a moved base in three motions, each with an error of its own."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (n, 3))
    groups = np.arange(n) % 3
    x = PLANAR.with_geometry(base=moved_base())(torch.from_numpy(q)).numpy()
    x = x + 0.02 * rng.standard_normal((3, 3))[groups] + 1e-3 * rng.standard_normal((n, 3))
    q[4], x[4] = q[3], x[3]  # a row of two motions
    return q, x, groups, np.arange(n) // 3 % 3


def test_each_set_is_scored_on_whole_motions_with_the_weights_of_rows():
    """Against calibrations to the other two motions."""
    q, x, groups, weights = log_of_motions()
    own = {"groups": groups, "weights": weights, "outside": False}
    errors = choose_geometry(PLANAR, q, x, **own).errors
    sets = [" + ".join(names) or "nothing" for names in PLANAR.parameter_sets]
    assert [*errors] == sets
    assert sets[-1] == "base + tool + joint_zeros + links + axes"
    rows = torch.from_numpy(q)
    for name in sets[:2]:
        total = 0.0
        for motion in range(3):
            chain = PLANAR
            kept = groups != motion
            if name == "base":
                own = {"sample_weight": weights[kept]}
                chain = calibrate(PLANAR, q[kept], x[kept], ("base",), **own).chain
            distance = np.linalg.norm(chain(rows).numpy() - x, axis=1)
            total += weights[~kept] @ distance[~kept]
        # The fits that are compared end at steps of 1e-4.
        assert errors[name].cv == pytest.approx(total / weights.sum(), rel=1e-3)


@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
def test_weights_are_repetitions_and_names_and_order_do_not_matter(loss):
    q, x, groups, weights = log_of_motions()
    own = {"outside": False, "loss": loss}
    weighted = choose_geometry(PLANAR, q, x, groups=groups, weights=weights, **own)
    repeated = np.random.default_rng(1).permutation(np.repeat(np.arange(len(q)), weights))
    names = np.array(["b", "c", "a"])[(groups + 1) % 3]
    many = x[repeated] + 1e-9 * np.arange(len(repeated))[:, None]  # or equal rows are merged
    expanded = choose_geometry(PLANAR, q[repeated], many, groups=names[repeated], **own)
    for name, found in weighted.errors.items():  # fits end at steps of 1e-4
        assert found.cv == pytest.approx(expanded.errors[name].cv, rel=1e-3)
    for name, value in weighted.start.problem.chain_at(weighted.start.theta).geometry().items():
        there = expanded.start.problem.chain_at(expanded.start.theta).geometry()[name]
        torch.testing.assert_close(value, there, rtol=1e-3, atol=1e-4)


def test_equal_rows_are_one_row_that_counts_as_often():
    q, x, _, _ = log_of_motions(45)
    weights = 1 + np.arange(45) % 3
    repeated = np.repeat(np.arange(45), weights)
    weighted = choose_geometry(PLANAR, q, x, weights=weights)
    expanded = choose_geometry(PLANAR, q[repeated], x[repeated])
    assert np.isfinite(weighted.errors["base"].io)
    for name, found in weighted.errors.items():
        np.testing.assert_allclose(found, expanded.errors[name], rtol=1e-9)


def test_groups_choose_another_set_than_rows():
    """Motions with an error each: among rows of all motions the base seems to be known."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (60, 3))[np.arange(60) // 20]
    q = q + 0.01 * rng.standard_normal(q.shape)
    groups = np.arange(60) // 20
    exact = PLANAR(torch.from_numpy(q)).numpy()
    x = exact + 0.05 * rng.standard_normal((3, 3))[groups]
    choices = [choose_geometry(PLANAR, q, x, groups=g, outside=False) for g in (None, groups)]
    assert "base" in choices[0].parameters
    assert choices[1].name == "nothing"


@pytest.mark.parametrize("unit", [1e-3, 1e3])
def test_inner_and_outer_rows_do_not_depend_on_the_units_of_columns(unit):
    X = np.random.default_rng(0).standard_normal((50, 3)) * [1.0, 0.3, 2.0] + 5.0
    inner, outer = inner_and_outer(X)
    away = X - X.mean(axis=0)
    distance = np.einsum("ni,ij,nj->n", away, np.linalg.inv(away.T @ away), away)
    assert distance[inner].max() < np.delete(distance, inner).min()
    assert distance[outer].min() > np.delete(distance, outer).max()
    assert (len(inner), len(outer)) == (20, 18)
    scaled = inner_and_outer(X * [1.0, unit, 1.0])
    np.testing.assert_array_equal(scaled[0], inner)
    np.testing.assert_array_equal(scaled[1], outer)
    still = inner_and_outer(np.insert(X, 1, 0.2 + 3e-17 * (np.arange(50) % 2), axis=1))
    np.testing.assert_array_equal(still[1], outer)


@pytest.mark.parametrize("names", [np.arange(5), np.array([*"dbaec"])])
def test_folds_hold_out_whole_groups(names):
    groups = names[np.random.default_rng(0).permutation(np.arange(40) % 5)]
    for shuffle in (False, True):
        splits = Groups(groups).folds(3, shuffle)
        assert len(splits) == 3
        for train, test in splits:
            assert not set(groups[train]) & set(groups[test])
            assert sorted([*train, *test]) == [*range(40)]
        assert sorted(np.concatenate([test for _, test in splits])) == [*range(40)]


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


def test_the_chain_alone_is_that_of_the_calibration_far_within_the_noise():
    truth = bent(base=moved_base())
    nominal = ConstantCurvatureChain([0.05])
    q = chambers(80)
    x = measured(truth, q)
    at = torch.from_numpy(chambers(50, seed=2))
    for choice in (choose_geometry(nominal, q, x), GeometryChoice(nominal, ("base",))):
        whole = choice.calibrate(q, x).chain
        apart = (choice.fitted(q, x)(at) - whole(at)).norm(dim=1)
        assert apart.max() < 0.1 * NOISE
        assert (whole(at) - nominal(at)).norm(dim=1).min() > 100 * NOISE
    assert GeometryChoice(nominal, ()).fitted(q, x) is nominal


def test_unknown_parameters_are_named():
    q = np.random.default_rng(0).uniform(0.2, 0.3, (10, 3))
    with pytest.raises(ValueError, match="`parameters` must name different entries"):
        choose_geometry(PLANAR, q, np.zeros((10, 3)), parameters=["tool_"])


def test_repr_of_a_choice_is_one_line():
    q = chambers(60)
    choice = choose_geometry(bent(), q, measured(bent(), q))
    n_sets = len(choice.errors)
    assert n_sets > 1
    expected = (
        f"GeometryChoice(ConstantCurvatureChain, {choice.parameters}, {n_sets} sets compared)"
    )
    assert repr(choice) == expected
