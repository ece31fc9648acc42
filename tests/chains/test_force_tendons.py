import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ForceTendonChain, calibrate
from hybridkin.chains._equilibrium import Shape

DOWN = torch.tensor([0.3, -0.2, 1.0])


def chain(**changes):
    options = {
        "radii": [0.012, 0.01],
        "lengths": [0.2, 0.15],
        "bending_stiffness": [0.02, 0.01],
        "axial_stiffness": 100.0,
        "n_actuators": 2,
        "angles": [1.0, -1.2],
        "weight": 2.0,
        "taper": [0.3, 0.5],
        "gravity": DOWN,
        "arcs": 3,
        "rest_bends": [[0.2, -0.1], [0.0, 0.3]],
        "offsets": [0.01, 0.02],
    }
    return ForceTendonChain(**(options | changes))


def forces(n=5, seed=0):
    random = torch.Generator().manual_seed(seed)
    return 0.5 + 4.0 * torch.rand(n, 4, generator=random, dtype=torch.float64)


def test_without_weight_one_force_bends_a_uniform_body_into_an_arc():
    # Moment r F over E I times the length; compression F over E A.
    body = ForceTendonChain([0.01], [0.3], 0.02, 50.0, arcs=4)
    length, bending = body.arcs(torch.tensor([1.5, 0.0, 0.0], dtype=torch.float64))
    assert_close(length.sum(), length.new_tensor(0.3 * (1 - 1.5 / 50.0)))
    assert_close(bending.sum(0), length.new_tensor([0.01 * 1.5 * 0.3 / 0.02, 0.0]))


def test_a_light_beam_sags_like_a_cantilever():
    # Euler-Bernoulli: the tip of a horizontal beam sinks by w L^4 / (8 E I).
    beam = ForceTendonChain([0.01], [0.3], 2.0, 1e6, weight=0.1, gravity=[1, 0, 0], arcs=40)
    x = beam(torch.zeros(3, dtype=torch.float64))
    assert_close(x[0], x.new_tensor(0.1 * 0.3**4 / 16.0), rtol=1e-3, atol=0.0)
    # A hanging one becomes longer by w L^2 / (2 E A).
    hanging = ForceTendonChain([0.01], [0.3], 2.0, 50.0, weight=1.0, gravity=[0, 0, 1], arcs=3)
    x = hanging(torch.zeros(3, dtype=torch.float64))
    assert_close(x, x.new_tensor([0.0, 0.0, 0.3 + 0.3**2 / 100.0]))


@pytest.mark.parametrize("lengths", [[0.3], [0.1, 0.12, 0.08]])
@pytest.mark.parametrize("taper", [0.0, 0.5])
def test_a_tapered_beam_sags_stretches_and_bends_as_beams_do(lengths, taper):
    """Linear beam theory with weight and E A of the area, and E I of the fourth power of radius."""
    S, n = len(lengths), 2000
    weight, bending, axial = [0.1, 0.07, 0.05][:S], [2.0, 1.5, 0.9][:S], [50.0, 40.0, 30.0][:S]

    def beam(gravity, axial=axial, weight=weight):
        options = {"routing": "segment", "taper": taper, "gravity": gravity, "arcs": 20}
        return ForceTendonChain([0.01] * S, lengths, bending, axial, weight=weight, **options)

    # Midpoint sums: the curvature at s moves the tip by L - s, and a weight at u acts by u - s.
    outer = np.tile(1.0 - taper * (np.arange(n) + 0.5) / n, S)
    ds, L = np.repeat(lengths, n) / n, sum(lengths)
    s = np.cumsum(ds) - 0.5 * ds
    weights = np.repeat(weight, n) * outer**2 * ds
    softness = ds / (np.repeat(bending, n) * outer**4)
    by_unit_load = s * np.cumsum((L - s) * softness) - np.cumsum(s * (L - s) * softness)
    stretch = np.cumsum(ds / (np.repeat(axial, n) * outer**2))
    q = torch.zeros(3 * S, dtype=torch.float64)
    # Constant along an arc: an error of 1 / arcs^2, times some units for the fourth power.
    close = {"rtol": 3e-3, "atol": 0.0}
    assert_close(beam([1, 0, 0], 1e6)(q)[0], q.new_tensor(weights @ by_unit_load), **close)
    assert_close(beam([0, 0, 1])(q)[2] - L, q.new_tensor(weights @ stretch), **close)
    q[::3] = 2.0
    bends = beam([0, 0, 1], 1e6, 0.0).arcs(q)[1][:, 0].reshape(S, -1).sum(1)
    assert_close(bends, q.new_tensor(0.01 * 2.0 * softness.reshape(S, n).sum(1)), **close)


def test_the_shape_has_least_energy():
    body = chain()
    statics = body._statics()
    arcs = body._arcs_of_rows(forces())
    assert_close(
        Shape(statics, arcs, forces()).imbalance, torch.zeros_like(arcs), rtol=0, atol=1e-12
    )
    energy = Shape(statics, arcs, forces()).energy
    random = torch.Generator().manual_seed(1)
    for size in (1e-4, 1e-2):
        step = size * torch.randn(arcs.shape, generator=random, dtype=torch.float64)
        assert (Shape(statics, arcs + step, forces()).energy > energy).all()


