"""Texts of users in generated files: names, units, labels and paths, by the grammar of each file.

Whoever names an actuator must not write code with it. Every function here returns a text that its
file shows as text: in a C comment nothing ends the comment, on a terminal nothing moves the cursor.
Characters that cannot be seen are written by their number, such as <U+001B>.
"""

from __future__ import annotations

import html
import json
import re
from collections.abc import Iterable, Sequence

_JOINERS = "\u200c\u200d"  # of letters in some scripts, and of emoji
# Words of a sentence that no Markdown takes for more than a word: no code, link, list or HTML.
_WORD = re.compile(r"(?:[\w\[\].,;:'\"()/%+=?!°±²³\u2013…-])+")
_MARKUP = re.compile(
    r"//|\][(\[]|(?<![^\W_])_|_(?![^\W_])|\w\.[^\W\d_]{2}"  # links, emphasis, names of hosts
)
_SPAN = re.compile(r"^([^`]*)`[^`]+`([^`]*)$")  # one word of code, as in `q`
_LIST = re.compile(r"\W*|\d+[.)]|\[.*")  # what means a list, a line or a link at a start
_FORMULA = re.compile(r"'*[=+\-@\t\r\n\uff1d\uff0b\uff0d\uff20]")


def visible(text: object) -> str:
    """Return a text in one line in which every character can be seen."""
    text = str(text)
    if text.isprintable():
        return text
    shown = []
    for character in text:
        if character.isprintable() or character in _JOINERS:
            shown.append(character)
        else:
            shown.append(_number(character))
    return "".join(shown)


def visible_lines(text: object) -> str:
    """Return a text for a terminal: its line breaks stay, all else can be seen."""
    return "\n".join(map(visible, str(text).split("\n")))


def _number(character: str) -> str:
    return f"<U+{ord(character):04X}>"


def c_comment(text: object) -> str:
    r"""Return a text inside a comment in C.

    It is ASCII: some compilers read other characters by the code page of their machine. It has
    no backslash and no trigraph, which can join lines, and neither ends nor begins a comment.
    """
    shown = ""
    for character in visible(text):
        is_plain = character.isascii() and character != "\\"
        shown += character if is_plain else _number(character)
    shown = shown.replace("*/", "* /").replace("/*", "/ *")
    return re.sub(r"\?(?=\?)", "? ", shown)


def matlab_comment(text: object) -> str:
    """Return a text inside a line of comment in MATLAB, whose help makes links of ``<a``."""
    return re.sub("<(?=a)", "< ", visible(text), flags=re.IGNORECASE)


def xml_text(text: object) -> str:
    """Return a text that XML can hold; the writer of the XML escapes < and &."""
    return visible(text)


def html_text(text: object) -> str:
    """Return a text in HTML, in an element or an attribute; its line breaks stay."""
    return html.escape(visible_lines(text))


def script_text(text: object) -> str:
    """Return a text as a literal in JavaScript, also inside HTML."""
    return json.dumps(visible(text)).replace("<", r"\u003c")


def markdown(text: object) -> str:
    """Return a text in Markdown; words that could be markup, as ``*x*``, become code."""
    words = visible(text).split()
    shown = []
    for k, word in enumerate(words):
        outside = _SPAN.sub(r"\1q\2", word)
        is_word = _WORD.fullmatch(outside) and not _MARKUP.search(outside)
        if word == "*":  # a star between words is one
            is_word = 0 < k < len(words) - 1
        if not is_word or (k == 0 and _LIST.fullmatch(word)):
            word = _code(word)
        shown.append(word)
    return " ".join(shown)


def markdown_cell(text: object) -> str:
    """Return a text in a cell of a table in Markdown, where a bar would end the cell."""
    return markdown(visible(text).replace("|", _number("|")))


def markdown_block(text: object) -> str:
    """Return lines as they are, as a block of code in Markdown."""
    lines = visible_lines(text)
    fence = "`" * max(3, 1 + _longest_run(lines))
    return f"{fence}\n{lines}\n{fence}"


def _code(word: str) -> str:
    fence = "`" * (1 + _longest_run(word))
    space = " " if "`" in word else ""
    return f"{fence}{space}{word}{space}{fence}"


def _longest_run(text: str) -> int:
    """Return the length of the longest run of backquotes."""
    return max(map(len, re.findall("`+", text)), default=0)


def toml_value(value: object) -> str:
    """Return text, a number, or a list of them in TOML, which reads back as the same; None: null.

    Raises
    ------
    ValueError
        If a text has a character that is none, from a path in another encoding.
    """
    text = ""
    for character in json.dumps(value, ensure_ascii=False):
        if "\ud800" <= character <= "\udfff":
            raise ValueError(
                f"TOML needs text in Unicode, got {value!a:.80}; rename the file or column."
            )
        is_plain = character.isprintable() or character in _JOINERS
        text += character if is_plain else f"\\U{ord(character):08X}"
    return text


def csv_cell(text: object) -> str:
    """Return a text as a cell of a table, which no spreadsheet takes for a formula.

    One that begins like a formula gets an apostrophe before it; numbers stay as they are.
    """
    shown = visible(text)
    if _FORMULA.match(str(text)) and not _is_number(shown):
        return f"'{shown}"
    return shown


def csv_table(head: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table as CSV; a cell with any separator is quoted, as readers guess theirs."""
    lines = []
    for row in (head, *rows):
        cells = []
        for cell in map(csv_cell, row):
            quoted = cell.replace('"', '""')
            cells.append(f'"{quoted}"' if re.search('[",;]', cell) else cell)
        lines.append(",".join(cells))
    return "\n".join([*lines, ""])


def _is_number(text: str) -> bool:
    try:
        float(text)
    except ValueError:
        return False
    return True


def plot_label(text: object) -> str:
    """Return a text in a figure: no formula of mathematics, and not left out of the legend."""
    label = visible(text).replace("$", r"\$")
    return f" {label}" if label.startswith("_") else label
