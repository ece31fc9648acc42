"""The experiment on several markers: its rows, what it repeats, what it shows."""

import numpy as np
import pytest
import torch
from markers import ENDS, MARKERS, Case, examined, study, write

from hybridkin import robots

pytestmark = pytest.mark.slow


def test_one_marker_is_the_tip_of_three():
    rng = np.random.default_rng(0)
    chain = robots.bionic_handling_assistant().with_markers(ENDS)
    q = 0.25 + 0.02 * rng.standard_normal((60, 9))
    x = chain(torch.from_numpy(q)).numpy() + 1e-3 * rng.standard_normal(q.shape)
    case = Case("a robot", 0, chain, (q[:20], x[:20], None), (q[20:], x[20:]))
    (entry,) = examined(case, ["calibrated chain"])
    assert (entry["n"], entry["model"]) == (20, "calibrated chain")
    assert {entry[name]["n_test"] for name in MARKERS} == {40}
    assert all(entry[name]["mean"] <= entry[name]["max"] for name in MARKERS)


def test_the_study_of_the_simulated_trunks(tmp_path):
    pytest.importorskip("mujoco")
    given = {"n_test": 10, "models": ["calibrated chain"], "data_home": tmp_path}
    with pytest.warns(UserWarning, match="Left out: asl_trunk_static"):
        entries = study((12,), 1, **given, folder=tmp_path)
    assert [entry["robot"] for entry in entries] == ["trunk 1", "trunk 2"]
    for entry in entries:
        assert 0.0 < entry["three"]["mean"] < 0.1
    report = write(entries)
    report.write(tmp_path / "out")
    lines = (tmp_path / "out" / "markers.csv").read_text().splitlines()
    assert lines[0] == "robot,rows,model,tip_alone_mm,three_markers_mm"
    assert [line.split(",")[:2] for line in lines[1::2]] == [["trunk 1", "12"], ["trunk 2", "12"]]
    text = report.markdown()
    assert "## trunk 2" in text
    assert (
        f"{1e3 * entries[0]['one']['mean']:.2f} / {1e3 * entries[0]['three']['mean']:.2f}" in text
    )
