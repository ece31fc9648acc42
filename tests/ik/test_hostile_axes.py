"""Positions with an axis, and stacks of tasks, in inverse kinematics."""

import math
import pickle

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, InverseKinematics, RigidChain, robots
from hybridkin._core.rotations import least_turn, rotation
from hybridkin.ik._gram import apply_rows
from hybridkin.ik.results import IKStatus
from hybridkin.ik.tasks import AxisTask, PointsTask, PoseTask, PositionTask, Stack

TRUNK = robots.bionic_handling_assistant()
LIMITS = {"q_min": 0.1, "q_max": 0.4}
AXIS = [1.0, -2.0, 0.5]
TOL = (1e-6, 1e-5)


def randn(rng, *shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def uniform(rng, low, high, *shape):
    return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)


def five_joints():
    """An arm with as many joints as an axis task has degrees of freedom."""
    origins = np.stack([np.eye(4)] * 5)
    origins[1:, 0, 3] = [0.1, 0.3, 0.25, 0.1]
    axes = [[0, 0, 1], [0, 1, 0], [0, 1, 0], [0, 1, 0], [0, 0, 1]]
    return RigidChain(origins, axes, tool=[0.1, 0.0, 0.05])


# ---------------------------------------------------------------- the least turn


@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_the_least_turn_turns_one_direction_to_the_other(rng, dtype):
    a = randn(rng, 500, 3).to(dtype)
    b = randn(rng, 500, 3).to(dtype)
    b[:100] = -a[:100] + 10.0 ** uniform(rng, -12, -1, 100, 1).to(dtype) * b[:100]
    b[100:200] = a[100:200] + 10.0 ** uniform(rng, -12, -1, 100, 1).to(dtype) * b[100:200]
    b[200:210] = -3.0 * a[200:210]
    b[210:220] = 3.0 * a[210:220]
    turn = least_turn(a, b)
    unit = torch.nn.functional.normalize
    turned = (rotation(turn)[0] @ unit(a, dim=-1)[..., None])[..., 0]
    # Where directions are opposite to half of the digits, the turn is one of many.
    rounding = 2.0 * torch.finfo(dtype).eps ** 0.5
    assert_close(turned, unit(b, dim=-1), rtol=0.0, atol=rounding)
    # The cross product of nearly opposite ones has as many digits as its length.
    assert (turn * unit(a, dim=-1)).sum(-1).abs().max() < math.pi * rounding
    away = unit(a.double(), dim=-1) - unit(b.double(), dim=-1)
    along = unit(a.double(), dim=-1) + unit(b.double(), dim=-1)
    angle = 2.0 * torch.atan2(away.norm(dim=-1), along.norm(dim=-1))
    assert_close(turn.norm(dim=-1).double(), angle, rtol=0.0, atol=rounding)


@pytest.mark.parametrize("axis", [[0, 0, 1], [1, 0, 0], [0, -1, 0], [0.6, 0.8, 0], [1, 1, 1]])
def test_opposite_directions_have_one_half_turn(axis):
    a = torch.tensor(axis, dtype=torch.float64)
    noise = 1e-12 * torch.tensor([1.0, -2.0, 3.0], dtype=torch.float64)
    half = least_turn(a, -a)
    assert_close(half.norm(), torch.tensor(math.pi, dtype=torch.float64))
    for b in (-2.0 * a, noise - a, -noise - a):
        assert_close(least_turn(a, b), half, rtol=0.0, atol=1e-10)


def test_the_least_turn_has_derivatives_everywhere(rng):
    a = randn(rng, 4, 3)
    a[1:] = torch.nn.functional.normalize(a[1:], dim=-1)
    b = torch.stack([randn(rng, 3), a[1], a[2] + 1e-7 * randn(rng, 3), -a[3] + 0.1 * randn(rng, 3)])
    assert torch.autograd.gradcheck(least_turn, (a.requires_grad_(), b.requires_grad_()))
    straight = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(least_turn(straight, -straight.detach()).sum(), straight)
    assert torch.isfinite(slope).all()


# ---------------------------------------------------------------- errors and Jacobians


