"""Every file that a command writes: nobody else's is replaced, and no pipe is waited for."""

import contextlib
import os
import signal
import sys

import numpy as np
import pytest
import torch

from hybridkin import robots
from hybridkin.app.cli.main import main
from hybridkin.datasets import load_log

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
INIT = "--kind tendons --segments 1 --radius 5 --length 80 --q-sign -1".split()
FOLDERS = {
    "fit": ["log.csv", "--robot", "data.toml", *FAST, "--out"],
    "evaluate": ["robot.toml", "log.csv", "--out"],
    "verify": ["robot.toml", "track.csv", "run.csv", "--out"],
    "track": ["robot.toml", *SHAPE, "--out"],
    "next": ["robot.toml", "-n", "3", "--out"],
    "export": ["robot.toml", "--out"],
    "export --mex": ["robot.toml", "--mex", "--out"],
}
SINGLE = {
    "export --fmu": ("a.fmu", ["robot.toml", "--fmu"]),
    "animate": ("a.gif", ["robot.toml", "track.csv", "--frames", "2", "--out"]),
    "animate html": ("a.html", ["robot.toml", "track.csv", "--frames", "2", "--out"]),
    "init": ("a.toml", [*INIT]),
}
EDITED = "init"  # its file is the user's, and is never replaced unasked
WRITTEN = {  # names in the folder
    "fit": ["report.md", "report.json", "held_out.png", "error_histogram.png", "model.safetensors"],
    "evaluate": ["report.md", "report.json", "error_histogram.png", "workspace.png"],
    "verify": ["report.md", "report.json"],
    "track": ["report.md", "report.json", "track.csv", "track.png", "commands.png"],
    "next": ["report.md", "report.json", "next.csv"],
    "export": ["model.c", "model.h", "model_test.c", "CMakeLists.txt", "README.md"],
    "export --mex": ["model.c", "model.m"],
}
WRITTEN["fit"].append("robot.toml")
FILES = [(command, name) for command, names in WRITTEN.items() for name in names]
FILES += [(command, name) for command, (name, _) in SINGLE.items()]
FIRST = [*dict(reversed(FILES)).items()]  # one of each command
MINE = b"mine"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a robot, a log, a track and its run."""
    home = tmp_path_factory.mktemp("home")
    (home / "robot.toml").write_text(ROBOT)
    (home / "data.toml").write_text(ROBOT[ROBOT.index("[log]") : ROBOT.index("[limits]")])
    turns = np.linspace(0, 6, 20)[:, None] + np.arange(3)
    q = np.concatenate([0.004 * size * np.sin(turns) for size in (1.0, 0.8, 0.6, 0.5)])
    chain = robots.read_description(home / "robot.toml").chain
    x = chain(torch.from_numpy(q)).numpy() + 2e-4 * np.sin(300 * q)
    for name, n in (("log.csv", 80), ("track.csv", 40), ("run.csv", 40)):
        table = np.column_stack([q, x, np.arange(80) // 20])[:n]
        np.savetxt(home / name, table, "%.9g", ",", header="a,b,c,x,y,z,motion", comments="")
    return home


@pytest.fixture
def place(made, tmp_path, monkeypatch):
    monkeypatch.chdir(made)
    return tmp_path / "out"


def run(command, place, *more):
    """Run a command that writes to a place, within some seconds, and return its exit code."""
    if command in SINGLE:
        arguments = [*SINGLE[command][1], str(place / SINGLE[command][0])]
    else:
        arguments = [*FOLDERS[command], str(place)]
    with within(60.0):
        return main([command.partition(" ")[0], *arguments, *more])


@contextlib.contextmanager
def within(seconds):
    def late(*_):
        pytest.fail("the command waits")

    if sys.platform == "win32":
        yield
        return
    before = signal.signal(signal.SIGALRM, late)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def needs(command):
    if command == "animate html":
        pytest.importorskip("viser", reason='needs viser: pip install "hybridkin[view]"')


@pytest.mark.parametrize(("command", "name"), FILES)
def test_a_file_of_another_is_refused_at_once_and_kept(place, capsys, command, name):
    place.mkdir()
    (place / name).write_bytes(MINE)
    assert run(command, place) == 2
    word = command.partition(" ")[0]
    err = capsys.readouterr().err
    assert f"has {name} already, which `hybridkin {word}` replaces only with --force" in err
    assert [path.name for path in place.iterdir()] == [name]
    assert (place / name).read_bytes() == MINE


@pytest.mark.parametrize(
    ("command", "name", "kind"),
    [(*file, "pipe") for file in FILES]
    + [(*file, kind) for file in FIRST for kind in ("folder", "device")],
)
def test_what_is_no_file_is_refused_at_once_also_by_force(place, capsys, command, name, kind):
    if kind != "folder" and not hasattr(os, "mkfifo"):
        pytest.skip("needs POSIX")
    place.mkdir()
    if kind == "pipe":
        os.mkfifo(place / name)
    elif kind == "device":
        (place / name).symlink_to(os.devnull)
    else:
        (place / name).mkdir()
    assert run(command, place, "--force") == 2
    assert run(command, place) == 2
    assert "which is not one" in capsys.readouterr().err
    assert [path.name for path in place.iterdir()] == [name]


@pytest.mark.slow
@pytest.mark.parametrize("command", [*FOLDERS, *SINGLE])
def test_own_files_are_replaced_and_by_force_those_of_others(place, capsys, command):
    needs(command)
    place.mkdir()
    assert run(command, place) == 0, capsys.readouterr().err
    names = sorted(path.name for path in place.iterdir())
    listed = WRITTEN.get(command) or [SINGLE[command][0]]
    assert {*names} >= {*listed} - {"robot.toml"}
    assert {*names} <= {*listed}, "a name that no test above refuses"
    assert run(command, place) == (2 if command == EDITED else 0), capsys.readouterr().err
    for name in names:
        (place / name).write_bytes(MINE)
    assert run(command, place) == 2
    assert run(command, place, "--force") == 0, capsys.readouterr().err
    assert MINE not in [path.read_bytes() for path in place.iterdir()]
    assert not [path for path in place.iterdir() if path.name not in names]


def test_a_demo_needs_an_empty_folder(place, capsys):
    place.mkdir()
    (place / "log.csv").write_bytes(MINE)
    assert main(["demo", "--out", str(place)]) == 2
    assert (place / "log.csv").read_bytes() == MINE
    if hasattr(os, "mkfifo"):
        os.mkfifo(place / "pipe")
        with within(10.0):
            assert main(["demo", "--out", str(place / "pipe")]) == 2


def test_a_film_with_its_mark_is_a_whole_film(place):
    from PIL import Image

    place.mkdir()
    assert run("animate", place) == 0
    with Image.open(place / "a.gif") as film:
        film.seek(film.n_frames - 1)
        film.load()
        assert film.n_frames == 2
    assert load_log("track.csv", ["a"], ["x", "y", "z"]).q.shape == (40, 1)
