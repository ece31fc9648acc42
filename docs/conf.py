"""Sphinx settings; `make docs` builds the pages into docs/_build/html."""

import os
import shutil
import sys
from pathlib import Path

ROOT = Path(__file__).parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "examples"), str(ROOT / "docs" / "_ext")]
os.environ.setdefault("MPLBACKEND", "agg")

import hybridkin  # noqa: E402

project = "hybridkin"
author = "The hybridkin developers"
copyright = author
version = release = hybridkin.__version__

extensions = [
    "sphinx.ext.autodoc",
    "sphinx.ext.autosummary",
    "numpydoc",
    "myst_parser",
    "sphinx_gallery.gen_gallery",
    "pages",
]
exclude_patterns = ["_build", "gallery/**/*.ipynb", "gallery/*.md5"]
templates_path = ["_templates"]
source_suffix = {".md": "markdown", ".rst": "restructuredtext"}

# Text: the pages are Markdown, readable in the repository as well.
myst_enable_extensions = ["amsmath", "colon_fence", "deflist", "dollarmath"]
myst_heading_anchors = 3
suppress_warnings = ["config.cache"]

# Reference: from the docstrings.
default_role = "py:obj"
autosummary_generate = True
# Pages of names that are gone would stay.
shutil.rmtree(ROOT / "docs" / "reference" / "api", ignore_errors=True)
autosummary_ignore_module_all = False
autodoc_typehints = "none"
autodoc_class_signature = "mixed"
autodoc_member_order = "bysource"
numpydoc_show_class_members = False
# Modules that the package opens as its attributes are documented under these names.
for _name in ("obstacles", "robots", "tasks", "trajectories"):
    sys.modules[f"hybridkin.{_name}"] = getattr(hybridkin, _name)

nitpicky = True
nitpick_ignore = [("py:class", "sklearn.utils.Bunch"), ("py:obj", "Trajectory")]
# Single quotes also mark arguments, methods and constants, which have no page of their own.
nitpick_ignore_regex = [("py:obj", r"[a-z_].*|[A-Z_]+")]

# Gallery: every example is run.
sphinx_gallery_conf = {
    "examples_dirs": "../examples",
    "gallery_dirs": "gallery",
    "backreferences_dir": "gallery/backreferences",
    "doc_module": ("hybridkin",),
    "filename_pattern": r"/plot_",
    "ignore_pattern": r"__init__\.py",
    "within_subsection_order": "pages.gallery_order",
    "thumbnail_size": (560, 400),
    "download_all_examples": False,
    "show_signature": False,
    "remove_config_comments": True,
    "show_memory": False,
    "write_computation_times": False,
    "plot_gallery": "True",
}

html_theme = "furo"
html_title = f"hybridkin {release}"
html_static_path = ["_static"]
html_css_files = ["hybridkin.css"]
html_theme_options = {
    "light_css_variables": {
        "color-brand-primary": "#0072B2",
        "color-brand-content": "#0072B2",
    },
    "dark_css_variables": {
        "color-brand-primary": "#56B4E9",
        "color-brand-content": "#56B4E9",
    },
}
html_show_sourcelink = False
html_math_renderer = "mathml"
