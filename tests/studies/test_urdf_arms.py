import pytest
import urdf_arms

URDF = """<robot name="r"><link name="a"/><link name="b"/><link name="c"/><link name="d"/>
<joint name="f" type="floating"><parent link="a"/><child link="b"/></joint>
<joint name="j" type="continuous"><parent link="b"/><child link="c"/><axis xyz="0 1 1"/></joint>
<joint name="k" type="prismatic"><parent link="c"/><child link="d"/>
<limit lower="0" upper="1" effort="1" velocity="1"/>
<mimic joint="j" multiplier="2" offset="0.1"/></joint></robot>"""


def test_leaf_links_are_compared_with_pinocchio(tmp_path):
    pytest.importorskip("pinocchio")
    path = tmp_path / "arm.urdf"
    path.write_text(URDF)
    (entry,) = urdf_arms.study([path], n=3)
    assert (entry["leaves"], entry["read"], entry["refused"]) == (1, 1, [])
    assert max(entry["pose"], entry["jacobian"]) < 1e-14


def test_without_the_packages_it_says_what_it_needs(monkeypatch, tmp_path):
    def absent(name):
        raise ImportError(name)

    monkeypatch.setattr(urdf_arms, "import_module", absent)
    with pytest.raises(SystemExit, match="pip install pin example-robot-data"):
        urdf_arms.main(["--out", str(tmp_path)])


def test_the_report_counts_leaf_links(tmp_path):
    entry = {"file": "a.urdf", "leaves": 3, "read": 2, "refused": ["x: no"]}
    report = urdf_arms.urdf_report([{**entry, "pose": 1e-15, "jacobian": 2e-15}])
    report.write(tmp_path / "out")
    text = (tmp_path / "out" / "report.md").read_text()
    assert "Of 3 leaf links in 1 files that pinocchio reads, 2 are read." in text
    assert "| a.urdf | 3 | 2 | 1e-15 | 2e-15 |" in text
    assert "a.urdf: x: no" in text
