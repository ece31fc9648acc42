"""A model that follows its robot to another day: moved base, shifted zeros, nothing else."""

import copy
from itertools import product

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose, assert_array_equal
from saved_models import bent_chain, elastic_chain, tendon_chain
from torch.testing import assert_close

from hybridkin import (
    Commands,
    ConstantCurvatureChain,
    ELMRegressor,
    HybridForwardModel,
    RigidChain,
    as_forward_model,
    datasets,
    robots,
)
from hybridkin._core.groups import Groups
from hybridkin._core.rotations import rotation, rotation_vector
from hybridkin.hybrid._adapt import _SCALES, _likeliest_scales, _whitened
from hybridkin.hybrid._drift import MISFITS, SWITCH

SHIFT = 0.006 * np.array([1.0, -0.5, 0.8, -1.2, 0.3, 0.9, -1.0, 0.6, -0.7])
TURN, WAY = torch.tensor([0.1, -0.06, 0.08], dtype=torch.float64), np.array([0.03, -0.05, 0.02])


R = rotation(TURN)[0].numpy()


def moved(x, R=R, way=WAY):
    """Return tips (N, 3), or poses (N, 6), after the base has moved."""
    tips = x[:, :3] @ R.T + way
    turns = rotation(torch.from_numpy(x[:, 3:]))[0] if x.shape[1] == 6 else None
    if turns is None:
        return tips
    return np.hstack([tips, rotation_vector(torch.from_numpy(R) @ turns).numpy()])


def error(model, q, x):
    return np.linalg.norm(model.predict(q) - x, axis=1).mean()


@pytest.fixture(scope="module")
def trunk():
    """Return a fit, five rows spread over the workspace, and test rows."""
    data = datasets.load_trunk()
    chain = robots.bionic_handling_assistant()
    model = HybridForwardModel(chain, "pose", coupling="serial", calibrate="default")
    model.fit(data.q[:400], data.x[:400])
    q, x = data.q[400:1000], data.x[400:1000]
    picks = [0]
    for _ in range(4):
        far = np.linalg.norm(x[:, None] - x[picks], axis=2).min(1)
        picks.append(int(far.argmax()))
    rest = np.setdiff1d(np.arange(600), picks)
    return model, (q[picks], x[picks]), (q[rest], x[rest])


@pytest.mark.parametrize("change", ["zeros", "base", "both"])
def test_five_rows_find_a_change(trunk, change):
    fitted, (q, x), (q_new, x_new) = trunk
    shift = 0.0 if change == "base" else SHIFT
    move = moved if change != "zeros" else lambda x: x
    model = copy.deepcopy(fitted).adapt(q - shift, move(x))
    before = error(fitted, q_new, x_new)
    off = error(fitted, q_new - shift, move(x_new))
    after = error(model, q_new - shift, move(x_new))
    assert off > 2.0 * before
    assert after < before + 0.25 * (off - before)


def test_a_robot_that_has_not_changed_stays_as_it_is(trunk):
    fitted, five, (q, _) = trunk
    model = copy.deepcopy(fitted).adapt(*five)
    assert model.module_ is model.fitted_module_
    assert_array_equal(model.predict(q), fitted.predict(q))


def fits():
    """Return models by name, each with rows to fit."""
    data, rng, make = datasets.load_trunk(), np.random.default_rng(0), HybridForwardModel
    q, x = data.q[:250], data.x[:250]
    trunk, few = robots.bionic_handling_assistant(), ELMRegressor(30, random_state=0)
    origins = np.tile(np.eye(4), (3, 1, 1))
    origins[1:, 0, 3] = 0.3
    arm = RigidChain(origins, [[0, 0, 1], [0, 1, 0], [1, 0, 1]], tool=[0.2, 0, 0.1])
    turns = rng.uniform(-0.6, 0.6, (150, 3))
    with torch.no_grad():
        T = trunk.pose(torch.from_numpy(q))
        turned = arm(torch.from_numpy(turns)).numpy() + 0.05 * turns[:, :1] ** 2
    poses = np.hstack([x, rotation_vector(T[:, :3, :3]).numpy()])
    serial = make(trunk, "quadratic", coupling="serial", calibrate="default")
    return {
        "serial": (serial, q, x),
        "play": (make(trunk, few, hysteresis=0.001), q, x),
        "pose": (make(trunk, few, output="pose"), q, poses),
        "rigid": (make(arm, few), turns, turned),
        "data alone": (make(None, ELMRegressor(100, alpha=1e-6, random_state=0)), q, x),
    }


