import copy
import math
import pickle

import joblib
import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain
from hybridkin._core.model import reverse_jacobian
from hybridkin._core.stumpff import next_stumpff, stumpff
from hybridkin.chains._arcs import transforms

RADII = [0.100, 0.093, 0.079]
THREE = 2 * math.pi / 3 * torch.arange(3, dtype=torch.float64)
STRAIGHT = torch.full((9,), 0.25, dtype=torch.float64)


def bha(**options):
    return ConstantCurvatureChain(RADII, **options)


def tendons(routing="base", **options):
    options = {"offsets": [0.002, 0.003, 0.01], **options}
    return ConstantCurvatureChain(
        [0.0045, 0.005, 0.004], lengths=[0.06, 0.0625, 0.064], routing=routing, **options
    )


def random_q(rng, n=20, size=9, center=0.25, width=0.06):
    return center + width * (2 * torch.rand(n, size, generator=rng, dtype=torch.float64) - 1)


def rotation_z(angle):
    c, s = math.cos(angle), math.sin(angle)
    return torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)


def pose(rotation, position):
    matrix = torch.eye(4, dtype=torch.float64)
    matrix[:3, :3], matrix[:3, 3] = rotation, torch.as_tensor(position, dtype=torch.float64)
    return matrix


CHAINS = {
    "chambers": (bha(offsets=[0.01, 0.0, 0.05]), 0.25, 0.06),
    "tendons, own segment": (tendons("segment"), 0.0, 0.005),
    "tendons, through": (tendons("base"), 0.0, 0.005),
    "mixed": (
        ConstantCurvatureChain(
            [0.1, 0.08],
            n_actuators=[4, 3],
            routing="base",
            base=pose(rotation_z(0.7), [0.1, 0.2, 0.3]),
        ),
        0.25,
        0.06,
    ),
    "pre-curved": (
        tendons(
            rest_bends=[[0.2, -0.1], [0.0, 0.3], [-0.4, 0.0]],
            actuator_zeros=1e-4 * np.arange(9),
        ),
        0.0,
        0.005,
    ),
    "pairs": (
        ConstantCurvatureChain(
            [0.1, 0.08, 0.09],
            n_actuators=[2, 3, 2],
            angles=[[0.4, 0.4 + math.pi], [0.0, 2.0, 4.0], [1.9, 1.9 + math.pi]],
            routing="base",
            rest_bends=[[0.2, -0.1], [0.0, 0.3], [-0.4, 0.0]],
            offsets=0.01,
        ),
        0.25,
        0.06,
    ),
    "on a rotating and moving stage": (
        ConstantCurvatureChain(
            [0.1, 0.1, 0.1, 0.08],
            n_actuators=[1, 1, 3, 2],
            lengths=[None, None, 0.2, 0.3],
            routing="base",
            offsets=[0.1, 0.0, 0.02, 0.0],
            stage="rotation",
            base=pose(rotation_z(0.7), [0.1, 0.2, 0.3]),
        ),
        0.25,
        0.06,
    ),
}
each_chain = pytest.mark.parametrize(("chain", "center", "width"), CHAINS.values(), ids=CHAINS)


SWITCH = 1.0  # [rad], where trigonometry takes over from the series
BESIDE_SWITCH = [math.nextafter(SWITCH, 0.0), math.nextafter(SWITCH, 2.0)]


@pytest.mark.parametrize(
    "theta",
    [0.0, 1e-12, 1e-4, 0.5, SWITCH, 2.0, math.pi, 4.0, 2 * math.pi, *BESIDE_SWITCH, 12.0, 1e3],
)
def test_stumpff_functions_against_mpmath(theta):
    s = torch.tensor(theta**2, dtype=torch.float64)
    with mpmath.workdps(120):
        exact = mpmath.mpf(s.item())

        angle = mpmath.sqrt(exact) or mpmath.mpf("1e-30")  # right to 60 digits at zero, too
        c, f = mpmath.cos(angle), mpmath.sin(angle) / angle
        g = (1 - c) / angle**2 if exact else mpmath.mpf("0.5")
        c3 = (1 - f) / angle**2 if exact else mpmath.mpf(1) / 6
        c4 = (0.5 - g) / angle**2 if exact else mpmath.mpf(1) / 24
        c5 = (mpmath.mpf(1) / 6 - c3) / exact if exact else mpmath.mpf(1) / 120
        c6 = (mpmath.mpf(1) / 24 - c4) / exact if exact else mpmath.mpf(1) / 720
        expected = [float(value) for value in (c, f, g, c3, c4, c5, c6)]
    functions = stumpff(s)
    assert_close(
        torch.stack([*functions, *next_stumpff(s, functions.c3, functions.c4)]),
        torch.tensor(expected, dtype=torch.float64),
        rtol=4e-15,
        atol=3e-15,
    )


