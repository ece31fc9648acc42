import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch.testing import assert_close

from hybridkin import Commands, ConstantCurvatureChain, PlayOperator, fit_play

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
    y, state = PlayOperator(0.5).apply(q)
    close(y.ravel(), np.array([0.0, 0.0, 0.75, 0.75, 0.75, 0.5, 1.75]))
    close(state.ravel(), np.array([2.0, 1.75, 1.75]))  # command, play, result


@CHECKS
@given(q=ROWS, width=WIDTHS)
def test_a_larger_swing_wipes_out_the_past(q, width):
    play = PlayOperator(width)
    end = np.array([[0.05] * 3, [-0.05] * 3, [0.0] * 3])
    close(play.apply(np.concatenate([q, end]))[0][-3:], play.apply(end, play.apply(q)[1])[0])
    close(play.apply(np.concatenate([q, end]))[1], play.apply(end)[1])


@pytest.mark.slow
@CHECKS
@given(q=ROWS, width=WIDTHS, data=st.data())
def test_chunks_with_the_state_carried_are_the_whole(q, width, data):
    play, at = PlayOperator(width), data.draw(st.integers(1, len(q)))
    for run in (play.apply, play.command):
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
    play = PlayOperator(width)
    _, state = play.apply(past)
    for before in (None, state):
        q, sent = play.command(y, before)
        reached, state = play.apply(q, before)
        close(reached, y)
        close(state, sent)


def test_motions_start_afresh_wherever_their_rows_lie(rng):
    q = torch.randn(30, 4, generator=rng, dtype=torch.float64)
    groups = np.array(["b", "a", "c"])[np.arange(30) % 3]
    play = PlayOperator([0.0, 0.1, 1.0, 2.0])
    y = play.apply_by_group(q, groups)
    for name in "abc":
        assert_close(y[groups == name], play.apply(q[groups == name])[0])
    close(play.apply_by_group(q.numpy(), groups), y)


def log_of(width, noise):
    rng = np.random.default_rng(0)
    truth = ConstantCurvatureChain([0.005], lengths=[0.1])
    groups = np.repeat(np.arange(10), 15)
    size, turn = rng.uniform(0.002, 0.006, 10)[groups], rng.uniform(0.0, 6.0, 10)[groups]
    swing = size * np.tile(np.sin(np.linspace(0.0, 6.0, 15)), 10)
    q = swing[:, None] * np.cos(turn[:, None] - np.array([0.0, 2.1, 4.2]))
    with torch.no_grad():
        x = truth(torch.as_tensor(PlayOperator(width).apply_by_group(q, groups))).numpy()
    return truth, q, x + noise * rng.standard_normal(x.shape), groups


@pytest.mark.slow
def test_play_in_a_log_is_found():
    truth, q, x, groups = log_of(0.2e-3, 1e-4)
    start = truth.with_geometry(radii=truth.radii * 1.2)
    fit = fit_play(start, q, x, groups, parameters=("radii",))
    assert fit.kept
    assert fit.width == 0.2e-3
    assert fit.gain > fit.gain_std_error
    assert np.argmin(fit.cv_distance) == 3
    assert fit.cv_distance.shape == fit.widths.shape == (5,)
    assert fit.play.width == fit.width
    assert_close(fit.result.chain.radii, truth.radii, rtol=1e-2, atol=0.0)
    as_torch = fit_play(
        start, torch.as_tensor(q), torch.as_tensor(x), groups, parameters=("radii",)
    )
    close(as_torch.cv_distance, fit.cv_distance)


def test_no_play_in_a_log_is_none():
    truth, q, x, groups = log_of(0.0, 1e-4)
    fit = fit_play(truth, q, x, groups, parameters=("radii",))
    assert not fit.kept
    assert fit.width == 0.0
    assert fit.cv_distance[0] < 3e-4


def test_play_of_counts_is_that_of_metres_and_runs_go_on_from_motion_to_motion():
    truth, q, x, _ = log_of(0.4e-3, 0.0)
    parts, runs = np.repeat(np.arange(30), 5), np.repeat([1, 0], 75)
    x = truth(torch.as_tensor(PlayOperator(0.4e-3).apply_by_group(q, runs))).detach().numpy()
    metres = fit_play(truth, Commands(q, runs), x, parts, parameters=("radii",))
    assert metres.width == 0.4e-3
    assert metres.cv_distance[4] < 1e-5 < 1e-4 < np.delete(metres.cv_distance, 4).min()
    assert metres.result.rmse < 1e-9
    counted = truth.with_geometry(gains=truth.gains * 2e-5)
    names = np.array([f"part {k:02d}" for k in parts])  # in the same order: so are the folds
    counts = fit_play(counted, Commands(q / 2e-5, runs), x, names, parameters=("radii",))
    close(2e-5 * counts.widths, metres.widths)
    assert_close(torch.as_tensor(counts.cv_distance), torch.as_tensor(metres.cv_distance))
    assert_close(counts.result.chain.radii, metres.result.chain.radii)


@pytest.mark.slow
def test_widths_are_doubled_while_the_largest_is_the_best():
    truth, q, x, groups = log_of(1.6e-3, 1e-4)
    fit = fit_play(truth, q, x, groups, parameters=("radii",))
    assert fit.kept
    assert fit.width == 1.6e-3
    close(fit.widths[-4:], np.array([0.4e-3, 0.8e-3, 1.6e-3, 3.2e-3]))
    assert fit.cv_distance.shape == fit.widths.shape


def test_one_motion_is_too_few():
    truth, q, x, _ = log_of(0.0, 0.0)
    with pytest.raises(ValueError, match="at least two motions"):
        fit_play(truth, q, x, np.zeros(len(q)))


def test_a_width_beyond_the_dtype_of_the_rows_never_moves_a_tendon():
    rows = np.array([[0.1, 0.2], [0.3, -0.1]], dtype=np.float32)
    effective, _ = PlayOperator(1e300).apply(rows)
    np.testing.assert_array_equal(effective, rows[[0, 0]])
