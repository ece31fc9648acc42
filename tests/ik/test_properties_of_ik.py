"""Inverse kinematics of hostile numbers: an answer within the limits, or an error that names why.

Rows whose numbers are not finite hold still, say so, and change no other row: by no bit in the
compiled core, by 1e-12 in torch, where sums of a batch are taken in another order.
"""

import warnings

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal
from saved_models import arm, tendon_chain, trunk, trunk_log
from strategies import answer, arrays

from hybridkin import ELMRegressor, HybridForwardModel, InverseKinematics
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask
from hybridkin.native import available

Q, X, GROUPS = trunk_log()
LEARNED = HybridForwardModel(trunk(), ELMRegressor(4, random_state=0)).fit(Q, X)


def line(q):
    """One actuator that moves the tip along a line, in torch alone."""
    return torch.cat([0.2 * q, 0.0 * q, 0.3 * q], dim=-1)


# model, and the middle and the half width of its limits
MODELS = {
    "trunk": (trunk(), 0.25, 0.15),
    "hybrid": (LEARNED, 0.25, 0.1),
    "tendons": (tendon_chain(), 0.0, 0.004),
    "arm": (arm(), 0.2, 3.3),  # two joints may turn all the way round
    "line": (line, 0.0, 1.0),
    "pose": (PoseTask(arm()), 0.2, 3.3),
    "points": (PointsTask(tendon_chain(), [1.0, 2.0]), 0.0, 0.004),
}
COMPILED = ("trunk", "hybrid", "tendons", "arm") if available() else ()
# Positive numbers that a user may mean, and some that nobody does.
ODD = (np.inf, 5e-324, 1e-300, 1e300, 1e-9)


def dofs(name):
    task = InverseKinematics(MODELS[name][0]).settings.task
    return task.n_actuators or 1, task.shape, sum(task.parts)


@st.composite
def solvers(draw, names=tuple(MODELS), odd=ODD):
    """A name of `MODELS` and a solver with any of its options."""
    name = draw(st.sampled_from(names))
    model, middle, half = MODELS[name]
    n, shape, _ = dofs(name)
    spread = np.random.default_rng(draw(st.integers(0, 9))).uniform(0.5, 1.0, n)
    low, high = middle - half * spread, middle + half * spread
    if draw(st.booleans()):
        high[0] = low[0]  # locked
    options = {
        "q_min": low,
        "q_max": high,
        "dq_max": draw(st.sampled_from([10.0 * half, *odd])),
        "ddq_max": draw(st.sampled_from([np.inf, 100.0 * half, *odd])),
        "weights": draw(st.sampled_from([None, 1.0 + np.arange(n), 1e-300, 1e300, 1e9**spread])),
        "beta": draw(st.sampled_from([0.0, 1.0, 100.0])),
        "gain": draw(st.sampled_from([None, 1.0, 1e-300])),
        "damping": draw(st.sampled_from(["adaptive", 0.0, 0.1, 1e300])),
        "limits": draw(st.sampled_from(["saturate", "saturate", "off"])),
    }
    if shape == (3,) and draw(st.booleans()):
        options["tip_limits"] = (np.eye(3)[:2], [0.02, 0.03])
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`.*` reaches")  # of units
        return name, InverseKinematics(model, **options)


def targets(draw, name, rows):
    """Targets (rows, ...) for a model, hostile but for poses, which are checked."""
    _, shape, _ = dofs(name)
    if shape == (4, 4):
        target = np.tile(np.eye(4), (rows, 1, 1))
        target[:, :3, 3] = draw(arrays((rows, 3), -0.6, 0.6))
        return target
    return draw(arrays((rows, *shape), -0.3, 0.5))


