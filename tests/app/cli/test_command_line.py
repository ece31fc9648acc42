"""The command line itself: help, options, errors, interrupts."""

import json
import os
import signal
import subprocess
import sys

import pytest
from simulated_log import document, run

from hybridkin.app import workflow
from hybridkin.app.cli.main import main


@pytest.mark.parametrize(
    "command", ["init", "fit", "evaluate", "track", "verify", "animate", "describe", "demo"]
)
def test_every_command_has_help_with_exit_codes(command, capsys):
    with pytest.raises(SystemExit) as left:
        main([command, "--help"])
    assert left.value.code == 0
    text = capsys.readouterr().out
    for words in ("--json", "--quiet", "exit codes: 0"):
        assert words in text
    assert f"hybridkin {command} " in text.split("examples:")[1]


@pytest.mark.parametrize(
    "arguments",
    [
        [],
        ["fly"],
        ["fit"],
        ["animate", "model", "track", "--out", "a.gif", "--frames", "0"],
        ["track", "model", "--shape", "line", "--tol", "-1", "--out", "out"],
        ["fit", "l", "--robot", "r", "--hysteresis", "-1", "--out", "out"],
        ["fit", "l", "--robot", "r", "--folds", "1", "--out", "out"],
        ["track", "model", "--shape", "line", "--size", "1,a,0", "--out", "out"],
    ],
)
def test_wrong_options_end_with_2(arguments, capsys):
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert capsys.readouterr().err.startswith("hybridkin: error: ")


def test_errors_are_json_where_asked(tmp_path, capsys, monkeypatch):
    code, record = document(capsys, "describe", tmp_path / "none")
    assert code == record["exit_code"] == 2
    assert "there is none at" in record["error"]
    monkeypatch.setattr(sys, "argv", ["hybridkin", "fly", "--json"])
    with pytest.raises(SystemExit):
        main(["fly", "--json"])
    assert "invalid choice: 'fly'" in json.loads(capsys.readouterr().out)["error"]


SHAPE = ["--shape", "figure-eight", "--size", "5,5", "--unit", "mm"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["evaluate", "log.csv", "robot.toml"], "must be a model or a robot description"),
        (["track", "robot.toml"], "give either a file of points or --shape"),
        (["track", "robot.toml", "none.csv"], "there is none at"),
        (["track", "robot.toml", "noise.bin"], "'noise.bin' is not a text file"),
        (["track", "robot.toml", "--shape", "line", "--size", "2,1"], "--size must be 3 numbers"),
        (["track", "robot.toml", *SHAPE, "--q-min", "1,2"], "number or 6"),
        (["track", "robot.toml", *SHAPE, "--duration", "1e9"], "times `dt`"),
    ],
)
def test_a_slip_of_a_newcomer_has_an_answer(
    robot, log, tmp_path, monkeypatch, capsys, arguments, message
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "noise.bin").write_bytes(bytes(range(256)))
    code, _, errors = run(capsys, *arguments, "--out", "out")
    assert code == 2
    assert message in errors
    assert not (tmp_path / "out").exists()


FILES = {
    "LOG": [
        ["fit", "none", "--robot", "robot.toml"],
        ["evaluate", "robot.toml", "none"],
        ["view", "robot.toml", "none"],
    ],
    "--measured": [["next", "robot.toml", "--measured", "none"]],
    "MEASURED": [["verify", "robot.toml", "log.csv", "none"]],
    "TRACK": [
        ["verify", "robot.toml", "none", "log.csv"],
        ["animate", "robot.toml", "none"],
    ],
    "PATH.csv": [["track", "robot.toml", "none"]],
    "--path": [["next", "robot.toml", "--path", "none"]],
    "MOTORS": [["merge", "none", "log.csv", "--q", "q1", "--x", "x,y,z", "--time", "t"]],
    "CAMERA": [["merge", "log.csv", "none", "--q", "q1", "--x", "x,y,z", "--time", "t"]],
    "MODEL": [["export", "none"], ["evaluate", "none", "log.csv"]],
    "MODEL|ROBOT.toml|LOG": [["describe", "none"]],
    "--robot": [["track", "robot.toml", "log.csv", "--robot", "none"]],
    "--obstacles": [["animate", "robot.toml", "log.csv", "--obstacles", "none"]],
}


