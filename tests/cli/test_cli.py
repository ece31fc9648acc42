import contextlib
import io
import json
import os
import re
import shutil
import signal
import subprocess
import sys

import numpy as np
import pytest
import torch
from sklearn.kernel_ridge import KernelRidge

import hybridkin
from hybridkin import PlayOperator, datasets, load_model, robots, save_model, workflow
from hybridkin.cli.main import main

COLUMNS = ["t1", "t2", "t3", "t4", "t5", "t6"]
ROBOT = """
name = "two segments"
calibrate = ["radii", "base"]
[[segment]]
radius = 0.0055
length = 0.1
repeat = 2
[log]
q = ["t1", "t2", "t3", "t4", "t5", "t6"]
x = ["x", "y", "z"]
q_unit = "mm"
x_unit = "mm"
q_sign = -1
groups = "motion"
time = "time"
[limits]
q_min = -0.006
q_max = 0.006
"""
HEADER = ",".join(["time", *COLUMNS, "x", "y", "z", "motion"])
FIT = ["--folds", "2", "--jobs", "1"]


def rows(n_motions=10, n=24):
    """A simulated log in mm and s: sweeps of a robot of two segments that a chain misses a bit."""
    rng = np.random.default_rng(0)
    chain = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
    q, motion = [], []
    for k in range(n_motions):
        way = rng.standard_normal((2, 2)) @ [
            np.cos(np.arange(3) * 2.0944),
            np.sin(np.arange(3) * 2.0944),
        ]
        way *= 0.005 / np.abs(way).max()
        turn = np.stack([way.ravel(), np.roll(way, 1, axis=1).ravel()])
        s = np.linspace(0, 1.5 * np.pi, n)
        q.append(np.sin(s)[:, None] * turn[0] + 0.4 * np.sin(2 * s)[:, None] * turn[1])
        motion += [k] * n
    q = np.concatenate(q)
    with torch.no_grad():
        x = chain(torch.from_numpy(q + 15.0 * q**2)).numpy()  # what pulls more gives way more
    x = x + 3e-4 * np.sin(200 * q[:, :3]) + 5e-5 * rng.standard_normal(x.shape)
    time = 0.1 * np.arange(len(q))
    return np.column_stack([time, -1e3 * q, 1e3 * x, motion])


def write(path, table):
    np.savetxt(path, table, delimiter=",", header=HEADER, comments="", fmt="%.8g")
    return path


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path


@pytest.fixture
def log(tmp_path):
    return write(tmp_path / "log.csv", rows())


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """The folder of a fit by the command line, with its log and robot beside it."""
    home = tmp_path_factory.mktemp("fitted")
    log = write(home / "log.csv", rows())
    (home / "robot.toml").write_text(ROBOT)
    arguments = [str(log), "--robot", str(home / "robot.toml"), "--out", str(home / "model")]
    said = {"out": io.StringIO(), "err": io.StringIO()}
    with contextlib.redirect_stdout(said["out"]), contextlib.redirect_stderr(said["err"]):
        assert main(["fit", *arguments, *FIT]) == 0
    for name, text in said.items():
        (home / name).write_text(text.getvalue())
    return home


def run(capsys, *arguments):
    """Return exit code, standard output and standard error of a command."""
    code = main([str(argument) for argument in arguments])
    return code, *capsys.readouterr()


def document(capsys, *arguments):
    """Return exit code and the one JSON document that a command prints."""
    code, out, _ = run(capsys, *arguments, "--json")
    return code, json.loads(out, parse_constant=pytest.fail)


# next


def planned(folder):
    """Return the configurations of next.csv (N, 6) [mm, pulled positive], and the errors [mm]."""
    table = np.genfromtxt(folder / "next.csv", delimiter=",", names=True)
    assert table.dtype.names == (*COLUMNS, "expected_error")
    table = np.array([*map(tuple, table)])
    return table[:, :6], table[:, 6]


@pytest.mark.slow
def test_next_keeps_to_the_limits_with_balanced_tendons(robot, tmp_path, capsys):
    code, out, _ = run(capsys, "next", robot, "-n", 12, "--out", tmp_path / "plan")
    assert code == 0
    q, error = planned(tmp_path / "plan")
    assert len(q) == 12
    assert np.abs(q).max() <= 6.0
    assert np.abs(q).max() > 4.0
    np.testing.assert_allclose(q.reshape(-1, 2, 3).sum(axis=2), 0.0, atol=1e-6)
    assert (np.diff(error) < 0.0).all()
    assert f"{error[-1]:.2f}" in out
    options = ["--q-min", 0, "--q-max", 4, "-n", 3, "--out", tmp_path / "pull"]
    assert run(capsys, "next", robot, *options)[0] == 0
    q, _ = planned(tmp_path / "pull")
    assert (q.min(), q.max() <= 4.0) == (0.0, True)
    np.testing.assert_allclose(q.reshape(-1, 2, 3).min(axis=2), 0.0, atol=1e-6)  # one is slack


@pytest.mark.slow
def test_next_counts_what_is_measured_already(robot, log, tmp_path, capsys):
    plan = ["next", robot, "-n", 3, "--out", tmp_path / "plan"]
    code, fresh = document(capsys, *plan)
    assert (code, fresh["n_measured"], fresh["limits"]["source"]) == (0, 0, "robot description")
    code, record = document(capsys, *plan, "--measured", log)
    assert (code, record["n_measured"]) == (0, 240)
    assert record["expected_errors"][0] < 0.5 * fresh["expected_errors"][0]


