import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain, ForwardModel
from hybridkin.ik._starts import even_starts, nearest_starts
from hybridkin.ik.solver import IKStatus, InverseKinematics

TRUNK = ConstantCurvatureChain([0.100, 0.093, 0.079])
TENDONS = ConstantCurvatureChain([0.02] * 2, lengths=[0.1] * 2, routing="base")
ELASTIC = ElasticTendonChain([0.02] * 2, [0.1] * 2)
ROBOTS = {"trunk": (TRUNK, 0.1, 0.4), "tendons": (TENDONS, -0.02, 0.02)}
ROBOTS["elastic"] = (ELASTIC, -0.02, 0.02)
RESTARTS = 32


class Counted(torch.nn.Module):
    """A chain that counts the rows it is evaluated on."""

    def __init__(self, chain):
        super().__init__()
        self.chain, self.n_actuators, self.rows = chain, chain.n_actuators, 0

    def forward(self, q):
        return self.forward_and_jacobian(q)[0]

    def forward_and_jacobian(self, q):
        self.rows += len(q)
        return self.chain.forward_and_jacobian(q)


def corners(rng, chain, low, high, n):
    return low + (high - low) * torch.rand(n, chain.n_actuators, generator=rng).round().double()


@pytest.mark.slow
@pytest.mark.parametrize("name", ROBOTS)
def test_targets_of_corners_are_reached_from_further_starts(rng, name):
    chain, low, high = ROBOTS[name]
    target = chain(corners(rng, chain, low, high, 40))
    start = low + (high - low) * torch.rand(40, chain.n_actuators, generator=rng).double()
    ik = InverseKinematics(chain, q_min=low, q_max=high)
    once, solution = ik.solve(target, start, restarts=0), ik.solve(target, start)
    assert (once.status == IKStatus.MAX_ITER).any()
    assert not (once.status == IKStatus.UNREACHABLE).any()  # each one can be reached
    assert solution.converged.all()
    assert ((solution.q >= low) & (solution.q <= high)).all()
    assert (chain(solution.q) - target).norm(dim=-1).max() <= 1e-4
    # Where one start was enough nothing has changed.
    first = once.converged
    assert_close(solution.q[first], once.q[first], rtol=0.0, atol=1e-8)
    assert (solution.n_starts[first] == once.n_starts[first]).all()
    assert (solution.n_starts[~first] > 1).all()
    assert (solution.n_iter[~first] > once.n_iter[~first]).all()


@pytest.mark.slow
def test_a_miss_is_said_after_all_starts_at_a_bounded_cost():
    model = Counted(TRUNK)
    ik = InverseKinematics(model, q_min=[0.1] * 9, q_max=0.4)
    target = torch.tensor([[0.0, 0.0, 1.5], [0.9, 0.9, 0.9]]).double()
    once = ik.solve(target, restarts=0)
    assert once.n_starts.tolist() == [1, 1]
    assert "starts" not in repr(once)
    model.rows = 0
    solution = ik.solve(target)
    assert (solution.status == IKStatus.MAX_ITER).all()
    assert solution.n_starts.tolist() == [1 + RESTARTS] * 2
    assert f"up to {1 + RESTARTS} starts" in repr(solution)
    assert (solution.error <= once.error).all()
    # One sample for both, and the iterations of every start.
    assert model.rows < 2048 + int((solution.n_iter + 2 * solution.n_starts).sum())
    assert ik.solve(target, restarts=3).n_starts.tolist() == [4, 4]


class HalfKnown(ForwardModel):
    """A robot x = q that is known for positive q1."""

    n_actuators, n_outputs = 3, 3

    def forward(self, q):
        return 1.0 * q

    def domain_distance(self, q):
        return torch.where(q[..., 0] > 0.0, 0.5, 2.0).to(q)


def test_starts_outside_the_domain_count_as_four_times_as_far():
    settings = InverseKinematics(HalfKnown(), q_min=-1.0, q_max=1.0).settings
    start, target = torch.zeros(1, 3).double(), torch.tensor([[-0.05, 0.1, 0.2]]).double()
    sample = even_starts(settings, start, start[:, 0], 2048)[0]
    distance = (sample - target).norm(dim=-1)
    distance = torch.where(sample[:, 0] > 0.0, distance, 4.0 * distance)
    nearest = nearest_starts(settings, start, start[:, 0], target, 400)[0]
    assert_close(nearest, sample[distance.argsort()[:400]])
    assert 0 < (nearest[:, 0] <= 0.0).sum() < 100
