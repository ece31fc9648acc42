"""`fit`, `evaluate` and `describe`: from a log to a model, its errors and what it is."""

import json
import re
from itertools import groupby

import numpy as np
import pytest
import torch
from simulated_log import FIT, HEADER, ROBOT, document, rows, run, write

from hybridkin import Hysteresis, load_model, robots
from hybridkin.app import workflow
from hybridkin.app.cli._terminal import Stages
from hybridkin.app.cli.main import main


def in_one_line(text):
    return re.sub(r"\s+", " ", text)


def test_fit_compares_models_saves_auto_and_prints_its_report(fitted):
    record = json.loads((fitted / "model" / "report.json").read_text())
    held_out = {name: entry["mean"] for name, entry in record["held_out"].items()}
    assert held_out["hybrid, auto"] < 0.5 * held_out["mechanical, calibrated"]
    chosen = record["auto"]
    candidates = {f"hybrid, {name}" for name in chosen["candidate"]}
    candidates -= {"hybrid, mechanical", "hybrid, blend"}
    others = {"mechanical, nominal", "mechanical, calibrated", "hybrid, auto"}
    others |= {"data-driven, quadratic", "data-driven, ELM"}
    assert {*held_out} == candidates | others
    assert all(name in record["chosen"] for name, weight in chosen["weights"].items() if weight)
    assert sum(chosen["weights"].values()) == pytest.approx(1.0)
    assert record["saved"] == "hybrid, auto"
    assert (fitted / "model" / "robot.toml").read_text() == ROBOT
    text = (fitted / "model" / "report.md").read_text()
    assert "no errors and no warnings" in text
    printed = in_one_line((fitted / "out").read_text())
    for sentence in record["words"]:
        assert sentence in printed
        assert sentence in text
    assert 'These are the values of the row "mechanical, calibrated".\n' in text
    assert f"hybrid, auto | {1e3 * held_out['hybrid, auto']:.2f}" in printed
    assert str(fitted / "model" / "model.safetensors") in printed
    assert "120 rows, 8 motions, 6 actuators" in (fitted / "err").read_text()


@pytest.mark.slow
def test_fit_without_auto_and_with_a_radius(log, robot, tmp_path, capsys):
    out = tmp_path / "m"
    arguments = [log, "--robot", robot, "--out", out, "--no-auto", "--coverage", "0.8", *FIT]
    code, record = document(capsys, "fit", *arguments)
    assert code == 0
    assert "hybrid, auto" not in record["held_out"]
    assert record["saved"] in ("hybrid, quadratic", "hybrid, ELM")
    _, record = document(capsys, "evaluate", out, log)
    assert 0.8 < record["all"]["share_in_radius"] <= 1
    assert "mm covers 80 % of the tips" in run(capsys, "describe", out)[1]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [["--hysteresis", "auto"], ["--no-auto", "--coverage", "0.8"]], ids=["auto", "none"]
)
def test_the_progress_of_a_whole_fit_never_goes_back(options, robot, tmp_path, monkeypatch, capsys):
    """Every stage is shown once, and what is done of it only grows."""
    calls = []

    class Recorded(Stages):
        def __call__(self, what, done, total):
            calls.append((what, done, total))
            super().__call__(what, done, total)

    monkeypatch.setattr("hybridkin.app.cli.main.Stages", Recorded)
    table = rows()
    for motion in np.split(table, 8):
        motion[:, 1:7] = Hysteresis.backlash(1.5).command(motion[:, 1:7])[0]
    log = write(tmp_path / "log.csv", table)
    arguments = [log, "--robot", robot, "--out", tmp_path / "m", *options, *FIT]
    code, record = document(capsys, "fit", *arguments)
    assert code == 0
    found = re.search("backlash|friction", record["chosen"])
    assert bool(found) == ("auto" in options)
    stages = [what for what, *_ in calls]
    assert len({*stages}) > 5
    for what, of_stage in groupby(calls, key=lambda call: call[0]):
        of_stage = [*of_stage]
        assert len(of_stage) == stages.count(what)  # it does not come again
        parts = [done / total for _, done, total in of_stage]
        assert parts == sorted(parts)
        assert parts[0] == 0.0
        assert parts[-1] <= 1.0
        assert len({total for _, _, total in of_stage} - {1}) <= 1
    assert ("cross-validation by motion", 2, 2) in calls


def in_metres(table):
    return table, ROBOT.replace('"mm"', '"m"')


def frozen(table):
    table[20:40, 7:10] = table[20, 7:10]
    return table, ROBOT


def with_nan(table):
    table[[10, 90, 91], 8] = np.nan
    return table, ROBOT


