"""Tips and derivatives of a chain that is evaluated once, as in a calibration, against torch."""

import math

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, ForceTendonChain, RigidChain
from hybridkin.chains.chain import Chain
from hybridkin.native import library

MARKERS = [(0, 0.5), (1, 1.0, (0.0, 0.0, 0.02)), (1, 0.7), (2, 1.0)]
BESIDE = [(0, 0.5, (0.02, 0.0, 0.0)), (2, 1.0)]  # which has no kernel
RADII = [0.01, 0.009, 0.008]
LENGTHS = [0.1, 0.11, 0.09]
PAIR = [0.0, math.pi]
LINK = np.eye(4) + 0.3 * np.eye(4, k=3)


def chambers():
    return ConstantCurvatureChain([0.1, 0.09, 0.08], offsets=[0.01, 0.02, 0.03])


def tendons():
    return ConstantCurvatureChain(RADII, lengths=LENGTHS, routing="base", offsets=0.01)


def elastic():
    return ElasticTendonChain(RADII, LENGTHS, tendon_zeros=2e-4 * np.arange(9), rest_bends=0.1)


CHAINS = {
    "chambers": chambers,
    "tendons": tendons,
    "elastic": elastic,
    "fifteen elastic": lambda: ElasticTendonChain(RADII, LENGTHS, n_actuators=5),
    "part": lambda: tendons().with_tip(1.4),
    "elastic part": lambda: elastic().with_tip(1.4),
    "markers": lambda: chambers().with_markers(MARKERS),
    "elastic markers": lambda: elastic().with_markers(MARKERS),
    "beside": lambda: tendons().with_markers(BESIDE),
    "elastic beside": lambda: elastic().with_markers(BESIDE),
    "mixed": lambda: ConstantCurvatureChain([0.03, 0.01], lengths=[None, 0.1], n_actuators=[3, 4]),
    "stage and pair": lambda: ConstantCurvatureChain(
        [0.01, 0.01, 0.008],
        n_actuators=[1, 3, 2],
        angles=[[0.0], [0.0, 2.0, 4.0], PAIR],
        lengths=[None, 0.1, 0.1],
        routing="base",
        stage="rotation",
    ),
    "arm": lambda: RigidChain([LINK] * 3, np.eye(3), joint_zeros=[0.1, 0.2, 0.3], tool=[0, 0, 0.1]),
}


def moved(chain, generator):
    """Return a chain with another geometry; of an arm only the base is another."""
    entries = {}
    for name, value in chain.geometry().items():
        noise = 0.05 * torch.rand(value.shape, generator=generator, dtype=value.dtype)
        entries[name] = value * (1.0 + noise)
        if name in ("angles", "rest_bends", "offsets"):
            entries[name] = value + 0.1 * noise
    if isinstance(chain, RigidChain):
        entries = {}
    turn = torch.linalg.qr(torch.rand(3, 3, generator=generator, dtype=torch.float64))[0]
    base = torch.eye(4, dtype=torch.float64)
    base[:3, :3] = turn * turn.det()
    base[:3, 3] = 0.1
    return chain.with_geometry(**{**entries, "base": base})


def rows_of(chain, generator, n=40):
    noise = torch.rand(n, chain.n_actuators, generator=generator, dtype=torch.float64) - 0.5
    if getattr(chain, "lengths", None) is None:
        return 0.25 + 0.1 * noise
    return 0.25 * chain.absolute + 0.01 * noise


@pytest.mark.parametrize("name", CHAINS)
def test_once_is_as_often(name):
    """The derivatives are those of forward mode by all entries of the geometry."""
    generator = torch.Generator().manual_seed(0)
    chain = moved(CHAINS[name](), generator)
    q = rows_of(chain, generator)
    tangents = {}
    for entry, value in chain.geometry().items():
        tangents[entry] = torch.rand(4, *value.shape, generator=generator, dtype=torch.float64)
    x = chain(q)
    assert_close(torch.from_numpy(chain.tips_once(q)), x, rtol=0, atol=1e-13)
    expected = Chain.geometry_jacobian(chain, q, tangents)
    size = float(expected.abs().max())
    assert_close(chain.slopes_once(q, tangents), expected, rtol=0, atol=1e-10 * size)


