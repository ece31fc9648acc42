"""A copy or a conversion of a chain is the same robot: no part of it is left behind."""

import copy
import pickle

import numpy as np
import pytest
import torch
from saved_models import arm
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, ForceTendonChain

BASE = torch.tensor([[0, -1, 0, 0.1], [1, 0, 0, 0.2], [0, 0, 1, 0.3], [0, 0, 0, 1]]).double()
# Nothing is at its default, and no two actuators are alike.
GIVEN = {
    "n_actuators": [3, 4],
    "angles": [[0.1, 2.0, 4.3], [0.4, 1.6, 3.5, 5.2]],
    "gains": [2e-5, -3e-5, 2.5e-5, 1e-5, 4e-5, -2e-5, 3e-5],
    "rest_bends": [[0.1, -0.2], [0.3, 0.05]],
    "offsets": [0.002, 0.01],
    "base": BASE,
}
ZEROS = [50.0, -20.0, 10.0, 30.0, -40.0, 20.0, 5.0]
SHAPE = {**GIVEN, "radii": [0.005, 0.004], "lengths": [0.06, 0.07]}
STIFF = {"bending_stiffness": [2e-6, 1e-6], "axial_stiffness": [3.0, 8.0]}
MARKERS = [(0, 0.5, (0.01, 0.0, 0.0)), (1, 0.8, (0.0, 0.002, 0.003))]
STAGE = {"n_actuators": [1, 3], "lengths": [None, 0.1], "stage": "rotation", "gains": [2.0, 1.0]}
CHAINS = {
    "chambers": ConstantCurvatureChain(
        **{**SHAPE, "lengths": None}, actuator_zeros=ZEROS
    ).with_markers(MARKERS),
    "tendons": ConstantCurvatureChain(**SHAPE, routing="base", actuator_zeros=ZEROS).with_tip(1.5),
    "mixed": ConstantCurvatureChain(**{**SHAPE, "lengths": [None, 0.07]}, actuator_zeros=ZEROS),
    "stage": ConstantCurvatureChain([0.01, 0.01], **STAGE, base=BASE),
    "elastic": ElasticTendonChain(
        **SHAPE, **STIFF, routing="segment", tendon_zeros=1e-4 * np.arange(7.0)
    ).with_markers(MARKERS),
    "forces": ForceTendonChain(
        **SHAPE,
        bending_stiffness=[0.02, 0.01],
        axial_stiffness=[100.0, 60.0],
        routing="segment",
        weight=[2.0, 1.0],
        taper=[0.3, 0.5],
        gravity=[0.3, -0.2, 1.0],
        arcs=2,
    ).with_markers(MARKERS),
    "arm": arm(),
}
SETTINGS = (
    "n_actuators n_outputs n_segments routing extensible starts bends stage markers gravity "
    "arcs_per_segment actuators_per_segment in_metres unit_of_q takes_lengths default_parameters "
    "parameter_sets kinds names"
).split()
NUMBERS = "rest reach rigid_length absolute pulls couplings limits".split()
COPIES = {
    "with_geometry, nothing": lambda chain: chain.with_geometry(),
    "with_geometry, base": lambda chain: chain.with_geometry(base=chain.base.clone()),
    "with_geometry, all": lambda chain: chain.with_geometry(**chain.geometry()),
    "near_last_shapes": lambda chain: chain.near_last_shapes(),
    "deepcopy": copy.deepcopy,
    "pickle": lambda chain: pickle.loads(pickle.dumps(chain)),
    "to": lambda chain: copy.deepcopy(chain).to("cpu", torch.float64),
    "file": lambda chain: type(chain).from_stored(chain.stored(), lambda part: None),
}


def rows(chain):
    """Rows of q, with tendons of both signs, or pulled."""
    metres = torch.randn(5, chain.n_actuators, generator=torch.manual_seed(0)).double()
    if not hasattr(chain, "gains"):
        return metres
    metres = torch.where(chain.absolute, 0.1 + 0.005 * metres, 0.002 * metres)
    if not chain.takes_lengths:
        metres = metres.abs() * 500.0
    return metres / chain.gains + chain.rest


