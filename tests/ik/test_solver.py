import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import lsq_linear
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ForwardModel
from hybridkin.ik._box import BoxProblem, box_limited_step, strict_box_step
from hybridkin.ik._gram import (
    adaptive_damping,
    apply_columns,
    apply_rows,
    damped_solve,
    null_projection,
    row_gram,
)
from hybridkin.ik.solver import IKStatus, InverseKinematics
from hybridkin.ik.trajectories import figure_eight

RADII = [0.100, 0.093, 0.079]
CHAIN = ConstantCurvatureChain(RADII)


def randn(rng, *shape):
    return torch.randn(*shape, generator=rng, dtype=torch.float64)


def uniform(rng, low, high, *shape):
    return low + (high - low) * torch.rand(*shape, generator=rng, dtype=torch.float64)


class Linear(torch.nn.Module):
    """x = A q; without a closed-form Jacobian, so that reverse mode is what is tested."""

    def __init__(self, A):
        super().__init__()
        self.register_buffer("A", A)

    def forward(self, q):
        return q @ self.A.T.to(q)


@pytest.fixture
def A(rng):
    return randn(rng, 3, 7)


def bha(**settings):
    return InverseKinematics(CHAIN, **{"q_min": 0.1, "q_max": 0.4, **settings})


# ---------------------------------------------------------------- three-row solvers


def test_singular_values_and_damped_solve_agree_with_dense_linear_algebra(rng):
    J = randn(rng, 200, 3, 9) * torch.logspace(-3, 3, 200, dtype=torch.float64)[:, None, None]
    J[::4, 2] = 1e-3 * J[::4, 2] + J[::4, 0] - J[::4, 1]
    gram = row_gram(J)
    exact = torch.linalg.svdvals(J)
    assert ((gram.sigma_max - exact[:, 0]).abs() <= 1e-12 * exact[:, 0]).all()
    assert ((gram.sigma_min - exact[:, 2]).abs() <= 1e-7 * exact[:, 0]).all()
    v, damping_sq = randn(rng, 200, 3), 1e-3 * exact[:, 0] ** 2
    mu = damped_solve(gram, v, damping_sq)
    eye = torch.eye(3, dtype=torch.float64)
    assert_close(
        mu, torch.linalg.solve(J @ J.mT + damping_sq[:, None, None] * eye, v), rtol=1e-9, atol=0.0
    )


def test_adaptive_damping_is_zero_when_healthy_free_of_units_and_smooth():
    ratio = torch.linspace(0.0, 0.04, 401, dtype=torch.float64)
    J = torch.zeros(401, 3, 4, dtype=torch.float64)
    J[:, 0, 0], J[:, 1, 1], J[:, 2, 2] = 3.0, 2.0, 3.0 * ratio

    damping_sq = adaptive_damping(row_gram(J))
    assert (damping_sq[ratio > 0.02 + 1e-9] == 0.0).all()
    assert_close(damping_sq[0].sqrt(), torch.tensor(0.02 * 3.0).double(), rtol=1e-6, atol=0.0)
    assert (damping_sq.diff() <= 1e-15).all()
    slope = damping_sq.diff() / ratio.diff()
    assert slope.diff().abs().max() < 0.03 * slope.abs().max()  # no kink where it sets in
    assert_close(adaptive_damping(row_gram(1e3 * J)), 1e6 * damping_sq, rtol=1e-6, atol=1e-9)


def reference_qp(J, v, z, lower, upper, damping_sq):
    A = np.vstack([np.eye(len(z)), J / np.sqrt(damping_sq)])
    b = np.concatenate([z, v / np.sqrt(damping_sq)])
    x = np.where(lower == upper, lower, 0.0)
    free = lower < upper
    if free.any():
        b = b - A[:, ~free] @ x[~free]
        found = lsq_linear(
            A[:, free], b, (lower[free], upper[free]), method="bvls", tol=1e-15, max_iter=500
        )
        x[free] = found.x
    return x


SIZES = [(1e-6, 3, 30), (1e-3, 6, 30)]
SIZES += [
    pytest.param(relative, m, 350, marks=pytest.mark.slow)
    for relative, m in [(1e-6, 3), (1e-3, 3), (1.0, 3), (1e-6, 6)]
]


