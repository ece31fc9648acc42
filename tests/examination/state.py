"""Each entry of the state of each module, changed in each way: the module is what its state says.

The test of tests/core/test_hostile_state.py, which takes one way for each entry of a kind in the
suite, takes all of them here. Seed 0.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from _line import Line

TESTS = Path(__file__).parent.parent


def examine(full: bool) -> Iterator[Line]:
    """Yield one line for all entries."""
    file = TESTS / "core" / "test_hostile_state.py"
    command = [sys.executable, "-m", "pytest", str(file), "-q", "-s", "-k", "every_module"]
    environment = {**os.environ, "EXAMPLES": "1"} if full else {**os.environ}
    run = subprocess.run(
        command, cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False
    )
    counts = re.search(r"\d+ entries of \d+ modules", run.stdout)
    if run.returncode:
        print(run.stdout[-4000:], run.stderr[-2000:], file=sys.stderr)
    ways = "nine ways of changing each" if full else "one way of changing each"
    figure = f"{counts[0] if counts else 'no entries'}, {ways}"
    yield Line("a changed module is a new one with its state", figure, run.returncode == 0)