@st.composite
def motions(draw, rows, names=tuple(MODELS)):
    """Arguments of a step: a solver, configurations, targets, and what else may be given."""
    name, ik = draw(solvers(names))
    n, _, m = dofs(name)
    _, middle, half = MODELS[name]
    q = draw(arrays((rows, n), middle - 1.1 * half, middle + 1.1 * half))
    more = {
        "dx": draw(st.none() | arrays((rows, m))),
        "x_measured": targets(draw, name, rows) if draw(st.booleans()) else None,
        "dq": draw(st.none() | arrays((rows, n), -0.02 * half, 0.02 * half)),
    }
    return name, ik, q, targets(draw, name, rows), more


@np.errstate(over="ignore", under="ignore")
def finite(rows, dtype, *given):
    """Return which rows hold finite numbers only, in a precision."""
    flat = [np.reshape(a, (rows, -1)).astype(dtype) for a in given if a is not None]
    return np.logical_and.reduce([np.isfinite(a).all(1) for a in flat])


def of_rows(more, rows):
    return {name: None if a is None else a[rows] for name, a in more.items()}


def bounds(ik, dtype=float):
    n = ik.settings.n_actuators or 1
    ends = ik.settings.box(torch.zeros((), dtype=torch.from_numpy(np.empty(0, dtype)).dtype))
    return [np.broadcast_to(end.numpy(), n) for end in ends]


@np.errstate(all="ignore")
def check_limits(ik, q, dq, last):
    """Limits of q, speed and acceleration hold to the last bit, in the dtype of q."""
    settings, (low, high) = ik.settings, bounds(ik, q.dtype)
    if settings.limits == "off":
        return
    inside, new = (q >= low) & (q <= high), q + dq
    # A speed that cannot be stopped in time leads out: there the step brakes.
    stops = inside & (last == 0.0) if settings.accelerates else inside
    assert ((new >= low) & (new <= high))[stops].all()
    # From outside no actuator goes farther out, but by rounding of q.
    out = np.isfinite(q) & ~inside & (last == 0.0)
    before, after = (np.abs(a - np.clip(a, low, high)) for a in (q, new))
    assert (after <= before + np.spacing(np.abs(q)))[out].all()
    most = settings.dq_max.to(torch.from_numpy(np.array(q))) * settings.dt
    slow = np.abs(last) <= np.broadcast_to(most.numpy(), q.shape)
    assert (np.abs(dq) <= most.numpy())[slow].all()
    if settings.accelerates:
        change = (settings.ddq_max.to(torch.from_numpy(np.array(q))) * settings.dt**2).numpy()
        change = np.broadcast_to(change, q.shape)
        kept = np.isfinite(q) & np.isfinite(last).all(-1, keepdims=True)
        ends = last - change, last + change
        assert ((dq >= ends[0]) & (dq <= ends[1]))[kept].all()


@given(motions(rows=4))
def test_a_step_is_finite_within_the_limits_and_its_own(case):
    name, ik, q, target, more = case
    step, error = answer(ik.step, q, target, **more)
    assert error is None
    n, shape, _ = dofs(name)
    assert step.dq.dtype == step.x.dtype == q.dtype
    assert (step.dq.shape, step.x.shape, step.error.shape) == ((4, n), (4, *shape), (4,))
    assert np.isfinite(step.dq).all()
    assert (step.dq[~np.isfinite(q)] == 0.0).all()
    with np.errstate(over="ignore", under="ignore"):
        last = np.zeros_like(q) if more["dq"] is None else np.asarray(more["dq"], q.dtype)
    check_limits(ik, np.asarray(q), step.dq, last)
    counted = more if ik.settings.accelerates else {**more, "dq": None}
    good = finite(4, q.dtype, q, target, *counted.values())
    assert np.isnan(step.sigma_min[~good]).all()
    # The others are what they are alone, and in any order.
    backwards = answer(ik.step, q[::-1], target[::-1], **of_rows(more, np.s_[::-1]))[0]
    compiled = name in COMPILED and q.dtype == float and ik.settings.tip_limits.n == 0
    for i in range(4):
        alone = answer(ik.step, q[i], target[i], **of_rows(more, i))[0]
        for field in ("dq", "x", "error", "sigma_min", "damping", "saturated"):
            parts = [getattr(one, field) for one in (step, backwards, alone)]
            parts = parts[0][i], parts[1][3 - i], parts[2]
            for part in parts[1:]:
                if compiled:
                    assert_array_equal(part, parts[0], err_msg=field)
                elif field != "saturated":
                    tol = 1e-12 if q.dtype == float else 1e-4
                    with np.errstate(over="ignore"):
                        assert_allclose(part, parts[0], rtol=tol, atol=tol, err_msg=field)