@pytest.mark.parametrize(("relative", "m", "N"), SIZES)
def test_box_limited_step_is_the_optimum_of_a_reference_qp(rng, relative, m, N):
    n = 9
    J = randn(rng, N, m, n)
    J[::9, -1] = 1e-4 * J[::9, -1] + J[::9, 0]
    v = randn(rng, N, m) * 10.0 ** uniform(rng, -2.0, 1.5, N, 1)  # the far ones are infeasible
    z = null_projection(J, row_gram(J), randn(rng, N, n))
    a, b = randn(rng, N, n), randn(rng, N, n)
    lower, upper = torch.minimum(a, b), torch.maximum(a, b)
    lower[::7, 0], upper[::5, 1] = -torch.inf, torch.inf
    upper[::11, 3] = lower[::11, 3]
    damping_sq = relative * row_gram(J).sigma_max ** 2
    dq, mu = box_limited_step(BoxProblem(J, v, z, lower, upper), damping_sq)
    assert ((dq >= lower) & (dq <= upper)).all()
    assert_close(damping_sq[:, None] * mu, v - apply_rows(J, dq), rtol=0.0, atol=1e-8)
    problems = (a.numpy() for a in (J, v, z, lower, upper, damping_sq))
    expected = np.stack([reference_qp(*row) for row in zip(*problems, strict=True)])
    assert_close(dq, torch.from_numpy(expected), rtol=0.0, atol=1e-8)
    out_of_reach = (v - apply_rows(J, dq)).norm(dim=-1) > 0.1
    held = (dq == lower) | (dq == upper)
    assert out_of_reach.sum() > 0.08 * N
    assert held.any(-1).sum() > 0.57 * N


def test_strict_step_reaches_a_reachable_task_and_ignores_posture_in_the_task(rng):
    N, n = 200, 9
    J = randn(rng, N, 3, n)
    inside = uniform(rng, -1.0, 1.0, N, n)
    lower, upper = -torch.ones(N, n, dtype=torch.float64), torch.ones(N, n, dtype=torch.float64)
    v = apply_rows(J, inside)
    zero = torch.zeros(N, dtype=torch.float64)
    z = 3.0 * null_projection(J, row_gram(J), randn(rng, N, n))
    dq = strict_box_step(BoxProblem(J, v, z, lower, upper), zero)
    assert (dq.abs() == 1.0).any(-1).all()
    assert_close(apply_rows(J, dq), v, rtol=0.0, atol=1e-9)
    # Nearly singular and damped: the tip must move as it would without any posture.
    damping_sq = 1e-2 * row_gram(J).sigma_max ** 2
    for scale, close in ((1.0, 1e-8), (3.0, 5e-3)):  # 3 v is out of reach of most
        problem = BoxProblem(J, scale * v, z, lower, upper)
        plain = strict_box_step(problem._replace(z=torch.zeros_like(z)), damping_sq)
        dq = strict_box_step(problem, damping_sq)
        leaky, _ = box_limited_step(problem, damping_sq)
        assert apply_rows(J, dq - plain).norm(dim=-1).max() < close
        assert apply_rows(J, dq - plain).norm(dim=-1).median() < 1e-11
        assert apply_rows(J, leaky - plain).norm(dim=-1).max() > 0.2  # what strictness is for
    assert (dq - plain).norm(dim=-1).max() > 0.1


# ---------------------------------------------------------------- one step


