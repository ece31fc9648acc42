"""Texts of users in every file and on the terminal: they stay text.

Text k is made from the seed (50, k): one to six pieces of code, markup, formulas, escape sequences
and characters that nobody sees. Each goes through every writer, and the reader of the file judges:
the C preprocessor by the tokens that are left, ElementTree, tomllib, csv, a reader of Markdown and
one of HTML by the elements that they find, and a terminal emulator by what it shows. Then whole
commands run on robots and logs whose every name is such a text.
"""

from __future__ import annotations

import csv
import io
import json
import os
import shutil
import sys
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from _line import Line
from tqdm import tqdm

import hybridkin
from hybridkin import native, robots
from hybridkin._core import texts
from hybridkin.app.cli._terminal import write
from hybridkin.app.cli.main import main

sys.path.insert(1, str(Path(__file__).parents[1] / "core"))
import test_hostile_texts as checks

SEED = 50
TEXTS = 20_000  # of the full run
ROBOTS = 25
IN_FILE = 500  # names in one file of C
SHAPE = "--shape line --size 0.001,0.001,0 --unit m --duration 1 --dt 0.1".split()


def examine(full: bool) -> Iterator[Line]:
    """Yield a line for each grammar, and one for whole commands."""
    n = TEXTS if full else TEXTS // 20
    made = checks.made(n, seed=SEED)
    yield in_c(made)
    yield from in_markdown(made)
    for name in ("html", "xml", "toml", "matlab"):
        yield each(f"texts in {name.upper()}", made, getattr(checks, f"check_{name}"))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder)
        yield each("texts in CSV", made, lambda name: checks.check_tables(name, path))
    yield on_a_terminal(made[: n // 5])
    yield in_figures(made[: n // 20])
    yield in_commands(ROBOTS if full else 2)


def each(what: str, made: list[str], check: Callable[[str], object]) -> Line:
    """Check every text, and return how many fail."""
    failed = []
    for name in tqdm(made, desc=what, file=sys.stderr, mininterval=10):
        try:
            check(name)
        except Exception as error:
            failed.append(f"{name!r}: {error!r:.200}")
    print(*failed[:5], sep="\n", file=sys.stderr)
    return Line(what, f"{len(failed)} of {len(made)} are more than text", not failed)


def in_c(made: list[str]) -> Line:
    """Return whether texts leave the tokens of C code as they are."""
    if not shutil.which("cc"):
        return Line("texts in C", "there is no C compiler", None)
    wrong = 0
    for options in checks.STANDARDS:
        for start in range(0, len(made), IN_FILE):
            try:
                checks.check_c(made[start : start + IN_FILE], options)
            except AssertionError as error:
                wrong += 1
                print(f"{options}, {start}: {error!s:.300}", file=sys.stderr)
    standards = ", ".join(" ".join(options) for options in checks.STANDARDS)
    figure = f"{wrong} of {3 * -(-len(made) // IN_FILE)} files of {IN_FILE} texts, {standards}"
    return Line("texts that add tokens to C", figure, wrong == 0)


def in_markdown(made: list[str]) -> Iterator[Line]:
    """Yield whether texts are no markup, with and without links of bare addresses."""
    reader = checks.reader_of()
    yield each("texts in Markdown", made, lambda name: checks.check_markdown(name, reader))
    what = "texts in Markdown that links addresses"
    try:
        reader = checks.reader_of("gfm-like")
        reader.parse("a")
    except (ImportError, ModuleNotFoundError):
        yield Line(what, "linkify-it-py is not installed here", None)
    else:
        yield each(what, made, lambda name: checks.check_markdown(name, reader))


def on_a_terminal(made: list[str]) -> Line:
    """Return whether a terminal shows texts, and does nothing else."""
    what = "texts on a terminal"
    try:
        import pyte
    except ModuleNotFoundError:
        return Line(what, "pyte is not installed here", None)

    screen = pyte.Screen(400, 12)

    def check(name: str) -> None:
        stream = io.StringIO()
        write(f"hybridkin: {name}", stream, indent="  ")
        written = stream.getvalue()
        screen.reset()
        before = (screen.title, screen.icon_name, set(screen.mode), screen.margins)
        pyte.Stream(screen).feed(written.replace("\n", "\r\n"))
        assert (screen.title, screen.icon_name, set(screen.mode), screen.margins) == before
        lines = written.split("\n")
        for row, line in zip(screen.display, lines, strict=False):
            if line.isascii():
                assert row.rstrip() == line.rstrip()
        assert all(line.startswith(("hybridkin: ", "  ")) for line in lines[:-1])
        assert (screen.cursor.y, screen.cursor.x) == (len(lines) - 1, 0)

    return each(what, made, check)


def in_figures(made: list[str]) -> Line:
    """Return whether figures show texts as they are."""
    warnings.simplefilter("ignore")
    groups = []
    for start in range(0, len(made), 20):
        groups.append([f"{k}{name}" for k, name in enumerate(made[start : start + 20])])
    line = each("groups of 20 texts in figures", groups, checks.check_figure)
    warnings.resetwarnings()
    return line


def in_commands(n: int) -> Line:
    """Run commands on robots of hostile names, and judge what they write and print."""
    commands = 0
    wrong = []
    home = Path.cwd()
    for k in tqdm(range(n), desc="robots", file=sys.stderr, mininterval=10):
        with tempfile.TemporaryDirectory() as folder:
            os.chdir(folder)
            try:
                commands += of_robot(np.random.default_rng((SEED, k)), Path(folder))
            except Exception as error:
                wrong.append(f"robot {k}: {error!r:.400}")
            os.chdir(home)
    print(*wrong, sep="\n", file=sys.stderr)
    figure = f"{len(wrong)} of {n} robots of hostile names fail, {commands} commands"
    return Line("commands", figure, not wrong)


def named(rng: np.random.Generator, n: int) -> list[str]:
    """Return n different names that TOML and a CSV file can hold."""
    names: list[str] = []
    while len(names) < n:
        pieces = rng.choice(np.array(checks.PIECES, object), rng.integers(1, 7))
        name = "".join(pieces).encode("utf-8", "ignore").decode().strip()
        clear = texts.csv_cell(name).strip()
        if clear and clear not in map(texts.csv_cell, names) and "\0" not in name:
            names.append(name)
    return names


def of_robot(rng: np.random.Generator, home: Path) -> int:
    """Run the commands of one robot and return how many; raise where a text is more than text."""
    names = named(rng, 13)
    q, x, motions = names[:3], names[3:6], names[6:10]
    title, unit, groups = names[10:]
    unit = f"u{unit}"
    log = f"./{texts.visible(named(rng, 1)[0]).replace('/', ' ')[:60]}\x1b[2J\n.csv"
    toml = texts.toml_value
    (home / "robot.toml").write_text(
        f"name = {toml(title)}\ncalibrate = []\n[[segment]]\nradius = 0.005\nlength = 0.1\n"
        f"gain = 0.001\n[log]\nq = {toml(q)}\nx = {toml(x)}\nq_unit = {toml(unit)}\n"
        f'groups = {toml(groups)}\n[limits]\nq_min = -6\nq_max = 6\nunit = "log"\n',
        encoding="utf-8",
    )
    steps = np.linspace(0, 6, 20)[:, None] + np.arange(3)
    commands = np.concatenate([4.0 * size * np.sin(steps) for size in (1.0, 0.8, 0.6, 0.5)])
    tips = robots.read_description(home / "robot.toml").chain(torch.from_numpy(commands)).numpy()
    with open(log, "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*q, *x, groups])
        for k, row in enumerate(np.hstack([commands, tips + 2e-4 * np.sin(commands)])):
            writer.writerow([*map(repr, map(float, row)), motions[k // 20]])
    lines = [
        ["describe", "robot.toml"],
        ["describe", log, "--robot", "robot.toml", "--delimiter", ","],
        ["evaluate", "robot.toml", log, "--out", "evaluate", "--delimiter", ","],
        ["track", "robot.toml", *SHAPE, "--out", "track"],
        ["next", "robot.toml", "-n", "3", "--out", "next"],
        ["export", "robot.toml", "--out", "export"],
        ["export", "robot.toml", "--mex", "--out", "mex"],
        ["export", "robot.toml", "--fmu", "robot.fmu"],
        ["evaluate", "robot.toml", log, f"--q={names[0]}"],
    ]
    for arguments in lines:
        out = io.StringIO()
        with redirect_stdout(out), redirect_stderr(out), warnings.catch_warnings():
            code = main(arguments)
        fails = arguments[-1].startswith("--q=")
        assert code == (2 if fails else 0), (arguments, out.getvalue()[-300:])
        assert not checks.hidden(out.getvalue()), arguments
    judge(home, [*q, *x])
    return len(lines)


def judge(home: Path, columns: list[str]) -> None:
    """Raise if a file that a robot's commands wrote has more than text of its names."""
    for path in home.glob("*/*"):
        if path.suffix != ".png":
            assert not checks.hidden(path.read_text(encoding="utf-8")), path
    for path in home.glob("*/*.md"):
        found = checks.markup(path.read_text(encoding="utf-8"), checks.reader_of())
        assert not {*found} & {"html_inline", "html_block", "link_open"}, path
    read: Any = hybridkin.datasets.load_log(home / "track" / "track.csv", columns[:3], columns[3:])
    assert (*read.q_names, *read.x_names) == (*columns,)
    json.loads((home / "track" / "report.json").read_text())
    with zipfile.ZipFile(home / "robot.fmu") as archive:
        root = ElementTree.fromstring(archive.read("modelDescription.xml"))
        archive.extractall(home / "unit")
    assert texts.visible(columns[0]) in str(root.get("description"))
    harmless = home / "harmless"
    native.export_c(robots.read_description(home / "robot.toml").chain, harmless, about_q="q")
    for options in checks.STANDARDS:
        for file in ("model.c", "model.h"):
            wanted = checks.tokens((harmless / file).read_text(), [*options, f"-I{harmless}"])
            for folder in (home / "export", home / "unit" / "sources"):
                source = (folder / file).read_text()
                assert checks.tokens(source, [*options, f"-I{folder}"]) == wanted, file
