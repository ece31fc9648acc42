"""The README does what it says: each code block, each command, each link, and the examples."""

import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pytest

from hybridkin.app.cli._parser import parser
from hybridkin.app.cli.main import main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
EXAMPLES = sorted((ROOT / "examples").glob("plot_*.py"))


def commands(text):
    """Return the commands of the console blocks, continued lines joined, comments off."""
    blocks = re.findall(r"```console\n(.*?)```", text, re.DOTALL)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.strip()]


COMMANDS = commands(README)
FIRST_USE = [c for c in COMMANDS if c[0] == "hybridkin" and c[1] in ("demo", "init", "view")]
OWN_LOG = [c for c in COMMANDS if c[0] == "hybridkin" and c not in FIRST_USE]
RECORDING = commands((ROOT / "docs" / "results.md").read_text(encoding="utf-8"))


def hybridkin(command):
    """Run a command in this process."""
    assert command[0] == "hybridkin"
    assert main(command[1:]) == 0


@pytest.mark.slow
def test_python_runs_as_printed(capsys):
    blocks = re.findall(r"```python\n(.*?)```", README, re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert float(re.search(r"unseen rows: ([\d.]+) cm", printed)[1]) < 1.5
    assert re.search(r"\(\d+, 9\)", printed)


def test_every_kind_of_command_is_tried_below():
    assert {"pip", "make", "hybridkin"} <= {command[0] for command in COMMANDS}
    assert {command[0] for command in COMMANDS} <= {"pip", "uv", "make", "hybridkin"}
    assert len(OWN_LOG) >= 2
    assert all("train.csv" in command for command in RECORDING)


def test_commands_of_the_first_use_are_known(tmp_path, monkeypatch):
    """They run in tests/app/cli and tests/app/viewer: one takes a minute, one asks, one waits."""
    monkeypatch.chdir(tmp_path)
    Path("log.csv").touch()
    found = [parser().parse_args(command[1:]).command for command in FIRST_USE]
    assert found == ["demo", "init", "view"]


def test_what_pip_installs_is_there():
    """The installation itself is what `make` does."""
    pyproject = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = pyproject["project"]
    pages = ["README.md", "CONTRIBUTING.md"]
    lines = "\n".join((ROOT / page).read_text(encoding="utf-8") for page in pages)
    installs = re.findall(r"^(?:uv )?pip install (.*)$", lines, re.MULTILINE)
    assert len(installs) >= 2
    for line in installs:
        words = shlex.split(line, comments=True)
        while "--group" in words:
            group = words.pop(words.index("--group") + 1)
            words.remove("--group")
            assert group in pyproject["dependency-groups"]
        for name in words:
            extras = re.fullmatch(r"\.\[([\w,]+)\]", name)
            if extras:
                assert {*extras[1].split(",")} <= {*project["optional-dependencies"]}
            elif name not in (".", "--editable"):
                assert any(needed.startswith(name) for needed in project["dependencies"])


CONTRIBUTING = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
PYTEST = "-m pytest -q -n auto --maxprocesses 4 --dist worksteal"
RUNS = {  # the last command of a target
    "paper": "python examples/paper --out results",
    "test": f"python {PYTEST}",
    "quick": f'python {PYTEST.replace("pytest", "pytest tests")} -m "not slow"',
    "docs": "python -m sphinx -W --keep-going -n -b html docs docs/_build/html",
    "examine": "python tests/examination --out results/examination",
    "bench": "python -m pytest -q tests/benchmarks --benchmark-enable --benchmark-quiet",
    "view-test": "python -m pytest -q tests/app/viewer -m browser",
    "check": "pyright --pythonpath .venv/bin/python",
}
GROUPS = {"docs": "docs", "bench": "bench", "examine": "examine"}  # more than the group "full"
TARGETS = {*re.findall(r"make\s([a-z-]+)", README), *re.findall(r"make ([a-z-]+) +#", CONTRIBUTING)}


def planned(folder, target):
    """Return the command lines that make would run for a target in a folder."""
    of_make = ("MAKEFLAGS", "MFLAGS", "MAKELEVEL", "PYTHON", "OUT", "TESTS")
    environment = {name: value for name, value in os.environ.items() if name not in of_make}
    done = subprocess.run(
        ["make", "-n", target], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    lines = done.stdout.replace("\\\n", " ").splitlines()
    return [shlex.split(re.sub(r"^env -u \w+ ", "", line)) for line in lines]


@pytest.fixture
def fresh(tmp_path):
    """A folder with what make looks at in a clone, and nothing that it has made."""
    for name in ("Makefile", "pyproject.toml", "hatch_build.py"):
        shutil.copy(ROOT / name, tmp_path / name)
    for name in ("hybridkin/_core/kernel_numbers.py", "hybridkin/native/src/hybridkin.h"):
        (tmp_path / name).parent.mkdir(parents=True)
        (tmp_path / name).touch()
    return tmp_path


@pytest.mark.skipif(shutil.which("make") is None, reason="needs make")
@pytest.mark.parametrize("target", sorted(TARGETS | {*RUNS}))
def test_make_runs_what_a_target_says(fresh, target):
    """In a clone it first makes the environment; once that is there, it runs the command alone."""
    before = [".venv/bin/python", "-m", "pip", "install", "--quiet"]
    clean = planned(fresh, target)
    last = clean[-1]
    if target == "native":
        last = clean[-2]
        assert last == [".venv/bin/python", "hatch_build.py"]
    if target in RUNS:
        assert last == shlex.split(f".venv/bin/{RUNS[target]}")
    script = Path(last[1]) if last[0].endswith("python") and last[1] != "-m" else Path(last[0])
    if script.parts[0] != ".venv":
        assert (ROOT / script).exists()
    if last[0].startswith(".venv"):  # others make an environment of their own
        assert clean[0] == ["python3", "-m", "venv", ".venv"]
        assert [*before, "--editable", ".[full]", "--group", "full"] in clean[: clean.index(last)]
    if target in GROUPS:
        assert [*before, "--group", GROUPS[target]] in clean[: clean.index(last)]
    for name in ("installed", "native", "docs", "bench", "examine", "browser", "wheels"):
        (fresh / ".venv").mkdir(exist_ok=True)
        (fresh / ".venv" / f".{name}").touch()
    installed = planned(fresh, target)
    assert not [line for line in installed if "pip" in line or "venv" in line]
    if target == "native":
        assert "Nothing to be done" in " ".join(installed[0])
    else:
        assert installed[-1] == clean[-1]
        assert len(installed) <= 3
    # Changed sources are compiled before they are used.
    later = 2 + max(path.stat().st_mtime for path in (fresh / ".venv").iterdir())
    os.utime(fresh / "hybridkin/native/src/hybridkin.h", (later, later))
    changed = planned(fresh, target)
    compiles = [".venv/bin/python", "hatch_build.py"]
    assert (compiles in changed) == (compiles in clean)
    if target in {*RUNS} - {"docs", "check"}:
        assert compiles in clean


def test_every_target_that_the_readme_names_is_tried():
    assert {"paper", "test", "docs"} <= TARGETS & {*RUNS}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {*re.findall(r"^([a-z-]+):", makefile, re.MULTILINE)} >= TARGETS
    assert "not slow" in RUNS["quick"]
    markers = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    markers = markers["tool"]["pytest"]["ini_options"]["markers"]
    assert {"slow", "browser"} <= {marker.partition(":")[0] for marker in markers}


QUICK = ["--folds", "2", "--jobs", "1", "--max-rows", "200"]  # of `fit`: less work


@pytest.mark.slow
def test_commands_for_a_log_of_ones_own_run(tmp_path, monkeypatch, capsys):
    """Those of the README and of the docs, on the robot and the simulated log of the docs."""
    page = (ROOT / "docs" / "your_robot.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    Path("robot.toml").write_text(re.search(r"```toml\n(.*?)```", page, re.DOTALL)[1])
    exec(
        compile(re.search(r"```python\n(.*?)```", page, re.DOTALL)[1], "your_robot.md", "exec"), {}
    )
    more = [command for command in commands(page) if command[1] not in ("fit", "track")]
    kinds = {"init", "describe", "evaluate", "animate", "next", "verify"}
    assert {command[1] for command in more} == kinds
    for command in [*OWN_LOG, *more]:
        if command[1] == "verify":  # a robot that does as the model
            shutil.copy("track/track.csv", "measured.csv")
        hybridkin(command + (QUICK if command[1] == "fit" else []))
        assert capsys.readouterr().out
        if "--out" in command:
            assert Path(command[command.index("--out") + 1]).exists()
    assert Path("model/model.safetensors").is_file()
    track = np.genfromtxt("track/track.csv", delimiter=",", names=True)
    assert len(track) > 100
    assert {"s1", "s6"} <= {*track.dtype.names}


@pytest.mark.slow
def test_commands_for_the_recording_run(tmp_path, data_home, monkeypatch, capsys):
    """On every sixth row, which leaves the motions whole, and without auto, which takes minutes."""
    lines = (data_home / "ftdcr_v4" / "train.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "train.csv").write_text("\n".join([lines[0], *lines[1::6]]), encoding="utf-8")
    shutil.copytree(ROOT / "examples" / "robots", tmp_path / "examples" / "robots")
    command = [word for word in RECORDING[-1] if word not in ("--hysteresis", "auto")]
    monkeypatch.chdir(tmp_path)
    hybridkin([*command, *QUICK, "--no-auto"])
    out = capsys.readouterr().out
    found = re.findall(r"^\W+(mechanical, calibrated|hybrid, ELM)[ |]+([\d.]+)", out, re.MULTILINE)
    assert {name: float(mean) < 12.0 for name, mean in found} == {
        "mechanical, calibrated": True,
        "hybrid, ELM": True,
    }


def test_links_lead_to_files_that_are_there():
    for link in re.findall(r"\]\(([^)#]+)\)", README):
        assert (ROOT / link).is_file(), link


# What takes long in an example, and less of it; `make docs` runs each example as it stands.
SMALLER = {
    "plot_learning_curve": [("ShuffleSplit(3", "ShuffleSplit(1"), ("60, 120, 250]", "40, 50, 60]")],
    "plot_model_selection": [
        ("[25, 100]", "[5, 100]"),
        ("10.0, 4)", "10.0, 2)"),
        (":300]", ":120]"),
    ],
    "plot_motions": [("[::2]", "[::8]")],
    "plot_new_day": [("range(10)", "range(1)"), ("1600", "400"), ("1680", "480")],
    "plot_next_rows": [
        ("range(5)", "range(1)"),
        ("(25, 50, 100)", "(25, 30, 40)"),
        ("100)", "40)"),
    ],
    "plot_notebook": [("data.q[::4], data.x[::4]", "data.q[::20], data.x[::20]"), ("0.05", "0.2")],
    "plot_obstacles": [
        ("N_TICKS = 80", "N_TICKS = 20"),
        ("fit(data.q, data.x)", "fit(data.q[::4], data.x[::4])"),
    ],
    "plot_payload": [
        ("dt=0.1)", "dt=0.1, duration=2.5)"),
        ("data.q, data.x", "data.q[::4], data.x[::4]"),
    ],
    "plot_rigid_arm": [
        ("cv=10", "cv=3"),
        ("turns=1.0, dt=0.1", "turns=1.0, dt=0.5"),
        ("::12", "::3"),
    ],
    "plot_slack_tendons": [("thin=2", "thin=8")],
    "plot_table1": [("n_splits=4", "n_splits=2")],
    "plot_tracking": [("0.125", "0.5")],
}


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda path: path.stem)
def test_examples_run_and_draw(example, tmp_path, monkeypatch, capsys):
    source = example.read_text(encoding="utf-8")
    for long, short in SMALLER.get(example.stem, []):
        assert long in source
        source = source.replace(long, short)
    smaller = tmp_path / example.name
    smaller.write_text(source, encoding="utf-8")
    shown = []
    monkeypatch.setattr(plt, "show", lambda: shown.append(len(plt.get_fignums())))
    runpy.run_path(str(smaller))
    figures = plt.get_fignums()
    plt.close("all")
    skipped = "Skipped: " in capsys.readouterr().out
    if example.stem == "plot_elm_dask":  # starts its workers as a script only, see test_elm_scale
        assert not figures
    else:
        assert skipped != bool(figures)
        assert skipped == (not shown)
