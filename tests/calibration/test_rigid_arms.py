"""Kinematic calibration of rigid arms: answers known by construction, on simulated tips."""

import math
import re

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation
from torch.testing import assert_close

from hybridkin import HybridForwardModel, RigidChain, calibrate, load_model, save_model
from hybridkin.app.workflow.calibrated import calibrated_parameters
from hybridkin.calibration._least_squares import TipRows
from hybridkin.calibration._parameters import Problem, parameter
from hybridkin.calibration._search import search
from hybridkin.calibration.calibrate import fit_geometry
from hybridkin.calibration.choice import choose_geometry
from hybridkin.formats import LogUnit

NOISE = 5e-5
ALL = ("base", "tool", "joint_zeros", "links", "axes")


def nominal(**options):
    """Five revolute joints, no two neighbours about one line."""
    places = [[0, 0, 0.2], [0.03, 0, 0.1], [0, 0, 0.3], [0, 0.02, 0.25], [0, 0, 0.1]]
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0]]
    origins = np.tile(np.eye(4), (5, 1, 1))
    origins[:, :3, 3] = places
    return RigidChain(origins, axes, **options)


def real(seed, axes_off=0.0, reversed_ones=()):
    """The arm as it was built, in an unknown frame.

    Its tool is 60 mm off. Standard deviations of the errors: of zeros 1 degree, of every coordinate
    of a link 1 mm, of the axes `axes_off` degrees about each of two directions.
    """
    rng = np.random.default_rng(seed)
    arm = nominal()
    tool, turn, move = (v / np.linalg.norm(v) for v in rng.standard_normal((3, 3)))
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec(2.0 * turn).as_matrix()
    base[:3, 3] = move
    turned = []
    for axis, off in zip(arm.axes.numpy(), rng.standard_normal((5, 3)), strict=True):
        away = math.radians(axes_off) * np.cross(axis, off)
        turned.append(Rotation.from_rotvec(away).as_matrix() @ axis)
    zeros = math.radians(1.0) * rng.standard_normal(5)
    links = arm.geometry()["links"] + 1e-3 * torch.from_numpy(rng.standard_normal((5, 3)))
    arm = arm.with_geometry(
        base=torch.from_numpy(base),
        tool=torch.from_numpy(0.06 * tool),
        joint_zeros=torch.from_numpy(zeros),
        links=links,
        axes=torch.from_numpy(np.array(turned)),
    )
    return arm.with_reversed(reversed_ones)


def log_of(arm, n, seed=0):
    rng = np.random.default_rng(seed)
    q = rng.uniform(-1.5, 1.5, (n, arm.n_actuators))
    return q, arm(torch.from_numpy(q)).numpy() + NOISE * rng.standard_normal((n, 3))


def error_of(model, arm):
    """Mean distance from the true tips at new postures [m]."""
    q, _ = log_of(arm, 500, seed=1)
    predicted = np.asarray(model(q))
    return np.linalg.norm(predicted - arm(torch.from_numpy(q)).numpy(), axis=1).mean()


def searched(q, x):
    rows = TipRows(torch.from_numpy(q), torch.from_numpy(x), torch.ones(len(q)).double())
    return search(nominal(), rows, ("base",), "linear")


def tips_of(chain):
    return lambda q: chain(torch.from_numpy(q)).numpy()


@pytest.mark.parametrize(("seed", "axes_off"), [(0, 0.0), (1, 0.5)])
def test_an_arm_is_calibrated_to_its_noise(axes_off, seed):
    arm = real(seed, axes_off)
    q, x = log_of(arm, 60)
    result = calibrate(nominal(), q, x, nominal().default_parameters)
    assert error_of(tips_of(result.chain), arm) < 1e-4
    choice = choose_geometry(nominal(), q, x)
    assert error_of(tips_of(choice.calibrate(q, x).chain), arm) < 1e-4
    if axes_off:
        assert choice.parameters == ALL


@pytest.mark.parametrize(
    ("error_model", "names"), [("drop", "auto"), ("drop", "default"), ("auto", "auto")]
)
def test_a_hybrid_calibrates_all_of_an_arm(error_model, names):
    arm = real(2, 0.5)
    q, x = log_of(arm, 80)
    model = HybridForwardModel(nominal(), error_model, calibrate=names, random_state=0).fit(q, x)
    assert error_of(model.predict, arm) < 1e-4