@pytest.mark.slow
def test_next_along_a_path(robot, tmp_path, capsys):
    (tmp_path / "path.csv").write_text("x,y,z\n0,0,190\n10,0,190\n20,0,189\n")
    plan = ["next", robot, "-n", 4, "--out", tmp_path / "plan"]
    _, everywhere = document(capsys, *plan)
    path = ["--path", tmp_path / "path.csv", "--dt", 1, "--unit", "mm"]
    code, record = document(capsys, *plan, *path)
    assert (code, record["where"][:14]) == (0, "along the path")
    assert record["expected_errors"][-1] < 0.3 * everywhere["expected_errors"][-1]


@pytest.mark.slow
def test_next_of_a_fitted_model_goes_to_the_limits_of_the_description(fitted, tmp_path, capsys):
    code, record = document(capsys, "next", fitted / "model", "-n", 2, "--out", tmp_path / "plan")
    assert (code, record["limits"]["source"]) == (0, "robot description")
    assert record["limits"]["q_max"] == [0.006] * 6


# fit


@pytest.mark.slow
def test_fit_compares_auto_and_saves_the_best(fitted):
    record = json.loads((fitted / "model" / "report.json").read_text())
    held_out = {name: entry["mean"] for name, entry in record["held_out"].items()}
    assert held_out["hybrid, auto"] < 0.5 * held_out["mechanical, calibrated"]
    chosen = record["auto"]
    names = {*chosen["candidates"]} - {"mechanical", "blend"}
    assert {f"hybrid, {name}" for name in names} < {*held_out}
    rest = {"mechanical, nominal", "mechanical, calibrated", "hybrid, auto"}
    assert {*held_out} - {f"hybrid, {name}" for name in names} == rest | {
        *("data-driven, quadratic", "data-driven, ELM")
    }
    parts = sorted(chosen["weights"], key=chosen["weights"].get)
    assert all(name in record["chosen"] for name in parts)
    assert ("blend of" in record["chosen"]) == (len(parts) > 1)
    assert sum(chosen["weights"].values()) == pytest.approx(1.0)
    assert (chosen["play"], chosen["play_asked"]) == (None, False)
    assert all("hybrid, auto" in choice for choice in record["choices_by_fold"])
    model = load_model(fitted / "model" / "model.safetensors")
    data = workflow.read_log(fitted / "log.csv", robots.read_description(fitted / "robot.toml").log)
    errors = np.linalg.norm(model.predict(data.q) - data.x, axis=1)
    assert errors.mean() < held_out[record["saved"]]
    text = (fitted / "model" / "report.md").read_text()
    assert "no errors and no warnings" in text
    assert f"**{record['saved']}**" in text
    assert record["saved"] == "hybrid, auto"
    assert (fitted / "model" / "robot.toml").read_text() == ROBOT


def test_fit_prints_the_check_the_table_and_what_was_written(fitted):
    printed, errors = (fitted / "out").read_text(), (fitted / "err").read_text()
    assert "240 rows, 10 motions, 6 actuators" in errors
    assert re.search(r"hybrid, auto +\d+\.\d\d", printed)
    assert "Saved: hybrid, auto, fitted to all motions: " in printed
    record = json.loads((fitted / "model" / "report.json").read_text())
    for sentence in record["auto"]["words"]:
        assert sentence in re.sub(r"\s+", " ", printed)
        assert sentence in (fitted / "model" / "report.md").read_text()
    assert str(fitted / "model" / "model.safetensors") in printed


@pytest.mark.slow
def test_fit_without_auto_and_with_a_radius(log, robot, tmp_path, capsys):
    out = tmp_path / "m"
    arguments = [log, "--robot", robot, "--out", out, "--no-auto", "--coverage", "0.9", *FIT]
    code, record = document(capsys, "fit", *arguments)
    assert code == 0
    assert "hybrid, auto" not in record["held_out"]
    assert record["saved"] == "hybrid, ELM"
    _, record = document(capsys, "evaluate", out, log)
    assert record["radius"]["coverage"] == 0.9
    assert 0.85 < record["all"]["share_in_radius"] <= 1
    code, printed, _ = run(capsys, "describe", out)
    assert "radius covering 90 % of the tips" in printed


def test_options_stand_over_the_log_table(log, robot, tmp_path, capsys):
    table = rows()
    table[:, 1:7] *= -0.1  # cm, shortening negative
    path = tmp_path / "cm.csv"
    header = HEADER.replace("t1", "a1").replace("time", "clock")
    np.savetxt(path, table, delimiter=";", header=header.replace(",", ";"), comments="")
    columns = ["--q", ",".join(["a1", *COLUMNS[1:]]), "--time", "clock"]
    units = ["--q-unit", "cm", "--q-sign", "1"]
    code, found = document(capsys, "describe", path, "--robot", robot, *columns, *units)
    _, wanted = document(capsys, "describe", log, "--robot", robot)
    assert code == 0
    np.testing.assert_allclose(found["q_range"], wanted["q_range"], atol=1e-8)


# logs that do not pass


def in_metres(table):
    return table, ROBOT.replace('"mm"', '"m"')


