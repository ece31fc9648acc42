"""The pages can be reached, and every public name says what it takes and gives."""

import inspect
import os
import re
from enum import Enum
from pathlib import Path

import pytest
from page_blocks import DOCS, GENERATED, PAGES, SHELVES, blocks_of

import hybridkin
from hybridkin import app

WRITTEN = [page for page in PAGES if page.name not in GENERATED and page.name != "index.md"]
# Words alone, or equations.
WITHOUT_CODE = {"glossary.md"}
MODULES = (
    "app",
    "datasets",
    "obstacles",
    "plots",
    "robots",
    "tasks",
    "trajectories",
    "workflow",
)
# In the unit of the robot's actuators, whatever that is, or of data that need no robot.
OF_THE_ACTUATORS = {"q", "q0", "q_min", "q_max", "q_pref", "dq", "X", "y", "std"}
WITHOUT_UNIT = {
    *("groups", "sample_weight", "weights", "sizes", "rows", "part", "train_idx", "test_idx"),
    *("motions", "runs", "fold", "late"),
    *("normal", "axes", "axes_", "frames", "base", "tip", "origins", "pose", "values", "spreads"),
    *("correlations", "narrowing", "identifiable", "singular_values", "sigma_min", "scale"),
    *("input_weights_", "alphas", "alpha_", "cv_results_", "leverage_center_"),
    *("feature_names_in_", "data", "geometry", "target", "s", "ndarray"),
}


# The pages


def listed_in(page):
    """Return the pages that the tables of contents of a page list, from the folder of the pages."""
    tables = re.findall(r"```\{toctree\}\n(.*?)```", page.read_text(encoding="utf-8"), re.DOTALL)
    lines = [line for table in tables for line in table.splitlines()]
    return {line for line in lines if line and not line.startswith(":")}


