"""Tasks beyond the tip's position, weights, secondary objectives, derivatives."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ForwardModel,
    HybridForwardModel,
    RigidChain,
    datasets,
    robots,
)
from hybridkin.ik._gram import apply_rows
from hybridkin.ik.solver import IKStatus, InverseKinematics
from hybridkin.ik.tasks import (
    PointsTask,
    PoseTask,
    PositionTask,
)

CHAIN = robots.bionic_handling_assistant()
LIMITS = {"q_min": 0.1, "q_max": 0.4}


def randn(rng, *shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def uniform(rng, low, high, *shape):
    return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)


class Linear(torch.nn.Module):
    def __init__(self, A):
        super().__init__()
        self.register_buffer("A", A)

    def forward(self, q):
        return q @ self.A.T


def pose(chain, q):
    return chain.poses(q)[..., -1, :, :]


# ---------------------------------------------------------------- solvers of any number of rows


# ---------------------------------------------------------------- weights


def test_weights_say_what_a_motion_costs(rng):
    A, q, target, q_pref = (randn(rng, *shape) for shape in ((3, 7), (7,), (3,), (7,)))
    weights = uniform(rng, 0.1, 10.0, 7)
    ik = InverseKinematics(Linear(A), q_pref=q_pref, beta=100.0, weights=weights)
    dq = ik.step(q, target).dq
    # argmin |W^(1/2) (q + dq - q_pref)| with A (q + dq) = target
    B = torch.diag(1.0 / weights) @ A.T
    expected = q_pref + B @ torch.linalg.solve(A @ B, target - A @ q_pref)
    assert_close(q + dq, expected, rtol=0.0, atol=1e-12)
    assert_close(ik.solve(target, q).q, expected, rtol=0.0, atol=1e-9)
    free = InverseKinematics(Linear(A), weights=weights).step(q, target).dq
    assert_close(free, B @ torch.linalg.solve(A @ B, target - A @ q), rtol=0.0, atol=1e-12)
    # A change of units of q with the weights that belong to it changes nothing.
    unit = uniform(rng, 0.1, 10.0, 7)
    low, high = -uniform(rng, 0.1, 0.5, 7), uniform(rng, 0.1, 0.5, 7)
    plain = InverseKinematics(Linear(A), q_min=low, q_max=high)
    scaled = InverseKinematics(
        Linear(A / unit), q_min=low * unit, q_max=high * unit, weights=unit**-2
    )
    far = 3.0 * target
    start = 0.5 * (low + high)
    assert_close(
        scaled.step(start * unit, far).dq / unit, plain.step(start, far).dq, rtol=0.0, atol=1e-9
    )


# ---------------------------------------------------------------- tasks


@pytest.mark.parametrize("radian", [0.05, 1.0])
def test_pose_error_falls_as_its_jacobian_says(rng, radian):
    task = PoseTask(CHAIN, radian=radian)
    q = uniform(rng, 0.2, 0.3, 20, 9)
    dq = 1e-6 * randn(rng, 20, 9)
    T, J = task.evaluate(q)
    assert_close(T, pose(CHAIN, q))
    change = task.difference(task.evaluate(q - dq)[0], task.evaluate(q + dq)[0])
    assert_close(change, 2.0 * apply_rows(J, dq), rtol=0.0, atol=1e-13)
    target = pose(CHAIN, uniform(rng, 0.2, 0.3, 20, 9))
    ends = [task.difference(task.evaluate(p)[0], target) for p in (q - dq, q + dq)]
    slope = 0.25 * (ends[1].square().sum(-1) - ends[0].square().sum(-1))
    e = task.difference(T, target)  # exact also far from the target: the logarithm is the axis
    assert_close(slope, -(e * apply_rows(J, dq)).sum(-1), rtol=1e-5, atol=1e-13)


@pytest.mark.parametrize("chain", [CHAIN, CHAIN.with_tip(2.5)], ids=["tip", "on the backbone"])
def test_poses_are_reached_to_two_tolerances(rng, chain):
    q = uniform(rng, 0.2, 0.3, 60, 9)
    target = chain.tip_transform(q).get_matrix()
    solution = InverseKinematics(PoseTask(chain), **LIMITS).solve(
        chain.tip_transform(q), tol=(1e-6, 1e-4)
    )
    assert solution.x.shape == (60, 4, 4)
    if chain is CHAIN:
        assert solution.converged.double().mean() >= 0.98
    e = PoseTask(chain, radian=1.0).difference(solution.x, target)[solution.converged]
    assert e[:, :3].norm(dim=-1).max() <= 1e-6
    assert e[:, 3:].norm(dim=-1).max() <= 1e-4
    assert_close(solution.x, chain.tip_transform(solution.q).get_matrix(), rtol=0.0, atol=1e-14)


def test_points_along_the_backbone(rng):
    task = PointsTask(CHAIN, [1.5, 3.0])
    q = uniform(rng, 0.2, 0.3, 100, 9)
    target = torch.stack([CHAIN.with_tip(1.5)(q), CHAIN(q)], dim=1)
    solution = InverseKinematics(task, **LIMITS).solve(target)
    assert solution.converged.double().mean() >= 0.99
    assert_close(solution.x[:, 1], CHAIN(solution.q), rtol=0.0, atol=1e-14)
    one = InverseKinematics(task, **LIMITS).solve(target[0].numpy())
    assert one.x.shape == (2, 3)
    assert InverseKinematics(task, **LIMITS).solve(target[:0]).x.shape == (0, 2, 3)
    with pytest.raises(TypeError, match="with_tip"):
        PointsTask(Linear(randn(rng, 3, 9)), [1.0])


# ---------------------------------------------------------------- models


def test_pairs_of_functions_for_torch_and_for_numpy(rng):
    A = randn(rng, 3, 7)
    target, q = randn(rng, 5, 3), randn(rng, 5, 7)
    expected = InverseKinematics(Linear(A)).solve(target, q).q
    B = A.numpy()

    def f(q):
        assert isinstance(q, np.ndarray)
        return q @ B.T

    def J(q):
        return np.broadcast_to(B, (*q.shape[:-1], 3, 7))

    arrays = PositionTask.from_numpy(f, J)
    by_numpy = InverseKinematics(arrays).solve(target, q).q
    pair = (lambda q: q @ A.T, lambda q: A.expand(*q.shape[:-1], 3, 7))
    by_torch = InverseKinematics(pair).solve(target, q).q
    assert_close(by_numpy, expected, rtol=0.0, atol=1e-10)
    assert_close(by_torch, expected, rtol=0.0, atol=1e-10)
    with pytest.raises(TypeError, match="two callables"):
        InverseKinematics((f, None))
    with pytest.raises(ValueError, match="twice differentiable"):
        InverseKinematics(arrays).solve(target, q, differentiable=True)
    with pytest.raises(TypeError, match="from_numpy"):
        InverseKinematics(lambda q: q.detach().numpy()[..., :3]).step(q, target)


# ---------------------------------------------------------------- secondary objectives


# ---------------------------------------------------------------- the error model's domain


@pytest.mark.slow
def test_the_solver_stays_in_the_domain_of_a_hybrid_where_it_can(rng):
    data = datasets.load_trunk()
    model = HybridForwardModel(CHAIN, random_state=0).fit(data.q, data.x)
    target = torch.from_numpy(model.predict(data.q[::10]))
    anywhere = uniform(rng, 0.1, 0.4, len(target), 9)
    # A posture that pulls out of the domain, and starts that mostly lie outside.
    ik = InverseKinematics(model, q_pref=0.35, **LIMITS)
    solution = ik.solve(target, anywhere)
    inside = model.module_.in_domain(solution.q)
    assert solution.converged.double().mean() >= 0.98
    assert_close(solution.converged, inside & (solution.error <= 1e-4))
    # Without the way in most of them leave it, and say so.
    bare = InverseKinematics(Unguided(model.module_), q_pref=0.35, **LIMITS)
    blind = bare.solve(target, anywhere, restarts=0)
    assert (blind.status == IKStatus.OUT_OF_DOMAIN).double().mean() > 0.5
    # Further starts are taken inside.
    assert bare.solve(target, anywhere).converged.all()


class Unguided(ForwardModel):
    """A model that knows whether q is in its domain, but not how far it is from there."""

    def __init__(self, module):
        super().__init__()
        self.module = module
        self.n_actuators = 9
        self.n_outputs = 3

    def domain_distance(self, q):
        return 2.0 * (~self.module.in_domain(q)).to(q)

    def forward_and_jacobian(self, q):
        return self.module.forward_and_jacobian(q)

    def forward(self, q):
        return self.module(q)


# ---------------------------------------------------------------- derivatives of solve


def test_rows_that_have_not_converged_get_no_derivatives():
    """Out of reach every actuator is at its limit; a search that stops early leaves them free."""
    x = torch.tensor([[0.0, 0.0, 9.0], [0.1, 0.05, 0.7]], dtype=torch.float64, requires_grad=True)
    ik = InverseKinematics(CHAIN, **LIMITS)
    for max_iter, converged in ((1, [False, False]), (100, [False, True])):
        solution = ik.solve(x, differentiable=True, max_iter=max_iter, restarts=0)
        assert solution.converged.tolist() == converged
        (slope,) = torch.autograd.grad(solution.q.square().sum(), x)
        assert (slope != 0.0).any(dim=1).tolist() == converged
    with pytest.raises(ValueError, match="torch tensor"):
        InverseKinematics(CHAIN, **LIMITS).solve(np.zeros(3), differentiable=True)


def test_the_limits_of_an_arm_are_the_defaults(rng):
    """Within them, no faster than its joints; infinite ones switch them off; repr says whose."""
    origins = np.stack([np.eye(4)] * 3)
    origins[1:, 0, 3] = 0.3
    limits = {"q_min": [-1.0, -0.5, -2.0], "q_max": [1.0, 0.5, 2.0], "dq_max": [1.0, 2.0, 3.0]}
    arm = RigidChain(origins, [[0, 0, 1], [0, 1, 0], [0, 1, 0]], tool=[0.2, 0, 0], **limits)
    q = torch.rand(60, 3, generator=rng, dtype=torch.float64)
    hybrid = HybridForwardModel(arm, "linear").fit(q.numpy(), arm(q).numpy())
    for model in (arm, PoseTask(arm), hybrid):
        ik = InverseKinematics(model)
        for name, value in limits.items():
            assert_close(vars(ik.settings)[name], torch.tensor(value, dtype=torch.float64))
        assert "q_max=0.5 to 2 of the model" in repr(ik)
    ik = InverseKinematics(arm)
    step = ik.step(np.zeros(3), np.array([0.0, 0.8, 0.0]))
    assert (np.abs(step.dq) <= 0.01 * np.array(limits["dq_max"])).all()
    assert step.saturated.any()
    assert not ik.solve(np.array([-0.8, 0.0, 0.0])).converged
    free = InverseKinematics(arm, q_min=-np.inf, q_max=np.inf, dq_max=np.inf)
    assert repr(free) == "InverseKinematics(RigidChain)"
    assert free.solve(np.array([-0.79, 0.0, 0.0]), q0=np.full(3, 0.1)).converged
    some = InverseKinematics(arm, q_max=0.1)
    assert "q_min=-2 to -0.5 of the model, q_max=0.1, dq_max" in repr(some)


def test_weights_decide_between_points_that_conflict():
    """Two points of a straight trunk are 0.3 m apart at most; the heavier one is missed by less."""
    target = np.array([[0.0, 0.0, 0.6], [0.0, 0.0, 1.4]])
    missed = {}
    for weights in ([3.0, 1.0], [1.0, 1.0], [1.0, 3.0]):
        task = PointsTask(CHAIN, [2.0, 3.0], weights=weights)
        x = InverseKinematics(task, **LIMITS).solve(target, restarts=4).x
        missed[tuple(weights)] = np.linalg.norm(x - target, axis=1)
    lower, equal, upper = missed.values()
    assert lower[0] < equal[0] < upper[0]
    assert lower[1] > equal[1] > upper[1]


def test_a_pose_at_which_first_order_is_blind_is_left():
    """Upright below the straight tip: no small motion of a straight backbone gets nearer."""
    tendons = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3)
    target = np.eye(4)
    target[2, 3] = 0.28
    ik = InverseKinematics(PoseTask(tendons), q_min=-0.03, q_max=0.03)
    solution = ik.solve(target, q0=np.zeros(9), tol=(1e-4, 1e-3), restarts=0)
    assert solution.converged
    alone = ik.solve(
        torch.from_numpy(target), q0=torch.zeros(9).double(), tol=(1e-4, 1e-3), restarts=0
    )
    assert alone.converged


def test_single_precision_keeps_accelerations_and_half_spaces():
    limits = {**LIMITS, "dq_max": 0.3, "ddq_max": 4.0, "dt": 0.01}
    ik = InverseKinematics(CHAIN, **limits, tip_limits=([[0.0, 0.0, 1.0]], [0.8]))
    tracker = ik.tracker(np.full(9, 0.25, dtype=np.float32))
    commands = [tracker.q, tracker.q]
    for _ in range(60):
        commands.append(tracker.step(np.array([0.1, 0.0, 1.0], dtype=np.float32)))
    q = np.array(commands)
    assert q.dtype == np.float32
    steps = np.diff(q.astype(float), axis=0)
    ulp = float(np.spacing(np.float32(0.4)))
    assert np.abs(steps).max() <= 0.3 * 0.01 + ulp
    assert np.abs(np.diff(steps, axis=0)).max() <= 4.0 * 0.01**2 + 2 * ulp
    tips = CHAIN(torch.from_numpy(q).double())
    assert tips[:, 2].max() <= 0.8 + 1e-4
    assert tips[-1, 2] > 0.79


@pytest.mark.parametrize("radian", [0.05, 2.0])
def test_the_distance_of_starts_to_a_pose_weighs_its_rotation(rng, radian):
    """By chords in place of angles, which are the same for small rotations."""
    task = PoseTask(CHAIN, radian=radian)
    q = uniform(rng, 0.2, 0.3, 8, 9)
    target = pose(CHAIN, q)
    x = pose(CHAIN, q + 1e-4 * randn(rng, 8, 9))
    errors = task.difference(x, target).norm(dim=-1)
    assert_close(task.distances(x[:, None], target)[:, 0], errors, rtol=1e-4, atol=0.0)
    assert_close(task.distances(x[None], target).diagonal(), errors, rtol=1e-4, atol=1e-9)
