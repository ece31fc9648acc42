"""Every feature of a hybrid with every other: laws that hold for any combination.

A robot, its markers, backlash, the error model, the coupling, what is calibrated, the guard, the
groups and a change of the robot are crossed pairwise: every two values of two factors meet in at
least one case, where the documentation allows them.
"""

from __future__ import annotations

import itertools
import os
import pickle
import warnings
from typing import NamedTuple

import numpy as np
import pytest
import torch
from operators import operators
from sklearn.base import clone
from sklearn.linear_model import LinearRegression

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ElasticTendonChain,
    ELMRegressor,
    ELMRegressorCV,
    ForceTendonChain,
    HybridForwardModel,
    InverseKinematics,
    RigidChain,
    load_model,
    open_model,
    save_model,
)
from hybridkin.app.workflow import path_limits
from hybridkin.hybrid._wrapped import in_columns
from hybridkin.plots import BackboneDisplay

MARKERS = [(0, 0.6), (0, 1.0)]
N_MOTIONS, N_ROWS = 5, 8
DRAWN = 4


def tendons(**options):
    return ConstantCurvatureChain([0.005], lengths=[0.06], offsets=[0.01], **options)


def arm():
    origins = np.stack([np.eye(4)] * 3)
    origins[1:, 0, 3] = 0.3, 0.2
    kinds = ["revolute", "prismatic", "revolute"]
    axes = [[0, 0, 1], [1, 0, 2], [0, 1, 0]]
    limits = {"q_min": [-2.0, 0.0, -2.0], "q_max": [2.0, 0.4, 2.0]}
    return RigidChain(origins, axes, kinds=kinds, tool=[0.1, 0.0, 0.02], **limits)


class OwnModel(torch.nn.Module):
    """A mechanical model of a user: no chain, no closed-form Jacobian."""

    def forward(self, q):
        return torch.stack([q.sum(-1), q[..., 0].sin(), q[..., 1] * q[..., 2]], dim=-1)


class Robot(NamedTuple):
    """The model of a robot, and the middle and half the range of its actuators."""

    chain: torch.nn.Module | None
    middle: float
    half: float

    @property
    def n(self):
        return getattr(self.chain, "n_actuators", 0) or 3


ROBOTS = {
    "chambers": Robot(ConstantCurvatureChain([0.05], offsets=[0.03]), 0.2, 0.03),
    "tendons": Robot(tendons(), 0.0, 0.003),
    "gain": Robot(tendons(gains=2e-5), 0.0, 150.0),
    "gains": Robot(tendons(gains=[2e-5, -2e-5, 3e-5]), 0.0, 150.0),
    "unit range": Robot(tendons(gains=1e-3, actuator_zeros=5.0), 5.0, 1.0),
    "elastic": Robot(ElasticTendonChain([0.005], [0.06], bending_stiffness=3e-7), 0.0, 0.002),
    "elastic, gain": Robot(ElasticTendonChain([0.005], [0.06], gains=2e-5), 0.0, 100.0),
    "forces": Robot(ForceTendonChain([0.01], [0.3], 0.02, 50.0, weight=0.1, arcs=3), 1.5, 1.0),
    "rotated stage": Robot(
        ConstantCurvatureChain(
            [0.05] * 2, n_actuators=[1, 3], lengths=[None, 0.1], routing="base", stage="rotation"
        ),
        0.0,
        0.01,
    ),
    "rigid": Robot(arm(), 0.2, 0.2),
    "own": Robot(OwnModel(), 0.0, 0.5),
    "none": Robot(None, 0.2, 0.03),
}
ERROR_MODELS = {
    "drop": "drop",
    "linear": "linear",
    "quadratic": "quadratic",
    "pose": "pose",
    "kernel": "kernel",
    "ELM": ELMRegressor(20, random_state=0),
    "ELM-CV": ELMRegressorCV(20, random_state=0),
    "regression": LinearRegression(),
    "auto": "auto",
}
FACTORS = {
    "robot": tuple(name for name in ROBOTS if name != "forces"),  # which is slow
    "markers": ("tip", "two", "two, some missing"),
    "hysteresis": ("none", "width", "friction, creep", "creep, friction", "auto"),
    "error_model": tuple(ERROR_MODELS),
    "coupling": ("parallel", "serial"),
    "output": ("position", "pose"),
    "calibrate": ("as it is", "base", "gain"),
    "guard": ("leverage", None),
    "groups": (True, False),
    "change": ("none", "adapted", "drifted", "adapted and drifted"),
}


