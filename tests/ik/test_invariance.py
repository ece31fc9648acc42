"""What may not depend on the units of q, time and length, and how weights and periods count.

The compiled core and torch compute every case. Both sides of a comparison are the same numbers up
to rounding, as each is first scaled by its weights: a step in a box is then good to 1e-9 of the
ranges, since its damping is 1e-6 of sigma_max^2; without limits it is good to 1e-12.
"""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from operators import operators, with_hysteresis

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    Hysteresis,
    InverseKinematics,
    RigidChain,
)
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import PointsTask, PoseTask

BACKENDS = {
    "core": pytest.param(np.array, marks=pytest.mark.needs_core),
    "torch": lambda a: torch.tensor(np.array(a)),
}
ON_BOTH = pytest.mark.parametrize("kind", BACKENDS.values(), ids=BACKENDS)
# The same for tests whose loops take long in torch.
SLOW_IN_TORCH = pytest.mark.parametrize(
    "kind",
    [BACKENDS["core"], pytest.param(BACKENDS["torch"], marks=pytest.mark.slow)],
    ids=BACKENDS,
)


def sliding(A):
    """Return the linear robot x = A q: three sliding joints, which the actuators drive together."""
    frames = np.tile(np.eye(4), (3, 1, 1))
    return RigidChain(frames, np.eye(3), kinds=["prismatic"] * 3, couplings=A)


def arrays(result):
    """Return the arrays of a step, a solution or a track by name."""
    names = type(result).__dataclass_fields__
    parts = {name: getattr(result, name) for name in names}
    return {name: np.asarray(part) for name, part in parts.items() if part is not None}


# ---------------------------------------------------------------- the unit of q

GAINS = np.array([2e-2, -3e-2, 2.5e-2, 1e-2, 4e-2, -2e-2])
ZEROS = np.array([5.0, -2.0, 0.0, 3.0, 10.0, 20.0])
CHAMBERS = {"radii": [0.1, 0.09]}
TENDONS = {"radii": [0.02, 0.02], "lengths": [0.1, 0.1]}
ROBOTS = {
    "chambers": (ConstantCurvatureChain, CHAMBERS, 0.15, 0.35, ZEROS),
    "tendons": (ConstantCurvatureChain, {**TENDONS, "routing": "base"}, -0.02, 0.02, ZEROS),
    "elastic": (ElasticTendonChain, TENDONS, -0.01, 0.01, 0.0),
}
LIMITS = {
    "free": {},
    "speed": {"dq_max": 0.25},
    "acceleration": {"dq_max": 3.0, "ddq_max": 15.0},
}


def counted(model, settings, zeros):
    """Return a function of q in counts, and settings in counts, for settings in metres."""
    low, high = ((settings[name] / GAINS + zeros) for name in ("q_min", "q_max"))
    found = dict(settings, q_min=np.minimum(low, high), q_max=np.maximum(low, high))
    found["q_pref"] = settings["q_pref"] / GAINS + zeros
    found["weights"] = settings["weights"] * GAINS**2
    for name in {"dq_max", "ddq_max"} & {*settings}:
        found[name] = settings[name] / np.abs(GAINS)
    return InverseKinematics(model, **found)


def in_both_units(name, limits, operator=None):
    """Return the solver of a robot in metres, the same in counts, and q in counts."""
    make, options, low, high, zeros = ROBOTS[name]
    span = (high - low) * np.linspace(0.8, 1.0, 6)
    middle = 0.5 * (low + high)
    settings = {name: value * span for name, value in LIMITS[limits].items()}
    settings |= {
        "q_min": middle - 0.5 * span,
        "q_max": middle + 0.5 * span,
        "q_pref": middle + 0.1 * span * np.cos(np.arange(6)),
        "weights": np.linspace(1.0, 3.0, 6),
        "damping": 0.01,
    }
    shifted = {} if make is ElasticTendonChain else {"actuator_zeros": zeros}
    plain = make(**options)
    scaled = make(**options, gains=GAINS, **shifted)
    if operator is not None:
        plain = with_hysteresis(plain, operator(1.0))
        scaled = with_hysteresis(scaled, operator(1.0 / np.abs(GAINS)))
    ours = InverseKinematics(plain, **settings)
    return ours, counted(scaled, settings, zeros), lambda q: q / GAINS + zeros


