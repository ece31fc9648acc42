"""Stacks of several levels: a task moves only what the tasks before it leave free."""

import math

import numpy as np
import pytest
import torch
from scipy.optimize import minimize
from torch.testing import assert_close

from hybridkin import ElasticTendonChain, InverseKinematics, robots
from hybridkin._core.model import ForwardModel
from hybridkin._core.planes import PlaneOfQ
from hybridkin.ik._step import limited_step
from hybridkin.ik._strict import StepLimits
from hybridkin.ik.obstacles import Sphere
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import AxisTask, PointsTask, PositionTask, Stack

TRUNK = robots.bionic_handling_assistant()
MIDDLE = TRUNK.with_tip(2.0)
SAME = 1e-9  # of a step


def tasks_of(sizes):
    """Return tasks with as many rows, of whose models only the Jacobians are used."""
    return [PositionTask(lambda q, m=m: q[..., :m], size=m) for m in sizes]


def settings_of(sizes, levels, n=6, **options):
    """Return the settings of steps of tasks with as many rows, in levels."""
    limits = {"q_min": np.full(n, -1.0), "q_max": np.full(n, 1.0)}
    stack = Stack(tasks_of(sizes), levels=levels)
    return InverseKinematics(stack, **limits, **options).settings


def random(*shape, seed=0):
    return torch.randn(*shape, generator=torch.manual_seed(seed), dtype=torch.float64)


def moved(J, dq):
    return (J @ dq[..., None])[..., 0]


def box(size, like, seed=5):
    """Return random limits about zero; some actuators are at one of them. Infinite: none."""
    infinite = torch.full_like(like, math.inf)
    if size == math.inf:
        return StepLimits.of_bounds(-infinite, infinite, like)
    lower = -size * random(*like.shape, seed=seed).abs()
    upper = size * random(*like.shape, seed=seed + 1).abs()
    lower[::3, 0] = 0.0
    return StepLimits.of_bounds(lower, upper, like)


def assert_same_motion(J, dq, expected):
    """Assert that two steps (N, n) make the same motion, to 1e-9 of what a step can make."""
    size = J.flatten(1).norm(dim=1) * torch.maximum(dq.norm(dim=1), expected.norm(dim=1))
    assert ((moved(J, dq - expected)).norm(dim=1) <= SAME * size + 1e-300).all()


def singular(J, rows):
    """Return J with nearly lost directions of some rows: by themselves, or by the rows before."""
    J = J.clone()
    J[::4, rows[-1]] = J[::4, rows[0]] + 1e-5 * J[::4, rows[-1]]
    if rows[0] > 0:
        J[1::4, rows[0]] = J[1::4, 0] + 1e-4 * J[1::4, rows[0]]
        J[2::4, rows[0]] = J[2::4, 1] - J[2::4, 0]
    J[3::8, rows[0]] = 0.0
    return J


@pytest.mark.parametrize("size", [math.inf, 1.0, 0.1, 0.01])
@pytest.mark.parametrize("damping", ["adaptive", 0.0, 0.1])
@pytest.mark.parametrize("weighted", [False, True])
def test_later_levels_and_posture_do_not_move_the_levels_before(size, damping, weighted):
    options = {"damping": damping, "weights": np.linspace(0.5, 3.0, 6) if weighted else None}
    all_levels = settings_of((2, 2, 3), (0, 1, 2), **options)
    J = singular(singular(random(40, 7, 6), (2, 3)), (4, 5, 6))
    J[5::8, :2] = torch.stack([J[5::8, 0], (1.0 + 1e-6) * J[5::8, 0]], dim=1)
    v = 0.3 * random(40, 7, seed=1)
    posture = 0.2 * random(40, 6, seed=2)
    limits = box(size, posture)
    step = limited_step(all_levels, J, v, posture, limits).dq
    assert (limits.clip(step) == step).all()
    still = torch.zeros_like(posture)
    alone = limited_step(settings_of((2,), (0,), **options), J[:, :2], v[:, :2], still, limits).dq
    assert_same_motion(J[:, :2], step, alone)
    two = settings_of((2, 2), (0, 1), **options)
    both = limited_step(two, J[:, :4], v[:, :4], still, limits).dq
    assert_same_motion(J[:, :4], step, both)
    without = limited_step(all_levels, J, v, still, limits).dq
    assert_same_motion(J, step, without)
    if size > 0.5:
        assert not torch.allclose(step, without), "the posture moves what is left"