def textbook(q, radii, lengths, offsets):
    """Return tip and rotation by Webster & Jones (2010): curvature, direction, Rz Ry Rz."""
    position, rotation, before = np.zeros(3), np.eye(3), 0
    for k, radius in enumerate(radii):
        l1, l2, l3 = q[3 * k : 3 * k + 3]
        bend = np.array([l2 + l3 - 2 * l1, mpmath.sqrt(3) * (l3 - l2)]) / (3 * radius)
        length = (l1 + l2 + l3) / 3 if lengths is None else lengths[k]
        if lengths is not None:  # these tendons have spent what the segments before took
            bend, before = bend - before, bend
        theta, phi = mpmath.hypot(*bend), mpmath.atan2(bend[1], bend[0])
        c, s, cp, sp = mpmath.cos(theta), mpmath.sin(theta), mpmath.cos(phi), mpmath.sin(phi)
        arc = np.array([0, 0, length])
        if theta:
            arc = length / theta * np.array([(1 - c) * cp, (1 - c) * sp, s])
        z = np.array([[cp, -sp, 0], [sp, cp, 0], [0, 0, 1]])
        turn = z @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ z.T
        position = position + rotation @ (arc + offsets[k] * turn[:, 2])
        rotation = rotation @ turn
    return position, rotation


def textbook_derivatives(q, *geometry):
    """Return tip, Jacobian, angular Jacobian and second derivatives, by central differences.

    With steps of 1e-20 and 100 digits each is right to 40 digits.
    """
    steps, h = np.diag([mpmath.mpf("1e-20")] * len(q)), mpmath.mpf("1e-20")
    x, R = textbook(q, *geometry)
    ahead, behind = ([textbook(q + sign * step, *geometry) for step in steps] for sign in (1, -1))
    J = [(a[0] - b[0]) / (2 * h) for a, b in zip(ahead, behind, strict=True)]
    spins = [(a[1] - b[1]) @ R.T / (2 * h) for a, b in zip(ahead, behind, strict=True)]
    angular = [(spin[2, 1], spin[0, 2], spin[1, 0]) for spin in spins]
    second = np.empty((len(q), len(q), 3), dtype=object)
    for j, k in zip(*np.tril_indices(len(q)), strict=True):
        move = steps[j] + steps[k]
        corners = textbook(q + move, *geometry)[0] + textbook(q - move, *geometry)[0]
        edges = ahead[j][0] + behind[j][0] + ahead[k][0] + behind[k][0]
        second[j, k] = second[k, j] = (corners - edges + 2 * x) / (2 * h**2)
    derivatives = (x, np.array(J).T, np.array(angular).T, second.T)
    return [torch.from_numpy(np.array(v, dtype=float)) for v in derivatives]


def within(bound, value, expected, noise=0.0):
    """Tell whether all errors are below a part of the largest entry, or below a noise."""
    scale = float(expected.abs().max())
    return float((value.double() - expected).abs().max()) <= max(bound * scale, noise)


BENDS = [
    *(0.0, 1e-12, 1e-8, 1e-4, 0.1, 0.999999, 1.0, 1.000001),
    *(1.5, 2.0, math.pi, 5.0, 2 * math.pi),
]


