"""What a notebook shows of an object: a title and a table of names and values, as HTML."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hybridkin._core.arrays import Numbers, as_array
from hybridkin._core.texts import html_text, visible

_MOST = 48  # numbers of an array that are shown
_ROUNDING = 12  # decimals
# Text has the colour of the page and lines are half transparent: right on light and on dark pages.
_STYLE = """<style>
.hybridkin { font-size: 0.9em; margin: 0.5em 0; text-align: left; width: fit-content; }
.hybridkin details { border: 1px solid rgba(128, 128, 128, 0.5); }
.hybridkin summary { background: rgba(0, 114, 178, 0.18); cursor: pointer; padding: 0.3em 0.6em; }
.hybridkin table { border-collapse: collapse; margin: 0.2em 0.6em; width: auto; }
.hybridkin tbody tr:nth-child(n) { background: none; }
.hybridkin tbody :is(th, td) { border: none; color: inherit; font: inherit; max-width: 60em;
  padding: 0.15em 1em 0.15em 0; text-align: left; vertical-align: top; white-space: pre-wrap; }
.hybridkin tbody th { opacity: 0.75; white-space: nowrap; }
</style>"""


def html_table(title: str, rows: Mapping[str, object]) -> str:
    """Return names and values as an HTML table that can be folded, every text escaped.

    Parameters
    ----------
    title : str
        The line that stays when the table is folded.
    rows : mapping of str
        Names and values: a tuple has a cell for each entry, a mapping becomes a folded table, and
        None is left out.
    """
    return f'{_STYLE}\n<div class="hybridkin">{_folding(title, rows, " open")}</div>'


def numbers(values: Numbers) -> str:
    """Return an array as text, one line for each row; of a long one its shape."""
    array = as_array(values)
    if array.size > _MOST:
        return f"array of shape {array.shape}"
    rows = np.round(array, _ROUNDING) + 0.0  # no negative zeros
    n_columns = np.atleast_1d(rows).shape[-1]
    lines = []
    for line in rows.reshape(-1, n_columns):
        lines.append(", ".join(f"{value:.4g}" for value in line))
    return "\n".join(lines)


def _folding(title: str, rows: Mapping[str, object], state: str = "") -> str:
    lines = []
    for name, value in rows.items():
        if value is not None:
            lines.append(_row(name, value))
    body = "\n".join(lines)
    return (
        f"<details{state}><summary>{html_text(title)}</summary>"
        f"<table><tbody>\n{body}\n</tbody></table></details>"
    )


def _row(name: str, value: object) -> str:
    if isinstance(value, Mapping):
        return f'<tr><td colspan="9">{_folding(name, value)}</td></tr>'
    cells = value if isinstance(value, tuple) else (value,)
    columns = "".join(f"<td>{html_text(cell)}</td>" for cell in cells)
    return f'<tr><th scope="row">{html_text(visible(name))}</th>{columns}</tr>'
