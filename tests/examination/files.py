"""Hostile and damaged files: each is refused by an error of ours, or read and used as it is.

File k of a format is made from the seed (20, format, k): whole files are truncated, flipped,
stretched, renumbered, or rebuilt with false sizes, code, bombs and deep nests; of the model files
three in five have a right checksum. Files are read in processes of their own, which have 1.5 GB of
addresses more than at the start and 10 s of processor time for a file: a crash, a hang and a
memory bomb end the process, and count.

Models are also written with other numbers and a right checksum, half of them with the prediction
that `save_model` stores: each is refused by an error that names the file, or the compiled core and
torch agree on finite numbers.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from _line import Line
from _readers import NAMES, READERS, made, outcome
from renumbered import judged, renumbered
from tqdm import tqdm

SECONDS, MEGABYTES = 2.0, 300.0  # that a file may take
NUMBERS = {"model": 20_000}  # of the full run; of other formats 700
SPACE = 1_500_000_000
WAYS = 6  # how a reader is called: the options of file k depend on k modulo 2, 3 or 4


def examine(full: bool) -> Iterator[Line]:
    """Yield a line for each format, and what held for all of them."""
    with tempfile.TemporaryDirectory() as folder:
        os.chdir(folder)
        for kind in READERS:
            number = NUMBERS.get(kind, 700)
            yield of_kind(kind, number if full else number // 20, Path(folder))
        yield no_files(Path(folder))
        yield of_numbers(100 if full else 5, Path(folder))


def of_numbers(n: int, folder: Path) -> Line:
    """Write n files of each kind of model with other numbers, and judge what became of each."""
    counts, wrong = Counter(), []
    for kind in tqdm(NAMES, desc="numbers", file=sys.stderr, mininterval=10):
        for k in range(n):
            said = judged(*renumbered(kind, k, folder / "numbers.safetensors"))
            counts[said if said in ("refused", "read") else "wrong"] += 1
            if said not in ("refused", "read"):
                wrong.append(f"{kind} {k}: {said[:300]}")
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{n * len(NAMES)} files of {len(NAMES)} kinds: {counts['refused']} refused, "
    figure += f"{counts['read']} read, {len(wrong)} wrong"
    return Line("models with other numbers and a right checksum", figure, not wrong)


def of_kind(kind: str, n: int, folder: Path) -> Line:
    """Read n files of a format and return what came of them; the whole ones must be read."""
    results, wrong = [], whole_files(kind, folder)
    bar = tqdm(total=n, desc=kind, file=sys.stderr, mininterval=10)
    while len(results) < n:
        results += in_child(kind, len(results), n, folder)
        bar.update(len(results) - bar.n)
    bar.close()
    counts = Counter(said if said in ("refused", "read") else "wrong" for said, *_ in results)
    for k, (said, seconds, memory) in enumerate(results):
        if said not in ("refused", "read") or seconds > SECONDS or memory > MEGABYTES:
            wrong.append(f"{kind} {k}: {said}, {seconds:.2f} s, {memory:.0f} MB")
    left = sorted({path.name for path in folder.iterdir()} - {READERS[kind].name})
    left = [name for name in left if not name.endswith(("_3cable", "_static"))]
    (folder / READERS[kind].name).unlink(missing_ok=True)
    print(*wrong, sep="\n", file=sys.stderr)
    most = [max(column) for column in zip(*(one[1:] for one in results), strict=True)]
    figure = f"{n} files: {counts['refused']} refused, {counts['read']} read, {len(wrong)} wrong"
    figure += f"; slowest {most[0]:.2f} s, peak {most[1]:.0f} MB more"
    figure += f"; left or executed: {left}" if left else ""
    good = not wrong and not left and counts["refused"] > 0
    return Line(f"hostile and damaged files: {kind}", figure, good)


def whole_files(kind: str, folder: Path) -> list[str]:
    """Return which whole files are read with none of the options: all could be refused then."""
    wrong = []
    path = folder / READERS[kind].name
    whole = READERS[kind].whole
    for first, content in enumerate(whole):
        path.write_bytes(content)
        numbers = range(first, WAYS * len(whole), len(whole))
        if not any(outcome(kind, k, path) == "read" for k in numbers):
            wrong.append(f"whole {kind} {first}: {outcome(kind, first, path)}")
    return wrong


def no_files(folder: Path) -> Line:
    """Check that devices, pipes, folders and links to themselves are refused, at once."""
    wrong = []
    os.mkfifo("pipe")
    os.symlink("loop", "loop")
    Path("folder").mkdir()
    names = ["pipe", "loop", "folder", "absent", "/dev/zero", "/dev/null", "nul\0", ""]
    for kind in [kind for kind in READERS if kind != "recording"]:
        for k, name in enumerate(names):
            signal.alarm(20)
            said = outcome(kind, k, Path(name))
            if said != "refused":
                wrong.append(f"{kind} {name[:9]!r}: {said}")
    signal.alarm(0)
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{len(names)} names, {len(READERS) - 1} readers: {len(wrong)} wrong"
    return Line("devices, pipes, folders, links, no name", figure, not wrong)


def in_child(kind: str, first: int, n: int, folder: Path) -> list[Any]:
    """Return the results of files from the first on, until all are read or the process dies."""
    reading, writing = os.pipe()
    if not (child := os.fork()):
        os.close(reading)
        read_all(kind, range(first, n), folder, writing)
    os.close(writing)
    with open(reading, encoding="utf-8") as lines:
        results = [json.loads(line) for line in lines]
    status = os.waitpid(child, 0)[1]
    if first + len(results) < n:
        end = signal.Signals(os.WTERMSIG(status)).name if os.WIFSIGNALED(status) else status
        results.append((f"the process ended by {end}", 0.0, 0.0))
    return results


def read_all(kind: str, files: range, folder: Path, writing: int) -> None:
    """Read files in this process, write a line of each to a pipe, and end."""
    try:
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        path = folder / READERS[kind].name
        for k in files:
            signal.setitimer(signal.ITIMER_PROF, 60)
            path.write_bytes(made(kind, k))
            space = 4096 * int(Path("/proc/self/statm").read_text().split()[0]) + SPACE
            resource.setrlimit(resource.RLIMIT_AS, (space, -1))
            before = peak(reset=True)
            signal.setitimer(signal.ITIMER_PROF, 10)
            signal.alarm(120)  # of one that waits
            start = time.process_time()
            said = outcome(kind, k, path)
            resource.setrlimit(resource.RLIMIT_AS, (-1, -1))
            result = said, time.process_time() - start, peak() - before
            os.write(writing, json.dumps(result).encode() + b"\n")
        os._exit(0)
    except BaseException as error:
        os.write(2, f"{kind}: {error!r}\n".encode())
        os._exit(1)


def peak(reset: bool = False) -> float:
    """Return the largest resident memory of this process since the last reset [MB]."""
    if reset:
        Path("/proc/self/clear_refs").write_text("5")
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1000