def frozen(table):
    table[40:60, 7:10] = table[40, 7:10]
    return table, ROBOT


def with_nan(table):
    table[[10, 90, 91], 8] = np.nan
    return table, ROBOT


@pytest.mark.parametrize(
    ("spoil", "found", "advice"),
    [
        (in_metres, "these look like millimetres", 'set q_unit = "mm" .* set x_unit = "mm"'),
        (
            frozen,
            r"does not change at all in \d+ rows while the actuators move \(lines 42-61\)",
            "--drop-frozen",
        ),
        (with_nan, r"3 of 240 rows have .* NaN .*\(lines 12, 92-93\)", "--drop-invalid"),
    ],
)
def test_spoilt_logs_stop_the_fit_with_advice(robot, tmp_path, capsys, spoil, found, advice):
    table, description = spoil(rows())
    robot.write_text(description)
    log, out = write(tmp_path / "log.csv", table), tmp_path / "m"
    code, printed, errors = run(capsys, "fit", log, "--robot", robot, "--out", out, *FIT)
    text = re.sub(r"\s+", " ", errors)
    assert code == 2
    assert printed == ""
    assert re.search(found, text)
    assert re.search(advice, text)
    assert errors.splitlines()[-1].startswith("hybridkin: error: the log did not pass its check")
    assert "Traceback" not in errors
    assert not out.exists()
    # `describe` tells the same without a fit.
    code, record = document(capsys, "describe", log, "--robot", robot)
    assert code == 1
    assert not record["ok"]
    assert any(re.search(found, finding["message"]) for finding in record["findings"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log": "none.csv"}, "there is none at"),
        ({"robot": "none.toml"}, "no such file"),
        ({"--groups": "motions"}, "did you mean 'motion'"),
        ({"--exclude": "*"}, "at least 2 motions"),
        ({"--q": "t1,t2"}, "must have 6 actuators"),
        ({"text": "t1,t2\n1,2\n"}, "no column 't3'"),
        ({"text": HEADER + "\n"}, "a header but no rows"),
        ({"text": HEADER + "\n0,1,2,3,4,5,6,7,8,nan,1\n"}, "NaN"),
        ({"text": HEADER + "\n0,1,2,3,4,5,6,7,8,a,1\n"}, "'a'"),
        ({"text": HEADER + "\n0,1,2,3,4,5,6,7,8,9,1\n1,2,1,3,4,5,6,7,7,9,1\n"}, "at least 2 mot"),
        ({"toml": ROBOT.replace("length = 0.1\n", "")}, "positive lengths"),
        ({"toml": "[[segment]]\nradius = 0.1\n"}, r"\[log\]"),
        ({"toml": "[[segment]]\nradius = 0.1\nactuators = 0\n"}, "from 1 to 64"),
        ({"out": "robot.toml"}, "must be a folder"),
    ],
)
def test_user_errors_have_no_traceback_and_leave_nothing(
    log, robot, tmp_path, capsys, change, message
):
    if "text" in change:
        log.write_text(change["text"])
    if "toml" in change:
        robot.write_text(change["toml"])
    before = sorted(tmp_path.iterdir())
    arguments = [
        tmp_path / change.get("log", "log.csv"),
        *("--robot", tmp_path / change.get("robot", "robot.toml")),
        *("--out", tmp_path / change.get("out", "model")),
    ]
    for option in ("--groups", "--exclude", "--q"):
        if option in change:
            arguments += [option, change[option]]
    code, printed, errors = run(capsys, "fit", *arguments, *FIT)
    assert code == 2
    assert printed == ""
    assert errors.splitlines()[-1].startswith("hybridkin: error: ")
    assert re.search(message, errors)
    assert "Traceback" not in errors
    assert sorted(tmp_path.iterdir()) == before