@pytest.mark.parametrize("name", ["chambers", "tendons"])
def test_the_straight_robot(name):
    chain = CHAINS[name]()
    q = torch.full((2, 9), 0.2 * (name == "chambers"), dtype=torch.float64)
    tangents = {k: torch.ones(1, *a.shape).to(a) for k, a in chain.geometry().items()}
    length = 0.66 if name == "chambers" else 0.33
    tip = torch.tensor([[0.0, 0.0, length]] * 2, dtype=torch.float64)
    assert_close(torch.from_numpy(chain.tips_once(q)), tip, rtol=0, atol=1e-15)
    expected = Chain.geometry_jacobian(chain, q, tangents)
    assert_close(chain.slopes_once(q, tangents), expected, rtol=0, atol=1e-13)


@pytest.mark.parametrize("at", [0.5, 1.0, 2.0])
def test_several_arcs_in_a_segment(at):
    chain = ForceTendonChain([0.01, 0.009], [0.1, 0.11], 1e-3, 50.0, arcs=3, offsets=[0.01, 0.02])
    chain = chain.with_tip(at)
    q = 0.3 * torch.rand(4, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    tangents = {k: torch.ones(2, *a.shape).to(a) for k, a in chain.geometry().items()}
    expected = chain.geometry_jacobian(q, tangents)
    size = float(expected.abs().max())
    assert_close(chain.slopes_once(q, tangents), expected, rtol=0, atol=1e-10 * size)
    assert_close(torch.from_numpy(chain.tips_once(q)), chain(q), rtol=0, atol=1e-9)


def test_a_class_that_computes_something_else():
    class Shifted(ConstantCurvatureChain):
        def forward(self, q):
            return super().forward(q) + 1.0

    chain = Shifted(RADII, lengths=LENGTHS)
    q = torch.zeros(2, 9, dtype=torch.float64)
    assert_close(torch.from_numpy(chain.tips_once(q)), chain(q), rtol=0, atol=0)


@pytest.mark.needs_core
def test_chains_of_one_structure_share_a_program():
    q = 0.01 * torch.rand(5, 9, generator=torch.manual_seed(0), dtype=torch.float64)
    chain = tendons()
    other = chain.with_geometry(offsets=2.0 * chain.offsets, radii=1.1 * chain.radii)
    assert chain._program_of_arcs() is other._program_of_arcs()
    assert chain._program_of_arcs() is not chain.with_tip(1.5)._program_of_arcs()
    other.tips_once(q)
    assert "_program" not in vars(other)  # it has no plan of its own


@pytest.mark.needs_core
def test_only_a_chain_with_a_table_keeps_it():
    chain = elastic()
    tangents = {"radii": torch.ones(1, 3, dtype=torch.float64)}
    q = rows_of(chain, torch.manual_seed(0))
    chain.slopes_once(q, tangents)
    assert "_table" not in vars(chain).get("_derived", {})
    chain.geometry_jacobian(q, tangents)
    assert "_table" in vars(chain)["_derived"]


def test_without_the_core_torch_computes(monkeypatch):
    chain = elastic()
    q = rows_of(chain, torch.manual_seed(0))
    tangents = {k: torch.ones(1, *a.shape).to(a) for k, a in chain.geometry().items()}
    J = chain.slopes_once(q, tangents)
    monkeypatch.setenv("HYBRIDKIN_NATIVE", "off")
    library._opened.cache_clear()
    try:
        for alike in (elastic(), tendons()):
            assert alike._program_of_arcs() is None
            tips = torch.from_numpy(alike.tips_once(q))
            assert_close(tips, alike(q), rtol=0, atol=1e-15)
        again = elastic().slopes_once(q, tangents)
    finally:
        library._opened.cache_clear()
    assert_close(again, J, rtol=1e-10, atol=1e-12)