@given(motions(rows=5), st.sampled_from([np.inf, 0.05]), st.booleans())
def test_a_tracker_stays_within_the_limits_whatever_comes(case, memory, in_torch):
    _, ik, q, target, more = case
    settings, (low, high) = ik.settings, bounds(ik)
    start = np.clip(np.nan_to_num(np.asarray(q[0], float)), -1e3, 1e3)
    start = np.clip(start, low, high)
    convert = torch.tensor if in_torch else np.array
    tracker, error = answer(ik.tracker, convert(start), memory=memory)
    assert error is None
    before = start
    for i in range(5):
        given = of_rows(more, i)
        given.pop("dq")
        parts = {k: a if a is None else convert(a.copy()) for k, a in given.items()}
        command, error = answer(tracker.step, convert(target[i].copy()), **parts)
        assert error is None
        command = np.asarray(command)
        assert np.isfinite(command).all()
        if settings.limits != "off":
            assert ((command >= low) & (command <= high)).all()
            most = np.broadcast_to((settings.dq_max * settings.dt).numpy(), command.shape)
            assert (np.abs(command - before) <= most + np.spacing(np.abs(before))).all()
        status, error = answer(lambda: (tracker.status, repr(tracker)))
        assert error is None
        if not finite(1, float, target[i], given["dx"]):
            assert status[0] is IKStatus.INVALID_INPUT
            if not settings.accelerates:
                assert_array_equal(command, before)
        before = command


@pytest.mark.slow
@given(st.data(), solvers(), st.sampled_from([0, 1]), st.sampled_from([None, None, 2]))
def test_a_solution_stays_within_the_limits_whatever_is_asked(data, case, restarts, places):
    name, ik = case
    (n, shape, _), (low, high) = dofs(name), bounds(ik)
    _, middle, half = MODELS[name]
    target = targets(data.draw, name, 4)
    q0 = data.draw(st.none() | arrays((4, n), middle - 2.0 * half, middle + 2.0 * half))
    options = {"max_iter": 6, "restarts": restarts, "n_solutions": places}
    if ik.settings.n_actuators is None:
        q0 = np.zeros((4, n)) if q0 is None else q0
    solution, error = answer(ik.solve, target, q0, **options)
    assert error is None
    dtype = target.dtype if q0 is None else np.promote_types(target.dtype, q0.dtype)
    lead = (4,) if places is None else (4, places)
    assert (solution.q.shape, solution.status.shape) == ((*lead, n), lead)
    assert solution.q.dtype == dtype
    low, high = bounds(ik, dtype)
    known = ~np.isnan(solution.q)
    assert (((solution.q >= low) & (solution.q <= high)) | ~known).all()
    good = finite(4, dtype, target, q0)
    first = np.s_[:] if places is None else np.s_[:, 0]
    assert (solution.status[first][~good] == IKStatus.INVALID_INPUT).all()
    missing = (solution.status == IKStatus.NO_FURTHER) | (solution.status == IKStatus.INVALID_INPUT)
    assert known[~missing].all()
    assert np.isfinite(solution.error[~missing]).all()
    # What is not finite changes no other row.
    plain = np.where(good.reshape(4, *(1,) * len(shape)), target, target[good][:1].sum(0))
    if good.any():
        start = None if q0 is None else np.where(good[:, None], q0, q0[good][0])
        alone = answer(ik.solve, plain.astype(target.dtype), start, **options)[0]
        assert_array_equal(alone.status[good], solution.status[good])
        assert_allclose(alone.q[good], solution.q[good], rtol=0.0, atol=1e-3 * half)
