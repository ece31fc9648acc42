"""The experiments on hybrid models: their rows and splits, what they repeat, what they show."""

from pathlib import Path

import hybrid_cases as cases
import numpy as np
import pytest
import torch
from hybrids import (
    extrapolation,
    held_out_motions,
    hybrids_report,
    learning_curves,
    main,
    stored_entries,
)

from hybridkin import ConstantCurvatureChain
from hybridkin.datasets._recordings import FTDCR_FILES, FTDCR_SERVOS

PAPER, NOMINAL, CALIBRATED = cases.PAPER, cases.NOMINAL, cases.CALIBRATED
SHOWN = (NOMINAL, CALIBRATED, PAPER, "serial, quadratic", "auto")

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def one_plant():
    pytest.importorskip("mujoco")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(cases, "PLANTS", {"trunk 1": {}})
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("rows")


@pytest.fixture(scope="module")
def curves(one_plant, folder):
    steps = []
    with pytest.warns(UserWarning, match="Left out: armlab_3cable"):
        table = learning_curves(
            (25, 120),
            1,
            n_test=30,
            models=(*SHOWN, *cases.DATA_ONLY),
            data_home=folder,
            folder=folder,
            progress=lambda *step: steps.append(step),
        )
    assert steps == [("trunk 1, 25 rows", 1, 2), ("trunk 1, 120 rows", 2, 2)]
    return table


def tips(chain, q):
    return chain(torch.from_numpy(q)).numpy()


@pytest.fixture(scope="module")
def recordings(tmp_path_factory):
    """A folder with made-up recordings of the real ones' form."""
    home, rng = tmp_path_factory.mktemp("recordings"), np.random.default_rng(0)
    pulled = np.zeros((2400, 3))
    for row, (still, line) in enumerate(zip(rng.integers(1, 3, 2400), range(2400), strict=True)):
        pulled[row, 0] = line % 40 * 0.25
        pulled[row, still] = rng.integers(0, 100) / 10
    turns = -2 * np.pi / 3 * np.arange(3)[None]
    chain = ConstantCurvatureChain([0.004], angles=turns, lengths=[0.12])
    x = tips(chain, -1e-3 * pulled + 2e-4 * np.sin(600e-3 * pulled))
    (home / "armlab_3cable").mkdir()
    np.savez(
        home / "armlab_3cable" / "armlab_3cable.npz",
        cable_shortening_mm=pulled.astype(np.float32),
        tip_mm=1e3 * x,
        row=np.arange(2400),
    )
    angles = np.add.outer([-3.03, -2.52, -2.01], 2 * np.pi / 3 * np.arange(3))
    chain = ConstantCurvatureChain(
        np.full(3, 0.0045), lengths=[0.06, 0.0625, 0.064], angles=angles, routing="base"
    )
    lines = [",".join(["timestamp", "pattern_label", *FTDCR_SERVOS, "tip_x", "tip_y", "tip_z"])]
    for kind in ("seg1", "seg2", "seg3", "pair12", "pair13", "pair23"):
        for way in range(4):
            bend = np.zeros((3, 2))
            moving = [int(digit) - 1 for digit in kind if digit.isdigit()]
            bend[moving] = rng.uniform(-0.6, 0.6, (len(moving), 2))
            for share in np.linspace(0.1, 1.0, 6):
                turned = share * np.cumsum(bend, axis=0)
                q = -0.0045 * np.concatenate(
                    [
                        turned[s, 0] * np.cos(a) + turned[s, 1] * np.sin(a)
                        for s, a in enumerate(angles)
                    ]
                )
                row = [0.0, *(-1e3 * q), *(1e3 * tips(chain, q) + rng.normal(0, 0.3, 3))]
                lines.append(f"{row[0]},rep1_{kind}_{way}," + ",".join(map(str, row[1:])))
    (home / "ftdcr_v4").mkdir()
    (home / "ftdcr_v4" / FTDCR_FILES["train"]).write_text("\n".join(lines) + "\n")
    return home


