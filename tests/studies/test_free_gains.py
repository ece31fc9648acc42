"""The study of calibrated gains: its folds, and what it compares."""

import numpy as np
import pytest
import torch
from free_gains import EXTRA, Fold, examined, gains_report

from hybridkin import ConstantCurvatureChain


def test_gains_that_are_off_are_found_on_held_out_rows():
    truth = np.array([1.2e-3, 1.0e-3, 0.8e-3])
    rng = np.random.default_rng(0)
    q = rng.uniform(-3, 3, (60, 3))
    q -= (truth * q).mean(1, keepdims=True) / truth
    x = ConstantCurvatureChain([0.01], lengths=[0.1], gains=truth)(torch.from_numpy(q)).numpy()
    chain = ConstantCurvatureChain([0.01], lengths=[0.1], gains=0.9e-3)
    fold = Fold("simulated", chain, ("base",), (q[:40], x[:40]), (q[40:], x[40:]))
    found = examined(fold)
    assert [*found] == [*EXTRA]
    assert found["all"] < 1e-3 < 0.1 * found["one gain"] < 0.1 * found["gains fixed"]


def test_without_the_recordings_the_table_is_empty(tmp_path):
    with pytest.warns(UserWarning, match="Left out: "):
        report = gains_report(tmp_path)
    assert report.record["errors"] == {}
