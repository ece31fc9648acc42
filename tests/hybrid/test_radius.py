"""The radius about a predicted tip: it covers new motions like the known ones, or is infinite."""

import numpy as np
import pytest
import torch
from sklearn.linear_model import Ridge

from hybridkin import (
    ConstantCurvatureChain,
    ELMRegressorCV,
    HybridForwardModel,
    robots,
)
from hybridkin.hybrid._radius import covering_distance
from hybridkin.hybrid.log_fit import fit_to_log


def motions(seed, n_motions=240, n=6, noise=2e-3):
    """Short motions of a trunk whose tip is off by a smooth error, a small offset each, and noise.

    Simulated: the mechanical model is exact but for these.
    """
    rng = np.random.default_rng(seed)
    chain = robots.bionic_handling_assistant()
    start = rng.uniform(0.18, 0.32, (n_motions, 1, 9))
    q = start + 0.02 * rng.uniform(-1, 1, (n_motions, n, 9))
    q, motion = q.reshape(-1, 9), np.repeat(np.arange(n_motions), n)
    x = chain(torch.from_numpy(q)).numpy() + 0.02 * np.sin(15 * q[:, :3] + q[:, 3:6])
    x = (
        x
        + 1e-3 * rng.standard_normal((n_motions, 3))[motion]
        + noise * rng.standard_normal(x.shape)
    )
    return q, x, motion


def few(n, coverage, groups=True, error_model="drop"):
    """Return a fit to few motions, its warnings, and its rows."""
    q, x, motion = motions(0, n, 4)
    model = HybridForwardModel(robots.bionic_handling_assistant(), error_model, coverage=coverage)
    fitted = fit_to_log(*model.prepared(q, x, groups=motion if groups else None))
    model.take_fit(fitted)
    return model, fitted.messages, q


@pytest.mark.parametrize(("n", "finite"), [(8, False), (9, True)])
def test_as_many_groups_as_the_coverage_needs(n, finite):
    model, messages, q = few(n, 0.9)
    assert np.isfinite(model.radius_.inside) == finite
    assert np.isfinite(model.predict(q, return_radius=True)[1]).all() == finite
    found = [message for message in messages if "at least 9 groups" in message]
    assert len(found) == (not finite)


def test_every_group_has_the_same_mass():
    values, groups = np.array([1.0, 2.0, 3.0, 5.0, 4.0, 6.0]), np.array([0, 0, 0, 0, 1, 2])
    ones = np.ones(6)
    # Masses: 1/16 for each value of the first group, 1/4 for 4 and for 6.
    assert covering_distance(values, groups, ones, 3 / 16) == 3.0
    assert covering_distance(values, groups, ones, 7 / 16) == 4.0
    assert covering_distance(values, groups, ones, 0.5) == 5.0
    assert covering_distance(values, groups, ones, 0.75) == 6.0
    assert covering_distance(values, groups, ones, 0.76) == np.inf


@pytest.mark.slow
@pytest.mark.parametrize(("n_motions", "n"), [(40, 1), (12, 5)], ids=["rows", "few motions"])
def test_coverage_over_many_logs(n_motions, n):
    """The mean over logs is at least the coverage, but for the error of 30 of them."""
    chain, covered = ConstantCurvatureChain([0.05]), []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        motion = np.repeat(np.arange(n_motions + 100), n)
        q = 0.25 + 0.05 * rng.uniform(-1, 1, (len(motion), 3))
        x = chain(torch.from_numpy(q)).numpy() + 0.02 * np.sin(15 * q)
        x = x + 2e-3 * rng.standard_normal((motion[-1] + 1, 3))[motion]
        old = motion < n_motions
        model = HybridForwardModel(chain, Ridge(1e-3), coverage=0.9)
        model.fit(q[old], x[old], groups=motion[old])
        tips, radius = model.predict(q[~old], return_radius=True)
        known = np.isfinite(radius)
        covered.append(np.mean((np.linalg.norm(tips - x[~old], axis=1) <= radius)[known]))
    assert np.mean(covered) > 0.9 - 2.0 * np.std(covered) / np.sqrt(30)
    assert np.mean(covered) < 0.97


def test_clear_errors():
    q, x, _ = motions(0, 4)
    chain = robots.bionic_handling_assistant()
    with pytest.raises(ValueError, match="'coverage'"):
        HybridForwardModel(chain, coverage=90).fit(q, x)
    with pytest.raises(ValueError, match="needs a model that was fitted with `coverage`"):
        HybridForwardModel(chain).fit(q, x).predict(q, return_radius=True)
    with pytest.raises(ValueError, match="`groups` must hold at least two motions"):
        HybridForwardModel(chain, coverage=0.9).fit(q, x, groups=np.zeros(len(q)))


@pytest.mark.parametrize(
    ("n", "error_model"),
    [
        (2, "linear"),
        (3, "linear"),
        (2, ELMRegressorCV(8, cv=2, relevance_rounds=0, max_hidden=0)),
        pytest.param(2, "kernel", marks=pytest.mark.slow),
    ],
)
def test_a_radius_of_two_motions_holds_out_one_and_then_rows(n, error_model):
    """Without one of two motions a single one is left, whose rows are then held out."""
    q, x, motion = motions(0, n, 12)
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(
        chain, error_model, calibrate=["radii"], coverage=0.5, random_state=0
    )
    fitted = fit_to_log(*model.prepared(q, x, groups=motion))
    told = any("`coverage`" in text for text in fitted.messages)
    assert (fitted.radius.inside < 0.2) == (not told)
    with pytest.raises(ValueError, match="`groups` must hold at least two motions"):
        model.fit(q[:12], x[:12], groups=motion[:12])


def test_equal_rows_of_several_motions_have_a_radius():
    """Rows are merged before folds; the outer ones are then places among the merged rows."""
    q, x, _ = motions(0, 3, 1)
    rows = np.repeat(np.arange(2), 5)[:9]
    motion = np.array([0, 1, 2, 0, 1, 2, 0, 1, 2])
    model = HybridForwardModel(robots.bionic_handling_assistant(), "auto", coverage=0.5)
    model.set_params(calibrate=["base"], random_state=0)
    fitted = fit_to_log(*model.prepared(q[rows], x[rows], groups=motion))
    assert fitted.radius.coverage == 0.5
    assert fitted.radius.inside > 0.0