def test_rows_of_obstacles_hold_and_do_not_change_the_order():
    settings = settings_of((2, 3), (0, 1))
    J = random(40, 5, 6)
    v = 0.3 * random(40, 5, seed=1)
    posture = 0.2 * random(40, 6, seed=2)
    limits = box(0.3, posture).with_rows(
        random(40, 3, 6, seed=3), 0.05 * random(40, 3, seed=4).abs()
    )
    still = torch.zeros_like(posture)
    step = limited_step(settings, J, v, posture, limits).dq
    alone = limited_step(settings_of((2,), (0,)), J[:, :2], v[:, :2], still, limits).dq
    assert_same_motion(J[:, :2], step, alone)
    assert (moved(limits.A, step) <= limits.b + 1e-12).all()


def test_a_row_with_nan_changes_no_other():
    settings = settings_of((2, 3), (0, 1))
    J = random(9, 5, 6)
    v = 0.3 * random(9, 5, seed=1)
    still = torch.zeros(9, 6, dtype=torch.float64)
    limits = box(0.3, still)
    expected = limited_step(settings, J, v, still, limits).dq
    J[4, 3, 1] = math.nan
    v[5, 4] = math.inf
    step = limited_step(settings, J, v, still, limits).dq
    good = [0, 1, 2, 3, 6, 7, 8]
    assert_close(step[good], expected[good], rtol=0.0, atol=1e-14)
    assert step[4:6].isnan().all()


def test_single_precision():
    settings = settings_of((2, 3), (0, 1))
    J = random(40, 5, 6)
    v = 0.3 * random(40, 5, seed=1)
    posture = 0.2 * random(40, 6, seed=2)
    limits = box(0.3, posture)
    expected = limited_step(settings, J, v, posture, limits).dq
    single = StepLimits(*(part.float() for part in limits))
    step = limited_step(settings, J.float(), v.float(), posture.float(), single).dq
    assert step.dtype == torch.float32
    # The least damping of single precision is larger, which leaves 1e-3 of a weak direction.
    assert_close(moved(J[:, :2], step.double()), moved(J[:, :2], expected), rtol=1e-3, atol=1e-3)
    assert (step.double() - expected).norm(dim=1).median() < 1e-4


def reference(J, v, upper_rows, limits, k):
    """Return the least error of later rows, by SciPy, with the motion of upper rows unchanged."""
    J, v = J[k].numpy(), v[k].numpy()
    later = [i for i in range(len(v)) if i not in upper_rows]

    def error(dq):
        return 0.5 * ((J[later] @ dq - v[later]) ** 2).sum()

    def slope(dq):
        return J[later].T @ (J[later] @ dq - v[later])

    def solve(start, motion):
        rows = [
            {
                "type": "eq",
                "fun": lambda dq: J[upper_rows] @ dq - motion,
                "jac": lambda _: J[upper_rows],
            },
            {
                "type": "ineq",
                "fun": lambda dq: limits.b[k].numpy() - limits.A[k].numpy() @ dq,
                "jac": lambda _: -limits.A[k].numpy(),
            },
        ]
        bounds = list(zip(limits.lower[k].tolist(), limits.upper[k].tolist(), strict=True))
        return minimize(
            error,
            start,
            jac=slope,
            bounds=bounds,
            constraints=rows,
            method="SLSQP",
            options={"ftol": 1e-12, "maxiter": 500},
        )

    return error, solve


