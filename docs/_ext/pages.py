"""What the pages need beyond Sphinx: equations without a script, names, and order."""

import re
from html import escape
from pathlib import Path

from docutils import nodes
from docutils.utils.math import latex2mathml

EXAMPLES = (
    "csv_to_track",
    "notebook",
    "next_rows",
    "table1",
    "error_histogram",
    "learning_curve",
    "extrapolation",
    "model_selection",
    "motions",
    "slack_tendons",
    "tracking",
    "obstacles",
    "payload",
    "new_day",
    "rigid_arm",
    "autograd",
    "elm_dask",
)
"""The gallery's order."""


def gallery_order(name):
    """Return the place of an example in the gallery."""
    return EXAMPLES.index(Path(name).stem.removeprefix("plot_"))


def _inline_math(writer, node):
    writer.body.append(latex2mathml.tex2mathml(node.astext()))
    raise nodes.SkipNode


def _block_math(writer, node):
    number = ""
    if node.get("number"):
        writer.body.append(f'<span class="eqno">({escape(str(node["number"]))})')
        writer.add_permalink_ref(node, "Link to this equation")
        number = "".join((writer.body.pop(-2), writer.body.pop(), "</span>"))
    ids = "".join(f'<span id="{name}"></span>' for name in node.get("ids", []))
    equation = latex2mathml.tex2mathml(node.astext(), as_block=True)
    writer.body.append(f'<div class="math">{ids}{number}{equation}</div>')
    raise nodes.SkipNode


def _resolve(app, env, node, contnode):
    """Resolve `Name` and `module.name` as the public hybridkin.Name and hybridkin.module.name."""
    target = node.get("reftarget", "")
    python = env.get_domain("py")
    name = f"hybridkin.{target}"
    if node.get("refdomain") != "py" or name not in python.objects:
        return None
    return python.resolve_xref(
        env, node["refdoc"], app.builder, node["reftype"], name, node, contnode
    )


def _to_gallery(app, docname, source):
    """Lead links to an example, which serve readers of the repository, to its page."""
    links = r"\]\(((?:\.\./)*)\.\./examples/(?:(plot_\w+)\.py)?\)"
    source[0] = re.sub(
        links, lambda link: f"]({link[1]}gallery/{link[2] or 'index'}.rst)", source[0]
    )


def setup(app):
    """Register the equations' renderer, the look-up of names and the links to the gallery."""
    app.add_html_math_renderer(
        "mathml",
        inline_renderers=(_inline_math, None),
        block_renderers=(_block_math, None),
    )
    app.connect("missing-reference", _resolve)
    app.connect("source-read", _to_gallery)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
