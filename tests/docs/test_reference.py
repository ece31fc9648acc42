"""The code of the pages in docs/reference runs as printed, and does what they say.

The tables of a page are CSV files of docs/data; every command beside them is there to be run.
"""

import csv
import re
import shlex
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
from page_blocks import DOCS, ROOT, commands_of, read, written_on

from hybridkin.app.cli._parser import parser

sys.path += [str(ROOT / "tests" / "examination"), str(ROOT / "examples" / "studies")]
import _report
import shown_tables
from _line import Line

PAGES = written_on("reference")
# What takes long on a page, and less of it.
SHORTER = {}
DATA = DOCS / "data"
SHOWN = sorted((DOCS / "reference").glob("*.md"))
LONG = 40  # rows that a page shows, at most
# Begins a list, a heading or a quotation of Markdown, where a cell should be text.
NO_CELL = re.compile(r"([-+*]|\d+[.)])( |$)|[#>]( |$)")


# What a page says of what its blocks print or write.
CHECKS = {}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    read("reference", page, SHORTER, CHECKS)


# Tables


def shown_on(page):
    """Return the CSV files that a page shows as tables."""
    files = re.findall(r"^:file: (\S+)$", page.read_text(encoding="utf-8"), re.MULTILINE)
    return [(page.parent / file).resolve() for file in files]


def rows_of(path):
    with open(path, newline="", encoding="utf-8") as file:
        return list(csv.reader(file))


TABLES = sorted({table for page in SHOWN for table in shown_on(page)})


def test_tables_are_found():
    assert len(TABLES) > 30
    text = "".join(page.read_text(encoding="utf-8") for page in SHOWN)
    assert text.count("{csv-table}") == sum(len(shown_on(page)) for page in SHOWN)
    assert text.count("{csv-table}") == text.count(":header-rows: 1")


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.stem)
def test_a_table_can_be_read_on_a_page(table):
    header, *rows = rows_of(table)
    assert all(header)
    assert len(set(header)) == len(header)
    assert 0 < len(rows) <= LONG
    for row in rows:
        assert len(row) == len(header), row
        assert any(row[1:]), row
        assert not any(NO_CELL.match(cell) for cell in row), row


@pytest.mark.parametrize("file", sorted(DATA.glob("**/*.csv")), ids=lambda file: file.stem)
def test_a_file_of_figures_has_a_header_and_rows(file):
    header, *rows = rows_of(file)
    assert all(header)
    assert rows
    assert {len(row) for row in rows} == {len(header)}


def test_every_file_of_figures_is_shown_or_linked():
    pages = [*DOCS.glob("*.md"), *DOCS.glob("*/*.md")]
    text = "".join(page.read_text(encoding="utf-8") for page in pages)
    sources = "".join(p.read_text(encoding="utf-8") for p in (ROOT / "examples").rglob("*.py"))
    for file in DATA.glob("*.csv"):
        assert file.name in text + sources, file.name


def test_short_tables_are_those_of_the_long_ones():
    for name, table in shown_tables.tables():
        assert rows_of(DATA / name) == table, name


# Commands


def commands_on(page):
    """Return the commands of a page: in blocks, in backquotes, and in the tables it shows."""
    text = page.read_text(encoding="utf-8")
    for table in shown_on(page):
        text += "\n".join(" ".join(row) for row in rows_of(table))
    found = re.findall(r"`((?:python|make|hybridkin) [^`]+)`", text)
    for block in re.findall(r"^```(?:console|bash)\n(.*?)^```", text, re.DOTALL | re.MULTILINE):
        found += [shlex.join(command) for command in commands_of(block)]
    return sorted(set(found))


COMMANDS = sorted({command for page in SHOWN for command in commands_on(page)})


def test_commands_are_found():
    assert len(COMMANDS) > 25


@pytest.mark.parametrize("command", COMMANDS)
def test_a_command_exists_with_its_options(command, monkeypatch):
    monkeypatch.chdir(ROOT)
    program, *arguments = shlex.split(command)
    if program == "hybridkin":
        assert parser().parse_args(arguments).command == arguments[0]
        return
    if program == "make":
        makefile = (ROOT / "Makefile").read_text(encoding="utf-8")
        assert re.search(rf"^{arguments[0]}:", makefile, re.MULTILINE)
        return
    if arguments[0] == "-m":
        assert find_spec(arguments[1]), command
        return
    script = ROOT / arguments[0]
    source = script / "__main__.py" if script.is_dir() else script
    text = source.read_text(encoding="utf-8")
    for argument in arguments[1:]:
        if argument.startswith("--"):
            assert f'"{argument}"' in text, command
    if script.name == "examination":
        parts = [word for word in arguments[1:] if word.isalpha() and word.islower()]
        for part in parts:
            assert part == "report" or (script / f"{part}.py").is_file(), command


# The report of the examination


def test_the_committed_report_is_what_the_command_writes():
    assert _report.PAGE.read_text(encoding="utf-8") == _report.page()


def test_the_report_says_that_it_is_generated_and_by_what():
    beginning = _report.page()[:600]
    assert "generated" in beginning
    assert "python tests/examination report" in beginning


def test_the_report_has_every_figure_and_where_it_is_from():
    page = _report.page()
    runs = _report.runs_in(_report.COMMITTED)
    files = {path.name for path in _report.COMMITTED.glob("*.csv")} - {"runs.csv"}
    assert {run.file for run in runs} == files
    for run in runs:
        assert run.date in page
        for row in rows_of(_report.COMMITTED / run.file):
            for cell in row:
                assert _report._cell(cell) in page


def test_a_part_that_runs_again_replaces_its_figures(tmp_path):
    for figure, holds in (("12 | of 12", True), ("11 of 12", False)):
        lines = [Line("rows", figure, holds), Line("a tool", "is absent", None)]
        _report.write_part(tmp_path, "soak", "python soak", "Long runs.", 61.4, lines)
        _report.write_part(tmp_path, "kills", "python kills", "Kills.", 1.0, lines[1:])
    assert [run.part for run in _report.runs_in(tmp_path)] == ["soak", "kills"]
    text = _report.sections(tmp_path)
    assert text.index("## Soak") < text.index("Long runs.") < text.index("`python soak`, ")
    assert "61 s" in text
    assert "| rows | 11 of 12 | NO |" in text
    assert "12 of 12" not in text
    assert text.count("| a tool | is absent | not run |") == 2
    assert "without a result" in _report.sections(tmp_path, ["files"])


def test_a_bar_ends_no_cell(tmp_path):
    line = Line("a | b", "two\nlines", True)
    _report.write_part(tmp_path, "soak", "python soak", "", 0.0, [line])
    assert r"| a \| b | two lines | yes |" in _report.sections(tmp_path)


def test_every_part_of_the_examination_is_in_the_report():
    modules = Path(_report.__file__).parent.glob("[a-z]*.py")
    assert {path.stem for path in modules} <= {
        run.part for run in _report.runs_in(_report.COMMITTED)
    }