@pytest.mark.parametrize("size", [0.1, 0.5])
def test_later_levels_come_as_near_as_a_solver_of_quadratic_programs(size):
    """SLSQP of SciPy; without damping, so that the problem is the same."""
    settings = settings_of((2, 3), (0, 1), damping=0.0)
    J = random(12, 5, 6, seed=7)
    v = 0.3 * random(12, 5, seed=8)
    still = torch.zeros(12, 6, dtype=torch.float64)
    limits = box(size, still).with_rows(
        random(12, 2, 6, seed=9), 0.1 * random(12, 2, seed=10).abs()
    )
    step = limited_step(settings, J, v, still, limits).dq
    at_limits = 0
    for k in range(len(J)):
        error, solve = reference(J, v, [0, 1], limits, k)
        ours = step[k].numpy()
        result = solve(np.zeros(6), J[k, :2].numpy() @ ours)
        assert result.success
        assert abs(error(ours) - result.fun) < 1e-8
        at_limits += result.fun > 1e-6
    assert at_limits > 2, "some targets are out of reach"


def test_one_level_is_the_weighted_stack():
    q = 0.25 + 0.02 * random(5, 9)
    plain = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], weights=[1.0, 0.5])
    level = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], weights=[1.0, 0.5], levels=[0, 0])
    target = plain.join(TRUNK(q) + 0.01, MIDDLE(q) - 0.02)
    steps = [
        InverseKinematics(task, q_min=0.1, q_max=0.4).step(q, target) for task in (plain, level)
    ]
    assert_close(steps[0].dq, steps[1].dq, rtol=0.0, atol=0.0)


ELASTIC = ElasticTendonChain([0.01] * 2, [0.1] * 2, routing="base")
ROBOTS = {
    "trunk": (TRUNK, 2.0, 0.25, 0.02, {"q_min": 0.1, "q_max": 0.4, "dq_max": 0.3}),
    "tendons": (ELASTIC, 1.0, 0.0, 0.002, {"q_min": -0.02, "q_max": 0.02, "dq_max": 0.05}),
}
CONTROL = {
    "gain": {"gain": 5.0},
    "acceleration": {"ddq_max": 3.0},
    "weights": {"weights": [1.0, 2.0, 3.0] * 3},
    "posture": {"beta": 2.0, "q_pref": 0.2},
    "no limits": {"limits": "off"},
}


@pytest.mark.parametrize("control", CONTROL)
def test_steps_move_the_upper_task_as_it_moves_alone(control):
    chain, at, center, width, limits = ROBOTS["trunk"]
    options = limits | CONTROL[control]
    alone_options = options | {"q_pref": None, "beta": None}
    q = center + width * random(30, chain.n_actuators)
    x = chain(q)
    target = x + 0.003 * random(30, 3, seed=1)
    dx = 0.05 * random(30, 3, seed=2)
    task = Stack([PositionTask(chain), PositionTask(chain.with_tip(at))], levels=[0, 1])
    middle = chain.with_tip(at)(q)
    both = task.join(target, middle + 0.05 * random(30, 3, seed=3))
    moving = torch.cat([dx, 0.3 * random(30, 3, seed=4)], dim=1)
    step = InverseKinematics(task, **options).step(q, both, dx=moving)
    alone = InverseKinematics(chain, **alone_options).step(q, target, dx=dx)
    assert_same_motion(chain.jacobian(q), step.dq, alone.dq)
    J = chain.with_tip(at).jacobian(q)
    assert (moved(J, step.dq - alone.dq).norm(dim=1) > 1e-6).any(), "the other task moves too"


class OnPlane(ForwardModel):
    """The trunk as its log knows it, in which two directions of q do not occur."""

    n_actuators, n_outputs = 9, 3
    plane = PlaneOfQ(torch.full((9,), 0.25).double(), torch.linalg.qr(random(9, 2))[0])

    def forward(self, q):
        return TRUNK(q)


@pytest.mark.parametrize("dq_max", [10.0, 0.5])
def test_levels_and_posture_keep_to_the_plane_of_a_log(dq_max):
    model = OnPlane()
    task = Stack([PositionTask(model), PositionTask(MIDDLE)], levels=[0, 1])
    ik = InverseKinematics(task, q_min=0.1, q_max=0.4, dq_max=dq_max, beta=5.0, q_pref=0.2)
    alone = InverseKinematics(model, q_min=0.1, q_max=0.4, dq_max=dq_max, beta=0.0)
    q = OnPlane.plane.nearest(0.25 + 0.02 * random(20, 9))
    target = TRUNK(q) + 0.005 * random(20, 3, seed=1)
    step = ik.step(q, task.join(target, MIDDLE(q) + 0.05 * random(20, 3, seed=2)))
    upper = alone.step(q, target)
    off_plane = (step.dq @ OnPlane.plane.normals).norm(dim=1)
    # At limits the plane of the first level is held by stiff rows.
    assert (off_plane <= 1e-4 * step.dq.norm(dim=1)).all()
    assert_same_motion(ik.settings.evaluate(q)[1][:, :3], step.dq, upper.dq)


