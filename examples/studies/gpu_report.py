"""What the study of models on a GPU has found, as text and as a table of numbers."""

from __future__ import annotations

import contextlib
import csv
import os
import platform
import subprocess
import time
import traceback
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import sklearn
import torch
from gpu_models import trunk

import hybridkin
from hybridkin import __version__, native

CORE = "cpu, compiled core"
# Work -> rows, and how many times faster than the compiled core on one thread a GPU should be.
COMPILED = "FK and J, compiled by torch"
GOALS = {"FK and J": (1_000_000, 50.0), "solve": (100_000, 20.0)}
GOALS[COMPILED] = GOALS["FK and J"]
OUT_OF_MEMORY = (MemoryError, torch.cuda.OutOfMemoryError)


class Result(NamedTuple):
    """A comparison, or a measurement without `allowed`."""

    part: str
    model: str
    what: str
    device: str
    dtype: str
    rows: int
    value: float
    unit: str
    allowed: float | None = None

    @property
    def verdict(self) -> str:
        """Whether a comparison holds."""
        if self.allowed is None:
            return ""
        return "agrees" if self.value <= self.allowed else "DIFFERS"


class Study:
    """Results so far, what was left out or has failed, and the time that is left."""

    def __init__(self, device: torch.device, minutes: float, quick: bool) -> None:
        self.device = device
        self.quick = quick
        self.machine = machine(device)
        self.began = time.perf_counter()
        self.seconds = 60.0 * minutes
        self.results: list[Result] = []
        self.left_out: list[str] = []
        self.failed: list[str] = []

    @property
    def elapsed(self) -> float:
        """Time since the start [s]."""
        return time.perf_counter() - self.began

    def say(self, text: str) -> None:
        """Print a line with the time."""
        print(f"[{self.elapsed:6.1f} s] {text}", flush=True)

    def leave_out(self, text: str) -> None:
        """Note what is not done, and why."""
        self.left_out.append(text)
        self.say(f"left out: {text}")

    def has_time(self, what: str, part: float, needed: float = 0.0) -> bool:
        """Return whether a task of `needed` seconds ends within this part of the time."""
        if self.elapsed + needed <= part * self.seconds:
            return True
        about = f", it needs about {needed:.0f} s" if needed > 0.0 else ""
        self.leave_out(f"{what}: no time left{about}")
        return False

    def compare(self, model: str, what: str, value: float, allowed: float, rows: int = 0) -> None:
        """Add a comparison."""
        name = str(self.device)
        result = Result("correctness", model, what, name, "float64", rows, value, "", allowed)
        self.results.append(result)
        if result.verdict != "agrees":
            self.failed.append(f"{model}, {what}: {value:.3g}, allowed {allowed:.3g}")
            self.say(f"DIFFERS: {self.failed[-1]}")

    @contextlib.contextmanager
    def attempt(self, what: str) -> Iterator[None]:
        """Note an exception and go on; a lack of memory is no failure."""
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                yield
        except OUT_OF_MEMORY as error:
            self.leave_out(f"{what}: out of memory, {str(error).splitlines()[:1]}")
        except Exception as error:
            text = f"{what}: {type(error).__name__} in {place_of(error)}: {str(error)[:300]}"
            self.failed.append(text)
            self.say(f"FAILED: {text}")
        if self.device.type == "cuda":
            with contextlib.suppress(Exception):  # after an error of the device itself
                torch.cuda.empty_cache()


def place_of(error: Exception) -> str:
    """Return the file and line of an error, if possible one of hybridkin."""
    frames = traceback.extract_tb(error.__traceback__)
    folder = Path(hybridkin.__file__).parent
    ours = [frame for frame in frames if folder in Path(frame.filename).parents]
    last = [*frames[-1:], *ours][-1]
    return f"{Path(last.filename).name}:{last.lineno}"


def machine(device: torch.device) -> list[str]:
    """Return the card, the processor and the versions, as lines."""
    lines = [
        f"CPU: {platform.processor() or platform.machine()}, {os.cpu_count()} cores, "
        f"torch with {torch.get_num_threads()} threads",
        f"hybridkin {__version__}, torch {torch.__version__}, CUDA {torch.version.cuda}, "
        f"NumPy {np.__version__}, scikit-learn {sklearn.__version__}, "
        f"Python {platform.python_version()}",
        f"compiled core: {native.backend(trunk())}",
    ]
    if device.type == "cuda":
        card = torch.cuda.get_device_properties(device)
        memory = card.total_memory / 2**30
        lines.insert(0, f"card: {card.name}, {memory:.0f} GiB, driver {driver()}")
    return lines


def driver() -> str:
    """Return the version of the driver."""
    command = ["nvidia-smi", "--query-gpu=driver_version", "--format=csv,noheader"]
    try:
        answer = subprocess.run(command, capture_output=True, text=True, timeout=10, check=True)
    except (OSError, subprocess.SubprocessError):
        return "unknown"
    return answer.stdout.splitlines()[0].strip()


