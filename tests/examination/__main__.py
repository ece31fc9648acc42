"""Examine what the library can be trusted with, and write the figures.

    python tests/examination                   # every part, shortened: minutes
    python tests/examination files soak --full # some parts, as long as the published figures took

Each part is a module of this folder with ``examine(full)``, which yields a `Line` for each claim.
Parts run one after another in processes of their own, so that none inherits another's memory or
settings. Each writes OUT/PART.json; report.md holds the table of all parts. The exit code is 1 if
a line does not hold.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import time
from dataclasses import asdict
from datetime import date
from importlib import import_module
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).parent
PARTS = sorted(path.stem for path in HERE.glob("*.py") if path.stem[0] != "_")
PACKAGES = ("torch", "numpy", "scipy", "scikit-learn")


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
    failed = []
    parts = options.parts or PARTS
    for k, part in enumerate(parts, 1):
        print(f"\n{k}/{len(parts)} {part}", flush=True)
        command = [sys.executable, str(HERE), part, "--out", str(options.out)]
        if subprocess.call([*command, "--full"] if options.full else command):
            failed.append(part)
    report = "\n".join(table(options.out / f"{part}.json") for part in parts)
    (options.out / "report.md").write_text(report, encoding="utf-8")
    print(f"\n{options.out / 'report.md'}; {len(failed)} of {len(parts)} parts fail", *failed)
    return int(bool(failed))


def examined(part: str, full: bool, out: Path) -> int:
    """Run one part, print and write its lines, and return the exit code."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    sys.path.insert(1, str(HERE.parent / "saving"))  # one small model of every kind
    (out / f"{part}.json").unlink(missing_ok=True)
    lines, start = [], time.perf_counter()
    for line in import_module(part).examine(full):
        lines.append(asdict(line))
        print(f"  {'holds' if line.holds else 'FAILS'}  {line.what}: {line.figure}", flush=True)
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
    return int(not lines or not all(line["holds"] for line in lines))


def table(path: Path) -> str:
    """Return the lines of a part as a Markdown table."""
    if not path.is_file():
        return f"## {path.stem}\n\nThis part ended without a result.\n"
    content = json.loads(path.read_text(encoding="utf-8"))
    rows = [f"## {content['part']}", ""]
    rows += [f"`{content['command']}`, {content['date']}, {content['seconds']:.0f} s", ""]
    rows += ["| what | figure | holds |", "| --- | --- | --- |"]
    for line in content["lines"]:
        rows.append(f"| {line['what']} | {line['figure']} | {'yes' if line['holds'] else 'NO'} |")
    return "\n".join([*rows, ""])


if __name__ == "__main__":
    sys.exit(main())
