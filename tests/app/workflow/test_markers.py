"""Logs of several markers: from the file to the report, a model and a track."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, open_model, robots
from hybridkin.app.workflow import FitSettings, evaluate_log, fit_log, read_log
from hybridkin.app.workflow.model import tips_at
from hybridkin.datasets import load_log

ROBOT = """
calibrate = ["radii", "base"]

[[segment]]
radius = 0.011
length = 0.1
repeat = 2

[log]
q = ["a", "b", "c", "d", "e", "f"]
x = ["x0", "y0", "z0", "x1", "y1", "z1"]
x_unit = "mm"
groups = "motion"
markers = [[0, 1.0, 0.01, 0, 0], [1, 1.0, 0, 0, 0]]
"""
MARKERS = [(0, 1.0, (0.01, 0.0, 0.0)), (1, 1.0)]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A robot, and a log of it in which every fourth row lacks the first marker, one the tip."""
    folder = tmp_path_factory.mktemp("markers")
    (folder / "robot.toml").write_text(ROBOT)
    rng = np.random.default_rng(0)
    groups = np.repeat(np.arange(8), 8)
    q = 0.003 * rng.uniform(-1.0, 1.0, (64, 2, 3))
    q = (q - q.mean(2, keepdims=True)).reshape(64, 6)
    truth = ConstantCurvatureChain([0.01, 0.01], lengths=[0.1, 0.1]).with_markers(MARKERS)
    x = 1e3 * truth(torch.from_numpy(q)).numpy() + 0.3 * rng.standard_normal((64, 6))
    cells = np.column_stack([q, x]).astype(str)
    cells[::4, 6:9] = ""
    cells[5, 11] = "nan"  # one coordinate of the tip
    lines = [",".join([*row, f"m{k}"]) for row, k in zip(cells, groups, strict=True)]
    header = "a,b,c,d,e,f,x0,y0,z0,x1,y1,z1,motion\n"
    (folder / "log.csv").write_text(header + "\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize(
    ("old", "new", "match"),
    [
        ('"z1"]', '"z1", "u"]', "3 column names, or 3 for each of `markers`"),
        ("markers =", "# markers =", "3 column names, or 3 for each of `markers`"),
        ("[1, 1.0, 0, 0, 0]", "[2, 1.0, 0, 0, 0]", "segment from 0 to 1"),
        ("[1, 1.0, 0, 0, 0]", "[1, 1.0]", r"lists \[segment, fraction"),
    ],
)
def test_wrong_markers_of_a_description_raise(tmp_path, old, new, match):
    (tmp_path / "robot.toml").write_text(ROBOT.replace(old, new))
    with pytest.raises(ValueError, match=match):
        robots.read_description(tmp_path / "robot.toml")


def test_rows_with_a_marker_stay_and_rows_without_any_are_dropped(folder, tmp_path):
    columns = [f"{axis}{k}" for k in (0, 1) for axis in "xyz"]
    log = load_log(folder / "log.csv", [*"abcdef"], columns, x_unit="mm")
    assert log.x.shape == (64, 6)
    np.testing.assert_array_equal(np.isnan(log.x[:, 0]), np.arange(64) % 4 == 0)
    np.testing.assert_array_equal(np.isnan(log.x[:, 5]), np.arange(64) == 5)
    assert np.isnan(log.x[5, 3:]).all()
    lines = (folder / "log.csv").read_text().splitlines()
    cells = lines[2].split(",")
    cells[6:12] = [""] * 6
    lines[2] = ",".join(cells)
    (tmp_path / "log.csv").write_text("\n".join(lines))
    with pytest.raises(ValueError, match=r"1 of 64 rows .* \(line 3\)"):
        load_log(tmp_path / "log.csv", [*"abcdef"], columns, x_unit="mm")
    dropped = load_log(tmp_path / "log.csv", [*"abcdef"], columns, x_unit="mm", drop_invalid=True)
    assert dropped.invalid_lines.tolist() == [3]


@pytest.mark.slow
def test_a_fit_reports_every_marker_and_its_model_steers_the_tip(folder):
    robot = robots.read_description(folder / "robot.toml")
    log = read_log(folder / "log.csv", robot.log, chain=robot.chain)
    out = folder / "fit"
    settings = FitSettings(auto=False, n_folds=2, coverage=0.8)
    report = fit_log(log, robot, out, settings, n_jobs=1)
    entries = report.record.markers
    assert [entry.rows for entry in entries] == [48, 63]
    assert all(entry.mean < 1e-3 for entry in entries)
    assert "| marker 1 " in report.markdown()
    loaded = open_model(out)
    assert loaded.predict(log.q).shape == (64, 6)
    np.testing.assert_allclose(tips_at(loaded, log.q), loaded.predict(log.q)[:, 3:], atol=1e-12)
    judged = evaluate_log(loaded, log, folder / "evaluation")
    assert len(judged.record.markers) == 2
    assert judged.record.all.share_in_radius > 0.7
