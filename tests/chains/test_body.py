"""The body of every chain: its points `with_tip`, its lengths, its radii."""

import pickle

import numpy as np
import pytest
import torch
from mechanical_models import CHAINS as SAVED
from mechanical_models import TENDONS
from saved_models import arm, bent_chain, structural_chain
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    ForceTendonChain,
    InverseKinematics,
    RigidChain,
    as_forward_model,
    load_model,
    save_model,
)
from hybridkin._core.model import Moved, Shifted
from hybridkin.ik.tasks import PointsTask
from hybridkin.native.library import evaluate, program_of

MOTION = torch.eye(4, dtype=torch.float64)
MOTION[:3, :3] = torch.tensor([[0.0, -0.6, 0.8], [1.0, 0.0, 0.0], [0.0, 0.8, 0.6]])
MOTION[:3, 3] = torch.tensor([0.3, 0.1, -0.2])
SHIFT = torch.linspace(-1e-3, 1e-3, 7, dtype=torch.float64)
COUPLED = arm(couplings=[[1.0, 0.0, 0.5], [0.2, 1.0, 0.0], [0.0, -0.5, 2.0]], joint_zeros=0.1)
FORCES = ForceTendonChain(
    [0.01, 0.009], [0.2, 0.1], 0.02, 50.0, weight=0.3, offsets=[0.01, 0.02], arcs=3
)
CHAINS = {
    **SAVED,
    "forces": (FORCES, np.linspace(0.0, 2.0, 18).reshape(3, 6)),
    "structure": (structural_chain(bent_chain()), TENDONS),
    "shifted": (Shifted(bent_chain(), SHIFT), TENDONS),
    "moved": (Moved(structural_chain(bent_chain()), MOTION), TENDONS),
    "coupled": (COUPLED, np.linspace(-1.0, 1.0, 9).reshape(3, 3)),
}
ARMS = ("arm", "coupled")
IN_TORCH = ("rotation", "forces")  # chains without kernels


@pytest.fixture(params=CHAINS)
def name(request):
    return request.param


@pytest.fixture
def model(name):
    return CHAINS[name][0]


@pytest.fixture
def q(name):
    return torch.tensor(CHAINS[name][1], dtype=torch.float64)


def places_of(model):
    """Return places within and at the end of every segment."""
    S = len(model.body_radii)
    return [k + part for k in range(S) for part in (0.3, 1.0)]


def test_the_end_of_the_body_is_the_tip(name, model, q):
    whole = bent_chain() if name == "tip" else model.tip_model
    end = model.with_tip(len(model.body_radii))
    both = zip(end.forward_and_jacobian(q), whole.forward_and_jacobian(q), strict=True)
    for part, expected in both:
        assert_close(part, expected, rtol=1e-14, atol=1e-15)
    assert end.n_actuators == model.n_actuators


def test_derivatives_of_all_points(model, q):
    for at in places_of(model):
        point = model.with_tip(at)
        x, J = point.forward_and_jacobian(q)
        assert_close(point(q), x)
        expected = torch.stack([torch.func.jacrev(point)(row) for row in q])
        assert_close(J, expected, rtol=1e-8, atol=1e-9)
        single = point(q.float())
        assert single.dtype == torch.float32
        assert_close(single.double(), x, rtol=0.0, atol=2e-5)


def test_points_follow_each_other_without_a_jump(name, model, q):
    """Behind the end of a segment; before it there may be a rigid offset of a chain of arcs."""
    for k in range(1, len(model.body_radii)):
        at_end = model.with_tip(k)(q)
        assert_close(model.with_tip(k + 1e-9)(q), at_end, rtol=0.0, atol=1e-8)
        if name in ARMS:
            assert_close(model.with_tip(k - 1e-9)(q), at_end, rtol=0.0, atol=1e-8)


@pytest.mark.needs_core
def test_the_compiled_core_has_all_points(name, model, q):
    for at in places_of(model):
        point = model.with_tip(at)
        assert (program_of(point) is None) == (name in IN_TORCH)
        if name in IN_TORCH:
            continue
        x, J = point.forward_and_jacobian(q)
        found, slope = evaluate(point, q.numpy(), jacobian=True)
        assert_close(torch.from_numpy(found), x, rtol=1e-11, atol=1e-13)
        assert_close(torch.from_numpy(slope), J, rtol=1e-9, atol=1e-10)


