"""Kills, signals and power loss: a file is the old or the new one, never half, and nothing stays.

Each run is a process forked from this one, so that a kill costs no import; it is killed at a moment
drawn uniformly over the time that a whole run takes (seed 20); a run that ends before its kill does
not count, and another is drawn. Real processes of the command line are killed too. Afterwards all
files of the folder must be those before, or all those after; then the same work is done once more,
to the end, and must leave its files and nothing else.
"""

from __future__ import annotations

import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _line import Line
from saved_models import arm, trunk
from tqdm import tqdm

from hybridkin import robots, save_model
from hybridkin._core.files import write_files
from hybridkin.app.cli.main import main
from paper import make_trunk, trunk_data

ROBOT = """calibrate = []
[[segment]]
radius = 0.005
length = 0.1
[log]
q = ["a", "b", "c"]
x = ["x", "y", "z"]
groups = "motion"
time = "t"
[limits]
q_min = -0.006
q_max = 0.006
"""
FIT = ["fit", "log.csv", "--robot", "robot.toml", "--folds", "2", "--no-auto"]
TRACK = [
    "track",
    "model",
    "--shape",
    "line",
    "--size",
    "0.005,0.005,0",
    "--unit",
    "m",
    "--duration",
]
COUNTS = {"save_model": 140, "fit --out": 16, "track --out": 24, "make_trunk": 24, "processes": 4}
DRAWS = 20  # at most, for each kill or signal that must hit a run
SETTINGS = {**os.environ, "SOURCE_DATE_EPOCH": "86400"}
Files = dict[str, bytes]


def examine(full: bool) -> Iterator[Line]:
    """Yield a line for each writer, each signal, and what is flushed to the disk."""
    rng, share = np.random.default_rng(20), 1.0 if full else 0.1
    os.environ["SOURCE_DATE_EPOCH"] = "86400"
    signal.signal(signal.SIGINT, signal.default_int_handler)  # in the background it is ignored
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        write_log()
        forked(lambda: main([*FIT, "--out", "model"]))
        for name, (old, new, out) in works().items():
            n = max(2, round(share * COUNTS[name]))
            yield killed(name, n, old, new, Path(out), rng)
        yield killed_at_every_step()
        yield flushed()
        for number in (signal.SIGINT, signal.SIGTERM):
            for name, command in {"fit": FIT, "track": [*TRACK, "4"]}.items():
                yield signalled(name, command, number, 5 if full else 1, rng)


def write_log() -> None:
    """Write a log of a segment and its description."""
    rng = np.random.default_rng(0)
    turns = np.linspace(0, 6, 20)[:, None] * rng.uniform(0.5, 1, (6, 1, 3))
    q = 0.004 * np.sin(turns + rng.uniform(0, 6, (6, 1, 3))).reshape(-1, 3)
    Path("robot.toml").write_text(ROBOT)
    x = robots.read_description("robot.toml").chain(torch.from_numpy(q)).numpy() + 2e-4 * np.sin(
        300 * q
    )
    table = np.column_stack([0.1 * np.arange(120), q, x, np.arange(120) // 20])
    np.savetxt("log.csv", table, delimiter=",", header="t,a,b,c,x,y,z,motion", comments="")


def works() -> dict[str, tuple[Callable[[], Any], Callable[[], Any], str]]:
    """Return by name what makes the old files, what makes the new ones, and where."""
    small = {"n_segment": 2, "n_random": 2, "checkpoint": "out"}

    def simulate(seed: int) -> None:
        trunk_data.CHUNK = 2
        make_trunk(**small, random_state=seed)

    command = [sys.executable, "-m", "hybridkin", *FIT, "--out", "out"]
    return {
        "save_model": (lambda: save_new(arm()), lambda: save_new(trunk()), "out"),
        "fit --out": (
            lambda: main([*FIT, "--out", "out", "--loss", "soft_l1"]),
            lambda: main([*FIT, "--out", "out"]),
            "out",
        ),
        "track --out": (
            lambda: main([*TRACK, "2", "--out", "out"]),
            lambda: main([*TRACK, "4", "--out", "out"]),
            "out",
        ),
        "make_trunk": (lambda: None, lambda: simulate(0), "out"),
        "processes": (
            lambda: main([*FIT, "--out", "out", "--loss", "soft_l1"]),
            lambda: os.execve(sys.executable, command, SETTINGS),
            "out",
        ),
    }


def save_new(model: Any) -> None:
    Path("out").mkdir(exist_ok=True)
    save_model(model, "out/model")


def forked(work: Callable[[], Any], delay: float | None = None, number: int = 9) -> int:
    """Do work in a process of its own, which gets a signal after a time; return its status."""
    if not (child := os.fork()):
        try:
            for stream, name in ((1, "stdout"), (2, "stderr")):
                os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC), stream)
            os._exit(work() or 0)
        except BaseException:
            os._exit(99)
    if delay is not None:
        if number != signal.SIGKILL:
            wait_for_handler(child)
        time.sleep(delay)
        os.kill(child, number)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def wait_for_handler(child: int) -> None:
    """Wait until a command handles SIGTERM, or has ended: before, on a busy machine, none can."""
    for _ in range(60_000):
        status = Path(f"/proc/{child}/status").read_text()
        caught = int(status.split("SigCgt:")[1].split()[0], 16)
        if caught >> (signal.SIGTERM - 1) & 1 or "State:\tZ" in status:
            return
        time.sleep(0.001)