@pytest.mark.slow
@pytest.mark.parametrize("theta", BENDS)
@pytest.mark.parametrize("n_segments", [1, 3])
@pytest.mark.parametrize("kind", ["chambers", "tendons"])
def test_against_the_textbook_in_a_hundred_digits(kind, n_segments, theta):
    """Errors are relative to the largest entry of x, of J, of the second derivatives."""
    if kind == "chambers":
        radii, lengths, offsets, center = RADII[:n_segments], None, [0.01, 0.0, 0.05], 0.25
    else:
        radii, offsets, center = [0.0045, 0.005, 0.004][:n_segments], [0.002, 0.003, 0.01], 0.0
        lengths = [0.06, 0.0625, 0.064][:n_segments]
    offsets = offsets[-n_segments:]
    routing = "segment" if lengths is None else "base"
    chain = ConstantCurvatureChain(radii, lengths=lengths, offsets=offsets, routing=routing)
    toward = torch.tensor([0.3, 2.0, -1.1], dtype=torch.float64)[:n_segments, None]
    bending = theta * torch.cat([toward.cos(), toward.sin()], 1)
    bending = bending if lengths is None else bending.cumsum(0)
    shorter = bending @ torch.stack([THREE.cos(), THREE.sin()]) * chain.radii[:, None]
    q = (center - shorter).flatten()

    with mpmath.workdps(100):
        geometry = (None if p is None else [*map(mpmath.mpf, p)] for p in (radii, lengths, offsets))
        expected = textbook_derivatives(np.array([*map(mpmath.mpf, q.tolist())]), *geometry)
    x, J, angular, second = expected
    hessians = [take(chain.jacobian)(q) for take in (torch.func.jacfwd, torch.func.jacrev)]

    for value in (chain(q), chain.forward_and_jacobian(q)[0]):
        assert within(4e-15, value, x)
    for value in (chain.jacobian(q), chain.pose_jacobian(q)[:3]):
        assert within(4e-15, value, J)
    assert within(4e-15, chain.pose_jacobian(q)[3:], angular)
    for value in hessians:
        assert within(1e-13, value, second)
    for value, reference, slope in zip(
        chain.forward_and_jacobian(q.float()),
        chain.forward_and_jacobian(q.float().double()),
        (J, second),
        strict=True,
    ):
        # After a full turn the tip is back at the base and its derivatives are small: what is left
        # is the rounding of the bends in single precision, six units of it.
        units = 6.0 if theta > math.pi else 0.0
        noise = units * 0.5 * torch.finfo(value.dtype).eps * float((slope.abs() @ q.abs()).max())
        assert within(1e-6, value, reference, noise)


def test_quarter_circle():
    radius, arc = 0.1, math.pi / 2
    chain = ConstantCurvatureChain([radius])
    length = 0.4
    q = length - radius * arc * THREE.cos()
    expected = torch.tensor([length / arc, 0.0, length / arc], dtype=torch.float64)
    assert_close(chain(q), expected, rtol=1e-12, atol=1e-15)


def test_consistency_finds_the_broken_reading(rng):
    chain = ConstantCurvatureChain([0.1, 0.08], n_actuators=[3, 4])
    bending = 0.3 * torch.randn(2, 2, generator=rng, dtype=torch.float64)
    toward = torch.stack([chain.angles.cos(), chain.angles.sin()], -1)
    segment = torch.tensor([0, 0, 0, 1, 1, 1, 1])
    q = 0.25 - chain.radii[segment] * (toward * bending[segment]).sum(-1)
    assert_close(chain.consistency(q), torch.zeros(2, dtype=torch.float64), rtol=0, atol=1e-15)
    q[5] += 0.01
    # Four readings of three unknowns: a quarter of the error, with alternating sign, remains.
    expected = torch.tensor([0.0, 0.0025], dtype=torch.float64)
    assert_close(chain.consistency(q), expected, rtol=1e-9, atol=1e-12)


def test_contradictory_readings_by_segment():
    chain = ConstantCurvatureChain([0.01, 0.02], lengths=[0.1, 0.1])
    balanced = torch.tensor([-2.0, 1.0, 1.0], dtype=torch.float64)  # 1.41 rms
    own = [
        (balanced, False),
        (0.0 * balanced, False),
        (balanced + 0.4, False),  # 28 % of what bends
        (100 * balanced + 5.0, False),
        (balanced + 1.1, True),
        (torch.tensor([-4.0, 0.0, 0.0]), True),
        (torch.full((3,), 0.9), False),  # a common change below a tenth of the radius
        (torch.full((3,), -1.1), True),
    ]
    for first, wrong in own:
        q = 1e-3 * torch.cat([first.double(), 2.0 * balanced])
        assert chain.contradictory(q).tolist() == [wrong, False]
        swapped = 1e-3 * torch.cat([balanced, 2.0 * first.double()])  # of twice the radius
        assert chain.contradictory(swapped).tolist() == [False, wrong]
    zeros = 1e-3 * torch.tensor([2.0] * 3 + [0.0] * 3, dtype=torch.float64)
    q = 1e-3 * torch.cat([balanced, balanced]) + zeros
    assert chain.contradictory(q.expand(2, 1, 6)).tolist() == [[[True, False]]] * 2
    assert not chain.with_geometry(actuator_zeros=zeros).contradictory(q).any()
    assert not bha().contradictory(STRAIGHT + 0.1).any()


@pytest.mark.parametrize("routing", ["segment", "base"])
def test_actuator_zeros_are_read_too_much(routing, rng):
    zeros = 1e-3 * torch.randn(9, generator=rng, dtype=torch.float64)
    q, plain = random_q(rng, center=0.0, width=0.005), tendons(routing)
    for value in (zeros, zeros.unflatten(0, (3, 3)).tolist()):
        chain = tendons(routing, actuator_zeros=value)
        x, J = chain.forward_and_jacobian(q + zeros)
        assert_close((x, J), plain.forward_and_jacobian(q), rtol=1e-12, atol=1e-14)
        assert_close(chain.consistency(q + zeros), plain.consistency(q), rtol=0, atol=1e-15)
    common = tendons(routing, actuator_zeros=0.001)
    assert_close(common(q + 0.001), plain(q), rtol=1e-12, atol=1e-14)