def test_files_and_pickles_keep_the_point(model, q, tmp_path):
    for at in places_of(model):
        point = model.with_tip(at)
        save_model(point, tmp_path / "point.safetensors")
        for twin in (load_model(tmp_path / "point.safetensors"), pickle.loads(pickle.dumps(point))):
            assert_close(twin(q), point(q), rtol=0.0, atol=0.0)
            assert_close(twin.body_lengths(q), model.body_lengths(q), rtol=0.0, atol=0.0)


def test_lengths_are_those_of_the_line_through_many_points(model, q):
    lengths = model.body_lengths(q)
    S = len(model.body_radii)
    assert lengths.shape == (len(q), S + 1)
    assert (lengths[:, 0] == 0.0).all()
    parts = np.linspace(0.0, 1.0, 31)
    parts[0] = 1e-12
    for k in range(S):
        points = torch.stack([model.with_tip(k + part)(q) for part in parts], dim=1)
        line = points.diff(dim=1).norm(dim=-1).sum(1)
        assert_close(line, lengths[:, k + 1] - lengths[:, k], rtol=1e-3, atol=1e-9)
    assert_close(model.body_lengths(q[0]), lengths[0])


def test_a_straight_robot_is_as_long_as_its_points_are_far():
    counts = [3, 4]
    chain = ConstantCurvatureChain(
        [0.01, 0.02], n_actuators=counts, lengths=[0.1, 0.2], offsets=[0.03, 0.04], base=MOTION
    )
    q = torch.zeros(7, dtype=torch.float64)
    points = torch.stack([chain.with_tip(at)(q) for at in (1, 2)])
    far = (points - MOTION[:3, 3]).norm(dim=1)
    assert_close(chain.body_lengths(q)[1:], far)
    assert_close(far, far.new_tensor([0.13, 0.37]))
    elastic = ElasticTendonChain([0.01], [0.1], offsets=[0.02])
    assert_close(elastic.body_lengths(q[:3]), q.new_tensor([0.0, 0.12]))


def test_lengths_of_chambers_are_those_of_their_actuators():
    chain = ConstantCurvatureChain([0.05, 0.04])
    q = torch.tensor([0.2, 0.21, 0.22, 0.1, 0.1, 0.1], dtype=torch.float64)
    assert_close(chain.body_lengths(q), q.new_tensor([0.0, 0.21, 0.31]))


def test_a_rotation_stage_has_no_length():
    chain, rows = CHAINS["rotation"]
    q = torch.tensor(rows, dtype=torch.float64)
    lengths = chain.body_lengths(q)
    assert_close(lengths[:, :2], torch.zeros_like(lengths[:, :2]))
    assert_close(lengths[:, 2], torch.full_like(q[:, 0], 0.1))


def test_lengths_of_an_arm_lead_from_joint_to_joint():
    """The second joint slides along (1, 0, 2), and is followed by 0.2 m along x."""
    q = torch.tensor([0.7, 0.1, -0.3], dtype=torch.float64)
    slid = 0.1 / 5.0**0.5
    second = ((0.2 + slid) ** 2 + (2.0 * slid) ** 2) ** 0.5
    links = q.new_tensor([0.0, 0.3, second, np.hypot(0.1, 0.02)])
    assert_close(arm().body_lengths(q), links.cumsum(0))
    points = torch.stack([arm().with_tip(at)(q) for at in (1e-12, 1.0, 2.0, 3.0)])
    assert_close(points.diff(dim=0).norm(dim=1), links[1:])


def test_a_point_of_an_arm_in_closed_form():
    origins = np.stack([np.eye(4)] * 3)
    origins[1:, 0, 3] = 0.3, 0.2
    planar = RigidChain(origins, [[0, 0, 1]] * 3, tool=[0.1, 0.0, 0.0])
    q = torch.tensor([0.5, -0.7, 1.9], dtype=torch.float64)
    point = planar.with_tip(1.25)
    first, second = q[0], q[0] + q[1]
    expected = [0.3 * first.cos() + 0.05 * second.cos(), 0.3 * first.sin() + 0.05 * second.sin()]
    assert_close(point(q), torch.stack([*expected, q.new_zeros(())]))
    assert_close(point.jacobian(q)[:, 2], q.new_zeros(3))
    assert_close(point.pose(q)[:2, 0], torch.stack([second.cos(), second.sin()]))
    assert_close(point.pose_and_jacobian(q)[1][5], q.new_tensor([1.0, 1.0, 0.0]))
    # All else is that of the whole arm.
    assert_close(point.backbone(q), planar.backbone(q))
    assert_close(point.poses(q), planar.poses(q))
    assert_close(point.with_tip(3.0)(q), planar(q))
    assert point.unit_of_q == planar.unit_of_q
    assert point.turns.tolist() == planar.turns.tolist()


