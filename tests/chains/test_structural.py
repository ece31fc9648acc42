"""Chains of arcs with errors of their structure."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from mechanical_models import ROTATION, STAGE
from saved_models import arm, bent_chain, elastic_chain, structural_chain
from torch.autograd import gradcheck, gradgradcheck
from torch.testing import assert_close

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    HybridForwardModel,
    InverseKinematics,
    jacobian,
    load_model,
    native,
    save_model,
)
from hybridkin._core.plan import NoKernel, Plan
from hybridkin.chains.structural import Loads, StructuralChain, Weights, change_of
from hybridkin.hybrid._adapt import Change
from hybridkin.hybrid._features import PoseFeatures, QuadraticFeatures, Readout
from hybridkin.hybrid._module import HybridModule, InnerCorrection, TipCorrection
from hybridkin.hybrid._wrapped import Stacked
from hybridkin.ik.tasks import PointsTask
from hybridkin.native.library import Program
from hybridkin.plots.models import body_of

KINDS = ("extensible", "inextensible", "mixed", "elastic")


def turned(rng):
    """Return a random pose (4, 4)."""
    pose = np.eye(4)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    pose[:3, :3] = turn * np.linalg.det(turn)
    pose[:3, 3] = rng.normal(0.0, 0.1, 3)
    return pose


def chain_of(kind, S, rng, base=None):
    """Return a chain of S segments, the mean lengths (S,), and q (n,) of the straight robot."""
    lengths = rng.uniform(0.08, 0.12, S)
    options = {"offsets": rng.uniform(0.0, 0.02, S), "rest_bends": rng.normal(0.0, 0.1, (S, 2))}
    options["base"] = turned(rng) if base is None else base
    given = lengths.tolist()
    if kind == "elastic":
        options |= {"axial_stiffness": 0.1, "bending_stiffness": 1e-4, "routing": "base"}
        return ElasticTendonChain([0.02] * S, lengths, **options), lengths, np.zeros(3 * S)
    if kind == "extensible":
        given = [None] * S
    if kind == "mixed":
        given[1::2] = [None] * (S // 2)
    straight = [length * (own is None) for length, own in zip(lengths, given, strict=True)]
    if kind == "extensible":
        given = None
    chain = ConstantCurvatureChain([0.02] * S, lengths=given, **options)
    return chain, lengths, np.repeat(straight, 3)


def errors_of(S, rng, size=0.05):
    shapes = (3,), (3, 3), (3,), (3,)
    return Weights(*[torch.from_numpy(rng.normal(0.0, size, (S, *shape))) for shape in shapes])


def structural(chain, lengths, rng, size=0.05, motion=None):
    motion = turned(rng) if motion is None else motion
    weights = errors_of(len(lengths), rng, size)
    return StructuralChain(
        chain, torch.tensor(lengths), *weights, torch.as_tensor(motion, dtype=torch.float64)
    )


def drawn(kind, S, seed=0, n_rows=12):
    """Return a chain with errors of its structure, and rows q (N, n) that bend it far."""
    rng = np.random.default_rng(seed)
    chain, lengths, straight = chain_of(kind, S, rng)
    q = straight + rng.uniform(-0.015, 0.015, (n_rows, len(straight)))
    return structural(chain, lengths, rng), torch.from_numpy(q)


def straight_pair(*rows, l0=0.1, l1=0.2):
    """Return an extensible chain of two arcs, its mean lengths, and q for bends (2, 2) of them."""
    chain = ConstantCurvatureChain([0.02, 0.02])
    angles = chain.angles.reshape(2, 3)
    q = []
    for length, angle, (x, y) in zip((l0, l1), angles, rows, strict=True):
        q.append(length - 0.02 * (x * torch.cos(angle) + y * torch.sin(angle)))
    return chain, torch.tensor([l0, l1], dtype=torch.float64), torch.cat(q)


def of_one(S, **entries):
    """Return weights that are zero but for the entries given, name=(place, value)."""
    weights = Weights(*[torch.zeros_like(entry) for entry in errors_of(S, np.random.default_rng())])
    for name, (place, value) in entries.items():
        getattr(weights, name)[place] = value
    return weights


def still():
    return torch.eye(4, dtype=torch.float64)


@pytest.mark.parametrize("kind", KINDS)
def test_without_errors_it_is_the_chain(kind):
    g, q = drawn(kind, 3)
    plain = StructuralChain(g.chain, g.lengths, *of_one(3), still())
    expected = g.chain.forward_and_jacobian(q)
    for found, right in zip(plain.forward_and_jacobian(q), expected, strict=True):
        assert_close(found, right, rtol=0, atol=1e-13)


def test_a_constant_strain_lengthens_a_segment():
    chain, lengths, q = straight_pair((0.0, 0.0), (0.0, 0.0))
    g = StructuralChain(chain, lengths, *of_one(2, zeros=((1, 0), 0.1)), still())
    assert_close(g(q), lengths.new_tensor([0.0, 0.0, 0.32]), rtol=0, atol=1e-15)


def test_a_load_twists_a_segment_by_its_torque():
    """The second segment is a quarter circle of the radius r: the load along y has the lever r."""
    quarter = np.pi / 2
    chain, lengths, q = straight_pair((0.0, 0.0), (quarter, 0.0))
    g = StructuralChain(chain, lengths, *of_one(2, twists=((0, 1), 0.3)), still())
    angle = 0.3 * (0.2 / quarter) / 0.3  # r over the length of the robot, times the weight
    _, _, bent = straight_pair((0.0, 0.0), (quarter, quarter * angle))
    assert_close(g(q), chain(bent), rtol=0, atol=1e-14)


def test_half_of_its_twist_turns_a_bend_of_its_own():
    quarter = np.pi / 2
    chain, lengths, q = straight_pair((quarter, 0.0), (0.0, 0.0))
    g = StructuralChain(chain, lengths, *of_one(2, twists=((0, 1), 0.3)), still())
    # At the base the lever is (r + l, r) and the tangent z; at the end of the arc both are along x.
    angle = 0.5 * 0.3 * 0.5 * (0.1 / quarter + 0.2) / 0.3
    _, _, bent = straight_pair((quarter, quarter * angle), (0.0, 0.0))
    assert_close(g(q), chain(bent), rtol=0, atol=1e-14)


def test_the_next_segment_bends_back_what_sags():
    chain, lengths, q = straight_pair((0.0, 0.0), (0.0, 0.0), l0=0.11)
    lengths[0] = 0.1  # a strain of a tenth
    g = StructuralChain(chain, lengths, *of_one(2, sags=((0, 0), 0.2)), still())
    _, _, bent = straight_pair((0.24, 0.0), (-0.24, 0.0), l0=0.11)
    assert_close(g(q), chain(bent), rtol=0, atol=1e-14)


def test_the_change_is_linear_in_the_weights():
    g, q = drawn("mixed", 3)
    rng = np.random.default_rng(1)
    one, other = errors_of(3, rng), errors_of(3, rng)
    both = Weights(*[2.0 * a - 3.0 * b for a, b in zip(one, other, strict=True)])
    frames = g.chain.frames_and_moves(q)
    loads = Loads.of(frames, g.lengths)
    changes = [change_of(loads, frames.arcs, g.lengths, w) for w in (one, other, both)]
    assert_close(changes[2], 2.0 * changes[0] - 3.0 * changes[1], rtol=0, atol=1e-14)


def test_loads_are_along_the_axes_of_the_base():
    """Where the base is turned and moved, so are the tips, and no error changes."""
    rng = np.random.default_rng(2)
    base = turned(rng)
    tips = []
    for pose in (np.eye(4), base):
        chain, lengths, straight = chain_of("extensible", 3, np.random.default_rng(0), pose)
        g = structural(chain, lengths, np.random.default_rng(1), motion=np.eye(4))
        tips.append(g(torch.from_numpy(straight - 0.01 * np.sin(np.arange(9.0)))))
    pose = torch.from_numpy(base)
    assert_close(pose[:3, :3] @ tips[0] + pose[:3, 3], tips[1], rtol=0, atol=1e-14)


def test_weights_have_natural_units():
    """Of a robot twice as large, tips are twice as far away."""
    size = 2.0
    tips = []
    for factor in (1.0, size):
        chain = ConstantCurvatureChain([0.02 * factor, 0.03 * factor], offsets=0.01 * factor)
        lengths = factor * np.array([0.1, 0.12])
        g = structural(chain, lengths, np.random.default_rng(0), motion=np.eye(4))
        q = factor * (0.1 + 0.01 * np.sin(np.arange(6.0)))
        tips.append(g(torch.from_numpy(q)))
    assert_close(size * tips[0], tips[1], rtol=0, atol=1e-14)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("S", "tip"), [(1, 1.0), (3, 3.0), (3, 1.5), (4, 2.0)])
def test_the_jacobian_is_that_of_autograd_and_of_differences(kind, S, tip):
    g, q = drawn(kind, S)
    g = g.with_tip(tip)
    x, J = g.forward_and_jacobian(q)
    assert_close(g(q), x, rtol=0, atol=1e-14)
    assert_close(J, jacobian(lambda rows: g(rows), q), rtol=0, atol=1e-11)
    steps = 1e-6 * torch.eye(q.shape[1], dtype=q.dtype)
    differences = (g(q[:, None] + steps) - g(q[:, None] - steps)).mT / 2e-6
    if kind != "elastic":  # whose tendons may become slack on the way
        assert_close(J, differences, rtol=0, atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["inextensible", "mixed"])
def test_derivatives_of_derivatives(kind):
    g, rows = drawn(kind, 2, n_rows=2)
    straight = rows.new_tensor(chain_of(kind, 2, np.random.default_rng(0))[2])
    tiny = straight + 1e-9 * torch.sin(torch.arange(6.0))
    for q in (straight, tiny, rows[0]):
        leaf = q[None].clone().requires_grad_()
        assert gradcheck(g, (leaf,))
        assert gradcheck(g.jacobian, (leaf,), atol=1e-4, fast_mode=True)
        assert gradgradcheck(g, (leaf,), atol=1e-4, fast_mode=True)


def test_a_batch_is_its_rows():
    g, q = drawn("extensible", 3)
    x, J = g.forward_and_jacobian(q.reshape(3, 4, 9))
    assert x.shape == (3, 4, 3)
    for k, row in enumerate(q):
        x_row, J_row = g.forward_and_jacobian(row)
        assert_close(x.reshape(-1, 3)[k], x_row, rtol=0, atol=1e-14)
        assert_close(J.reshape(-1, 3, 9)[k], J_row, rtol=0, atol=1e-13)
    assert g(q[:0]).shape == (0, 3)
    with pytest.raises(ValueError, match=r"`q` must have shape \(..., 9\)"):
        g(q[:, :8])


@pytest.mark.parametrize("kind", KINDS)
def test_single_precision(kind):
    g, q = drawn(kind, 3)
    x, J = g.forward_and_jacobian(q)
    assert g(q.float()).dtype == torch.float32
    assert_close(g(q.float()).double(), x, rtol=0, atol=1e-5)
    single = g.float()
    x_single, J_single = single.forward_and_jacobian(q.float())
    assert x_single.dtype == J_single.dtype == torch.float32
    assert_close(x_single.double(), x, rtol=0, atol=1e-5)
    assert_close(J_single.double(), J, rtol=0, atol=2e-4 * float(J.abs().max()))


@pytest.mark.parametrize("chain", [STAGE, ROTATION])
def test_a_segment_of_no_length_has_no_strain(chain):
    rng = np.random.default_rng(0)
    first = 0.0 if chain is ROTATION else 0.1
    g = structural(chain, np.array([first, 0.1]), rng)
    q = torch.tensor([[0.1, 0.01, 0.002, -0.01], [0.12, 0.0, 0.0, 0.0]]).double()
    x, J = g.forward_and_jacobian(q)
    assert x.isfinite().all()
    assert_close(J, jacobian(lambda rows: g(rows), q), rtol=0, atol=1e-12)
    if chain is ROTATION:
        with pytest.raises(NoKernel, match="rotation stage"):
            Plan(g.stored())


@pytest.mark.needs_core
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("S", [1, 2, 3, 5])
def test_the_core_computes_the_same(kind, S):
    """Of blocks and of single rows, with partial tips; relative to the robot and to J."""
    for seed, tip in enumerate((S, 0.5, S - 0.3, max(S - 1, 0.7))):
        g, q = drawn(kind, S, seed)
        check_core(g.with_tip(tip), q)


@pytest.mark.needs_core
def test_the_largest_robot():
    g, q = drawn("extensible", 16, n_rows=3)
    check_core(g, q, tol=1e-11)  # more arcs, more rounding


def check_core(model, q, tol=1e-12):
    program = Program(Plan(model.stored()))
    for rows in (q, q[0], q[-1]):
        with torch.no_grad():
            expected = model.forward_and_jacobian(rows)
        found = program.evaluate(rows.numpy(), jacobian=True)
        (alone,) = program.evaluate(rows.numpy())
        np.testing.assert_array_equal(alone, found[0])
        for array, right in zip(found, expected, strict=True):
            size = max(0.1, float(right.nan_to_num().abs().max()))
            np.testing.assert_allclose(array, right.numpy(), rtol=0, atol=tol * size)


def corrections(chain, q, inside):
    """Return corrections by quadratic and pose features, inside or at the tip."""
    rng = np.random.default_rng(5)
    kind = InnerCorrection if inside else TipCorrection
    m = len(chain.coordinates(q)[0][0]) if inside else 3
    found = []
    for features in (QuadraticFeatures.of_range(q), PoseFeatures.of_range(q, chain)):
        n_weights = features(q[:1]).shape[1]
        weights = torch.from_numpy(rng.normal(0.0, 2e-3, (m, n_weights)))
        found.append(kind(Readout(features, weights)))
    return found


def hybrids(g, q):
    """Return hybrids on a chain with errors of its structure."""
    half = torch.tensor([0.5, 0.5]).double()
    inner, tip = (corrections(g.robot, q, inside) for inside in (True, False))
    return {
        "alone": HybridModule(g, [], half[:0]),
        "inside": HybridModule(g, inner, half),
        "at the tip": HybridModule(g, tip, half),
        "both": HybridModule(g, [inner[0], tip[1]], half),
    }


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_hybrids_of_it(kind):
    g, q = drawn(kind, 3, n_rows=4)
    g = g.with_tip(2.5)
    for name, hybrid in hybrids(g, q).items():
        assert hybrid.robot is g.chain
        assert hybrid.corrects_inside is True
        x, J = hybrid.forward_and_jacobian(q)
        assert_close(hybrid(q), x, rtol=0, atol=1e-13)
        assert_close(J, jacobian(lambda rows, h=hybrid: h(rows), q), rtol=0, atol=1e-10, msg=name)
        if name == "alone":
            assert_close(x, g(q), rtol=0, atol=0)
        if native.available():
            check_core(hybrid, q)


def test_markers_stand_side_by_side():
    g, q = drawn("mixed", 3)
    many = g._around(g.chain.with_markers([(0, 0.5), (1, 1.0, (0.0, 0.0, 0.01)), (2, 1.0)]))
    x, J = many.forward_and_jacobian(q)
    for k, tip in enumerate(many.each_tip()):
        at = slice(3 * k, 3 * k + 3)
        assert_close(x[:, at], tip(q), rtol=0, atol=1e-14)
        assert_close(J[:, at], tip.jacobian(q), rtol=0, atol=1e-13)
    assert_close(many.tip_model(q), g(q), rtol=0, atol=0)
    none = torch.zeros(0).double()
    stacked = Stacked(None, [HybridModule(tip, [], none) for tip in many.each_tip()])
    assert_close(stacked.mechanical(q), x, rtol=0, atol=1e-14)
    assert stacked.robot.markers == many.markers
    assert_close(stacked.forward_and_jacobian(q)[1], J, rtol=0, atol=1e-13)
    if native.available():
        check_core(many, q)
        check_core(stacked, q)
    beside = g._around(g.chain.with_markers([(2, 1.0, (0.01, 0.0, 0.0))]))
    assert_close(beside.jacobian(q), jacobian(lambda rows: beside(rows), q), rtol=0, atol=1e-11)
    with pytest.raises(NoKernel, match="beside the backbone"):
        Plan(beside.stored())


def test_a_robot_that_has_changed():
    """Its base has moved, its zeros have shifted; the errors of its structure stay."""
    g, q = drawn("extensible", 2)
    rng = np.random.default_rng(3)
    change = Change(rng.normal(0.0, 1e-3, 6), turned(rng))
    hybrid = hybrids(g, q)["inside"]
    after = change.after(hybrid)
    motion = torch.from_numpy(change.motion)
    x = hybrid(q + torch.from_numpy(change.shift)) @ motion[:3, :3].T + motion[:3, 3]
    assert_close(after(q), x, rtol=0, atol=1e-13)
    assert_close(after.robot(q), change.after(g.chain)(q), rtol=0, atol=1e-13)
    if native.available():
        check_core(after, q)


@pytest.mark.slow
def test_inverse_kinematics_reaches_its_tips():
    g, q = drawn("extensible", 3)
    ik = InverseKinematics(hybrids(g, q)["inside"], q_min=0.05, q_max=0.15)
    tracker = ik.tracker(q[0].numpy())
    target = tracker.x + np.array([0.004, -0.003, 0.002])
    for _ in range(30):
        tracker.step(target)
    np.testing.assert_allclose(tracker.x, target, rtol=0, atol=1e-6)
    points = InverseKinematics(PointsTask(g, [1.5, 3.0]), q_min=0.05, q_max=0.15)
    targets = torch.stack([g.with_tip(1.5)(q[1]), g(q[1])])
    assert points.solve(targets, q[2]).converged


def fitted_on(g, q):
    """Return a hybrid estimator whose module stands on a chain with errors of its structure."""
    x = g(q).numpy()
    model = HybridForwardModel(g.chain, "drop").fit(q.numpy(), x)
    module = HybridModule(g, [], torch.zeros(0).double())
    model._fit = replace(model._fit, module=module)
    model._follow_robot()
    return model


def test_an_estimator_has_the_plain_chain_and_is_drawn_up_to_its_tip(tmp_path):
    rng = np.random.default_rng(0)
    chain, lengths, straight = chain_of("extensible", 3, rng)
    q = torch.from_numpy(straight + rng.uniform(-0.01, 0.01, (30, 9)))
    g = structural(chain, lengths, rng, size=0.01, motion=np.eye(4))  # within reach of the chain
    model = fitted_on(g, q)
    assert model.mechanical_model_ is g.chain
    x = g(q).numpy()
    np.testing.assert_allclose(model.predict(q.numpy()), x, rtol=0, atol=1e-13)
    body = body_of(model, q[:4].numpy(), 5)
    np.testing.assert_allclose(body["points"][:, -1], x[:4], rtol=0, atol=1e-6)
    save_model(model, tmp_path / "model")
    twin = load_model(tmp_path / "model")
    np.testing.assert_allclose(twin.predict(q.numpy()), x, rtol=0, atol=1e-13)
    assert isinstance(twin.fitted_module_.mechanical, StructuralChain)


def test_files_keep_it(tmp_path):
    for chain in (bent_chain(), elastic_chain().with_tip(1.5)):
        g = structural_chain(chain)
        save_model(g, tmp_path / "model")
        twin = load_model(tmp_path / "model")
        q = torch.linspace(-0.002, 0.002, 21).double().reshape(3, 7)
        assert_close(twin.jacobian(q), g.jacobian(q), rtol=0, atol=1e-13)
        for name, entry in g.state_dict().items():
            assert_close(twin.state_dict()[name], entry, rtol=0, atol=0)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("lengths", np.zeros(2), "must hold the lengths of 2 arcs"),
        ("lengths", np.array([0.1, -0.1]), "must hold the lengths of 2 arcs"),
        ("lengths", np.full(2, np.nan), "must be finite"),
        ("maps", np.zeros((2, 3)), "maps"),
        ("zeros", np.zeros((3, 3)), "zeros"),
        ("twists", np.full((2, 3), np.inf), "must be finite"),
        ("motion", np.ones((4, 4)), "must hold a rotation"),
    ],
)
def test_files_with_other_numbers_are_refused(name, value, message):
    stored = structural_chain(bent_chain()).stored()
    stored.arrays[name] = value
    with pytest.raises(ValueError, match=message):
        StructuralChain.from_stored(stored, lambda part: bent_chain())


def test_files_with_other_chains_are_refused():
    stored = structural_chain(bent_chain()).stored()
    with pytest.raises(ValueError, match="must be a chain of arcs, got RigidChain"):
        StructuralChain.from_stored(stored, lambda part: arm())
    with pytest.raises(ValueError, match="must hold the lengths of 1 arcs"):
        StructuralChain.from_stored(stored, lambda part: ConstantCurvatureChain([0.02]))
