"""Public functions and methods, given hostile arguments at random, by the property tests.

The property tests of tests/test_hostile_arguments.py and tests/**/test_properties*.py are run with
the profile "examination": 500 examples for each property in the full examination, 5 in the
shortened one, fewer where an example takes long. The seed is 20.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from _line import Line

TESTS = Path(__file__).parent.parent
SEED, FULL, SHORT = 20, 500, 5


def examine(full: bool) -> Iterator[Line]:
    files = [TESTS / "test_hostile_arguments.py", *sorted(TESTS.glob("**/test_properties*.py"))]
    for k, file in enumerate(files, 1):
        print(f"{k}/{len(files)} {file.name}", file=sys.stderr, flush=True)
        yield line_of(file, FULL if full else SHORT)


def line_of(file: Path, examples: int) -> Line:
    """Run one file; it holds where all its properties do, each in at least one example."""
    command = [sys.executable, "-m", "pytest", str(file), "-q", "--tb=short", "-rP"]
    command += ["--hypothesis-profile=examination", f"--hypothesis-seed={SEED}"]
    command += ["--hypothesis-show-statistics"]
    if file.stem == "test_hostile_arguments":
        command += ["-k", "any_argument"]
    environment = {**os.environ, "EXAMPLES": str(examples)}
    start = time.perf_counter()
    run = subprocess.run(
        command, cwd=TESTS.parent, env=environment, capture_output=True, text=True, check=False
    )
    seconds = time.perf_counter() - start
    examples_of = re.findall(r"generate phase.*?(\d+) passing", run.stdout, re.DOTALL)
    tested = [int(n) for n in examples_of if int(n)]
    counts = Counter()
    for n, what in re.findall(r"(\d+) (passed|failed|error|skipped)", run.stdout):
        counts[what] += int(n)
    failed = counts["failed"] + counts["error"]
    if run.returncode:
        print(run.stdout.split("= PASSES =")[0], run.stderr[-2000:], file=sys.stderr)
    return Line(
        f"{file.stem}: an answer or an error that names the argument",
        f"{counts['passed'] + failed} properties, {sum(tested)} examples (at most {examples} "
        f"each, seed {SEED}), {failed} failures, {counts['skipped']} not run, {seconds:.0f} s",
        run.returncode == 0 and 0 < counts["passed"] <= len(tested) and not counts["skipped"],
    )