def rows_near(ik, count=25, seed=0):
    """Return rows of q within and beyond the limits, and targets near their tips and far."""
    draw = np.random.default_rng(seed)
    low, high = ik.settings.q_min.numpy(), ik.settings.q_max.numpy()
    q = draw.uniform(low, high, (count, len(low)))
    q[::5] += 0.3 * (high - low)
    near = q + draw.choice([0.01, 0.3], (count, 1)) * (high - low) * draw.standard_normal(q.shape)
    return q, ik.model(torch.from_numpy(near)).numpy()


@ON_BOTH
@pytest.mark.parametrize("limits", LIMITS)
@pytest.mark.parametrize("name", ROBOTS)
def test_a_step_is_the_same_in_another_unit_of_q(name, limits, kind):
    ours, theirs, convert = in_both_units(name, limits)
    q, x = rows_near(ours)
    span = np.ptp(q, axis=0)
    last = 0.005 * span * np.random.default_rng(1).standard_normal(q.shape)
    more = {"dx": kind(0.1 * (x - x[::-1])), "x_measured": kind(x + 0.002)}
    plain = arrays(ours.step(kind(q), kind(x), dq=kind(last), **more))
    other = arrays(theirs.step(kind(convert(q)), kind(x), dq=kind(last / GAINS), **more))
    other["dq"] = other["dq"] * GAINS
    assert_allclose(other["dq"] / span, plain["dq"] / span, rtol=0, atol=1e-8)
    if name != "elastic":  # whose last correction ends at a bound, or beside it by rounding
        assert_array_equal(other["saturated"], plain["saturated"])
        assert plain["saturated"].any()
    # Singular values are good to the root of the precision.
    close = {"x": 1e-12, "error": 1e-12, "sigma_min": 1e-6, "damping": 1e-9}
    for field, relative in close.items():
        size = np.abs(plain[field]).max()
        assert_allclose(other[field], plain[field], rtol=0, atol=relative * size, err_msg=field)


@SLOW_IN_TORCH
@pytest.mark.parametrize("name", ["chambers", "tendons"])
def test_a_solution_is_the_same_in_another_unit_of_q(name, kind):
    """From starts near the target: further ones are mirrored where a gain is negative."""
    ours, theirs, convert = in_both_units(name, "free")
    q, x = rows_near(ours)
    plain = arrays(ours.solve(kind(x), kind(q), restarts=0, tol=1e-6))
    other = arrays(theirs.solve(kind(x), kind(convert(q)), restarts=0, tol=1e-6))
    # A start that is singular is moved aside, to the other side where a gain is negative.
    alone = plain["n_starts"] == 1
    assert_array_equal(other["n_starts"], plain["n_starts"])
    assert_array_equal(other["status"][alone], plain["status"][alone])
    good = alone & (plain["status"] == IKStatus.CONVERGED)
    assert good.sum() > 10
    span = np.ptp(q, axis=0)
    found = (other["q"] - convert(np.zeros(6))) * GAINS
    assert_allclose((found / span)[good], (plain["q"] / span)[good], rtol=0, atol=1e-5)
    low, high = theirs.settings.q_min.numpy(), theirs.settings.q_max.numpy()
    margin = np.minimum(other["q"] - low, high - other["q"]).min(axis=1)
    assert_allclose(other["limit_margin"], margin, rtol=0, atol=1e-12)


