"""Rotations that bring points nearest to others, also for mirror images and points in a plane."""

import numpy as np
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hybridkin.rotations import nearest_rotation


def test_no_rotation_has_a_larger_trace_than_the_nearest_one():
    rng = np.random.default_rng(0)
    others = Rotation.random(2000, random_state=0).as_matrix()
    for k in range(40):
        moments = rng.standard_normal((3, 3))
        if k % 4 == 0:
            moments[2] = 0.0
        turn, trace = nearest_rotation(moments)
        assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
        assert_allclose(np.linalg.det(turn), 1.0)
        assert_allclose(np.trace(turn.T @ moments), trace, atol=1e-12)
        traces = np.einsum("kji,ji->k", others, moments)
        assert traces.max() <= trace
        assert traces.max() > 0.9 * trace - 0.1