@pytest.fixture(scope="module", params=[*fits()])
def case(request):
    """Return a fit, and rows of its robot after a change that it can express exactly."""
    model, q, x = fits()[request.param]
    model.fit(q, x)
    shift = 0.1 * np.ptp(q, axis=0) * np.linspace(-1, 1, q.shape[1])
    return model, q - shift, moved(model.predict(q)), q


def test_any_model_is_adapted_and_adapted_back(case):
    fitted, q, x, then = case
    off, before = error(fitted, q, x), fitted.predict(q)
    model = copy.deepcopy(fitted).adapt(q, x)
    assert error(model, q, x) < 0.1 * off
    assert_array_equal(fitted.predict(q), before)
    again = copy.deepcopy(model).adapt(q, x)  # about the fit, not about the last change
    assert_allclose(again.predict(q), model.predict(q), rtol=0, atol=1e-12)
    back = copy.deepcopy(model).adapt(then, fitted.predict(then))
    assert_allclose(back.predict(q), before, rtol=0, atol=1e-9)


def test_an_adapted_model_is_the_fit_moved_and_shifted(case):
    fitted, q, x, _ = case
    model = copy.deepcopy(fitted).adapt(q, x)
    shift, motion = model.change_
    turn = motion[:3, :3]
    q = model.effective(q)[:20]
    at = torch.from_numpy(q)
    then = torch.from_numpy(q + shift)
    x, J = model.module_.forward_and_jacobian(at)
    x_then, J_then = fitted.module_.forward_and_jacobian(then)
    assert_allclose(x, x_then.numpy() @ turn.T + motion[:3, 3], rtol=0, atol=1e-13)
    assert_allclose(J, turn @ J_then.numpy(), rtol=1e-12, atol=1e-12)
    assert_close(model.module_.domain_distance(at), fitted.module_.domain_distance(then))
    far = q + 4.0 * (q - q.mean(axis=0))
    weights = fitted.module_.error_weight(torch.from_numpy(far + shift)).numpy()
    alone = Commands(far, np.arange(len(far)))  # each row begins a run, without hysteresis
    assert_allclose(model.error_weight(alone), weights, rtol=0, atol=1e-12)
    if fitted.mechanical_model is not None:
        assert weights.min() < 0.9
    for end, before in zip(model.training_range_, fitted.training_range_, strict=True):
        assert_allclose(end, before - shift, rtol=0, atol=1e-15)
    single = copy.deepcopy(model.module_).float()(at.float())
    assert single.dtype == torch.float32
    assert_close(single.double(), x, rtol=0, atol=1e-4)
    if model.output == "pose":
        assert_allclose(model.module_.pose(at), motion @ fitted.module_.pose(then).numpy())


def test_measurements_after_a_change_are_learned_as_those_before_it(case):
    """What is then learned moves and shifts with the robot."""
    fitted, q, x, _ = case
    model = copy.deepcopy(fitted).adapt(q, x)
    shift, motion = model.change_
    load = np.zeros(x.shape[1])
    load[:3] = 0.02, -0.01, 0.03
    before = fitted.predict(q + shift) + load
    follows = copy.deepcopy(fitted).partial_fit(q[:50] + shift, before[:50], alpha=1.0)
    turn = motion[:3, :3], motion[:3, 3]
    model.partial_fit(q[:50], moved(before[:50], *turn), alpha=1.0)
    expected = moved(follows.predict(q + shift), *turn)
    assert_allclose(model.predict(q), expected, rtol=0, atol=1e-9)
    assert np.abs(follows.predict(q + shift) - fitted.predict(q + shift)).max() > 0.01