@pytest.mark.parametrize("axis", [[0.0, 0.0, 1.0], AXIS])
def test_the_jacobian_is_that_of_the_error(rng, axis):
    task = AxisTask(TRUNK, axis, length=0.3)
    q = uniform(rng, 0.2, 0.3, 20, 9)
    q[0] = 0.25  # straight
    dq = 1e-6 * randn(rng, 20, 9)
    x, J = task.evaluate(q)
    change = task.difference(task.evaluate(q - dq)[0], task.evaluate(q + dq)[0])
    assert_close(change, 2.0 * apply_rows(J, dq), rtol=0.0, atol=1e-13)
    # No motion turns about the axis, and the other five rows are free.
    turns = (x[:, None, 3:] @ J[:, 3:]).abs().max()
    assert turns < 1e-14
    assert (torch.linalg.matrix_rank(J[1:]) == 5).all()
    # Far from the target the slope of the squared error is exact.
    target = task.evaluate(uniform(rng, 0.1, 0.4, 20, 9))[0]
    target[10:, 3:] = -x[10:, 3:] + 0.1 * randn(rng, 10, 3)
    ends = [task.difference(task.evaluate(p)[0], target) for p in (q - dq, q + dq)]
    slope = 0.25 * (ends[1].square().sum(-1) - ends[0].square().sum(-1))
    e = task.difference(x, target)
    assert_close(slope, -(e * apply_rows(J, dq)).sum(-1), rtol=1e-4, atol=1e-12)


def test_a_turn_about_the_axis_is_free(rng):
    """Targets reached with another turn of the tip than that of the pose."""
    task = AxisTask(TRUNK)
    q = uniform(rng, 0.2, 0.3, 100, 9)
    solution = InverseKinematics(task, **LIMITS).solve(task.evaluate(q)[0], tol=TOL)
    assert solution.converged.all()
    assert solution.x.shape == (100, 6)
    turned = PoseTask(TRUNK, radian=1.0).difference(TRUNK.pose(q), TRUNK.pose(solution.q))
    assert turned[:, 3:].norm(dim=-1).max() > 0.05
    assert turned[:, :3].norm(dim=-1).max() < 1e-6
    # The length of the direction does not matter.
    longer = task.evaluate(q)[0] * torch.tensor([1.0, 1.0, 1.0, 7.0, 7.0, 7.0])
    again = InverseKinematics(task, **LIMITS).solve(longer, tol=TOL)
    assert_close(again.q, solution.q, rtol=0.0, atol=1e-9)


def test_an_arm_of_five_joints_is_not_damped(rng):
    """As its rows have the rank of the task: the singular value of the free turn does not count."""
    arm = five_joints()
    task = AxisTask(arm, [1.0, 0.0, 0.0])
    q = uniform(rng, -1.0, 1.0, 40, 5)
    q[:, 3] = uniform(rng, 0.4, 1.2, 40)
    target = task.evaluate(q)[0]
    ik = InverseKinematics(task, q_min=-2.0, q_max=2.0)
    step = ik.step(q + 1e-4, target)
    healthy = step.damping == 0.0
    assert healthy.double().mean() > 0.6
    after = task.evaluate(q + 1e-4 + step.dq)[0]
    assert task.difference(after, target)[healthy].norm(dim=-1).max() < 1e-5
    for rows in (q, q.numpy()):
        solution = ik.solve(target if rows is q else target.numpy(), tol=TOL)
        assert np.asarray(solution.converged).mean() >= 0.95


def test_a_turn_of_the_base_turns_the_problem(rng):
    turn = rotation(randn(rng, 3))[0]
    base = np.eye(4)
    base[:3, :3] = turn.numpy()
    lengths = {"offsets": [0.01, 0.0, 0.05]}
    task = AxisTask(ConstantCurvatureChain([0.1, 0.09, 0.08], **lengths), AXIS)
    turned = AxisTask(ConstantCurvatureChain([0.1, 0.09, 0.08], **lengths, base=base), AXIS)
    q = uniform(rng, 0.2, 0.3, 20, 9)
    target = task.evaluate(uniform(rng, 0.2, 0.3, 20, 9))[0]
    there = torch.cat([target[:, :3] @ turn.mT, target[:, 3:] @ turn.mT], dim=1)
    steps = [
        InverseKinematics(t, **LIMITS).step(q, x).dq for t, x in ((task, target), (turned, there))
    ]
    assert_close(steps[1], steps[0], rtol=0.0, atol=1e-11)