@pytest.mark.slow
@each_chain
def test_gradcheck_at_straight_and_beside_it(chain, center, width, rng):
    size = chain.n_actuators
    for spread in (0.0, 1e-9, width):
        q = random_q(rng, 2, size, center, spread).requires_grad_()
        assert torch.autograd.gradcheck(chain, q)
        assert torch.autograd.gradgradcheck(chain, q)


@each_chain
def test_closed_form_jacobian_is_that_of_autograd(chain, center, width, rng):
    for spread in (0.0, 1e-9, width):
        q = random_q(rng, 10, chain.n_actuators, center, spread)
        x, J = chain.forward_and_jacobian(q)
        x_reverse, J_reverse = reverse_jacobian(chain.forward, q)
        assert_close(x, x_reverse, rtol=1e-15, atol=1e-15)
        assert_close(J, J_reverse, rtol=1e-13, atol=1e-13 * float(J.abs().max()))


def test_splitting_a_segment_changes_nothing(rng):
    q = random_q(rng, 5, 3)
    whole = ConstantCurvatureChain([0.1])
    halves = ConstantCurvatureChain([0.1, 0.1])
    x, J = halves.forward_and_jacobian(torch.cat([q, q], 1) / 2)
    expected = whole.forward_and_jacobian(q)
    assert_close((x, J.unflatten(2, (2, 3)).mean(2)), expected, rtol=1e-13, atol=1e-14)
    # Tendons that also run through the first half read the whole bend.
    q = 0.1 * (q - q.mean(1, keepdim=True))
    whole = ConstantCurvatureChain([0.01], lengths=[0.1])
    halves = ConstantCurvatureChain([0.01, 0.01], lengths=[0.05, 0.05], routing="base")
    assert_close(halves(torch.cat([q / 2, q], 1)), whole(q), rtol=1e-13, atol=1e-14)


@settings(max_examples=10, deadline=None)
@given(seed=st.integers(0, 2**32 - 1), turns=st.integers(0, 2), spread=st.sampled_from([1.0, 1e-6]))
def test_a_third_of_a_turn_permutes_the_actuators(seed, turns, spread):
    rng = torch.Generator().manual_seed(seed)
    turn = rotation_z(turns * 2 * math.pi / 3)
    both_ways = torch.block_diag(turn, turn)
    for chain, center, width in (CHAINS["chambers"], CHAINS["tendons, through"]):
        q = random_q(rng, 3, center=center, width=spread * width)
        passed_on = q.unflatten(1, (3, 3)).roll(turns, 2).flatten(1)
        J = chain.pose_jacobian(passed_on).unflatten(2, (3, 3)).roll(-turns, 3).flatten(2)
        expected = both_ways @ chain.pose_jacobian(q)
        assert_close(chain(passed_on), chain(q) @ turn.mT, rtol=0, atol=1e-14)
        assert_close(J / J.abs().max(), expected / J.abs().max(), rtol=0, atol=1e-14)


def test_change_of_units(rng):
    q = random_q(rng, 5)
    with pytest.warns(UserWarning, match="millimetres"):
        in_mm = ConstantCurvatureChain([100.0, 93.0, 79.0])
    assert_close(in_mm(1000 * q), 1000 * bha()(q), rtol=1e-13, atol=1e-11)
    assert_close(in_mm.jacobian(1000 * q), bha().jacobian(q), rtol=1e-13, atol=1e-13)


def test_functional_transforms(rng):
    q = random_q(rng, 4)
    chain = bha()
    J = torch.func.vmap(torch.func.jacrev(chain))(q)
    assert_close(J, chain.jacobian(q), rtol=1e-13, atol=1e-13)
    hessian = torch.func.vmap(torch.func.hessian(chain))(STRAIGHT[None])
    assert torch.isfinite(hessian).all()
    state = {"base": pose(torch.eye(3), [0.0, 0.0, 1.0])}
    lifted = torch.func.functional_call(chain, state, (q,))
    assert_close(lifted[:, 2], chain(q)[:, 2] + 1.0, rtol=1e-14, atol=0)