def description(chain, q):
    """The settings of a chain, and its numbers by name."""
    numbers = {f"geometry of {name}": value for name, value in chain.geometry().items()}
    numbers |= {name: getattr(chain, name) for name in NUMBERS if hasattr(chain, name)}
    plausible = chain.plausible_rows()
    numbers["plausible_rows"] = plausible.rest, plausible.weights
    for name in ("forward", "jacobian", "poses", "pose", "backbone", "pose_jacobian"):
        numbers[name] = getattr(chain, name)(q)
    return {name: getattr(chain, name, None) for name in SETTINGS}, numbers


@pytest.mark.parametrize("kind", CHAINS)
@pytest.mark.parametrize("way", COPIES)
def test_a_copy_is_the_same_robot(kind, way):
    chain = CHAINS[kind]
    twin = COPIES[way](chain)
    assert type(twin) is type(chain)
    settings, numbers = description(chain, rows(chain))
    found_settings, found = description(twin, rows(chain))
    assert found_settings == settings
    assert found.keys() == numbers.keys()
    for name in numbers:  # a file may hold arrays in another order: the last bits of products
        assert_close(found[name], numbers[name], rtol=1e-10, atol=1e-12, msg=name)


@pytest.mark.parametrize("kind", ["chambers", "tendons", "mixed", "elastic", "forces"])
def test_markers_keep_the_robot_and_move_its_outputs(kind):
    chain = CHAINS[kind]
    q = rows(chain)
    settings, numbers = description(chain, q)
    of_outputs = {"forward", "jacobian", "pose", "pose_jacobian", "rigid_length"}
    of_outputs |= {"geometry of marker_offsets"}
    marked = chain.with_markers([(0, 0.3, (0.0, 0.001, 0.0)), (1, 1.0)])
    for twin in (marked, chain.with_tip(2.0), chain.tip_model):
        found_settings, found = description(twin, q)
        for name in settings.keys() - {"n_outputs", "markers"}:
            assert found_settings[name] == settings[name]
        for name in numbers.keys() - of_outputs:
            assert_close(found[name], numbers[name], rtol=0, atol=0, msg=name)
    for twin in (marked, chain.with_tip(2.0)):
        assert_close(twin(q)[:, -3:], chain.poses(q)[:, -1, :3, 3])
    assert_close(torch.cat([tip(q) for tip in chain.each_tip()], dim=1), chain(q))


@pytest.mark.parametrize("routing", ["segment", "base"])
@pytest.mark.parametrize("markers", [[(1, 1.0)], [(0, 0.5, (0.01, 0.0, 0.0)), (1, 0.8)]])
def test_elastic_tendons_that_are_soft_and_taut_are_the_plain_chain(routing, markers):
    """With soft bending and a stiff length, pulled together, every part of the plain chain shows.

    Also a chain in another unit, whose tendons all have their own gains and zeros.
    """
    angles = [[0.4 + 2.0 * np.pi / n * k for k in range(n)] for n in (3, 4)]
    given = {**SHAPE, "angles": angles, "routing": routing, "actuator_zeros": ZEROS}
    plain = ConstantCurvatureChain(**given).with_markers(markers)
    soft = 1e-9 * plain.radii**2
    elastic = ElasticTendonChain.from_chain(plain, bending_stiffness=soft, axial_stiffness=1e9)
    assert elastic.in_metres == plain.in_metres
    assert elastic.unit_of_q == plain.unit_of_q
    for name in plain.geometry().keys() - {"actuator_zeros"}:
        assert_close(elastic.geometry()[name], plain.geometry()[name])
    bend = torch.linspace(-1.0, 1.0, 28, dtype=torch.float64).reshape(7, 4).sin()
    with torch.no_grad():
        arcs = torch.cat([torch.zeros(7, 2), bend], dim=1).double()
        metres = arcs @ plain._readings().mT - 0.01  # evenly spaced, 1 cm bends nothing
    q = metres / plain.gains + plain.rest
    assert not elastic.slack(q).any()
    # The stiffnesses take away 1e-9 of the bends.
    assert_close(elastic(q), plain(q), rtol=0.0, atol=1e-8)
    assert_close(elastic.jacobian(q), plain.jacobian(q), rtol=1e-6, atol=1e-13)
    single = ConstantCurvatureChain(**given, dtype=torch.float32)
    assert ElasticTendonChain.from_chain(single).gains.dtype == torch.float32
