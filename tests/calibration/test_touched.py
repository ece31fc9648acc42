"""Calibration by touch points."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from saved_models import elastic_chain

from hybridkin import ConstantCurvatureChain, InverseKinematics, RigidChain, calibrate
from hybridkin.calibration._least_squares import LOSSES, row_loss
from hybridkin.calibration._parameters import Problem
from hybridkin.calibration._touched import Ties, TouchedRows
from hybridkin.calibration.calibrate import fit_geometry

LIMITS = {"q_min": np.full(5, -0.5), "q_max": np.full(5, 0.5)}
TOOL = np.array([0.02, -0.03, 0.15])
SOCKETS = np.array([[0.3, 0.1, 0.2], [0.1, 0.4, 0.1], [-0.2, 0.0, 0.3], [0.2, 0.2, -0.1]])
NAMES = np.array(["a", "b", "c", "d"])


def gantry(tool=(0.0, 0.0, 0.1), **geometry):
    """Return three slides that carry a wrist of two joints: tip = slides + rotation @ tool."""
    axes = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 1, 0], [1, 0, 0]]
    kinds = ["prismatic"] * 3 + ["revolute"] * 2
    origins = np.tile(np.eye(4), (5, 1, 1))
    return RigidChain(origins, axes, kinds=kinds, tool=tool, **LIMITS, **geometry)


def touches(chain, points, each, rng, noise=0.0):
    """Return q of a gantry that touches every point `each` times, and the rows' points."""
    point = np.repeat(np.arange(len(points)), each)
    q = np.zeros((len(point), 5))
    q[:, 3:] = rng.uniform(-1.0, 1.0, (len(point), 2))
    goals = points[point] + noise * rng.standard_normal((len(point), 3))
    q[:, :3] = goals - chain(torch.from_numpy(q)).numpy()
    return q, point


def arm(**geometry):
    """Return six joints at different places about different axes."""
    places = np.array([[0, 0, 30], [10, 0, 5], [0, 5, 25], [8, 0, 20], [0, 0, 10], [5, 0, 0]])
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [1, 0, 0], [0, 1, 0], [1, 0, 0]]
    origins = np.tile(np.eye(4), (6, 1, 1))
    origins[:, :3, 3] = 0.01 * places
    return RigidChain(origins, axes, **geometry)


def reached(chain, points, each, rng, low, high, noise=0.0):
    """Return q of a chain that touches every point `each` times in random postures."""
    point = np.repeat(np.arange(len(points)), each)
    goals = points[point] + noise * rng.standard_normal((len(point), 3))
    ik = InverseKinematics(chain, q_min=low, q_max=high, beta=0.0)
    q = np.empty((len(point), chain.n_actuators))
    left = np.arange(len(point))
    while left.size:
        start = rng.uniform(low, high, (left.size, chain.n_actuators))
        q[left] = ik.solve(goals[left], start, tol=1e-12, max_iter=1000).q
        missed = np.linalg.norm(chain(torch.from_numpy(q)).detach().numpy() - goals, axis=1)
        left = np.flatnonzero(missed > 1e-10)
    return q, point


def pairs(points):
    """Return all distances between points."""
    n = len(points)
    return {
        (NAMES[i], NAMES[j]): float(np.linalg.norm(points[i] - points[j]))
        for i in range(n)
        for j in range(i)
    }


@pytest.fixture
def seeded():
    return np.random.default_rng(0)


