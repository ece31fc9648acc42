"""What a track promised against what simulated robots do whose fault is known."""

import json

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.spatial.transform import Rotation

from hybridkin import (
    ConstantCurvatureChain,
    HybridForwardModel,
    Hysteresis,
    open_model,
    robots,
    save_model,
)
from hybridkin.app import workflow
from hybridkin.app.cli.main import main
from hybridkin.app.workflow.track import TARGET, read_track
from hybridkin.datasets import Log

CHAIN = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
NOISE, SIZE = 2e-4, 0.004
COMMON = np.repeat(np.eye(2), 3, axis=1)  # all tendons of a segment together
HEAD = ["t", *(f"q{i + 1}" for i in range(6)), "x", "y", "z", *TARGET, "status"]
TRAINING = {
    "saved": "h",
    "held_out": {"h": {"mean": 1.6 * NOISE, "p95": 2.8 * NOISE}},
    "promise": {"at_rows": 1.6 * NOISE, "per_distance": 0.0, "p95": 1.75},
}


def balanced(q):
    """Return commands (N, 6) whose tendons of a segment do not pull against each other."""
    return q - (q @ COMMON.T / 3.0) @ COMMON


def truth(q):
    """Return the tips of the robot: a chain, and a curved error."""
    with torch.no_grad():
        return CHAIN(torch.from_numpy(q)).numpy() + 30.0 * q[:, :3] * q[:, 1:4]


