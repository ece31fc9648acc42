import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ForwardModel, RigidChain
from hybridkin.ik._gram import (
    apply_columns,
    apply_rows,
    null_projection,
    row_gram,
)
from hybridkin.ik._strict import StepLimits, damped_step
from hybridkin.ik.solver import IKStatus, InverseKinematics

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


@pytest.mark.parametrize(("relative", "m"), [(1e-6, 3), (1.0, 3), (1e-3, 6)])
def test_a_limited_step_is_the_optimum_of_a_reference_qp(rng, relative, m):
    N, n = 60, 9
    J = randn(rng, N, m, n)
    J[::9, -1] = 1e-4 * J[::9, -1] + J[::9, 0]
    v = randn(rng, N, m) * 10.0 ** uniform(rng, -2.0, 1.5, N, 1)  # the far ones are infeasible
    z = null_projection(J, row_gram(J), randn(rng, N, n))
    a, b = randn(rng, N, n), randn(rng, N, n)
    lower, upper = torch.minimum(a, b), torch.maximum(a, b)
    lower[::7, 0], upper[::5, 1] = -torch.inf, torch.inf
    upper[::11, 3] = lower[::11, 3]
    damping_sq = relative * row_gram(J).sigma_max ** 2
    dq, mu = damped_step(
        J,
        v,
        z,
        damping_sq.sqrt(),
        StepLimits.of_bounds(lower, upper, z),
        torch.zeros(N).double(),
        0.0 * v,
    )
    assert ((dq >= lower) & (dq <= upper)).all()
    assert_close(damping_sq[:, None] * mu, v - apply_rows(J, dq), rtol=0.0, atol=1e-8)
    problems = (a.numpy() for a in (J, v, z, lower, upper, damping_sq))
    expected = np.stack([reference_qp(*row) for row in zip(*problems, strict=True)])
    assert_close(dq, torch.from_numpy(expected), rtol=0.0, atol=1e-8)
    out_of_reach = (v - apply_rows(J, dq)).norm(dim=-1) > 0.1
    assert out_of_reach.sum() > 0.08 * N
    assert ((dq == lower) | (dq == upper)).any(-1).sum() > 0.57 * N


# ---------------------------------------------------------------- one step


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
    target = chain(uniform(rng, low, high, 1_000, 9))
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


def test_a_target_out_of_reach_gets_the_nearest_point(rng):
    direction = torch.nn.functional.normalize(randn(rng, 40, 3), dim=-1)
    target = uniform(rng, 1.25, 2.0, 40, 1) * direction  # farther than the robot is long
    solution = bha().solve(target, restarts=4)
    assert (solution.status == IKStatus.UNREACHABLE).all()
    # Nearest to first order: no feasible direction lowers the error.
    q, J, e = solution.q, CHAIN.jacobian(solution.q), target - solution.x
    pull = apply_columns(J, e)
    pull[((q == 0.4) & (pull > 0)) | ((q == 0.1) & (pull < 0))] = 0.0
    nearest = pull.norm(dim=-1) < 1e-3 * e.norm(dim=-1) * J.flatten(1).norm(dim=-1)
    assert nearest.double().mean() > 0.95


def test_straight_backbone_leaves_the_point_where_first_order_is_blind():
    tendons = ConstantCurvatureChain([0.02] * 3, lengths=[0.1] * 3)
    ik = InverseKinematics(tendons, q_min=-0.02, q_max=0.02)
    heights = np.array([0.25, 0.28, 0.299, 0.3, 0.31])
    solution = ik.solve(np.stack([0 * heights, 0 * heights, heights], axis=1))
    assert solution.status.tolist() == [0, 0, 0, 0, IKStatus.UNREACHABLE]
    assert abs(solution.error[4] - 0.01) < 1e-6


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
def test_feedback_on_the_plant_removes_what_the_model_does_not_know():
    path = closed_path(200)

    def plant(q):
        assert isinstance(q, np.ndarray)
        assert q.shape == (9,)
        return CHAIN(torch.from_numpy(1.03 * q)).numpy() + 0.01

    ik = bha(dt=0.02, gain=50.0)
    blind = ik.track(path, plant=plant)
    seeing = ik.track(path, plant=plant, feedback="measured")
    assert blind.error.min() > 5e-3
    assert seeing.error[5:].max() < 5e-4
    assert_close(torch.from_numpy(blind.x), CHAIN(torch.from_numpy(blind.q)))
    np.testing.assert_allclose(blind.error, np.linalg.norm(blind.x_measured - path, axis=1))
    np.testing.assert_allclose(blind.q, ik.track(path).q, atol=1e-14)
    assert seeing.largest_step == np.abs(np.diff(seeing.q, axis=0)).max()


@pytest.mark.parametrize("kind", [np.asarray, torch.from_numpy], ids=["core", "torch"])
def test_a_status_is_that_of_the_loop_and_an_error_that_of_the_robot(kind):
    """A robot whose tip is 1 cm off: the model reaches the point, and the robot does not."""
    path = kind(closed_path(50)[:8])

    def plant(q):
        return CHAIN(torch.as_tensor(q)).numpy() + np.array([0.0, 0.01, 0.0])

    start = kind(np.asarray(bha().solve(closed_path(50)[0], tol=1e-9).q))
    for more, converged in (
        ({}, True),
        ({"tol": 2e-3}, True),
        ({"feedback": "measured", "tol": 1e-3}, False),
        ({"feedback": "measured", "tol": 2e-2}, True),
    ):
        track = bha(dt=0.02, gain=1e-3).track(path, q0=start, plant=plant, **more)
        np.testing.assert_allclose(track.error, 0.01, atol=1.5e-3)
        reached = np.asarray(track.status) == IKStatus.CONVERGED
        if "tol" in more:
            assert reached.all() if converged else not reached.any()
        assert reached[0] == converged


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
    assert np.isfinite(np.nanmax(track.error))
    assert seen == [(i, 10) for i in range(10)]


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