@pytest.mark.slow
def test_linear_model_is_reached_in_one_step_and_settles_at_the_preferred_posture(rng, A):
    q_pref, target = randn(rng, 7), randn(rng, 3)
    ik = InverseKinematics(Linear(A), q_pref=q_pref, beta=20.0, dt=0.01)
    q = randn(rng, 7)
    q = q + ik.step(q, target).dq
    assert_close(A @ q, target, rtol=0.0, atol=1e-12)
    for _ in range(200):
        q = q + ik.step(q, target).dq
    pinv = torch.linalg.pinv(A)
    null = torch.eye(7, dtype=torch.float64) - pinv @ A
    assert_close(q, pinv @ target + null @ q_pref, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("limits", ["saturate", "off"])
def test_step_equals_equation_1_when_healthy_and_nothing_is_limited(rng, limits):
    q, q_pref = uniform(rng, 0.15, 0.35, 20, 9), uniform(rng, 0.2, 0.3, 9)
    dx, gain, beta, dt = randn(rng, 20, 3), 30.0, 5.0, 0.02
    x, J = CHAIN.forward_and_jacobian(q)
    target = x + 1e-3 * randn(rng, 20, 3)
    ik = bha(q_pref=q_pref, beta=beta, gain=gain, dt=dt, limits=limits, q_min=-9.0, q_max=9.0)
    step = ik.step(q, target, dx)
    pinv = torch.linalg.pinv(J)
    eye = torch.eye(9, dtype=torch.float64)
    v = dt * dx + gain * dt * (target - x)
    expected = apply_rows(pinv, v) + apply_rows(eye - pinv @ J, beta * dt * (q_pref - q))
    assert_close(step.dq, expected, rtol=0.0, atol=1e-13)
    assert_close(step.error, (target - x).norm(dim=-1))
    assert (step.damping == 0.0).all()
    assert not step.saturated.any()
    idle = ik.step(q, x).dq
    assert apply_rows(J, idle).abs().max() < 1e-15 < idle.abs().max()


def test_step_takes_the_measured_tip_in_place_of_the_models(rng):
    q = uniform(rng, 0.2, 0.3, 9)
    x = CHAIN(q)
    seen = x + 1e-3
    dq = bha(beta=0.0).step(q, x, x_measured=seen).dq
    assert_close(CHAIN.jacobian(q) @ dq, x - seen, rtol=1e-10, atol=1e-15)


@pytest.mark.slow
@given(seed=st.integers(0, 2**31), dtype=st.sampled_from([torch.float64, torch.float32]))
def test_limits_hold_to_the_last_bit(seed, dtype):
    rng = torch.Generator().manual_seed(seed)
    low, high = uniform(rng, -1.0, 0.2, 7), uniform(rng, 0.2, 1.0, 7)
    model = Linear(randn(rng, 3, 7))
    speed = 100.0 * torch.rand(7, generator=rng)
    ik = InverseKinematics(model, q_min=low, q_max=high, dq_max=speed)
    low, high = low.to(dtype), high.to(dtype)
    q = (low + (high - low) * torch.rand(40, 7, generator=rng).to(dtype)).clamp(low, high)
    target = 3.0 * randn(rng, 40, 3).to(dtype)
    for _ in range(5):
        q = q + ik.step(q, target).dq
        assert ((q >= low) & (q <= high)).all()
    q = ik.solve(target).q
    assert ((q >= low) & (q <= high)).all()
    assert ((q == low) | (q == high)).any()


@pytest.mark.slow
def test_solver_evaluates_the_model_inside_the_limits_only(rng):
    class Witness(torch.nn.Module):
        lowest, highest = np.inf, -np.inf

        def forward_and_jacobian(self, q):
            self.lowest = min(self.lowest, float(q.min()))
            self.highest = max(self.highest, float(q.max()))
            return CHAIN.forward_and_jacobian(q)

        def forward(self, q):
            return CHAIN(q)

    witness = Witness()
    ik = InverseKinematics(witness, q_min=[0.1] * 9, q_max=0.4)
    ik.solve(randn(rng, 200, 3), restarts=2)
    assert (witness.lowest, witness.highest) == (0.1, 0.4)


def test_start_outside_the_limits_walks_back_at_full_speed():
    ik = bha(dq_max=0.5, dt=0.01)
    q = torch.full((9,), 0.25, dtype=torch.float64)
    q[0], q[4] = 0.4 + 0.0125, 0.1 - 0.006
    path = []
    for _ in range(5):
        q = q + ik.step(q, torch.tensor([0.1, 0.0, 0.8], dtype=torch.float64)).dq
        path.append(q)
    path = torch.stack(path)
    back = torch.tensor([0.4075, 0.4025], dtype=torch.float64)
    assert_close(path[:2, 0], back, rtol=0.0, atol=1e-15)
    assert_close(path[0, 4], torch.tensor(0.099, dtype=torch.float64), rtol=0.0, atol=1e-15)
    assert (path[2:, 0] <= 0.4).all()
    assert (path[1:, 4] >= 0.1).all()


def test_speed_limit_holds_and_free_actuators_take_over(rng):
    speed = torch.full((9,), 1.0, dtype=torch.float64)
    speed[:3] = 0.01
    ik = bha(dq_max=speed, dt=0.01, beta=0.0)
    q = uniform(rng, 0.2, 0.3, 9)
    x, J = CHAIN.forward_and_jacobian(q)
    wanted = torch.tensor([1e-3, -5e-4, 2e-4], dtype=torch.float64)
    step = ik.step(q, x + wanted)
    assert (step.dq.abs() <= speed * 0.01).all()
    assert step.saturated[:3].any()
    assert_close(J @ step.dq, wanted, rtol=0.0, atol=1e-12)
    free = bha(dt=0.01, beta=0.0).step(q, x + wanted)
    assert (J @ torch.clamp(free.dq, -0.01 * speed, 0.01 * speed) - wanted).norm() > 1e-4


def test_singular_configuration_is_damped_and_finite():
    straight = ConstantCurvatureChain([0.02, 0.02], lengths=[0.1, 0.1])
    ik = InverseKinematics(straight, q_pref=0.0)
    q = torch.zeros(6, dtype=torch.float64)
    step = ik.step(q, torch.tensor([0.01, 0.0, 0.1], dtype=torch.float64))
    assert step.sigma_min < 1e-7
    assert step.damping > 0.0
    assert step.dq.norm() < 1.0
    plain = InverseKinematics(straight, q_pref=0.0, damping=0.0)
    assert torch.isfinite(plain.step(q, step.x + 0.01).dq).all()


# ---------------------------------------------------------------- solve


def coupled_tendons():
    """A thin robot whose distal tendons run through all segments, and that starts straight."""
    return ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3, routing="base")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("chain", "low", "high"),
    [(CHAIN, 0.1, 0.4), (coupled_tendons(), -0.02, 0.02)],
    ids=["trunk", "coupled tendons"],
)
def test_reachable_targets_converge_from_a_cold_start(rng, chain, low, high):
    target = chain(uniform(rng, low, high, 2_000, 9))
    solution = InverseKinematics(chain, q_min=low, q_max=high).solve(target)
    assert solution.converged.double().mean() >= 0.999
    good, q = solution.converged, solution.q
    assert_close((chain(q) - target).norm(dim=-1), solution.error, rtol=0.0, atol=1e-12)
    assert solution.error[good].max() <= 1e-4
    assert_close(chain(q), solution.x, rtol=0.0, atol=1e-12)
    assert ((q >= low) & (q <= high)).all()
    assert_close(solution.limit_margin, torch.minimum(q - low, high - q).amin(-1))


