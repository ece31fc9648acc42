"""Commands of any operator of hysteresis: finite, found again by `apply`, the same in every path.

`examine commands` puts 20,000 of these motions through; here are a few, and closed forms.
"""

from functools import reduce
from operator import or_

import numpy as np
import pytest

from hybridkin import Hysteresis
from hybridkin.hysteresis import follow as following
from hybridkin.native import available

DTYPES = (np.float64, np.float32)
SLOPES = (0.0, 0.0, 0.0, 1.0, 0.3, 2.5, 1e-3, 1e-9, 1e-15, 1e4)
T = 12


def plays(rng, n):
    """Return a sum of plays: flat slopes, no threshold, nearly equal ones, huge and tiny ratios."""
    count = rng.integers(1, 7)
    widths = 10.0 ** rng.uniform(-5, 1) * 10.0 ** rng.uniform(-rng.choice([1, 12]), 0, count)
    if rng.random() < 0.5:
        widths[0] = 0.0
    if rng.random() < 0.5:
        widths[-1] = np.nextafter(widths[rng.integers(count)], np.inf)
    widths = np.unique(widths)
    shape = (len(widths) - 1, n) if rng.random() < 0.5 else len(widths) - 1
    return Hysteresis.friction(widths, rng.choice(SLOPES, shape))


def creep(rng, n):
    """Return creep whose share at once is between all and one in a hundred thousand."""
    count = rng.integers(1, 4)
    gains = rng.dirichlet(np.ones(count)) * (1.0 - 10.0 ** -rng.choice([0.1, 1, 5]))
    if rng.random() < 0.5:
        gains = np.tile(gains[:, None], n)
    return Hysteresis.creep(gains, 10.0 ** rng.uniform(-3, 4, count))


def random_operator(rng, n):
    """Return one to three operators in series."""
    makers = rng.choice(
        [plays, plays, creep, lambda rng, n: Hysteresis.backlash(rng.uniform(0, 2, n))],
        rng.integers(1, 4),
    )
    return reduce(or_, [maker(rng, n) for maker in makers])


def random_motion(rng, operator, n):
    """Return times (T,), what actuators did before, and what they are to do (T, n) each.

    The motion goes on from what they did, or begins elsewhere. Some steps are rounding, some
    repeat, some motions are what other commands gave, so that flat pieces are met at their ends.
    """
    steps = rng.choice([0.0, 0.01, 1.0, 1e6], T)
    size = 10.0 ** rng.uniform(-4, 2)
    past = size * (rng.choice([0.0, 1.0, 1e3]) + np.cumsum(rng.normal(size=(T, n)), axis=0))
    ways = rng.normal(size=(T, n)) * rng.choice([1.0, 1.0, 0.0, 1e-7, 1e-15], (T, n))
    if rng.random() < 0.3:
        ways = np.abs(ways)
    before, _ = operator.apply(past, dt=1.0)
    y = before[-1] * rng.choice([0.0, 1.0]) + size * np.cumsum(ways, axis=0)
    if rng.random() < 0.3:
        y, _ = operator.apply(y, dt=steps)
    return steps, past, y


def apart(operator, n, dtype, *rows):
    """Return how far rounding may take results (n,) apart, through all stages.

    A stage rounds each of its parts, and multiplies what came before by its largest slope. Rounding
    that a play keeps adds up over the rows.
    """
    size = np.max([np.abs(a).max(initial=0.0) for a in rows])
    total = 0.0
    for stage in operator.stages:
        steepest = parts = 1.0
        if stage.kernel == "plays":
            half, slopes = stage.numbers(n)
            steepest = slopes.max()
            parts = np.abs(np.diff(slopes, axis=0, prepend=0.0)).sum(axis=0).max()
            size = size + half.max()
        total = steepest * total + (steepest + parts) * size
    return 4.0 * T * float(np.finfo(dtype).eps) * total


def paths():
    """Return what computes rows of a precision, by name: a dtype and a function as `follow`."""
    ways = {"no core": following.follow_in_numpy}
    if available():
        ways["core"] = following.follow_in_core
    return {
        f"{name}, {dtype.__name__}": (dtype, follow)
        for name, follow in ways.items()
        for dtype in DTYPES
    }


def examined(rng, ways):
    """Return what is wrong with the commands of a random motion, and the commands by path."""
    n = rng.integers(1, 5)
    operator = random_operator(rng, n)
    steps, past, y = random_motion(rng, operator, n)
    wrong = []
    commands = {}
    for path, (dtype, follow) in ways.items():
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(following, "available", lambda: True)
            patch.setattr(following, "follow_in_core", follow)
            goals = y.astype(dtype)
            _, before = operator.apply(past.astype(dtype), dt=1.0)
            q, after = operator.command(goals, before, steps)
            commands[path] = q
            if not (np.isfinite(q).all() and np.isfinite(after).all()):
                wrong.append(f"{path}: not finite, {operator}")
                continue
            reached, state = operator.apply(q, before, steps)
        close = apart(operator, n, dtype, goals, q, before, state, after)
        far = np.abs(np.vstack([reached - goals, state[-1:] - after[-1:]])).max()
        if not far <= close:
            wrong.append(f"{path}: {far:.2g} apart, rounding is {close:.2g}, {operator}")
    return wrong, commands


@pytest.mark.parametrize("seed", range(4))
def test_commands_of_random_motions_are_finite_and_do_them(seed):
    rng = np.random.default_rng(seed)
    for _ in range(20):
        wrong, _ = examined(rng, paths())
        assert not wrong