def test_float32_solves_an_arm():
    origins = np.stack([np.eye(4)] * 3)
    origins[:, 0, 3] = 0.2
    axes = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]
    kinds = ["revolute", "revolute", "prismatic"]
    limits = {"q_min": [-1.0, -1.0, 0.0], "q_max": [1.0, 1.0, 0.1]}
    arm = RigidChain(origins, axes, kinds=kinds, **limits).float()
    q = torch.tensor([[0.3, -0.4, 0.05], [-0.7, 0.5, 0.01]])
    solution = InverseKinematics(arm).solve(arm(q))
    assert solution.q.dtype == torch.float32
    assert_close(arm(solution.q), arm(q), rtol=0.0, atol=1e-4)
    far = InverseKinematics(arm).solve(arm(q) + 2.0, max_iter=5)
    assert (far.status == IKStatus.UNREACHABLE).all()


def test_float32_solves_to_a_tenth_of_a_millimetre(rng):
    target = CHAIN(uniform(rng, 0.1, 0.4, 500, 9)).float()
    solution = bha().solve(target)
    assert solution.q.dtype == torch.float32
    assert solution.converged.double().mean() > 0.995
    exact = CHAIN(solution.q[solution.converged].double())
    assert (exact - target[solution.converged].double()).norm(dim=-1).max() < 1.01e-4


BAD_SETTINGS = [
    ({"q_min": 0.5}, "`q_min` .* `q_max`"),
    ({"q_min": [0.1, 0.2]}, "one value per actuator"),
    ({"q_pref": np.zeros((2, 9))}, "`q_pref`"),
    ({"dq_max": 0.0}, "`dq_max`"),
    ({"gain": 101.0}, "`gain`"),
    ({"beta": 101.0}, "`beta`"),
    ({"dt": 0.0}, "`dt`"),
    ({"damping": "some"}, "`damping`"),
    ({"weights": -1.0}, "`weights`"),
    ({"tip_limits": 3.0}, "`tip_limits` .* pair"),
    ({"tip_limits": (np.eye(3), [1.0])}, "`tip_limits` .* shapes"),
    ({"tip_limits": (np.zeros((1, 3)), [1.0])}, "`tip_limits` .* direction"),
    ({"tip_limits": ([[1.0, 0, 0], [-1.0, 0, 0]], [0.0, -1.0])}, "`tip_limits` .* none"),
]


@pytest.mark.parametrize(("settings", "message"), BAD_SETTINGS)
def test_bad_settings_are_refused_by_name(settings, message):
    with pytest.raises(ValueError, match=message):
        bha(**settings)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda ik: ik.step(np.zeros(8), np.zeros(3)), "`q`"),
        (lambda ik: ik.step(np.zeros((2, 9)), np.zeros((3, 3))), "agree in their batch shapes"),
        (lambda ik: ik.solve(np.zeros(2)), "`x_target`"),
        (lambda ik: ik.solve(np.zeros(3), tol=(1e-3, 1e-2)), "`tol`"),
        (lambda ik: ik.track(np.zeros((3, 3)), [0.0, 1.0]), "`t`"),
        (lambda ik: ik.track(np.zeros((2, 3)), [1.0, 1.0]), "increasing"),
        (lambda ik: ik.track(np.zeros((2, 3)), feedback="measured"), "`plant`"),
        (lambda ik: ik.track(np.zeros((2, 3)), feedback="tip"), "`feedback`"),
        (lambda ik: ik.tracker(np.zeros((1, 9))), "`q`"),
        (lambda ik: ik.tracker(np.full(9, 0.2), memory=0.0), "`memory`"),
        (lambda ik: ik.tracker(np.full(9, 0.2)).step([0.0, 0.7]), "`x_target`"),
    ],
)
def test_bad_calls_are_refused_by_name(call, message):
    with pytest.raises(ValueError, match=message):
        call(bha())


@pytest.mark.parametrize("rate", ["gain", "beta"])
def test_a_track_with_one_long_period_is_refused_before_the_robot_moves(rate):
    """A step of the longest period would go past its target."""
    sent = []
    path = np.full((4, 3), [0.0, 0.0, 0.75])
    ik = InverseKinematics(CHAIN, q_min=0.1, q_max=0.4, dt=0.05, **{rate: 10.0})
    times = [0.0, 0.05, 0.1, 0.15]
    ik.track(path, times, q0=np.full(9, 0.25), plant=lambda q: sent.append(q) or path[0])
    assert len(sent) == 4
    with pytest.raises(ValueError, match=f"`{rate}` times .* got 10 1/s x 0.15 s"):
        ik.track(path, [0.0, 0.05, 0.1, 0.25], plant=sent.append)
    assert len(sent) == 4


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


@pytest.mark.slow
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
