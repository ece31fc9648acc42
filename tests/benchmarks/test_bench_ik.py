"""Inverse kinematics of a nine-joint arm in batch, against pytorch_kinematics on the same arm.

Both start every target from the same configuration, to the same tolerances and within the same
limits; what is counted is targets reached per CPU second. The peer solves for poses only, so that
the position task is measured against its pose task as well.
"""

import math
import warnings

import pytest
import torch

from hybridkin import InverseKinematics, RigidChain
from hybridkin.ik.tasks import PoseTask

TOL = (1e-3, 1e-2)  # [m], [rad]
BATCH = 10_000
ITERATIONS = 15  # the peer's best: further ones cost it time and reach next to nothing


@pytest.fixture(scope="module")
def problem(urdf):
    chain = RigidChain.from_urdf(urdf, "link9")
    rng = torch.Generator().manual_seed(0)

    def targets(n):
        share = torch.rand(n, chain.n_actuators, generator=rng, dtype=torch.float64)
        return chain.poses(torch.lerp(chain.q_min, chain.q_max, share))[:, -1]

    return chain, targets


def peer_of(arm, chain, n_starts):
    from pytorch_kinematics import PseudoInverseIK, Transform3d

    rng = torch.Generator().manual_seed(1)
    share = torch.rand(n_starts - 1, 9, generator=rng, dtype=torch.float64)
    starts = torch.cat([start(chain)[None], torch.lerp(chain.q_min, chain.q_max, share)])
    solver = PseudoInverseIK(
        arm,
        pos_tolerance=TOL[0],
        rot_tolerance=TOL[1],
        retry_configs=starts,
        max_iterations=ITERATIONS,
        early_stopping_any_converged=True,
        early_stopping_no_improvement=None,
    )

    def solve(poses):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return int(solver.solve(Transform3d(matrix=poses)).converged_any.sum())

    return solve


def start(chain):
    return torch.full_like(chain.q_min, 0.3)


@pytest.mark.parametrize("n_starts", [1, 3])
@pytest.mark.parametrize("what", ["position", "pose"])
def test_reached_targets_per_second_against_pytorch_kinematics(
    race, arm, problem, timed, what, n_starts
):
    chain, draw = problem
    poses = draw(BATCH if timed else 8)
    model, target, q0, tol = PoseTask(chain), poses.numpy(), start(chain).numpy(), TOL
    if what == "position":
        model, target, tol = chain, poses[:, :3, 3].numpy(), TOL[0]
    # As the peer, which has no preferred posture.
    ik = InverseKinematics(model, q_min=chain.q_min, q_max=chain.q_max, beta=0.0)
    peer = peer_of(arm, chain, n_starts)

    def ours():
        return ik.solve(target, q0, tol=tol, restarts=n_starts - 1).converged

    reached, by_peer = int(ours().sum()), peer(poses)
    assert reached >= 0.9 * len(poses)
    share = [math.floor(100 * n / len(poses)) for n in (reached, by_peer)]
    race(
        f"solve, {what}, {n_starts} start{'s' * (n_starts > 1)}, {share[0]} % reached",
        f"pytorch_kinematics: pose, {share[1]} %",
        ours,
        lambda: peer(poses),
        rows=reached,
        peer_rows=by_peer,
        at_least=30 if what == "position" else 10,
    )