@pytest.mark.parametrize("dtype", [np.float64, np.float32])
def test_tracks_and_trackers_reach_points_with_an_axis(dtype):
    task = AxisTask(TRUNK)
    phase = np.linspace(0.0, 2.0 * np.pi, 41)
    aside = np.stack([0.1 * np.sin(phase), 0.1 * np.cos(phase), 0.75 + 0.0 * phase], axis=1)
    tilt = np.stack([0.3 * np.sin(phase), 0.1 * np.cos(phase), 1.0 + 0.0 * phase], axis=1)
    path = np.hstack([aside, tilt]).astype(dtype)
    ik = InverseKinematics(task, **LIMITS, dt=0.02)
    track = ik.track(path, tol=1e-3)
    assert track.q.dtype == dtype
    assert (track.status == IKStatus.CONVERGED).all()
    tracker = ik.tracker(track.q[0], tol=(1e-3, 1e-2))
    for x, following in zip(path, [*path[1:], path[-1]], strict=True):
        turn = least_turn(torch.from_numpy(x[3:]), torch.from_numpy(following[3:])).numpy()
        motion = np.append((following - x)[:3], task.units[1] * turn)
        tracker.step(x, motion / 0.02)
    assert tracker.status is IKStatus.CONVERGED
    assert tracker.x.shape == (6,)


def test_opposite_axes_are_left_in_one_direction():
    """The straight trunk is asked to look back: torch and core turn to the same side."""
    task = AxisTask(TRUNK)
    start = np.full(9, 0.25) + 0.003 * np.cos(np.arange(9.0))
    with torch.no_grad():
        x = task.evaluate(torch.from_numpy(start)[None])[0][0].numpy()
    target = np.concatenate([x[:3], -x[3:]])
    ik = InverseKinematics(task, **LIMITS, dq_max=1.0, damping=0.02)
    ours = ik.tracker(start)
    theirs = ik.tracker(torch.from_numpy(start))
    for _ in range(3):
        command = ours.step(target)
        np.testing.assert_allclose(command, theirs.step(torch.from_numpy(target)), atol=1e-8)
    assert np.abs(command - start).max() > 1e-3


# ---------------------------------------------------------------- derivatives of solutions


@pytest.mark.slow
@pytest.mark.parametrize("name", ["trunk", "five joints"])
def test_solutions_are_differentiable(rng, name):
    if name == "trunk":
        task, q, limits = AxisTask(TRUNK, AXIS), uniform(rng, 0.22, 0.28, 1, 9), LIMITS
    else:
        task = AxisTask(five_joints(), [1.0, 0.0, 0.0])
        q, limits = torch.tensor([[0.3, -0.5, 0.8, 0.6, 0.2]]).double(), {"q_min": -2, "q_max": 2}
    ik = InverseKinematics(task, **limits)
    x = task.evaluate(q)[0][0].detach()

    def solution(target):
        return ik.solve(target, q[0], tol=1e-9, differentiable=True).q

    assert torch.autograd.gradcheck(solution, x.requires_grad_(), eps=1e-5, atol=1e-5)


# ---------------------------------------------------------------- arguments


def test_directions_and_arguments_are_checked():
    for axis in ([0.0, 0.0, 0.0], [np.nan, 0.0, 1.0], [np.inf, 0.0, 1.0]):
        with pytest.raises(ValueError, match="`axis` must be finite and not zero"):
            AxisTask(TRUNK, axis)
    with pytest.raises(ValueError, match="`axis`"):
        AxisTask(TRUNK, [0.0, 1.0])
    for length in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(ValueError, match="`length` must be a positive length"):
            AxisTask(TRUNK, length=length)
    with pytest.raises(TypeError, match="PoseModel"):
        AxisTask(torch.nn.Linear(9, 3))
    ik = InverseKinematics(AxisTask(TRUNK), **LIMITS)
    start = np.full(9, 0.25)
    none = np.array([0.1, 0.0, 0.7, 0.0, 0.0, 0.0])
    good = np.array([0.1, 0.0, 0.7, 0.0, 0.0, 1.0])
    tracker = ik.tracker(start)
    for call in (
        lambda: ik.solve(none),
        lambda: ik.step(start, none),
        lambda: ik.step(torch.from_numpy(start), torch.from_numpy(none)),
        lambda: ik.track(np.stack([good, none])),
        lambda: tracker.step(none),
        lambda: tracker.step(good, x_measured=none),
    ):
        with pytest.raises(ValueError, match="must hold directions in its last 3 numbers"):
            call()
    np.testing.assert_array_equal(tracker.q, start)
    with pytest.raises(ValueError, match="x_target"):
        ik.step(start, good[:3])
    unknown = ik.solve(np.stack([good, np.full(6, np.nan)]))
    assert unknown.status.tolist() == [IKStatus.CONVERGED, IKStatus.INVALID_INPUT]
    far = ik.solve(np.array([0.0, 0.0, 9.0, 0.0, 0.0, 1.0]))
    assert far.status == IKStatus.UNREACHABLE


# ---------------------------------------------------------------- readings of positions alone