@SLOW_IN_TORCH
@pytest.mark.parametrize("width", [None, 0.02], ids=["static", "backlash"])
@pytest.mark.parametrize("limits", ["speed", "acceleration"])
@pytest.mark.parametrize("name", ["chambers", "tendons"])
def test_a_track_is_the_same_in_another_unit_of_q(name, limits, width, kind):
    """With unequal periods; widths of backlash are in the unit of q, too."""
    span = ROBOTS[name][3] - ROBOTS[name][2]
    operator = (
        None
        if width is None
        else (lambda unit: Hysteresis.backlash(width * span * unit * np.ones(6)))
    )
    ours, theirs, convert = in_both_units(name, limits, operator)
    model = ours.settings.task.models[0]
    start = ours.settings.q_pref.numpy()
    phase = np.linspace(0.0, 1.0, 14)[:, None]
    way = start + 0.2 * span * np.sin(phase * (1.0 + np.arange(6) / 5.0))
    path = model(torch.from_numpy(way)).numpy()
    t = np.cumsum(0.01 + 0.02 * (np.arange(14) % 3))
    plain = arrays(ours.track(kind(path), kind(t), q0=kind(start)))
    other = arrays(theirs.track(kind(path), kind(t), q0=kind(convert(start))))
    for field in ("q", "effective"):
        back = (other[field] - convert(np.zeros(6))) * GAINS
        assert_allclose(back / span, plain[field] / span, rtol=0, atol=1e-7, err_msg=field)
    assert_array_equal(other["status"], plain["status"])
    assert_allclose(other["x"], plain["x"], rtol=0, atol=1e-8)
    assert (plain["status"] == IKStatus.AT_LIMITS).any()


@SLOW_IN_TORCH
@pytest.mark.parametrize("units", [(1e-3, 1.0), (1.0, 1.0), (1e3, 1e3)])
def test_which_solutions_differ_and_which_is_nearest_does_not_depend_on_the_unit(units, kind):
    """Joints in thousandths or thousands of a radian: ranges make them comparable."""
    origins = np.tile(np.eye(4), (2, 1, 1))
    origins[1, 0, 3] = 0.3
    couplings = np.diag(units)
    arm = RigidChain(origins, [[0, 0, 1]] * 2, couplings=couplings, tool=[0.2, 0, 0])
    ends = 3.0 / np.array(units)
    ik = InverseKinematics(arm, q_min=-ends, q_max=ends)
    q0 = np.array([0.35, -1.5]) / units
    found = ik.solve(kind([0.3, 0.2, 0.0]), kind(q0), tol=1e-9, n_solutions=3)
    names = [IKStatus(int(code)).name for code in found.status]
    assert names == ["CONVERGED", "CONVERGED", "NO_FURTHER"]
    angles = np.asarray(found.q)[:2] * units
    first = 2.0 * math.atan2(0.2, 0.3)
    # In thousandths of a radian the other one has the smaller distance.
    assert_allclose(angles, [[first, -0.5 * math.pi], [0.0, 0.5 * math.pi]], rtol=0, atol=1e-6)


# ---------------------------------------------------------------- the unit of time

TICK = 2.0**-4  # [s]; times a power of 2 a number keeps its digits
RATES = {"gain": 1, "beta": 1, "dq_max": 1, "ddq_max": 2, "dt": -1}
TIMED = {
    "speed": {"dq_max": 0.5, "gain": 12.0},
    "acceleration": {"dq_max": 0.8, "ddq_max": 4.0},
    "slow": {"gain": 8.0, "ddq_max": 3.0},
}


def clocks(limits, operator=None, **more):
    """Return the trunk with rates per second, and per tick."""
    chain = ConstantCurvatureChain([0.1, 0.09])
    model = chain if operator is None else with_hysteresis(chain, operator)
    settings = {"q_min": 0.15, "q_max": 0.35, "beta": 2.0, "dt": 0.05, **TIMED[limits], **more}
    slower = {name: value * TICK ** RATES.get(name, 0) for name, value in settings.items()}
    return InverseKinematics(model, **settings), InverseKinematics(model, **slower)


def reading(q):
    """Return the tip of a robot that is not as the model; not every time it is seen."""
    tip = ConstantCurvatureChain([0.1, 0.09])(torch.as_tensor(1.01 * np.asarray(q))).numpy()
    return tip if int(1e5 * abs(float(q[0]))) % 3 else np.full(3, np.nan)


