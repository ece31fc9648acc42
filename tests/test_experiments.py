import json
import re

import numpy as np
import pytest
import torch

from hybridkin import datasets, experiments, load_model, robots
from hybridkin.__main__ import main
from hybridkin.experiments.paper import summary

ROBOT = """
calibrate = ["radii", "base"]
[[segment]]
radius = 0.11
repeat = 2
[log]
q = ["l1", "l2", "l3", "l4", "l5", "l6"]
x = ["x", "y", "z"]
q_unit = "mm"
x_unit = "mm"
"""


@pytest.fixture
def log(tmp_path):
    """A simulated log of 6 motions in millimetres, and its robot description."""
    rng = np.random.default_rng(0)
    q = 0.25 + 0.05 * rng.uniform(-1, 1, (180, 6))
    robot = tmp_path / "robot.toml"
    robot.write_text(ROBOT)
    with torch.no_grad():
        x = robots.from_toml(robot)(torch.from_numpy(q)).numpy()
    x += 0.02 * np.sin(30 * q[:, :3]) + 0.001 * rng.standard_normal(x.shape)
    rows = np.column_stack([1000 * q, 1000 * x, np.repeat(np.arange(6), 30)])
    path = tmp_path / "log.csv"
    header = "l1,l2,l3,l4,l5,l6,x,y,z,motion"
    np.savetxt(path, rows, delimiter=",", header=header, comments="", fmt="%.6f")
    return path, robot


def test_the_kinds_of_spread_are_told_apart():
    wide = [
        [np.array([0.0, 2.0]), np.array([1.0, 3.0])],
        [np.array([4.0, 6.0]), np.array([5.0, 7.0])],
    ]
    expected = {"mean": 3.5, "std": 1.0, "max": 7.0, "mean_max": 4.5}
    expected |= {"std_splits": 2.0, "std_seeds": 0.5}
    assert summary(wide) == pytest.approx(expected)


def test_table1_orders_the_models_as_the_paper_does():
    table = experiments.table1(datasets.load_trunk(), n_splits=3, n_seeds=2, n_jobs=1)
    test = {(e["model"], e["learner"]): e["test"]["mean"] for e in table}
    train = {(e["model"], e["learner"]): e["train"]["mean"] for e in table}
    mechanical = test["mechanical, nominal", "-"]
    assert test["hybrid on nominal", "ELM"] < test["hybrid on nominal", "linear"] < mechanical
    assert test["hybrid on nominal", "ELM"] < test["data-driven", "ELM"]
    assert test["data-driven", "ELM"] < test["data-driven", "linear"]
    assert mechanical > 1.8 * test["hybrid on nominal", "ELM"]
    assert train["data-driven", "ELM"] < test["data-driven", "ELM"]
    assert test["hybrid on calibrated", "ELM"] < test["mechanical, calibrated", "-"]


def test_paper_command_writes_everything_or_nothing(tmp_path, capsys):
    pytest.importorskip("mujoco")
    out = tmp_path / "results"
    options = ["--splits", "2", "--seeds", "2", "--points", "25", "--jobs", "1"]
    assert main(["paper", "--out", str(out), *options]) == 0
    printed = capsys.readouterr().out
    record = json.loads((out / "report.json").read_text())
    report = (out / "report.md").read_text()
    assert record["tracking_mechanical_over_hybrid"]["nominal"] > 2.0
    assert len(record["table1"]) == 11
    pictures = set(re.findall(r"\((\w+\.png)\)", report))
    assert len(pictures) == 6
    for name in pictures | {"report.json", "report.md"}:
        assert (out / name).stat().st_size > 500
        assert str(out / name) in printed
    assert [p.name for p in tmp_path.iterdir()] == ["results"]


