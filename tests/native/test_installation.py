import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import hybridkin
from hybridkin.native import _installation

PIP = f"{sys.executable} -m pip install --force-reinstall --no-deps --no-cache-dir "
UV = f"uv pip install --python {sys.executable} --force-reinstall --no-deps --no-cache-dir "
GIT = {"url": "https://example.org/h.git", "vcs_info": {"vcs": "git", "commit_id": "1"}}


@pytest.fixture(scope="module")
def without_core(tmp_path_factory):
    """A folder with the package as it is installed where there is no compiler."""
    folder = tmp_path_factory.mktemp("site")
    package = Path(hybridkin.__file__).parent
    leave = shutil.ignore_patterns("lib", "__pycache__")
    shutil.copytree(package, folder / "hybridkin", ignore=leave)
    return folder


def said(folder, code, **environment):
    """Return what a program says that imports the package of a folder."""
    inherited = {name: value for name, value in os.environ.items() if name != "HYBRIDKIN_NATIVE"}
    environment = {**inherited, "PYTHONPATH": str(folder), **environment}
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=folder, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stderr


CHAIN = """
import hybridkin
hybridkin.native.evaluate(hybridkin.ConstantCurvatureChain([0.1]), [[0.2, 0.2, 0.2]])
"""


@pytest.mark.slow
def test_an_absent_core_is_said_once_with_the_command(without_core):
    text = said(without_core, CHAIN)
    assert text.count("hybridkin computes without its compiled core") == 1
    assert "install a C compiler, then run `" in text
    assert "computes without" in said(without_core, "import hybridkin.native")


@pytest.mark.slow
def test_nothing_is_said_where_the_core_is_off_or_in_workers(without_core):
    assert said(without_core, CHAIN, HYBRIDKIN_NATIVE="off") == ""
    worker = (
        "import multiprocessing\n"
        "with multiprocessing.get_context('spawn').Pool(1) as pool:\n"
        "    pool.apply(exec, ['import hybridkin.native'])\n"
    )
    assert "computes without" not in said(without_core, worker)


@pytest.mark.slow
def test_the_command_line_says_it_as_a_warning(without_core):
    script = "import hybridkin.app.cli.main as cli; cli.main(['describe', 'robot.toml'])"
    (without_core / "robot.toml").write_text("[[segment]]\nradius = 0.1\n")
    lines = said(without_core, script).splitlines()
    assert [
        line.startswith("hybridkin: warning: hybridkin computes without") for line in lines
    ] == [True]


@pytest.mark.parametrize(
    ("files", "command"),
    [
        ({}, f"{PIP}hybridkin"),
        ({"INSTALLER": "pip\n"}, f"{PIP}hybridkin"),
        ({"INSTALLER": "uv"}, f"{UV}hybridkin"),
        ({"direct_url.json": {"url": "file:///home/clone", "dir_info": {}}}, "file:///home/clone"),
        ({"direct_url.json": {"url": "file:///home/h-1.tar.gz"}}, "file:///home/h-1.tar.gz"),
        ({"direct_url.json": {"url": "file:///home/h-1-none-any.whl"}}, f"{PIP}hybridkin"),
        ({"direct_url.json": GIT}, " git+https://example.org/h.git"),
    ],
)
def test_the_command_is_that_of_the_installation(monkeypatch, tmp_path, files, command):
    monkeypatch.setattr(_installation, "_SOURCES", tmp_path)
    record = tmp_path / "hybridkin-1.0.dist-info"
    record.mkdir()
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: hybridkin\nVersion: 1.0\n")
    for name, content in files.items():
        text = content if isinstance(content, str) else json.dumps(content)
        (record / name).write_text(text)
    monkeypatch.syspath_prepend(tmp_path)
    assert _installation.compiling_command().endswith(command)


def test_a_clone_compiles_in_place(monkeypatch, tmp_path):
    monkeypatch.setattr(_installation, "_SOURCES", tmp_path)
    (tmp_path / "hatch_build.py").touch()
    assert _installation.compiling_command().endswith(str(tmp_path / "hatch_build.py"))


def test_a_clone_that_hides_the_installed_package_is_named(monkeypatch, tmp_path):
    clone = tmp_path / "clone"
    clone.mkdir()
    (clone / "hatch_build.py").touch()
    monkeypatch.setattr(_installation, "_SOURCES", clone)
    record = tmp_path / "site" / "hybridkin-1.0.dist-info"
    record.mkdir(parents=True)
    (record / "METADATA").write_text("Metadata-Version: 2.1\nName: hybridkin\nVersion: 1.0\n")
    monkeypatch.syspath_prepend(tmp_path / "site")
    monkeypatch.setattr(sys, "path", [str(tmp_path / "site")])
    assert "installed without compiled kernels" in _installation.without_kernels()  # editable
    (tmp_path / "site" / "hybridkin").mkdir()
    text = _installation.without_kernels()
    assert f"imported from the source folder {clone}, which has no compiled kernels; run" in text
    assert "or work in another folder to use the installed package" in text