def test_derivatives_of_the_energy():
    statics = chain()._statics()
    random = torch.Generator().manual_seed(2)
    step = torch.randn(18, 5, generator=random, dtype=torch.float64)
    arcs = statics.rest[:, None] + 0.3 * step
    by_torch = torch.func.grad(lambda shape: Shape(statics, shape, forces()).energy.sum())(arcs)
    assert_close(Shape(statics, arcs, forces()).imbalance, by_torch)
    second = torch.func.jacrev(lambda shape: Shape(statics, shape, forces()).imbalance)(arcs)
    assert_close(Shape(statics, arcs, forces()).hessian, torch.einsum("injn->nij", second))


def test_turning_base_and_gravity_turns_the_tip():
    turn = torch.linalg.matrix_exp(torch.tensor([[0, 1.0, 2], [-1, 0, 0.5], [-2, -0.5, 0]]))
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = turn
    turned = chain(base=base, gravity=turn @ DOWN)
    assert_close(turned(forces()), chain()(forces()) @ turn.double().T, rtol=0, atol=1e-7)
    moved = chain().moved(base)
    assert_close(moved(forces()), turned(forces()), rtol=0, atol=1e-7)
    assert_close(torch.tensor(moved.gravity).norm(), torch.tensor(1.0))


def test_jacobian_is_that_of_torch_and_of_differences():
    body = chain().with_markers([(0, 0.4, (0.01, 0.0, 0.02)), (1, 1.0)])
    q = forces(3)
    x, J = body.forward_and_jacobian(q)
    assert_close(x, body(q))
    step = 1e-5
    for k in range(4):
        change = torch.zeros(4, dtype=torch.float64)
        change[k] = step
        difference = (body(q + change) - body(q - change)) / (2 * step)
        assert_close(J[..., k], difference, rtol=1e-6, atol=1e-9)


@pytest.mark.slow
def test_first_and_second_derivatives_in_torch():
    rows = forces(1).requires_grad_()
    assert torch.autograd.gradcheck(chain(arcs=2), rows)
    assert torch.autograd.gradgradcheck(chain(arcs=1), rows)
    assert torch.autograd.gradcheck(lambda q: chain(arcs=1).forward_and_jacobian(q)[1], rows)


@pytest.mark.slow
def test_geometry_jacobian_against_differences():
    body = chain(arcs=2).with_markers([(0, 0.4, (0.01, 0.0, 0.02)), (1, 1.0)])
    q = forces(1)
    step = 1e-6
    geometry = body.geometry()
    for name, value in geometry.items():
        change = torch.linspace(0.2, 1.0, value.numel(), dtype=torch.float64)
        change = change.reshape(value.shape) * value.abs().max().clamp(min=0.01)
        J = body.geometry_jacobian(q, {name: change[None]})[..., 0]
        above = body.with_geometry(**{name: value + step * change})(q)
        below = body.with_geometry(**{name: value - step * change})(q)
        assert_close(J, (above - below) / (2 * step), rtol=1e-5, atol=1e-8)


def test_searches_near_the_last_shapes_find_the_same():
    near = chain().near_last_shapes()
    assert near.with_geometry()._last is near._last
    near(forces())
    heavier = {"weight": torch.tensor([2.5, 1.0], dtype=torch.float64)}
    for q in (forces(), forces(3, seed=1)):  # the rows of the last search, and others
        expected = chain().with_geometry(**heavier)(q)
        assert_close(near.with_geometry(**heavier)(q), expected, rtol=0, atol=1e-13)
    assert chain()._last is None  # without asking, a result depends on nothing before


def test_batches_dtypes_and_negative_forces():
    body = chain()
    q = forces(4)
    assert_close(body(q.reshape(2, 2, 4)).reshape(4, 3), torch.stack([body(row) for row in q]))
    assert body(q.float()).dtype == torch.float32
    assert_close(torch.func.vmap(body)(q), body(q))
    q[:, 0] = -1.0
    slack = torch.cat([torch.zeros(4, 1).double(), q[:, 1:]], dim=1)
    assert_close(body(q), body(slack))
    with pytest.raises(ValueError, match="pull"):
        body.check_actuators(q)


@pytest.mark.slow
def test_calibration_finds_stiffness_and_weight():
    q = forces(12, seed=3)
    x = chain(arcs=2).with_markers([(0, 1.0), (1, 1.0)])(q)
    start = chain(arcs=2, bending_stiffness=[0.03, 0.008], weight=1.0, taper=0.2)
    names = ("bending_stiffness", "weight", "taper")
    result = calibrate(start.with_markers([(0, 1.0), (1, 1.0)]), q, x, names)
    assert result.rmse < 1e-8
    np.testing.assert_allclose(result.values["weight"], 2.0, rtol=1e-4)
    np.testing.assert_allclose(result.values["taper"], [0.3, 0.5], rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("lengths", None),
        ("weight", -1.0),
        ("taper", 1.0),
        ("gravity", [0, 0, 0]),
        ("arcs", 0),
        ("axial_stiffness", 0.0),
    ],
)
def test_wrong_arguments_are_named(name, value):
    with pytest.raises(ValueError, match=name):
        chain(**{name: value})


def test_poses_backbone_and_pose_agree():
    body = chain()
    q = forces(2)
    assert body.poses(q).shape == (2, 3, 4, 4)
    assert_close(body.poses(q)[:, -1], body.pose(q))
    assert_close(body.pose(q)[:, :3, 3], body(q))
    points = body.backbone(q, 5)
    assert points.shape == (2, 11, 3)
    assert_close(points[:, [0, 5, 10]], body.poses(q)[:, :, :3, 3])
    J = body.pose_jacobian(q)
    assert_close(J[:, :3], body.forward_and_jacobian(q)[1])
