"""Mutation testing: does the fast suite see a small change of the code?

1,000 changes (shortened: 60) of _core, chains, learning, hybrid and ik are drawn with seed 0 from
those of cosmic-ray; `_mutation` says what is left out. A change counts as killed when a fast test
that runs the changed line fails, crashes or takes far longer than before. The tests of one mutant
take at most 12 s: those of the same folder first, of each test function one case first, then those
that run the fewest lines. A survivor might still be killed by the rest of the suite.

Changes inside functions replace the code of the live functions in a process forked from one that
has collected the suite; other ones (constants, decorators, default arguments) are imported anew.
Which test runs which line, and which mutants died, is kept in results/mutants as long as the
package and that file of tests stay the same; survivors run again. survivors.diff lists them.
"""

from __future__ import annotations

import hashlib
import json
import signal
import time
import warnings
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path

import coverage
from _fork import Judge, Result, collected, functions, imported, patch, pool, prepare
from _line import Line
from _mutation import ROOT, Mutant, places, sample
from tqdm import tqdm

OUT = ROOT / "results/mutants"
FOLDERS = ("_core", "chains", "learning", "hybrid", "ik")
CAP = 12.0  # CPU seconds of the tests of a mutant, as measured with coverage
SOME = "tests/learning", "hybridkin/learning", "hybridkin/_core"  # shortened
PLANTED = "hybridkin/learning/network.py", "core/ReplaceBinaryOperator_Sub_Add"
PLANTED_IN = "u = (q - self.input_center.to(q))"  # the line of the wrong sign


