"""Public functions and methods, given hostile arguments at random, by the property tests.

Every test of tests/**/test_properties*.py is run with the profile "examination": 500 examples for
each property in the full examination, 5 in the shortened one, fewer where an example takes long.
The seed is 20.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from _line import Line

TESTS = Path(__file__).parent.parent
SEED, FULL, SHORT = 20, 500, 5


def examine(full: bool) -> Iterator[Line]:
    files = sorted(TESTS.glob("**/test_properties*.py"))
    files = [file for file in files if "names" not in file.stem]
    for k, file in enumerate(files, 1):
        print(f"{k}/{len(files)} {file.name}", file=sys.stderr, flush=True)
        yield line_of(file, FULL if full else SHORT)


def line_of(file: Path, examples: int) -> Line:
    """Run one file; it holds where all its properties do, and at least one was tested."""
    command = [sys.executable, "-m", "pytest", str(file), "-q", "--tb=short", "-rP"]
    command += ["--hypothesis-profile=examination", f"--hypothesis-seed={SEED}"]
    command += ["--hypothesis-show-statistics"]
    environment = {**os.environ, "EXAMPLES": str(examples)}
    start = time.perf_counter()
    run = subprocess.run(
        command, cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False
    )
    seconds = time.perf_counter() - start
    tested = sum(map(int, re.findall(r"generate phase.*?(\d+) passing", run.stdout, re.DOTALL)))
    counts = {what: int(n) for n, what in re.findall(r"(\d+) (passed|failed|errors?)", run.stdout)}
    failed = sum(n for what, n in counts.items() if what != "passed")
    if run.returncode:
        print(run.stdout.split("= PASSES =")[0], run.stderr[-2000:], file=sys.stderr)
    return Line(
        f"{file.stem}: an answer or an error that names the argument",
        f"{counts.get('passed', 0) + failed} properties, {tested} examples (at most {examples} "
        f"each, seed {SEED}), {failed} failures, {seconds:.0f} s",
        run.returncode == 0 and tested > 0,
    )
