"""Chains with several markers: places, offsets, derivatives, the compiled core."""

import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain
from hybridkin.chains.chain import Chain
from hybridkin.native.library import evaluate, program_of

MARKERS = [
    (0, 0.5, (0.02, 0.0, 0.0)),
    (1, 1.0, (0.0, 0.01, -0.02)),
    (1, 0.7),
    (2, 1.0, (0, 0, 0.03)),
]
OFFSETS = [0.01, 0.02, 0.03]
CHAINS = {
    "extensible": lambda: ConstantCurvatureChain([0.1, 0.09, 0.08], offsets=OFFSETS),
    "tendons": lambda: ConstantCurvatureChain(
        [0.01, 0.009, 0.008], lengths=[0.1, 0.1, 0.09], routing="base", offsets=OFFSETS
    ),
    "elastic": lambda: ElasticTendonChain([0.01, 0.009, 0.008], [0.1, 0.1, 0.09], offsets=OFFSETS),
}


def rows_of(chain, n=12):
    noise = torch.randn(n, 9, generator=torch.manual_seed(0), dtype=torch.float64)
    return 0.25 + 0.03 * noise if chain.lengths is None else 0.002 * noise


@pytest.fixture(params=CHAINS)
def chain(request):
    return CHAINS[request.param]()


def test_a_marker_on_a_quarter_circle():
    length, radius = 0.1, 0.01
    psi = 2.0 * np.pi / 3.0 * np.arange(3)
    q = torch.from_numpy(-radius * 0.5 * np.pi * np.cos(psi))
    chain = ConstantCurvatureChain([radius], lengths=[length])
    marked = chain.with_markers([(0, 0.5), (0, 1.0, (0.0, 0.002, 0.003))])
    R = length / (0.5 * np.pi)
    s = np.sqrt(0.5)
    assert_close(marked(q), torch.tensor([R - R * s, 0, R * s, R + 0.003, 0.002, R]).to(q))


def test_markers_are_points_in_the_frames_of_the_robot(chain):
    q = rows_of(chain)
    marked = chain.with_markers([(0, 1.0, (0.01, 0.02, 0.03)), (2, 1.0, (0.0, 0.0, 0.05))])
    frames = chain.poses(q)[:, [1, 3]]
    beside = q.new_tensor([[0.01, 0.02, 0.03, 1.0], [0.0, 0.0, 0.05, 1.0]])
    expected = (frames @ beside[..., None])[..., :3, 0].flatten(1)
    assert_close(marked(q), expected)
    assert_close(marked.pose(q)[:, :3, 3], expected[:, 3:])
    assert marked.n_outputs == 6


def test_all_derivatives_of_several_markers(chain):
    marked, q = chain.with_markers(MARKERS), rows_of(chain)
    x, J = marked.forward_and_jacobian(q)
    assert_close(x, marked(q))
    assert_close(J, torch.stack([torch.func.jacrev(marked)(row) for row in q]))
    z, slope = marked.coordinates(q)
    assert_close(marked.from_coordinates(z), x)
    again, by_z = marked.from_coordinates_and_jacobian(z)
    assert_close(again, x)
    assert_close(by_z @ slope, J)
    tangents = {name: torch.ones(1, *a.shape).to(a) for name, a in marked.geometry().items()}
    expected = Chain.geometry_jacobian(marked, q, tangents)
    assert_close(marked.geometry_jacobian(q, tangents), expected, atol=1e-9, rtol=1e-9)


@pytest.mark.parametrize("k", range(4))
def test_the_compiled_core_has_one_marker(chain, k):
    """Beside the backbone torch computes it."""
    marked, q = chain.with_markers(MARKERS), rows_of(chain)
    one = marked.each_tip()[k]
    x, J = (part[:, 3 * k : 3 * k + 3] for part in marked.forward_and_jacobian(q))
    found, slope = evaluate(one, q.numpy(), jacobian=True)
    assert_close(torch.from_numpy(found), x, rtol=1e-11, atol=1e-13)
    assert_close(torch.from_numpy(slope), J, rtol=1e-9, atol=1e-10)
    assert_close(one.pose_jacobian(q)[:, :3], J)
    assert (program_of(one) is not None) == (k > 1 and program_of(chain) is not None)


@pytest.mark.parametrize(
    ("markers", "match"),
    [
        ([], "got none"),
        ([(3, 1.0)], "segment from 0 to 2"),
        ([(0, 0.0)], "fraction in"),
        ([(0, 1.0, (0.0, 0.1))], "shape"),
        ([(0, 1.0, (0.0, 0.0, float("nan")))], "finite"),
    ],
)
def test_wrong_markers_raise(markers, match):
    with pytest.raises(ValueError, match=match):
        CHAINS["extensible"]().with_markers(markers)


def test_markers_on_a_rotation_stage_lie_on_the_backbone():
    counts, lengths = [1, 3], [None, 0.1]
    chain = ConstantCurvatureChain(
        [0.01, 0.01], n_actuators=counts, lengths=lengths, stage="rotation"
    )
    q = torch.tensor([[0.7, 0.001, -0.002, 0.001]], dtype=torch.float64)
    marked = chain.with_markers([(1, 0.5), (1, 1.0, (0.0, 0.0, 0.02))])
    points = [chain.with_tip(1.5)(q), (chain.pose(q) @ q.new_tensor([0.0, 0.0, 0.02, 1.0]))[:, :3]]
    assert_close(marked(q), torch.cat(points, dim=1))
    with pytest.raises(ValueError, match="on the backbone"):
        chain.with_markers([(1, 1.0, (0.01, 0.0, 0.0))])