def allowed(case):
    """Return whether the documentation allows a case, or a part of one."""

    def known(*names):
        return all(name in case for name in names)

    chain = ROBOTS[case["robot"]].chain if known("robot") else None
    arcs = hasattr(chain, "with_markers")
    gains = arcs and "gains" in chain.geometry()
    model = case.get("error_model")
    marked = case.get("markers", "tip") != "tip"
    if known("robot"):
        if not arcs and (model == "pose" or (chain is not None and marked)):
            return False
        if chain is None:
            if model not in (None, "kernel", "ELM", "ELM-CV", "regression", "auto"):
                return False
            if case.get("coupling") == "serial" or case.get("output") == "pose":
                return False
        if not arcs and case.get("calibrate") not in (None, "as it is"):
            if case["robot"] != "rigid" or case["calibrate"] == "gain":
                return False
        if case.get("calibrate") == "gain" and not gains:
            return False
        if case["robot"] == "own" and case.get("output") == "pose":
            return False
    if case.get("output") == "pose" and (marked or case.get("coupling") == "serial"):
        return False
    if case.get("output") == "pose" and model in ("linear", "quadratic", "pose", "auto"):
        return False
    if case.get("coupling") == "serial" and model in ("kernel", "regression", "auto"):
        return False
    # Choices take long, and have tests of their own: not one within the other.
    if case.get("hysteresis") == "auto" and model in ("auto", "kernel", "ELM-CV"):
        return False
    # Motions need rows in order of time; changed robots need three coordinates or poses.
    return not (case.get("hysteresis") == "auto" and case.get("groups") is False)


def pairwise(factors, seed=0, of=()):
    """Return cases in which every allowed pair of values meets, greedily from random ones.

    With `of`, factors with a value each, only the pairs of these values.
    """
    rng = np.random.default_rng(seed)
    missing = set()
    for a, b in itertools.combinations(factors, 2):
        for pair in itertools.product(factors[a], factors[b]):
            entry = ((a, pair[0]), (b, pair[1]))
            if allowed(dict(entry)) and (not of or {*of} & {*entry}):
                missing.add(entry)
    cases = []
    for entry in sorted(missing, key=str):
        if entry not in missing:
            continue
        tried = [completed(dict(entry), factors, rng) for _ in range(100)]
        tried = [case for case in tried if case is not None]
        if not tried:
            missing.discard(entry)  # a third value rules the pair out
            continue
        best = max(tried, key=lambda case: len(missing & met(case)))
        missing -= met(best)
        cases.append(best)
    return cases


def completed(case, factors, rng):
    """Return the case with random allowed values of the other factors, None if there are none."""
    for name in rng.permutation([name for name in factors if name not in case]):
        values = [value for value in factors[name] if allowed({**case, name: value})]
        if not values:
            return None
        case = {**case, name: values[rng.integers(len(values))]}
    return case


def met(case):
    ordered = [(name, case[name]) for name in FACTORS]
    return set(itertools.combinations(ordered, 2))


# Fits of this robot take long: crossed with all pairs of the others by `make everything` alone.
OF_FORCES = ("robot", "forces"), ("error_model", "drop")
EVERY_PAIR = "HYBRIDKIN_MUST_RUN" in os.environ
CASES = pairwise(FACTORS)
CASES += pairwise({**FACTORS, "robot": ("forces",)}, of=() if EVERY_PAIR else OF_FORCES)
SLOW = {"auto", "forces", "ELM-CV", "kernel"}  # values whose fits take more than 0.3 s


class Log(NamedTuple):
    q: np.ndarray
    x: np.ndarray
    groups: np.ndarray | None

    @property
    def commands(self):
        return Commands(self.q, self.groups, np.arange(float(len(self.q))))


