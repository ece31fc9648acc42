"""Mutation testing by cosmic-ray: do the fast tests of a folder see a small change of its code?

200 changes (shortened: 8, of `learning`) of _core, chains, learning, hybrid and ik are drawn with
seed 0. Each is made in a copy of the sources, where the fast tests of the same folder then run
until one fails. Unions are left out: most stand in annotations. results/mutants/survivors.diff
lists the changes that no test noticed.
"""

from __future__ import annotations

import os
import random
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

from _line import Line
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import WorkerOutcome, WorkResult
from tqdm import tqdm

ROOT = Path(__file__).parents[2]
OUT = ROOT / "results/mutants"
FOLDERS = ("_core", "chains", "learning", "hybrid", "ik")
CONFIG = """[cosmic-ray]
module-path = "hybridkin/{folder}"
timeout = 300.0
excluded-modules = []
test-command = "{python} -m pytest -q -x -m 'not slow' tests/{tests}"
[cosmic-ray.distributor]
name = "local"
"""


def examine(full: bool) -> Iterator[Line]:
    """Yield for each folder whether its tests pass, and which share of the changes they see."""
    OUT.mkdir(parents=True, exist_ok=True)
    (OUT / "survivors.diff").unlink(missing_ok=True)
    folders = FOLDERS if full else ("learning",)
    n_killed, n_changes = 0, 0
    with tempfile.TemporaryDirectory() as copy:
        for name in ("hybridkin", "tests", "examples"):
            shutil.copytree(ROOT / name, Path(copy, name))
        shutil.copy(ROOT / "pyproject.toml", copy)
        for folder in tqdm(folders, "folders"):
            if run("baseline", folder, copy):
                yield Line(f"{folder}: the unchanged code passes", "its tests fail", False)
                continue
            killed = judged(folder, copy, 40 if full else 8)
            yield Line(
                f"{folder}: changes that a test notices", f"{sum(killed)} of {len(killed)}", True
            )
            n_killed += sum(killed)
            n_changes += len(killed)
    need = 0.85 if full else 0.6
    what = f"at least {need:.0%} of all changes are noticed (seed 0)"
    yield Line(what, f"{n_killed} of {n_changes}", n_changes > 0 and n_killed >= need * n_changes)


def run(command: str, folder: str, copy: str, *session: str) -> int:
    """Run a command of cosmic-ray in the copy, and return its exit code."""
    text = CONFIG.format(folder=folder, tests=folder.strip("_"), python=sys.executable)
    Path(copy, "cosmic.toml").write_text(text, encoding="utf-8")
    code = "import sys; from cosmic_ray.cli import cli; sys.exit(cli())"
    arguments = [sys.executable, "-c", code, command, "cosmic.toml", *session]
    paths = os.pathsep.join([copy, *filter(None, [os.environ.get("PYTHONPATH")])])
    return subprocess.call(arguments, cwd=copy, env={**os.environ, "PYTHONPATH": paths})


def judged(folder: str, copy: str, n: int) -> list[bool]:
    """Return for each of n changes of a folder whether a test noticed it."""
    session = f"{folder}.sqlite"
    if run("init", folder, copy, session):
        raise RuntimeError(f"cosmic-ray finds no changes of {folder}")
    with use_db(str(Path(copy, session)), WorkDB.Mode.open) as database:
        drawn = sample(database, n)
        skipped = [item.job_id for item in database.work_items if item.job_id not in drawn]
        database.set_multiple_results(skipped, WorkResult(WorkerOutcome.SKIPPED))
    run("exec", folder, copy, session)
    killed = []
    with use_db(str(Path(copy, session)), WorkDB.Mode.open) as database:
        for job, result in database.results:
            if job not in drawn:
                continue
            killed.append(result.is_killed)
            if not result.is_killed:
                with (OUT / "survivors.diff").open("a", encoding="utf-8") as file:
                    file.write(f"{result.diff}\n\n")
    return killed


def sample(database: WorkDB, n: int) -> set[str]:
    """Return n jobs, each of another place: cosmic-ray makes eleven of each binary operator."""
    places = defaultdict(list)
    for item in database.work_items:
        (mutation,) = item.mutations
        family = mutation.operator_name.split("_")[0]
        if "BinaryOperator_BitOr" not in mutation.operator_name:
            places[str(mutation.module_path), mutation.start_pos, family].append(item.job_id)
    generator = random.Random(0)
    drawn = generator.sample(sorted(places), min(n, len(places)))
    return {generator.choice(places[place]) for place in drawn}
