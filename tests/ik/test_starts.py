import numpy as np
import pytest
import torch
from torch.testing import assert_close

from hybridkin import ConstantCurvatureChain, ElasticTendonChain
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


@pytest.mark.slow
def test_starts_are_the_same_in_every_call_and_leave_the_generators_alone(rng):
    chain, low, high = ROBOTS["tendons"]
    target = chain(corners(rng, chain, low, high, 12))
    ik = InverseKinematics(chain, q_min=low, q_max=high)
    torch_state, numpy_state = torch.get_rng_state(), np.random.get_state()[1].copy()  # noqa: NPY002
    solution, again = ik.solve(target), ik.solve(target)
    assert solution.n_starts.max() > 1
    assert torch.equal(solution.q, again.q)
    assert torch.equal(torch_state, torch.get_rng_state())
    np.testing.assert_array_equal(numpy_state, np.random.get_state()[1])  # noqa: NPY002
    rows = torch.stack([ik.solve(row).q for row in target])
    assert_close(rows, solution.q, rtol=0.0, atol=1e-8)


def test_lengths_stay_positive_without_limits(rng):
    q = 0.1 + 0.3 * torch.rand(100, 9, generator=rng).double()
    solution = InverseKinematics(TRUNK).solve(TRUNK(q), q.flip(0))
    assert solution.converged.all()
    assert solution.q.min() >= 0.0
    assert InverseKinematics(TENDONS).settings.q_min == -torch.inf


@pytest.mark.slow
def test_further_starts_lie_around_the_first_one_where_there_are_no_limits(rng):
    target = ELASTIC(corners(rng, ELASTIC, -0.02, 0.02, 40))
    start = 0.02 * (2.0 * torch.rand(40, 6, generator=rng).double() - 1.0)
    ik = InverseKinematics(ELASTIC, q_min=-0.02)
    once, solution = ik.solve(target, start, restarts=0), ik.solve(target, start)
    assert solution.converged.double().mean() > 0.85 > 0.75 > once.converged.double().mean()
    assert solution.q.min() >= -0.02
    assert solution.q.max() < 0.2
