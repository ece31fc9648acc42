"""Texts of a user are shown as text, whatever they hold, by each file's own reader."""

import csv
import io
import math
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

import matplotlib.pyplot as plt
import numpy as np
import pytest
from markdown_it import MarkdownIt

from hybridkin._core import texts
from hybridkin._core.html import html_table
from hybridkin.app import cli
from hybridkin.app.workflow import Report
from hybridkin.datasets import load_log
from hybridkin.plots import ActuatorDisplay, ErrorBoxDisplay

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

PIECES = [
    *("*/", "/*", "//", "*\\\n/", "*??/\n/", "\\", "\\\n", "??/", "??/\n", "%:define x"),
    *("#include <x.h>", "__attribute__((constructor)) static void evil(void){}", "\\u002a\\u002f"),
    *("\x1b[2J", "\x1b]0;title\x07", "\x9b2J", "\0", "\x7f", "\x08", "\r", "\n", "\n\n", "\t"),
    *("\u2028", "\u2029", "\u0085", "\u202e", "\u2066", "\ud800", "\udc80", "\ufeff", "\ufffe"),
    *("<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "<b>", "&lt;b&gt;", "&#60;b>"),
    *("<a href='matlab:quit'>x</a>", "]]>", "-->", "<!--", "<?php", "<!DOCTYPE x>", "%{", "{%"),
    *(
        "[x](javascript:alert(1))",
        "![x](http://e.xyz/i)",
        "[x]: http://e.xyz",
        "[x]",
        "](",
        "<x:y>",
    ),
    *("<http://e.xyz>", "https://e.xyz/?a=b", "www.e.xyz", "a@e.xyz", "e.xyz", "`", "``", "```"),
    *("`x`", "|", "\\|", "$x$", "$\\frac{$", "\\$", "_", "__x__", "**x**", "*", "~~~", "#", "# x"),
    *("- x", "1. x", "> x", "---", "===", "    x", "=1+1", "+1", "-1", "@SUM(1)", "'=1", "\uff1d1"),
    *('"', '"""', "'", "{evil}", "{0}", "{alert(1)}", "{", "}", "@NAME@", "%s", "$(id)", "$name"),
    *(
        ";",
        ";;;;;;;;",
        ",",
        "\u00e9",
        "\u9577\u3055",
        "\U0001f991",
        "\u200d",
        " ",
        "  ",
        "a",
        "tip_x",
        "q[0]",
    ),
]
STANDARDS = (["-std=c99"], ["-std=gnu11"], ["-std=gnu11", "-trigraphs"])


def made(n, seed=0):
    """Return n texts of one to six pieces; the first are the pieces alone."""
    rng = np.random.default_rng(seed)
    joined = []
    for _ in range(max(n - len(PIECES), 0)):
        joined.append("".join(rng.choice(np.array(PIECES, object), rng.integers(1, 7))))
    return [*PIECES, *joined][:n]


def hidden(text):
    """Return the characters of a text, except line breaks, that a terminal or reader may obey."""
    return [c for c in text if not (c.isprintable() or c in "\n\u200c\u200d")]


def tokens(source, options):
    """Return what the preprocessor leaves of C code: all but its comments."""
    command = ["cc", "-E", "-P", "-Wall", "-Werror", *options, "-x", "c", "-"]
    done = subprocess.run(command, input=source.encode(), capture_output=True)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout.decode().split()


def reader_of(kind="commonmark"):
    """Return a reader of Markdown with tables; "gfm-like" also makes links of addresses."""
    return MarkdownIt(kind).enable(["table", "strikethrough"])


def markup(text, reader):
    """Return the kinds of tokens of Markdown."""
    found = []
    for block in reader.parse(text):
        for token in [block, *(block.children or [])]:
            found.append(token.type)
    return found


def shown(text):
    """Return the text that a reader of Markdown sees."""
    parts = []
    for block in reader_of().parse(text):
        parts += [token.content for token in block.children or []]
    return "".join(parts)


def check_c(names, options):
    """Raise if a name adds a token to C code, in the middle, at the start or the end of a line."""
    lines, wanted = [], []
    for k, name in enumerate(names):
        comment = texts.c_comment(name)
        lines.append(f"/* {comment} */ a{k} /* x\n {comment}\n*/ b{k} /*\n{comment}*/ c{k}")
        wanted += [f"a{k}", f"b{k}", f"c{k}"]
    assert tokens("\n".join(lines), options) == wanted


def check_markdown(name, reader):
    """Raise if a name in a report is more than text."""
    report = Report(name, {})
    report.text("{name}", "Of {name}: **{name}**, {name}.", name=name)
    report.items([name, name])
    report.table(["name", name], [[name, "1"], ["b", name]])
    report.verbatim(name)
    plain = Report("q", {})
    plain.text("q", "Of q: **q**, q.")
    plain.items(["q", "q"])
    plain.table(["name", "q"], [["q", "1"], ["b", "q"]])
    plain.verbatim("q")
    written = report.markdown()
    assert not hidden(written)
    structure = [kind for kind in markup(written, reader) if kind not in ("text", "code_inline")]
    wanted = markup(plain.markdown(), reader)
    wanted = [kind for kind in wanted if kind not in ("text", "code_inline")]
    if texts.visible(name).strip():  # of an empty one nothing is left to be a paragraph
        assert structure == wanted
    assert {*structure} <= {*wanted}
    assert not hidden(report.plain())


def check_tables(name, folder):
    """Raise if a name is a formula in a CSV file, or cannot be read from it."""
    head = ["t", name, f"effective_{name}", "x", "y", "z"]
    text = texts.csv_table(head, [["-0.5", "1e-3", "+2", "-1", "1.5", "0"]] * 2)
    header, *rows = csv.reader(io.StringIO(text))
    assert [*map(float, rows[0][:3])] == [-0.5, 1e-3, 2.0]
    for cell in header:
        is_number = re.fullmatch(r"[+-]?\d+", cell.strip())
        assert cell[:1] not in "=+-@\t\r\n\uff1d" or cell == "" or is_number
    assert not hidden(text)
    if texts.visible(name).strip() in ("", "t", "x", "y", "z"):
        return
    path = folder / "track.csv"
    path.write_text(text, encoding="utf-8", newline="")
    log = load_log(path, [name, f"effective_{name}"], ["z", "y", "x"])
    assert log.q_names == [name, f"effective_{name}"]
    assert log.q[0].tolist() == [1e-3, 2.0]


class Reader(HTMLParser):
    def __init__(self):
        super().__init__()
        self.tags, self.text = [], ""

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, attrs))

    def handle_data(self, data):
        self.text += data