def points(n, seed=3):
    phase = np.linspace(0.0, 3.0, n)
    x = np.stack([0.1 * np.sin(phase), 0.06 * np.sin(2.0 * phase), 0.5 + 0.02 * phase], axis=1)
    t = np.cumsum(np.random.default_rng(seed).choice([0.02, 0.05, 0.08], n))
    return x, t


@SLOW_IN_TORCH
@pytest.mark.parametrize("limits", TIMED)
def test_nothing_depends_on_the_unit_of_time(limits, kind):
    ours, theirs = clocks(limits)
    start = np.full(6, 0.25) + 0.01 * np.cos(np.arange(6))
    x, t = points(14)
    for more in ({}, {"plant": reading, "feedback": "measured", "memory": 0.3}):
        slower = dict(more, memory=0.3 / TICK) if more else {}
        plain = arrays(ours.track(kind(x), kind(t), q0=kind(start), **more))
        other = arrays(theirs.track(kind(x), kind(t / TICK), q0=kind(start), **slower))
        for field in plain.keys() - {"t"}:
            assert_allclose(other[field], plain[field], rtol=0, atol=1e-9, err_msg=field)
        assert_allclose(other["t"] * TICK, plain["t"], rtol=1e-15)
    # A tracker and a single step have the same periods, and velocities of targets.
    quick, slow = (
        ours.tracker(kind(start), memory=0.3),
        theirs.tracker(kind(start), memory=0.3 / TICK),
    )
    dx = np.array([0.05, 0.02, -0.01])
    for k, point in enumerate(x):
        seen = kind(np.full(3, np.nan) if k % 3 else point + 0.01)
        q = quick.step(kind(point), kind(dx), x_measured=seen)
        again = slow.step(kind(point), kind(dx * TICK), x_measured=seen)
        assert_allclose(again, q, rtol=0, atol=1e-9)
    last = kind(0.002 * np.cos(np.arange(6)))
    step = ours.step(kind(start), kind(x[3]), kind(dx), dq=last)
    again = theirs.step(kind(start), kind(x[3]), kind(dx * TICK), dq=last)
    assert_allclose(again.dq, step.dq, rtol=0, atol=1e-9)


@SLOW_IN_TORCH
@pytest.mark.parametrize("operator", ["play", "plays, creep"])
def test_commands_that_lead_do_not_depend_on_the_unit_of_time(operator, kind):
    model = operators(6, 2e-3)
    slower = operators(6, 2e-3)[operator]
    if operator == "plays, creep":
        plays = Hysteresis(slower.stages[:1])
        slower = plays | Hysteresis.creep([0.1, 0.05], [0.5 / TICK, 5.0 / TICK])
    ours, _ = clocks("acceleration", model[operator])
    _, theirs = clocks("acceleration", slower)
    start = np.full(6, 0.25)
    x, t = points(10)
    plain = arrays(ours.track(kind(x), kind(t), q0=kind(start)))
    other = arrays(theirs.track(kind(x), kind(t / TICK), q0=kind(start)))
    for field in ("q", "effective", "x", "error", "status"):
        assert_allclose(other[field], plain[field], rtol=0, atol=1e-8, err_msg=field)


@ON_BOTH
def test_times_that_begin_later_and_those_of_the_period_change_nothing(kind):
    ours, _ = clocks("acceleration")
    x, _ = points(10)
    start = kind(np.full(6, 0.25))
    plain = arrays(ours.track(kind(x), q0=start))
    t = 0.05 * np.arange(10)
    assert_allclose(plain["t"], t, rtol=1e-15)
    for later in (0.0, 512.0):
        other = arrays(ours.track(kind(x), kind(later + t), q0=start))
        assert_allclose(other["q"], plain["q"], rtol=0, atol=1e-11)


# ---------------------------------------------------------------- unequal periods, in closed form

PERIODS = np.array([0.01, 0.03, 0.02, 0.05, 0.005, 0.04, 0.01, 0.02, 0.03, 0.05])
TIMES = np.concatenate([[0.0], np.cumsum(PERIODS)])
STAYS = np.zeros((len(TIMES), 3))


