"""Cameras that are late: the delay is estimated from a recorded motion, and said if it is clear."""

import numpy as np
import pytest
import torch

from hybridkin import ConstantCurvatureChain, HybridForwardModel, open_model, save_model
from hybridkin.app import workflow
from hybridkin.app.workflow.track import TARGET
from hybridkin.datasets import Log

CHAIN = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
NOISE, SIZE = 2e-4, 0.004
T = 0.1 * np.arange(240)
HEAD = ["t", *(f"q{i + 1}" for i in range(6)), "x", "y", "z", *TARGET, "status"]
TRAINING = {
    "saved": "h",
    "held_out": {"h": {"mean": 1.6 * NOISE, "p95": 2.8 * NOISE}},
    "promise": {"at_rows": 1.6 * NOISE, "per_distance": 0.0, "p95": 1.75},
}


def truth(q):
    """Return the tips of the robot."""
    return CHAIN(torch.from_numpy(q)).numpy()


def loops(size):
    """Return balanced commands along a loop that is run twice."""
    phase = np.linspace(0.0, 4.0 * np.pi, 240)[:, None] + np.arange(6)
    q = size * np.sin(phase) * (1.0 + 0.2 * np.cos(2.0 * phase))
    return q - q.reshape(-1, 2, 3).mean(axis=2).repeat(3, axis=1)


@pytest.fixture(scope="module")
def loaded(tmp_path_factory):
    """A model that promises errors."""
    rng = np.random.default_rng(0)
    q = rng.uniform(-SIZE, SIZE, (400, 6))
    q -= q.reshape(-1, 2, 3).mean(axis=2).repeat(3, axis=1)
    x = truth(q) + NOISE * rng.standard_normal((400, 3))
    model = HybridForwardModel(CHAIN, "quadratic").fit(q, x)
    path = tmp_path_factory.mktemp("model") / "model.safetensors"
    save_model(model, path, training=TRAINING)
    return open_model(path)


def written(path, q):
    """Write a track of commands, with the tips as targets."""
    cells = np.column_stack([T, q, truth(q), truth(q)]).astype(str)
    lines = [",".join([*row, "CONVERGED"]) for row in cells]
    path.write_text("\n".join([",".join(HEAD), *lines]))
    return path


def late(q, delay):
    """Return the tips of the robot some time before, with noise."""
    moved = np.stack([np.interp(T - delay, T, column) for column in q.T], axis=1)
    return truth(moved) + NOISE * np.random.default_rng(2).standard_normal((len(q), 3))


@pytest.mark.parametrize("delay", [0.0, 0.03, 0.1, 0.25, 1.4])
@pytest.mark.parametrize("gaps", [False, True])
def test_the_delay_is_that_of_the_camera(delay, gaps):
    q = loops(SIZE)
    x = late(q, delay) + np.array([0.01, 0.0, 0.0])  # a constant offset does not count
    if gaps:
        x[::7] = np.nan
        x[100:110, 1] = np.inf
    found = workflow.estimated_delay(T, truth(q), x)
    assert found.seconds == pytest.approx(delay, abs=0.01)
    assert found.is_clear == (delay >= 0.05)
    assert found.error <= found.without


def test_a_wrong_model_is_not_taken_for_a_delay():
    q = loops(SIZE)
    found = workflow.estimated_delay(T, 0.9 * truth(q), late(q, 0.0))
    assert not found.is_clear


def test_what_holds_no_motion_is_refused():
    q = loops(SIZE)
    x = truth(q)
    for t, readings in ((T[::-1], x), (T[:3], x[:3]), (T, x[:5]), (T, np.nan * x)):
        with pytest.raises(ValueError, match=r"must (be|hold) at least 4"):
            workflow.estimated_delay(t, x[: len(t)], readings)


def test_verify_says_that_a_camera_is_late_and_compares_each_tip_with_its_command(loaded, tmp_path):
    q = loops(0.6 * SIZE)
    track = written(tmp_path / "track.csv", q)
    log = Log(q, late(q, 0.25))
    report = workflow.verify_track(loaded, track, log)
    assert not report.record.kept
    assert report.record.later.seconds == pytest.approx(0.25, abs=0.01)
    assert "use --delay 0.2" in report.markdown()
    report = workflow.verify_track(loaded, track, log, delay=0.25)
    assert report.record.kept
    assert report.record.delay == 0.25
    assert "--delay" not in report.markdown()
    (tmp_path / "report.json").write_text('{"command": "track", "delay": 0.25}')
    assert workflow.verify_track(loaded, track, log).record.kept  # that of the track
    for delay in (-0.1, 1e9, np.nan):
        with pytest.raises(ValueError, match="`delay` must be a time"):
            workflow.verify_track(loaded, track, log, delay=delay)