@pytest.mark.parametrize("gains", [None, np.linspace(-2.0, 3.0, 7)])
@pytest.mark.parametrize("make", [tendon_chain, bent_chain, elastic_chain])
def test_a_chain_with_shifted_zeros_is_the_chain_of_shifted_actuators(make, gains):
    """In the unit of the actuators, whatever their gains are."""
    chain = make() if gains is None else make(gains=gains)
    rng = np.random.default_rng(0)
    q, shift = (torch.from_numpy(1e-3 * rng.standard_normal(size)) for size in ((9, 7), 7))
    moved_chain = chain.shifted(shift)
    assert isinstance(moved_chain, type(chain))
    assert_close(moved_chain(q), chain(q + shift), rtol=0, atol=1e-12)
    assert (moved_chain(q) - chain(q)).abs().max() > 1e-4


def test_only_what_may_have_changed_is_adapted(trunk):
    fitted, (q, x), _ = trunk
    model = copy.deepcopy(fitted).adapt(q, moved(x), parameters=["base"])
    assert_array_equal(model.change_.shift, np.zeros(9))
    model.adapt(q - SHIFT, x, parameters=["actuator_zeros"])
    assert_array_equal(model.change_.motion, np.eye(4))


def test_a_single_row_moves_the_model_towards_it(trunk):
    fitted, _, (q, x) = trunk
    model = copy.deepcopy(fitted).adapt(q[:1], moved(x[:1]))
    assert error(model, q[:1], moved(x[:1])) < 0.3 * error(fitted, q[:1], moved(x[:1]))


def test_a_large_turn_of_the_base_is_found(trunk):
    fitted, (q, _), (q_new, _) = trunk
    turn = rotation(torch.tensor([1.0, -2.0, 1.0], dtype=torch.float64))[0].numpy()
    model = copy.deepcopy(fitted).adapt(q, fitted.predict(q) @ turn.T)
    assert error(model, q_new, fitted.predict(q_new) @ turn.T) < 5e-3


def test_the_rows_of_one_motion_count_as_fewer(trunk):
    fitted, _, (q, x) = trunk
    q, x = q[:30], x[:30] + np.array([0.004, 0.0, 0.0])
    free = copy.deepcopy(fitted).adapt(q, x)
    one = copy.deepcopy(fitted).adapt(q, x, groups=np.zeros(30))
    assert free.module_ is not free.fitted_module_
    assert one.module_ is one.fitted_module_


def two_outputs(q):
    """Return two outputs, whose slopes at different rows span all actuators."""
    return torch.stack([q.sum(-1), q[..., 0] ** 2 + q[..., 1] * q[..., 2]], dim=-1)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_outputs_that_are_not_in_space_have_no_base(unit):
    """The shift is found as exactly as the noise allows: within four standard errors."""
    rng = np.random.default_rng(0)
    sigma = 2e-3
    q = rng.uniform(-1, 1, (60, 3))
    y = two_outputs(torch.from_numpy(q)).numpy()
    robot = as_forward_model(lambda q: two_outputs(q / unit))
    model = HybridForwardModel(robot, "drop")
    model.fit(unit * q, y + sigma * rng.standard_normal(y.shape))
    with pytest.raises(ValueError, match="'base' needs"):
        model.adapt(unit * q, y)
    shift = np.array([0.1, -0.2, 0.05])
    new = y[:40] + sigma * rng.standard_normal((40, 2))
    model.adapt(unit * (q[:40] - shift), new, parameters=["actuator_zeros"])
    A = np.stack([np.ones((40, 3)), q[:40, [0, 2, 1]] * [2.0, 1.0, 1.0]], axis=1).reshape(-1, 3)
    standard_errors = sigma * np.sqrt(np.diag(np.linalg.inv(A.T @ A)))
    assert standard_errors.max() < 0.02 * np.abs(shift).min()
    assert (np.abs(model.change_.shift / unit - shift) < 4.0 * standard_errors).all()


