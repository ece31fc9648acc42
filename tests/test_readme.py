import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent


def test_readme_python_runs_as_printed(capsys):
    blocks = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.DOTALL)
    assert blocks
    for block in blocks:
        exec(compile(block, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    assert float(re.search(r"unseen rows: ([\d.]+) cm", printed)[1]) < 1.5
    assert re.search(r"\(\d+, 9\)", printed)


def test_readme_points_at_files_that_are_there():
    links = re.findall(r"\]\(([^)#]+)\)", (ROOT / "README.md").read_text())
    for link in links:
        assert (ROOT / link).is_file(), link


@pytest.mark.parametrize("example", sorted((ROOT / "examples").glob("plot_*.py")), ids=str)
def test_examples_run(example):
    runpy.run_path(str(example))
