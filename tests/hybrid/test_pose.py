"""Hybrid models of the whole pose."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation
from sklearn.linear_model import LinearRegression
from sklearn.pipeline import make_pipeline
from sklearn.preprocessing import MinMaxScaler, PolynomialFeatures
from torch.testing import assert_close

from hybridkin import (
    ELMRegressor,
    HybridForwardModel,
    InverseKinematics,
    robots,
)
from hybridkin._core.rotations import rotation
from hybridkin.ik.solver import IKStatus
from hybridkin.ik.tasks import PoseTask, rotation_vector

STRAIGHT = torch.full((1, 9), 0.25, dtype=torch.float64)


def bha(base=None):
    chain = robots.bionic_handling_assistant()
    if base is None:
        return chain
    return chain.with_geometry(base=torch.as_tensor(base, dtype=torch.float64))


def end(chain, q):
    return chain.poses(torch.as_tensor(q))[..., -1, :, :].numpy()


def rows_of(T):
    return np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_rotvec()], axis=1)


def moved(T, way, turn):
    """Poses moved by ways, their frames turned by rotation vectors in the measuring frame."""
    T = T.copy()
    T[:, :3, 3] += way
    T[:, :3, :3] = Rotation.from_rotvec(turn).as_matrix() @ T[:, :3, :3]
    return T


def actuators(n, seed=0, spread=0.05):
    return 0.25 + spread * np.random.default_rng(seed).uniform(-1, 1, (n, 9))


def log_of(q, base=None):
    """Poses with errors in position and orientation that vary smoothly over the box."""
    way = 0.3 * (q[:, :3] - 0.25) + 0.05 * np.sin(15 * (q[:, 3:6] - 0.24))
    turn = 3.0 * (q[:, 3:6] - 0.22) + 0.3 * np.cos(15 * (q[:, 6:] - 0.25))
    T = moved(end(bha(), q), way, turn)
    return rows_of(T if base is None else base @ T)


def quadratic():
    return make_pipeline(MinMaxScaler((-1, 1)), PolynomialFeatures(2), LinearRegression())


def pose_model(error_model=None, base=None, **options):
    return HybridForwardModel(bha(base), error_model, output="pose", random_state=0, **options)


@pytest.fixture(scope="module")
def log():
    q = actuators(300)
    return q, log_of(q)


@pytest.fixture(scope="module")
def fitted(log):
    return pose_model(quadratic()).fit(*log)


def degrees(a, b):
    """Angles between the orientations of two sets of rows."""
    turn = Rotation.from_rotvec(a[:, 3:]) * Rotation.from_rotvec(b[:, 3:]).inv()
    return np.degrees(turn.magnitude())


def millimetres(a, b):
    return 1e3 * np.linalg.norm(a[:, :3] - b[:, :3], axis=1)


# ---------------------------------------------------------------- rotations


def turns(rng):
    axis = torch.nn.functional.normalize(
        torch.randn(300, 3, generator=rng, dtype=torch.float64), dim=1
    )
    angle = torch.cat([torch.logspace(-12, 0, 150), torch.linspace(1.0, math.pi, 150)]).double()
    return angle[:, None].clamp(max=math.pi) * axis


def test_exp_and_log_undo_each_other_from_zero_to_a_half_turn(rng):
    phi = torch.cat([turns(rng)[:-1], torch.zeros(1, 3, dtype=torch.float64)])
    R, _ = rotation(phi)
    assert_close(
        R, torch.from_numpy(Rotation.from_rotvec(phi.numpy()).as_matrix()), rtol=0, atol=2e-15
    )
    assert_close(rotation_vector(R), phi, rtol=1e-12, atol=1e-15)
    half = math.pi * torch.eye(3, dtype=torch.float64)
    found = rotation_vector(rotation(half)[0])
    assert (found.norm(dim=1) <= math.pi).all()
    assert_close(rotation(found)[0], rotation(half)[0], rtol=0, atol=1e-14)


@pytest.mark.parametrize("angle", [0.0, 1e-160, 1e-9, 1e-3, 1.0, 2.0, math.pi, 6.0])
def test_rotations_are_smooth(angle):
    phi = angle * torch.tensor([0.6, 0.0, -0.8], dtype=torch.float64)
    phi.requires_grad_()
    assert torch.autograd.gradcheck(lambda phi: rotation(phi), phi)
    assert torch.autograd.gradgradcheck(lambda phi: rotation(phi), phi)
    J = torch.autograd.functional.jacobian(lambda phi: rotation_vector(rotation(phi)[0]), phi)
    assert torch.isfinite(J).all()
    if angle < math.pi:  # there it jumps
        assert_close(J, torch.eye(3, dtype=torch.float64), rtol=0, atol=1e-9)


def test_left_jacobian_gives_the_angular_velocity(rng):
    phi, step = turns(rng), torch.randn(300, 3, generator=rng, dtype=torch.float64)
    h = 1e-5
    ahead, behind = rotation(phi + h * step)[0], rotation(phi - h * step)[0]
    omega = rotation_vector(ahead @ behind.mT) / (2 * h)
    assert_close((rotation(phi)[1] @ step[..., None])[..., 0], omega, rtol=0, atol=1e-8)


# ---------------------------------------------------------------- what is learned


def test_a_planted_error_is_recovered():
    """Of the orientation in metres: a radian counts as the reach."""
    q = actuators(400)
    way, turn = 0.3 * (q[:, :3] - 0.24), 3.0 * (q[:, 3:6] - 0.23)
    y = rows_of(moved(end(bha(), q), way, turn))
    model = pose_model(LinearRegression(), guard=None).fit(q, y)
    coef = np.hstack([0.3 * np.eye(3, 6), np.zeros((3, 3))])
    coef = np.vstack([coef, np.roll(10.0 * float(bha().reach) * coef, 3, axis=1)])
    assert_allclose(model.error_model_.coef_, coef, rtol=0, atol=1e-10)
    new = actuators(100, seed=1)
    expected = np.column_stack([0.3 * (new[:, :3] - 0.24), 3.0 * (new[:, 3:6] - 0.23)])
    assert_allclose(model.predict_error(new), expected, rtol=0, atol=1e-11)
    planted = moved(end(bha(), new), expected[:, :3], expected[:, 3:])
    assert_allclose(model.predict(new), rows_of(planted), rtol=0, atol=1e-11)
    assert_allclose(model.predict_mechanical(new), rows_of(end(bha(), new)), rtol=0, atol=1e-11)


def test_parts_compose_to_the_prediction(fitted, log):
    q = np.concatenate([log[0][:20], actuators(20, seed=3, spread=0.3)])
    mechanical, error = fitted.predict_mechanical(q), fitted.predict_error(q)
    turn = Rotation.from_rotvec(error[:, 3:]) * Rotation.from_rotvec(mechanical[:, 3:])
    answer = fitted.predict(q)
    assert_allclose(answer[:, :3], mechanical[:, :3] + error[:, :3], rtol=0, atol=1e-14)
    R = Rotation.from_rotvec(answer[:, 3:]).as_matrix()
    assert_allclose(R, turn.as_matrix(), rtol=0, atol=1e-12)
    learned = fitted.module_.error_part(torch.from_numpy(q)).numpy()
    expected = moved(end(bha(), q), learned[:, :3], learned[:, 3:] / float(bha().reach))
    assert_allclose(R, expected[:, :3, :3], rtol=0, atol=1e-12)


@pytest.mark.parametrize("error_model", [None, quadratic()])
def test_turning_the_measuring_frame_turns_the_answers(log, error_model):
    q, _ = log
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.5, -2.0, 1.2]).as_matrix()
    base[:3, 3] = [0.3, -0.2, 1.0]
    new = torch.from_numpy(np.concatenate([q[:20], actuators(20, seed=4, spread=0.2)]))
    modules = [
        pose_model(error_model, frame).fit(q, log_of(q, frame)).module_ for frame in (None, base)
    ]
    here, there = (module.pose(new) for module in modules)
    frame = torch.from_numpy(base)
    assert_close(there, frame @ here, rtol=0, atol=1e-9)
    here, there = (module.pose_jacobian(new) for module in modules)
    turned = torch.cat([frame[:3, :3] @ here[:, :3], frame[:3, :3] @ here[:, 3:]], dim=1)
    assert_close(there, turned, rtol=0, atol=1e-7)


def test_half_turns_do_no_harm():
    base = np.diag([1.0, -1.0, -1.0, 1.0])  # a robot that hangs
    q = actuators(300, spread=0.01)
    y = log_of(q, base)
    assert (np.linalg.norm(y[:, 3:], axis=1) > 2.4).all()
    y[::2, 3:] *= 1.0 - 2.0 * math.pi / np.linalg.norm(y[::2, 3:], axis=1)[:, None]  # the same
    model = pose_model(quadratic(), base).fit(q, y)
    answer = model.predict(q)
    assert np.isfinite(answer).all()
    assert (np.linalg.norm(answer[:, 3:], axis=1) <= math.pi).all()
    assert degrees(answer, y).max() < 0.05
    hanging = pose_model("drop", base).fit(q, y)
    assert_allclose(
        np.linalg.norm(hanging.predict(STRAIGHT.numpy())[:, 3:]), math.pi, rtol=0, atol=1e-12
    )


# ---------------------------------------------------------------- Jacobians


def cases(log):
    """Rows that are straight, bent, at the edge of the domain and far from it."""
    far = torch.from_numpy(actuators(12, seed=8, spread=0.25))
    edge = torch.from_numpy(actuators(12, seed=9, spread=0.09))
    return torch.cat([STRAIGHT, torch.from_numpy(log[0][:10]), edge, far])


@pytest.mark.parametrize("kind", ["drop", "network", "shortened", "no guard", "drifted"])
def test_pose_jacobian_is_the_derivative(log, kind):
    error_models = {"drop": "drop", "network": ELMRegressor(random_state=0)}
    guard = None if kind == "no guard" else "leverage"
    model = pose_model(error_models.get(kind, quadratic()), guard=guard).fit(*log)
    if kind == "drifted":
        model.partial_fit(log[0][:20], log[1][:20] + 0.02)
    (correction,) = model.module_.learned.corrections
    if kind == "shortened":
        correction.guard.largest *= 0.6  # some rows are then shortened where they are trusted
    module = model.module_
    q = cases(log)
    J = module.pose_jacobian(q)
    if kind in ("network", "shortened", "drifted"):
        weight = module.error_weight(q)
        assert weight.min() < 0.1
        assert ((weight > 0.1) & (weight < 0.9)).any()
    if kind == "shortened":
        long = correction.guard.is_long(correction.guard(q) * correction.module(q))
        assert (long & module.in_domain(q)).any()
    h = 1e-6
    for k in range(9):
        step = h * torch.eye(9, dtype=torch.float64)[k]
        ahead, behind = module.pose(q + step), module.pose(q - step)
        linear = (ahead[:, :3, 3] - behind[:, :3, 3]) / (2 * h)
        angular = rotation_vector(ahead[:, :3, :3] @ behind[:, :3, :3].mT) / (2 * h)
        assert_close(J[:, :, k], torch.cat([linear, angular], dim=1), rtol=0, atol=1e-6)


def test_the_guard_bounds_position_and_orientation(fitted, log, monkeypatch):
    q = actuators(3000, seed=10, spread=0.6)
    away = q[fitted.error_weight(q) < 1e-6]
    assert len(away)
    assert_allclose(fitted.predict(away), fitted.predict_mechanical(away), rtol=0, atol=1e-5)
    guard = fitted.module_.learned.corrections[0].guard
    largest = float(guard.largest)

    def longest(model):
        return float(model.fitted_module_.error_part(torch.from_numpy(q)).norm(dim=1).max())

    monkeypatch.setattr(
        type(guard), "FULL", 1e9
    )  # no error model fades out: the length alone counts
    assert longest(pose_model(quadratic(), guard=None).fit(*log)) > 10.0 * largest
    assert longest(fitted) == pytest.approx(1.5 * largest)


# ---------------------------------------------------------------- other robots


# ---------------------------------------------------------------- in use


def test_inverse_kinematics_of_the_pose(fitted):
    q = torch.from_numpy(actuators(10, seed=12, spread=0.03))
    target = fitted.module_.pose(q)
    solution = InverseKinematics(PoseTask(fitted), q_min=0.1, q_max=0.4).solve(
        target, q0=q + 0.01, tol=(1e-7, 1e-6)
    )
    assert (solution.status == IKStatus.CONVERGED).all()
    assert_close(fitted.module_.pose(solution.q), target, rtol=0, atol=1e-6)
    # The chain alone takes the same configurations to other frames.
    alone = fitted.mechanical_model_.poses(solution.q)[:, -1, :3, :3]
    assert (rotation_vector(alone @ target[:, :3, :3].mT).norm(dim=1) > 0.1).all()


def test_a_change_of_the_robot_is_followed(log):
    model = pose_model(quadratic()).fit(*log)
    base = np.eye(4)
    base[:3, :3] = Rotation.from_rotvec([0.0, 0.05, 0.0]).as_matrix()
    new, unseen = actuators(200, seed=13), actuators(50, seed=14)
    y = log_of(unseen, base)
    stale = model.predict(unseen)
    model.partial_fit(new, log_of(new, base), decay=1.0, alpha=1e-3)
    followed = model.predict(unseen)
    assert millimetres(followed, y).mean() < 0.2 * millimetres(stale, y).mean()
    assert degrees(followed, y).mean() < 0.2 * degrees(stale, y).mean()


class TipOnly(torch.nn.Module):
    def forward(self, q):
        return q[..., :3]


@pytest.mark.parametrize(
    ("options", "kind"),
    [
        ({"output": "frame"}, ValueError),
        ({"mechanical_model": TipOnly()}, TypeError),
        ({"mechanical_model": None}, TypeError),
        ({"coupling": "serial"}, ValueError),
        ({"error_model": "quadratic"}, ValueError),
        ({"coverage": 0.9}, ValueError),
    ],
)
def test_errors_name_the_way_out(log, options, kind):
    with pytest.raises(kind, match="pose"):
        pose_model().set_params(**options).fit(*log)
