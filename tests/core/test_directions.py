"""Directions in words: those of the span, whatever axes an eigenvalue problem gives it."""

import numpy as np
import pytest
from scipy.stats import ortho_group

from hybridkin._core.directions import few_terms, in_terms

NAMES = [f"q{k}" for k in range(9)]
SPANS = {
    "balance": np.kron(np.eye(3), np.ones(3)),  # tendons of three segments in balance
    "pairs": np.eye(9)[:4] - np.eye(9)[1:5],
    "equal to the last": np.eye(9)[:3] + np.eye(9)[8],
    "halves": np.array([[2.0, 1, 0, 0, 0, 0, 0, 0, 0], [0, 0, 0, 1, 2, 0, 0, 0, 1]]),
    **{
        f"integers, {seed}": np.random.default_rng(seed).integers(-1, 2, (3, 9)).astype(float)
        for seed in range(4)
    },
}


def of_span(basis):
    """Orthonormal rows of a span, in three other directions."""
    axes = np.linalg.qr(basis.T)[0].T
    yield axes
    for seed in range(2):
        yield ortho_group.rvs(len(axes), random_state=seed) @ axes


@pytest.mark.parametrize("name", SPANS)
def test_the_words_are_those_of_the_span(name):
    assert len({in_terms(axes.T, NAMES) for axes in of_span(SPANS[name])}) == 1


@pytest.mark.parametrize("name", SPANS)
def test_the_sparse_basis_spans_the_same(name):
    for axes in of_span(SPANS[name]):
        sparse = few_terms(axes)
        assert np.linalg.matrix_rank(sparse) == len(axes)
        outside = sparse - sparse @ axes.T @ axes
        np.testing.assert_allclose(outside, 0.0, atol=1e-14 * np.abs(sparse).max())


def test_the_words_name_the_actuators_in_their_order():
    for axes in of_span(SPANS["balance"]):
        assert in_terms(axes.T, NAMES) == "+1 q0 +1 q1 +1 q2; +1 q3 +1 q4 +1 q5; +1 q6 +1 q7 +1 q8"