def log_of(case, robot, chain):
    """Return measured rows of a robot that bends a little more than its model says."""
    rng = np.random.default_rng(0)
    way = rng.uniform(-1.0, 1.0, (N_MOTIONS, 2, robot.n))
    share = np.linspace(0.0, 1.0, N_ROWS)[:, None]
    commands = np.concatenate([start + share * (end - start) for start, end in way])
    q = robot.middle + robot.half * commands
    q[0] = robot.middle - robot.half
    q[1] = robot.middle + robot.half
    actual = torch.from_numpy(robot.middle + 1.02 * robot.half * (commands + 0.05 * commands**2))
    size = 1e-3 * rng.standard_normal((len(q), 3))
    if robot.chain is None:
        tips = [np.column_stack([q[:, 0] + k, np.sin(q[:, 1]), q[:, 2] ** 2]) for k in range(2)]
        x = np.concatenate(tips if case["markers"] != "tip" else tips[:1], axis=1)
    elif case["output"] == "pose":
        model = HybridForwardModel(chain, "drop", output="pose", guard=None)
        model.fit(q, np.zeros((len(q), 6)))
        x = model.predict(actual.numpy())
    else:
        x = chain(actual).numpy()
    x = x.copy()
    x[:, :3] += 0.05 * size
    if case["markers"] == "two, some missing":
        x[3:7, :3] = np.nan
    groups = np.repeat(np.arange(N_MOTIONS), N_ROWS) if case["groups"] else None
    return Log(q, x, groups)


class Fitted(NamedTuple):
    model: HybridForwardModel  # after the change of the robot
    unchanged: HybridForwardModel
    log: Log
    robot: Robot


def fitted(case):
    robot = ROBOTS[case["robot"]]
    chain = robot.chain
    if case["markers"] != "tip" and chain is not None:
        segments = chain.n_segments - 1
        chain = chain.with_markers([(segments, at) for _, at in MARKERS])
    log = log_of(case, robot, chain)
    calibrate = {"as it is": (), "base": ["base"], "gain": ["gain"]}
    model = HybridForwardModel(
        chain,
        ERROR_MODELS[case["error_model"]],
        coupling=case["coupling"],
        calibrate=calibrate[case["calibrate"]],
        guard=case["guard"],
        hysteresis=hysteresis_of(case["hysteresis"], robot),
        output=case["output"],
        random_state=0,
    )
    model.fit(log.commands, log.x, groups=log.groups)
    unchanged = pickle.loads(pickle.dumps(model))
    if "adapted" in case["change"]:
        moved = log.x[:10] + np.resize([0.004, -0.002, 0.003, 0.0, 0.0, 0.0], log.x.shape[1])
        if case["output"] == "position":
            moved = log.x[:10] + np.resize([0.004, -0.002, 0.003], log.x.shape[1])
        model.adapt(log.commands[:10], moved)
    if "drifted" in case["change"]:
        model.partial_fit(log.commands[:20], log.x[:20] + 0.002)
    return Fitted(model, unchanged, log, robot)


def hysteresis_of(kind, robot):
    """Return the argument `hysteresis` of a model: none, a width, a value, or "auto"."""
    values = operators(robot.n, 0.1 * robot.half)
    of_kind = {
        "none": 0.0,
        "width": 0.1 * robot.half,
        "friction, creep": values["plays, creep"],
        "creep, friction": values["creep, play, plays"],
        "auto": "auto",
    }
    return of_kind[kind]


def name_of(case):
    return " - ".join(str(value) for value in case.values())


PARAMS = [
    pytest.param(case, id=name_of(case), marks=[pytest.mark.slow] * bool(SLOW & {*case.values()}))
    for case in CASES
]


@pytest.fixture(scope="module", params=PARAMS)
def crossing(request):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # few rows, and what a robot cannot tell
        return request.param, fitted(request.param)


@pytest.fixture(autouse=True)
def _without_warnings_of_few_rows():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        yield


def test_parts_add_up(crossing):
    case, (model, _, log, _) = crossing
    whole = model.predict(log.commands)
    mechanical = model.predict_mechanical(log.commands)
    error = model.predict_error(log.commands)
    columns = slice(None, 3 if case["output"] == "pose" else None)
    np.testing.assert_allclose((mechanical + error)[:, columns], whole[:, columns], atol=1e-9)
    if case["error_model"] == "drop" and case["change"] in ("none", "adapted"):
        np.testing.assert_allclose(error, 0.0, atol=1e-12)