def test_fit_command_on_a_log(log, tmp_path, capsys):
    path, robot = log
    out = tmp_path / "model"
    arguments = [str(path), "--robot", str(robot), "--groups", "motion", "--out", str(out)]
    assert main(["fit", *arguments, "--seeds", "2", "--jobs", "1"]) == 0
    assert "hybrid, ELM" in capsys.readouterr().out
    held_out = json.loads((out / "report.json").read_text())["held_out"]
    assert held_out["hybrid, ELM"]["mean"] < 0.5 * held_out["mechanical, calibrated"]["mean"]
    assert (
        held_out["mechanical, calibrated"]["mean"] < held_out["mechanical, nominal"]["mean"] * 1.01
    )
    model = load_model(out / "model.safetensors")
    data = datasets.load_csv(
        path, ["l1", "l2", "l3", "l4", "l5", "l6"], ["x", "y", "z"], q_unit="mm", x_unit="mm"
    )
    errors = np.linalg.norm(model.predict(data.q) - data.x, axis=1)
    assert errors.mean() < held_out["hybrid, ELM"]["mean"]


def test_without_a_column_of_motions_the_log_is_cut_into_stretches(log, tmp_path):
    path, robot = log
    report, _ = experiments.fit_log(path, robot, tmp_path / "m", n_folds=2, n_seeds=1, n_jobs=1)
    assert report.record["n_motions"] == 10


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log": "none.csv"}, "there is none at"),
        ({"robot": "none.toml"}, "no such file"),
        ({"groups": "motions"}, "motion"),
        ({"exclude": "*"}, "at least 2 motions"),
        ({"text": "l1,l2\n1,2\n"}, "l3"),
        ({"text": "l1,l2,l3,l4,l5,l6,x,y,z,motion\n"}, "a header but no rows"),
        ({"text": "l1,l2,l3,l4,l5,l6,x,y,z,motion\n1,2,3,4,5,6,7,8,nan,1\n"}, "NaN"),
        ({"text": "l1,l2,l3,l4,l5,l6,x,y,z,motion\n1,2,3,4,5,6,7,8,a,1\n"}, "'a'"),
        (
            {
                "text": "l1,l2,l3,l4,l5,l6,x,y,z,motion\n-1,2,3,4,5,6,7,8,9,1\n"
                + "1,2,3,4,5,6,7,8,9,2\n"
            },
            "positive actuator lengths",
        ),
        ({"toml": "[[segment]]\nradius = 0.1\n"}, r"\[log\]"),
        ({"toml": "[[segment]]\nradius = 0.1\nactuators = 2\n"}, "at least 3"),
        ({"out": "robot.toml"}, "must be a folder"),
    ],
)
def test_user_errors_have_no_traceback_and_leave_nothing(log, tmp_path, capsys, change, message):
    path, robot = log
    if "text" in change:
        path.write_text(change["text"])
    if "toml" in change:
        robot.write_text(change["toml"])
    before = sorted(tmp_path.iterdir())
    arguments = [
        str(tmp_path / change.get("log", "log.csv")),
        *("--robot", str(tmp_path / change.get("robot", "robot.toml"))),
        *("--groups", change.get("groups", "motion")),
        *("--out", str(tmp_path / change.get("out", "model"))),
    ]
    if "exclude" in change:
        arguments += ["--exclude", change["exclude"]]
    assert main(["fit", *arguments, "--jobs", "1"]) == 2
    captured = capsys.readouterr()
    assert captured.err.splitlines()[-1].startswith("hybridkin: error: ")
    assert re.search(message, captured.err)
    assert "Traceback" not in captured.err
    assert sorted(tmp_path.iterdir()) == before


def test_real_nine_tendon_robot_hybrid_is_not_worse_than_calibrated(data_home, tmp_path):
    robot = robots.read_description("examples/robots/ftdcr_v4.toml")
    data = datasets.load_ftdcr(data_home)
    errors, _, _ = experiments.compare_by_group(
        robot.chain,
        data.q,
        data.x,
        data.groups,
        parameters=robot.calibrate,
        n_folds=3,
        n_seeds=1,
        n_jobs=-1,
    )
    mean = {name: values.mean() for name, values in errors.items()}
    assert mean["hybrid, ELM"] <= mean["mechanical, calibrated"] < mean["mechanical, nominal"]
    assert mean["hybrid, ELM"] < mean["data-driven, ELM"]