def test_a_tool_is_that_of_linear_least_squares_with_its_standard_errors(seeded):
    """The tip of the gantry is linear in the tool: slides + R tool - point = 0."""
    truth = gantry(TOOL)
    q, point = touches(truth, SOCKETS, 8, seeded, noise=1e-4)
    result = calibrate(gantry(), q, None, ["tool"], touched=NAMES[point], prior=math.inf)
    rotations = truth.pose(torch.from_numpy(q)).numpy()[:, :3, :3]
    A = np.hstack([rotations.reshape(96, 3), -np.kron(np.eye(4)[point], np.eye(3))])
    slides = q[:, :3].ravel()
    solution, squares, *_ = np.linalg.lstsq(A, -slides, rcond=None)
    covariance = np.linalg.inv(A.T @ A) * squares / (96 - 15)
    # Points are divided by their size, 0.3 m: it pulls at the tool by noise squared over 0.3 m.
    np.testing.assert_allclose(result.values["tool"], solution[:3], atol=1e-6)
    np.testing.assert_allclose(
        result.std_errors["tool"], covariance.diagonal()[:3] ** 0.5, rtol=0.01
    )
    for k, name in enumerate(NAMES):
        place = slice(3 + 3 * k, 6 + 3 * k)
        np.testing.assert_allclose(result.points[name], solution[place], atol=1e-6)
        std = covariance.diagonal()[place] ** 0.5
        np.testing.assert_allclose(result.point_errors[name], std, rtol=0.01)
    rmse = (squares / 32) ** 0.5
    np.testing.assert_allclose(result.rmse, rmse, rtol=1e-4)


def shape_of(places):
    """Return the distances of all places from each other."""
    return np.linalg.norm(places[:, None] - places, axis=2)


def test_exact_touches_and_distances_give_the_exact_arm(seeded):
    truth = arm(tool=TOOL, joint_zeros=0.02 * seeded.standard_normal(6))
    points = truth(torch.from_numpy(seeded.uniform(-1.0, 1.0, (4, 6)))).numpy()
    q, point = reached(truth, points, 12, seeded, -2.0, 2.0)
    start = arm(tool=[0.0, 0.0, 0.1])
    names = ("joint_zeros", "tool")
    result = calibrate(start, q, None, names, touched=NAMES[point], distances=pairs(points))
    assert result.rmse < 1e-8
    assert result.converged
    found = np.array([result.points[name] for name in NAMES])
    np.testing.assert_allclose(shape_of(found), shape_of(points), atol=1e-7)
    new = torch.from_numpy(seeded.uniform(-1.0, 1.0, (20, 6)))
    np.testing.assert_allclose(
        shape_of(result.chain(new).numpy()), shape_of(truth(new).numpy()), atol=1e-7
    )
    zeros = truth.joint_zeros.numpy()[1:5]
    np.testing.assert_allclose(result.values["joint_zeros"][1:5], zeros, atol=1e-7)
    # The first zero turns the robot with all points, the last one turns the tool.
    first, last = result.unidentified
    assert first.startswith("joint_zeros[0] +1 deg does not move the tips from the points")
    assert last.startswith("joint_zeros[5] +1 deg with tool[")
    assert result.identifiable["joint_zeros"].tolist() == [False, *[True] * 4, False]
    assert result.std_errors["joint_zeros"][0] == pytest.approx(0.5, rel=0.01)  # the prior


def robots():
    """Return soft robots, with what to calibrate, its start and the range of q."""
    trunk = ConstantCurvatureChain([0.055, 0.045, 0.05])
    tendons = ConstantCurvatureChain([0.011, 0.009, 0.0105], lengths=[0.1] * 3)
    elastic = elastic_chain()
    return {
        "chambers": (trunk, "radii", np.full(3, 0.05), 0.08, 0.12),
        "tendons": (tendons, "radii", np.full(3, 0.01), -0.008, 0.008),
        "elastic": (elastic, "radii", 1.05 * elastic.radii.numpy(), -0.002, 0.002),
    }


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.* pull the tendons of a segment together")
@pytest.mark.parametrize("name", robots())
def test_soft_robots_are_found_from_exact_touches(name, seeded):
    truth, entry, nominal, low, high = robots()[name]
    shape = (4, truth.n_actuators)
    points = truth(torch.from_numpy(seeded.uniform(0.6 * low + 0.4 * high, high, shape)))
    q, point = reached(truth, points.detach().numpy(), 8, seeded, low, high)
    start = truth.with_geometry(**{entry: torch.from_numpy(nominal)})
    distances = pairs(points.detach().numpy())
    result = calibrate(start, q, None, [entry], touched=NAMES[point], distances=distances)
    np.testing.assert_allclose(result.values[entry], truth.geometry()[entry], rtol=1e-4)