@pytest.mark.parametrize("d", [0.001, 0.1, 3.0])
def test_target_above_the_longest_robot_is_unreachable_by_what_is_missing(d):
    solution = bha().solve(np.array([0.0, 0.0, 3 * 0.4 + d]))
    assert solution.status == IKStatus.UNREACHABLE
    assert abs(solution.error - d) < 1e-9
    assert (solution.q == 0.4).all()


def test_unreachable_targets_never_converge_and_get_the_nearest_point(rng):
    # A chain with bends up to theta cannot be farther from its base than its length.
    direction = torch.nn.functional.normalize(randn(rng, 300, 3), dim=-1)
    target = uniform(rng, 1.25, 2.0, 300, 1) * direction
    solution = bha().solve(target)
    assert not solution.converged.any()
    assert (solution.status == IKStatus.UNREACHABLE).all()
    # Nearest to first order: no feasible direction lowers the error.
    q, J, e = solution.q, CHAIN.jacobian(solution.q), target - solution.x
    pull = apply_columns(J, e)
    pull[((q == 0.4) & (pull > 0)) | ((q == 0.1) & (pull < 0))] = 0.0
    nearest = pull.norm(dim=-1) < 1e-3 * e.norm(dim=-1) * J.flatten(1).norm(dim=-1)
    assert nearest.double().mean() > 0.98


def test_straight_backbone_leaves_the_point_where_first_order_is_blind():
    tendons = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3)
    ik = InverseKinematics(tendons, q_min=-0.02, q_max=0.02)
    heights = np.array([0.25, 0.28, 0.299, 0.3, 0.31])
    solution = ik.solve(np.stack([0 * heights, 0 * heights, heights], axis=1))
    assert solution.status.tolist() == [0, 0, 0, 0, IKStatus.UNREACHABLE]
    assert abs(solution.error[4] - 0.01) < 1e-6


def test_posture_after_convergence_is_the_nearest_solution(rng, A):
    q_pref = randn(rng, 7)
    target = randn(rng, 5, 3)
    solution = InverseKinematics(Linear(A), q_pref=q_pref).solve(target, randn(rng, 5, 7))
    pinv = torch.linalg.pinv(A)
    expected = q_pref + apply_rows(pinv, target - A @ q_pref)
    assert_close(solution.q, expected, rtol=0.0, atol=1e-9)


@pytest.mark.slow
def test_further_starts_reach_what_a_warm_start_misses(rng):
    target = CHAIN(uniform(rng, 0.1, 0.4, 300, 9))
    starts = uniform(rng, 0.1, 0.4, 300, 9)
    once = bha().solve(target, starts, restarts=0)
    again = bha().solve(target, starts)
    assert again.converged.all()
    assert not once.converged.all()
    same = bha().solve(target, starts)
    assert_close(again.q, same.q, rtol=0.0, atol=0.0)
    assert (again.n_iter >= once.n_iter).all()


def test_max_iter_is_honest(rng):
    target = CHAIN(uniform(rng, 0.1, 0.4, 50, 9))
    solution = bha().solve(target, max_iter=1)
    allowed = {IKStatus.MAX_ITER, IKStatus.AT_LIMITS, IKStatus.CONVERGED}
    assert set(solution.status.tolist()) <= allowed
    assert (solution.status == IKStatus.MAX_ITER).any()
    start = (CHAIN(torch.full((9,), 0.25).double()) - target).norm(dim=-1)
    assert (solution.error <= start).all()


def solve_whole_and_in_parts(ik, target):
    whole = ik.solve(target, restarts=2)
    single = [ik.solve(row, restarts=2) for row in target]
    cut = len(target) // 3
    parts = [ik.solve(part, restarts=2) for part in target.split([cut, 2 * cut])]
    return whole, single, [torch.stack([s.q for s in single]), torch.cat([s.q for s in parts])]