@pytest.mark.parametrize("renamed", [False, True])
def test_groups_of_new_rows_are_correlated_errors(renamed):
    """Of rows with half of their variance in common, what is whitened has unit covariance."""
    groups = np.array([0, 1, 0, 2, 1, 0, 0])
    covariance = 0.5 * np.eye(7) + 0.5 * (groups[:, None] == groups)
    names = np.array(["c", "a", "b"])[groups] if renamed else groups
    whitening = _whitened(np.eye(7), Groups(names))
    assert_allclose(whitening @ covariance @ whitening.T, np.eye(7), rtol=0, atol=1e-14)
    assert _whitened(covariance, Groups.rows(7)) is covariance


@pytest.mark.parametrize("parameters", [["base"], ["actuator_zeros"], ["base", "actuator_zeros"]])
@pytest.mark.parametrize("size", [0.0, 12.0, 20.0])
def test_the_evidence_of_a_change_is_that_of_normal_errors(size, parameters):
    """Each part of a change has a cost; so has every doubling of the variance not explained."""
    rng = np.random.default_rng(1)
    A = 5.0 * rng.standard_normal((12, 8))
    theta = size * np.repeat([0.03, 0.01, 0.02], [3, 3, 2]) * rng.standard_normal(8)
    target = A @ theta + rng.standard_normal(12)
    bases = [(0.0, 0.0)]
    if "base" in parameters:
        bases += product(_SCALES, _SCALES)
    zeros = [0.0]
    if "actuator_zeros" in parameters:
        zeros += [*_SCALES]
    best = -np.inf
    for (turn, way), zero, variance in product(bases, zeros, MISFITS):
        tried = np.repeat([turn, way, zero], [3, 3, 2])
        covariance = variance * np.eye(12) + (A * tried**2) @ A.T
        evidence = -0.5 * (target @ np.linalg.solve(covariance, target))
        evidence -= 0.5 * np.linalg.slogdet(covariance)[1] + np.log2(variance)
        evidence -= SWITCH * ((way > 0.0) + (zero > 0.0))
        if evidence > best:
            best = evidence
            expected = tried, variance
    std, misfit = _likeliest_scales(A, target, parameters)
    assert_allclose(std, expected[0])
    assert misfit == expected[1]
    assert (std > 0.0).any() == (size > 0.0)


@pytest.mark.filterwarnings("ignore:`")  # a row of 9e74 is no usual one
def test_rows_too_large_for_the_model_are_refused():
    q = np.random.default_rng(0).uniform(0.2, 0.3, (30, 3))
    x = ConstantCurvatureChain([0.06])(torch.from_numpy(q)).numpy()
    model = HybridForwardModel(ConstantCurvatureChain([0.05]), "linear").fit(q, x)
    before, far = model.predict(q), q[:3].copy()
    far[0, 1] = 9e74
    with pytest.raises(ValueError, match="too large"):
        model.adapt(far, x[:3])
    assert_array_equal(model.predict(q), before)
    assert np.isfinite(model.partial_fit(far, x[:3]).predict(q)).all()


def test_the_warning_of_another_change_names_the_line_of_the_caller():
    q = np.random.default_rng(0).uniform(0.2, 0.3, (30, 9))
    model = HybridForwardModel(robots.bionic_handling_assistant(), "drop")
    x = model.mechanical_model(torch.from_numpy(q)).numpy()
    noise = 1e-4 * np.random.default_rng(1).standard_normal(x.shape)
    model.fit(q, x + noise)
    with pytest.warns(UserWarning, match="has changed in a way") as caught:
        model.adapt(q, x + 0.1 * np.sin(40.0 * q[:, :3]), parameters=["base"])
    assert caught[0].filename == __file__
