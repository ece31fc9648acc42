"""Methods of chains that work row by row: any batch, any layout, hostile rows among others."""

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from mechanical_models import CHAINS, ROW_BY_ROW
from strategies import SPECIAL, answer, tensors
from torch.testing import assert_close

BATCHES = [(), (0,), (1,), (3,), (2, 3), (0, 2), (3, 1)]
BASE = {"base": torch.ones(2, 4, 4, dtype=torch.float64)}


def of(name, data):
    """Return a method as a function of q that returns a list of tensors, and rows q (3, n)."""
    chain, q = CHAINS[name]
    method = data.draw(st.sampled_from(ROW_BY_ROW[type(chain)].split()))
    given = {"geometry_jacobian": (BASE,)}.get(method, ())

    def function(q):
        found = getattr(chain, method)(q, *given)
        return [*found] if isinstance(found, tuple) else [found]

    return function, torch.tensor(q)


@pytest.mark.parametrize("name", CHAINS)
@given(st.data())
def test_a_hostile_row_touches_no_other(name, data):
    function, clean = of(name, data)
    clean = clean.repeat(2, 1).to(data.draw(st.sampled_from([torch.float64, torch.float32])))
    dirty, rows = clean.clone(), data.draw(st.lists(st.integers(0, 5), min_size=1, max_size=3))
    for row in rows:
        column = data.draw(st.integers(0, clean.shape[1] - 1))
        dirty[row, column] = torch.tensor(data.draw(st.sampled_from(SPECIAL)), dtype=torch.float64)
    found, error = answer(function, dirty)
    assert error is None
    others = np.setdiff1d(range(6), rows)
    for part, expected in zip(found, function(clean), strict=True):
        assert part.shape == expected.shape
        assert part.dtype == expected.dtype
        assert part[others].isfinite().all()
        assert torch.equal(part[others], expected[others])


@pytest.mark.parametrize("name", CHAINS)
@given(st.data())
def test_a_batch_equals_its_rows(name, data):
    function, rows = of(name, data)
    low, high = float(rows.min()), float(rows.max())
    shape = (*data.draw(st.sampled_from(BATCHES)), rows.shape[1])
    q = data.draw(tensors(shape, low, high, special=()))
    found, error = answer(function, q)
    assert error is None
    tol = (
        {"rtol": 1e-9, "atol": 1e-12} if q.dtype == torch.float64 else {"rtol": 2e-4, "atol": 2e-4}
    )
    for k, part in enumerate(found):
        assert part.shape[: q.ndim - 1] == q.shape[:-1]
        assert part.dtype in (q.dtype, torch.bool)
        assert part.isfinite().all()
        for i, row in enumerate(q.reshape(-1, shape[-1])):
            assert_close(part.reshape(-1, *part.shape[q.ndim - 1 :])[i], function(row)[k], **tol)