def entry(table, model, n):
    return next(e for e in table if (e["model"], e["n"]) == (model, n))


def mean(table, model, n):
    return entry(table, model, n)["errors"]["without noise"]["mean"]


def test_one_entry_for_every_model_and_size(curves):
    assert {(e["model"], e["n"]) for e in curves} == {
        (model, n) for model in (*SHOWN, *cases.DATA_ONLY, cases.AUTO_MECHANICS) for n in (25, 120)
    }
    for e in curves:
        assert list(e["errors"]) == ["without noise", "with noise"]
        assert all(0 < found["mean"] <= found["max"] for found in e["errors"].values())
        assert e["errors"]["with noise"]["n_test"] == 30
        assert ("chosen" in e) == (e["model"] == "auto")
    assert set(entry(curves, "auto", 120)["scores"]) >= {"mechanical", "serial quadratic"}


@pytest.mark.slow
def test_serial_and_auto_beat_the_papers_hybrid(curves):
    paper = mean(curves, PAPER, 120)
    assert mean(curves, "serial, quadratic", 120) < 0.8 * paper
    assert mean(curves, "auto", 120) < 0.8 * paper
    assert mean(curves, "auto", 120) < 0.6 * mean(curves, CALIBRATED, 120)
    assert mean(curves, "auto", 120) < 0.6 * mean(curves, cases.DATA_ONLY[1], 120)
    assert mean(curves, NOMINAL, 25) == mean(curves, NOMINAL, 120)


def test_the_same_again_and_fewer_rows_are_part_of_more(curves, one_plant, folder):
    with pytest.warns(UserWarning, match="Left out"):
        again = learning_curves(
            (25, 120), 1, n_test=30, models=[PAPER], data_home=folder, folder=folder
        )
    assert [e["errors"] for e in again] == [entry(curves, PAPER, n)["errors"] for n in (25, 120)]
    few, many = cases.trunk_cases((25, 120), 1, 30, folder, 1)
    np.testing.assert_array_equal(few.q, many.q[:25])
    clean, noisy = (few.tests[name] for name in ("without noise", "with noise"))
    assert np.std(noisy[0] - clean[0]) == pytest.approx(1e-3, rel=0.1)
    assert np.std(noisy[1] - clean[1]) == pytest.approx(5e-4, rel=0.2)
    assert not set(few.q[:, 0]) & set(clean[0][:, 0])


def test_inner_rows_teach_and_outer_ones_examine(one_plant, recordings, folder):
    trunk = cases.trunk_cases((20,), 1, 20, folder, 1, inner=0.6)[0]
    assert np.abs(trunk.q - 0.25).max() < 0.036 + 0.005
    assert (np.abs(trunk.tests["without noise"][0] - 0.25).max(1) > 0.0359).all()
    inner, outer = cases.armlab_cases((100,), 2, 100, recordings, inner=True)
    for case in (inner, outer):
        assert case.q.min() > -6.05e-3
        assert (case.tests["measured"][0].min(1) < -6.05e-3).all()
    assert not np.array_equal(inner.q, outer.q)


