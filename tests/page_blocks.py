"""The code blocks of a page, run in order in one folder, as a reader of the page does.

`python` blocks share one namespace. A `toml` block is a file: a comment in its first line names it,
``# scene.toml``, else it is robot.toml; a block that begins with a ``[section]`` replaces this
section of the file. Of `console` blocks each command runs in this process. `text` and `csv` are
outputs. Other languages have tests of their own.
"""

import contextlib
import io
import re
import runpy
import shlex
import sys
import textwrap
from dataclasses import dataclass
from pathlib import Path

import pytest

from hybridkin.app.cli._demo import write_log
from hybridkin.app.cli._parser import parser
from hybridkin.app.cli.main import main

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
SHELVES = ("tutorials", "how_to", "explanation", "reference")
GENERATED = ("reliability_report.md", "changelog.md")
PAGES = [DOCS / "index.md", *(page for shelf in SHELVES for page in (DOCS / shelf).glob("*.md"))]
QUICK = ["--folds", "2", "--jobs", "1", "--max-rows", "200", "--no-auto"]
"""Arguments of `hybridkin fit` for less work."""
UNRUN = ("demo", "view")
"""Commands whose arguments are read only; of the demo the log is written, which pages use."""
ELSEWHERE = ("pip", "uv", "git", "cd", "ssh", "mex", "mkoctfile", "cc", "docker", "ros2", "colcon")
"""Programs that no page runs here: they install, or belong to other systems."""


def written_on(shelf):
    """Return the names of the pages on a shelf, without those that are generated."""
    pages = sorted((DOCS / shelf).glob("*.md"))
    return [page.stem for page in pages if page.name not in GENERATED]


@dataclass(frozen=True)
class Block:
    """A code block: its language, its text and the first line of the text in the page."""

    language: str
    text: str
    line: int


def blocks_of(page):
    """Return the code blocks of a Markdown file in order, without those of Sphinx."""
    text = page.read_text(encoding="utf-8")
    blocks = []
    for found in re.finditer(r"^ *```([a-z]+)\n(.*?)^ *```", text, re.DOTALL | re.MULTILINE):
        line = text[: found.start(2)].count("\n") + 1
        blocks.append(Block(found[1], textwrap.dedent(found[2]), line))
    return blocks


def commands_of(text):
    """Return the commands of a console block, continued lines joined, comments off."""
    lines = text.replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if shlex.split(line, comments=True)]


def replaced(text, shorter):
    """Return a text with replacements made, each of which must occur."""
    for long, short in shorter:
        assert long in text, long
        text = text.replace(long, short)
    return text


class Reader:
    """One who runs the blocks of a page in the working directory.

    Parameters
    ----------
    page : Path
        The Markdown file.
    shorter : sequence of (str, str)
        What takes long in the blocks, and less of it.

    Attributes
    ----------
    space : dict
        The namespace of the Python blocks.
    printed : str
        What the blocks printed.
    """

    def __init__(self, page, shorter=()):
        self.page = page
        self.shorter = shorter
        self.space = {"__name__": page.stem}
        self.printed = ""

    def run(self):
        """Run all blocks in order, and return self."""
        left = [*self.shorter]
        for block in blocks_of(self.page):
            here = [(long, short) for long, short in left if long in block.text]
            left = [pair for pair in left if pair not in here]
            kind = getattr(self, f"_{block.language}", None)
            if kind is None:
                continue
            with contextlib.redirect_stdout(io.StringIO()) as out:
                try:
                    kind(replaced(block.text, here), block.line)
                except Exception as error:
                    raise AssertionError(f"{self.page.name}, line {block.line}") from error
            self.printed += out.getvalue()
        assert not left, f"not in {self.page.name}: {left}"
        return self

    def _python(self, text, line):
        exec(compile("\n" * (line - 1) + text, str(self.page), "exec"), self.space)

    def _toml(self, text, line):
        name = re.match(r"# *(\S+\.toml)", text)
        file = Path(name[1] if name else "robot.toml")
        section = re.search(r"\A(?:#.*\n)*(\[[^]\n]+\])\n", text)
        if section and file.exists():
            old = file.read_text(encoding="utf-8")
            before, _, rest = old.partition(section[1])
            after = re.split(r"^(?=\[)", rest, maxsplit=1, flags=re.MULTILINE)[1:]
            text = "".join([before.rstrip("\n"), "\n\n", text, "\n", *after])
        file.write_text(text, encoding="utf-8")

    def _console(self, text, line):
        for command in commands_of(text):
            _run(command)

    _bash = _sh = _console


def read(shelf, page, shorter, checks):
    """Run the blocks of a page, and check what the page says of them.

    Parameters
    ----------
    shelf, page : str
        Names of the folder and of the page in it.
    shorter : dict
        By page: what takes long in its blocks, and less of it.
    checks : dict
        By page: a function that takes the `Reader`. Of other pages it counts that all blocks run.
    """
    reader = Reader(DOCS / shelf / f"{page}.md", shorter.get(page, ())).run()
    if page in checks:
        checks[page](reader)


def _run(command):
    program, *arguments = command
    if program == "hybridkin":
        if arguments[0] == "fit":
            arguments += [word for word in QUICK if word not in arguments]
        if arguments[0] in UNRUN:
            read = parser().parse_args(arguments)
            if arguments[0] == "demo":
                read.out.mkdir()
                write_log(read.out / "log.csv")
        else:
            assert main(arguments) == 0, command
    elif program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        for target in arguments:
            assert re.search(rf"^{target}:", makefile, re.MULTILINE), command
    elif program == "python":
        _run_python(arguments)
    else:
        assert program in ELSEWHERE, f"nobody runs {command}"


def _run_python(arguments):
    """Run a script of the examples that lies in their folder; of others look whether they exist."""
    script = ROOT / arguments[0]
    assert script.exists(), arguments
    if script.name == "measured_trunk.py":
        pytest.importorskip("mujoco", reason='needs MuJoCo: pip install "hybridkin[sim]"')
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", [str(script), *arguments[1:]])
            patch.setattr(sys, "path", [str(script.parent), *sys.path])
            runpy.run_path(str(script), run_name="__main__")
