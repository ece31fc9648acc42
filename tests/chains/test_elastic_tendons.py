import copy
import math

import numpy as np
import pytest
import torch
from scipy.optimize import lsq_linear
from torch.testing import assert_close

from hybridkin import (
    ElasticTendonChain,
    calibrate,
)
from hybridkin.chains import _slack
from hybridkin.chains import elastic_tendons as tendons

RADII, LENGTHS = [0.0045, 0.005, 0.004], [0.06, 0.0625, 0.064]
SQUARED = np.square(RADII)


def robot(**options):
    """Return a robot that is not symmetric anywhere."""
    options = {
        "offsets": [0.002, 0.003, 0.01],
        "tendon_zeros": 3e-4 * np.arange(9) - 5e-4,
        "rest_bends": [[0.2, -0.1], [0.0, 0.3], [-0.4, 0.0]],
        "angles": [[0.0, 2.0, 4.3], [0.4, 2.6, 4.5], [-0.6, 1.4, 3.7]],
        "bending_stiffness": [0.2, 0.1, 0.05] * SQUARED,
        "axial_stiffness": [3.0, 10.0, 1.0],
        **options,
    }
    return ElasticTendonChain(RADII, LENGTHS, **options)


def random_q(rng, n=20, size=9, width=0.005):
    return width * (2 * torch.rand(n, size, generator=rng, dtype=torch.float64) - 1)


def change_of_shape(chain, q):
    """Return the length changes, x- and y-bendings of all segments (N, 3 S)."""
    length, bending = chain.arcs(q)
    return torch.cat([length - chain.lengths, *bending.unbind(-1)], dim=-1)


def least_energy(chain, q):
    """Return the shapes of least energy by bounded least squares, slackness as an unknown."""
    B = chain._readings().numpy()
    bending = chain.bending_stiffness
    root = torch.cat([chain.axial_stiffness, bending, bending]).sqrt().numpy()
    rest = np.concatenate([np.zeros(chain.n_segments), *chain.rest_bends.T.numpy()])
    n, m = B.shape
    unit = np.concatenate([np.ones(chain.n_segments), *[1 / chain.radii.numpy()] * 2])
    matrix = np.block([[np.diag(root * unit), np.zeros((m, n))], [B * unit, np.eye(n)]])
    low = np.concatenate([np.full(m, -np.inf), np.zeros(n)])
    shapes = []
    for row in q.numpy():
        target = np.concatenate([root * rest, row - chain.tendon_zeros.numpy()])
        # In units of the largest target, or the solver's tolerance would be met too early.
        size = np.abs(target).max() or 1.0
        found = lsq_linear(matrix, target / size, (low, np.inf), method="bvls", tol=1e-15)
        shapes.append(unit * found.x[:m] * size)
    return torch.tensor(np.array(shapes))


ROBOTS = {
    "through": robot(),
    "own segment": robot(routing="segment"),
    "soft": ElasticTendonChain(RADII, LENGTHS),
    "pre-tensioned": ElasticTendonChain(RADII, LENGTHS, tendon_zeros=0.002),
    "uneven": ElasticTendonChain(
        RADII[:2],
        LENGTHS[:2],
        n_actuators=[2, 4],
        angles=[[0.0, 2.0], [0.1, 1.5, 3.0, 4.4]],
        tendon_zeros=[[1e-3, 0.0], [0.0, 2e-3, 0.0, -1e-3]],
        base=[[0.0, -1.0, 0.0, 0.1], [1.0, 0.0, 0.0, 0.2], [0.0, 0.0, 1.0, 0.3], [0, 0, 0, 1]],
    ),
    "sixteen tendons": ElasticTendonChain(
        [*RADII, 0.003], [*LENGTHS, 0.05], n_actuators=4, rest_bends=0.1, tendon_zeros=1e-3
    ),
}
each_robot = pytest.mark.parametrize("chain", ROBOTS.values(), ids=ROBOTS)