def content(folder: Path) -> Files:
    """Return the files of a folder that readers see."""
    return {p.name: p.read_bytes() for p in folder.glob("[!.]*")} if folder.is_dir() else {}


def litter(folder: Path) -> list[str]:
    """Return what lies beside the files; a killed writer may leave its hidden part."""
    beside = [*folder.glob(".*"), *folder.parent.glob(".out*")]
    return sorted(p.name for p in beside if ".part" not in p.name)


def killed(name: str, n: int, old: Any, new: Any, out: Path, rng: Any) -> Line:
    """Kill n runs, and see what is left and whether the next run succeeds."""
    after, durations = {}, []
    forked(old)
    before = content(out)
    shutil.rmtree("before", ignore_errors=True)
    shutil.copytree(out, "before") if before else Path("before").mkdir()
    for attempt in range(2):
        start = time.perf_counter()
        if code := forked(new):
            return Line(f"kill -9: {name}", f"the run without a kill ends by {code}", False)
        durations.append(time.perf_counter() - start)
        after = content(out)
        if attempt == 0 and before:
            shutil.rmtree(out)
            shutil.copytree("before", out)
    wrong, counts = [], {"old": 0, "new": 0, "both": 0, "half": 0}
    again = 0
    for k in tqdm(range(n), desc=name, mininterval=10):
        for _ in range(DRAWS):
            shutil.rmtree(out, ignore_errors=True)
            if before:
                shutil.copytree("before", out)
            delay = rng.uniform(0, max(durations))
            if forked(new, delay) == -signal.SIGKILL:
                break
        else:
            wrong.append(f"{DRAWS} runs ended before the kill")
        found = content(out)
        differ = [k for k in found if found[k] not in (before.get(k), after.get(k))]
        kind = "new" if found == after else "old" if found == before else "both"
        if differ or before.keys() - found.keys():
            kind = "half"
        counts[kind] += 1
        if kind == "half":
            wrong.append(f"half after {delay:.3f} s: neither {differ}; {sorted(found)}")
        if max(durations) > 2.0 and k % 3:  # of slow ones a third is done once more
            continue
        again += 1
        if (code := forked(new)) or content(out) != after or litter(out):
            wrong.append(f"after {delay:.3f} s the next run ends by {code}, left {litter(out)}")
    shutil.rmtree("before")
    shutil.rmtree(out, ignore_errors=True)
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{n} kills in {max(durations):.2f} s: {counts['old']} old, {counts['new']} new, "
    figure += (
        f"{counts['both']} both, {counts['half']} half; {again} done once more; {len(wrong)} wrong"
    )
    return Line(f"kill -9: {name}", figure, not wrong)


def killed_at_every_step() -> Line:
    """Kill the writing of a folder before each of its calls of the system, one after another."""
    out, n_kills, wrong = Path("out"), 0, []

    def write(text: str, at: int = 0) -> Callable[[], None]:
        def run() -> None:
            counter = iter(range(1, 10_000))
            for name in ("fsync", "rename", "replace", "rmdir", "mkdir", "unlink"):
                before_call(name, lambda *_: next(counter) == at and os.kill(os.getpid(), 9))
            write_files(out, {k: lambda path, k=k: path.write_text(text + k) for k in "abcd"})

        return run

    for earlier in (False, True):  # the folder is not there, or has files
        for step in range(1, 10_000):
            shutil.rmtree(out, ignore_errors=True)
            if earlier:
                forked(write("old"))
            ended = forked(write("new", step))
            n_kills += ended != 0
            whole = [text + k for text in ("old", "new") for k in "abcd"]
            found = [value.decode() for value in content(out).values()]
            if not {*found} <= {*whole} or (earlier and len(found) != 4):
                wrong.append(f"step {step}: {content(out)}")
            if forked(write("new")) or {*content(out)} != {*"abcd"} or litter(out):
                wrong.append(f"step {step}: the next run leaves {litter(out)}")
            if ended == 0:
                break
    shutil.rmtree(out)
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{n_kills} kills; {len(wrong)} wrong"
    return Line("kill -9 before each call that writes a folder", figure, not wrong and n_kills > 0)


