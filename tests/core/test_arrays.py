import numpy as np
import pytest
import torch
from numpy.testing import assert_array_equal

from hybridkin._core.arrays import check_shape, leading, shaped, table


def test_shapes_of_lengths_letters_and_leading_axes():
    rows = np.zeros((4, 3))
    check_shape(rows, "x", [4, 3])
    check_shape(rows, "x", "T3")
    check_shape(rows, "x", ("...", 3))
    check_shape(rows[0], "x", ("...", 3))
    check_shape(np.zeros((2, 2)), "A", "nn")
    for need, shape, text in [
        ([3], (2,), r"\(3,\), got \(2,\)"),
        ("nn", (2, 3), r"\(n, n\), got \(2, 3\)"),
        (("...", 4), (4, 3), r"\(\.\.\., 4\), got \(4, 3\)"),
        (("...", 2, 3), (3,), r"got \(3,\)"),
        ([4], (4, 3), r"got \(4, 3\)"),
        ([2, 3], (3, 2), r"\(2, 3\), got \(3, 2\); a reason\."),
    ]:
        with pytest.raises(ValueError, match=text):
            check_shape(np.zeros(shape), "x", need, "a reason")
    assert_array_equal(shaped([[1, 2]], "x", "T2", 1), [[1.0, 2.0]])
    with pytest.raises(ValueError, match=r"`t` must have shape \(3,\), got \(2,\)"):
        shaped([0.0, 1.0], "t", "T", 3)


def test_batches_that_do_not_agree_are_named():
    q, x = torch.zeros(2, 1, 9), torch.zeros(4, 3)
    assert leading([(q, 1), (x, 1)]) == (2, 4)
    assert leading([(torch.zeros(5, 4, 4), 2), (q[0], 1)]) == (5,)
    with pytest.raises(
        ValueError, match=r"agree in their batch shapes, got \[\(2, 1\), \(4, 3\)\]"
    ):
        leading([(q, 1), (torch.zeros(4, 3, 3), 1)])


def test_tables_keep_what_scikit_learn_asks_for():
    pandas = pytest.importorskip("pandas")
    frame = pandas.DataFrame({"a": [1.0, 2.0]})
    assert table(frame, "X") is frame
    assert type(table(frame, "y")) is np.ndarray
    assert table(None, "sample_weight") is None
    assert table(2.0, "sample_weight") == 2.0
    assert_array_equal(table([[1, 2]], "X"), [[1.0, 2.0]])
