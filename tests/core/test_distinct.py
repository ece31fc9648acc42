"""Equal rows, merged with the number of times that they count, against a search row by row."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from hybridkin._core.distinct import at_place, distinct_rows
from hybridkin._core.groups import Groups

N = 60


def rows(seed=0):
    """Rows of few different numbers, weights with zeros and halves, and groups of rows."""
    rng = np.random.default_rng(seed)
    X = rng.integers(0, 2, (N, 2)) * 0.1
    y = rng.integers(0, 2, (N, 1)) * -0.0
    y[30:, 0] += 0.3 * rng.integers(0, 2, 30)
    X[::5] = X[0]  # every fifth row equals the first one
    return X, y, rng.choice([0.0, 0.5, 1.0, 3.0], N), rng.integers(0, 3, N)


def merged(X, y, weights, groups, runs):
    """Return the first rows, sums of weights and places, found one row after the other."""
    first, counts, place = [], [], np.full(N, -1)
    keys = []
    for i in range(N):
        key = (*X[i], *y[i], groups[i])
        if runs:
            if not keys or keys[-1] != key:
                keys.append(key)
                first.append(i)
                counts.append(0.0)
            place[i] = len(keys) - 1
        elif weights[i]:
            if key not in keys:
                keys.append(key)
                first.append(i)
                counts.append(0.0)
            place[i] = keys.index(key)
        if place[i] >= 0:
            counts[place[i]] += weights[i]
    return first, counts, place


@pytest.mark.parametrize("runs", [False, True])
@pytest.mark.parametrize("weighted", [False, True])
@pytest.mark.parametrize("grouped", [False, True])
def test_rows_are_merged_as_row_by_row(runs, weighted, grouped):
    X, y, weights, groups = rows()
    if not weighted:
        weights = np.ones(N)
    if not grouped:
        groups = np.zeros(N, dtype=int)
    expected = merged(X, y, weights, groups, runs)
    labels = np.array(["b", "c", "a"])[groups]
    motions = [Groups(groups), Groups(labels), Groups(7.5 - groups)]
    if not grouped:
        motions.append(Groups.rows(N))
    for of_rows in motions:
        for given in (weights, torch.from_numpy(weights)):
            first, counts, place = distinct_rows(X, y, given, of_rows.apart, runs)
            assert_array_equal(first, expected[0])
            assert_array_equal(counts, expected[1])
            assert_array_equal(place, expected[2])
    assert len(first) < N


def test_one_row_more_or_less_changes_a_count_and_no_other():
    X, y, weights, groups = rows()
    first, counts, place = distinct_rows(X, y, weights, groups[:, None])
    assert counts.sum() == weights.sum()
    values = np.arange(float(len(first)))
    at = at_place(values, place)
    assert_array_equal(np.isnan(at), weights == 0.0)
    assert_array_equal(at[first], values)
    repeated = np.repeat(np.arange(N), (2 * weights).astype(int))
    ones = np.ones(len(repeated))
    again = distinct_rows(X[repeated], y[repeated], ones, groups[repeated, None])
    assert_array_equal(X[repeated][again[0]], X[first])
    assert_array_equal(again[1], 2.0 * counts)


def test_without_equal_rows_nothing_is_merged():
    X = np.arange(10.0)[:, None]
    first, counts, place = distinct_rows(X, X[:, :0], np.ones(10), X[:, :0])
    assert_array_equal(first, np.arange(10))
    assert_array_equal(counts, np.ones(10))
    assert_array_equal(place, first)
