"""`init` and `demo`: the first commands of a new user."""

import io
import json
import re
import sys

import numpy as np
import pytest
import torch
from PIL import Image
from simulated_log import run

from hybridkin import ConstantCurvatureChain, load_model, robots
from hybridkin.app.cli import _demo

TENDONS = ["--kind", "tendons", "--segments", "2", "--radius", "5", "--length", "100"]


@pytest.fixture
def log(tmp_path):
    """A log [mm] of two segments of three tendons, pulled counted as positive."""
    rng = np.random.default_rng(0)
    bends = np.cumsum(rng.uniform(-0.3, 0.3, (60, 2, 2)), axis=0).clip(-1, 1)
    angles = 2 * np.pi / 3 * np.arange(3)
    ring = np.stack([np.cos(angles), np.sin(angles)])
    chain = ConstantCurvatureChain([0.005, 0.005], lengths=[0.1, 0.1], routing="base")
    q = -0.005 * (np.cumsum(bends, axis=1) @ ring).reshape(-1, 6)
    with torch.no_grad():
        x = chain(torch.from_numpy(q)).numpy() + 1e-4 * rng.standard_normal((60, 3))
    table = np.column_stack([np.arange(60), -1e3 * q, 1e3 * x, np.arange(60) // 10])
    header = "timestamp [s],servo_1,servo_2,servo_3,servo_4,servo_5,servo_6,tip_x,tip_y,tip_z,run"
    np.savetxt(tmp_path / "log.csv", table, "%.6g", ",", header=header, comments="")
    return tmp_path / "log.csv"


def test_init_from_options(tmp_path, capsys):
    path = tmp_path / "arm.toml"
    options = ["--radius", "8,8,7", "--q-sign", "-1", "--segments", "3", "--time", "t"]
    code, out, _ = run(capsys, "init", path, *TENDONS, *options)
    assert code == 0
    assert f"hybridkin fit log.csv --robot {path} --out model" in re.sub(r"\s+", " ", out)
    robot = robots.read_description(path)
    assert robot.name == "arm"
    assert robot.calibrate == "auto"
    assert robot.chain.routing == "base"
    assert robot.chain.radii.tolist() == [0.008, 0.008, 0.007]
    assert robot.chain.lengths.tolist() == [0.1] * 3
    assert robot.log == robots.LogFormat(
        tuple(f"q{i}" for i in range(1, 10)),
        ("x", "y", "z"),
        time="t",
        q_unit="mm",
        x_unit="mm",
        q_sign=-1,
    )


MOTORS = [*TENDONS, "--q-sign", "1"]
BELLOWS = ["--kind", "chambers", "--segments", "2", "--radius", "30", "--q-unit", "bar"]


def test_init_of_pressures(tmp_path, capsys):
    """The length of a chamber is that without pressure, and what a bar adds."""
    path = tmp_path / "bellows.toml"
    lengths = ["--length", "100,80", "--gain", "20"]
    assert run(capsys, "init", path, *BELLOWS, *lengths)[0] == 0
    robot = robots.read_description(path)
    assert (robot.log.q_unit, robot.log.q_sign) == ("bar", 1)
    pressures = torch.tensor([0.0, 0, 0, 1, 1, 1], dtype=torch.float64)
    metres = robot.chain.metres(pressures).tolist()
    assert metres == pytest.approx([0.1, 0.1, 0.1, 0.1, 0.1, 0.1], rel=1e-8)
    assert robot.chain(pressures).tolist() == pytest.approx([0, 0, 0.2], abs=1e-9)


def test_init_takes_a_value_for_every_actuator(tmp_path, capsys):
    path = tmp_path / "arm.toml"
    options = ["--angle=0,130,240,60,180,-60", "--q-sign=1,-1,1,1,1,-1"]
    assert run(capsys, "init", path, *TENDONS, *options)[0] == 0
    robot = robots.read_description(path)
    degrees = [0, 130, 240, 60, 180, -60]
    assert np.degrees(robot.chain.angles.tolist()) == pytest.approx(degrees)
    assert robot.log.q_sign == (1, -1, 1, 1, 1, -1)


def test_init_asks_for_pressures_in_words(tmp_path, capsys, monkeypatch):
    path = tmp_path / "bellows.toml"
    typed = ["", "chambers", "1", "", "30", "", "bar", "90", "15", "", "", "", "", "", ""]
    monkeypatch.setattr(sys, "stdin", Terminal("\n".join(typed) + "\n"))
    code, _, err = run(capsys, "init", path)
    assert code == 0
    assert "length: length of a chamber at 0 bar [mm]" in err
    assert "gain: length that 1 bar adds to a chamber [mm]" in err
    assert not {"spool_radius:", "q_sign:"} & {*err.split()}
    assert robots.read_description(path).chain.metres(torch.ones(3))[0] == pytest.approx(0.105)


@pytest.mark.parametrize(
    ("options", "metres"),
    [
        (["--q-unit", "counts", "--spool-radius", "6", "--counts-per-turn", "4096"], 9.20388e-6),
        (["--q-unit", "counts", "--gain", "0.0092"], 9.2e-6),
        (["--q-unit", "deg", "--spool-radius", "6"], 0.006),  # per radian
    ],
)
def test_init_of_motors(tmp_path, capsys, options, metres):
    path = tmp_path / "r.toml"
    assert run(capsys, "init", path, *MOTORS, *options, "--angle=-30,90")[0] == 0
    robot = robots.read_description(path)
    assert robot.chain.gains.tolist() == pytest.approx([metres] * 6, rel=1e-5)
    degrees = [-30, 90, 210, 90, 210, 330]
    assert np.degrees(robot.chain.angles.tolist()) == pytest.approx(degrees)
    assert robot.log.q_unit == options[1]


def test_init_reads_the_header_of_a_log_and_checks_it(log, tmp_path, capsys):
    path = tmp_path / "robot.toml"
    code, out, err = run(capsys, "init", path, *TENDONS, "--q-sign", "-1", "--log", log)
    assert code == 0
    found = robots.read_description(path).log
    assert found.q == tuple(f"servo_{i}" for i in range(1, 7))
    assert found.x == ("tip_x", "tip_y", "tip_z")
    assert (found.groups, found.time) == ("run", "timestamp [s]")
    assert "60 rows, 6 motions, 6 actuators" in err
    assert "motion run" in out
    assert "not used" not in out
    options = ["--groups", "none", "--time", "none", "--force"]
    _, out, _ = run(capsys, "init", path, *TENDONS, "--q-sign", "-1", "--log", log, *options)
    assert "Columns not used: timestamp [s], run. If one names the motion" in out
    options = ["--q-unit", "m", "--x-unit", "m", "--force", "--json"]
    code, out, err = run(capsys, "init", path, *TENDONS, "--q-sign", "-1", "--log", log, *options)
    assert code == 1  # as of `describe`, whose check this is
    assert "these look like millimetres" in re.sub(r"\s+", " ", err)
    assert not json.loads(out)["log_check"]["ok"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ([], "needs --kind, --segments, --radius, --length, --q-sign where it cannot ask"),
        (TENDONS, "needs --q-sign where"),
        ([*TENDONS, "--q-sign", "1", "--q", "a,b"], "error: `q` in [log] must name 6 columns"),
        ([*TENDONS, "--q-sign", "1", "--radius", "1,2,3"], "--radius must be one value, or one"),
        ([*TENDONS, "--q-sign", "1", "--q-unit", "counts"], "needs --gain where"),
        (
            [*TENDONS, "--q-sign", "1", "--q-unit", "counts", "--spool-radius", "6"],
            "needs --counts-per-turn where",
        ),
        ([*BELLOWS, "--gain", "20"], "needs --length where"),
        ([*BELLOWS, "--length", "90"], "needs --gain where"),
        ([*BELLOWS, "--q-unit", "mm", "--length", "90"], "--length has no use: q is the length of"),
        ([*BELLOWS, "--spool-radius", "9"], "--spool-radius has no use: chambers have no spools"),
        ([*TENDONS, "--q-sign", "1", "--gain", "9"], "--gain has no use: q is a length; leave"),
        ([*TENDONS, "--q-sign", "1", "--counts-per-turn", "9"], "it goes with --spool-radius"),
        ([*TENDONS, "--q-sign", "1,-1"], "`q_sign` in [log] must hold 6 numbers"),
        ([*TENDONS, "--q-sign", "1", "--angle", "1,2,3"], "or those of all actuators, got 3"),
    ],
)
def test_init_without_what_it_needs_writes_nothing(tmp_path, capsys, options, message):
    code, _, err = run(capsys, "init", tmp_path / "robot.toml", *options)
    assert code == 2
    assert message in err
    assert not [*tmp_path.iterdir()]


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_init_asks_on_a_terminal(log, tmp_path, capsys, monkeypatch):
    path = tmp_path / "robot.toml"
    typed = [log, "cables", "tendons", "two", "2", "", "5", "", "", "100", "", "-1", "", "", "none"]
    text = "\n".join(map(str, [*typed, ""])) + "\n"
    monkeypatch.setattr(sys, "stdin", Terminal(text))
    code, out, err = run(capsys, "init", path)
    assert code == 0
    assert "must be one of tendons, elastic-tendons, chambers, got 'cables'" in err
    assert "must be a number" in err
    assert "[servo_1,servo_2,servo_3,servo_4,servo_5,servo_6]: " in err
    assert "[run]: " in err
    assert out.startswith("robot: 6 actuators")
    found = robots.read_description(path).log
    assert (found.q_sign, found.q[0], found.groups) == (-1, "servo_1", None)
    assert found.time == "timestamp [s]"


def test_an_answer_that_never_comes_is_an_interrupt(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(sys, "stdin", Terminal("\ntendons\n"))
    code, _, err = run(capsys, "init", tmp_path / "robot.toml")
    assert code == 130
    assert err.endswith("interrupted\n")


@pytest.mark.slow
def test_demo_goes_from_a_log_to_a_film(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(_demo, "_ROWS", 60)  # for speed, as what follows
    steps = _demo.steps
    fast = {"--folds 2": "--folds 2 --no-auto", "--frames 24": "--frames 3", "--dt 0.1": "--dt 0.5"}

    def quick(out):
        commands = {}
        for command, what in steps(out).items():
            for slow, option in fast.items():
                command = command.replace(slow, option)
            commands[command] = what
        return commands

    monkeypatch.setattr(_demo, "steps", quick)
    (tmp_path / "robot.toml").write_text("mine")
    assert "is not an empty folder" in run(capsys, "demo", "--out", tmp_path)[2]
    out = tmp_path / "first try"
    code, printed, err = run(capsys, "demo", "--out", out)
    assert code == 0
    assert "SIMULATED" in printed
    assert "simulated" in err
    # Whole lines: a command that is wrapped cannot be copied.
    lines = printed.splitlines()
    for command in quick(out):
        assert f"$ hybridkin {command}" in lines
    report = json.loads((out / "model" / "report.json").read_text())
    means = {name: entry["mean"] for name, entry in report["held_out"].items()}
    shown = re.findall(r"^\| ([a-z-]+, \w+) +\| +([\d.]+)", printed, re.MULTILINE)
    assert {name for name, _ in shown} == {*_demo._SHOWN, report["saved"]}
    for name, mean in shown:
        assert float(mean) == pytest.approx(1e3 * means[name], abs=0.006)
    # The errors on held-out rows, against those of the saved model on the rows of its fit.
    table = np.loadtxt(out / "log.csv", delimiter=",", skiprows=1)  # [mm]
    q, x = 1e-3 * table[:, 1:10], 1e-3 * table[:, 10:]
    model = load_model(out / "model" / "model.safetensors")
    training = np.linalg.norm(model.predict(q) - x, axis=1).mean()
    saved, calibrated, nominal = (means[name] for name in (report["saved"], *_demo._SHOWN[1::-1]))
    assert 0.001 < training < saved < calibrated < nominal < 0.1
    words = " ".join(lines)
    assert f"with {calibrated / saved:.1f} times less mean error" in words
    expected = json.loads((out / "track" / "report.json").read_text())["expected"]["mean"]
    assert f"Expect {1e3 * expected:.2g} mm of the robot on this path." in words
    assert f"Expect {1e3 * expected:.2g} mm (95 %" in (out / "track" / "report.md").read_text()
    # The commands [mm] lead the tip of the model along a figure eight of 200 by 100 mm.
    track = np.genfromtxt(out / "track" / "track.csv", delimiter=",", names=True, dtype=None)
    on_path = track["status"] == "CONVERGED"
    assert f"the tip reaches {on_path.sum()} of {on_path.sum()} points" in words
    sent = 1e-3 * np.column_stack([track[f"c{k}"] for k in range(1, 10)])
    target = 1e-3 * np.column_stack([track[f"target_{axis}"] for axis in "xyz"])
    missed = np.linalg.norm(model.predict(sent) - target, axis=1)
    assert missed[on_path].max() < 1e-4
    assert np.ptp(target[on_path], axis=0).max() == pytest.approx(0.2, rel=0.05)
    with Image.open(out / "track.gif") as film:
        assert film.n_frames == 3
    assert robots.read_description(out / "robot.toml").log.groups == "group"