def loops(size, n=240):
    """Return commands along a loop that is run twice."""
    phase = np.linspace(0.0, 4.0 * np.pi, n)[:, None] + np.arange(6)
    return balanced(size * np.sin(phase) * (1.0 + 0.2 * np.cos(2.0 * phase)))


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A model whose log has balanced commands within SIZE."""
    rng = np.random.default_rng(0)
    q = balanced(rng.uniform(-SIZE, SIZE, (400, 6)))
    x = truth(q) + NOISE * rng.standard_normal((400, 3))
    model = HybridForwardModel(CHAIN, "quadratic").fit(q, x)
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(model, path, training=TRAINING)
    return open_model(path)


def written(path, q, x):
    """Write a track of commands and tips."""
    states = np.where(np.arange(len(q)) < 10, "LEAD_IN", "CONVERGED")
    cells = np.column_stack([0.1 * np.arange(len(q)), q, x, x]).astype(str)
    lines = [",".join([*row, state]) for row, state in zip(cells, states, strict=True)]
    path.write_text("\n".join([",".join(HEAD), *lines]))
    return path


@pytest.fixture
def verified(loaded, tmp_path):
    """Return the record of a verification of commands q, with the tips of the robot (N, 3)."""

    def verify(q, tips):
        track = written(tmp_path / "track.csv", q, truth(q))
        x = tips + NOISE * np.random.default_rng(1).standard_normal(tips.shape)
        report = workflow.verify_track(loaded, track, Log(q, x))
        return report

    return verify


def test_a_robot_as_in_the_log_keeps_the_promise(verified):
    q = loops(0.6 * SIZE)
    report = verified(q, truth(q))
    record = report.record
    assert (record.kept, record.cause) == (True, None)
    assert record.parts["path"].rows == len(q) - 10  # without the lead-in
    assert record.parts["path"].mean == pytest.approx(1.6 * NOISE, rel=0.15)
    assert record.parts["path"].promised == pytest.approx(1.6 * NOISE)
    assert max(record.causes.values()) < 0.2
    assert "Promised: mean 0.32 mm, 95 % below 0.56 mm. Robot: mean 0." in report.plain()
    kept = "The promise is kept: the mean error is within 1.5 times the promised one."
    assert kept in report.plain()


def test_a_kept_promise_has_no_table_of_causes(verified):
    """A shift that is a third of the promised error, and one that is seven times as large."""
    q = loops(0.6 * SIZE)
    small = verified(q, truth(q) + 0.5 * NOISE * np.array([1.0, 0.0, 0.0]))
    assert small.record.kept
    assert max(small.record.causes.values()) > 0.05
    assert "explains [%]" not in small.plain()
    large = verified(q, truth(q) + 10.0 * NOISE * np.array([1.0, 0.0, 0.0]))
    assert not large.record.kept
    assert "explains [%]" in large.plain()


def with_backlash(q):
    return q, truth(Hysteresis.backlash(6e-4).apply(q)[0])


def on_a_moved_base(q):
    turn = Rotation.from_rotvec([0.03, -0.02, 0.05])
    return q, turn.apply(truth(q)) + np.array([0.002, -0.001, 0.003])


def partly_outside(q):
    """Return three times as large commands in the second half, with an error that grows there."""
    q = q * np.where(np.arange(len(q)) < len(q) // 2, 1.0, 3.0)[:, None]
    over = np.maximum(np.linalg.norm(q, axis=1, keepdims=True) - 2.2 * SIZE, 0.0)
    return q, truth(q) + over * np.sin(1000.0 * q[:, :3])


def off_the_plane(q):
    pulled = 0.3 * SIZE * np.sin(np.linspace(0.0, 9.0, len(q)))[:, None] * COMMON[0]
    return q + pulled, truth(q) + 2.0 * pulled[:, :3]


@pytest.mark.parametrize(
    ("fault", "cause", "remedy"),
    [
        (with_backlash, "backlash", "fit named motions"),
        (on_a_moved_base, "moved base", "model.adapt(q, x)"),
        (partly_outside, "outside the log", "hybridkin next"),
        (off_the_plane, "off the plane of the log", "motions off the plane"),
    ],
)
def test_the_cause_of_a_fault_is_found(verified, fault, cause, remedy):
    q, tips = fault(loops(0.6 * SIZE))
    report = verified(q, tips)
    record = report.record
    assert record.kept is False
    assert record.cause == cause
    assert record.causes[cause] > 0.8
    assert cause not in record.also
    text = " ".join(report.plain().split())
    assert f"Likely cause: {cause}." in text
    assert remedy in text
    assert record.remedy in text
    assert f"Amount: {record.amount}." in text


def test_an_error_of_no_known_cause_is_not_explained(verified):
    q = loops(0.6 * SIZE)
    far = 3e-3 * np.random.default_rng(2).standard_normal((len(q), 3))
    report = verified(q, truth(q) + far)
    assert (report.record.kept, report.record.cause) == (False, None)
    assert "None of the known causes explains the error" in report.plain()
    assert (report.record.also, report.record.amount, report.record.separate) == ([], "", "")


def test_rows_are_matched_by_time(loaded, tmp_path):
    q = loops(0.6 * SIZE)
    track = written(tmp_path / "track.csv", q, truth(q))
    few = slice(None, None, 3)
    log = Log(q[few], truth(q)[few], time=1e9 + 0.1 * np.arange(len(q))[few])
    report = workflow.verify_track(loaded, track, log)
    assert report.record.parts["path"].rows == len(range(12, len(q), 3))
    assert report.record.parts["path"].mean < NOISE
    with pytest.raises(ValueError, match="`log` must have as many rows as the track or a column"):
        workflow.verify_track(loaded, track, Log(q[few], truth(q)[few]))


def test_the_command_leaves_out_rows_without_a_tip(loaded, tmp_path, capsys):
    q = loops(0.6 * SIZE)
    x = on_a_moved_base(q)[1]
    track = written(tmp_path / "track.csv", q, truth(q))
    measured = written(tmp_path / "measured.csv", q, x)
    lines = measured.read_text().splitlines()
    lines[51] = lines[51].replace(str(x[50, 2]), "nan", 1)
    measured.write_text("\n".join(lines))
    command = [
        "verify",
        loaded.description_.path,
        track,
        measured,
        "--out",
        tmp_path / "out",
        "--json",
    ]
    assert main([*map(str, command)]) == 1
    record = json.loads(capsys.readouterr().out)
    assert record["cause"] == "moved base"
    assert record["parts"]["path"]["rows"] == len(q) - 11
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"report.md", "report.json"}


def test_a_track_is_read_whatever_the_form_of_the_logs_is(tmp_path):
    columns = [*("t", "a", "b", "tip X", "tip Y", "tip Z"), *TARGET, "error", "status"]
    row = "0.5,1.5,2.5,1,2,3,4,5,6,0,CONVERGED\n"
    (tmp_path / "track.csv").write_text(",".join(columns) + "\n" + 3 * row)
    form = robots.LogFormat(
        q=("a", "b"),
        x=("tip X", "tip Y", "tip Z"),
        q_unit="mm",
        x_unit="mm",
        time="frame",
        time_unit="frames",
        rate=100.0,
        header_line=7,
        decimal=",",
        missing=(4.0,),
    )
    log = read_track(tmp_path, form)
    assert_allclose(log.q, 1e-3 * np.array([[1.5, 2.5]] * 3))
    assert_allclose(log.x, 1e-3 * np.array([[4.0, 5.0, 6.0]] * 3))
    assert_allclose(log.time, 0.5)
