import contextlib
import io

import pytest
from simulated_log import FIT, ROBOT, rows, write

from hybridkin.app.cli.main import main


def pytest_itemcollected(item):
    """Mark what needs the one fit, which takes seconds."""
    if "fitted" in item.fixturenames:
        item.add_marker(pytest.mark.slow)


@pytest.fixture
def robot(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text(ROBOT)
    return path


@pytest.fixture
def log(tmp_path):
    return write(tmp_path / "log.csv", rows())


@pytest.fixture(scope="session")
def fitted(tmp_path_factory):
    """The folder of the one fit of these tests, with its log, its robot and what it printed."""
    home = tmp_path_factory.mktemp("fitted")
    log = write(home / "log.csv", rows())
    (home / "robot.toml").write_text(ROBOT)
    arguments = [str(log), "--robot", str(home / "robot.toml"), "--out", str(home / "model")]
    printed = {"out": io.StringIO(), "err": io.StringIO()}
    with (
        contextlib.redirect_stdout(printed["out"]),
        contextlib.redirect_stderr(printed["err"]),
    ):
        assert main(["fit", *arguments, *FIT]) == 0
    for name, text in printed.items():
        (home / name).write_text(text.getvalue())
    return home
