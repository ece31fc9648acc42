import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from torch.testing import assert_close

from hybridkin import Hysteresis

TIMES = [0.5, 10.0, 200.0]
# The rounding of a change that is subnormal is as large as the change.
NUMBERS = st.floats(-0.01, 0.01, allow_subnormal=False)
ROWS = st.integers(1, 12).flatmap(lambda T: arrays(np.float64, (T, 3), elements=NUMBERS))
STEPS = arrays(np.float64, (12,), elements=st.sampled_from([0.0, 0.1, 1.0, 7.0, 1e6]))
CREEPS = arrays(np.float64, (3, 3), elements=st.sampled_from([0.0, 0.05, 0.3])).map(
    lambda shares: Hysteresis.creep(shares, TIMES)
)
OPERATORS = CREEPS | st.tuples(
    st.sampled_from(
        [
            Hysteresis.backlash(0.004),
            Hysteresis.backlash([0.0, 0.001, 0.01]),
            Hysteresis.friction([0.0, 0.001, 0.009], [0.3, 1.2]),
        ]
    ),
    CREEPS,
).map(lambda stages: stages[0] | stages[1])
CHECKS = settings(max_examples=100, deadline=None)


def close(a, b, atol=1e-14):
    assert_close(torch.as_tensor(a), torch.as_tensor(b), rtol=0.0, atol=atol)


def test_a_step_by_hand():
    creep = Hysteresis.creep([0.3, 0.2], [2.0, 50.0])
    time = np.array([0.0, 0.5, 0.7, 3.0, 100.0, 1e5])
    y, state = creep.apply(np.array([[0.0], *[[1.0]] * 5]), dt=np.diff(time, prepend=0.0))
    expected = 1.0 - 0.3 * np.exp(-time / 2.0) - 0.2 * np.exp(-time / 50.0)
    close(y[1:, 0], expected[1:])
    close(state.ravel(), np.ones(4))  # command, slow states, result


@CHECKS
@given(past=ROWS, y=ROWS, steps=STEPS, operator=OPERATORS)
def test_commanding_is_the_inverse(past, y, steps, operator):
    _, state = operator.apply(past, dt=1.0)
    for before in (None, state):
        q, sent = operator.command(y, before, steps[: len(y)])
        reached, state = operator.apply(q, before, steps[: len(y)])
        close(reached, y, atol=1e-12)
        close(state, sent, atol=1e-12)


@CHECKS
@given(q=ROWS, steps=STEPS, operator=OPERATORS, data=st.data())
def test_chunks_with_the_state_carried_are_the_whole(q, steps, operator, data):
    steps = steps[: len(q)]
    at = data.draw(st.integers(0, len(q)))
    for run in (operator.apply, operator.command):
        whole, end = run(q, None, steps)
        state = run(q[:1])[1] if at == 0 else None
        first, state = run(q[:at], state, steps[:at])
        second, last = run(q[at:], state, steps[at:])
        close(np.concatenate([first, second]), whole)
        close(last, end)


@CHECKS
@given(q=ROWS, operator=CREEPS)
def test_at_rest_the_result_is_the_command(q, operator):
    _, state = operator.apply(q, dt=1.0)
    close(operator.apply(q[-1:], state, 1e5)[0], q[-1:], atol=1e-12)


def test_time_matters_only_by_what_lies_between():
    # A command that stays for three steps is one that stays as long in one.
    creep = Hysteresis.creep([0.4], [3.0])
    q = np.array([[0.0], [1.0], [1.0], [1.0], [0.2]])
    y, _ = creep.apply(q, dt=[0.0, 0.5, 1.0, 1.5, 2.0])
    close(creep.apply(q[[0, 1, 4]], dt=[0.0, 3.0, 2.0])[0], y[[0, 3, 4]])


def test_each_motion_starts_at_rest_and_has_its_times():
    operator = Hysteresis.backlash(0.3) | Hysteresis.creep([0.4], [3.0])
    rng = np.random.default_rng(0)
    q = rng.normal(size=(30, 2))
    groups = np.arange(30) % 3
    time = np.cumsum(rng.uniform(0.1, 5.0, 30))
    y = operator.apply_by_group(q, groups, time)
    for name in range(3):
        rows = groups == name
        steps = np.diff(time[rows], prepend=0.0)
        close(y[rows], operator.apply(q[rows], dt=steps)[0])


@pytest.mark.parametrize(
    "operator",
    [
        Hysteresis.backlash([0.3, 0.5]),
        Hysteresis.friction([0.0, 0.3, 0.8], [0.3, 1.2]),
        Hysteresis.creep([[0.3, 0.1], [0.2, 0.4]], [3.0, 20.0]),
        Hysteresis.backlash(0.3) | Hysteresis.creep([0.4], [3.0]),
    ],
    ids=lambda operator: operator.kind,
)
def test_motions_may_be_renamed_mixed_and_have_clocks_in_any_unit(operator):
    rng = np.random.default_rng(0)
    q = rng.normal(size=(30, 2))
    groups = np.arange(30) // 10
    time = np.cumsum(rng.uniform(0.1, 5.0, 30))
    y = operator.apply_by_group(q, groups, time)
    inner = operator.inner_states(q, groups, time)
    for name in range(3):  # the state is the last command, what is inside, and the result
        rows = groups == name
        _, state = operator.apply(q[rows], dt=np.diff(time[rows], prepend=time[rows][0]))
        close(y[rows][-1], state[-1])
        if len(inner[0]):
            close(inner[rows][-1], state[-1 - len(inner[0]) : -1])
    order = np.argsort(np.arange(30) % 10 + 0.1 * (2 - groups))
    names = np.array(["b", "c", "a"])[groups[order]]
    clock = time[order] - 1e3 * groups[order]
    close(operator.apply_by_group(q[order], names, clock), y[order], atol=1e-12)
    close(operator.inner_states(q[order], names, clock), inner[order], atol=1e-12)
    if operator.kind == "creep":
        slower = Hysteresis.creep(operator.stages[0].shares, 60.0 * operator.time_constants)
        close(slower.apply_by_group(q, groups, 60.0 * time), y)
    with pytest.raises(ValueError, match="`time` must not decrease within a motion, but does in"):
        operator.apply_by_group(q, groups, -time)


