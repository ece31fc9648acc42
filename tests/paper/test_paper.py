import json
import re

import numpy as np
import pytest
from sklearn.utils import Bunch

from hybridkin import HybridForwardModel, datasets, robots
from hybridkin.workflow import Report
from paper import table1, tables, tracks
from paper.__main__ import main
from paper.identifiability import ASKED, IDENTIFIABLE, identifiability
from paper.tables import summary


def test_the_kinds_of_spread_differ():
    wide = [
        [np.array([0.0, 2.0]), np.array([1.0, 3.0])],
        [np.array([4.0, 6.0]), np.array([5.0, 7.0])],
    ]
    expected = {"mean": 3.5, "std": 1.0, "max": 7.0, "mean_max": 4.5}
    expected |= {"std_splits": 2.0, "std_seeds": 0.5}
    assert summary(wide) == pytest.approx(expected)


def test_the_figure_of_table1_shows_the_values_of_the_paper():
    known = {"mean": 0.01, "std": 0.005, "max": 0.03, "std_splits": 0.0, "std_seeds": 0.0}
    models = [("mechanical, nominal", "-"), ("data-driven", "ELM"), ("hybrid on nominal", "ELM")]
    models += [("mechanical, calibrated", "-"), ("hybrid on calibrated", "ELM")]
    table = [{"model": m, "learner": k, "train": known, "test": known} for m, k in models]
    report = Report("table", {})
    report.record.update(n_splits=1, n_seeds=1)
    figures = {}
    report.figure = lambda name, figure, caption: figures.update({name: figure})
    tables.write_table1(report, table)
    ax = figures["table1"].axes[0]
    crosses, labels = ax.get_legend_handles_labels()
    assert labels == ["paper, real robot"]
    x, y = crosses[0].lines[0].get_data()
    np.testing.assert_allclose(x, [2.5, 3.4, 1.3, np.nan, np.nan])
    np.testing.assert_allclose(y, np.arange(5)[::-1] - 0.3)
    assert tables.paper_test_error(table[1]) == pytest.approx((0.034, 0.027))
    assert tables.paper_test_error(table[0]) == pytest.approx((0.025, np.nan), nan_ok=True)


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
def test_the_hybrids_of_the_paper_have_no_guard(monkeypatch):
    fitted, fit = [], HybridForwardModel.fit
    monkeypatch.setattr(
        HybridForwardModel, "fit", lambda model, q, x: fit(fitted.append(model) or model, q, x)
    )
    chain = robots.bionic_handling_assistant()
    for module in (tables, tracks):
        monkeypatch.setattr(
            module, "chains_of", lambda q, x: {"nominal": chain, "calibrated": chain}
        )
    data = datasets.load_trunk()
    rows = np.flatnonzero(data.part == 3)[::4]
    few = Bunch(q=data.q[rows], x=data.x[rows], part=data.part[rows])
    table1(few, n_splits=1, n_seeds=1, n_jobs=1)
    hybrids = [m for m in fitted if m.mechanical_model is not None and m.error_model != "drop"]
    assert len(hybrids) == 6
    assert {model.guard for model in hybrids} == {None}
    models = tracks.tracked_models(few.q, few.x)
    guards = {name: model.guard for name, model in models.items()}
    assert guards["hybrid on nominal"] is guards["hybrid on calibrated"] is None
    assert guards["serial on calibrated"] == "leverage"  # not of the paper


@pytest.mark.slow
def test_which_geometry_the_protocol_identifies():
    found = identifiability(datasets.load_trunk())
    assert (found["n_train"], found["n_single"], found["n_random"]) == (1900, 1500, 400)
    identified = {entry.name: entry.identified for entry in found["asked"]["entries"]}
    assert all(identified[f"radii[{k}]"] for k in range(3))
    # A turn of all rings equals one of the base, a rest bend equals zeros of its sensors.
    assert not identified["base[rot z]"]
    assert not any(identified[f"turns[{k}]"] for k in range(3))
    assert not any(identified[f"actuator_zeros[{k}]"] for k in range(9))
    sentences = found["asked"]["unidentified"]
    assert sum("turns" in line and "base[rot z]" in line for line in sentences) == 1
    assert sum("rest_bends" in line and "actuator_zeros" in line for line in sentences) == 9
    assert len(sentences) == 10
    # Asked for once each, all are identified, and the tip error is the same.
    assert set(IDENTIFIABLE) < set(ASKED)
    entries = found["identifiable"]["entries"]
    assert len(entries) == 16
    assert all(entry.identified for entry in entries)
    assert found["identifiable"]["unidentified"] == ()
    assert found["identifiable"]["test"] == pytest.approx(found["asked"]["test"], rel=0.01)
    assert found["identifiable"]["test"] < found["default"]["test"]


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
        answer = "yes" if entry["identified"] else "no"
        assert re.search(rf"{re.escape(entry['name'])} .* {answer}\n", printed)
        assert f"| {entry['name']} [{entry['unit']}] | " in report
    for sentence in found["asked"]["unidentified"]:
        assert f"- {sentence}" in report
        assert sentence in plain
    pictures = set(re.findall(r"\((\w+\.png)\)", report))
    assert len(pictures) == 6
    for name in pictures | {"report.json", "report.md"}:
        assert (out / name).stat().st_size > 500
        assert str(out / name) in printed
    assert [p.name for p in tmp_path.iterdir()] == ["results"]