def test_elastic_tendons_move_the_upper_task_first():
    chain, at, center, width, limits = ROBOTS["tendons"]
    q = center + width * random(1, chain.n_actuators)[0]
    middle = chain.with_tip(at)
    task = Stack([PositionTask(chain), PositionTask(middle)], levels=[0, 1])
    target = chain(q) + torch.tensor([0.01, -0.005, 0.0]).to(q)
    aside = middle(q) + torch.tensor([0.0, 0.05, 0.0]).to(q)
    tracker = InverseKinematics(task, **limits).tracker(q)
    for _ in range(50):
        q = tracker.step(task.join(target, aside))
    assert (chain(q) - target).norm() < 1e-6
    assert (middle(q) - aside).norm() < 0.045, "it was 0.05 m away"
    assert tracker.status != IKStatus.CONVERGED


def test_a_tracker_keeps_the_tip_while_the_middle_cannot_be_reached():
    q = 0.25 + 0.02 * random(1, 9)[0]
    task = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], levels=[0, 1])
    tip = TRUNK(q)
    far = MIDDLE(q) + torch.tensor([0.3, 0.0, 0.0]).to(q)
    tracker = InverseKinematics(task, q_min=0.1, q_max=0.4, dq_max=0.3).tracker(q)
    before = (MIDDLE(q) - far).norm()
    for _ in range(120):
        at = tracker.step(task.join(tip, far))
    assert (TRUNK(at) - tip).norm() < 1e-9, "the tip stays"
    after = (MIDDLE(at) - far).norm()
    assert after < before - 0.1
    assert_close(tracker.step(task.join(tip, far)), at, rtol=0.0, atol=1e-9)
    assert tracker.status != IKStatus.CONVERGED
    # Back to where it was, all levels are reached.
    for _ in range(120):
        at = tracker.step(task.join(tip, MIDDLE(q)))
    assert tracker.status == IKStatus.CONVERGED


def test_an_obstacle_stops_the_lower_task_alone():
    q = 0.25 + 0.02 * random(1, 9)[0]
    tip = TRUNK(q)
    far = MIDDLE(q) + torch.tensor([0.3, 0.0, 0.0]).to(q)
    ball = Sphere((MIDDLE(q) + torch.tensor([0.22, 0.0, 0.0]).to(q)).numpy(), 0.03)
    task = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], levels=[0, 1])
    ik = InverseKinematics(task, q_min=0.1, q_max=0.4, dq_max=0.3, obstacles=[ball])
    clear = ik.settings.clear
    tracker = ik.tracker(q)
    for _ in range(80):
        at = tracker.step(task.join(tip, far))
    assert (TRUNK(at) - tip).norm() < 1e-9
    assert tracker.status == IKStatus.BLOCKED
    assert clear.smallest(at[None], clear.scene) > -1e-9
    found = ik.solve(task.join(tip, far))
    assert found.status == IKStatus.BLOCKED
    assert (TRUNK(found.q) - tip).norm() < 1e-6
    assert_close((MIDDLE(found.q) - far).norm(), (MIDDLE(at) - far).norm(), rtol=1e-4, atol=0.0)


@pytest.mark.needs_core
def test_torch_computes_levels_and_says_so():
    q = np.full(9, 0.25)
    task = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], levels=[0, 1])
    tracker = InverseKinematics(task, q_min=0.1, q_max=0.4).tracker(q)
    assert tracker.backend == "torch: a Stack of several levels has no kernel"


def linear_stack(levels, n=6):
    A, B = random(2, n), random(3, n, seed=1)
    C = torch.cat([A[:1], B[:1], random(1, n, seed=2)])
    tasks = []
    for part in (A, B, C):
        tasks.append(PositionTask(lambda q, part=part: q @ part.mT.to(q), size=len(part)))
    return Stack(tasks, levels=levels)