@pytest.mark.parametrize("make", [AxisTask, PoseTask])
@pytest.mark.parametrize("as_numpy", [True, False])
def test_a_camera_that_sees_positions_alone(make, as_numpy):
    """It corrects the position; the rotation stays with the model."""
    task = make(TRUNK)
    ik = InverseKinematics(task, **LIMITS)
    start = torch.from_numpy(0.25 + 0.01 * np.cos(np.arange(9.0)))
    goal = torch.from_numpy(0.25 + 0.012 * np.cos(np.arange(9.0) + 0.1))
    with torch.no_grad():
        x, target = task.evaluate(torch.stack([start, goal]))[0]
    seen = TRUNK(start) + torch.tensor([0.004, -0.003, 0.002])
    moved = task.moved(x, torch.tensor([0.004, -0.003, 0.002]).to(x), torch.zeros(3).to(x))
    unknown = task.reading(seen)
    if as_numpy:
        start, target, seen, moved, unknown = (
            a.numpy() for a in (start, target, seen, moved, unknown)
        )
    expected = np.asarray(ik.step(start, target, x_measured=moved).dq)
    for reading in (seen, unknown):
        np.testing.assert_allclose(
            ik.step(start, target, x_measured=reading).dq, expected, rtol=0.0, atol=1e-14
        )
        ours = ik.tracker(start)
        whole = ik.tracker(start)
        np.testing.assert_allclose(
            ours.step(target, x_measured=reading),
            whole.step(target, x_measured=moved),
            rtol=0.0,
            atol=1e-14,
        )
        assert ours.error == pytest.approx(whole.error, rel=1e-9)
    nothing = ik.step(start, target, x_measured=seen * np.nan)
    assert (np.asarray(nothing.dq) == 0.0).all()


@pytest.mark.parametrize("make", [AxisTask, PoseTask])
def test_a_path_of_poses_with_a_camera_of_positions(make):
    """The position is as exact as with readings of the whole pose."""
    task = make(TRUNK)
    robot = ConstantCurvatureChain([0.103, 0.092, 0.081])
    phase = torch.linspace(0.0, 1.0, 60, dtype=torch.float64)[:, None]
    q = 0.25 + 0.02 * torch.cos(torch.arange(9.0, dtype=torch.float64) + 3.0 * phase)
    with torch.no_grad():
        path = task.evaluate(q)[0].numpy()

    def camera(command):
        return robot(torch.from_numpy(command)).numpy()

    ik = InverseKinematics(task, **LIMITS, dt=0.05)
    track = ik.track(path, q0=q[0].numpy(), plant=camera, feedback="measured")
    positions = task.positions(torch.from_numpy(path)).numpy()
    seen = task.positions(torch.from_numpy(track.x_measured)).numpy()
    assert np.linalg.norm(seen - positions, axis=1)[40:].max() < 1e-3
    assert (track.status[40:] != IKStatus.INVALID_INPUT).all()


# ---------------------------------------------------------------- stacks


MIDDLE = TRUNK.with_tip(2.0)
STACKS = {
    "points": lambda: Stack([PositionTask(TRUNK), PointsTask(TRUNK, [2.0])], weights=[1.0, 0.5]),
    "axis": lambda: Stack([PositionTask(TRUNK), AxisTask(MIDDLE)], weights=[1.0, 0.5]),
    "pose": lambda: Stack([AxisTask(TRUNK), PoseTask(MIDDLE)]),
}


@pytest.mark.parametrize("name", STACKS)
def test_a_stack_is_its_tasks_side_by_side(rng, name):
    task = STACKS[name]()
    q = uniform(rng, 0.2, 0.3, 20, 9)
    goal = uniform(rng, 0.2, 0.3, 20, 9)
    x, J = task.evaluate(q)
    target = task.join(*(part.evaluate(goal)[0] for part in task.stacked))
    assert_close(target, task.evaluate(goal)[0], rtol=0.0, atol=0.0)
    errors = task.difference(x, target)
    row = 0
    for part, weight, ours in zip(task.stacked, task.weights, task.split(x), strict=True):
        theirs, slope = part.evaluate(q)
        end = row + sum(part.parts)
        assert_close(ours, theirs, rtol=0.0, atol=0.0)
        assert_close(J[:, row:end], weight * slope, rtol=0.0, atol=0.0)
        alone = weight * part.difference(theirs, part.evaluate(goal)[0])
        assert_close(errors[:, row:end], alone, rtol=0.0, atol=1e-15)
        row = end
    assert row == J.shape[1] == sum(task.parts)
    tol = [1e-6] * len(task.parts)
    ik = InverseKinematics(task, **LIMITS)
    for goals in (target, target.numpy()):
        solution = ik.solve(goals, tol=tol)
        assert np.asarray(solution.converged).mean() >= 0.95
    near = torch.cat([x[:1], task.evaluate(q[:1] + 1e-3)[0]])
    track = ik.track(near.numpy(), q0=q[0].numpy())
    assert track.x.shape == near.shape