def test_names_of_points_and_order_of_rows_do_not_matter(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 5, seeded, noise=1e-3)
    distances = pairs(SOCKETS)
    known = calibrate(gantry(), q, None, ["tool"], touched=NAMES[point], distances=distances)
    order = seeded.permutation(len(q))
    numbers = {(ord(a) - 95, ord(b) - 95): length for (b, a), length in distances.items()}
    renamed = calibrate(
        gantry(), q[order], None, ["tool"], touched=(point + 2)[order], distances=numbers
    )
    np.testing.assert_allclose(renamed.values["tool"], known.values["tool"], rtol=1e-8)
    np.testing.assert_allclose(renamed.std_errors["tool"], known.std_errors["tool"], rtol=1e-6)
    for k, name in enumerate(NAMES):
        np.testing.assert_allclose(renamed.points[k + 2], known.points[name], atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("loss", LOSSES)
def test_weights_are_repeated_touches(loss, seeded):
    q, point = touches(gantry(TOOL), SOCKETS[:3], 6, seeded, noise=1e-3)
    weights = np.arange(18) % 3
    repeated = np.arange(18).repeat(weights)
    touched = NAMES[point]
    own = {"parameters": ["tool"], "loss": loss, "groups": np.arange(18) // 2 % 3}
    weighted = calibrate(gantry(), q, None, touched=touched, sample_weight=weights, **own)
    own["groups"] = own["groups"][repeated]
    expanded = calibrate(gantry(), q[repeated], None, touched=touched[repeated], **own)
    np.testing.assert_allclose(weighted.values["tool"], expanded.values["tool"], rtol=1e-8)
    np.testing.assert_allclose(weighted.std_errors["tool"], expanded.std_errors["tool"], rtol=1e-7)
    assert weighted.cv_rmse == pytest.approx(expanded.cv_rmse, rel=1e-5)


def test_what_rows_of_no_weight_touched_does_not_matter(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 5, seeded, noise=1e-3)
    touched = NAMES[point]
    known = calibrate(gantry(), q, None, ["tool"], touched=touched)
    more = np.vstack([q, q[:2] + 0.3])
    weights = np.append(np.ones(20), [0.0, 0.0])
    labels = [*touched, "a", "e"]
    same = calibrate(gantry(), more, None, ["tool"], touched=labels, sample_weight=weights)
    np.testing.assert_allclose(same.values["tool"], known.values["tool"], rtol=1e-12)
    assert [*same.points] == [*NAMES]


def test_measured_tips_show_where_the_base_is(seeded):
    """Some rows measured, some touched, some both; NaN and None where there is nothing."""
    base = np.eye(4)
    base[:3, 3] = [0.3, -0.2, 0.1]
    truth = gantry(TOOL, base=base)
    q, point = touches(truth, SOCKETS[:2] + base[:3, 3], 6, seeded)
    measured = np.vstack([q[:2], q[:6] + 0.2])
    x = truth(torch.from_numpy(measured)).numpy()
    x = np.vstack([x[:2], np.full((10, 3), np.nan), x[2:]])
    q = np.vstack([q, measured[2:]])
    touched = [*NAMES[point], None, "", float("nan"), None, "", None]
    result = calibrate(gantry(), q, x, ["tool", "base"], touched=touched)
    np.testing.assert_allclose(result.values["base"], base, atol=1e-7)
    np.testing.assert_allclose(result.values["tool"], TOOL, atol=1e-7)
    np.testing.assert_allclose(result.points["b"], SOCKETS[1] + base[:3, 3], atol=1e-7)
    assert result.unidentified == ()


def test_labels_without_a_name_change_nothing(seeded):
    q = seeded.uniform(-0.5, 0.5, (12, 5))
    x = gantry(TOOL)(torch.from_numpy(q)).numpy() + 1e-3 * seeded.standard_normal((12, 3))
    plain = calibrate(gantry(), q, x, ["tool"])
    same = calibrate(gantry(), q, x, ["tool"], touched=[""] * 12)
    np.testing.assert_array_equal(same.values["tool"], plain.values["tool"])
    assert same.points == plain.points == same.point_errors == {}


def example(seed=0):
    """Return noisy rows of touches and tips, a problem, and a theta beside the best one."""
    rng = np.random.default_rng(seed)
    truth = arm(tool=TOOL)
    q = torch.from_numpy(rng.uniform(-1.0, 1.0, (14, 6)))
    x = truth(q) + 0.01 * torch.from_numpy(rng.standard_normal((14, 3)))
    x[4:] = np.nan
    point = np.array([-1, -1, 0, 1, 0, 0, 0, 1, 1, 1, 2, 2, 2, 1])
    known = Ties(np.array([[0, 1], [1, 2]]), np.array([0.3, 0.2]), 0.1)
    weight = torch.from_numpy(rng.uniform(0.5, 2.0, 14))
    rows = TouchedRows(q, x, weight, point, 3, known, 1e-4)
    problem = Problem.of(arm(tool=[0.0, 0.0, 0.1]), ("joint_zeros", "tool"))
    theta = 0.1 * rng.standard_normal(9)
    return rows.at_scale_of(rows.tips(truth)), problem, theta


@pytest.mark.parametrize("loss", LOSSES)
def test_slopes_are_central_differences(loss):
    rows, problem, theta = example()
    sigma = 0.3

    def cost(theta):
        """Return half the loss that the solver minimises, without the prior."""
        tips = rows.tips(problem.chain_at(theta))
        unknowns = rows.unknowns(tips, sigma, loss)
        errors = np.sqrt(rows.weights)[:, None] * rows.errors(tips, unknowns) / sigma
        ties = rows.ties(unknowns)
        return 0.5 * row_loss(np.append(errors**2, ties**2), rows.weights, loss)[0].sum()

    chain = problem.chain_at(theta)
    tips = rows.tips(chain)
    unknowns = rows.unknowns(tips, sigma, loss)
    errors = rows.errors(tips, unknowns)
    slopes = rows.slopes(rows.tip_slopes(problem, theta, chain), tips, unknowns, sigma)
    whitened = (np.sqrt(rows.weights)[:, None] * errors).ravel() / sigma
    residual = np.append(whitened, rows.ties(unknowns))
    _, rho, _ = row_loss(residual**2, rows.weights, loss)
    gradient = (rho * residual) @ np.vstack([slopes.residual / sigma, slopes.ties])
    steps = 1e-5 * np.eye(9)
    expected = [(cost(theta + step) - cost(theta - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(gradient, expected, rtol=1e-6, atol=1e-6)


def test_points_and_distances_follow_the_geometry():
    """Without a measured tip every point is the mean of its tips, and so are its derivatives."""
    rows, problem, theta = example()
    none = Ties(np.empty((0, 2), dtype=int), np.empty(0), 1.0)
    rows = replace(rows, x=torch.full_like(rows.x, torch.nan), known=none)

    def unknowns_at(theta):
        return rows.unknowns(rows.tips(problem.chain_at(theta)), 0.05, "linear")

    chain = problem.chain_at(theta)
    J = rows.tip_slopes(problem, theta, chain)
    slopes = rows.slopes(J, rows.tips(chain), unknowns_at(theta), 0.05)
    steps = 1e-5 * np.eye(9)
    expected = [(unknowns_at(theta + step) - unknowns_at(theta - step)) / 2e-5 for step in steps]
    np.testing.assert_allclose(slopes.unknowns, np.transpose(expected), atol=1e-8)
    # The first zero turns all: nothing that a touch shows changes.
    np.testing.assert_allclose(slopes.residual[:, 0], 0.0, atol=1e-5)


@pytest.mark.slow
def test_standard_errors_are_the_spread_of_the_estimates(seeded):
    """Few touches of each point: the points use up a third of the coordinates."""
    truth = gantry(TOOL)
    q, point = touches(truth, SOCKETS, 3, seeded)
    squares, variances, points, point_variances = [], [], [], []
    for _ in range(60):
        moved = q.copy()
        moved[:, :3] += 1e-3 * seeded.standard_normal((12, 3))
        result = calibrate(gantry(), moved, None, ["tool"], touched=NAMES[point])
        squares.append((result.values["tool"] - TOOL) ** 2)
        variances.append(result.std_errors["tool"] ** 2)
        points.append((result.points["c"] - SOCKETS[2]) ** 2)
        point_variances.append(result.point_errors["c"] ** 2)
    # Means of 60 squares of three numbers are right to 0.11, and so are those of the variances.
    np.testing.assert_allclose(np.mean(squares), np.mean(variances), rtol=0.35)
    np.testing.assert_allclose(np.mean(points), np.mean(point_variances), rtol=0.35)


def test_the_median_gives_the_noise_of_robust_fits_with_few_touches(seeded):
    q, point = touches(gantry(TOOL), seeded.uniform(-0.3, 0.3, (40, 3)), 3, seeded, noise=1e-3)
    rows = calibrate(gantry(), q, None, ["tool"], touched=point, loss="soft_l1")
    plain = calibrate(gantry(), q, None, ["tool"], touched=point)
    np.testing.assert_allclose(rows.std_errors["tool"], plain.std_errors["tool"], rtol=0.25)
    assert plain.rmse == pytest.approx(1e-3 * 2**0.5, rel=0.15)  # two thirds of three coordinates


def test_robust_loss_forgets_touches_of_other_points(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 8, seeded, noise=1e-4)
    q[3, 0] += 0.05
    q[20, 2] -= 0.1
    errors = {}
    for loss in ("linear", "cauchy"):
        result = calibrate(gantry(), q, None, ["tool"], touched=NAMES[point], loss=loss)
        errors[loss] = np.linalg.norm(result.values["tool"] - TOOL)
        errors[loss] += np.linalg.norm(result.points["a"] - SOCKETS[0])
    assert errors["cauchy"] < 5e-4 < errors["linear"]


def size_of(result):
    points = np.array([*result.points.values()])
    return np.linalg.norm(points - points.mean(axis=0))


def test_only_distances_give_an_arm_with_free_lengths_its_size(seeded):
    truth = arm(tool=TOOL)
    points = truth(torch.from_numpy(seeded.uniform(-1.0, 1.0, (4, 6)))).numpy()
    q, point = reached(truth, points, 12, seeded, -2.0, 2.0, noise=1e-3)
    own = {"parameters": ("links", "tool"), "touched": NAMES[point]}
    free = calibrate(truth, q, None, **own)
    assert "touches do not fix the size of this robot" in free.unidentified[0]
    assert not free.messages
    size = np.linalg.norm(points - points.mean(axis=0))
    # The fit has no reason to shrink the robot: the prior keeps its size.
    assert size_of(free) == pytest.approx(size, rel=0.05)
    # A robot of another size touches the same points if all distances are of that size.
    for factor in (1.0, 0.9):
        known = {pair: factor * length for pair, length in pairs(points).items()}
        fixed = calibrate(truth, q, None, **own, distances=known)
        assert not any("size of this robot" in sentence for sentence in fixed.unidentified)
        assert size_of(fixed) == pytest.approx(factor * size, rel=1e-3)
    shown = fixed.rmse / 0.9
    assert shown == pytest.approx(
        calibrate(truth, q, None, **own, distances=pairs(points)).rmse, rel=0.02
    )


def test_a_robot_that_shrinks_to_touch_its_only_point_warns(seeded):
    truth = arm(tool=TOOL)
    q, point = reached(truth, np.array([[0.3, 0.1, 0.5]]), 30, seeded, -2.0, 2.0, noise=1e-2)
    with pytest.warns(UserWarning, match="touches all points at once. Give `distances`"):
        result = calibrate(truth, q, None, ("links", "tool"), touched=point)
    assert "times as far as that of `chain`" in result.messages[-1]


def test_contradictory_distances_are_for_the_fit_to_show(seeded):
    q, point = touches(gantry(TOOL), SOCKETS[:3], 6, seeded, noise=1e-4)
    distances = {("a", "b"): 0.1, ("b", "c"): 0.1, ("a", "c"): 0.9}
    with pytest.warns(UserWarning, match="the calibrated model has a median residual of"):
        known = calibrate(gantry(), q, None, ["tool"], touched=NAMES[point], distances=distances)
    plain = calibrate(gantry(), q, None, ["tool"], touched=NAMES[point])
    assert known.rmse > 100 * plain.rmse


def test_whole_points_and_motions_are_held_out(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 8, seeded, noise=1e-3)
    touched = NAMES[point]
    motions = np.arange(32) % 4
    cv_rmse = calibrate(gantry(), q, None, ["tool"], touched=touched, groups=motions).cv_rmse
    squares = []
    for motion in range(4):
        kept = motions != motion
        result = calibrate(gantry(), q[kept], None, ["tool"], touched=touched[kept])
        tips = result.chain(torch.from_numpy(q[~kept])).numpy()
        known = np.array([result.points[name] for name in touched[~kept]])
        squares.append(((tips - known) ** 2).sum(axis=1))
    assert cv_rmse == pytest.approx(np.mean(squares) ** 0.5, rel=1e-4)
    # A held-out point is where its tips are on average.
    cv_rmse = calibrate(gantry(), q, None, ["tool"], touched=touched, groups=point).cv_rmse
    squares = []
    for k in range(4):
        kept = point != k
        result = calibrate(gantry(), q[kept], None, ["tool"], touched=touched[kept])
        tips = result.chain(torch.from_numpy(q[~kept])).numpy()
        squares.append(((tips - tips.mean(axis=0)) ** 2).sum(axis=1))
    assert cv_rmse == pytest.approx(np.mean(squares) ** 0.5, rel=1e-4)


def test_a_fold_without_touches_predicts_them(seeded):
    truth = gantry(TOOL)
    q, point = touches(truth, SOCKETS[:2], 6, seeded, noise=1e-3)
    camera = seeded.uniform(-0.5, 0.5, (9, 5))
    x = truth(torch.from_numpy(camera)).numpy()
    rows = {"q": np.vstack([q, camera]), "x": np.vstack([np.full((12, 3), np.nan), x])}
    labels = [*NAMES[point], *[""] * 9]
    groups = np.repeat([0, 1], [12, 9])
    start = gantry(base=np.eye(4))
    result = calibrate(start, **rows, parameters=["tool"], touched=labels, groups=groups)
    # From the camera the tool is exact: the touches are apart from their means by their noise.
    tips = truth(torch.from_numpy(q)).numpy().reshape(2, 6, 3)
    of_touches = ((tips - tips.mean(axis=1, keepdims=True)) ** 2).sum()
    tool = calibrate(start, q, None, ["tool"], touched=NAMES[point])
    of_camera = ((tool.chain(torch.from_numpy(camera)).numpy() - x) ** 2).sum()
    assert result.cv_rmse == pytest.approx(((of_touches + of_camera) / 21) ** 0.5, rel=1e-3)


def test_too_few_touches_warn(seeded):
    q, point = touches(gantry(TOOL), SOCKETS[:2], 2, seeded, noise=1e-4)
    message = "4 touches of 2 points and 0 measured tips count as 2 rows"
    with pytest.warns(UserWarning, match=message):
        calibrate(gantry(), q, None, ["tool"], touched=NAMES[point])


def test_mixed_up_labels_are_noticed(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 8, seeded)
    with pytest.warns(UserWarning, match="`touched`, or the description"):
        calibrate(gantry(), q, None, ["tool"], touched=NAMES[seeded.permutation(point)])


def test_results_are_of_the_kind_of_q(seeded):
    q, point = touches(gantry(TOOL), SOCKETS, 4, seeded, noise=1e-4)
    result = fit_geometry(gantry(), torch.from_numpy(q), None, ["tool"], touched=NAMES[point])
    assert isinstance(result.points["a"], torch.Tensor)
    assert isinstance(result.point_errors["a"], torch.Tensor)
    assert "4 touched points" in repr(result)
    arrays = fit_geometry(gantry(), q, None, ["tool"], touched=torch.from_numpy(point))
    np.testing.assert_array_equal(arrays.points[0], result.points["a"])


LABELS = np.repeat(["a", "b"], 5)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"touched": LABELS[:4]}, r"`touched` must have shape \(10,\), got \(4,\)"),
        ({"touched": "ab"}, "`touched` must have shape"),
        ({"touched": [["a"], ["b", "c"]] * 5}, "`touched` must hold texts or numbers"),
        ({"touched": [*LABELS[:9], "c"]}, "1 of 3 labels are in one: 'c'"),
        ({"touched": None}, "`x`"),
        ({"touched": [""] * 10}, "`x`"),
        ({"parameters": ("tool", "base")}, "must not hold 'base' without measured tips"),
        ({"distances": {("a", "c"): 0.1}}, "`distances` must be between labels of `touched`"),
        ({"distances": {("a", "a"): 0.1}}, "two different points"),
        ({"distances": {("a", "b"): 0.1, ("b", "a"): 0.1}}, "each pair once"),
        ({"distances": {("a", "b"): 0.0}}, "`distances` must be positive"),
        ({"distances": {("a", "b"): 250.0}}, "`distances` must be in metres, got 250"),
        ({"distances": {"ab": 0.1}}, "`distances` must have pairs of labels as keys"),
        ({"distances": [0.1]}, "`distances` must map pairs"),
        ({"touched": None, "x": np.zeros((10, 3)), "distances": {("a", "b"): 0.1}}, "labels of"),
        ({"distance_std": 0.0}, "`distance_std`"),
        ({"x": np.full((10, 3), np.nan), "touched": [*LABELS[:9], ""]}, "`x` must be finite"),
        ({"x": np.where(np.arange(3) == 1, np.nan, np.ones((10, 3)))}, "`x` must be finite"),
    ],
)
def test_bad_input_says_what_is_needed(change, message):
    q = np.random.default_rng(0).uniform(-0.3, 0.3, (10, 5))
    arguments = {"q": q, "x": None, "parameters": ["tool"], "touched": LABELS, **change}
    with pytest.raises((ValueError, TypeError), match=message):
        calibrate(gantry(), **arguments)


def test_chains_with_markers_are_refused():
    marked = ConstantCurvatureChain([0.05]).with_markers([(0, 0.5), (0, 1.0)])
    with pytest.raises(ValueError, match="`touched` needs a chain with one tip"):
        calibrate(marked, np.full((4, 3), 0.1), None, ["radii"], touched=[1, 1, 2, 2])


def test_equal_rows_are_one_touch():
    q = np.repeat(np.random.default_rng(0).uniform(-0.3, 0.3, (2, 5)), 3, axis=0)
    with pytest.raises(ValueError, match="at least two different rows, but 2 of 2 labels"):
        calibrate(gantry(), q, None, ["tool"], touched=[0, 0, 0, 1, 1, 1])


def test_rows_that_neither_touch_nor_have_a_tip_are_named(seeded):
    q = seeded.uniform(-0.1, 0.1, (6, 3))
    labels = ["a", "a", "", "b", "b", ""]
    with pytest.raises(ValueError, match="2 of 6 rows have none \\(first: row 2\\)"):
        calibrate(gantry(), q, None, ["tool"], touched=labels)
