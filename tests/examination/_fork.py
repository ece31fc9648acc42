"""Tests in forked processes: the package is imported and the suite collected once, not per run."""

from __future__ import annotations

import gc
import os
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from pathlib import Path
from types import FunctionType
from typing import Any

import pytest
from _mutation import ROOT, Mutant
from hypothesis import HealthCheck, Phase, settings

PASSED, FAILED, BROKEN = 0, 1, 2  # exit codes of a process
MEMORY = 24 << 30  # bytes of address space of one process
WALL = 300.0  # seconds until a process that uses no CPU is killed


@dataclass
class Result:
    """How one process ended."""

    task: Any
    code: int  # the exit code, or minus the signal
    note: str  # what it wrote about the end
    seconds: float  # CPU, subprocesses included


def pool(
    tasks: Iterable, work: Callable[[Any], str | None], workers: int = 2, quiet: bool = True
) -> Iterator[Result]:
    """Yield how `work(task)` ended for each task; a returned text is the note of a failure."""
    tasks, running = iter(tasks), {}
    while True:
        while len(running) < workers and (task := next(tasks, None)) is not None:
            folder = tempfile.mkdtemp(prefix="forked-")
            pid = os.fork()
            if not pid:
                _child(folder, work, task, quiet)
            running[pid] = task, folder, time.monotonic()
        if not running:
            return
        pid, status, used = os.wait4(-1, os.WNOHANG)
        if not pid:
            time.sleep(0.01)
            for late in [p for p, r in running.items() if time.monotonic() - r[2] > WALL and quiet]:
                os.kill(late, signal.SIGKILL)
            continue
        task, folder, _ = running.pop(pid)
        try:
            if quiet:
                os.killpg(pid, signal.SIGKILL)  # what the tests left
        except ProcessLookupError:
            pass
        note = Path(folder, "note")
        text = note.read_text(encoding="utf-8") if note.is_file() else ""
        shutil.rmtree(folder, ignore_errors=True)
        code = os.waitstatus_to_exitcode(status)
        if code == BROKEN:
            raise RuntimeError(f"The runner failed with {task}: {text}")
        yield Result(task, code, text, used.ru_utime + used.ru_stime)


def _child(folder: str, work: Callable[[Any], str | None], task: Any, quiet: bool) -> None:
    """Run the task with no output, files of its own and limits; end the process."""
    code = BROKEN
    try:
        if quiet:
            os.setsid()
            null = os.open(os.devnull, os.O_RDWR)
            for stream in range(3):
                os.dup2(null, stream)
        os.environ["TMPDIR"] = os.environ["PYTEST_DEBUG_TEMPROOT"] = tempfile.tempdir = folder
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        note = work(task)
        code = PASSED if note is None else FAILED
    except BaseException:
        note = traceback.format_exc()
    Path(folder, "note").write_text(note or "", encoding="utf-8")
    os._exit(code)


class Fast:
    """Hands the collected fast tests to `work` instead of running them."""

    def __init__(self, work: Callable[[list[pytest.Item]], None]) -> None:
        self.work = work

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.work(session.items)
        return True


class Judge:
    """Runs tests until one fails; a test that takes far longer than it used to ends the process."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.seconds, self.failed = seconds, None

    def run(self, items: list[pytest.Item]) -> str | None:
        """Return the id of the first test that fails."""
        for item, following in zip(items, [*items[1:], None], strict=True):
            limit = 4.0 + 10.0 * self.seconds[item.nodeid]
            signal.setitimer(signal.ITIMER_PROF, limit)  # of CPU; its signal ends the process
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if self.failed:
                break
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        return self.failed

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed and not self.failed:
            self.failed = report.nodeid

    def pytest_collectreport(self, report: pytest.CollectReport) -> None:
        if report.failed and not self.failed:
            self.failed = f"collection of {report.nodeid}"


def prepare() -> None:
    """Import what the tests need, except the package itself."""
    os.chdir(ROOT)
    sys.path.insert(0, str(ROOT))
    for name in ("torch", "sklearn.utils.estimator_checks", "pytorch_kinematics", "scipy.optimize"):
        __import__(name)
    checks, phases = list(HealthCheck), (Phase.explicit, Phase.generate)
    settings.register_profile(
        "forked", derandomize=True, deadline=None, database=None, phases=phases,
        suppress_health_check=checks,
    )  # fmt: skip
    settings.load_profile("forked")


def collected(work: Callable[[list[pytest.Item]], None], paths: Iterable[str], *plugins) -> int:
    """Collect the fast tests of the paths, hand them to `work`, and return pytest's exit code."""
    options = "-q -q --no-summary --capture=no -p no:xdist --assert=plain -m".split()
    options += ["not slow", *paths]
    return pytest.main(options, plugins=[Fast(work), *plugins])


def functions() -> dict[str, list[FunctionType]]:
    """Return the live functions of the package by file."""
    found = defaultdict(list)
    for one in gc.get_objects():
        if type(one) is FunctionType and one.__code__.co_filename.startswith(str(ROOT)):
            found[one.__code__.co_filename].append(one)
    return found


def patch(mutant: Mutant, live: dict[str, list[FunctionType]]) -> None:
    """Give the live functions the mutated code."""
    after = dict(mutant.functions or ())
    for function in live[str(ROOT / mutant.path)]:
        function.__code__ = after.get(function.__code__, function.__code__)


def imported(mutant: Mutant, tests: list[str], seconds: dict[str, float]) -> str | None:
    """Import the package with the mutated module and run the tests."""
    load, judge = SourceFileLoader.get_code, Judge(seconds)
    place = str(ROOT / mutant.path)

    def get_code(self, fullname):
        return mutant.code if self.path == place else load(self, fullname)

    SourceFileLoader.get_code = get_code

    def work(items):
        found = {item.nodeid: item for item in items}
        judge.run([found[name] for name in tests if name in found])

    files = list(dict.fromkeys(name.split("::")[0] for name in tests))
    signal.setitimer(signal.ITIMER_PROF, 60.0)  # of the import
    code = collected(work, files, judge)
    return judge.failed or (f"pytest ends with {code}" if code not in (0, 5) else None)