@ON_BOTH
def test_an_error_falls_by_the_gain_times_each_period(kind):
    ik = InverseKinematics(sliding(np.eye(3)), gain=15.0, beta=0.0, dt=0.02)
    start = np.array([0.3, -0.2, 0.1])
    q = np.asarray(ik.track(kind(STAYS), kind(TIMES), q0=kind(start)).q)
    left = np.cumprod(np.append(1.0, 1.0 - 15.0 * PERIODS))
    assert_allclose(q, left[:, None] * start, rtol=0, atol=1e-14)


@ON_BOTH
def test_a_posture_is_approached_by_beta_times_each_period(kind):
    """The null space of x = A q is the difference of the last two actuators."""
    A = np.array([[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 1.0]])
    ik = InverseKinematics(sliding(A), q_pref=0.0, beta=9.0, gain=15.0, dt=0.02)
    start = np.array([0.0, 0.0, 0.25, -0.25])
    q = np.asarray(ik.track(kind(STAYS), kind(TIMES), q0=kind(start)).q)
    left = np.cumprod(np.append(1.0, 1.0 - 9.0 * PERIODS))
    assert_allclose(q, left[:, None] * start, rtol=0, atol=1e-14)


@ON_BOTH
@pytest.mark.parametrize(
    "operator", [None, Hysteresis.backlash(1e-9)], ids=["static", "hysteresis"]
)
def test_the_speed_grows_by_the_acceleration_times_each_period(operator, kind):
    """Full thrust towards a target far away; backlash is crossed in the first period."""
    model = sliding(np.eye(3))
    if operator is not None:
        model = with_hysteresis(model, operator)
    most = np.array([2.0, 3.0, 4.0])
    ik = InverseKinematics(model, ddq_max=most, beta=0.0, dt=0.02)
    far = np.tile(2.0 * most, (len(TIMES), 1))  # each actuator needs the same time
    q = np.asarray(ik.track(kind(far), kind(TIMES), q0=kind(np.zeros(3))).q)
    speed = np.cumsum(PERIODS)
    way = np.concatenate([[0.0], np.cumsum(speed * PERIODS)])
    assert_allclose(q, way[:, None] * most, rtol=0, atol=1e-8)


@ON_BOTH
def test_a_remembered_offset_decays_by_the_time_that_has_passed(kind):
    """Measured once, then never: the tip stays where the offset that is left says."""
    ik = InverseKinematics(sliding(np.eye(3)), beta=0.0, dt=0.02)
    offset = np.array([0.01, -0.005, 0.015])  # as may be
    seen = []

    def plant(q):
        seen.append(np.asarray(q))
        return seen[-1] + offset if len(seen) == 1 else np.full(3, np.nan)

    track = ik.track(
        kind(STAYS), kind(TIMES), q0=kind(np.zeros(3)), plant=plant, feedback="measured", memory=0.1
    )
    left = np.append(1.0, np.exp(-TIMES[1:-1] / 0.1))
    assert_allclose(np.asarray(track.q)[1:], -left[:, None] * offset, rtol=0, atol=1e-14)


@ON_BOTH
def test_no_actuator_is_faster_than_its_limit_in_any_period(kind):
    most = np.array([1.0, 2.0, 3.0])
    ik = InverseKinematics(sliding(np.eye(3)), dq_max=most, beta=0.0, dt=0.02)
    far = np.tile([9.0, -9.0, 9.0], (len(TIMES), 1))
    track = ik.track(kind(far), kind(TIMES), q0=kind(np.zeros(3)))
    expected = TIMES[:, None] * most * [1.0, -1.0, 1.0]
    assert_allclose(track.q, expected, rtol=0, atol=1e-13)
    assert track.largest_step == pytest.approx(3.0 * PERIODS.max())


# ---------------------------------------------------------------- weights of actuators

A = np.random.default_rng(5).standard_normal((3, 5))
WEIGHTED = {
    "free": {},
    "box": {"q_min": -0.2, "q_max": 0.2},
    "speed": {"q_min": -0.3, "q_max": 0.3, "dq_max": 4.0},
    "acceleration": {"q_min": -0.3, "q_max": 0.3, "ddq_max": 300.0},
    "plane": {"q_min": -0.3, "q_max": 0.3, "tip_limits": ([[1.0, 0.5, 0.0]], [0.1])},
}


