"""Examine what the library can be trusted with, and write the figures.

    python tests/examination                   # every part, shortened: minutes
    python tests/examination files soak --full # some parts, as long as the published figures took

Each part is a module of this folder with ``examine(full)``, which yields a `Line` for each claim.
Parts run one after another in processes of their own, so that none inherits another's memory or
settings. Each writes OUT/PART.json; report.md holds the table of all parts. The exit code is 1 if
a line does not hold, and 2 if all hold but some were not run.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

from _line import Line

HERE = Path(__file__).parent
PARTS = sorted(path.stem for path in HERE.glob("*.py") if path.stem[0] != "_")
PACKAGES = ("torch", "numpy", "scipy", "scikit-learn")
TOOLS = ("cosmic_ray", "coverage", "dask", "psutil", "tqdm")  # a part without its tool is not run
HOLDS, FAILS, NOT_RUN = 0, 1, 2  # exit codes
PRINTED = {True: "holds", False: "FAILS", None: "not run"}
IN_TABLE = {True: "yes", False: "NO", None: "not run"}


def main(arguments: list[str] | None = None) -> int:
    parser = argparse.ArgumentParser(prog="python tests/examination", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("parts", nargs="*", metavar="PART", help=", ".join(PARTS))
    parser.add_argument("--full", action="store_true", help="as long as the published figures")
    parser.add_argument("--out", type=Path, default=Path("results/examination"))
    options = parser.parse_args(arguments)
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
    report = "\n".join(table(options.out / f"{part}.json") for part in parts)
    (options.out / "report.md").write_text(report, encoding="utf-8")
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
    (out / f"{part}.json").unlink(missing_ok=True)
    lines, start = [], time.perf_counter()
    for line in lines_of(part, full):
        lines.append(asdict(line))
        print(f"  {PRINTED[line.holds]}  {line.what}: {line.figure}", flush=True)
    content = {
        "part": part,
        "command": f"python tests/examination {part}{' --full' if full else ''}",
        "date": date.today().isoformat(),
        "seconds": round(time.perf_counter() - start, 1),
        "machine": f"{platform.machine()}, Python {platform.python_version()}",
        "versions": {name: version(name) for name in PACKAGES},
        "lines": lines,
    }
    (out / f"{part}.json").write_text(json.dumps(content, indent=1), encoding="utf-8")
    outcomes = [line["holds"] for line in lines]
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


def table(path: Path) -> str:
    """Return the lines of a part as a Markdown table."""
    if not path.is_file():
        return f"## {path.stem}\n\nThis part ended without a result.\n"
    content = json.loads(path.read_text(encoding="utf-8"))
    rows = [f"## {content['part']}", ""]
    rows += [f"`{content['command']}`, {content['date']}, {content['seconds']:.0f} s", ""]
    rows += ["| what | figure | holds |", "| --- | --- | --- |"]
    for line in content["lines"]:
        rows.append(f"| {line['what']} | {line['figure']} | {IN_TABLE[line['holds']]} |")
    return "\n".join([*rows, ""])


if __name__ == "__main__":
    sys.exit(main())