@each_robot
def test_the_shape_has_the_least_energy(chain, rng):
    n = chain.n_actuators
    wide = torch.cat([random_q(rng, 60, n, width) for width in (1e-4, 2e-3, 5e-3, 0.02)])
    pulled = -torch.eye(n, dtype=torch.float64) * 0.01
    q = torch.cat([wide, pulled, 0.0 * wide[:1], 0 * wide[:2] + 0.01, 0 * wide[:2] - 0.01])
    assert chain.slack(q).double().mean() > 0.1
    assert_close(change_of_shape(chain, q), least_energy(chain, q), rtol=0, atol=1e-9)


@each_robot
def test_forces_balance_where_it_rests(chain, rng):
    q = random_q(rng, 200, chain.n_actuators)
    shape, tension = change_of_shape(chain, q), chain.tensions(q)
    B = chain._readings()
    stretch = shape @ B.T - q + chain.tendon_zeros
    assert_close(tension, stretch.relu(), rtol=0, atol=1e-15)
    assert torch.equal(chain.slack(q) & (tension > 0), torch.zeros_like(tension > 0))
    bending = chain.bending_stiffness
    stiffness = torch.cat([chain.axial_stiffness, bending, bending])
    rest = torch.cat([0 * chain.lengths, *chain.rest_bends.T])
    moments = stiffness * (shape - rest) + tension @ B
    scale = torch.cat([1 + 0 * chain.radii, chain.radii, chain.radii])
    assert_close(moments / scale, 0 * moments, rtol=0, atol=1e-14)


WAYS = [(_slack, "HK_WHOLE_STEPS"), (tendons, "_TABLE")]


@pytest.mark.parametrize(("module", "limit"), WAYS)
def test_every_way_to_find_the_taut_tendons_agrees(module, limit, monkeypatch, rng):
    chain, q = robot(), random_q(rng, 500)
    expected, taut = change_of_shape(chain, q), chain.slack(q)
    monkeypatch.setattr(module, limit, 0)
    chain = robot()
    assert torch.equal(chain.slack(q), taut)
    assert_close(change_of_shape(chain, q), expected, rtol=0, atol=1e-12)
    J = chain.jacobian(q)
    monkeypatch.undo()
    assert_close(J, chain.jacobian(q), rtol=0, atol=1e-12 * float(J.abs().max()))


def test_one_tendon_pulled_by_hand():
    radius, bending, axial, pull = 0.005, 2e-6, 4.0, 0.003
    chain = ElasticTendonChain([radius], [0.1], bending_stiffness=bending, axial_stiffness=axial)
    q = torch.tensor([-pull, 0.01, 0.01], dtype=torch.float64)
    assert chain.slack(q).tolist() == [False, True, True]
    tension = pull / (1 + 1 / axial + radius**2 / bending)
    assert_close(chain.tensions(q), torch.tensor([tension, 0.0, 0.0]).double(), rtol=1e-6, atol=0)
    length, bend = chain.arcs(q)
    assert float(length) == pytest.approx(0.1 - tension / axial, rel=1e-13)
    assert_close(bend[0], torch.tensor([radius * tension / bending, 0.0]).double())


def test_slack_tendons_hang(rng):
    chain, q = robot(), random_q(rng, 200)
    looser = q + 0.01 * chain.slack(q)  # however far
    assert_close(chain(looser), chain(q), rtol=0, atol=1e-15)
    assert_close(chain.tensions(looser), chain.tensions(q), rtol=0, atol=1e-15)
    idle = chain.slack(q)[:, None].expand(-1, 3, -1)
    assert (chain.jacobian(q)[idle] == 0).all()
    loose = torch.full((9,), 0.1, dtype=torch.float64)
    assert chain.slack(loose).all()
    assert_close(chain.arcs(loose), (chain.lengths, chain.rest_bends), rtol=0, atol=1e-15)


