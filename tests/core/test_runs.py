"""Runs in a row: their order, steps in time, and names."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from hybridkin._core.runs import BEGINS, RunOrder, numbered


@pytest.mark.parametrize("seed", range(5))
def test_runs_come_one_after_the_other(seed):
    rng = np.random.default_rng(seed)
    names = rng.choice(["b", "a", "10", "9"], rng.integers(0, 40))
    time = np.sort(rng.uniform(0.0, 9.0, len(names)))
    runs = RunOrder.of(names)
    expected = [np.flatnonzero(names == name) for name in np.unique(names)]
    assert_array_equal(runs.order, np.concatenate([[], *expected]))
    assert_array_equal(runs.order[runs.starts], [rows[0] for rows in expected])
    assert_array_equal(runs.order[runs.ends], [rows[-1] for rows in expected])
    steps = [np.append(BEGINS, np.diff(time[rows])) for rows in expected]
    assert_array_equal(runs.steps(time), np.concatenate([[], *steps]))
    late = [rows[1:][np.diff(-time[rows]) < 0] for rows in expected]
    assert_array_equal(runs.late(-time), np.concatenate([[], *late]))
    assert_array_equal(numbered(names), np.unique(names, return_inverse=True)[1])
