import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hybridkin import ConstantCurvatureChain
from hybridkin.datasets import load_trunk
from paper import NotSettledError, TrunkPlant, make_trunk, trunk_data
from paper.mjcf import RADII

pytest.importorskip("mujoco", reason='needs MuJoCo: pip install "hybridkin[sim]"')
IDEAL = {"gravity": 0.0, "base_error": np.zeros(6)}
TURN = Rotation.from_euler("z", 120, degrees=True)


def segment_lengths(lengths, segment):
    """The three lengths of one segment, the others at rest."""
    q = np.full((3, 3), 0.25)
    q[segment] = lengths
    return q.ravel()


@pytest.fixture(scope="module")
def plant():
    return TrunkPlant()


@pytest.fixture(scope="module")
def ideal():
    return TrunkPlant(**IDEAL)


@pytest.fixture(scope="module")
def working():
    """Typical and extreme configurations."""
    rng = np.random.default_rng(0)
    return np.concatenate(
        [
            rng.uniform(0.19, 0.31, (4, 9)),
            rng.choice([0.19, 0.31], (4, 9)),
            rng.uniform(0.1, 0.4, (4, 9)),
        ]
    )


# closed form


def test_quarter_circle_without_gravity(ideal):
    theta, length, r = np.pi / 2, 0.25, RADII[2]
    lengths = length - r * theta * np.cos([0, 2 * np.pi / 3, 4 * np.pi / 3])
    _, pose = ideal.settle(segment_lengths(lengths, 2))
    arc = 2 * length / np.pi
    assert_allclose(pose[:3, 3], [arc, 0, 0.5 + arc], atol=3e-3)
    # The tangent turns towards +x, where the chamber is shortest.
    assert_allclose(pose[:3, 2], [1, 0, 0], atol=1e-2)


@pytest.mark.slow
def test_without_gravity_the_trunk_is_a_constant_curvature_chain(ideal, working):
    chain = ConstantCurvatureChain(RADII)
    for q_target in working[:8]:
        q, pose = ideal.settle(q_target)
        assert_allclose(pose[:3, 3], chain(torch.as_tensor(q)).numpy(), atol=2e-3)


# invariance and sign


@pytest.mark.parametrize("gravity", [0.0, 9.81])
def test_hanging_trunk_turns_with_its_chambers(gravity, working):
    hanging = TrunkPlant(tilt=0.0, gravity=gravity, base_error=np.zeros(6))
    for q_target in working[[0, 5]]:
        turned = np.roll(q_target.reshape(3, 3), 1, axis=1).ravel()
        assert_allclose(hanging(turned), TURN.apply(hanging(q_target)), atol=2e-3)


# the map q -> x


@pytest.mark.slow
def test_lengths_reach_the_command_and_the_pose_is_rigid(plant, working):
    for q_target in working:
        q, pose = plant.settle(q_target)
        assert_allclose(q, q_target, atol=1e-5)
        assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-9)
        assert_allclose(pose[3], [0, 0, 0, 1])


# data of the trunk


def test_shipped_rows_are_reproduced_by_the_plant():
    data = load_trunk()
    plant, seed = TrunkPlant(**data.parameters["plant"]), data.parameters["random_state"]
    for row in (0, 1000, 1999):
        q, pose = plant.settle(data.q_target[row], random_state=[seed, trunk_data.NOISE, row])
        assert_allclose(q, data.q[row], rtol=0, atol=1e-7)
        assert_allclose(pose[:3, 3], data.x[row], rtol=0, atol=1e-7)


@pytest.mark.slow
def test_resumed_data_equal_uninterrupted_ones(monkeypatch, tmp_path):
    small = {"n_segment": 2, "n_random": 4, "random_state": 5}
    monkeypatch.setattr(trunk_data, "CHUNK", 3)
    whole = make_trunk(**small)
    make_trunk(**small, checkpoint=tmp_path)
    first, *_ = sorted(tmp_path.iterdir())
    first.unlink()
    resumed = make_trunk(**small, checkpoint=tmp_path)
    assert_allclose(resumed.q, whole.q, rtol=0, atol=1e-12)
    assert_allclose(resumed.x, whole.x, rtol=0, atol=1e-12)


# not settled


def test_an_unstable_equilibrium_is_not_settled():
    # Straight up is an equilibrium by symmetry, but this trunk would fall over.
    upright = TrunkPlant(tilt=np.pi, torsional_stiffness=50.0, bending_stiffness=0.02)
    with pytest.raises(NotSettledError, match=r"lowest stiffness is -\d"):
        upright.settle(np.full(9, 0.25))
