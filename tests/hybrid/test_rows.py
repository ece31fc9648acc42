"""Measured rows of a log: which are merged, and what goes along with them."""

import numpy as np
from numpy.testing import assert_array_equal

from hybridkin import Hysteresis
from hybridkin.hybrid._rows import Rows

Q = np.array([0.0, 1.0, 1.0, 0.0, 1.0, 0.0])[:, None]
RUNS = np.array(["b", "b", "b", "b", "a", "a"])
TIME = np.array([0.0, 1.0, 2.0, 3.0, 0.0, 1.0])
WEIGHTS = np.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])


def test_equal_rows_of_two_groups_stay_apart_and_runs_do_not_count():
    """A model without hysteresis does not know what the actuators did before."""
    rows = Rows.of(Q, 2.0 * Q, WEIGHTS, groups=RUNS)
    merged = rows.distinct()
    assert_array_equal(merged.X[:, 0], [0.0, 1.0, 1.0, 0.0])
    assert_array_equal(merged.groups.labels, ["b", "b", "a", "a"])
    assert_array_equal(merged.counts, [5.0, 5.0, 5.0, 6.0])
    assert_array_equal(merged.as_given(merged.X), Q)
    for named in ({}, {"runs": RUNS, "time": TIME}):
        assert_array_equal(Rows.of(Q, 2.0 * Q, WEIGHTS, **named).distinct().counts, [11.0, 10.0])


def test_rows_in_runs_merge_only_with_the_row_before():
    rows = Rows.of(Q, 2.0 * Q, WEIGHTS, groups=np.zeros(6), runs=RUNS)
    merged = rows.in_runs()
    assert_array_equal(merged.X[:, 0], [0.0, 1.0, 0.0, 1.0, 0.0])
    assert_array_equal(merged.counts, [1.0, 5.0, 4.0, 5.0, 6.0])
    assert_array_equal(merged.runs, ["b", "b", "b", "a", "a"])
    # A rest takes its time.
    timed = Rows.of(Q, 2.0 * Q, WEIGHTS, groups=np.zeros(6), runs=RUNS, time=TIME).in_runs()
    assert_array_equal(timed.time, TIME)
    assert_array_equal(timed.counts, WEIGHTS)


def test_what_the_actuators_do_follows_each_run():
    rows = Rows.of(Q, 2.0 * Q, WEIGHTS, groups=np.zeros(6), runs=RUNS, time=TIME)
    moved = rows.effective(Hysteresis.backlash(0.5)).X[:, 0]
    assert_array_equal(moved, [0.0, 0.75, 0.75, 0.25, 1.0, 0.25])
    some = rows.take(np.array([4, 1]))
    assert_array_equal(some.runs, ["a", "b"])
    assert_array_equal(some.time, [0.0, 1.0])
    assert_array_equal(some.counts, [5.0, 2.0])
    assert_array_equal(rows.repeated().X[:, 0], np.repeat(Q[:, 0], WEIGHTS.astype(int)))
    assert_array_equal(rows.repeated().runs, np.repeat(RUNS, WEIGHTS.astype(int)))
