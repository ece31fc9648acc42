import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch.testing import assert_close

from hybridkin import Hysteresis

ROWS = st.integers(1, 12).flatmap(
    lambda T: arrays(np.float64, (T, 3), elements=st.floats(-0.01, 0.01))
)
WIDTHS = st.one_of(
    st.floats(0.0, 0.01), arrays(np.float64, 3, elements=st.floats(0.0, 0.01)).map(np.array)
)
CHECKS = settings(max_examples=50, deadline=None)


def close(a, b):
    assert_close(torch.as_tensor(a), torch.as_tensor(b), rtol=0.0, atol=1e-15)


def test_play_by_hand():
    q = np.array([[0.0], [0.1], [1.0], [0.75], [0.5], [0.25], [2.0]])
    y, state = Hysteresis.backlash(0.5).apply(q)
    close(y.ravel(), np.array([0.0, 0.0, 0.75, 0.75, 0.75, 0.5, 1.75]))
    close(state.ravel(), np.array([2.0, 1.75, 1.75]))  # command, play, result


@CHECKS
@given(q=ROWS, width=WIDTHS)
def test_a_larger_swing_wipes_out_the_past(q, width):
    backlash = Hysteresis.backlash(width)
    end = np.array([[0.05] * 3, [-0.05] * 3, [0.0] * 3])
    close(
        backlash.apply(np.concatenate([q, end]))[0][-3:],
        backlash.apply(end, backlash.apply(q)[1])[0],
    )
    close(backlash.apply(np.concatenate([q, end]))[1], backlash.apply(end)[1])


@pytest.mark.slow
@CHECKS
@given(q=ROWS, width=WIDTHS, data=st.data())
def test_chunks_with_the_state_carried_are_the_whole(q, width, data):
    backlash = Hysteresis.backlash(width)
    at = data.draw(st.integers(1, len(q)))
    for run in (backlash.apply, backlash.command):
        whole, end = run(q)
        first, state = run(q[:at])
        kept = state.copy()
        second, last = run(q[at:], state)
        close(np.concatenate([first, second]), whole)
        close(last, end)
        close(state, kept)  # what was handed over is left as it was


@CHECKS
@given(past=ROWS, y=ROWS, width=WIDTHS)
def test_commanding_is_the_inverse(past, y, width):
    backlash = Hysteresis.backlash(width)
    _, state = backlash.apply(past)
    for before in (None, state):
        q, sent = backlash.command(y, before)
        reached, state = backlash.apply(q, before)
        close(reached, y)
        close(state, sent)


def test_motions_start_afresh_wherever_their_rows_lie(rng):
    q = torch.randn(30, 4, generator=rng, dtype=torch.float64)
    groups = np.array(["b", "a", "c"])[np.arange(30) % 3]
    backlash = Hysteresis.backlash([0.0, 0.1, 1.0, 2.0])
    y = backlash.apply_by_group(q, groups)
    for name in "abc":
        assert_close(y[groups == name], backlash.apply(q[groups == name])[0])
    close(backlash.apply_by_group(q.numpy(), groups), y)


def test_a_width_beyond_the_dtype_of_the_rows_never_moves_a_tendon():
    rows = np.array([[0.1, 0.2], [0.3, -0.1]], dtype=np.float32)
    effective, _ = Hysteresis.backlash(1e300).apply(rows)
    np.testing.assert_array_equal(effective, rows[[0, 0]])
