"""Files that another command or program wrote are replaced only by --force."""

import numpy as np
import pytest
import torch

from hybridkin import robots
from hybridkin.app.cli.main import main

ROBOT = """calibrate = []
[[segment]]
radius = 0.005
length = 0.1
[log]
q = ["a", "b", "c"]
x = ["x", "y", "z"]
groups = "motion"
[limits]
q_min = -0.006
q_max = 0.006
"""
FAST = ["--folds", "2", "--no-auto", "--jobs", "1"]
SHAPE = "--shape line --size 0.001,0.001,0 --unit m --duration 1 --dt 0.1".split()
COMMANDS = {
    "fit": ["log.csv", "--robot", "data.toml", *FAST],  # without a chain it takes a second
    "evaluate": ["robot.toml", "log.csv"],
    "track": ["robot.toml", *SHAPE],
    "next": ["robot.toml", "-n", "3"],
}


@pytest.fixture
def home(tmp_path, monkeypatch):
    """A folder with a robot and a log, in which commands run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "robot.toml").write_text(ROBOT)
    (tmp_path / "data.toml").write_text(ROBOT[ROBOT.index("[log]") : ROBOT.index("[limits]")])
    turns = np.linspace(0, 6, 20)[:, None] + np.arange(3)
    q = np.concatenate([0.004 * size * np.sin(turns) for size in (1.0, 0.8, 0.6, 0.5)])
    chain = robots.read_description(tmp_path / "robot.toml").chain
    x = chain(torch.from_numpy(q)).numpy() + 2e-4 * np.sin(300 * q)
    table = np.column_stack([q, x, np.arange(80) // 20])
    header = "a,b,c,x,y,z,motion"
    np.savetxt("log.csv", table, "%.9g", ",", header=header, comments="")
    return tmp_path


def content(folder):
    return {path.name: path.read_bytes() for path in folder.iterdir()}


@pytest.mark.slow
def test_a_command_replaces_its_earlier_files_and_by_force_those_of_others(home):
    run = ["next", *COMMANDS["next"], "--out", "out"]
    assert main(run) == 0
    first = (home / "out" / "next.csv").read_text()
    assert main([*run, "--q-max", "0.004"]) == 0
    assert (home / "out" / "next.csv").read_text() != first
    (home / "out" / "report.json").unlink()
    assert main(run) == 2
    assert main([*run, "--force"]) == 0
    assert (home / "out" / "next.csv").read_text() == first


def test_fit_keeps_the_description_of_another_robot(home, capsys):
    out = home / "arm"
    out.mkdir()
    (out / "robot.toml").write_text("mine")
    assert main(["fit", *COMMANDS["fit"], "--out", "arm"]) == 2
    assert (
        "arm has robot.toml already, which `hybridkin fit` replaces only" in capsys.readouterr().err
    )
    assert content(out) == {"robot.toml": b"mine"}


@pytest.mark.slow
@pytest.mark.parametrize(("answer", "code"), [("y", 0), ("", 2)])
def test_a_fit_asks_on_a_terminal_before_it_replaces_a_model(
    home, capsys, monkeypatch, answer, code
):
    run = ["fit", *COMMANDS["fit"], "--out", "out"]
    assert main(run) == 0
    assert "Replaced" not in capsys.readouterr().err
    assert main([*run, "--quiet"]) == 0  # no terminal to ask on
    assert "Replaced the model of 20" in capsys.readouterr().err
    before = (home / "out" / "model.safetensors").stat().st_mtime_ns
    monkeypatch.setattr("sys.stdin.isatty", lambda: True)
    monkeypatch.setattr("builtins.input", lambda: answer)
    assert main(run) == code
    err = capsys.readouterr().err
    assert "Replace the model of 20" in err
    assert ("Replaced the model of 20" in err) == (code == 0)
    assert ("out keeps the model of 20" in err) == (code == 2)
    assert ((home / "out" / "model.safetensors").stat().st_mtime_ns > before) == (code == 0)