class Tests:
    """The fast tests: which lines each runs, and how long it takes."""

    def __init__(self, paths: tuple[str, ...]) -> None:
        self.paths, self.listed = paths, OUT / f"files-{len(paths)}.json"
        self.seconds: dict[str, float] = {}
        self.failed: list[str] = []
        self.sizes = Counter()  # how many lines a test runs
        self.lines = defaultdict(lambda: defaultdict(set))  # path, line: tests; "" is the import
        self.package = hashlib.sha256()
        for path in sorted((ROOT / "hybridkin").rglob("*.py")):
            self.package.update(path.read_bytes())

    def measure(self) -> None:
        """Trace the files of tests that have changed, and read what is kept of the others."""
        for result in pool(["tests"], self._collect, 1, quiet=False):
            if result.code:
                raise RuntimeError(f"The tests cannot be collected: {result.note}")
        for file in json.loads(self.listed.read_text(encoding="utf-8")):
            kept = json.loads(self._kept(file).read_text(encoding="utf-8"))
            self.seconds.update(kept["seconds"])
            self.failed += kept["failed"]
            names = ["", *kept["seconds"]]
            for path, lines in kept["lines"].items():
                for line, tests in lines.items():
                    self.lines[path][int(line)].update(names[k] for k in tests)
                    self.sizes.update(names[k] for k in tests)

    def _collect(self, _) -> str | None:
        tracer = tracing()

        def work(items):
            tracer.stop()
            files = defaultdict(list)
            for item in items:
                files[item.nodeid.split("::")[0]].append(item)
            self.listed.write_text(json.dumps(list(files)), encoding="utf-8")
            imported = lines_of(tracer)
            new = [
                (f, group, imported) for f, group in files.items() if not self._kept(f).is_file()
            ]
            for result in tqdm(pool(new, self._trace), "tests", len(new)):
                if result.code:
                    raise RuntimeError(f"{result.task[0]} ends with {result.code}: {result.note}")

        code = collected(work, self.paths)
        return f"pytest ends with {code}" if code else None

    def _kept(self, file: str) -> Path:
        digest = self.package.copy()
        digest.update((ROOT / file).read_bytes())
        return OUT / f"lines-{file.replace('/', '.')}-{digest.hexdigest()[:12]}.json"

    def _trace(self, task: tuple) -> None:
        file, items, imported = task
        judge, seconds, failed, tracer = Judge({}), {}, [], tracing()
        items[0].config.pluginmanager.register(judge)
        for item, following in zip(items, [*items[1:], None], strict=True):
            tracer.switch_context(item.nodeid)
            start = time.process_time()
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            seconds[item.nodeid] = round(time.process_time() - start, 3)
            if judge.failed:
                failed, judge.failed = [*failed, judge.failed], None
        tracer.stop()
        number = {name: k for k, name in enumerate(["", *seconds])}
        lines = {path: {n: [0] for n in ns} for path, ns in imported.items()}
        for path, run in lines_of(tracer).items():
            for n, names in run.items():
                lines.setdefault(path, {}).setdefault(n, []).extend(
                    number[name] for name in names if name
                )
        content = {"seconds": seconds, "failed": failed, "lines": lines}
        self._kept(file).write_text(json.dumps(content), encoding="utf-8")

    def covering(self, mutant: Mutant) -> list[str]:
        """Return the tests of a mutant in order, up to the cap.

        They run the line, or the statement, or, if only the import does, what holds it.
        """
        lines, names = self.lines[mutant.path], set()
        for k, (first, last) in enumerate(mutant.lines):
            names = set().union(*(lines.get(n, ()) for n in range(first, last + 1)))
            if names - {""} or (k == 1 and not names):
                break
        names -= {"", *self.failed}
        keys, count = [], Counter()
        for name in sorted(names, key=lambda name: (self.seconds[name], name)):
            function = name.split("[")[0]
            near = f"/{mutant.folder.strip('_')}/" in name
            keys.append((not near, count[function], self.sizes[name], name))
            count[function] += 1
        chosen, total = [], 0.0
        for *_, name in sorted(keys):
            total += self.seconds[name]
            if total > CAP and chosen:
                break
            chosen.append(name)
        return chosen

    def judged(self, mutants: list[Mutant], again: bool = False) -> list[str]:
        """Return "survived", or the test or reason that ended it, for each mutant."""
        log, found = OUT / f"log-{self.package.hexdigest()[:12]}.jsonl", {}
        for line in log.read_text(encoding="utf-8").splitlines() if log.is_file() else ():
            key, _, what = json.loads(line)
            if not again and not what.startswith("survived"):
                found[tuple(key)] = what
        chosen = {mutant: self.covering(mutant) for mutant in mutants if mutant.key not in found}
        found.update((m.key, "survived: no test") for m, names in chosen.items() if not names)
        inside = [m for m in chosen if chosen[m] and m.functions is not None]
        outside = [m for m in chosen if chosen[m] and m.functions is None]
        progress = tqdm(None, "mutants", len(inside) + len(outside))

        def note(results: Iterator[Result]) -> None:
            for result in results:
                with log.open("a", encoding="utf-8") as file:
                    entry = result.task.key, round(result.seconds, 1), outcome(result)
                    file.write(json.dumps(entry) + "\n")
                progress.update()

        def live(_) -> str | None:
            def work(items):
                by_name, bodies = {item.nodeid: item for item in items}, functions()

                def one(mutant):
                    judge = Judge(self.seconds)
                    items[0].config.pluginmanager.register(judge)
                    patch(mutant, bodies)
                    return judge.run([by_name[name] for name in chosen[mutant]])

                note(pool(inside, one))

            code = collected(work, self.paths)
            return f"pytest ends with {code}" if code else None

        start = log.stat().st_size if log.is_file() else 0
        for result in pool(["mutants"] if inside else [], live, 1, quiet=False):
            if result.code:
                raise RuntimeError(f"The runner failed: {result.note}")
        note(pool(outside, lambda mutant: imported(mutant, chosen[mutant], self.seconds)))
        with log.open(encoding="utf-8") as file:
            file.seek(start)
            for line in file:
                key, _, what = json.loads(line)
                found[tuple(key)] = what
        return [found[mutant.key] for mutant in mutants]


def tracing() -> coverage.Coverage:
    package = str(ROOT / "hybridkin")
    tracer = coverage.Coverage(data_file=None, source=[package], config_file=False)
    tracer.start()
    return tracer


