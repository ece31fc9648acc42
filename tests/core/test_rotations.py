"""Rotations for NumPy arrays are those for tensors."""

import numpy as np
import torch
from numpy.testing import assert_allclose

from hybridkin._core.rotations import nearest_rotation
from hybridkin.app.checks.rotations import nearest_turn


def test_the_nearest_turn_of_an_array_is_that_of_a_tensor():
    """For mirror images and for points in a plane, too."""
    rng = np.random.default_rng(0)
    for k in range(40):
        moments = rng.standard_normal((3, 3))
        if k % 4 == 0:
            moments[2] = 0.0
        turn, trace = nearest_turn(moments)
        expected, expected_trace = nearest_rotation(torch.from_numpy(moments))
        assert_allclose(turn, expected, atol=1e-12)
        assert_allclose(trace, expected_trace, atol=1e-12)
        assert_allclose(np.linalg.det(turn), 1.0)
        assert_allclose(np.trace(turn.T @ moments), trace, atol=1e-12)