def test_an_interrupt_leaves_cleanly(log, robot, tmp_path, capsys, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(workflow, "fit_log", interrupted)
    code, printed, errors = run(capsys, "fit", log, "--robot", robot, "--out", tmp_path / "m")
    assert code == 130
    assert printed == ""
    assert errors.split("\n\n")[-1] == "hybridkin: interrupted; nothing was written\n"


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals of POSIX")
@pytest.mark.parametrize("written", [False, True])
def test_a_request_to_end_is_an_interrupt_and_says_what_was_written(
    log, robot, tmp_path, capsys, monkeypatch, written
):
    def asked(log, robot, out, **_):
        if written:
            (out / "model").parent.mkdir()
            (out / "model").touch()
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(workflow, "fit_log", asked)
    code, printed, errors = run(capsys, "fit", log, "--robot", robot, "--out", tmp_path / "m")
    assert (code, printed) == (143, "")
    fate = "files were written" if written else "nothing was written"
    assert errors.split("\n\n")[-1] == f"hybridkin: interrupted; {fate}\n"
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL


@pytest.mark.skipif(sys.platform == "win32", reason="needs signals of POSIX")
def test_an_interrupt_that_an_import_turns_into_an_error(log, robot, tmp_path, capsys, monkeypatch):
    def imported(*_, **__):
        try:
            os.kill(os.getpid(), signal.SIGINT)
        except KeyboardInterrupt:
            raise ImportError("could not import datetime") from None

    monkeypatch.setattr(workflow, "fit_log", imported)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    code, _, errors = run(capsys, "fit", log, "--robot", robot, "--out", tmp_path / "m")
    assert errors.split("\n\n")[-1] == "hybridkin: interrupted; nothing was written\n"
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    assert code == 130


# evaluate, track, animate, describe


@pytest.mark.slow
def test_evaluate_tells_errors_by_motion(fitted, tmp_path, capsys):
    out = tmp_path / "evaluation"
    code, record = document(capsys, "evaluate", fitted / "model", fitted / "log.csv", "--out", out)
    assert code == 0
    assert len(record["motions"]) == 10
    model = load_model(fitted / "model" / "model.safetensors")
    data = datasets.load_log(
        fitted / "log.csv", COLUMNS, ["x", "y", "z"], "motion", q_unit="mm", x_unit="mm", q_sign=-1
    )
    errors = np.linalg.norm(model.predict(data.q) - data.x, axis=1)
    everything = record["all"]
    found = [everything[key] for key in ("mean", "median", "p95", "max")]
    wanted = [errors.mean(), np.median(errors), np.percentile(errors, 95), errors.max()]
    np.testing.assert_allclose(found, wanted, rtol=1e-9)
    third = [record["motions"]["2"][key] for key in ("rows", "mean")]
    np.testing.assert_allclose(third, [24, errors[data.groups == "2"].mean()])
    assert everything["share_in_domain"] == model.in_domain(data.q).mean() > 0.9
    assert "share_in_radius" not in everything
    for name in ("workspace.png", "error_histogram.png", "report.md"):
        assert str(out / name) in record["written"]
        assert (out / name).stat().st_size > 500
    code, printed, _ = run(capsys, "evaluate", fitted / "model", fitted / "log.csv")
    assert code == 0
    assert re.search(rf"all rows +240 +{1e3 * errors.mean():.2f} ", printed)


def test_evaluate_says_which_rows_were_fitted(fitted, tmp_path, capsys):
    held_out = json.loads((fitted / "model" / "report.json").read_text())["held_out"]
    held_out = held_out["hybrid, auto"]
    below = ["--fail-above", 1e3 * 0.9 * held_out["mean"]]  # and above the training error
    np.savetxt(tmp_path / "log.csv", rows(), "%.6g", ",", header=HEADER, comments="")
    code, record = document(capsys, "evaluate", fitted / "model", tmp_path / "log.csv", *below)
    assert code == 1
    assert record["fitted_rows"] == 240
    assert record["fitted"] == record["all"]
    assert record["new"] is None
    assert record["held_out"] == held_out
    assert 1e3 * record["all"]["mean"] < below[1]
    _, printed, _ = run(capsys, "evaluate", fitted / "model", tmp_path / "log.csv")
    printed = re.sub(r"\s+", " ", printed)
    assert "240 of 240 rows were fitted: their errors are training errors" in printed
    assert f" held out in the fit - {1e3 * held_out['mean']:.2f} " in printed


@pytest.mark.slow
def test_evaluate_takes_new_and_fitted_rows_apart(fitted, tmp_path, capsys):
    table = np.vstack([rows(), rows(14)[240:]])
    table[10:24, 7] += 0.01  # mm: other tips; less than half of the motion is fitted
    table[36:48, 7] += 0.01  # half of it is
    log = write(tmp_path / "more.csv", table[:-12])
    code, record = document(capsys, "evaluate", fitted / "model", log)
    assert code == 0
    assert record["fitted_rows"] == record["fitted"]["rows"] == 240 - 14
    assert record["new"]["rows"] == 14 + 3 * 24 + 12
    assert record["new"]["mean"] > record["all"]["mean"] > record["fitted"]["mean"]
    _, printed, _ = run(capsys, "evaluate", fitted / "model", log)
    assert re.search(rf"new rows +98 +{1e3 * record['new']['mean']:.2f}", printed)
    new = write(tmp_path / "new.csv", table[240:])
    _, record = document(capsys, "evaluate", fitted / "model", new)
    assert (record["fitted_rows"], record["fitted"], record["held_out"]) == (0, None, None)
    assert "training errors" not in run(capsys, "evaluate", fitted / "model", new)[1]


def test_evaluate_of_a_description_is_the_mechanical_model(fitted, capsys):
    arguments = [fitted / "robot.toml", fitted / "log.csv"]
    code, record = document(capsys, "evaluate", *arguments)
    assert code == 0
    chain = robots.from_toml(fitted / "robot.toml")
    table = rows()
    with torch.no_grad():
        x = chain(torch.from_numpy(-1e-3 * table[:, 1:7])).numpy()
    mean = np.linalg.norm(x - 1e-3 * table[:, 7:10], axis=1).mean()
    assert record["all"]["mean"] == pytest.approx(mean, rel=1e-6)
    assert "share_in_domain" not in record["all"]
    assert document(capsys, "evaluate", *arguments, "--fail-above", "0.01")[0] == 1
    assert document(capsys, "evaluate", *arguments, "--fail-above", "1000")[0] == 0


@pytest.mark.slow
def test_track_of_a_shape_can_be_sent_and_read_back(fitted, tmp_path, capsys):
    out = tmp_path / "track"
    shape = ["--shape", "figure-eight", "--size", "20,10", "--duration", "2", "--dt", "0.05"]
    code, record = document(capsys, "track", fitted / "model", *shape, "--out", out)
    assert code == 0
    assert record["reached"] == record["n"] == 41
    assert record["limits"]["source"] == "robot description, within the training range"
    assert record["in_domain"] == 1.0
    assert record["play"] is None
    assert record["columns"]["x"] == ["x", "y", "z"]
    # What the file says, in the robot's units and sign, leads the model where it says.
    data = datasets.load_log(
        out / "track.csv",
        COLUMNS,
        ["target_x", "target_y", "target_z"],
        time="t",
        q_unit="mm",
        x_unit="mm",
        q_sign=-1,
    )
    model = load_model(fitted / "model" / "model.safetensors")
    assert np.linalg.norm(model.predict(data.q) - data.x, axis=1).max() < 1e-4
    assert np.abs(data.q).max() <= 0.006
    rows = record["lead_in"]["rows"]
    np.testing.assert_allclose(data.time, 0.05 * np.arange(rows + 41), atol=1e-9)
    np.testing.assert_allclose(np.ptp(data.x[rows:], axis=0)[:2], [0.02, 0.01], rtol=0.02)
    # The robot starts at rest, and the lead-in keeps to a tenth of the range per second.
    assert not data.q[0].any()
    low, high = (np.array(record["limits"][name]) for name in ("q_min", "q_max"))
    speed = np.abs(np.diff(data.q[: rows + 1], axis=0)).max() / 0.05
    assert 0.08 * (high - low).max() < speed <= 0.1 * (high - low).max() + 1e-9
    statuses = np.genfromtxt(out / "track.csv", delimiter=",", dtype=str, skip_header=1)[:, -1]
    assert statuses.tolist() == rows * ["LEAD_IN"] + 41 * ["CONVERGED"]
    assert (out / "track.png").stat().st_size > 500


@pytest.mark.slow
def test_track_of_points_within_given_limits(fitted, tmp_path, capsys):
    tip = 1e3 * load_model(fitted / "model" / "model.safetensors").predict(np.zeros((1, 6)))[0]
    far = tip + np.array([[0, 0, -0.1], [15, 0, -4], [30, 0, -8]])
    path = tmp_path / "path.csv"
    np.savetxt(path, far, delimiter=",", header="x,y,z", comments="")
    out = tmp_path / "track"
    arguments = ["track", fitted / "model", path, "--out", out]
    code, _, errors = run(capsys, *arguments)
    assert code == 2
    assert "--dt" in errors
    # In the log's sign: at least -1 mm pulled, at most 0.2.
    limits = ["--dt", "1", "--q-min=-1", "--q-max", "0.2"]
    code, _, errors = run(capsys, *arguments, *limits)
    assert code == 2  # the last point is out of reach
    assert "2 of 3 checked points are out of reach" in errors
    assert not out.exists()
    code, record = document(capsys, *arguments, *limits, "--force")
    assert code == 1
    assert record["reached"] < 3
    assert record["limits"]["q_min"] == pytest.approx([-0.0002] * 6)
    assert record["limits"]["q_max"] == pytest.approx([0.001] * 6)
    q = np.loadtxt(out / "track.csv", delimiter=",", skiprows=1, usecols=range(1, 7))
    assert q.min() >= -1 - 1e-9
    assert q.max() <= 0.2 + 1e-9


SHAPE = ["--shape", "figure-eight", "--unit", "mm", "--dt", "0.1"]


@pytest.mark.slow
def test_track_says_how_much_of_a_path_is_within_reach(fitted, tmp_path, capsys):
    arguments = ["track", fitted / "robot.toml", *SHAPE, "--out", tmp_path / "track"]
    arguments += ["--center", "0,0,190"]  # else it is placed where it fits
    code, printed, errors = run(capsys, *arguments, "--size", "800,400")
    assert code == 2
    assert printed == ""
    assert "leaves the reach of the robot within its limits (robot description)" in errors
    scale = float(re.search(r"--scale ([\d.]+\d)", errors)[1])
    assert document(capsys, *arguments, "--size", "800,400", "--scale", scale)[0] == 0
    code, _, errors = run(capsys, *arguments, "--size", f"{960 * scale},{480 * scale}")
    assert code == 2
    assert float(re.search(r"--scale ([\d.]+\d)", errors)[1]) == pytest.approx(1 / 1.2, rel=0.1)
    code, _, errors = run(capsys, *arguments, "--size", "8,4", "--center", "0,0,500")
    assert code == 2
    assert "its centre is out of reach too: tips go from (" in errors


@pytest.mark.parametrize("force", [[], ["--force"]])
def test_track_names_the_unit_of_a_path_a_thousand_times_too_large(fitted, tmp_path, capsys, force):
    (tmp_path / "path.csv").write_text("t,x,y,z\n0,0,0,190\n1,5,0,190\n2,0,0,190\n")
    arguments = ["track", fitted / "robot.toml", tmp_path / "path.csv", "--out", tmp_path / "t"]
    code, _, errors = run(capsys, *arguments, "--unit", "m", *force)
    assert code == 2
    assert re.search(r"goes 190.1 m from the origin, the tips of the robot 0.\d+ m", errors)
    assert errors.endswith("This looks like millimetres read as metres; give --unit mm.\n")


@pytest.mark.slow
def test_track_leads_in_from_where_the_robot_stands(fitted, tmp_path, capsys):
    out = tmp_path / "track"
    arguments = ["track", fitted / "robot.toml", *SHAPE, "--size", "20,10", "--out", out]
    arguments += ["--duration", "2", "--dq-max", "4"]  # mm/s
    table = {}
    for start in ("1,-2,1,0.5,0,-0.5", "rest", "path"):
        code, record = document(capsys, *arguments, f"--from={start}")
        assert code == 0
        q = np.loadtxt(out / "track.csv", delimiter=",", skiprows=1, usecols=range(1, 7))
        assert np.abs(np.diff(q, axis=0)).max() <= 0.4 + 1e-8
        rows = record["lead_in"]["rows"]
        assert record["lead_in"]["duration_s"] == pytest.approx(0.1 * rows)
        assert len(q) == rows + 21
        table[start] = q[0], q[rows:]
    assert table["1,-2,1,0.5,0,-0.5"][0].tolist() == [1, -2, 1, 0.5, 0, -0.5]
    assert not table["rest"][0].any()
    assert rows == 0
    for _, path in table.values():
        np.testing.assert_array_equal(path, table["path"][1])
    code, _, errors = run(capsys, *arguments, "--from=1000,0,0,0,0,0")
    assert code == 2
    assert "`start` must be 6 values in or near the limits" in errors
    assert run(capsys, *arguments, "--from=1,2")[0] == 2


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "give either a file of points or --shape"),
        (["--shape", "line", "--size", "20,10"], "--size must be 3 numbers"),
        (["--shape", "spiral"], "--size must be 2 numbers"),
        (["none.csv"], "there is none at"),
    ],
)
def test_track_needs_a_path(fitted, tmp_path, capsys, options, message):
    code, _, errors = run(capsys, "track", fitted / "model", *options, "--out", tmp_path / "t")
    assert code == 2
    assert message in errors
    assert not (tmp_path / "t").exists()


