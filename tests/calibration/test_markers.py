"""Calibration to several markers, some of them missing."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, calibrate

MARKERS = [(0, 1.0), (1, 1.0, (0.02, 0.0, 0.0)), (2, 1.0)]
NOMINAL = ConstantCurvatureChain([0.11, 0.11, 0.11]).with_markers(MARKERS)
TRUTH = np.array([0.1, 0.09, 0.08])
NOISE = 1e-3


def log(n=80, seed=0):
    rng = np.random.default_rng(seed)
    q = 0.25 + 0.03 * rng.standard_normal((n, 9))
    truth = NOMINAL.with_geometry(radii=torch.from_numpy(TRUTH))
    return q, truth(torch.from_numpy(q)).numpy() + NOISE * rng.standard_normal((n, 9))


def without(x, share=0.4, seed=1):
    """Return x with a share of the markers missing; every row keeps one."""
    missing = np.random.default_rng(seed).random((len(x), 3)) < share
    missing[:, 2] &= ~missing.all(axis=1)
    return np.where(missing.repeat(3, axis=1), np.nan, x)


@pytest.mark.slow
@pytest.mark.parametrize("loss", ["linear", "soft_l1"])
@pytest.mark.parametrize("share", [0.0, 0.4])
def test_radii_are_found_to_their_standard_errors(loss, share):
    q, x = log()
    result = calibrate(
        NOMINAL, q, without(x, share), ("radii", "base"), loss=loss, groups=np.arange(80) // 10
    )
    apart = (result.values["radii"] - TRUTH) / result.std_errors["radii"]
    assert np.abs(apart).max() < 3.0
    np.testing.assert_allclose([result.rmse, result.cv_rmse], 3**0.5 * NOISE, rtol=0.15)


def test_a_missing_marker_counts_as_no_row_of_its_own():
    """Rows of one marker each give what the rows of single markers give together."""
    q, x = log(60)
    kept = np.eye(3, dtype=bool)[np.arange(60) % 3].repeat(3, axis=1)
    few = calibrate(NOMINAL, q, np.where(kept, x, np.nan), ("radii",), prior=1e3)
    tips, errors = NOMINAL.each_tip(), []
    for k, tip in enumerate(tips):
        rows = np.arange(60) % 3 == k
        chain = few.chain.each_tip()[k]
        found = chain(torch.from_numpy(q[rows])).numpy() - x[rows, 3 * k : 3 * k + 3]
        errors.append((found**2).sum(axis=1))
        assert tip.n_outputs == 3
    np.testing.assert_allclose(few.rmse, np.sqrt(np.mean(np.concatenate(errors))), rtol=1e-9)


def test_equal_markers_give_what_one_gives():
    """The same marker three times: the same values, and errors smaller by the root of three."""
    q, x = log()
    tip = x[:, 6:]
    one = calibrate(NOMINAL.tip_model, q, tip, ("radii",), prior=1e3)
    three = NOMINAL.with_markers([(2, 1.0)] * 3)
    same = calibrate(three, q, np.tile(tip, 3), ("radii",), prior=1e3)
    np.testing.assert_allclose(same.values["radii"], one.values["radii"], rtol=1e-7)
    ratio = one.std_errors["radii"] / same.std_errors["radii"]
    np.testing.assert_allclose(ratio, 3**0.5, rtol=0.01)