def weighted(limits, A, weights, **settings):
    settings = {"q_pref": 0.05, "beta": 50.0, "dt": 0.01, **WEIGHTED[limits], **settings}
    return InverseKinematics(sliding(A), weights=weights, **settings)


@SLOW_IN_TORCH
@pytest.mark.parametrize("limits", WEIGHTED)
def test_a_weight_of_2_is_an_actuator_of_two_halves(limits, kind):
    """Each half with weight 1: the halves move alike, and their costs add up."""
    weights = np.array([1.0, 2.0, 1.0, 2.0, 1.0])
    places = np.repeat(np.arange(5), weights.astype(int))
    halves = (A / weights)[:, places]
    ours, theirs = weighted(limits, A, weights), weighted(limits, halves, None)
    draw = np.random.default_rng(0)
    q, x = draw.uniform(-0.2, 0.2, (12, 5)), draw.uniform(-0.6, 0.6, (12, 3))
    plain = arrays(ours.step(kind(q), kind(x)))
    other = arrays(theirs.step(kind(q[:, places]), kind(x)))
    assert_allclose(other["dq"], plain["dq"][:, places], rtol=0, atol=1e-9)
    assert_allclose(other["sigma_min"], plain["sigma_min"], rtol=1e-9)
    if limits in ("free", "box"):
        found = arrays(ours.solve(kind(x), kind(q), restarts=0, tol=1e-9))
        again = arrays(theirs.solve(kind(x), kind(q[:, places]), restarts=0, tol=1e-9))
        assert_array_equal(again["status"], found["status"])
        good = found["status"] == IKStatus.CONVERGED
        assert good.sum() > 2
        assert_allclose(again["q"][good], found["q"][good][:, places], rtol=0, atol=1e-4)


@SLOW_IN_TORCH
@pytest.mark.parametrize("limits", WEIGHTED)
def test_only_ratios_of_weights_count(limits, kind):
    weights = np.array([1.0, 2.0, 0.5, 3.0, 1.0])
    draw = np.random.default_rng(0)
    q, x = draw.uniform(-0.2, 0.2, (12, 5)), draw.uniform(-0.6, 0.6, (12, 3))
    q[0] = 0.0
    results = []
    for factor in (1.0, 256.0, 2.0**-16):
        ik = weighted(limits, A, factor * weights, damping=0.02)
        step = arrays(ik.step(kind(q), kind(x)))
        for field in ("sigma_min", "damping"):  # in the unit in which weights are 1
            step[field] = step[field] * factor**0.5
        if limits == "box":
            step["q"] = arrays(ik.solve(kind(x), kind(q), restarts=1))["q"]
        results.append(step)
    for other in results[1:]:
        for field, value in results[0].items():
            assert_allclose(other[field], value, rtol=0, atol=1e-9, err_msg=field)


# ---------------------------------------------------------------- the unit of length, task weights

SCALE = 4.0


def joints(scale):
    """Return an arm of three turning joints; its q has no unit of length."""
    origins = np.tile(np.eye(4), (3, 1, 1))
    origins[1:, 0, 3] = [0.3 * scale, 0.2 * scale]
    axes = [[0, 0, 1], [0, 1, 0], [1, 0, 1]]
    return RigidChain(origins, axes, tool=[0.1 * scale, 0.05 * scale, 0.0])


def trunk(scale):
    return ConstantCurvatureChain(
        scale * np.array([0.05, 0.04]), lengths=[0.1 * scale, 0.1 * scale]
    )


LONG = {
    "position": (joints, None, 0.0),
    "pose": (lambda s: PoseTask(joints(s), radian=0.1 * s), (1e-5, 1e-4), 0.0),
    "arcs": (trunk, None, 1.0),
    "pose of arcs": (lambda s: PoseTask(trunk(s), radian=0.1 * s), (1e-5, 1e-4), 1.0),
    "points": (lambda s: PointsTask(trunk(s), [1.0, 2.0], weights=[0.5, 2.0]), (1e-5, 2e-5), 1.0),
    "plane": (joints, None, 0.0),
}


