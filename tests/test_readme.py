"""The README does what it says: each code block, each command, each link, and the examples."""

import csv
import os
import re
import runpy
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import matplotlib.pyplot as plt
import pytest
from page_blocks import DOCS, PAGES, QUICK, Reader, blocks_of, commands_of

from hybridkin.app.cli.main import main

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parent.parent
README = ROOT / "README.md"
EXAMPLES = sorted((ROOT / "examples").glob("plot_*.py"))


def commands_on(page):
    """Return the commands of all console blocks of a page."""
    blocks = [block for block in blocks_of(page) if block.language in ("console", "bash")]
    return [command for block in blocks for command in commands_of(block.text)]


COMMANDS = commands_on(README)
RESULTS = (DOCS / "reference" / "results.md").read_text(encoding="utf-8")
RECORDING = re.findall(r"hybridkin fit train\.csv(?:[^`\n\\]|\\\n)*", RESULTS)
INSTALLS = [
    command
    for page in [README, ROOT / "CONTRIBUTING.md", *PAGES]
    for command in commands_on(page)
    if command[0] in ("pip", "uv")
]


@pytest.mark.slow
def test_readme_runs_as_printed(tmp_path, monkeypatch):
    """In an empty folder."""
    monkeypatch.chdir(tmp_path)
    printed = Reader(README).run().printed
    assert float(re.search(r"unseen rows: ([\d.]+) cm", printed)[1]) < 1.5
    assert "(201, 9)" in printed
    assert "Reached: 501 of 501 points" in printed
    assert Path("track/track.csv").is_file()


def test_every_kind_of_command_is_tried_below():
    assert {command[0] for command in COMMANDS} == {"pip", "uv", "make", "hybridkin"}


def test_readme_is_short():
    assert len(README.read_text(encoding="utf-8").split()) <= 650


def test_what_pip_installs_is_there():
    """The extras and groups exist; the installation itself is what `make` does."""
    content = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    project = content["project"]
    assert INSTALLS
    for program, *command in INSTALLS:
        if program == "uv":
            assert command[0] in ("venv", "pip")
            del command[0]
        if not command:
            continue
        assert command.pop(0) == "install"
        while command:
            name = command.pop(0)
            extras = re.fullmatch(r"(?:\.|hybridkin)\[([\w,]+)\]", name)
            if name == "--group":
                assert command.pop(0) in content["dependency-groups"]
            elif extras:
                assert {*extras[1].split(",")} <= {*project["optional-dependencies"]}
            elif name not in ("--editable", "."):
                assert any(needed.startswith(name) for needed in project["dependencies"])


# Rows of the README, and those of the tables of results with the same model.
ROWS = {
    "nominal model": (
        "mechanical, nominal (published radii)",
        "mechanical, nominal",
        "mechanical, nominal (rings 40° apart), base fitted",
    ),
    "calibrated model": (
        "mechanical, calibrated (radii, base)",
        "mechanical, calibrated",
        "mechanical, as the fit chose and calibrated it: elastic tendons",
    ),
    "data alone, quadratic": (
        "data-driven, quadratic",
        "data alone, quadratic",
        "data-driven, quadratic",
    ),
    "hybrid: network on calibrated model": (
        "hybrid on calibrated, ELM",
        "hybrid on calibrated",
        "hybrid, ELM, with backlash",
    ),
}


def table(name):
    """Return the rows of a CSV file of docs/data."""
    with open(DOCS / "data" / name, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_rows_of_results_are_those_of_one_model():
    trunk = {}
    for row in table("trunk_test_rows.csv"):
        name = row["model"] if row["learner"] == "none" else f"{row['model']}, {row['learner']}"
        trunk[name] = row["test [cm]"].partition(" (")[0]
    tracking = {}
    for row in table("few_rows_tracking.csv"):  # spread over draws, not over points
        if row["rows"] == "1900":
            mean = float(row["without feedback [mm]"].partition(" ")[0])
            tracking[row["model"]] = f"{mean / 10:.2f}"
    for row in table("trunk_tracking.csv"):
        tracking[row["model"]] = row["error [cm]"]
    tendons = {}
    for row in table("nine_tendons.csv"):
        error = row["standard error over motions [mm]"]
        tendons[row["model"]] = f"{row['mean [mm]']} ± {error}"
    lines = re.findall(r"^\| (.+?) \| (.+) \| (.+) \| (.+) \|$", README.read_text("utf-8"), re.M)
    printed = {name: figures for name, *figures in lines if "±" in figures[0]}
    expected = {}
    for name, (test, track, held_out) in ROWS.items():
        expected[name] = [trunk[test], tracking[track], tendons[held_out]]
    assert printed == expected


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
TARGETS = {command[1] for command in COMMANDS if command[0] == "make"}
TARGETS |= {*re.findall(r"make ([a-z-]+) +#", CONTRIBUTING)}


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
    assert {"paper", "test"} <= TARGETS & {*RUNS}
    makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
    assert {*re.findall(r"^([a-z-]+):", makefile, re.MULTILINE)} >= TARGETS
    assert "not slow" in RUNS["quick"]
    markers = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    markers = markers["tool"]["pytest"]["ini_options"]["markers"]
    assert {"slow", "browser"} <= {marker.partition(":")[0] for marker in markers}


@pytest.mark.slow
def test_commands_for_the_recording_run(tmp_path, data_home, monkeypatch, capsys):
    """On every sixth row, which leaves the motions whole, and without auto, which takes minutes."""
    lines = (data_home / "ftdcr_v4" / "train.csv").read_text(encoding="utf-8").splitlines()
    (tmp_path / "train.csv").write_text("\n".join([lines[0], *lines[1::6]]), encoding="utf-8")
    shutil.copytree(ROOT / "examples" / "robots", tmp_path / "examples" / "robots")
    (command,) = RECORDING
    (words,) = commands_of(command)
    monkeypatch.chdir(tmp_path)
    assert main([*words[1:], *QUICK]) == 0
    out = capsys.readouterr().out
    found = re.findall(r"^\W+(mechanical, calibrated|hybrid, ELM)[ |]+([\d.]+)", out, re.MULTILINE)
    assert {name: float(mean) < 12.0 for name, mean in found} == {
        "mechanical, calibrated": True,
        "hybrid, ELM": True,
    }


def test_links_lead_to_files_that_are_there():
    for link in re.findall(r"\]\(([^)#]+)\)", README.read_text(encoding="utf-8")):
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
