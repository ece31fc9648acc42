import numpy as np
import pytest
import torch

from hybridkin import Hysteresis, as_forward_model, robots
from hybridkin.hysteresis.fit import HysteresisProblem, _LeastSquares
from hybridkin.hysteresis.log import HysteresisLog
from hybridkin.hysteresis.search import Candidate, find_hysteresis, gain

TRUNK = robots.bionic_handling_assistant()
M = np.array([[1.0, 0.3, 0.0], [0.0, 0.8, -0.4], [0.2, 0.0, 1.1]])


def log_of(hysteresis, groups=8, rows=30, noise=1e-3):
    """Return a log of a linear robot in which a hysteresis stands before the model."""
    rng = np.random.default_rng(0)
    turn = np.linspace(0.0, 6.0, rows)
    waves = np.stack([np.sin(turn), np.sin(2.0 * turn), np.cos(turn)])
    q = (rng.uniform(-1.0, 1.0, (groups, 3, 3)) @ waves).transpose(0, 2, 1).reshape(-1, 3)
    names = np.repeat(np.arange(groups), rows)
    time = np.tile(np.arange(rows, dtype=float), groups)
    y = hysteresis.apply_by_group(q, names, time)
    x = y @ M.T + noise * rng.standard_normal(q.shape)
    model = as_forward_model(lambda q: q @ torch.from_numpy(M.T))
    return HysteresisLog(model, q, x, np.ones(len(q)), names, names, time)


def static_log(error, seed):
    """Return a log of a trunk without hysteresis whose model has an error as large as a tenth."""
    rng = np.random.default_rng(seed)
    if error == "quadratic":  # straight lines from posture to posture
        ends = rng.uniform(-1.0, 1.0, (10, 2, 9))
        along = np.linspace(0.0, 1.0, 8)[:, None]
        unit = np.concatenate([start + along * (end - start) for start, end in ends])
        groups = np.repeat(np.arange(10), 8)
    else:  # one motion of nine sines
        turn = np.linspace(0.0, 6.0 * np.pi, 300)[:, None]
        unit = np.sin(turn * rng.uniform(0.5, 2.0, 9) + rng.uniform(0.0, 6.0, 9))
        groups = np.arange(300) // 30
    moved = unit
    if error == "quadratic":
        form = rng.standard_normal((9, 9, 9)) / 9.0
        moved = unit + 0.2 * np.einsum("ni,nj,ijk->nk", unit, unit, form)
    with torch.no_grad():
        x = TRUNK(torch.from_numpy(0.25 + 0.05 * moved)).numpy()
    if error == "gravity":
        side = x[:, :2]
        out = np.linalg.norm(side, axis=1, keepdims=True)
        x = x + 0.4 * np.hstack([0.5 * side * out, -(out**2)])
    x = x + 5e-4 * rng.standard_normal(x.shape)
    runs = np.zeros(len(x)) if error == "gravity" else groups
    time = np.arange(len(x), dtype=float)
    return HysteresisLog(TRUNK, 0.25 + 0.05 * unit, x, np.ones(len(x)), groups, runs, time)


@pytest.mark.parametrize("seed", range(3))
def test_an_error_of_the_model_is_not_taken_for_hysteresis(seed):
    assert find_hysteresis(static_log("quadratic", seed)) == Hysteresis()


@pytest.mark.slow
def test_hysteresis_is_rarely_found_where_there_is_none():
    wrong = 0
    for seed in range(15):
        for error in ("quadratic", "gravity"):
            wrong += bool(find_hysteresis(static_log(error, seed)))
    assert wrong <= 2  # of 30


def test_held_out_errors_are_those_of_fits_without_each_fold():
    log = log_of(Hysteresis(), groups=5, rows=4)
    distances = HysteresisProblem(log, 0.0, creep=False).fitted(0.0, 0.0).distances
    inputs = np.column_stack([np.ones(len(log.q)), log.q])
    expected = np.empty(len(log.q))
    for train, test in log.folds:
        readout = np.linalg.lstsq(inputs[train], log.x[train], rcond=None)[0]
        expected[test] = np.linalg.norm(log.x[test] - inputs[test] @ readout, axis=1)
    # The weak penalty of the correction, one row, is the difference.
    np.testing.assert_allclose(distances.mean(), expected.mean(), rtol=0.1)
    readout = np.linalg.lstsq(inputs, log.x, rcond=None)[0]
    fitted = np.linalg.norm(log.x - inputs @ readout, axis=1)
    assert fitted.mean() < 0.8 * distances.mean()