@pytest.mark.slow
def test_batch_equals_loop_and_any_split(rng):
    ik = bha()
    whole, single, others = solve_whole_and_in_parts(ik, CHAIN(uniform(rng, 0.1, 0.4, 12, 9)))
    for other in others:
        assert_close(whole.q, other, rtol=0.0, atol=1e-12)
        assert_close(whole.x, CHAIN(other), rtol=0.0, atol=1e-12)
    assert whole.status.tolist() == [int(s.status) for s in single]
    whole, single, others = solve_whole_and_in_parts(ik, randn(rng, 9, 3))
    for other in others:
        # On the way to a nearest point rounding is not contracted as it is by Gauss-Newton.
        assert_close(whole.q, other, rtol=0.0, atol=1e-9)
    assert whole.status.tolist() == [int(s.status) for s in single]
    q = uniform(rng, 0.2, 0.3, 4, 15, 9)
    target = CHAIN(q) + 0.01 * randn(rng, 4, 15, 3)
    steps = ik.step(q, target)
    rows = [ik.step(*row).dq for row in zip(q.reshape(60, 9), target.reshape(60, 3), strict=True)]
    assert steps.dq.shape == (4, 15, 9)
    assert_close(steps.dq.reshape(60, 9), torch.stack(rows), rtol=0.0, atol=1e-12)


def test_empty_batches():
    solution = bha().solve(np.zeros((0, 3)), restarts=1)
    assert solution.q.shape == (0, 9)
    assert solution.status.shape == (0,)
    assert "0 targets" in repr(solution)
    assert bha().step(np.zeros((2, 0, 9)), np.zeros((2, 0, 3))).dq.shape == (2, 0, 9)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy])
def test_a_target_that_is_not_finite_returns_the_start_within_the_limits(bad, kind):
    # The start is straight, where starts beside it are tried for good targets.
    chain = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2, routing="base")
    ik = InverseKinematics(chain, q_min=-0.02, q_max=0.02)
    bent = chain(torch.tensor([0.01, -0.005, -0.005, 0.015, -0.0075, -0.0075]).double()).tolist()
    target = kind(np.array([bent, [0.05, bad, 0.15]]))
    outside = kind(np.array([0.01, 0.0, -0.01, 0.03, 0.0, 0.0]))
    for q0, expected in ((None, np.zeros(6)), (outside, [0.01, 0.0, -0.01, 0.02, 0.0, 0.0])):
        solution = ik.solve(target, q0, restarts=1)
        assert solution.status.tolist() == [IKStatus.CONVERGED, IKStatus.INVALID_INPUT]
        np.testing.assert_array_equal(solution.q[1], expected)
        assert np.isfinite(np.asarray(solution.x)).all()


def test_a_model_may_be_out_of_its_domain():
    class Guarded(torch.nn.Module):
        def forward(self, q):
            return CHAIN(q)

        def in_domain(self, q):
            return CHAIN(q)[:, 0] > 0.0

    class Fitted:
        module_ = Guarded()

    target = np.array([[0.1, 0.0, 0.7], [-0.1, 0.0, 0.7], [0.0, 0.0, 9.0]])
    solution = InverseKinematics(Fitted(), q_min=[0.1] * 9, q_max=0.4).solve(target)
    assert solution.status.tolist() == [0, IKStatus.OUT_OF_DOMAIN, IKStatus.MAX_ITER]


# ---------------------------------------------------------------- track


def closed_path(n, laps=1):
    phase = 2.0 * np.pi * np.arange(laps * n + 1) / n
    x = np.stack([0.1 * np.sin(phase), 0.06 * np.sin(2.0 * phase), 0.75 + 0.05 * np.cos(phase)], 1)
    return x