@pytest.mark.slow
def test_track_without_known_limits_asks_for_them(fitted, tmp_path, capsys):
    bare = tmp_path / "robot.toml"
    bare.write_text(ROBOT[: ROBOT.index("[limits]")])
    shape = ["--shape", "line", "--size", "0,10,0", "--out", tmp_path / "t"]
    code, _, errors = run(capsys, "track", bare, *shape)
    assert code == 2
    assert "--q-min" in errors
    # A fitted model knows the range that it was fitted on.
    shutil.copy(fitted / "model" / "model.safetensors", tmp_path / "alone.safetensors")
    code, record = document(
        capsys, "track", tmp_path / "alone.safetensors", *shape, "--unit", "mm", "--dt", "0.1"
    )
    assert code == 0
    assert record["limits"]["source"] == "training range"
    assert record["columns"]["q"] == ["q1", "q2", "q3", "q4", "q5", "q6"]


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["gif", "html"])
def test_animate_a_track(fitted, tmp_path, capsys, kind):
    if kind == "html":
        pytest.importorskip("viser")
    shape = ["--shape", "spiral", "--size", "2,8", "--duration", "1", "--dt", "0.1"]
    run(capsys, "track", fitted / "model", *shape, "--out", tmp_path / "track")
    out = tmp_path / f"film.{kind}"
    arguments = [fitted / "model", tmp_path / "track", "--out", out, "--frames", "3"]
    code, record = document(capsys, "animate", *arguments)
    assert code == 0
    assert record["frames"] == 3
    assert record["bytes"] == out.stat().st_size > 10_000
    assert record["written"] == [str(out)]
    assert sorted(p.name for p in tmp_path.iterdir()) == [out.name, "track"]


