"""Examine what the library can be trusted with, and write the figures.

    python tests/examination                   # every part, shortened: minutes
    python tests/examination files soak --full # some parts, as long as the published figures took
    python tests/examination files --full --out docs/data/examination  # published figures anew
    python tests/examination report            # the page of the published figures

Each part is a module of this folder with ``examine(full)``, which yields a `Line` for each claim.
Parts run one after another in processes of their own, so that none inherits another's memory or
settings. Each writes OUT/PART.csv, and its line in OUT/runs.csv; report.md holds the tables of all
parts. The exit code is 1 if a line does not hold, and 2 if all hold but some were not run.
"""

from __future__ import annotations

import argparse
import ast
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from _line import Line
from _report import COMMITTED, PAGE, page, sections, write_part

HERE = Path(__file__).parent
PARTS = sorted(path.stem for path in HERE.glob("*.py") if path.stem[0] != "_")
TOOLS = ("cosmic_ray", "coverage", "dask", "psutil", "tqdm")  # a part without its tool is not run
HOLDS, FAILS, NOT_RUN = 0, 1, 2  # exit codes
PRINTED = {True: "holds", False: "FAILS", None: "not run"}
REPORT = "report"


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python tests/examination", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join((*PARTS, REPORT)))
    parser.add_argument("--full", action="store_true", help="as long as the published figures")
    parser.add_argument("--out", type=Path, default=Path("results/examination"))
    options = parser.parse_args(arguments)
    if options.parts == [REPORT]:
        PAGE.write_text(page(), encoding="utf-8")
        print(f"{PAGE}, from {COMMITTED}")
        return HOLDS
    unknown = {*options.parts} - {*PARTS}
    if unknown:
        parser.error(f"PART must be among {', '.join(PARTS)}, got {', '.join(unknown)}")
    options.out = options.out.resolve()  # some parts work in folders of their own
    options.out.mkdir(parents=True, exist_ok=True)
    if len(options.parts) == 1:
        return examined(options.parts[0], options.full, options.out)
    codes = {}
    parts = options.parts or PARTS
    for k, part in enumerate(parts, 1):
        print(f"\n{k}/{len(parts)} {part}", flush=True)
        command = [sys.executable, str(HERE), part, "--out", str(options.out)]
        codes[part] = subprocess.call([*command, "--full"] if options.full else command)
    report = sections(options.out, parts)
    (options.out / "report.md").write_text(f"{report}\n", encoding="utf-8")
    not_run = [part for part in parts if codes[part] == NOT_RUN]
    failed = [part for part in parts if codes[part] not in (HOLDS, NOT_RUN)]
    print(f"\n{options.out / 'report.md'}; {len(failed)} of {len(parts)} parts fail", *failed)
    if not_run:
        print(f"Lines of {len(not_run)} parts were not run:", *not_run)
    if failed:
        return FAILS
    return NOT_RUN if not_run else HOLDS


def examined(part: str, full: bool, out: Path) -> int:
    """Run one part, print and write its lines, and return the exit code."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path.insert(1, str(HERE.parent / "saving"))  # one small model of every kind
    sys.path.append(str(HERE.parents[1] / "examples"))  # the simulated trunk
    lines, start = [], time.perf_counter()
    for line in lines_of(part, full):
        lines.append(line)
        print(f"  {PRINTED[line.holds]}  {line.what}: {line.figure}", flush=True)
    seconds = time.perf_counter() - start
    command = f"python tests/examination {part}{' --full' if full else ''}"
    write_part(out, part, command, about(part), seconds, lines)
    outcomes = [line.holds for line in lines]
    if not outcomes or False in outcomes:
        return FAILS
    return NOT_RUN if None in outcomes else HOLDS


def lines_of(part: str, full: bool) -> Iterator[Line]:
    """Yield the lines of a part, or one that says which of the tools is missing."""
    try:
        module = import_module(part)
    except ModuleNotFoundError as error:
        if error.name not in TOOLS:
            raise
        yield Line("the whole part", f"{error.name} is not installed here", None)
    else:
        yield from module.examine(full)


def about(part: str) -> str:
    """Return what a part examines, the text at the head of its module, in one line."""
    text = ast.get_docstring(ast.parse((HERE / f"{part}.py").read_text(encoding="utf-8")))
    return " ".join(str(text).split())


if __name__ == "__main__":
    sys.exit(main())