@pytest.mark.slow
@pytest.mark.parametrize(("feedback", "order"), [(None, 1.0), ("model", 2.0)])
def test_order_of_tracking_in_the_period(feedback, order):
    errors = []
    for n in (50, 100, 200):
        ik = bha(dt=4.0 / n, beta=0.0)
        track = ik.track(closed_path(n), feedback=feedback)
        errors.append(track.error[n // 10 :].max())
    rates = np.log2(np.array(errors[:-1]) / np.array(errors[1:]))
    np.testing.assert_allclose(rates, order, atol=0.2)


@pytest.mark.slow
def test_posture_makes_a_closed_path_cyclic():
    n, period, laps, beta = 100, 2.0, 5, 1.0
    q0 = bha().solve(closed_path(n)[0]).q
    # A start off the preferred posture, by a motion that keeps the tip.
    q0 = bha(q_pref=np.linspace(0.15, 0.35, 9)).solve(closed_path(n)[0], q0, tol=1e-9).q
    gaps = {}
    for rate in (0.0, beta):
        track = bha(dt=period / n, beta=rate).track(closed_path(n, laps), q0=q0)
        marks = track.q[::n]
        gaps[rate] = np.linalg.norm(np.diff(marks, axis=0), axis=1)
    decay = {rate: gap[1:] / gap[:-1] for rate, gap in gaps.items()}
    # (1 - beta dt)^n is what the discrete law gives for exp(-beta T).
    np.testing.assert_allclose(decay[beta], (1.0 - beta * period / n) ** n, rtol=0.01)
    # Without posture the gap stays, up to what the drift itself changes.
    assert ((decay[0.0] > 0.9) & (decay[0.0] < 1.0)).all()


@pytest.mark.slow
def test_feedback_on_the_plant_removes_what_the_model_does_not_know():
    path = closed_path(200)

    def plant(q):
        assert isinstance(q, np.ndarray)
        assert q.shape == (9,)
        return CHAIN(torch.from_numpy(1.03 * q)).numpy() + 0.01

    ik = bha(dt=0.02)
    blind = ik.track(path, plant=plant)
    seeing = ik.track(path, plant=plant, feedback="measured")
    assert blind.error.min() > 5e-3
    assert seeing.error[5:].max() < 5e-4
    assert_close(torch.from_numpy(blind.x), CHAIN(torch.from_numpy(blind.q)))
    np.testing.assert_allclose(blind.error, np.linalg.norm(blind.x_measured - path, axis=1))
    np.testing.assert_allclose(blind.q, ik.track(path).q, atol=1e-14)
    assert (seeing.mean_error, seeing.max_error) == (seeing.error.mean(), seeing.error.max())
    assert 0.94 < (seeing.error <= seeing.p95_error).mean() < 0.96
    assert seeing.largest_step == np.abs(np.diff(seeing.q, axis=0)).max()


def wrong_plant(q):
    return CHAIN(torch.from_numpy(1.03 * q)).numpy() + 0.01


@pytest.mark.slow
def test_a_reading_counts_on_where_the_next_ones_are_missing():
    path, calls = closed_path(30), []

    def now_and_then(q):
        calls.append(q)
        return wrong_plant(q) if len(calls) % 20 == 1 else np.full(3, np.nan)

    def error(**options):
        calls.clear()
        track = bha(dt=0.02).track(path, plant=now_and_then, feedback="measured", **options)
        return np.linalg.norm(wrong_plant(track.q) - path, axis=1).mean()

    assert error(memory=5.0) < 0.7 * error()
    # Once forgotten, the model's own tip is what counts.
    assert error(memory=1e-3) > 3.0 * error(memory=5.0)


def test_without_any_reading_memory_goes_by_the_models_tip():
    path = closed_path(30)

    def blind(q):
        return np.full(3, np.nan)

    track = bha().track(path, plant=blind, feedback="measured", memory=1.0)
    np.testing.assert_array_equal(track.q, bha().track(path).q)


def test_a_failing_plant_loses_only_its_own_point():
    calls = []

    def plant(q):
        calls.append(q)
        if len(calls) == 4:
            raise OSError("no reading")
        return CHAIN(torch.from_numpy(q)).numpy()

    seen = []
    with pytest.warns(UserWarning, match=r"point 3.*no reading"):
        track = bha(dt=0.02).track(
            closed_path(50)[:10],
            plant=plant,
            feedback="measured",
            tol=0.01,
            progress=lambda i, n: seen.append((i, n)),
        )
    assert np.isnan(track.x_measured).any(axis=1).tolist() == [i == 3 for i in range(10)]
    assert track.status.tolist() == [
        IKStatus.INVALID_INPUT if i == 3 else IKStatus.CONVERGED for i in range(10)
    ]
    assert np.isfinite(track.q).all()
    assert np.isfinite(track.max_error)
    assert seen == [(i, 10) for i in range(10)]


@pytest.mark.slow
def test_track_takes_a_trajectory_uneven_times_and_gaps_in_the_path():
    ik = bha()
    path = figure_eight([0.0, 0.0, 0.75], (0.3, 0.15), duration=2.0, dt=0.02)
    track = ik.track(path, tol=1e-3)
    np.testing.assert_array_equal(track.t, path.t)
    assert (track.status == IKStatus.CONVERGED).all()
    assert track.x_measured is None
    uneven = np.delete(np.arange(len(path)), [10, 11, 50])
    skipping = ik.track(path.x[uneven], path.t[uneven])
    assert skipping.max_error < 9.0 * track.max_error  # a threefold period, squared
    spoilt = path.x.copy()
    spoilt[40:45] = np.nan
    track = ik.track(spoilt, path.t)
    assert (track.status == IKStatus.INVALID_INPUT).nonzero()[0].tolist() == [40, 41, 42, 43, 44]
    assert track.error[47:].max() < 1e-3  # one jump to the path, one step to settle


@pytest.mark.slow
def test_a_path_out_of_reach_is_followed_at_the_limits():
    start, end = np.array([0.0, 0.0, 0.8]), np.array([0.0, 0.0, 1.5])
    path = start + np.linspace(0.0, 1.0, 200)[:, None] * (end - start)
    track = bha().track(path)
    reached = path[:, 2] <= 1.2
    assert (track.status[reached] == IKStatus.CONVERGED).all()
    assert (track.status[~reached] == IKStatus.AT_LIMITS).all()
    assert abs(track.error[-1] - 0.3) < 1e-6
    assert track.q.max() == 0.4


def test_a_speed_limit_shows_in_the_status():
    jump = np.array([[0.0, 0.0, 0.75]] * 3 + [[0.1, 0.0, 0.8]] * 40)
    track = bha(dq_max=0.3).track(jump)
    assert track.largest_step <= 0.3 * 0.01 * (1 + 1e-12)
    assert IKStatus.AT_LIMITS in track.status
    assert track.status[-1] == IKStatus.CONVERGED


# ---------------------------------------------------------------- doors


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_numpy_and_torch_come_back_as_they_went_in(rng, dtype):
    q = uniform(rng, 0.2, 0.3, 5, 9).numpy().astype(dtype)
    target = CHAIN(uniform(rng, 0.2, 0.3, 5, 9)).numpy().astype(dtype)
    q.flags.writeable = target.flags.writeable = False
    ik = bha(dq_max=1.0)
    q_tensor, target_tensor = torch.tensor(q), torch.tensor(target, requires_grad=True)
    pairs = [
        (ik.step(q, target), ik.step(q_tensor, target_tensor)),
        (ik.solve(target, q), ik.solve(target_tensor, q_tensor)),
        (ik.track(target, q0=q[0]), ik.track(target_tensor, q0=q_tensor[0])),
    ]
    for arrays, tensors in pairs:
        for name in vars(arrays):
            array, tensor = getattr(arrays, name), getattr(tensors, name)
            if array is None:
                assert tensor is None
                continue
            assert isinstance(array, np.ndarray)
            assert isinstance(tensor, torch.Tensor)
            assert not tensor.requires_grad
            np.testing.assert_allclose(array, tensor.numpy(), rtol=0.0, atol=1e-9)
            if tensor.is_floating_point():
                assert array.dtype == dtype
    assert ik.solve(target.tolist()).q.dtype == np.float64


def test_float32_solves_to_a_tenth_of_a_millimetre(rng):
    target = CHAIN(uniform(rng, 0.1, 0.4, 500, 9)).float()
    solution = bha().solve(target)
    assert solution.q.dtype == torch.float32
    assert solution.converged.double().mean() > 0.995
    exact = CHAIN(solution.q[solution.converged].double())
    assert (exact - target[solution.converged].double()).norm(dim=-1).max() < 1.01e-4


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"q_min": 0.5}, "`q_min` must not exceed `q_max`"),
        ({"q_min": [0.1, 0.2]}, "one value per actuator"),
        ({"q_min": float("nan")}, "`q_min` must be a number"),
        ({"q_pref": np.zeros((2, 9))}, "`q_pref` must be a number"),
        ({"q_pref": np.inf}, "`q_pref` .* finite"),
        ({"dq_max": 0.0}, "`dq_max` .* positive"),
        ({"gain": 101.0}, "`gain` times the period"),
        ({"gain": 0.0}, "`gain` must be positive"),
        ({"beta": 101.0}, "`beta` times the period"),
        ({"beta": -1.0}, "`beta` must not be negative"),
        ({"dt": 0.0}, "`dt` must be a positive period"),
        ({"limits": "clip"}, "`limits` must be"),
        ({"damping": "some"}, "`damping` must be"),
        ({"damping": -1.0}, "`damping` must be"),
        ({"weights": -1.0}, "`weights` .* positive"),
    ],
)
def test_bad_settings_say_what_was_needed(settings, message):
    with pytest.raises(ValueError, match=message):
        bha(**settings)


