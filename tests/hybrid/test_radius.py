"""The radius about a predicted tip: it covers new motions as promised, and widens outside."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from sklearn.linear_model import Ridge
from sklearn.model_selection import GroupShuffleSplit

from hybridkin import HybridForwardModel, load_model, robots, save_model
from hybridkin.hybrid._radius import _quantile


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


@pytest.mark.slow
@pytest.mark.parametrize("coverage", [0.5, 0.9])
@pytest.mark.parametrize("error_model", [None, "drop", Ridge(1e-3)], ids=["elm", "drop", "ridge"])
def test_unseen_motions_are_covered(coverage, error_model):
    covered = []
    for seed in range(10):
        q, x, motion = motions(seed)
        split = GroupShuffleSplit(1, test_size=0.4, random_state=seed).split(q, x, motion)
        train, test = next(split)
        model = HybridForwardModel(
            robots.bionic_handling_assistant(), error_model, coverage=coverage, random_state=seed
        ).fit(q[train], x[train], groups=motion[train])
        tips, radius = model.predict(q[test], return_radius=True)
        assert_allclose(tips, model.predict(q[test]))
        covered.append(np.mean(np.linalg.norm(tips - x[test], axis=1) < radius))
    assert abs(np.mean(covered) - coverage) < 0.05


def test_wider_outside_the_domain_and_monotone_in_coverage():
    q, x, motion = motions(0)
    narrow, wide = (
        HybridForwardModel(
            robots.bionic_handling_assistant(), coverage=coverage, random_state=0
        ).fit(q, x, groups=motion)
        for coverage in (0.5, 0.95)
    )
    assert narrow.radius_.inside < wide.radius_.inside
    far = q + 0.2
    _, inside = wide.predict(q, return_radius=True)
    _, outside = wide.predict(far, return_radius=True)
    assert_allclose(inside, wide.radius_.inside)
    assert outside.min() > 1.5 * inside.max()
    assert outside.max() <= wide.radius_.outside


def test_weights_are_repetitions():
    values = np.array([3.0, 1.0, 2.0, 5.0, 4.0])
    counts = np.array([2, 1, 3, 1, 4])
    for coverage in (0.1, 0.5, 0.8, 0.99):
        repeated = _quantile(np.repeat(values, counts), np.ones(counts.sum()), coverage)
        assert _quantile(values, counts.astype(float), coverage) == repeated


def test_one_dimensional_targets_and_no_mechanical_model():
    q, x, _ = motions(0, 10)
    model = HybridForwardModel(None, coverage=0.9, random_state=0).fit(q, x[:, 0])
    tips, radius = model.predict(q, return_radius=True)
    assert tips.shape == radius.shape == (len(q),)
    assert np.mean(np.abs(tips - x[:, 0]) < radius) > 0.85


def test_it_is_saved(tmp_path):
    q, x, motion = motions(0, 20)
    model = HybridForwardModel(robots.bionic_handling_assistant(), coverage=0.8, random_state=0)
    model.fit(q, x, groups=motion)
    save_model(model, tmp_path / "model.safetensors")
    back = load_model(tmp_path / "model.safetensors")
    assert back.radius_ == model.radius_
    assert back.coverage == 0.8
    assert_allclose(back.predict(q, True)[1], model.predict(q, True)[1])


def test_clear_errors():
    q, x, _ = motions(0, 4)
    chain = robots.bionic_handling_assistant()
    with pytest.raises(ValueError, match=r"`coverage` must lie in \(0, 1\)"):
        HybridForwardModel(chain, coverage=90).fit(q, x)
    with pytest.raises(ValueError, match="needs a model that was fitted with `coverage`"):
        HybridForwardModel(chain).fit(q, x).predict(q, return_radius=True)
    with pytest.raises(ValueError, match="needs at least two groups"):
        HybridForwardModel(chain, coverage=0.9).fit(q, x, groups=np.zeros(len(q)))