def test_describe_tells_what_a_model_is(fitted, capsys):
    code, record = document(capsys, "describe", fitted / "model")
    assert code == 0
    model = load_model(fitted / "model" / "model.safetensors")
    radii = [entry["radius"] for entry in record["geometry"]["segments"]]
    np.testing.assert_allclose(radii, model.mechanical_model_.radii.tolist())
    np.testing.assert_allclose(radii, 0.005, rtol=0.1)
    report = json.loads((fitted / "model" / "report.json").read_text())
    assert record["training"]["rows"] == 240
    for key in ("log", "n_motions", "saved", "chosen", "held_out"):
        assert record["training"][key] == report[key]
    assert record["auto"] == report["auto"]
    assert record["versions"]["torch"] == str(torch.__version__)
    assert record["radius"] is None
    q = -1e-3 * rows()[:, 1:7]
    np.testing.assert_allclose(record["domain"]["q_min"], q.min(axis=0), atol=1e-8)
    code, printed, _ = run(capsys, "describe", fitted / "model")
    assert "segment  radius [mm]  length [mm]" in printed
    assert "Fitted to log.csv: 240 rows, 10 motions" in printed
    taken = f"Model: {record['training']['saved']}, {record['training']['chosen']}"
    assert taken in re.sub(r"\s+", " ", printed)


def test_describe_of_a_description_and_of_what_is_none(fitted, tmp_path, capsys):
    code, printed, _ = run(capsys, "describe", fitted / "robot.toml")
    assert code == 0
    assert printed.startswith("two segments: ConstantCurvatureChain, 6 actuators")
    assert "5.500" in printed
    code, _, errors = run(capsys, "describe", fitted / "log.csv")
    assert code == 2
    assert "--robot" in errors
    other = tmp_path / "other.safetensors"
    other.write_bytes(b"no model")
    code, _, errors = run(capsys, "describe", other)
    assert code == 2
    assert "not a model" in errors