def test_with_geometry_is_differentiable_and_leaves_the_chain(rng):
    q = random_q(rng, 4)
    chain = bha()
    before = chain.radii.clone()

    def tip(radii):
        return chain.with_geometry(radii=radii)(q)

    radii = chain.radii.clone().requires_grad_()
    assert torch.autograd.gradcheck(tip, radii)
    assert_close(chain.radii, before, rtol=0, atol=0)
    with pytest.raises(ValueError, match="lengths"):
        chain.with_geometry(lengths=radii)


@each_chain
def test_pickle_copy_and_hash(chain, center, width, rng):
    q = random_q(rng, 3, chain.n_actuators, center, width)
    for twin in (pickle.loads(pickle.dumps(chain)), copy.deepcopy(chain)):
        assert_close(twin(q), chain(q), rtol=0, atol=0)
        assert joblib.hash(twin) == joblib.hash(chain)
    assert_close(chain.float()(q).double(), chain(q).double(), rtol=0, atol=0)
    chain.double()


PARTS = [0.3, 1.0, 1.5, 2.0, 2.75, 3.0]


@pytest.mark.parametrize("at", PARTS)
@pytest.mark.parametrize("name", ["chambers", "tendons, through", "pre-curved"])
def test_another_tip_lies_on_the_backbone(name, at, rng):
    whole, center, width = CHAINS[name]
    chain, q = whole.with_tip(at), random_q(rng, 4, 9, center, width)
    x, J = chain.forward_and_jacobian(q)
    assert_close(x, chain(q), rtol=0, atol=1e-15)
    if at == int(at):
        expected = whole.poses(q)[:, int(at)]
        assert_close(x, expected[:, :3, 3], rtol=0, atol=2e-15)
    else:
        # A part of an arc is an arc of that part of its length and of its bending.
        k, part = int(at), at - int(at)
        length, bending = whole.arcs(q)
        step = transforms(part * length[:, k], part * bending[:, k], torch.zeros(4).double())
        expected = (whole.poses(q)[:, k] @ step)[:, :3, 3]
        assert_close(x, expected, rtol=0, atol=2e-15)
        assert_close(whole.backbone(q, 20)[:, round(20 * at)], x, rtol=0, atol=2e-15)
    _, J_reverse = reverse_jacobian(chain.forward, q)
    assert_close(J, J_reverse, rtol=1e-13, atol=1e-13 * float(J.abs().max()))
    J_pose = chain.pose_jacobian(q)
    assert_close(J_pose[:, :3], J, rtol=1e-13, atol=1e-13)
    later = J_pose[..., 3 * math.ceil(at) :]
    assert_close(later, torch.zeros_like(later), rtol=0, atol=1e-15 * float(J_pose.abs().max()))
    for own, others in zip(chain.arcs(q), whole.arcs(q), strict=True):
        assert torch.equal(own, others)
    assert torch.equal(chain.poses(q), whole.poses(q))
    assert torch.equal(chain.backbone(q), whole.backbone(q))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ConstantCurvatureChain([0.1, -0.1]), "`radii` must be positive"),
        (lambda: bha(n_actuators=[3, 0, 3]), "at least 1 on every segment"),
        (lambda: bha(n_actuators=2.5), "`n_actuators` must be one whole number .* got 2.5"),
        (lambda: bha(angles=[0.0, 0.0, 0.0]), "`angles` must determine the bending"),
        (lambda: bha(angles=[[0.0, 2.0, 4.0]] * 2), "`angles` must hold"),
        (lambda: bha(lengths=[0.1, 0.1]), r"`lengths` must have shape \(3,\)"),
        (lambda: bha(routing="through"), "`routing` must be one of"),
        (lambda: bha(rest_bends=[0.0, 1.0]), r"`rest_bends` must have shape \(3, 2\)"),
        (lambda: bha().with_tip(0), r"`at` must lie in \(0, 3\]"),
        (lambda: bha(base=np.eye(3)), r"`base` must be one pose of shape \(4, 4\)"),
        (lambda: bha(base=2 * np.eye(4)), "`base` must hold a rotation"),
        (lambda: bha()(torch.zeros(4, 6, dtype=torch.float64)), r"`q` must have shape \(..., 9\)"),
        (lambda: bha().check_actuators(STRAIGHT - 0.25), "positive actuator lengths"),
    ],
)
def test_bad_input_says_what_is_needed(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_angles_in_degrees_are_noticed():
    degrees = [0.0, 120.0, 240.0]
    for kind in (ConstantCurvatureChain, ElasticTendonChain):
        with pytest.warns(UserWarning, match="reach 240, which looks like degrees"):
            kind([0.005], lengths=[0.1], angles=degrees)
        assert kind([0.005], lengths=[0.1], angles=np.radians(degrees)).n_actuators == 3