@pytest.mark.parametrize("given", [np.asarray, torch.from_numpy])
def test_points_of_an_arm_are_steered(given):
    """The point on the second link moves with two joints, the tip with all three."""
    task = PointsTask(arm(), [1.5, 3.0])
    q = np.array([0.4, 0.2, -0.6])
    targets = np.stack([arm().with_tip(at)(torch.from_numpy(q)).numpy() for at in (1.5, 3.0)])
    solution = InverseKinematics(task).solve(given(targets), q0=given(np.array([0.0, 0.1, 0.0])))
    assert solution.converged
    assert_close(torch.as_tensor(solution.q), torch.from_numpy(q), rtol=0.0, atol=1e-3)


def test_the_body_moves_with_the_base(model, q):
    moved = model.moved(MOTION)
    assert_close(moved.body_lengths(q), model.body_lengths(q))
    assert_close(moved.body_radii, model.body_radii)
    for at in places_of(model):
        turned = model.with_tip(at)(q) @ MOTION[:3, :3].mT + MOTION[:3, 3]
        assert_close(moved.with_tip(at)(q), turned)


def test_the_body_follows_shifted_zeros(model, q):
    shift = 1e-3 * torch.linspace(0.5, 1.0, model.n_actuators, dtype=torch.float64)
    shifted = model.shifted(shift)
    assert_close(shifted.body_lengths(q), model.body_lengths(q + shift))
    for at in places_of(model):
        assert_close(shifted.with_tip(at)(q), model.with_tip(at)(q + shift))


def test_radii_are_those_of_all_actuators_in_a_segment():
    radii = [0.01, 0.03, 0.02]
    for routing, expected in (("segment", radii), ("base", [0.03, 0.03, 0.02])):
        chain = ConstantCurvatureChain(radii, lengths=[0.1] * 3, routing=routing)
        assert_close(chain.body_radii, torch.tensor(expected, dtype=torch.float64))
    assert arm().body_radii.tolist() == [np.inf] * 3


@pytest.mark.parametrize("at", [0.0, 3.1, -1.0, float("nan")])
def test_a_place_off_the_arm_is_refused(at):
    with pytest.raises(ValueError, match=r"`at` must lie in \(0, 3\]"):
        arm().with_tip(at)


def test_a_function_has_no_body():
    model = as_forward_model(lambda q: q)
    q = torch.zeros(3, dtype=torch.float64)
    for ask in (lambda: model.with_tip(1.0), lambda: model.body_lengths(q)):
        with pytest.raises(TypeError, match=r"`chain` must have .*FunctionModel; pass the chain"):
            ask()
    with pytest.raises(TypeError, match="`chain` must have body_radii"):
        _ = model.body_radii


def test_points_after_a_length_lie_on_arcs_and_on_tools():
    """A straight robot with rigid offsets: every point is as high as it is far along the body."""
    chain = ConstantCurvatureChain(
        [0.01, 0.01], lengths=[0.1, 0.2], offsets=[0.05, 0.15], routing="base"
    )
    q = torch.zeros(6, dtype=torch.float64)
    for length in (1e-3, 0.05, 0.1, 0.12, 0.15, 0.2, 0.35, 0.4, 0.5):
        tip = chain.at_length(length, q)(q)
        torch.testing.assert_close(tip, torch.tensor([0.0, 0.0, length], dtype=torch.float64))
    bent = torch.tensor([0.01, -0.005, -0.005, 0.0, 0.0, 0.0], dtype=torch.float64)
    on_tool = chain.at_length(0.4, q).pose(bent)
    end = chain.pose(bent)
    torch.testing.assert_close(on_tool[:3, 3], end[:3, 3] - 0.1 * end[:3, 2])