# play, and domains of odd shape


@pytest.fixture(scope="module")
def playful(tmp_path_factory):
    """A folder with a model whose actuators have play, its robot and a log of it."""
    home = tmp_path_factory.mktemp("playful")
    table = rows()
    q = PlayOperator(4e-4).apply_by_group(-1e-3 * table[:, 1:7], table[:, 10])
    chain = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
    with torch.no_grad():
        table[:, 7:10] = 1e3 * (chain(torch.from_numpy(q)).numpy() + 5e-4 * np.sin(200 * q[:, :3]))
    write(home / "log.csv", table)
    (home / "robot.toml").write_text(ROBOT)
    model = hybridkin.HybridForwardModel(chain, "quadratic", play=4e-4)
    model.fit(-1e-3 * table[:, 1:7], 1e-3 * table[:, 7:10], groups=table[:, 10])
    save_model(model, home / "model.safetensors")
    return home


def test_evaluate_knows_where_the_motions_of_play_begin(playful, tmp_path, capsys):
    code, record = document(capsys, "evaluate", playful, playful / "log.csv")
    assert code == 0
    assert record["all"]["mean"] < 1e-4
    table = np.loadtxt(playful / "log.csv", delimiter=",", skiprows=1)
    table[:24] = table[23::-1]  # the first motion backwards, its times too
    log = write(tmp_path / "backwards.csv", table)
    code, _, errors = run(capsys, "evaluate", playful, log)
    assert code == 2
    assert (
        "A model with backlash (play) needs the rows of a motion in order of time, but 23" in errors
    )


def test_code_and_trackers_tell_unit_sign_and_backlash_of_q(playful, tmp_path, capsys):
    code, printed, _ = run(capsys, "export", playful, "--out", tmp_path / "c", "--name", "robot")
    assert code == 0
    for text in (printed, *((tmp_path / "c" / n).read_text() for n in ("README.md", "robot.h"))):
        text = " ".join(text.split())
        assert f"log in mm: q[0] = -0.001 * {COLUMNS[0]}, q[1] = -0.001 * {COLUMNS[1]}" in text
        assert "backlash (play) of 0.0004" in text
    model = load_model(playful / "model.safetensors")
    ik = hybridkin.InverseKinematics(model, q_min=-0.005, q_max=0.005)
    with pytest.warns(UserWarning, match=r"backlash \(play\) of 0.0004.*play_.command"):
        ik.tracker(np.zeros(6))


@pytest.mark.slow
def test_track_with_play_tells_what_to_send_and_what_it_does(playful, tmp_path, capsys):
    out = tmp_path / "track"
    shape = ["--shape", "figure-eight", "--size", "20,10", "--duration", "2", "--dt", "0.05"]
    code, record = document(capsys, "track", playful, *shape, "--out", out)
    assert code == 0
    assert record["play"] == [4e-4]
    table = np.genfromtxt(out / "track.csv", delimiter=",", names=True, dtype=None, encoding=None)
    sent, does = (
        -1e-3 * np.column_stack([table[prefix + name] for name in COLUMNS])
        for prefix in ("", "effective_")
    )
    np.testing.assert_allclose(PlayOperator(4e-4).apply(sent)[0], does, atol=1e-10)
    assert np.abs(sent - does).max() == pytest.approx(2e-4)
    assert np.abs(sent).max() <= 0.006
    target = 1e-3 * np.column_stack([table["target_" + axis] for axis in "xyz"])
    model = load_model(playful / "model.safetensors")
    assert np.linalg.norm(model.predict(sent) - target, axis=1).max() < 1e-4
    film = [playful, out, "--out", tmp_path / "film.gif", "--frames", "2"]
    assert document(capsys, "animate", *film)[0] == 0
    _, printed, _ = run(capsys, "describe", playful)
    assert "Backlash (play) of the actuators: 0.4 mm" in printed


@pytest.mark.parametrize(
    ("given", "play"), [("auto", "auto"), ("0.4", 4e-4), ("0", 0.0), (None, "detect")]
)
def test_play_reaches_the_fit_in_metres(log, robot, tmp_path, monkeypatch, given, play):
    given_settings = {}

    def fit_log(*_, **options):
        given_settings.update(options)
        raise ValueError("enough")

    monkeypatch.setattr(workflow, "fit_log", fit_log)
    arguments = ["fit", log, "--robot", robot, "--out", tmp_path / "m"]
    arguments += [] if given is None else ["--play", given]
    assert main([str(argument) for argument in arguments]) == 2
    assert given_settings["settings"].play == play
    assert type(given_settings["settings"].play) is type(play)


def test_play_needs_motions_in_the_order_of_time(robot, tmp_path, capsys):
    table = rows()
    table[[3, 4], 0] = table[[4, 3], 0]
    log = write(tmp_path / "log.csv", table)
    arguments = ["fit", log, "--robot", robot, "--out", tmp_path / "m", "--play", "auto", *FIT]
    code, _, errors = run(capsys, *arguments)
    assert code == 2
    assert "sort the log by motion and time" in errors
    code, _, errors = run(capsys, *arguments, "--no-auto")
    assert code == 2
    assert "--no-auto" in errors
    robot.write_text(ROBOT.replace('groups = "motion"', ""))
    code, _, errors = run(capsys, *arguments)
    assert code == 2
    assert "`play` needs motions" in errors