@pytest.mark.parametrize("as_given", [np.asarray, torch.as_tensor], ids=["core", "torch"])
def test_periods_of_more_than_a_second_need_no_beta(as_given):
    q, target = as_given(np.full(9, 0.3)), as_given(np.array([0.1, 0.0, 0.8]))
    slow = bha(dt=2.0, q_pref=0.2)
    np.testing.assert_allclose(
        slow.step(q, target).dq, bha(dt=2.0, beta=0.5, q_pref=0.2).step(q, target).dq
    )
    quick = bha(dt=0.5, q_pref=0.2)
    np.testing.assert_allclose(
        quick.step(q, target).dq, bha(dt=0.5, beta=1.0, q_pref=0.2).step(q, target).dq
    )
    assert slow.track(np.full((2, 3), [0.0, 0.0, 0.8]), [0.0, 3.0]).q.shape == (2, 9)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda ik: ik.step(np.zeros(8), np.zeros(3)), r"`q` must have shape \(..., 9\)"),
        (lambda ik: ik.step(np.zeros(9), np.zeros(2)), r"`x_target` must have shape \(..., 3\)"),
        (lambda ik: ik.step(np.zeros((2, 9)), np.zeros((3, 3))), "agree in their batch shapes"),
        (lambda ik: ik.step(["a"] * 9, np.zeros(3)), "`q` must be numeric"),
        (lambda ik: ik.solve(np.zeros(3), tol=0.0), "`tol` must be positive"),
        (lambda ik: ik.solve(np.zeros(3), tol=(1e-3, 1e-2)), "`tol` must be positive: one number"),
        (lambda ik: ik.solve(np.zeros(3), max_iter=0), "`max_iter` must be 1 to"),
        (lambda ik: ik.track(np.zeros(3)), r"`path` must have shape \(T, 3\)"),
        (lambda ik: ik.track(np.zeros((3, 3)), [0.0, 1.0]), r"`t` must have shape \(3,\)"),
        (lambda ik: ik.track(np.zeros((2, 3)), [1.0, 1.0]), "increasing"),
        (lambda ik: ik.track(np.zeros((2, 3)), feedback="measured"), "needs `plant`"),
        (lambda ik: ik.track(np.zeros((2, 3)), memory=1.0), "`memory` requires feedback"),
        (lambda ik: ik.track(np.zeros((2, 3)), feedback="tip"), "`feedback` must be"),
    ],
)
def test_bad_calls_say_what_was_needed(call, message):
    with pytest.raises(ValueError, match=message):
        call(bha())