@SLOW_IN_TORCH
@pytest.mark.parametrize("name", LONG)
def test_nothing_depends_on_the_unit_of_length(name, kind):
    """A robot four times as large, with all lengths of the settings; angles stay."""
    make, tol, power = LONG[name]
    unit = SCALE**power  # of q
    half = 0.03 if power else 1.5
    found = []
    for scale, of_q in ((1.0, 1.0), (SCALE, unit)):
        task = make(scale)
        more = {}
        restarts = 2
        if name == "plane":
            restarts = 0
            more["tip_limits"] = ([[0.0, 1.0, 0.5]], [0.1 * scale])
        ik = InverseKinematics(task, q_min=-half * of_q, q_max=half * of_q, damping=0.01, **more)
        inner = ik.settings.task
        n = inner.n_actuators
        q = half * of_q * np.random.default_rng(0).uniform(-1.0, 1.0, (12, n))
        start = half * of_q * np.random.default_rng(1).uniform(-1.0, 1.0, (12, n))
        target = inner.evaluate(torch.from_numpy(q))[0].numpy()
        step = arrays(ik.step(kind(start), kind(target)))
        tols = 1e-5 * scale
        if name.startswith("pose"):
            tols = (tol[0] * scale, tol[1])
        elif tol is not None:
            tols = (tol[0] * scale, tol[1] * scale)
        solution = arrays(ik.solve(kind(target), kind(start), tol=tols, restarts=restarts))
        found.append((step, solution))
    (step, solution), (far_step, far_solution) = found
    assert_allclose(far_step["dq"] / unit, step["dq"], rtol=0, atol=1e-9 * half)
    assert_allclose(far_step["error"] / SCALE, step["error"], rtol=1e-12)
    assert_array_equal(far_solution["status"], solution["status"])
    assert_array_equal(far_solution["n_starts"], solution["n_starts"])
    assert (solution["status"] == IKStatus.CONVERGED).any()
    assert_allclose(far_solution["q"] / unit, solution["q"], rtol=0, atol=1e-6 * half)


@SLOW_IN_TORCH
def test_a_point_of_weight_2_counts_as_four(kind):
    """Its error is squared: the task lists the point four times instead."""
    chain = ConstantCurvatureChain([0.1, 0.09, 0.08])
    ours = PointsTask(chain, [2.0, 3.0], weights=[1.0, 2.0])
    theirs = PointsTask(chain, [2.0, 3.0, 3.0, 3.0, 3.0])
    settings = {"q_min": 0.1, "q_max": 0.4, "beta": 0.0, "damping": 0.05}
    q = np.random.default_rng(0).uniform(0.15, 0.35, (20, 9))
    x = ours.evaluate(torch.from_numpy(q[::-1].copy()))[0].numpy()
    step = arrays(InverseKinematics(ours, **settings).step(kind(q), kind(x)))
    places = [0, 1, 1, 1, 1]
    again = arrays(InverseKinematics(theirs, **settings).step(kind(q), kind(x[:, places])))
    assert_allclose(again["error"], step["error"], rtol=1e-12)
    assert_allclose(again["dq"], step["dq"], rtol=0, atol=1e-8)
    conflicting = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 1.1]])
    one = InverseKinematics(ours, **settings).solve(kind(conflicting), kind(q[0]), restarts=0)
    many = InverseKinematics(theirs, **settings)
    many = many.solve(kind(conflicting[places]), kind(q[0]), restarts=0)
    assert_allclose(many.x[:2], one.x, rtol=0, atol=1e-4)
    assert many.error == pytest.approx(float(one.error), abs=1e-6)