@pytest.mark.parametrize("hysteresis", [Hysteresis(), Hysteresis.backlash(0.3)])
def test_what_is_not_there_is_not_taken(hysteresis):
    found = find_hysteresis(log_of(hysteresis))
    assert found.kind == hysteresis.kind
    np.testing.assert_allclose(found.width, hysteresis.width, rtol=0.01)


def test_shares_of_creep_and_the_width_before_it_are_found():
    creep = Hysteresis.creep([0.1, 0.2], [1.0, 29.0 ** (2.0 / 3.0)])  # of the grid
    log = log_of(Hysteresis.backlash(0.3) | creep)
    backlash, slow = find_hysteresis(log).stages
    np.testing.assert_allclose(backlash.width, 0.3, rtol=0.02)
    shares = dict(zip(slow.times, slow.shares, strict=True))
    for share, time in zip(creep.stages[0].shares, creep.time_constants, strict=True):
        near = min(shares, key=lambda tau: abs(tau - time))
        np.testing.assert_allclose(shares[near], share, atol=0.05)


def changed(log, **columns):
    """A log with other columns, or only some of its rows."""
    names = ("model", "q", "x", "counts", "groups", "runs", "time")
    return HysteresisLog(**{name: columns.get(name, getattr(log, name)) for name in names})


def taken(log, rows):
    """A log of rows in another order, or of repeated ones that count once."""
    columns = {n: getattr(log, n)[rows] for n in ("q", "x", "counts", "groups", "runs", "time")}
    return changed(log, **columns)


def found(log, unit=1.0):
    """Weights of friction about a backlash of 0.3 and of creep, and the errors on held-out rows."""
    problem = HysteresisProblem(log, 0.3 * unit, creep=True)
    fit = problem.fitted(0.2, 0.2)
    return {
        "slopes": fit.slopes,
        "shares": fit.shares,
        "groups": np.sort(log.by_group(fit.distances)),
        "mean": np.average(fit.distances, weights=log.counts[log.rows]),
    }


FRICTION = Hysteresis.backlash(0.3) | Hysteresis.creep([0.2], [4.0])
WHOLE = log_of(FRICTION, groups=5, rows=24)
COUNTS = np.random.default_rng(1).integers(0, 4, len(WHOLE.q)).astype(float)
COUNTED = changed(WHOLE, counts=COUNTS)
MIXED = np.argsort((np.arange(len(WHOLE.q)) % 24) * 7 + WHOLE.groups * 3, kind="stable")


def repetitions():
    """Every row as often as it counts; those of no count as rows whose tip was not measured."""
    rows = np.repeat(np.arange(len(COUNTS)), np.maximum(COUNTS, 1).astype(int))
    x = np.where(COUNTS[:, None] > 0, WHOLE.x, np.nan)
    return taken(changed(WHOLE, x=x), rows)


def in_another_unit():
    unit = 1e3
    model = as_forward_model(lambda q: q @ torch.from_numpy(M.T / unit))
    return changed(COUNTED, model=model, q=unit * WHOLE.q)


INVARIANT = {
    "repetitions": repetitions,
    "order": lambda: taken(COUNTED, MIXED),
    "names": lambda: changed(
        COUNTED, groups=np.array([*"dabec"])[WHOLE.groups], runs=9.5 - WHOLE.runs
    ),
    "clock": lambda: changed(COUNTED, time=WHOLE.time + 1000.0 * WHOLE.runs),
    "unit of q": in_another_unit,
}


@pytest.mark.parametrize("change", INVARIANT)
def test_hysteresis_does_not_depend_on(change):
    """Counts are repetitions, of a row that stays, in which no creep goes on without time."""
    expected = found(COUNTED)
    assert expected["shares"].max() > 0.05
    after = found(INVARIANT[change](), 1e3 if change == "unit of q" else 1.0)
    for name, value in expected.items():  # sums in another order, conditions of 1e5
        np.testing.assert_allclose(after[name], value, rtol=1e-6, atol=1e-8)