def lines_of(tracer: coverage.Coverage) -> dict[str, dict[int, list[str]]]:
    """Return the contexts that ran each line of each file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that a file of tests runs no line of the package
        data = tracer.get_data()
    files = data.measured_files()
    return {str(Path(f).relative_to(ROOT)): data.contexts_by_lineno(f) for f in files}


def outcome(result: Result) -> str:
    """Return in words how the tests of a mutant ended."""
    if result.code >= 0:
        return result.note if result.code else "survived"
    slow = -result.code in (signal.SIGPROF, signal.SIGKILL)
    return "far longer than before" if slow else f"signal {-result.code}"


def examine(full: bool) -> Iterator[Line]:
    OUT.mkdir(parents=True, exist_ok=True)
    prepare()
    tests = Tests(("tests", "hybridkin") if full else SOME)
    tests.measure()
    yield Line(
        "the unchanged code passes the fast tests, each file in a forked process",
        f"{len(tests.failed)} of {len(tests.seconds)} fail{': ' * bool(tests.failed)}"
        + ", ".join(tests.failed),
        bool(tests.seconds) and not tests.failed,
    )
    folders = FOLDERS if full else ("learning",)
    files = [path for f in folders for path in sorted((ROOT / "hybridkin" / f).glob("*.py"))]
    mutants = sample([str(path.relative_to(ROOT)) for path in files], 1000 if full else 60, 0)
    ends = tests.judged(mutants)
    found = list(zip(mutants, ends, strict=True))
    survived = [(m, end) for m, end in found if end[:8] == "survived"]
    with (OUT / "survivors.diff").open("w", encoding="utf-8") as file:
        for m, end in sorted(survived, key=lambda one: one[0].key):
            file.write(f"{m.path} {m.operator} {m.occurrence}: {end}\n{m.diff}\n\n")
    (OUT / "ends.json").write_text(json.dumps([(m.key, end) for m, end in found]))
    need = 0.9 if full else 0.7
    yield Line(
        f"at least {need:.0%} of the changes are seen (seed 0)",
        f"{1 - len(survived) / len(mutants):.1%} of {len(mutants)}; {shares(mutants, survived)}",
        len(survived) <= (1 - need) * len(mutants),
    )
    repeated = mutants[: 40 if full else 8]
    second = tests.judged(repeated, again=True)
    same = [a[:8] == b[:8] for a, b in zip(ends[: len(second)], second, strict=True)]
    yield Line("a second run finds the same", f"{sum(same)} of {len(same)}", all(same))
    yield from planted(tests)


def shares(mutants: list[Mutant], survived: list) -> str:
    """Return the share killed of each folder and of each family of operators."""
    parts = []
    for name in ("folder", "family"):
        total = Counter(getattr(m, name) for m in mutants)
        left = Counter(getattr(m, name) for m, _ in survived)
        parts += [
            f"{key} {1 - left[key] / total[key]:.0%} of {total[key]}" for key in sorted(total)
        ]
    return ", ".join(parts)


def planted_mutant() -> Mutant:
    """Return the change of a sign in a line that the tests of networks must notice."""
    for (_, _, start), mutants in places(PLANTED[0]).items():
        for mutant in mutants:
            line = mutant.source.splitlines()[start[0] - 1]
            if mutant.key[:2] == PLANTED and PLANTED_IN in line:
                return mutant
    raise ValueError(f"{PLANTED[0]} has no line with {PLANTED_IN!r}: choose another sign.")


def planted(tests: Tests) -> Iterator[Line]:
    """Check the runner: it sees a wrong sign, and passes unchanged code, both ways to run."""
    wrong = planted_mutant()
    pair = wrong, Mutant(wrong.path, "", 0, wrong.lines)
    results = pool(pair, lambda m: imported(m, tests.covering(m), tests.seconds), 1)
    ends = [*tests.judged([*pair], again=True), *map(outcome, results)]
    yield Line(
        "a planted wrong sign is seen, unchanged code passes; in place, and imported anew",
        ", ".join(ends),
        [end == "survived" for end in ends] == [False, True] * 2,
    )
