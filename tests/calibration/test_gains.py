"""Gains of actuators, calibrated: what the data identify of them."""

import re

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    calibrate,
)
from hybridkin.calibration.calibrate import fit_geometry
from hybridkin.calibration.choice import choose_geometry

TRUE = np.array([2.7e-5, -2.5e-5, 3.0e-5, 2.2e-5, 2.9e-5, -2.6e-5])
RADII, NOISE = (0.008, 0.006), 2e-4
RINGS = np.repeat(RADII, 3)


def tendon_robot(gains=TRUE, radii=RADII, **options):
    return ConstantCurvatureChain(radii, lengths=[0.1, 0.08], gains=gains, **options)


def measured(truth, seed, n=60):
    """Return counts and tips with noise; balanced tendons about the counts at rest."""
    rng = np.random.default_rng(seed)
    bends = rng.uniform(-0.7, 0.7, (n, 2, 2))
    at = 2 * np.pi * np.arange(3) / 3
    metres = -np.array(RADII)[:, None] * (bends @ np.stack([np.cos(at), np.sin(at)]))
    q = metres.reshape(n, 6) / truth.gains.numpy() + truth.rest.numpy()
    x = truth(torch.from_numpy(q)).numpy() + NOISE * rng.standard_normal((n, 3))
    return q, x


def log_covariance(result):
    """Return the covariance of the free parameters, of scaled ones of the logarithm."""
    shares = [result.std_errors[k] / np.abs(result.values[k]) for k in ("gains", "radii")]
    std = np.concatenate(shares)
    return result.correlations[: len(std), : len(std)] * std * std[:, None]


@pytest.mark.slow
def test_gains_over_radii_to_their_standard_errors():
    """n = 60 rows, 20 seeds, 6 ratios each: 95 % should lie within 1.96 standard errors."""
    nominal = np.array([1.15, 0.9, 1.1, 0.85, 1.2, 1.0]) * TRUE
    scores = []
    for seed in range(20):
        q, x = measured(tendon_robot(), seed)
        start = tendon_robot(nominal, [0.0075, 0.0065])
        result = calibrate(start, q, x, ["gains", "radii"])
        ratio = np.log(result.values["gains"] / TRUE / np.repeat(result.values["radii"], 3) * RINGS)
        covariance = log_covariance(result)
        ring = 6 + np.repeat([0, 1], 3)
        own, other = np.diag(covariance)[:6], np.diag(covariance)[ring]
        std = np.sqrt(own + other - 2 * covariance[np.arange(6), ring])
        assert (std < 0.01).all()
        scores.append(ratio / std)
    scores = np.array(scores)
    assert 0.88 <= np.mean(np.abs(scores) < 1.96) <= 1.0
    assert 0.75 < scores.std() < 1.25
    # Radii and gains of a segment grow alike without moving the tips, and that is what it says.
    segments = []
    for sentence in result.unidentified:
        found = re.search(
            r"The data identify gains\[(\d)\] / radii\[(\d)\] = (\S+) per unit of q "
            r"\(std. error (\S+)\)\.",
            sentence,
        )
        assert found, sentence
        assert len(found[4].lstrip("0.")) == 2  # digits of the error, and as many decimals
        assert len(found[3]) == len(found[4])
        i, k = int(found[1]), int(found[2])
        assert i // 3 == k
        assert abs(float(found[3]) - TRUE[i] / RADII[k]) < 4 * float(found[4])
        segments.append(k)
    assert sorted(segments) == [0, 1]
    assert not result.identifiable["gains"].any()


def test_one_gain_of_all():
    q, x = measured(tendon_robot(), 0)
    result = calibrate(tendon_robot(1.3 * TRUE), q, x, ["gain"])
    assert result.names == ("gain",)
    assert abs(result.values["gain"] / TRUE[0] - 1) < 3 * result.std_errors["gain"] / TRUE[0]
    assert result.std_errors["gain"] < 0.01 * TRUE[0]
    assert_close(result.chain.gains.numpy() / TRUE, np.full(6, result.values["gain"] / TRUE[0]))
    assert result.identifiable["gain"]
    with pytest.raises(ValueError, match="must not hold both 'gains' and 'gain'"):
        calibrate(tendon_robot(), q, x, ["gain", "gains"])


def test_chambers_identify_gain_and_zeros_by_their_lengths():
    zeros = np.array([900.0, 1000.0, 1100.0])
    truth = ConstantCurvatureChain([0.05], gains=2e-4, actuator_zeros=zeros)
    rng = np.random.default_rng(3)
    q = zeros + rng.uniform(800, 1400, (80, 3))
    x = truth(torch.from_numpy(q)).numpy() + NOISE * rng.standard_normal((80, 3))
    start = ConstantCurvatureChain([0.055], gains=2.3e-4, actuator_zeros=1000.0)
    result = calibrate(start, q, x, ["radii", "gain", "actuator_zeros"])
    for name, true in (("gain", 2e-4), ("radii", 0.05), ("actuator_zeros", zeros)):
        assert (np.abs(result.values[name] - true) < 4 * result.std_errors[name]).all()
    assert (result.std_errors["actuator_zeros"] < 20).all()
    assert start.default_parameters == ("radii", "gain", "base")


@pytest.mark.slow
@pytest.mark.parametrize("elastic", [False, True])
def test_the_unit_of_q_changes_no_calibration(elastic):
    plain = tendon_robot(1.0)
    make = ElasticTendonChain.from_chain if elastic else lambda chain: chain
    q, x = measured(tendon_robot(), 4)
    names = ["radii", "rest_bends", "tendon_zeros" if elastic else "actuator_zeros", "base"]
    ours = calibrate(make(tendon_robot()), q, x, names)
    theirs = calibrate(make(plain), q * TRUE, x, names)
    rows = torch.from_numpy(q)
    shift = (ours.chain(rows) - theirs.chain(rows * plain.gains.new_tensor(TRUE))).abs().max()
    assert shift < 1e-8
    assert_close(ours.std_errors["radii"], theirs.std_errors["radii"], rtol=1e-6, atol=0)


@pytest.mark.slow
def test_auto_calibrates_the_gain_beside_the_radii():
    """A gain off by 27 % is not hidden in radii that count as identified."""
    q, x = measured(tendon_robot(), 0)
    start = tendon_robot(1.27 * TRUE)
    choice = choose_geometry(start, q, x)
    assert choice.name == "radii + base + gain"
    assert all(("gain" in name) == ("radii" in name) for name in choice.errors)
    result = fit_geometry(start, q, x, choice.parameters, start=choice.start)
    assert not result.identifiable["radii"].any()
    ratio = result.values["gain"] / result.values["radii"][0]
    assert abs(ratio / (TRUE[0] / RADII[0]) - 1) < 0.01
    assert "The data identify gain / radii[0]" in result.unidentified[0]