def written(study: Study) -> str:
    """Return the report as Markdown."""
    lines = [f"# Models on {study.device}", ""]
    lines += [f"- {line}" for line in study.machine]
    comparisons = [r for r in study.results if r.part == "correctness"]
    n_failed = sum(r.verdict != "agrees" for r in comparisons)
    lines += [f"- {len(comparisons)} comparisons, {n_failed} differ", ""]
    for title, entries in (("Failed", study.failed), ("Left out", study.left_out)):
        lines += [f"## {title}", ""]
        lines += [f"- {entry}" for entry in entries or ["nothing"]]
        lines.append("")

    # Of every kind the comparison that is nearest to its limit.
    lines += ["## Correctness, float64", ""]
    lines += ["| model | comparisons | worst | difference | allowed | |"]
    lines += ["| --- | --- | --- | --- | --- | --- |"]
    for model in dict.fromkeys(r.model for r in comparisons):
        of_model = [r for r in comparisons if r.model == model]
        worst = max(of_model, key=closeness)
        cells = [model, len(of_model), worst.what, f"{worst.value:.2g}"]
        cells += [f"{worst.allowed:.2g}", worst.verdict]
        lines.append(in_row(cells))

    lines += measured_table(study, "speed", "µs per row", ["cpu", CORE])
    lines += faster_table(study)
    lines += measured_table(study, "memory", "bytes per row", [])
    return "\n".join(lines) + "\n"


def faster_table(study: Study) -> list[str]:
    """Return the lines of a table: from how many rows the device is faster than one CPU core.

    The core computes on one thread in float64. Where it was not measured at a number of rows, its
    time per row at the largest smaller number counts.
    """
    name = str(study.device)
    times: dict[tuple[str, ...], dict[int, float]] = {}
    for result in study.results:
        if result.part == "speed":
            job = result.model, result.what, result.device, result.dtype
            times.setdefault(job, {})[result.rows] = result.value
            if result.device == CORE and result.what == "FK and J":
                times.setdefault((result.model, COMPILED, *job[2:]), {})[result.rows] = result.value
    lines = ["", f"## {name} beside the compiled core on one thread", ""]
    titles = ["model", "work", "dtype", "faster from rows", "times faster, by rows", "goal"]
    lines += [in_row(titles), in_row(["---"] * len(titles))]
    for (model, work, device, dtype), of_device in times.items():
        of_core = times.get((model, work, CORE, "float64"), {})
        ratios = {}
        for n in sorted(of_device):
            measured = [rows for rows in of_core if rows <= n]
            if measured:
                ratios[n] = of_core[max(measured)] / of_device[n]
        if device == name and ratios:
            by_rows = ", ".join(f"{n}: {ratio:.2g}" for n, ratio in ratios.items())
            cells = [model, work, dtype, faster_from(ratios), by_rows, goal(work, ratios)]
            lines.append(in_row(cells))
    return lines


def faster_from(ratios: dict[int, float]) -> str:
    """Return the number of rows from which on the device is always faster."""
    first = "none"
    for n in sorted(ratios, reverse=True):
        if ratios[n] <= 1.0:
            break
        first = str(n)
    return first


def goal(work: str, ratios: dict[int, float]) -> str:
    """Return the goal of a kind of work, and whether it is reached."""
    if work not in GOALS:
        return ""
    n, wanted = GOALS[work]
    text = f"{wanted:g} at {n}"
    if n not in ratios:
        return f"{text}: not measured"
    return f"{text}: {'reached' if ratios[n] >= wanted else 'MISSED'}"


def measured_table(study: Study, part: str, unit: str, others: Sequence[str]) -> list[str]:
    """Return the lines of a table of measurements, with columns of other places."""
    name = str(study.device)
    columns = [*dict.fromkeys([name, *others])]
    measured = {result[1:6]: result.value for result in study.results if result.part == part}
    titles = ["model", "work", "dtype", "rows", *columns]
    lines = ["", f"## {part.capitalize()}, {unit}", ""]
    lines += [in_row(titles), in_row(["---"] * len(titles))]
    for model, work, dtype, n in dict.fromkeys((m, w, d, n) for m, w, _, d, n in measured):
        cells: list[object] = [model, work, dtype, n]
        for column in columns:
            value = measured.get((model, work, column, dtype, n))
            cells.append("" if value is None else f"{value:.3g}")
        lines.append(in_row(cells))
    return lines


def closeness(result: Result) -> float:
    """Return how near a comparison is to its limit; above 1 it differs."""
    if result.verdict == "DIFFERS":
        return float("inf")
    return result.value / result.allowed if result.allowed else 0.0


def in_row(cells: Sequence[object]) -> str:
    """Return a row of a Markdown table."""
    return f"| {' | '.join(map(str, cells))} |"


def write(study: Study, folder: Path) -> None:
    """Write the report, and all numbers as CSV."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "gpu.md").write_text(written(study), encoding="utf-8")
    with open(folder / "gpu.csv", "w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow([*Result._fields, "verdict"])
        for result in study.results:
            cells = [*result, result.verdict]
            writer.writerow(["" if cell is None else cell for cell in cells])