def test_tendons_may_be_renamed_and_the_robot_turned(rng):
    chain, q = robot(base=None), random_q(rng, 20)
    order = torch.tensor([2, 0, 1, 3, 5, 4, 8, 7, 6])
    renamed = chain.with_geometry(
        angles=chain.angles[order], tendon_zeros=chain.tendon_zeros[order]
    )
    assert_close(renamed(q[:, order]), chain(q), rtol=0, atol=1e-14)
    assert_close(renamed.tensions(q[:, order]), chain.tensions(q)[:, order], rtol=0, atol=1e-16)
    c, s = math.cos(0.7), math.sin(0.7)
    turn = torch.tensor([[c, -s], [s, c]], dtype=torch.float64)
    turned = chain.with_geometry(angles=chain.angles + 0.7, rest_bends=chain.rest_bends @ turn.T)
    expected = torch.cat([chain(q)[:, :2] @ turn.T, chain(q)[:, 2:]], dim=1)
    assert_close(turned(q), expected, rtol=0, atol=1e-14)


@each_robot
def test_closed_form_jacobians_are_those_of_autograd(chain, rng):
    q = random_q(rng, 10, chain.n_actuators)
    x, J = chain.forward_and_jacobian(q)
    assert_close(x, chain(q), rtol=0, atol=1e-15)
    J_pose, tolerance = chain.pose_jacobian(q), 1e-12 * float(J.abs().max())
    assert_close(J_pose[:, :3], J, rtol=0, atol=tolerance)
    for take in (torch.func.jacrev, torch.func.jacfwd):
        assert_close(torch.func.vmap(take(chain))(q), J, rtol=0, atol=tolerance)
    frame = chain.poses(q)[:, -1, :3, :3]
    slope = torch.func.vmap(torch.func.jacrev(lambda row: chain.poses(row)[-1, :3, :3]))(q)
    spin = torch.einsum("nabj,ncb->njac", slope, frame)
    spin = torch.stack([spin[..., 2, 1], spin[..., 0, 2], spin[..., 1, 0]], dim=1)
    assert_close(J_pose[:, 3:], spin, rtol=0, atol=1e-11 * float(spin.abs().max()))
    second = [
        torch.func.vmap(take(chain.jacobian))(q[:3])
        for take in (torch.func.jacrev, torch.func.jacfwd)
    ]
    assert_close(*second, rtol=0, atol=1e-12 * float(second[0].abs().max()))


def test_at_a_kink_the_derivative_is_the_taut_side():
    chain = ElasticTendonChain(RADII, LENGTHS)
    straight, ones = torch.zeros(9, dtype=torch.float64), torch.ones(9, dtype=torch.float64)
    assert not chain.slack(straight).any()
    assert_close(chain.tensions(straight), straight, rtol=0, atol=0)
    pulled = (chain(straight) - chain(straight - 1e-6 * ones)) / 1e-6
    assert_close(chain.jacobian(straight) @ ones, pulled, rtol=1e-6, atol=1e-8)


@pytest.mark.slow
@each_robot
def test_geometry_jacobian_is_that_of_autograd(chain, rng):
    q = random_q(rng, 6, chain.n_actuators)
    for name, value in chain.geometry().items():
        P = value.numel()
        tangents = torch.eye(P, dtype=torch.float64).reshape(P, *value.shape)
        J = chain.geometry_jacobian(q, {name: tangents})
        expected = torch.func.jacfwd(lambda v: chain.with_geometry(**{name: v})(q))(value)  # noqa: B023
        assert_close(J, expected.flatten(2), rtol=0, atol=1e-10 * float(expected.abs().max()))
    both = {"radii": chain.radii[None], "tendon_zeros": torch.ones(1, chain.n_actuators).double()}
    each = [chain.geometry_jacobian(q, {name: value}) for name, value in both.items()]
    J = chain.geometry_jacobian(q, both)
    assert_close(J, sum(each), rtol=0, atol=1e-12 * float(J.abs().max()))


