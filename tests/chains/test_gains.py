"""Actuators that count in another unit than metres."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, ForceTendonChain
from hybridkin.chains.chain import Chain
from hybridkin.native.library import evaluate

COUNTS = torch.tensor([2e-5, -3e-5, 2.5e-5, 1e-5, 4e-5, -2e-5], dtype=torch.float64)
ZEROS = torch.tensor([500.0, -200.0, 0.0, 30.0, 1000.0, 2048.0], dtype=torch.float64)
KINDS = {
    "extensible": (ConstantCurvatureChain, {}),
    "tendons": (ConstantCurvatureChain, {"lengths": [0.1, 0.08], "routing": "base"}),
    "elastic": (ElasticTendonChain, {"lengths": [0.1, 0.08], "tendon_zeros": 5e-4}),
    "forces": (
        ForceTendonChain,
        {
            "lengths": [0.1, 0.08],
            "bending_stiffness": [0.02, 0.01],
            "axial_stiffness": 100.0,
            "weight": 0.5,
            "arcs": 2,
        },
    ),
}


def pair(kind, tip_at=1.6):
    """Return a chain in metres, the same one in counts, and rows of both."""
    cls, options = KINDS[kind]
    given = {"radii": [0.01, 0.008], "rest_bends": 0.05, "offsets": [0.01, 0.02], **options}
    plain = cls(**given).with_tip(tip_at)
    zeros = {} if kind in ("elastic", "forces") else {"actuator_zeros": ZEROS}
    counted = cls(**given, gains=COUNTS, **zeros).with_tip(tip_at)
    metres = 0.004 * torch.randn(20, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    metres = metres + 0.1 * (kind == "extensible")
    if kind == "forces":
        metres = 1e3 * metres.abs()  # [N]
    return plain, counted, metres, metres / COUNTS + counted.rest


@pytest.mark.parametrize("kind", KINDS)
def test_the_unit_of_q_changes_nothing(kind):
    plain, counted, metres, q = pair(kind)
    for of in ("forward", "pose", "poses", "backbone", "arcs"):
        assert_close(getattr(counted, of)(q), getattr(plain, of)(metres), atol=1e-12, rtol=0)
    for of in ("jacobian", "pose_jacobian"):
        scaled = getattr(plain, of)(metres) * COUNTS
        assert_close(getattr(counted, of)(q), scaled, atol=1e-16, rtol=1e-9)
    z, slope = counted.coordinates(q)
    assert_close(z, plain.coordinates(metres)[0])
    assert_close(slope, plain.coordinates(metres)[1] * COUNTS)
    if kind == "elastic":
        assert_close(counted.tensions(q), plain.tensions(metres))
        assert_close(counted.slack(q), plain.slack(metres))
        assert counted.slack(q).any()
        assert_close(counted.pulls, -COUNTS.sign())
    elif kind == "forces":
        assert_close(counted.forces(q), metres)
        assert counted.check_actuators(q) == []
        with pytest.raises(ValueError, match="20 of 20 rows"):
            counted.check_actuators(-q)
    else:
        assert_close(counted.consistency(q), plain.consistency(metres))
        assert_close(counted.contradictory(q), plain.contradictory(metres))
        assert counted.contradictions(q) == plain.contradictions(metres)
    if kind != "forces":
        assert_close(counted.metres(q), metres)
        in_counts, in_metres = counted.plausible_rows(), plain.plausible_rows()
        assert_close(in_counts.rest, counted.rest.numpy())
        assert_close(in_counts.weights, in_metres.weights * COUNTS.numpy())
    x, J = evaluate(counted, q.numpy(), jacobian=True)  # the compiled core, where there is one
    assert_close(torch.from_numpy(x), plain(metres), atol=1e-12, rtol=0)
    assert_close(torch.from_numpy(J), plain.jacobian(metres) * COUNTS, atol=1e-15, rtol=1e-8)
    assert counted.unit_messages(q, "q") == []
    assert len(counted.unit_messages(2e3 * q, "q")) == (kind != "forces")
    assert counted(q.float()).dtype == torch.float32


@pytest.mark.parametrize("kind", KINDS)
def test_derivatives_by_gains_and_zeros(kind):
    _, chain, _, q = pair(kind)
    names = [name for name in chain.geometry() if name.endswith("zeros")]
    tangents = {"gains": torch.diag(COUNTS)}
    tangents |= {name: torch.eye(6, dtype=torch.float64) for name in names}
    found = chain.geometry_jacobian(q, tangents)
    assert_close(found, Chain.geometry_jacobian(chain, q, tangents), rtol=1e-8, atol=1e-12)
    assert found.abs().amax((0, 1)).min() > 0


def test_the_stage_turns_the_frame_by_its_own_gain():
    gains = [2.0, 1e-3, 1e-3, 1e-3]
    given = {"n_actuators": [1, 3], "lengths": [None, 0.1], "stage": "rotation", "gains": gains}
    chain = ConstantCurvatureChain([0.01, 0.01], **given)
    q = torch.tensor([[0.3, 1.0, -2.0, 1.0], [0.0, 0.0, 0.0, 0.0]], dtype=torch.float64)
    turn = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64).expand(2, 3)
    assert_close(chain.pose_jacobian(q)[:, 3:, 0], turn, rtol=0, atol=1e-14)


def test_gains_of_all_of_segments_and_of_actuators():
    def gains(value):
        return ConstantCurvatureChain([0.01, 0.01], n_actuators=[3, 4], gains=value).gains.tolist()

    assert gains(2.0) == [2.0] * 7
    assert gains([2.0, -1.0]) == [2.0] * 3 + [-1.0] * 4
    assert gains(torch.tensor([2.0, -1.0])) == [2.0] * 3 + [-1.0] * 4
    assert gains([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 7.0]]) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    assert gains(np.arange(1.0, 8.0)) == [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]
    with pytest.raises(ValueError, match=r"`gains` must not be zero .m per unit of q., got 0"):
        gains(0.0)
    with pytest.raises(ValueError, match=r"`gains` must have shape .7,., or be one number"):
        gains([1.0, 2.0, 3.0])
    with pytest.raises(ValueError, match="`gains` must be finite"):
        gains(float("nan"))


def test_no_tip_is_farther_than_the_longest_robot():
    """For every q within a bound, also of a chain in counts whose zeros are far from it."""
    rows = torch.rand(200, 6, generator=torch.manual_seed(1), dtype=torch.float64)
    for kind in ("extensible", "tendons", "elastic"):
        _, counted, _, q = pair(kind, tip_at=2.0)
        largest = q.abs().amax(0)
        inside = (2.0 * rows - 1.0) * largest
        away = torch.linalg.vector_norm(counted(inside), dim=-1).max()
        assert away <= counted.longest(largest)
        assert (counted.misses(counted(inside), largest) <= 0.0).all()


def test_lengths_are_positive_in_metres():
    chain = ConstantCurvatureChain([0.01], gains=[2e-5, 2e-5, -2e-5], actuator_zeros=100.0)
    assert chain.limits["q_min"].tolist() == [100.0, 100.0, -np.inf]
    assert chain.limits["q_max"].tolist() == [np.inf, np.inf, 100.0]
    assert chain.check_actuators(torch.tensor([[110.0, 120.0, -50.0]])) == []
    with pytest.raises(ValueError, match=r"positive actuator lengths .m., got -0\.001 in row 1"):
        chain.check_actuators(torch.tensor([[110.0, 120.0, -50.0], [110.0, 50.0, -50.0]]))
    (message,) = chain.check_actuators(torch.tensor([[1e6, 120.0, -50.0]]))
    assert message.startswith("`q` times `gains` reaches 20, which looks like millimetres")
    # Small numbers may be speeds: they are no lengths of 20 m where the zeros are far.
    far = ConstantCurvatureChain([0.01], gains=2e-5, actuator_zeros=1e6)
    assert far.unit_messages(torch.full((1, 3), 100.0), "dq_max") == []