def test_a_stack_of_one_task_is_that_task(rng):
    q = uniform(rng, 0.2, 0.3, 10, 9)
    for part in (PositionTask(TRUNK), AxisTask(TRUNK), PoseTask(TRUNK)):
        stack = Stack([part])
        target = part.evaluate(uniform(rng, 0.2, 0.3, 10, 9))[0]
        ours = InverseKinematics(stack, **LIMITS).step(q, stack.join(target))
        theirs = InverseKinematics(part, **LIMITS).step(q, target)
        assert_close(ours.dq, theirs.dq, rtol=0.0, atol=1e-12)


@pytest.mark.needs_core
def test_stacks_of_points_run_in_the_core(rng):
    task = STACKS["points"]()
    ik = InverseKinematics(task, **LIMITS, dq_max=1.0, damping=0.02)
    q = uniform(rng, 0.2, 0.3, 20, 9)
    target = task.evaluate(uniform(rng, 0.2, 0.3, 20, 9))[0]
    ours = ik.step(q.numpy(), target.numpy())
    theirs = ik.step(q, target)
    np.testing.assert_allclose(ours.dq, theirs.dq, rtol=0.0, atol=1e-9)
    assert ik.tracker(q[0].numpy()).backend == "compiled"
    other = InverseKinematics(STACKS["axis"](), **LIMITS).tracker(q[0].numpy())
    assert other.backend == "torch: a Stack with poses or axes has no kernel"
    x = target[0].numpy()
    again = pickle.loads(pickle.dumps(ik.tracker(q[0].numpy())))
    np.testing.assert_array_equal(again.step(x), ik.tracker(q[0].numpy()).step(x))


def test_a_stack_decides_conflicts_by_weights():
    """Two points of a straight trunk are 0.3 m apart at most; the heavier one is missed by less."""
    missed = []
    target = np.array([0.0, 0.0, 0.6, 0.0, 0.0, 1.4])
    for weights in ([3.0, 1.0], [1.0, 3.0]):
        task = Stack([PositionTask(MIDDLE), PositionTask(TRUNK)], weights)
        x = InverseKinematics(task, **LIMITS).solve(target, restarts=4).x
        missed.append(np.linalg.norm((x - target).reshape(2, 3), axis=1))
    assert missed[0][0] < missed[1][0]
    assert missed[0][1] > missed[1][1]
    assert InverseKinematics(task, **LIMITS).solve(3.0 * target).status == IKStatus.UNREACHABLE


def test_arguments_of_stacks_name_the_task():
    position = PositionTask(TRUNK)
    with pytest.raises(TypeError, match="`tasks` must be tasks"):
        Stack([TRUNK])
    with pytest.raises(TypeError, match="at least one"):
        Stack([])
    with pytest.raises(ValueError, match="`weights` must be positive, one for every task"):
        Stack([position], weights=[1.0, 2.0])
    with pytest.raises(ValueError, match="the same actuators"):
        Stack([position, PositionTask(five_joints())])
    stack = Stack([position, AxisTask(MIDDLE)])
    up = np.array([0.0, 0.0, 0.5, 0.0, 0.0, 1.0])
    assert stack.join(np.zeros((4, 3)), up).shape == (4, 9)
    with pytest.raises(ValueError, match=r"targets\[1\]"):
        stack.join(np.zeros(3), np.zeros(3))
    with pytest.raises(ValueError, match=r"targets\[1\]` must hold directions"):
        stack.join(np.zeros(3), np.zeros(6))
    with pytest.raises(ValueError, match="one for every task, 2, got 1"):
        stack.join(np.zeros(3))
    with pytest.raises(ValueError, match="part 1 of x_target` must hold directions"):
        InverseKinematics(stack, **LIMITS).solve(np.zeros(9))
    tracker = InverseKinematics(stack, **LIMITS).tracker(np.full(9, 0.25))
    tip = np.array([0.05, 0.0, 0.75])
    tracker.step(stack.join(tip, up), x_measured=np.r_[tip, up[:3], [np.nan] * 3])
    assert math.isfinite(tracker.error)