@pytest.mark.parametrize("reversed_ones", [(1, 3), (0, 4)])
def test_motors_that_count_the_other_way_round_are_found(reversed_ones):
    arm = real(3, 0.5, reversed_ones)
    q, x = log_of(arm, 60)
    columns = ", ".join(rf"q\[{k}\]" for k in reversed_ones)
    with pytest.warns(UserWarning, match=f"opposite direction.* sign of {columns} flipped"):
        result = calibrate(nominal(), q, x, ALL)
    assert error_of(tips_of(result.chain), arm) < 1e-4
    signs = torch.ones(5, dtype=torch.float64)
    signs[[*reversed_ones]] = -1.0
    assert_close(result.chain.couplings, torch.diag(signs), rtol=0, atol=0)
    start = searched(q, x)
    assert_close(start.problem.chain.couplings, torch.diag(signs), rtol=0, atol=0)


def test_signs_are_kept_where_others_explain_no_more():
    """Nothing but noise, and a few rows that any signs explain: no sign is flipped, no warning."""
    rng = np.random.default_rng(0)
    for n in (3, 40):
        q = rng.uniform(-1.5, 1.5, (n, 5))
        start = searched(q, 0.2 * rng.standard_normal((n, 3)))
        assert_close(start.problem.chain.couplings, nominal().couplings, rtol=0, atol=0)
        assert not start.messages


@pytest.mark.parametrize("actuators", [[5], [-1], [0.5], ["a"], 0])
def test_reversed_actuators_are_among_those_of_the_arm(actuators):
    with pytest.raises(ValueError, match="`actuators` must hold places from 0 to 4"):
        nominal().with_reversed(actuators)


def test_reports_show_what_calibrate_shows_of_axes():
    """Two coordinates of each axis, beside standard errors of two angles."""
    arm = real(0, 0.5)
    q, x = log_of(arm, 60)
    result = calibrate(nominal(), q, x, ALL)
    shown = calibrated_parameters(nominal(), result, LogUnit.of("rad"))
    assert [parameter.name for parameter in shown] == [*result.names]
    axes = [parameter for parameter in shown if parameter.name.startswith("axes")]
    values = {parameter.name: parameter.value for parameter in axes}
    assert len(values) == 10
    for name, value in values.items():
        joint, coordinate = int(name[5]), "xyz".index(name[-2])
        assert value == result.values["axes"][joint, coordinate]


def test_reversed_actuators_keep_the_limits_of_their_joints():
    arm = nominal(q_min=[-1, -2, -3, -4, -5], q_max=[1.5, 2.5, 3.5, math.inf, 5.5])
    other = arm.with_reversed((1, 3))
    assert other.q_min.tolist() == [-1, -2.5, -3, -math.inf, -5]
    assert other.q_max.tolist() == [1.5, 2, 3.5, 4, 5.5]
    q = torch.tensor([0.1, 0.2, 0.3, 0.4, 0.5], dtype=torch.float64)
    assert_close(other(q * torch.tensor([1, -1, 1, -1, 1])), arm(q))
    assert arm.q_min[1] == -2.0, "the given arm is not changed"


def test_gear_ratios_are_found():
    factors = torch.tensor([1.02, 0.99, 1.0, -1.01, 1.005], dtype=torch.float64)
    arm = real(4)
    arm = arm.with_geometry(couplings=arm.couplings * factors)
    q, x = log_of(arm, 80)
    with pytest.warns(UserWarning, match=r"sign of q\[3\] flipped"):
        result = calibrate(nominal(), q, x, ("base", "tool", "joint_zeros", "links", "gains"))
    assert error_of(tips_of(result.chain), arm) < 1e-4
    assert_close(result.values["gains"], factors.numpy(), rtol=0, atol=2e-3)
    assert (np.abs(result.values["gains"] - factors.numpy()) < 5 * result.std_errors["gains"]).all()
    assert result.identifiable["gains"].all()
    assert "gains[3]" in result.names


def test_axes_turn_on_the_unit_sphere(rng):
    """The derivatives by two angles per joint are exact, at the start and far from it."""
    axes = [[0, 0, 1], [0, 1, 0], [-1, 0, 0], [0.6, 0, 0.8], [0.5, -0.7, 0.3]]
    arm = RigidChain(np.tile(np.eye(4), (5, 1, 1)), axes)
    turned = parameter(arm, "axes")
    assert turned.size == 10
    towards = [label.partition(", ")[2] for label in turned.labels]
    assert towards[:6] == ["x]", "y]", "x]", "z]", "y]", "z]"]
    assert turned.labels[3] == "axes[1, z]"
    directions = turned.tangents(torch.zeros(10, dtype=torch.float64))
    assert_close((directions * arm.axes).sum(-1), 0 * directions[..., 0], rtol=0, atol=1e-15)
    flat = directions.flatten(1)
    eye = torch.eye(10, dtype=torch.float64)
    assert_close(flat @ flat.mT, eye, rtol=0, atol=1e-15)
    for size in (0.0, 1e-9, 0.3, 2.0):
        theta = size * torch.randn(10, generator=rng, dtype=torch.float64)
        at = turned.entry_at(theta)
        lengths = torch.ones(5, dtype=torch.float64)
        assert_close(at.norm(dim=1), lengths, rtol=0, atol=1e-15)
        away = torch.arccos((at * arm.axes).sum(1).clamp(-1, 1))
        angles = theta.unflatten(0, (5, 2)).norm(dim=1)
        if size == 0.3:
            assert_close(away, angles, rtol=0, atol=1e-7)
        slopes = torch.func.jacfwd(turned.entry_at)(theta).movedim(-1, 0)
        assert_close(turned.tangents(theta), slopes, rtol=0, atol=1e-14)