def before_call(name: str, hook: Callable[..., Any]) -> None:
    """Call a hook before a function of `os`, from now on; in a process of its own."""
    call = getattr(os, name)

    def hooked(*given: Any, **more: Any) -> Any:
        hook(name, *given)
        return call(*given, **more)

    setattr(os, name, hooked)


def flushed() -> Line:
    """Check that all files are on the disk before they get their names, and the names after."""
    film = ["animate", "model", "old", "--out", "film.gif", "--frames", "3"]
    writers: dict[str, Callable[[], Any]] = {
        "save_model": lambda: save_model(arm(), "out"),
        "fit": lambda: main([*FIT, "--out", "out"]),
        "evaluate": lambda: main(["evaluate", "model", "log.csv", "--out", "out"]),
        "track": lambda: main([*TRACK, "2", "--out", "old"]),
        "next": lambda: main(["next", "robot.toml", "-n", "5", "--out", "out"]),
        "export": lambda: main(["export", "model", "--out", "out"]),
        "animate": lambda: main(film),
        "make_trunk": lambda: make_trunk(n_segment=1, n_random=1, checkpoint="out") and None,
    }
    wrong, count = [], 0
    for name, write in writers.items():
        for out in (Path("out"), Path("film.gif")):
            shutil.rmtree(out) if out.is_dir() else out.unlink(missing_ok=True)
        Path("steps").unlink(missing_ok=True)
        code = forked(lambda write=write: recorded(write))
        steps = [line.split("\t") for line in Path("steps").read_text().splitlines()]
        synced: set[str] = set()
        for step, path, to in steps:
            if step == "fsync":
                synced.add(path)
            else:  # what lies below moves too; the folders have to be flushed again
                moved = {to + p[len(path) :] for p in synced if (p + "/").startswith(path + "/")}
                wrong += [] if moved else [f"{name}: {path} got its name first"]
                synced = (synced | moved) - {os.path.dirname(path), os.path.dirname(to)}
        renamed = [to for step, _, to in steps if step != "fsync"]
        last = Path(renamed[-1]) if renamed else Path()
        beside = [p for p in last.parent.glob("*") if str(p) in renamed]
        files = [*last.glob("*")] if last.is_dir() else beside
        missing = [str(p) for p in [*files, last.parent] if str(p) not in synced]
        count += len(files)
        if code or missing or not renamed or not files:
            wrong.append(f"{name} ends by {code}, not flushed: {missing}")
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{count} files of {len(writers)} writers: {len(wrong)} wrong"
    return Line(
        "power loss: files are flushed before their names, folders after", figure, not wrong
    )


def recorded(write: Callable[[], Any]) -> int:
    """Write, and record what was flushed and renamed."""
    with open("steps", "w") as steps:

        def note(name: str, *given: Any) -> None:
            places = [given[0], given[0]] if name == "fsync" else given[:2]
            if name == "fsync":
                places = 2 * [os.readlink(f"/proc/self/fd/{given[0]}")]
            print(name, *map(os.path.abspath, places), sep="\t", file=steps)

        for name in ("fsync", "rename", "replace"):
            before_call(name, note)
        return write() or 0


def signalled(name: str, command: list[str], number: int, n: int, rng: Any) -> Line:
    """Interrupt runs at moments of a whole run, and compare what they say with what is there."""
    out, wrong, counts = Path("out"), [], {}
    run = [*command, "--out", "out"]
    start = time.perf_counter()
    shutil.rmtree(out, ignore_errors=True)
    if code := forked(lambda: main(run)):
        return Line(f"{signal.Signals(number).name}: {name}", f"ends by {code}", False)
    duration = time.perf_counter() - start
    whole = {*content(out)}
    for _ in range(n):
        code, delay = 0, 0.0
        for _ in range(DRAWS):
            shutil.rmtree(out, ignore_errors=True)
            delay = rng.uniform(0.0, duration)
            code = forked(lambda: main(run), delay, number)
            if code:
                break
            if {*content(out)} != whole:
                wrong.append(f"{name} after {delay:.3f} s: a whole run wrote {[*content(out)]}")
        said = Path("stderr").read_text()
        kept = "files" if content(out) else "nothing"
        last = said.strip().splitlines()[-1] if said.strip() else ""
        right = code == 128 + number and last == "hybridkin: interrupted"
        counts[f"{code}, {kept} written"] = counts.get(f"{code}, {kept} written", 0) + 1
        if not right or "Traceback" in said or litter(out):
            wrong.append(
                f"{name} after {delay:.3f} s: {code}, {kept}, {litter(out)}, {said[-600:]}"
            )
    print(*wrong, sep="\n", file=sys.stderr)
    shutil.rmtree(out, ignore_errors=True)
    figure = "; ".join(f"{k}: {v}" for k, v in sorted(counts.items())) + f"; {len(wrong)} wrong"
    return Line(f"{signal.Signals(number).name}: {name}, code and sentence", figure, not wrong)
