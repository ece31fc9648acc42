import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from hybridkin.datasets import load_trunk
from paper import paper_protocol


def test_protocol_has_the_papers_counts_and_bounds():
    q, part = paper_protocol(random_state=0)
    assert q.shape == (2000, 9)
    assert np.bincount(part).tolist() == [500, 500, 500, 500]
    assert q.min() >= 0.19
    assert q.max() <= 0.31
    segments = q.reshape(-1, 3, 3)
    for s in range(3):
        held = np.delete(segments[part == s], s, axis=1)
        assert np.abs(held - 0.20).max() <= 0.005
        moving = segments[part == s][:, s]
        assert_allclose(moving.mean(axis=0), 0.25, atol=0.01)
        assert_allclose(moving.std(axis=0), 0.12 / np.sqrt(12), rtol=0.1)
    free = q[part == 3]
    assert_allclose(free.std(axis=0), 0.12 / np.sqrt(12), rtol=0.1)
    assert np.abs(np.corrcoef(free.T) - np.eye(9)).max() < 0.2


def test_protocol_is_seeded():
    assert_array_equal(paper_protocol(3)[0], paper_protocol(np.random.default_rng(3))[0])
    assert (paper_protocol(3)[0] != paper_protocol(4)[0]).all()


def test_shipped_data_are_the_protocol():
    data = load_trunk()
    target, part = paper_protocol(data.parameters["random_state"])
    assert_array_equal(data.part, part)
    assert_array_equal(data.row, np.arange(2000))
    assert_allclose(data.q_target, target, rtol=0, atol=1e-15)