@pytest.mark.slow
def test_first_track_of_a_kernel_model_stays_where_the_model_is_at_home(tmp_path, capsys):
    """Most of the box around its training rows lies outside the domain of such a model."""
    table = rows()
    table = table[table[:, 1] > 1.0]  # mm: a half of the workspace
    chain = hybridkin.ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
    q, x = -1e-3 * table[:, 1:7], 1e-3 * table[:, 7:10]
    kernel = KernelRidge(kernel="rbf", gamma=1e5).set_params(alpha=1e-3)
    path = tmp_path / "kernel.safetensors"
    model = hybridkin.HybridForwardModel(chain, kernel).fit(q, x)
    save_model(model, path)
    low, high = q.min(axis=0), q.max(axis=0)
    box = np.random.default_rng(0).uniform(low, high, (500, 6))
    assert model.in_domain(box).mean() < 0.5
    shape = ["--shape", "figure-eight", "--size", "10,5", "--unit", "mm", "--dt", "0.1"]
    code, record = document(capsys, "track", path, *shape, "--out", tmp_path / "track")
    assert code == 0
    assert record["statuses"] == {"CONVERGED": record["n"]}
    assert record["in_domain"] == 1.0
    np.testing.assert_allclose(record["limits"]["q_min"], low)
    np.testing.assert_allclose(record["limits"]["q_max"], high)


# the command line itself


@pytest.mark.parametrize(
    "command", ["init", "fit", "evaluate", "track", "verify", "animate", "describe", "demo"]
)
def test_every_command_has_help_with_exit_codes(command, capsys):
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    assert "--json" in text
    assert "--quiet" in text
    assert "exit codes: 0" in text
    assert f"hybridkin {command} " in text.split("examples:")[1]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["fit"],
        ["animate", "model", "track", "--out", "a.gif", "--frames", "0"],
        ["track", "model", "--shape", "line", "--tol", "-1", "--out", "out"],
        ["fit", "l", "--robot", "r", "--play", "-1", "--out", "out"],
        ["fit", "l", "--robot", "r", "--folds", "1", "--out", "out"],
        ["fit", "l", "--robot", "r", "--max-rows", "-3", "--out", "out"],
        ["track", "model", "--shape", "line", "--size", "1,a,0", "--out", "out"],
    ],
)
def test_wrong_options_end_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert capsys.readouterr().err.startswith("hybridkin: error: ")


def test_errors_are_json_where_asked(fitted, capsys, monkeypatch):
    code, record = document(capsys, "describe", fitted / "none")
    assert code == record["exit_code"] == 2
    assert "no such file" in record["error"]
    monkeypatch.setattr(sys, "argv", ["hybridkin", "fly", "--json"])
    with pytest.raises(SystemExit):
        main(["fly", "--json"])
    assert "invalid choice: 'fly'" in json.loads(capsys.readouterr().out)["error"]


@pytest.mark.slow
def test_a_reader_that_stops_early_is_no_error(fitted):
    command = [sys.executable, "-m", "hybridkin", "describe", fitted / "robot.toml"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "log.csv", "model"], "must be a model or a robot description, got the log"),
        (["track", "model", "noise.bin", "--out", "t"], "noise.bin is not text"),
        (
            ["track", "model", *SHAPE, "--size", "5,5", "--q-min", "1,2", "--out", "t"],
            "number or 6",
        ),
        (
            ["track", "model", *SHAPE, "--size", "5,5", "--duration", "1e9", "--out", "t"],
            "at most 1e+08 times `dt`",
        ),
    ],
)
def test_a_slip_of_a_newcomer_has_an_answer(fitted, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(fitted)
    (fitted / "noise.bin").write_bytes(bytes(range(256)))
    code, _, errors = run(capsys, *arguments)
    assert code == 2
    assert message in errors


@pytest.mark.slow
def test_help_comes_at_once_and_json_is_alone_on_stdout(fitted):
    code = "import sys, hybridkin.__main__; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    command = [sys.executable, "-m", "hybridkin", "describe", fitted / "model", "--json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert json.loads(done.stdout)["name"] == "two segments"
    assert done.stderr == ""


# the recordings of real robots, rows thinned for speed


@pytest.mark.slow
def test_fit_of_armlab_as_csv_with_nothing_but_a_robot_description(data_home, tmp_path, capsys):
    data = datasets.load_armlab(data_home)
    table = np.column_stack([-1e3 * data.q, 1e3 * data.x, data.groups])
    header = "cable_1,cable_2,cable_3,tip_x,tip_y,tip_z,line"
    log, out = tmp_path / "armlab.csv", tmp_path / "m"
    np.savetxt(log, table, delimiter=",", header=header, comments="", fmt="%.6g")
    arguments = [log, "--robot", "examples/robots/armlab_3cable.toml", "--out", out]
    code, record = document(capsys, "fit", *arguments, *FIT, "--max-rows", "440", "--no-auto")
    assert code == 0
    assert record["n_whole"] == 24019
    assert {f["kind"] for f in record["log_check"]["findings"]} == {"jumps"}
    held_out = {name: entry["mean"] for name, entry in record["held_out"].items()}
    assert held_out["hybrid, ELM"] < 0.5 * held_out["mechanical, calibrated"] < 0.003