@ON_BOTH
@pytest.mark.parametrize("radian", [0.05, 2.0])
def test_a_rotation_is_reached_within_its_tolerance_in_radians(radian, kind):
    """A joint that only turns the tip: the weight of the rotation does not move the tolerance."""
    task = PoseTask(RigidChain(np.eye(4)[None], [[0.0, 0.0, 1.0]]), radian=radian)
    ik = InverseKinematics(task, q_min=-1.0, q_max=1.0, beta=0.0)
    target = task.evaluate(torch.zeros(1, 1, dtype=torch.float64))[0][0].numpy()
    for angle, reached in ((0.019, True), (0.021, False)):
        solution = ik.solve(kind(target), kind([angle]), tol=(1e-3, 0.02))
        assert (int(solution.n_iter) == 0) == reached
        tracker = ik.tracker(kind([angle]), tol=(1e-3, 0.02))
        tracker.step(kind(target))
        assert (tracker.status is IKStatus.CONVERGED) == reached
        assert tracker.error == pytest.approx(radian * angle)


@ON_BOTH
@pytest.mark.parametrize("weight", [0.1, 10.0])
def test_points_are_reached_within_tolerances_in_metres(weight, kind):
    task = PointsTask(trunk(1.0), [1.0, 2.0], weights=[weight, 1.0])
    ik = InverseKinematics(task, q_min=-0.03, q_max=0.03, beta=0.0)
    q = np.array([0.01, -0.005, -0.005, 0.0, 0.01, -0.01])
    target = task.evaluate(torch.from_numpy(q)[None])[0][0].numpy()
    for miss, reached in ((0.9e-3, True), (1.1e-3, False)):
        solution = ik.solve(
            kind(target + miss * np.eye(2, 3)[:1] * [[1.0], [0.0]]), kind(q), tol=(1e-3, 1e-3)
        )
        assert (int(solution.n_iter) == 0) == reached
        tracker = ik.tracker(kind(q), tol=(1e-3, 1e-3))
        tracker.step(kind(target + miss * np.eye(2, 3)[:1] * [[1.0], [0.0]]))
        assert (tracker.status is IKStatus.CONVERGED) == reached


def test_a_proven_miss_is_no_larger_than_the_error_of_the_task():
    """Of weighted points, and of poses: then "unreachable" is certain."""
    far = np.array([0.0, 0.0, 0.9])
    pose = np.eye(4)
    pose[:3, 3] = far
    tasks = [
        (PointsTask(trunk(1.0), [1.0, 2.0], weights=w), np.stack([far, far]))
        for w in ([0.1, 0.1], [0.1, 2.0], [3.0, 2.0])
    ]
    tasks += [(PoseTask(trunk(1.0), radian=r), pose) for r in (0.1, 5.0)]
    for task, target in tasks:
        ik = InverseKinematics(task, q_min=-0.03, q_max=0.03)
        proven = float(ik.settings.misses(torch.from_numpy(target)[None]))
        solution = ik.solve(target, restarts=0)
        assert 0.0 < proven <= solution.error
        assert solution.status == IKStatus.UNREACHABLE


@ON_BOTH
def test_half_spaces_are_the_same_in_any_order_and_length_of_their_normals(kind):
    chain = ConstantCurvatureChain([0.1, 0.09, 0.08])
    q = np.random.default_rng(0).uniform(0.15, 0.35, (30, 9))
    x = chain(torch.from_numpy(q)).numpy()
    normals = np.array([[1.0, 0.2, 0.0], [0.0, 1.0, -0.3], [-0.2, 0.0, 1.0]])
    offsets = (x @ normals.T).mean(axis=0) + 0.02
    plain = InverseKinematics(chain, q_min=0.1, q_max=0.4, tip_limits=(normals, offsets))
    factors = np.array([8.0, 0.25, 3.0])
    other = (normals * factors[:, None])[::-1], (offsets * factors)[::-1]
    other = InverseKinematics(chain, q_min=0.1, q_max=0.4, tip_limits=other)
    # From inside and within reach: rows that cannot get inside depend on the order of projections.
    inside = (x @ normals.T <= offsets).all(axis=1)
    assert inside.sum() > 5
    rows = kind(q[inside]), kind(x[::-1].copy()[inside])
    assert_allclose(other.step(*rows).dq, plain.step(*rows).dq, rtol=0, atol=1e-8)
