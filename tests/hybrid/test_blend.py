"""Hybrids averaged: value, Jacobian, domain and drift of the mean."""

import pytest
import torch
from torch.testing import assert_close

from hybridkin import ELMRegressor, HybridForwardModel, datasets, robots
from hybridkin.hybrid._module import HybridModule
from hybridkin.learning.regressor_modules import AffineModule

WEIGHTS = torch.tensor([0.5, 0.3, 0.2], dtype=torch.float64)


@pytest.fixture(scope="module")
def log():
    data = datasets.load_trunk()
    return data.q[::8], data.x[::8]


@pytest.fixture(scope="module")
def parts(log):
    chain = robots.bionic_handling_assistant()
    models = [
        HybridForwardModel(chain, ELMRegressor(30, random_state=0)),
        HybridForwardModel(chain, "linear", coupling="serial"),
        HybridForwardModel(chain, "quadratic", guard=None),
    ]
    return [model.fit(*log).module_ for model in models]


def blended(parts, weights):
    corrections = [correction for part in parts for correction in part.corrections]
    return HybridModule(parts[0].mechanical, corrections, weights)


@pytest.fixture(scope="module")
def blend(parts):
    return blended(parts, WEIGHTS)


@pytest.fixture
def q(log):
    near = torch.from_numpy(log[0][:20])
    far = 0.1 + 0.3 * torch.rand(20, 9, generator=torch.manual_seed(0), dtype=torch.float64)
    return torch.cat([near, far])


def mean(parts, function):
    return sum(w * function(part) for w, part in zip(WEIGHTS, parts, strict=True))


def test_all_is_the_mean_of_the_parts(blend, parts, q):
    assert_close(blend(q), mean(parts, lambda part: part(q)))
    assert_close(blend.jacobian(q), mean(parts, lambda part: part.jacobian(q)))
    assert_close(blend.error_weight(q), mean(parts, lambda part: part.error_weight(q)))
    assert_close(blend.mechanical(q) + blend.error_part(q), blend(q))
    trusted = blend.in_domain(q)
    assert (trusted == torch.stack([part.in_domain(q) for part in parts]).all(0)).all()
    assert trusted.any()
    assert not trusted.all()


def test_drift_is_added_once_and_leaves_the_parts_alone(blend, parts, q):
    slope = torch.full((3, 9), 0.1, dtype=torch.float64)
    drift = AffineModule(slope, torch.full((3,), 0.01, dtype=torch.float64))
    moved = blend.with_drift(drift)
    expected = blend(q) + blend.error_weight(q)[:, None] * drift(q)
    assert_close(moved(q), expected)
    assert blend.drift is None
    assert all(part.drift is None for part in parts)
    h, J = 1e-6, moved.jacobian(q)
    ahead = [(moved(q + h * e) - moved(q - h * e)) / (2 * h) for e in torch.eye(9).double()]
    assert_close(torch.stack(ahead, -1), J, rtol=0.0, atol=1e-6)