def test_what_is_kept_follows_the_geometry(rng):
    chain, q = robot(), random_q(rng, 5)
    with torch.inference_mode():
        before = chain(q)
    leaf = q.clone().requires_grad_()
    assert_close(torch.autograd.grad(chain(leaf)[:, 0].sum(), leaf)[0], chain.jacobian(q)[:, 0])
    table = chain._all_responses(q)
    moved = chain.with_geometry(base=chain.base.clone(), lengths=chain.lengths)
    assert moved._all_responses(q) is table
    for _ in range(2):
        chain(q)
    assert chain._all_responses(q) is table
    twin = robot(tendon_zeros=0.0)
    expected = twin(q)
    chain.load_state_dict(twin.state_dict())
    assert_close(chain(q), expected, rtol=0, atol=1e-14)
    chain.tendon_zeros.copy_(robot().tendon_zeros)
    assert_close(chain(q), before, rtol=0, atol=1e-14)
    swapped = torch.func.functional_call(chain, {"tendon_zeros": twin.tendon_zeros}, (q,))
    assert_close(swapped, expected, rtol=0, atol=1e-14)
    assert_close(chain(q), before, rtol=0, atol=1e-14)
    zeros = chain.tendon_zeros.clone().requires_grad_()
    learning = chain.with_geometry(tendon_zeros=zeros)
    with torch.no_grad():
        learning(q)
    for _ in range(2):  # nothing of a graph is kept
        learning(q).sum().backward()
    slope = chain.geometry_jacobian(q, {"tendon_zeros": torch.eye(9, dtype=torch.float64)})
    assert_close(zeros.grad, 2 * slope.sum((0, 1)), rtol=1e-10, atol=1e-10)


@each_robot
def test_single_precision(chain, rng):
    widths = (0.0, 1e-9, 1e-5, 1e-3, 5e-3, 0.05)
    q = torch.cat([random_q(rng, 100, chain.n_actuators, width) for width in widths]).float()
    for there in (chain, copy.deepcopy(chain).float()):
        x, J = there.forward_and_jacobian(q)
        assert x.dtype == J.dtype == torch.float32
        assert torch.isfinite(x).all()
        assert torch.isfinite(J).all()
        assert_close(x[:-100].double(), chain(q.double())[:-100], rtol=0, atol=1e-5)
        same = (there.slack(q) == chain.slack(q.double())).all(-1)
        same[-100:] = False  # twenty turns
        assert same.sum() > 300
        expected = chain.jacobian(q.double())[same]
        assert_close(J[same].double(), expected, rtol=0, atol=1e-4 * float(expected.abs().max()))


def logged(truth, rng, n=300):
    """Return displacements that let tendons go slack, and the tips."""
    q = random_q(rng, n)
    share = truth.slack(q).double().mean()
    assert 0.1 < share < 0.9
    return q, truth(q)


PLANTED = ("rest_bends", "bending_stiffness", "axial_stiffness", "tendon_zeros")


@pytest.mark.slow
def test_calibration_finds_stiffness_rest_bends_and_zeros(rng):
    truth = robot()
    q, x = logged(truth, rng)
    geometry = truth.geometry()
    start = truth.with_geometry(
        rest_bends=0 * geometry["rest_bends"],
        bending_stiffness=0.65 * geometry["bending_stiffness"],
        axial_stiffness=1.5 * geometry["axial_stiffness"],
        tendon_zeros=0 * geometry["tendon_zeros"] + 5e-4,
    )
    result = calibrate(start, q, x, PLANTED)
    for name in PLANTED:
        assert result.identifiable[name].all()
        scale = float(geometry[name].abs().max())
        assert_close(result.values[name] / scale, geometry[name] / scale, rtol=0, atol=1e-6)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: ElasticTendonChain([0.1, -0.1], [1.0, 1.0]), "`radii` must be positive"),
        (lambda: robot(n_actuators=30, angles=None, tendon_zeros=0.0), "at most 62 in all, got 90"),
        (lambda: robot(angles=[[0.0, 2.0, 4.0]] * 2), "`angles` must hold"),
        (lambda: ElasticTendonChain(RADII, LENGTHS[:2]), r"`lengths` must have shape \(3,\)"),
        (lambda: robot(bending_stiffness=0.0), "`bending_stiffness` must be positive"),
        (lambda: robot(axial_stiffness=[1.0, 1.0]), r"`axial_stiffness` must have shape \(3,\)"),
    ],
)
def test_bad_input_says_what_is_needed(make, message):
    with pytest.raises(ValueError, match=message):
        make()