def test_runs_and_not_groups_are_where_hysteresis_starts():
    """Parts of one motion are held out, but the play goes on from part to part."""
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (120, 3)).cumsum(axis=0)
    play = Hysteresis.backlash(0.8)
    groups, runs, time = np.arange(120) // 10, np.zeros(120), np.arange(120.0)
    x = play.apply_by_group(q, runs) @ M.T
    model = as_forward_model(lambda q: q @ torch.from_numpy(M.T))
    log = HysteresisLog(model, q, x, np.ones(120), groups, runs, time)
    exact = HysteresisProblem(log, 0.8, creep=False).fitted(0.0, 0.0).distances
    assert exact.max() < 1e-9
    restarted = changed(log, runs=groups)
    assert HysteresisProblem(restarted, 0.8, creep=False).fitted(0.0, 0.0).distances.max() > 0.05
    np.testing.assert_allclose(log.times[[0, -1]], [1.0, 119.0])
    np.testing.assert_allclose(restarted.times[[0, -1]], [1.0, 9.0])
    for train, test in log.folds:
        assert not set(groups[train]) & set(groups[test])
    slow = Hysteresis.creep([0.3], log.times[2:3])
    crept = changed(log, x=slow.apply_by_group(q, runs, time) @ M.T)
    found = HysteresisProblem(crept, 0.0, creep=True).fitted(0.0, 0.2)
    expected = np.zeros((len(log.times), 3))
    expected[2] = 0.3
    np.testing.assert_allclose(found.shares, expected, atol=1e-3)


def test_a_gain_must_be_above_its_error_and_above_one_percent():
    def gain_of(errors):
        before = np.array([1.0, 1.1, 0.9, 1.0])
        return gain(
            Candidate(0.0, Hysteresis(), before), Candidate(0.1, Hysteresis(), before - errors)
        )

    assert gain_of([0.1, 0.12, 0.08, 0.1]).certain
    unsure = gain_of([0.1, -0.04, 0.06, 0.04])
    assert unsure.clear
    assert not unsure.certain
    assert not gain_of([0.3, -0.2, 0.1, -0.1]).clear
    assert not gain_of(0.005).clear


def test_missing_markers_and_counts_weigh_the_rows():
    log = log_of(Hysteresis.backlash(0.3))
    problem = HysteresisProblem(log, 0.3, creep=True)
    twice = np.repeat(np.arange(len(log.q)), 2)
    doubled = HysteresisLog(
        log.model,
        log.q[twice],
        log.x[twice],
        np.ones(len(twice)),
        log.groups[twice],
        log.runs[twice],
        log.time[twice],
    )
    weighted = HysteresisLog(
        log.model, log.q, log.x, 2.0 * np.ones(len(log.q)), log.groups, log.runs, log.time
    )
    one = HysteresisProblem(doubled, 0.3, creep=False).fitted(0.2, 0.0)
    two = HysteresisProblem(weighted, 0.3, creep=False).fitted(0.2, 0.0)
    np.testing.assert_allclose(one.slopes, two.slopes, atol=1e-9)
    np.testing.assert_allclose(one.distances[::2], two.distances, rtol=1e-9)
    assert problem.fitted(0.2, 0.2).shares.max() < 0.02


@pytest.mark.parametrize("n_weights", [0, 4])
def test_least_squares_are_those_of_columns_written_out(n_weights):
    """The products of a correction's columns, and the errors of each part without its rows."""
    rng = np.random.default_rng(0)
    by_z = rng.standard_normal((40, 3, 5))
    inputs = rng.standard_normal((40, 4))
    by_weights = rng.standard_normal((40, 3, n_weights))
    target = rng.standard_normal((40, 3))
    folds = np.array_split(rng.permutation(40), 3)
    penalty = 0.3 * np.eye(n_weights)
    mean = np.ones(n_weights)
    system = _LeastSquares(by_z, inputs, by_weights, target, folds, penalty, mean, 40.0)

    correction = (by_z[..., None] * inputs[:, None, None]).reshape(40, 3, 20)
    columns = np.concatenate([correction, by_weights, target[..., None]], axis=2)
    flat = columns.reshape(120, -1)
    np.testing.assert_allclose(system.products, flat.T @ flat, rtol=0, atol=1e-12)
    distances = system.held_out()
    for test in folds:
        train = np.delete(columns, test, axis=0).reshape(-1, flat.shape[1])
        solution = np.append(system.solution(train.T @ train), -1.0)
        expected = np.linalg.norm(columns[test] @ solution, axis=1)
        np.testing.assert_allclose(distances[test], expected, rtol=1e-9)