def test_the_core_agrees_with_torch(crossing):
    case, (model, _, log, _) = crossing
    module = in_columns(model.module_, case["output"])
    q = torch.from_numpy(model.effective(log.commands))
    with torch.no_grad():
        x, J = module.forward_and_jacobian(q)
        inside = model.module_.in_domain(q)
    np.testing.assert_allclose(model.predict(log.commands), x, atol=1e-9)
    np.testing.assert_allclose(model.jacobian(log.commands), J, rtol=1e-7, atol=1e-7)
    in_domain = model.in_domain(log.commands)
    assert (in_domain <= inside.numpy()).all()
    if case["hysteresis"] != "creep, friction" or "adapted" not in case["change"]:
        # There the zeros that are found may shift the states out of the range of the log.
        assert (in_domain == inside.numpy()).all()


def test_the_jacobian_is_the_derivative(crossing):
    _, (model, _, log, robot) = crossing
    module = model.module_
    q = torch.from_numpy(log.q[12:20] + 0.01 * robot.half)
    step = 1e-5 * robot.half
    with torch.no_grad():
        J = module.jacobian(q)
        for k in range(robot.n):
            way = torch.zeros_like(q)
            way[:, k] = step
            slope = (module(q + way) - module(q - way)) / (2.0 * step)
            np.testing.assert_allclose(
                robot.half * J[..., k], robot.half * slope, rtol=0, atol=2e-7
            )


def test_a_file_holds_the_model(crossing, tmp_path):
    case, (model, _, log, _) = crossing
    if case["robot"] == "own":
        with pytest.raises(TypeError, match="code"):
            save_model(model, tmp_path / "model.safetensors")
        return
    save_model(model, tmp_path / "model.safetensors")
    again = load_model(tmp_path / "model.safetensors")
    for method in ("predict", "predict_mechanical", "predict_error", "jacobian", "in_domain"):
        before = getattr(model, method)(log.commands)
        after = getattr(again, method)(log.commands)
        np.testing.assert_allclose(after, before, rtol=1e-12, atol=1e-12, err_msg=method)
    np.testing.assert_array_equal(again.training_range_, model.training_range_)
    assert again.hysteresis_ == model.hysteresis_
    pickled = pickle.loads(pickle.dumps(model))
    np.testing.assert_array_equal(pickled.predict(log.commands), model.predict(log.commands))


def test_limits_of_a_track_leave_room(crossing, tmp_path):
    case, (model, _, _, robot) = crossing
    if case["robot"] == "own":
        return  # is code, which no file holds
    save_model(model, tmp_path / "model.safetensors")
    limits = path_limits(open_model(tmp_path / "model.safetensors"))
    assert (np.broadcast_to(limits.q_max - limits.q_min, robot.n) > 0.5 * robot.half).all()


def test_a_clone_fits_the_same(crossing):
    case, (_, model, log, _) = crossing
    if case["error_model"] == "auto" and (
        case["hysteresis"] != "none" or case["robot"] == "forces"
    ):
        return  # takes as long as the fit itself; quick robots without backlash are enough
    again = clone(model).fit(log.commands, log.x, groups=log.groups)
    np.testing.assert_allclose(
        again.predict(log.commands),
        model.predict(log.commands),
        rtol=0,
        atol=1e-9,
    )


def test_the_training_range_is_that_of_the_log(crossing):
    case, (model, unchanged, log, robot) = crossing
    low, high = unchanged.training_range_
    if not model.hysteresis_:
        np.testing.assert_allclose(low, log.q.min(axis=0), rtol=0, atol=1e-12 * robot.half)
        np.testing.assert_allclose(high, log.q.max(axis=0), rtol=0, atol=1e-12 * robot.half)
    else:
        width = np.max(model.hysteresis_.width)
        for stage in model.hysteresis_.stages:
            if stage.needs_time:  # at most this share of a motion is late
                late = stage.shares.reshape(len(stage.shares), -1).sum(axis=0)
                width = width + late * np.ptp(log.q, axis=0)
        assert (low >= log.q.min(axis=0) - 1e-12).all()
        assert (high <= log.q.max(axis=0) + 1e-12).all()
        assert (high - low >= np.ptp(log.q, axis=0) - 1.01 * width).all()
    shift = model.training_range_.low - low
    if "adapted" not in case["change"]:
        np.testing.assert_array_equal(shift, 0.0)
    # Behind creep the rows of the log show the zeros less well.
    most = 2.0 if case["hysteresis"] == "creep, friction" else 1.0
    assert (np.abs(shift) < most * robot.half).all()