@pytest.mark.parametrize(
    ("spoil", "message", "advice"),
    [
        (in_metres, "look like millimetres", "set q_unit"),
        (frozen, r"does not change .*\(lines 22-41\)", "--drop-frozen"),
        (with_nan, r"NaN .*\(lines 12, 92-93\)", "--drop-invalid"),
    ],
)
def test_spoilt_logs_stop_the_fit_with_advice(robot, tmp_path, capsys, spoil, message, advice):
    table, description = spoil(rows())
    robot.write_text(description)
    log, out = write(tmp_path / "log.csv", table), tmp_path / "m"
    code, printed, errors = run(capsys, "fit", log, "--robot", robot, "--out", out, *FIT)
    assert (code, printed, out.exists()) == (2, "", False)
    assert re.search(message, in_one_line(errors))
    assert advice in errors
    assert errors.splitlines()[-1].startswith("hybridkin: error: the log did not pass its check")
    # `describe` tells the same without a fit.
    code, record = document(capsys, "describe", log, "--robot", robot)
    assert (code, record["ok"]) == (1, False)
    assert any(re.search(message, finding["message"]) for finding in record["findings"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"log": "none.csv"}, "LOG must be a file, there is none at"),
        ({"robot": "none.toml"}, "--robot must be a file, there is none at"),
        ({"--groups": "motions"}, "did you mean 'motion'"),
        ({"--exclude": "*"}, "at least 2 motions"),
        ({"--q": "t1,t2"}, "must have 6 actuators"),
        ({"text": HEADER + "\n0,1,2,3,4,5,6,7,8,9,1\n1,2,1,3,4,5,6,7,7,9,1\n"}, "at least 3 mot"),
        ({"toml": "[[segment]]\nradius = 0.1\n"}, r"\[log\]"),
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
    arguments = [tmp_path / change.get("log", "log.csv")]
    arguments += ["--robot", tmp_path / change.get("robot", "robot.toml")]
    arguments += ["--out", tmp_path / change.get("out", "model")]
    for option in ("--groups", "--exclude", "--q"):
        if option in change:
            arguments += [option, change[option]]
    code, printed, errors = run(capsys, "fit", *arguments, *FIT)
    assert (code, printed) == (2, "")
    assert errors.splitlines()[-1].startswith("hybridkin: error: ")
    assert re.search(message, errors)
    assert "Traceback" not in errors
    assert sorted(tmp_path.iterdir()) == before


def test_evaluate_tells_errors_by_motion_and_which_rows_were_fitted(fitted, tmp_path, capsys):
    held_out = json.loads((fitted / "model" / "report.json").read_text())["held_out"]
    held_out = held_out["hybrid, auto"]
    out = tmp_path / "evaluation"
    below = ["--fail-above", 1e3 * 0.9 * held_out["mean"]]  # and above the training error
    arguments = ["evaluate", fitted / "model", fitted / "log.csv"]
    code, record = document(capsys, *arguments, *below, "--out", out)
    assert code == 1
    model = load_model(fitted / "model" / "model.safetensors")
    table = rows()
    q, x = -1e-3 * table[:, 1:7], 1e-3 * table[:, 7:10]
    errors = np.linalg.norm(model.predict(q) - x, axis=1)
    everything = record["all"]
    wanted = [errors.mean(), np.median(errors), np.percentile(errors, 95), errors.max()]
    shown = [everything[key] for key in ("mean", "median", "p95", "max")]
    np.testing.assert_allclose(shown, wanted, rtol=1e-4)
    assert len(record["motions"]) == 8
    # The tendons are in balance; this is advice for a fit.
    assert "no motion along" in (fitted / "err").read_text()
    assert "no motion along" in (fitted / "model" / "report.md").read_text()
    assert "no motion along" not in (out / "report.md").read_text()
    second = record["motions"]["2"]
    assert second["mean"] == pytest.approx(errors[table[:, 10] == 2].mean(), rel=1e-4)
    assert everything["share_in_domain"] == model.in_domain(q).mean() > 0.9
    assert (record["fitted_rows"], record["new"]) == (120, None)
    assert record["fitted"] == everything
    assert record["held_out"] == held_out
    for name in ("workspace.png", "error_histogram.png", "report.md"):
        assert str(out / name) in record["written"]
        assert (out / name).stat().st_size > 500
    _, printed, notes = run(capsys, *arguments)
    assert "no motion along" not in notes
    printed = in_one_line(printed)
    assert "120 of 120 rows were fitted: their errors are training errors" in printed
    assert f"held out in the fit | 120 | {1e3 * held_out['mean']:.2f} |" in printed


