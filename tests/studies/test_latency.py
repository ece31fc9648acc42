import shutil

import pytest
from latency import c_loop, latency_report, python_loop

from hybridkin import ConstantCurvatureChain, InverseKinematics


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler `cc`")
def test_every_tick_of_both_loops_is_counted(tmp_path):
    chain = ConstantCurvatureChain([0.100, 0.093, 0.079])
    ik = InverseKinematics(chain, q_min=0.15, q_max=0.35, dt=1e-3)
    found = {"Python": python_loop(ik, 50), "C": c_loop(ik, 50)}
    for one in found.values():
        assert one.after.sum() == one.step.sum() == 50
        assert 0.0 < one.worst_step <= one.worst_after
    report = latency_report(found)
    report.write(tmp_path / "out")
    assert [row[:2] for row in report.record["table"]] == [["Python", "50"], ["C", "50"]]
    assert (tmp_path / "out" / "latency.png").stat().st_size > 5000
