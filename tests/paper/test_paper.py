import json
import re

import numpy as np
import pytest

from hybridkin import datasets
from paper import table1
from paper.__main__ import main
from paper.tables import summary


def test_the_kinds_of_spread_differ():
    wide = [
        [np.array([0.0, 2.0]), np.array([1.0, 3.0])],
        [np.array([4.0, 6.0]), np.array([5.0, 7.0])],
    ]
    expected = {"mean": 3.5, "std": 1.0, "max": 7.0, "mean_max": 4.5}
    expected |= {"std_splits": 2.0, "std_seeds": 0.5}
    assert summary(wide) == pytest.approx(expected)


@pytest.mark.slow
def test_table1_orders_the_models_as_the_paper_does():
    table = table1(datasets.load_trunk(), n_splits=3, n_seeds=2, n_jobs=1)
    test = {(e["model"], e["learner"]): e["test"]["mean"] for e in table}
    train = {(e["model"], e["learner"]): e["train"]["mean"] for e in table}
    mechanical = test["mechanical, nominal", "-"]
    assert test["hybrid on nominal", "ELM"] < test["hybrid on nominal", "linear"] < mechanical
    assert test["hybrid on nominal", "ELM"] < test["data-driven", "ELM"]
    assert test["data-driven", "ELM"] < test["data-driven", "linear"]
    assert mechanical > 1.8 * test["hybrid on nominal", "ELM"]
    assert train["data-driven", "ELM"] < test["data-driven", "ELM"]
    assert test["hybrid on calibrated", "ELM"] < test["mechanical, calibrated", "-"]


@pytest.mark.slow
def test_the_command_writes_everything_or_nothing(tmp_path, capsys):
    pytest.importorskip("mujoco")
    out = tmp_path / "results"
    options = ["--splits", "2", "--seeds", "2", "--points", "25", "--jobs", "1"]
    main(["--out", str(out), *options])
    printed, errors = capsys.readouterr()
    assert "warning" not in errors
    record = json.loads((out / "report.json").read_text())
    report = (out / "report.md").read_text()
    assert record["tracking_mechanical_over_hybrid"]["nominal"] > 2.0
    assert len(record["table1"]) == 11
    closed = record["closed_loop"]
    assert len(closed) == 5
    for runs in closed.values():
        assert runs["closed loop"]["mean"] < 1.1 * runs["feed-forward"]["mean"]
        assert max(run["largest_step"] for run in runs.values()) < 0.06  # at 25 points
    serial, nominal = closed["serial on calibrated"], closed["mechanical, nominal"]
    assert serial["feed-forward"]["mean"] < 0.5 * nominal["feed-forward"]["mean"]
    found = record["identifiability"]
    plain = re.sub(r"\s+", " ", printed)
    assert re.search(r"In 1500 rows one .* moves alone, and 400 rows are fully random", plain)
    assert len(found["asked"]["entries"]) == 28
    for entry in found["asked"]["entries"]:
        answer = "no"
        if entry["identified"]:
            answer = "yes" if entry["alone"] else "not alone"
        assert re.search(rf"{re.escape(entry['name'])} .* {answer}[ |]*\n", printed)
        assert f"| {entry['name']} [{entry['unit']}] | " in re.sub(" +", " ", report)
    for sentence in found["asked"]["unidentified"]:
        assert f"- {sentence}" in report
        assert sentence in plain
    pictures = set(re.findall(r"\((\w+\.png)\)", report))
    assert len(pictures) == 6
    for name in pictures | {"report.json", "report.md"}:
        assert (out / name).stat().st_size > 500
        assert str(out / name) in printed
    assert [p.name for p in tmp_path.iterdir()] == ["results"]
