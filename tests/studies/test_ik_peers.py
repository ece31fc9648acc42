import numpy as np
import pytest
import torch
from ik_peers import (
    ARMS,
    PROGRAMS,
    branches,
    compared,
    installed,
    main,
    peers_report,
    solved,
    ur5_branches,
)

from hybridkin import RigidChain


@pytest.mark.parametrize("name", ARMS)
def test_poses_by_products_are_those_of_the_arm_from_its_urdf(name):
    arm, draw = ARMS[name], np.random.default_rng(0)
    chain = RigidChain.from_urdf(arm.urdf(), "tip")
    low, high = arm.limits
    np.testing.assert_allclose(chain.q_min, low)
    np.testing.assert_allclose(chain.q_max, high)
    q = arm.draw(20, draw)
    assert ((q >= low) & (q <= high)).all()
    poses = arm.poses(q)
    np.testing.assert_allclose(chain.pose(torch.from_numpy(q)), poses, atol=1e-12)
    assert solved(arm, q, poses).all()
    assert not solved(arm, q + 0.1, poses).any()
    assert not solved(arm, np.where(np.arange(q.shape[1]) == 2, 9.0, q), poses).any()


@pytest.mark.parametrize("program", PROGRAMS)
def test_every_program_solves_what_it_counts(program):
    if not installed(program):
        pytest.skip(f"{program} is not installed")
    entries = compared(12, programs=[program], starts={program: [10]})
    assert [entry["arm"] for entry in entries] == [*ARMS]
    assert all(entry["share"] >= 0.8 and entry["seconds"] > 0.0 for entry in entries)


def test_branches_of_the_ur5_in_closed_form():
    """At a wrist that is out of reach there are none, near the shoulder's axis none either."""
    far, near = np.eye(4), np.eye(4)
    far[:3, 3], near[:3, 3] = [2.0, 0.0, 0.0], [0.02, 0.0, 0.5]
    assert ur5_branches(np.stack([far, near])).tolist() == [0, 0]
    poses = ARMS["ur5, 6 joints"].poses(ARMS["ur5, 6 joints"].draw(200, np.random.default_rng(1)))
    counts = np.bincount(ur5_branches(poses), minlength=9)
    assert counts[0] == counts[1::2].sum() == 0
    assert counts[8] > 100


@pytest.mark.slow
def test_nearly_all_branches_are_found_and_reported(tmp_path, capsys):
    (few, many) = branches(40, (8, 128))
    assert few["found"] < many["found"] <= many["there"]
    assert many["found"] >= 0.98 * many["there"]
    assert many["too_many"] <= 1
    entries = compared(30, programs=["hybridkin"])
    assert {entry["share"] for entry in entries if entry["starts"] == 33} == {1.0}
    text = "".join(path.read_text() for path in peers_report(entries, [few]).write(tmp_path / "a"))
    assert text.count("| hybridkin |") == 9
    main(["--out", str(tmp_path / "b"), "--programs", "hybridkin", "--targets", "10"])
    assert (tmp_path / "b" / "report.md").is_file()
    assert "33 starts" in capsys.readouterr().err