def test_evaluate_takes_new_and_fitted_rows_apart(fitted, tmp_path, capsys):
    table = np.vstack([rows(), rows(10)[120:]])
    table[6:15, 7] += 0.01  # mm: other tips; less than half of the motion is fitted
    table[22:30, 7] += 0.01  # seven of fifteen rows of it are not
    table[22, 7] -= 0.01
    log = write(tmp_path / "more.csv", table)
    code, record = document(capsys, "evaluate", fitted / "model", log)
    assert code == 0
    assert record["fitted_rows"] == record["fitted"]["rows"] == 120 - 9
    assert record["new"]["rows"] == 9 + 30
    assert record["new"]["mean"] > record["all"]["mean"] > record["fitted"]["mean"]
    new = write(tmp_path / "new.csv", table[120:])
    _, record = document(capsys, "evaluate", fitted / "model", new)
    assert (record["fitted_rows"], record["fitted"], record["held_out"]) == (0, None, None)


def test_describe_tells_what_a_model_is(fitted, capsys):
    code, record = document(capsys, "describe", fitted / "model")
    assert code == 0
    model = load_model(fitted / "model" / "model.safetensors")
    radii = model.mechanical_model_.radii
    np.testing.assert_allclose(record["geometry"]["radii"], radii.tolist())
    report = json.loads((fitted / "model" / "report.json").read_text())
    for key in ("rows", "log", "n_motions", "saved", "chosen", "held_out"):
        assert record["training"][key] == report[key]
    assert record["auto"] == report["auto"]
    assert record["versions"]["torch"] == str(torch.__version__)
    q = -1e-3 * rows()[:, 1:7]
    np.testing.assert_allclose(record["domain"]["q_min"], q.min(axis=0), atol=1e-8)
    printed = run(capsys, "describe", fitted / "model")[1]
    assert re.search(r"radii \[m\]: +0.00\d+, 0.00\d+\n", printed)
    assert "Fitted to log.csv: 120 rows of 120, 8 motions" in printed
    assert f"Model: hybrid, auto, {record['training']['chosen']}" in in_one_line(printed)


@pytest.mark.parametrize(
    ("option", "setting"), [("auto", "auto"), ("0.4", 4e-4), ("0", 0.0), (None, "detect")]
)
def test_hysteresis_reaches_the_fit_in_metres(log, robot, tmp_path, monkeypatch, option, setting):
    seen = []

    def fit_log(*_, settings, **__):
        seen.append(settings.hysteresis)
        raise ValueError("enough")

    monkeypatch.setattr(workflow, "fit_log", fit_log, raising=False)
    arguments = ["fit", log, "--robot", robot, "--out", tmp_path / "m"]
    arguments += [] if option is None else ["--hysteresis", option]
    assert main([str(argument) for argument in arguments]) == 2
    assert seen == [setting]
    assert type(seen[0]) is type(setting)


def test_hysteresis_is_a_width_in_the_unit_of_q_of_every_actuator(
    log, robot, tmp_path, monkeypatch
):
    """Of motors whose signs differ: a width has no sign."""
    seen = []

    def fit_log(*_, settings, **__):
        seen.append(settings.hysteresis)
        raise ValueError("enough")

    monkeypatch.setattr(workflow, "fit_log", fit_log, raising=False)
    text = ROBOT.replace("q_sign = -1", "q_sign = [1, -1, 1, -1, 1, -1]")
    text = text.replace('q_unit = "mm"', 'q_unit = "deg"').partition("[limits]")[0]
    robot.write_text(text.replace("radius = 0.0055", "radius = 0.0055\nspool_radius = 0.006"))
    arguments = ["fit", log, "--robot", robot, "--out", tmp_path / "m", "--hysteresis", "2"]
    assert main([str(argument) for argument in arguments]) == 2
    np.testing.assert_allclose(seen[0], np.full(6, np.radians(2.0)))


@pytest.mark.parametrize(("limit", "code"), [("2.4", 1), ("2.6", 0)])
def test_a_largest_error_is_in_millimetres(log, robot, tmp_path, capsys, limit, code):
    """2.5 mm is the error of every row."""
    table = rows()
    with torch.no_grad():
        tips = robots.read_description(robot).chain(torch.from_numpy(-1e-3 * table[:, 1:7])).numpy()
    table[:, 7:10] = 1e3 * tips + [1.5, 0.0, 2.0]
    log = write(tmp_path / "moved.csv", table)
    assert run(capsys, "evaluate", robot, log, "--fail-above", limit)[0] == code
