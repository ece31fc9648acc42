"""Kernel ridge tuned on folds against fits of scikit-learn on the same folds."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from sklearn.kernel_ridge import KernelRidge

from hybridkin import HybridForwardModel
from hybridkin._core.groups import Groups
from hybridkin.hybrid import _kernel
from hybridkin.hybrid._kernel import distance, folds_of, tuned_kernel


def held_out(X, y, weights, groups, gamma, alpha):
    """Return the sum of held-out distances, by fits of scikit-learn."""
    total = 0.0
    for train, test in folds_of(groups):
        ridge = KernelRidge(kernel="rbf", gamma=gamma).set_params(alpha=alpha)
        ridge.fit(X[train], y[train], sample_weight=weights[train])
        total += weights[test] @ distance(ridge.predict(X[test]), y[test])
    return total


@pytest.mark.parametrize("n_outputs", [None, 3])
@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("enough", [600, 24])  # rows on which the search begins
def test_no_neighbour_of_the_tuned_kernel_is_better(enough, n_outputs, grouped, monkeypatch):
    monkeypatch.setattr(_kernel, "_ENOUGH", enough)
    rng = np.random.default_rng(3)
    X = rng.uniform(-0.1, 0.1, (60, 2))
    y = 0.01 * np.sin(20.0 * X @ rng.standard_normal((2, n_outputs or 1)))
    y += 1e-3 * rng.standard_normal(y.shape)
    y = y if n_outputs else y[:, 0]
    weights = rng.integers(1, 4, 60).astype(float)
    groups = Groups.of(np.arange(60) // 6 if grouped else None, 60)
    found = tuned_kernel(X, y, weights, groups)
    spread = np.repeat(X, weights.astype(int), axis=0).var(axis=0).mean()
    best = held_out(X, y, weights, groups, found.gamma, found.alpha)
    width = np.argmin(np.abs(np.array(_kernel._GAMMAS) - found.gamma * spread))
    penalty = np.argmin(np.abs(np.array(_kernel._ALPHAS) - found.alpha))
    assert 0 < penalty < len(_kernel._ALPHAS) - 1
    near = [(gamma, found.alpha) for gamma in _kernel._GAMMAS[max(width - 1, 0) : width + 2]]
    near += [(_kernel._GAMMAS[width], _kernel._ALPHAS[penalty + step]) for step in (-1, 1)]
    for gamma, alpha in near:
        other = held_out(X, y, weights, groups, gamma / spread, alpha)
        assert best <= other * (1.0 + 1e-9)


def rows_of_motions():
    """Return inputs, targets, weights and motions of three rows each."""
    rng = np.random.default_rng(4)
    X = rng.uniform(-0.1, 0.1, (60, 2))
    y = 0.01 * np.sin(20.0 * X) + 1e-3 * rng.standard_normal((60, 2))
    return X, y, rng.integers(1, 9, 60).astype(float), Groups(np.arange(60) // 3)


@pytest.mark.parametrize("grouped", [False, True])
@pytest.mark.parametrize("place", [(0, 1), (3, 4), (5, 6)])
def test_the_score_of_a_kernel_is_that_of_weighted_fits_on_the_folds(place, grouped):
    X, y, weights, groups = rows_of_motions()
    groups = groups if grouped else Groups.rows(60)
    score = _kernel._HeldOut(X, y, weights, groups, 0.01).distance(place)
    gamma = _kernel._GAMMAS[place[0]] / 0.01
    expected = held_out(X, y, weights, groups, gamma, _kernel._ALPHAS[place[1]])
    # Few digits are lost: the least penalty is 1e-4 of the kernel's weights.
    assert score == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize("first", [7, 40])
def test_a_first_search_on_some_rows_keeps_their_weights_and_every_motion(first, monkeypatch):
    X, y, weights, groups = rows_of_motions()
    searched = []

    class Recorded(_kernel._HeldOut):
        def __init__(self, *rows):
            searched.append(rows)
            super().__init__(*rows)

    monkeypatch.setattr(_kernel, "_HeldOut", Recorded)
    monkeypatch.setattr(_kernel, "_FIRST", first)
    tuned_kernel(X, y, weights, groups)
    few = searched[0]
    places = [int(np.flatnonzero((X == row).all(axis=1))[0]) for row in few[0]]
    assert len(places) == (60 if first == 7 else 40)  # 7 rows would leave motions out
    for found, given in zip(few[1:3], (y, weights), strict=True):
        assert_array_equal(found, given[places])
    assert_array_equal(few[3].labels, groups.labels[places])
    assert few[3].number == 20


def test_more_rows_than_the_memory_holds_are_refused():
    X = np.random.default_rng(0).uniform(size=(10_001, 2))
    with pytest.raises(ValueError, match=r"at most 10000 different rows .*, got 10001; use fewer"):
        HybridForwardModel(None, "kernel").fit(X, X)
