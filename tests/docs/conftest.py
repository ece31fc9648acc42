import shutil

import matplotlib.pyplot as plt
import pytest
from page_blocks import DOCS, QUICK, Reader, blocks_of

from hybridkin.app.cli.main import main


@pytest.fixture(scope="session")
def _lab(tmp_path_factory):
    """The robot and the logs of the page "Your own robot", and a model of them."""
    folder = tmp_path_factory.mktemp("lab")
    page = DOCS / "tutorials" / "your_robot.md"
    reader = Reader(page)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        log, description = (
            next(block for block in blocks_of(page) if block.language == language)
            for language in ("python", "toml")
        )
        reader._python(log.text, log.line)
        reader._toml(description.text, description.line)
        fit = ["fit", "log.csv", "--robot", "robot.toml", "--groups", "motion", "--out", "model"]
        assert main([*fit, *QUICK]) == 0
    return folder


@pytest.fixture
def lab(_lab, tmp_path, monkeypatch):
    """A folder of its own with robot.toml, log.csv, next_day.csv and model, to work in."""
    shutil.copytree(_lab, tmp_path, dirs_exist_ok=True)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")
