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
OPERATORS = arrays(np.float64, (3, 3), elements=st.sampled_from([0.0, 0.3, 1.0, 1.7])).map(
    lambda slopes: Hysteresis.friction([0.0, 0.001, 0.003, 0.009], slopes)
)
CHECKS = settings(max_examples=100, deadline=None)


def close(a, b):
    assert_close(torch.as_tensor(a), torch.as_tensor(b), rtol=0.0, atol=1e-14)


def test_a_loop_by_hand():
    # After a reversal at 2 the slope is 1/4 for half a unit, 1/2 up to two units, then 1.
    hysteresis = Hysteresis.friction([0.0, 0.5, 2.0], [0.25, 0.5])
    q = np.array([[0.0], [2.0], [1.5], [0.5], [0.0], [-1.0]])
    y, state = hysteresis.apply(q)
    # The first rise begins in the middle of the plays: half of every width.
    top = 0.25 * 0.25 + 0.75 * 0.5 + 1.0
    down = top - np.array([0.0, 0.125, 0.625, 0.875, 1.875])
    close(y.ravel(), np.array([0.0, *down]))
    close(state.ravel(), np.array([-1.0, -1.0, -0.75, 0.0, *y[-1]]))  # command, plays, result


@CHECKS
@given(q=ROWS, width=st.sampled_from([0.001, 0.003, 0.009]))
def test_one_play_is_a_special_case(q, width):
    widths = np.array([0.0, 0.001, 0.003, 0.009])
    hysteresis = Hysteresis.friction(widths, 1.0 * (widths[:-1] >= width))
    close(hysteresis.apply(q)[0], Hysteresis.backlash(width).apply(q)[0])
    assert hysteresis.width == pytest.approx(width)


@CHECKS
@given(past=ROWS, y=ROWS, hysteresis=OPERATORS)
def test_commanding_is_the_inverse(past, y, hysteresis):
    _, state = hysteresis.apply(past)
    for before in (None, state):
        q, sent = hysteresis.command(y, before)
        reached, state = hysteresis.apply(q, before)
        close(reached, y)
        close(state, sent)
        assert (np.abs(q - y) <= 0.5 * hysteresis.width + 1e-14).all()


@CHECKS
@given(q=ROWS, hysteresis=OPERATORS, data=st.data())
def test_chunks_with_the_state_carried_are_the_whole(q, hysteresis, data):
    at = data.draw(st.integers(0, len(q)))
    for run in (hysteresis.apply, hysteresis.command):
        whole, end = run(q)
        state = run(q[:1])[1] if at == 0 else None
        first, state = run(q[:at], state)
        second, last = run(q[at:], state)
        close(np.concatenate([first, second]), whole)
        close(last, end)


def test_a_target_that_stays_keeps_its_command():
    hysteresis = Hysteresis.friction([0.1, 0.5, 2.0], [0.3, 0.8])
    y = np.repeat(np.random.default_rng(0).normal(size=(30, 2)), 3, axis=0)
    q, _ = hysteresis.command(y)
    assert np.ptp(q.reshape(30, 3, 2), axis=1).max() == 0.0


def test_single_precision_and_tensors_come_back_as_they_came():
    hysteresis = Hysteresis.friction([0.0, 0.5, 2.0], [0.25, 0.5])
    q = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    y, state = hysteresis.apply(q)
    assert y.dtype == state.dtype == torch.float32
    assert_close(y.double(), hysteresis.apply(q.double())[0], rtol=0.0, atol=1e-6)
    sent, state = hysteresis.command(y)
    assert sent.dtype == state.dtype == torch.float32


@pytest.mark.parametrize(
    ("widths", "slopes", "name"),
    [
        ([0.2, 0.1], [1.0], "widths"),
        ([-0.1, 0.1], [1.0], "widths"),
        ([0.1, np.inf], [1.0], "widths"),
        ([], [], "widths"),
        (0.1, [], "widths"),
        ([0.1, 0.2], [-1.0], "slopes"),
        ([0.1, 0.2], [np.nan], "slopes"),
        ([0.1, 0.2], [1.0, 1.0], "slopes"),
        ([0.1, 0.2], 1.0, "slopes"),
    ],
)
def test_bad_widths_and_slopes_are_named(widths, slopes, name):
    with pytest.raises(ValueError, match=f"`{name}` must"):
        Hysteresis.friction(widths, slopes)


def test_bad_rows_and_states_are_named():
    hysteresis = Hysteresis.friction([0.1, 0.2], [[0.5, 0.5]])
    with pytest.raises(ValueError, match=r"`q` must have shape \(T, 2\), got \(3, 3\)"):
        hysteresis.apply(np.zeros((3, 3)))
    _, state = Hysteresis.backlash(0.1).apply(np.zeros((3, 2)))
    with pytest.raises(ValueError, match=r"`state` must have shape \(4, 2\), got \(3, 2\)"):
        hysteresis.apply(np.zeros((3, 2)), state)