@pytest.mark.parametrize(
    "kinds", [5 * ("revolute",), ("revolute", "prismatic", *3 * ("revolute",))]
)
def test_tips_identify_four_numbers_per_turning_joint_two_per_sliding_one_and_three(kinds):
    """A product of exponentials: a line for each turning joint, a direction for each sliding one.

    The tip at q = 0 is three more. Everything else that a calibration frees is redundant.
    """
    arm = real(5, 3.0)
    arm = RigidChain(arm.origins, arm.axes, kinds=kinds, tool=arm.tool, base=arm.base)
    q, _ = log_of(arm, 200)
    problem = Problem.of(arm, ALL)
    tangents = problem.tangents(torch.zeros(len(problem.low), dtype=torch.float64))
    jacobian = arm.geometry_jacobian(torch.from_numpy(q), tangents).flatten(0, 1)
    sizes = torch.linalg.svdvals(jacobian)
    n_known = 4 * kinds.count("revolute") + 2 * kinds.count("prismatic") + 3
    assert sizes[n_known - 1] > 1e-3 * sizes[0]
    assert sizes[n_known] < 1e-12 * sizes[0]


def test_redundant_parameters_are_named():
    """Of two parallel joints and one across them, whose redundancies are known."""
    origins = np.tile(np.eye(4), (3, 1, 1))
    origins[:, 0, 3] = 0.0, 0.3, 0.25
    arm = RigidChain(origins, [[0, 0, 1], [0, 0, 1], [0, 1, 0]], tool=[0.2, 0, 0])
    q, x = log_of(arm, 100)
    names = ("base", "joint_zeros", "links", "tool")
    said = "\n".join(calibrate(arm, q, x, names).unidentified)
    assert re.search(r"base\[rot z\] \+1 deg with joint_zeros\[0\] \+1 deg does not move", said)
    assert re.search(r"base\[z\] \+1 mm with links\[0, z\] -1 mm does not move", said)
    assert re.search(r"\+1 mm with links\[2, z\] -1 mm does not move", said)
    assert re.search(r"joint_zeros\[2\] \+1 deg with tool\[2\] -3.49 mm does not move", said)
    assert re.search(r"links\[2, y\] \+1 mm with tool\[1\] -1 mm does not move", said)
    turned = "\n".join(calibrate(arm, q, x, (*names, "axes")).unidentified)
    assert re.search(r"base\[rot x\] \+1 deg with axes\[0, y\] \+1 deg, axes\[1, y\]", turned)


def test_parameters_that_compensate_each_other_need_rows_once():
    """39 numbers of which tips identify 23: 24 rows are enough not to warn, 20 are not."""
    q, x = log_of(nominal(tool=[0.05, 0.02, 0.1]), 24)
    start = nominal(tool=[0.05, 0.0, 0.1])
    assert not fit_geometry(start, q, x, ALL).messages
    (message,) = fit_geometry(start, q[:20], x[:20], ALL).messages
    assert "holds 20 different rows for 23 free parameters" in message


def test_a_calibrated_arm_is_saved_and_loaded(tmp_path):
    arm = real(6, 0.5, (1,))
    q, x = log_of(arm, 60)
    with pytest.warns(UserWarning, match="opposite direction"):
        model = HybridForwardModel(nominal(), "drop", calibrate="default").fit(q, x)
    save_model(model, tmp_path / "arm.hk")
    loaded = load_model(tmp_path / "arm.hk")
    np.testing.assert_array_equal(loaded.predict(q), model.predict(q))
    assert error_of(loaded.predict, arm) < 1e-4


def test_a_warning_about_wrong_columns_recommends_no_check_of_soft_robots():
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.0, 1.0, (40, 5))
    x = 0.5 * rng.standard_normal((40, 3))
    messages = fit_geometry(nominal(), q, x, ("base",)).messages
    (wrong,) = [message for message in messages if "median residual" in message]
    assert wrong.endswith("or the description of the robot, may be wrong.")
