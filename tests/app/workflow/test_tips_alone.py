"""A file of a camera alone, without the commands, is compared with a track."""

import json

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hybridkin import ConstantCurvatureChain, HybridForwardModel, open_model, save_model
from hybridkin.app import workflow
from hybridkin.app.cli.main import main
from hybridkin.app.workflow.track import TARGET
from hybridkin.native import evaluate

CHAIN = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1])
NOISE = 2e-4
TRAINING = {"saved": "h", "promise": {"at_rows": 1.6 * NOISE, "per_distance": 0.0, "p95": 1.75}}
NAMES = [f"q{i + 1}" for i in range(6)]
TURN = Rotation.from_rotvec([0.03, -0.02, 0.05])


def balanced(q):
    return q - q.reshape(-1, 2, 3).mean(axis=2).repeat(3, axis=1)


@pytest.fixture
def files(tmp_path):
    """A model, a track, and a file of a camera whose base has moved; every third row of it."""
    rng = np.random.default_rng(0)
    log = balanced(rng.uniform(-0.004, 0.004, (300, 6)))
    x = evaluate(CHAIN, log)[0] + NOISE * rng.standard_normal((300, 3))
    model = HybridForwardModel(CHAIN, "quadratic").fit(log, x)
    save_model(model, tmp_path / "model.safetensors", training=TRAINING)
    phase = np.linspace(0.0, 4.0 * np.pi, 240)[:, None] + np.arange(6)
    q = balanced(0.0024 * np.sin(phase))
    t = 0.1 * np.arange(240)
    x = evaluate(CHAIN, q)[0]
    states = ["CONVERGED"] * 240
    lines = [",".join(["t", *NAMES, *"xyz", *TARGET, "status"])]
    for cells, state in zip(np.column_stack([t, q, x, x]), states, strict=True):
        lines.append(",".join([*map(str, cells), state]))
    (tmp_path / "track.csv").write_text("\n".join(lines))
    measured = TURN.apply(x) + np.array([0.002, -0.001, 0.003])
    measured += NOISE * rng.standard_normal(x.shape)
    every = np.column_stack([t, measured])
    for name, rows in (("camera", every), ("some", every[::3])):
        head = "stamp,x,y,z"
        np.savetxt(tmp_path / f"{name}.csv", rows, delimiter=",", header=head, comments="")
    return tmp_path


@pytest.mark.parametrize(
    ("name", "options"),
    [("camera", []), ("camera", ["--time", "stamp"]), ("some", ["--time", "stamp"])],
)
def test_the_commands_are_those_of_the_track(files, capsys, name, options):
    command = ["verify", files / "model.safetensors", files / "track.csv", files / f"{name}.csv"]
    assert main([*map(str, command), *options, "--json"]) == 1
    printed = capsys.readouterr()
    record = json.loads(printed.out)
    assert record["cause"] == "moved base"
    assert record["parts"]["path"]["rows"] == (240 if name == "camera" else 80)
    assert "The file holds no commands" in printed.err


def test_rows_need_a_number_or_times(files, capsys):
    command = ["verify", files / "model.safetensors", files / "track.csv", files / "some.csv"]
    assert main([*map(str, command), "--json"]) == 2
    assert "column of times" in capsys.readouterr().out


def test_read_tips_has_no_commands(files):
    loaded = open_model(files / "model.safetensors")
    log = workflow.read_tips(files / "camera.csv", loaded.description_.log)
    assert log.q.shape == (240, 0)
    assert log.x.shape == (240, 3)
    assert log.time is None