def test_commands_of_a_target_that_stays_do_not_jump_by_the_backlash():
    # In rounding the inverse of creep goes to and fro; a backlash must not follow it.
    series = Hysteresis.backlash(0.5) | Hysteresis.creep([0.2, 0.7], [2.0, 9.0])
    _, state = series.apply(np.random.default_rng(0).normal(size=(20, 3)), dt=1.0)
    for target in np.random.default_rng(1).normal(size=(5, 3)):
        y = np.tile(target, (1000, 1))
        q, state = series.command(y, state, dt=1.0)
        turns = np.abs(np.diff(np.sign(np.diff(q, axis=0)), axis=0))[1:] > 1.0
        assert not turns.any()


def test_a_series_is_one_operator_after_the_other():
    friction = Hysteresis.friction([0.0, 0.5, 2.0], [0.25, 0.5])
    creep = Hysteresis.creep([[0.1, 0.3], [0.2, 0.0]], [2.0, 9.0])
    q = np.random.default_rng(0).normal(size=(20, 2))
    series = friction | creep
    y, state = series.apply(q, dt=0.7)
    moved, end = friction.apply(q)
    expected, slow = creep.apply(moved, dt=0.7)
    close(y, expected)
    close(state, np.concatenate([end[:-1], slow]))  # the result is the command of the next
    assert series.width == friction.width


def test_single_precision_and_tensors_come_back_as_they_came():
    series = Hysteresis.backlash(0.5) | Hysteresis.creep([0.2, 0.3], [2.0, 9.0])
    q = torch.randn(20, 3, generator=torch.Generator().manual_seed(0))
    for run in (series.apply, series.command):
        y, state = run(q, dt=1.0)
        assert y.dtype == state.dtype == torch.float32
        assert_close(y.double(), run(q.double(), dt=1.0)[0], rtol=0.0, atol=2e-6)
        again, _ = run(q, state, dt=1.0)
        assert again.dtype == torch.float32


def test_creep_without_times_is_refused_where_they_count():
    creep = Hysteresis.creep([0.4], [3.0])
    q = np.array([[0.0], [1.0], [2.0]])
    for operator in (creep, Hysteresis.backlash(0.1) | creep):
        _, state = operator.apply(q[:1])  # one row at rest needs none
        for run in (operator.apply, operator.command):
            with pytest.raises(ValueError, match=r"times .* must be given"):
                run(q)
            with pytest.raises(ValueError, match=r"times .* must be given"):
                run(q[:1], state)
        for by_group in (operator.apply_by_group, operator.inner_states):
            with pytest.raises(ValueError, match=r"times .* must be given"):
                by_group(q, [0, 0, 1])
            assert len(by_group(q, [0, 1, 2])) == 3


@pytest.mark.parametrize(
    ("shares", "times", "name"),
    [
        ([0.2], [0.0], "times"),
        ([0.2], [np.inf], "times"),
        ([], [], "times"),
        ([0.2], 1.0, "times"),
        ([-0.1], [1.0], "shares"),
        ([np.nan], [1.0], "shares"),
        ([0.5, 0.5], [1.0, 2.0], "shares"),
        ([0.1, 0.1], [1.0], "shares"),
        (0.1, [1.0], "shares"),
    ],
)
def test_bad_shares_and_times_are_named(shares, times, name):
    with pytest.raises(ValueError, match=f"`{name}` must"):
        Hysteresis.creep(shares, times)


def test_bad_rows_steps_and_states_are_named():
    creep = Hysteresis.creep([[0.5, 0.5]], [1.0])
    q = np.zeros((3, 2))
    with pytest.raises(ValueError, match=r"`q` must have shape \(T, 2\), got \(3, 3\)"):
        creep.apply(np.zeros((3, 3)))
    for dt in (-1.0, np.nan, [1.0, 1.0], [[1.0], [1.0], [1.0]]):
        with pytest.raises(ValueError, match="`dt` must"):
            creep.command(q, dt=dt)
    with pytest.raises(ValueError, match="`time` must not decrease within a motion"):
        creep.apply_by_group(q, [0, 1, 1], [5.0, 4.0, 3.0])
    assert creep.apply_by_group(q, [0, 1, 1], [5.0, 4.0, 4.0]).shape == (3, 2)
    with pytest.raises(ValueError, match="`time` must"):
        creep.apply_by_group(q, [0, 1, 1], [5.0, 4.0])
    series = Hysteresis.backlash(0.1) | creep
    _, state = series.apply(q, dt=1.0)
    with pytest.raises(ValueError, match=r"`state` must have shape \(5, 2\), got \(4, 2\)"):
        series.apply(q, state[:-1], dt=1.0)
    with pytest.raises(ValueError, match="`state` must be finite"):
        series.apply(q, np.nan * state, dt=1.0)
    with pytest.raises(ValueError, match="`state` must be numeric"):
        series.apply(q, (state[0], "slow"), dt=1.0)
    with pytest.raises(ValueError, match="`stages` must be for equally many actuators"):
        Hysteresis.backlash([0.1, 0.1, 0.1]) | creep
    with pytest.raises(TypeError, match="`stages` must hold stages"):
        Hysteresis([0.1])