def test_solutions_of_linear_models_are_those_of_least_squares_in_order():
    """Level 2 asks for what levels 0 and 1 have fixed, and for one direction more."""
    task = linear_stack([0, 1, 2])
    ik = InverseKinematics(task, q_min=np.full(6, -9.0), q_max=np.full(6, 9.0), q_pref=0.0)
    target = 0.3 * random(4, 8, seed=4)
    solution = ik.solve(target)
    a, b, c = task.split(solution.x)
    wanted = task.split(target)
    # The last task has one row of each of the others, and one that is free.
    assert_close(a, wanted[0], rtol=0.0, atol=1e-6)
    assert_close(b, wanted[1], rtol=0.0, atol=1e-5)
    assert_close(c[:, :2], torch.stack([a[:, 0], b[:, 0]], dim=1))
    assert_close(c[:, 2], wanted[2][:, 2], rtol=0.0, atol=1e-5)
    assert not solution.converged.any()


def test_solutions_reach_the_upper_task_where_the_lower_one_is_out_of_reach():
    q = 0.25 + 0.05 * random(20, 9)
    task = Stack([PositionTask(TRUNK), PositionTask(MIDDLE)], levels=[0, 1])
    ik = InverseKinematics(task, q_min=0.1, q_max=0.4)
    tip, middle = TRUNK(q), MIDDLE(q)
    reachable = ik.solve(task.join(tip, middle))
    assert reachable.converged.all()
    far = middle + 0.1 * random(20, 3, seed=1)
    solution = ik.solve(task.join(tip, far))
    x, y = task.split(solution.x)
    assert ((x - tip).norm(dim=1) < 1e-4).all()
    missed = (y - far).norm(dim=1) > 1e-4
    assert missed.any()
    assert not solution.converged[missed].any()
    # No motion that keeps the tip brings the middle nearer, as far as actuators are free.
    _, J = ik.settings.evaluate(solution.q)
    free = (solution.q > 0.1 + 1e-9) & (solution.q < 0.4 - 1e-9)
    J = J * free[:, None]
    for k in missed.nonzero()[:, 0].tolist():
        null = torch.eye(9).to(J) - torch.linalg.pinv(J[k, :3]) @ J[k, :3]
        pull = J[k, 3:].mT @ (far - y)[k]
        slope = (null @ pull).norm() / (J[k, 3:].norm() * (far - y)[k].norm())
        assert slope < 0.05


def test_targets_tolerances_and_tracks_of_levels():
    task = Stack([AxisTask(TRUNK), PointsTask(TRUNK, [1.0, 2.0])], levels=[0, 1])
    q = torch.full((9,), 0.25, dtype=torch.float64)
    axis = torch.tensor([0.1, 0.0, 1.0], dtype=torch.float64)
    points = torch.stack([TRUNK.with_tip(1.0)(q), MIDDLE(q)]) + 0.05
    target = task.join(torch.cat([TRUNK(q), axis]), points)
    parts = task.split(target)
    assert_close(parts[1], points)
    ik = InverseKinematics(task, q_min=0.1, q_max=0.4)
    solution = ik.solve(target, tol=(1e-5, 1e-4, 1e-3, 1e-3))
    reached, _ = task.split(solution.x)
    assert (reached[:3] - TRUNK(q)).norm() < 1e-5
    assert torch.linalg.cross(reached[3:], axis / axis.norm()).norm() < 1e-4
    assert not solution.converged
    track = ik.track(target.expand(30, -1), q0=q)
    last, _ = task.split(track.x[-1])
    assert (last[:3] - TRUNK(q)).norm() < 1e-5


@pytest.mark.parametrize(
    ("levels", "error"),
    [
        ([0], ValueError),
        ([0, 2], ValueError),
        ([1, 1], ValueError),
        ([0, -1], ValueError),
        ([0, 0.5], ValueError),
        (1, TypeError),
        ("01", TypeError),
    ],
)
def test_wrong_levels_are_refused(levels, error):
    with pytest.raises(error, match="`levels` must be whole numbers"):
        Stack(tasks_of((2, 3)), levels=levels)