def test_every_page_is_in_the_table_of_contents():
    pages = {page.relative_to(DOCS).with_suffix("").as_posix() for page in PAGES}
    listed = listed_in(DOCS / "index.md")
    assert listed == pages - {"index"} | {"reference/api", "gallery/index"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    """Also for readers of the repository, where the gallery is not built."""
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        name, _, heading = link.partition("#")
        file = Path(os.path.normpath(page.parent / name)) if name else page
        assert file.exists(), link
        if heading:
            headings = re.findall(r"^#+ (.*)$", file.read_text(), re.M)
            assert heading in {h.lower().replace(" ", "-").replace("'", "") for h in headings}, link


def test_equations_are_numbered_as_they_come():
    text = (DOCS / "explanation" / "theory.md").read_text(encoding="utf-8")
    numbers = [int(n) for n in re.findall(r"^\$\$ .* \$\$ \((\d+)\)$", text, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > 20
    outside = re.sub(r"\$\$.*?\$\$ \(\d+\)", "", text)
    assert {int(n) for n in re.findall(r"(?<=[\s~])\((\d{1,2})\)", outside)} <= {*numbers}


def test_every_page_is_read_by_the_tests_of_its_shelf():
    folders = {page.parent.name for page in PAGES} - {"docs"}
    assert folders == {*SHELVES}
    assert all((DOCS.parent / f"tests/docs/test_{shelf}.py").is_file() for shelf in folders)
    assert not blocks_of(DOCS / "index.md")


@pytest.mark.parametrize("page", WRITTEN, ids=lambda page: page.stem)
def test_a_page_begins_with_who_needs_it_and_code(page):
    """The first code comes before the second heading."""
    text = page.read_text(encoding="utf-8")
    title, first, *_ = text.split("\n\n")
    assert title.startswith("# ")
    assert re.match("(For|You) ", first), "who needs this page?"
    if page.name not in WITHOUT_CODE:
        beginning = text.partition("\n## ")[0]
        assert re.search(r"^```(python|console|toml)\n", beginning, re.MULTILINE)


# The gallery


def test_gallery_lists_every_example():
    text = (DOCS / "_ext" / "pages.py").read_text(encoding="utf-8")
    order = re.search(r"EXAMPLES = \((.*?)\)", text, re.DOTALL)
    assert order
    names = re.findall(r'"(\w+)"', order[1])
    examples = [p.stem.removeprefix("plot_") for p in DOCS.parent.glob("examples/plot_*.py")]
    assert sorted(names) == sorted(examples)


# The docstrings


def public():
    """Return all functions and classes of the public modules, and the classes' own methods."""
    found = {name: getattr(hybridkin, name) for name in hybridkin.__all__}
    found = {name: o for name, o in found.items() if callable(o)}
    for folder in MODULES:
        within = app if folder == "workflow" else hybridkin
        module = getattr(within, folder)
        members = {f"{folder}.{name}": getattr(module, name) for name in module.__all__}
        found |= {name: o for name, o in members.items() if callable(o)}
    for name, cls in list(found.items()):
        if inspect.isclass(cls):
            own = [base for base in cls.__mro__ if base.__module__.startswith("hybridkin")]
            members = {key: o for base in reversed(own) for key, o in vars(base).items()}
            for key, member in members.items():
                member = getattr(member, "__func__", getattr(member, "fget", member))
                if not key.startswith("_") and inspect.isfunction(member):
                    found[f"{name}.{key}"] = member
    return found


PUBLIC = public()


def section(doc, name):
    """Return the entries (names, type, text) of one section of a docstring."""
    pattern = rf"^{name}\n-+\n(.*?)(?=^\S[^\n]*\n-{{3,}}|\Z)"
    body = re.search(pattern, doc, re.DOTALL | re.MULTILINE)
    entries = re.split(r"^(?=\S)", body[1], flags=re.MULTILINE) if body else []
    found = []
    for entry in filter(str.strip, entries):
        head, _, text = entry.partition("\n")
        names, colon, kind = head.partition(" : ")
        if not colon and name == "Returns":
            names, kind = "", head
        names = [n.strip().lstrip("*") for n in names.split(",") if n]
        found.append((names, kind, text))
    return found


def names_in(entries):
    return {name for names, _, _ in entries for name in names if name}


# A module with its functions, or a class with its methods: one test.
HOMES = {name.split(".")[0]: [] for name in PUBLIC}
for _name in PUBLIC:
    HOMES[_name.split(".")[0]].append(_name)


@pytest.mark.parametrize("home", HOMES)
def test_docstrings_name_arguments_and_results(home):
    for name in HOMES[home]:
        thing = PUBLIC[name]
        doc = inspect.getdoc(thing)
        assert doc, f"{name} has no docstring"
        first_line = doc.splitlines()[0]
        assert first_line.endswith((".", ":")), f"{name}: the first line is a sentence"
        if re.search(r"; see `\w+`", first_line):  # where the details are
            continue
        is_class = inspect.isclass(thing)
        is_method = not is_class and "." in name and name.split(".")[-2] not in MODULES
        is_made_by_user = is_class and "Parameters\n---" in doc
        documented = names_in(section(doc, "Parameters"))
        is_function = inspect.isfunction(thing)
        if is_made_by_user or (is_function and (documented or not is_method)):
            taken = {*inspect.signature(thing).parameters} - {"self", "cls"}
            assert documented == taken, name
        if is_class and not is_made_by_user and not issubclass(thing, (Exception, Enum)):
            assert "Attributes\n---" in doc, name
        if is_function and not is_method and doc.startswith("Return"):
            assert section(doc, "Returns"), name


@pytest.mark.parametrize("home", HOMES)
def test_arrays_have_a_shape_and_a_unit(home):
    for name in HOMES[home]:
        doc = inspect.getdoc(PUBLIC[name]) or ""
        for kind in ("Parameters", "Attributes", "Returns"):
            for names, what, text in section(doc, kind):
                check_array(f"{name}, {names or kind}: {what}", {*names}, what, text)


def check_array(entry, names, what, text):
    """Fail if an entry of a docstring holds an array without a shape or a unit."""
    is_array = re.search(r"\b(array|array-like|ndarray|Tensor)\b(?! of Axes)", what)
    if not is_array or re.match(r"(dict|mapping)\b", what):
        return
    assert "shape" in what + text, entry
    is_number = not re.search(r"\b(bool|int|str)\b|Bool|of Axes", what + text)
    if is_number and not names & (OF_THE_ACTUATORS | WITHOUT_UNIT):
        stated = re.search(r"\[.+\]|unit of|As for|as for", text, re.DOTALL)
        assert stated or not names, f"{entry}: {text}"


def test_reference_lists_every_class():
    """Functions and classes of the modules are listed from `__all__` by the pages' template."""
    text = (DOCS / "reference" / "api.rst").read_text(encoding="utf-8")
    for name, thing in PUBLIC.items():
        if inspect.isclass(thing):
            home = name.split(".")[0]
            listed = re.search(rf"^   (app\.)?{home}(\.\w+)?$", text, re.MULTILINE)
            assert listed, name