def test_what_cannot_be_known_is_asked_for(A):
    with pytest.raises(TypeError, match="fitted regressor"):
        InverseKinematics(object())
    with pytest.raises(ValueError, match="give `q0`"):
        InverseKinematics(CHAIN).solve(np.zeros(3))
    with pytest.raises(ValueError, match="number of actuators is not known"):
        InverseKinematics(Linear(A), q_min=0.0, q_max=1.0).solve(np.zeros(3))
    with pytest.raises(ValueError, match="`model` must map q"):
        InverseKinematics(lambda q: q).step(np.zeros(9), np.zeros(3))


class TwoRegions(ForwardModel):
    """A robot x = ((q1 + q4), (1 + q4^2) q2, (1 + q4^2) q3) that is known in two regions.

    One holds the preferred configuration, but ends at x1 = 0.05; the other does not end.
    """

    n_actuators, n_outputs = 4, 3

    def forward(self, q):
        scale = 1.0 + q[..., 3:].square()
        return torch.cat([q[..., :1] + q[..., 3:], scale * q[..., 1:3]], dim=-1)

    def domain_distance(self, q):
        near = (q[..., 3].abs() < 0.2) & (q[..., 0] + q[..., 3] < 0.05)
        return torch.where(near | (q[..., 3] > 0.4), 0.5, 2.0).to(q)


@pytest.mark.parametrize("as_numpy", [True, False])
def test_a_track_without_a_start_stays_in_the_domain(as_numpy):
    path = torch.linspace(0.0, 0.3, 61)[:, None] * torch.tensor(
        [1.0, 0.2, 0.0], dtype=torch.float64
    )
    path = path.numpy() if as_numpy else path
    ik = InverseKinematics(TwoRegions(), q_min=-1.0, q_max=1.0, q_pref=0.0, beta=0.0)
    left = ik.track(path, q0=np.zeros(4) if as_numpy else torch.zeros(4, dtype=torch.float64))
    assert (left.status == IKStatus.OUT_OF_DOMAIN).sum() > 40
    seen = []
    track = ik.track(path, plant=lambda q: seen.append(q) or ik.model(torch.as_tensor(q)))
    assert (track.status == IKStatus.CONVERGED).all()
    assert len(seen) == len(path)  # the robot moves once
    rows = np.random.default_rng(0).uniform(-1.0, 1.0, (200, 4))
    rows[:, 3] = np.abs(rows[:, 3])
    track = ik.track(path, q0=rows if as_numpy else torch.from_numpy(rows))
    assert (track.status == IKStatus.CONVERGED).all()


def test_measured_points_are_converged_within_a_millimetre():
    rng = np.random.default_rng(0)

    def plant(q):
        tip = CHAIN(torch.from_numpy(q)).numpy()
        return 1.02 * tip + 1e-4 * rng.standard_normal(3)  # 14 mm from the model

    path = figure_eight((0.0, 0.0, 0.7), (0.2, 0.1), duration=2.0, dt=0.02)
    track = bha(dt=0.02).track(path, plant=plant, feedback="measured")
    first = track.status.tolist().index(IKStatus.CONVERGED)
    assert first <= 3
    assert (track.status[first:] == IKStatus.CONVERGED).all()
    assert (track.error[first:] < 1e-3).all()
    assert track.error[0] > 1e-2
    strict = bha(dt=0.02).track(path, plant=plant, feedback="measured", tol=1e-4)
    assert (strict.status == IKStatus.MAX_ITER).mean() > 0.8