def test_the_drawn_body_ends_at_the_tip(crossing):
    case, (model, _, log, _) = crossing
    if case["robot"] in ("own", "none"):
        return
    q = log.q[:DRAWN]
    if case["robot"] == "forces" and not isinstance(model.mechanical_model_, ForceTendonChain):
        with pytest.raises(TypeError, match="backbone can be drawn"):  # forces have no zeros
            BackboneDisplay.from_estimator(model, q)
        return
    body = BackboneDisplay.from_estimator(model, q)
    tips = model.predict(Commands(q, np.arange(len(q))))  # every row on its own
    tips = tips[:, :3] if case["output"] == "pose" else tips[:, -3:]
    ends = body.predicted if len(body.predicted) else body.tips
    np.testing.assert_allclose(ends, tips, rtol=0, atol=1e-5)


def test_what_a_solve_says_of_its_error_is_true(crossing):
    _, (model, _, log, robot) = crossing
    if model.module_.tip_model.n_outputs != 3:
        return  # outputs without a chain: which of them is the tip is not known
    q_min, q_max = robot.middle - robot.half, robot.middle + robot.half
    ik = InverseKinematics(model, q_min=q_min, q_max=q_max)
    q = log.q[[5, 25]]
    with torch.no_grad():
        targets = model.module_.tip_model(torch.from_numpy(q)).numpy()
    solution = ik.solve(targets, q0=q + 0.02 * robot.half)
    with torch.no_grad():
        reached = model.module_.tip_model(torch.from_numpy(np.asarray(solution.q))).numpy()
    error = np.linalg.norm(reached - targets, axis=1)
    np.testing.assert_allclose(solution.error, error, rtol=0, atol=1e-7)
    assert (np.asarray(solution.q) >= q_min - 1e-9 * robot.half).all()
    assert (np.asarray(solution.q) <= q_max + 1e-9 * robot.half).all()


def test_commands_lead_by_the_hysteresis(crossing):
    _, (model, _, log, robot) = crossing
    if model.module_.tip_model.n_outputs != 3:
        return  # outputs without a chain: which of them is the tip is not known
    q_min, q_max = robot.middle - robot.half, robot.middle + robot.half
    ik = InverseKinematics(model, q_min=q_min, q_max=q_max, dq_max=10.0 * robot.half)
    start = log.q[5].astype(float)
    with torch.no_grad():
        targets = model.module_.tip_model(torch.from_numpy(log.q[6:12])).numpy()
    tracker = ik.tracker(start)
    reference = ik.tracker(torch.from_numpy(start))
    sent = [start, *(tracker.step(target) for target in targets)]
    assert (np.min(sent, axis=0) >= q_min).all()
    assert (np.max(sent, axis=0) <= q_max).all()
    assert np.abs(np.diff(sent, axis=0)).max() <= (1.0 + 1e-9) * 0.1 * robot.half
    for target in targets:
        expected = reference.step(torch.from_numpy(target))
    np.testing.assert_allclose(tracker.q, expected, rtol=0, atol=1e-6 * robot.half)
    effective = np.array(sent)
    if model.hysteresis_:
        effective, _ = model.hysteresis_.apply(effective, dt=0.01)
    np.testing.assert_allclose(tracker.effective, effective[-1], rtol=0, atol=1e-12 * robot.half)


def test_every_factor_meets_every_other():
    together = set().union(*map(met, CASES))
    for name, values in FACTORS.items():
        for value in values:
            partners = {entry for entry in together if (name, value) in entry}
            assert len(partners) >= 10, (name, value)
    assert len(CASES) < 150