def check_html(name):
    """Raise if a name is more than text in HTML."""
    seen = []
    for text in (name, "q"):
        reader = Reader()
        reader.feed(html_table(text, {text: text, "b": (text, 1), "c": {text: text}}))
        reader.close()
        seen.append(reader)
    assert seen[0].tags == seen[1].tags
    assert texts.visible(name) in seen[0].text
    assert not hidden(seen[0].text)


def check_xml(name):
    """Raise if an attribute or an element in XML does not give a name back."""
    root = ElementTree.Element("a", b=texts.xml_text(name))
    root.text = texts.xml_text(name)
    read = ElementTree.fromstring(ElementTree.tostring(root, encoding="utf-8"))
    assert read.get("b") == read.text == texts.visible(name)


def check_toml(name):
    """Raise if TOML does not give a name back; lone surrogates are no text."""
    if any("\ud800" <= c <= "\udfff" for c in name):
        with pytest.raises(ValueError, match="Unicode"):
            texts.toml_value(name)
        return
    line = f"a = {texts.toml_value([name, name])}\nb = 1\n"
    assert tomllib.loads(line) == {"a": [name, name], "b": 1}
    assert not hidden(line)


def check_matlab(name):
    line = texts.matlab_comment(name)
    assert not hidden(line)
    assert "\n" not in line
    assert "<a" not in line.lower()


def check_figure(names):
    """Draw names in axes and legends; formulas that are none raise."""
    errors = {name: np.array([0.01, 0.02]) for name in names}
    display = ErrorBoxDisplay(errors).plot()
    display.figure_.draw_without_rendering()
    q = np.zeros((2, len(names)))
    actuators = ActuatorDisplay({"command": q}, [len(names)], names=names)
    actuators.plot(unit=names[0], per_unit=1.0)
    actuators.figure_.draw_without_rendering()
    legend = actuators.axes_[0].get_legend().get_texts()
    found = [text.get_text().strip() for text in legend]
    assert found == [texts.plot_label(name).strip() for name in names]
    plt.close("all")


needs_compiler = pytest.mark.skipif(not shutil.which("cc"), reason="needs a C compiler")


@needs_compiler
@pytest.mark.parametrize("options", STANDARDS)
def test_no_name_adds_a_token_to_c(options):
    check_c(made(600), options)


def test_no_name_is_more_than_text_in_markdown():
    for name in made(200, seed=1):
        check_markdown(name, reader_of())


def test_no_name_is_more_than_text_in_html_xml_toml_and_matlab():
    for name in made(300, seed=2):
        check_html(name)
        check_xml(name)
        check_toml(name)
        check_matlab(name)


def test_no_name_is_a_formula_in_a_table_and_all_are_read_back(tmp_path):
    for name in made(150, seed=3):
        check_tables(name, tmp_path)


@pytest.mark.filterwarnings("ignore:Glyph", "ignore:constrained_layout")
@pytest.mark.slow
def test_no_name_is_a_formula_in_a_figure():
    names = [f"{k}{name}" for k, name in enumerate(PIECES[::4])]
    check_figure([*names, "_hidden", "$x$", "a$b", "$\\frac{$"])


@pytest.mark.parametrize(
    ("text", "written"),
    [
        ("cable 1, base (left)", "cable 1, base (left)"),
        ("0.001 * tip_x = q[0]", "0.001 * tip_x = q[0]"),
        ("log.csv of *tendon*", "`log.csv` of `*tendon*`"),
        ("set `groups`, e.g. 1.5 mm", "set `groups`, e.g. 1.5 mm"),
        ("a`b", "`` a`b ``"),
        ("1. first", "`1.` first"),
        ("a *", "a `*`"),  # beside the stars of bold words
    ],
)
def test_usual_texts_stay_readable_in_markdown(text, written):
    assert texts.markdown(text) == written
    assert shown(written).replace("`", "") == text.replace("`", "")


def test_numbers_stay_numbers_in_a_table():
    cells = ["-1", "+1.5", "-1e-9", "-inf", "=1", "-a", "'-a", "a"]
    assert [*map(texts.csv_cell, cells)] == [*cells[:4], "'=1", "'-a", "''-a", "a"]
    assert texts.csv_table(["a"], [[math.nan], [-1.5]]) == "a\nnan\n-1.5\n"


def test_the_command_line_writes_in_one_place():
    folder = Path(cli.__file__).parent
    found = {}
    for path in folder.glob("*.py"):
        words = re.findall(
            r"(?<!\.)\bprint\(|std(?:out|err)\.write\(", path.read_text(encoding="utf-8")
        )
        if words:
            found[path.name] = words
    assert found == {"_terminal.py": ["print("]}