def test_lines_and_motions_are_held_out_whole(recordings):
    by_lines = cases.armlab_cases((50, 300), 2, 200, recordings)
    assert len(by_lines) == 4
    for case in by_lines:
        rows = {tuple(row) for row in np.rint(1e4 * case.q)}
        assert len(case.q) in (50, 300)
        assert case.groups is not None
        held_out = case.tests["measured"][0]
        tenths = np.rint(-1e4 * held_out).astype(int)
        lines = np.where(tenths[:, 0] == 0, tenths[:, 1], 100 + tenths[:, 0])
        assert not set(case.groups) & set(lines)
        assert not rows & {tuple(row) for row in np.rint(1e4 * held_out)}
    found = cases.motion_cases(recordings, 2)
    assert [case.name for case in found] == ["plain chain"] * 10 + ["elastic tendons"] * 10
    folds = [case for case in found[:10] if "5 folds" in case.tests]
    assert sum(len(case.tests["5 folds"][0]) for case in folds) == 24 * 6
    for case in folds:
        assert len(np.unique(case.groups)) + len(case.tests["5 folds"][0]) // 6 == 24
    for case, held in zip(found[5:8], ("pair12", "pair13", "pair23"), strict=True):
        groups = case.tests["a pair held out"][2]
        assert np.char.find(groups.astype(str), held).min() >= 0
        assert len(groups) == 4 * 6
        assert np.char.find(case.groups.astype(str), held).max() < 0
    assert [case.in_time for case in found[:10]] == [True] * 9 + [False]
    pairs, by_segment = found[8:10]
    np.testing.assert_array_equal(pairs.q, by_segment.q)
    assert set(by_segment.groups) == {"seg1", "seg2", "seg3"}
    assert np.char.find(pairs.groups.astype(str), "_seg").min() >= 0
    assert len(pairs.tests["pairs from single segments"][0]) == 12 * 6


def test_report_of_all_three(curves, one_plant, recordings, folder, tmp_path):
    models = (NOMINAL, CALIBRATED, cases.DATA_ONLY[0], "serial, pose", "auto")
    outside = extrapolation(
        20, 1, n_test=20, models=models[:-1], data_home=recordings, folder=folder
    )
    trunks = {f"trunk 1, inner {part} %" for part in (60, 80)}
    assert {e["case"] for e in outside} == {
        *trunks,
        "armlab_3cable, pulls up to 6 mm",
        "ftdcr_v4, plain chain",
        "ftdcr_v4, elastic tendons",
    }
    pairs = cases.motion_cases(recordings, 4)[8]
    motions = cases.examined(pairs._replace(calibrate=()), (CALIBRATED, "auto", cases.AUTO_PLAY))
    names = [CALIBRATED, "auto", cases.AUTO_MECHANICS, cases.AUTO_PLAY]
    assert [entry["model"] for entry in motions] == names
    report = hybrids_report(curves, outside, motions)
    paths = {path.name for path in report.write(tmp_path / "hybrids")}
    assert paths == {
        *("report.md", "report.json", "hybrids.csv"),
        *("hybrid_curves.png", "hybrid_outside.png"),
    }
    stored = stored_entries(tmp_path / "hybrids" / "hybrids.csv")
    assert [*stored] == ["few rows", "outside the training range", "held-out motions"]
    for e in stored["few rows"]:
        test, errors = next(iter(e["errors"].items()))
        expected = entry(curves, e["model"], e["n"])["errors"][test]
        assert errors["mean"] == pytest.approx(expected["mean"], abs=5.1e-6)
        assert errors["max"] == pytest.approx(expected["max"], abs=5.1e-6)
    text = (tmp_path / "hybrids" / "report.md").read_text()
    assert "| rows | 25 | 120 |" in text
    assert "| plain chain | 0 | " in text


def test_small_pulls_teach_and_large_ones_examine(recordings):
    case = cases.pull_cases(recordings, 1)[0]
    q = np.vstack([case.q, case.tests["measured"][0]])
    assert (case.q >= 0.6 * q.min(0)).all()
    assert (case.tests["measured"][0] < 0.6 * q.min(0)).any(1).all()
    assert len(q) == 24 * 6


def test_absent_recordings_are_left_out(tmp_path):
    with (
        pytest.warns(UserWarning, match="Left out: ftdcr_v4"),
        pytest.warns(UserWarning, match="Left out: asl_trunk_static"),
    ):
        assert held_out_motions(data_home=tmp_path) == []


def test_figures_of_the_docs_are_drawn_from_their_table(tmp_path):
    data = Path(__file__).parents[2] / "docs" / "data" / "hybrids.csv"
    main(["--draw", str(data), "--out", str(tmp_path)])
    assert {path.name for path in tmp_path.glob("*.png")} == {
        *("hybrid_curves.png", "hybrid_outside.png")
    }