@pytest.mark.parametrize(
    ("shown", "arguments"),
    [(shown, arguments) for shown, commands in FILES.items() for arguments in commands],
)
def test_a_missing_file_is_named_as_in_the_help(
    robot, log, tmp_path, monkeypatch, capsys, shown, arguments
):
    monkeypatch.chdir(tmp_path)
    out = [] if arguments[0] in ("view", "describe") else ["--out", "out.gif"]
    code, printed, errors = run(capsys, *arguments, *out)
    assert (code, printed) == (2, "")
    assert errors.startswith(f"hybridkin: error: {shown} must be a file")
    assert errors.endswith("there is none at none.\n")


def test_a_folder_is_no_log(robot, tmp_path, capsys):
    code, _, errors = run(capsys, "evaluate", robot, tmp_path)
    assert code == 2
    assert f"LOG must be a file, got the folder {tmp_path}." in errors


def by_terminate(*_, **__):
    os.kill(os.getpid(), signal.SIGTERM)


def by_keyboard(*_, **__):
    raise KeyboardInterrupt


def by_an_import(*_, **__):
    """C code that turns an interrupt into an error of an import."""
    try:
        os.kill(os.getpid(), signal.SIGINT)
    except KeyboardInterrupt:
        raise ImportError("could not import datetime") from None


@pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX: signals")
@pytest.mark.parametrize(
    ("fit_log", "code"), [(by_keyboard, 130), (by_terminate, 143), (by_an_import, 130)]
)
def test_an_interrupt_leaves_cleanly(log, robot, tmp_path, capsys, monkeypatch, fit_log, code):
    monkeypatch.setattr(workflow, "fit_log", fit_log)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # background jobs ignore it
    left = run(capsys, "fit", log, "--robot", robot, "--out", tmp_path / "m")
    assert signal.signal(signal.SIGINT, before) is signal.default_int_handler
    assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    assert left[:2] == (code, "")
    assert left[2].endswith("hybridkin: interrupted\n")


@pytest.mark.slow
def test_what_is_not_needed_is_not_imported_and_a_pipe_may_close(robot):
    code = "import sys, hybridkin.__main__; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
    describe = f"from hybridkin.app.cli.main import main; main(['describe', {str(robot)!r}])"
    code = f"import sys; {describe}; sys.exit('matplotlib' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], check=False, capture_output=True)
    assert (done.returncode, done.stderr) == (0, b"")
    command = [sys.executable, "-m", "hybridkin", "describe", robot, "--json"]
    done = subprocess.run(command, check=True, capture_output=True, text=True)
    assert json.loads(done.stdout)["name"] == "two segments"
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 0


def test_a_log_of_any_ending_is_described(tmp_path, capsys):
    """A file that is no model is a log, as LabVIEW's .lvm or a plotter's .dat."""
    robot = tmp_path / "robot.toml"
    robot.write_text(
        "[[segment]]\nradius = 0.01\nlength = 0.1\n"
        '[log]\nq = ["a", "b", "c"]\nx = ["x", "y", "z"]\n'
    )
    rows = "\n".join(f"{k % 7 * 1e-4},{k % 5 * -1e-4},0,{k % 7 * 1e-3},0,0.1" for k in range(40))
    for name in ("log.lvm", "log.dat", "log"):
        path = tmp_path / name
        path.write_text(f"a,b,c,x,y,z\n{rows}\n")
        out = run(capsys, "describe", path, "--robot", robot)[1]
        assert f"{name}: 40 rows" in " ".join(out.split())
    code, _, err = run(capsys, "describe", tmp_path / "none.lvm")
    assert code == 2
    assert "none.lvm" in err