@pytest.mark.parametrize(("path", "dtype", "follow"), [(k, *v) for k, v in paths().items()])
def test_a_flat_piece_ends_where_it_begins(path, dtype, follow, monkeypatch):
    # The slopes are 1, 0 and 1: a result on the flat piece has the first command that gives it, and
    # one beyond it those behind the piece.
    monkeypatch.setattr(following, "available", lambda: True)
    monkeypatch.setattr(following, "follow_in_core", follow)
    hysteresis = Hysteresis.friction([0.0, 1.0, 2.0], [1.0, 0.0])
    _, state = hysteresis.apply(np.array([[0.0]], dtype))
    for goal, command in ((0.25, 0.25), (0.5, 0.5), (0.5, 0.5), (0.75, 1.25), (0.75, 1.25)):
        q, state = hysteresis.command(np.array([[goal]], dtype), state)
        assert q.item() == command
        assert state[-1].item() == goal


@pytest.mark.parametrize(("path", "dtype", "follow"), [(k, *v) for k, v in paths().items()])
def test_creep_that_leaves_nothing_at_once_keeps_the_command(path, dtype, follow, monkeypatch):
    # The largest share below 1: a command within no time moves nothing beyond rounding.
    monkeypatch.setattr(following, "available", lambda: True)
    monkeypatch.setattr(following, "follow_in_core", follow)
    creep = Hysteresis.creep([np.nextafter(1.0, 0.0)], [2.0])
    _, state = creep.apply(np.array([[0.25]], dtype))
    q, state = creep.command(np.array([[1.0], [2.0]], dtype), state, 0.0)
    assert (q == 0.25).all()
    assert (state == 0.25).all()
    q, state = creep.command(np.array([[1.0]], dtype), state, 1.0)
    np.testing.assert_allclose(creep.apply(q, state, 0.0)[0], 1.0, rtol=1e-6)


# Widths, slopes, a state and a goal where rounding makes a play begin before a narrower one.
ROUNDED = {
    "float64": (
        [
            0.0,
            2.4999439376807972e-06,
            3.268289654979436e-06,
            7.559584646855175e-06,
            9.561076596816487e-06,
            9.695512590536306e-06,
        ],
        [2.5, 2.5, 0.0, 0.0, 10000.0],
        [
            0.00012130057232713488,
            0.00012130057232713488,
            0.00012255054429597526,
            0.00012293471715462458,
            0.00012508036465056245,
            0.00012608111062554312,
            0.00012614832862240302,
            -0.0005501170020454155,
        ],
        -0.0005501170020454156,
    ),
    "float32": (
        [
            0.1797123716072571,
            0.284147344928694,
            0.39809227727691,
            0.49920159056447627,
            0.8440834602854704,
            0.8587492846662481,
        ],
        [0.001, 0.001, 0.0, 1e-09, 0.0],
        [
            -0.4296039044857025,
            -0.33974772691726685,
            -0.28753024339675903,
            -0.23055776953697205,
            -0.1800031065940857,
            -0.007562160491943359,
            -0.00022926926612854004,
            -0.0003384726296644658,
        ],
        -0.00033847265876829624,
    ),
}


@pytest.mark.parametrize(("path", "dtype", "follow"), [(k, *v) for k, v in paths().items()])
def test_a_slope_of_zero_gives_no_infinite_command(path, dtype, follow, monkeypatch):
    monkeypatch.setattr(following, "available", lambda: True)
    monkeypatch.setattr(following, "follow_in_core", follow)
    widths, slopes, state, goal = ROUNDED[np.dtype(dtype).name]
    hysteresis = Hysteresis.friction(widths, slopes)
    before = np.array(state, dtype)[:, None]
    goals = np.array([[goal], [0.0], [goal]], dtype)  # the later ones were infinite too
    q, after = hysteresis.command(goals, before)
    assert np.isfinite(q).all()
    assert np.isfinite(after).all()
    reached, _ = hysteresis.apply(q, before)
    close = apart(hysteresis, 1, dtype, goals, q, before, after)
    np.testing.assert_allclose(reached, goals, rtol=0.0, atol=close)


def test_single_precision_is_double_precision_rounded():
    rng = np.random.default_rng(0)
    for _ in range(20):
        operator = plays(rng, 2)
        _, _, y = random_motion(rng, operator, 2)
        single = operator.command(y.astype(np.float32))[0]
        double = operator.command(y.astype(np.float32).astype(np.float64))[0]
        np.testing.assert_array_equal(single, double.astype(np.float32))


def test_one_width_is_a_play():
    q = np.random.default_rng(0).normal(size=(20, 3))
    for slopes in ([], np.empty((0, 3))):
        sums = Hysteresis.friction([0.4], slopes)
        assert (sums.width == 0.4).all()
        for run, expected in (
            (sums.apply, Hysteresis.backlash(0.4).apply),
            (sums.command, Hysteresis.backlash(0.4).command),
        ):
            for found, wanted in zip(run(q), expected(q), strict=True):
                np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-15)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("size", [1e30, 1e75, 1e154, 1e308, np.inf, np.nan])
def test_finite_numbers_have_finite_results_and_others_are_refused(size, dtype):
    operator = Hysteresis.friction([0.0, 1.0, 1e300], [0.5, 0.0]) | Hysteresis.creep([0.9], [1.0])
    with np.errstate(over="ignore"):
        far = np.array([[0.0], [size], [-size], [1.0]], dtype)
    _, state = operator.apply(far[:1])
    for run, name in ((operator.apply, "q"), (operator.command, "y")):
        if np.isfinite(far).all():
            rows, end = run(far, state, 1.0)
            assert np.isfinite(rows).all()
            assert np.isfinite(run(far, end, 1.0)[0]).all()
        else:
            with pytest.raises(ValueError, match=f"`{name}` must be finite"):
                run(far, state, 1.0)
            with pytest.raises(ValueError, match="`state` must be finite"):
                run(far[:1], np.full_like(state, far[1, 0]), 1.0)
