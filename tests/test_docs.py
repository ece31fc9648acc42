"""The pages can be reached, their code runs, and every public name says what it takes and gives."""

import inspect
import re
import runpy
import shlex
import sys
import textwrap
from enum import Enum
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
import pytest
import torch

import hybridkin
from hybridkin import ForwardModel, app, load_model, robots
from hybridkin.app.cli.main import main

DOCS = Path(__file__).parent.parent / "docs"
PAGES = sorted(DOCS.glob("*.md"))
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


def blocks(page, language):
    text = (DOCS / page).read_text(encoding="utf-8")
    found = re.findall(rf"^ *```{language}\n(.*?)```", text, re.DOTALL | re.MULTILINE)
    return [textwrap.dedent(block) for block in found]


def test_every_page_is_in_the_table_of_contents():
    listed = {line for block in blocks("index.md", r"\{toctree\}") for line in block.splitlines()}
    pages = {page.stem for page in PAGES} - {"index"} | {"api"}
    assert pages <= listed
    assert {name for name in listed if name and ":" not in name} - pages == {"gallery/index"}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    examples = {f"gallery/{p.stem}.rst" for p in DOCS.parent.glob("examples/plot_*.py")}
    for link in re.findall(r"\]\(([^)\s]+)\)", page.read_text(encoding="utf-8")):
        if link.startswith("http"):
            continue
        name, _, heading = link.partition("#")
        assert not name or (DOCS / name).is_file() or name in {*examples, "gallery/index.rst"}, link
        if heading:
            headings = re.findall(r"^#+ (.*)$", (DOCS / (name or page.name)).read_text(), re.M)
            assert heading in {h.lower().replace(" ", "-").replace("'", "") for h in headings}, link


def test_equations_are_numbered_as_they_come():
    text = (DOCS / "theory.md").read_text(encoding="utf-8")
    numbers = [int(n) for n in re.findall(r"^\$\$ .* \$\$ \((\d+)\)$", text, re.MULTILINE)]
    assert numbers == list(range(1, len(numbers) + 1))
    assert len(numbers) > 20
    outside = re.sub(r"\$\$.*?\$\$ \(\d+\)", "", text)
    assert {int(n) for n in re.findall(r"(?<=[\s~])\((\d{1,2})\)", outside)} <= {*numbers}


@pytest.mark.slow
@pytest.mark.parametrize(
    "page", ["getting_started.md", "your_robot.md", "rigid_arms.md", "next_rows.md"]
)
def test_code_of_a_page_runs_as_printed(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for block in blocks(page, "toml"):
        Path("robot.toml").write_text(block, encoding="utf-8")
    space = {}
    for block in blocks(page, "python"):
        exec(compile(block, page, "exec"), space)
    if page == "your_robot.md":
        errors = dict(re.findall(r"(\w+): mean ([\d.]+) mm", capsys.readouterr().out))
        assert float(errors["hybrid"]) < 0.6 * float(errors["mechanical"])
        assert len(Path("commands.csv").read_text().splitlines()) == len(space["path"].x)
    if page == "rigid_arms.md":
        assert "q_max=1.5 to 2 of the model, dq_max=3 to 4 of the model" in capsys.readouterr().out
        assert "<!-- measured in May -->" in Path("calibrated.urdf").read_text()
        assert space["result"].rmse < 2.5e-4


@pytest.mark.parametrize("page", sorted(path.name for path in DOCS.glob("*.md")))
def test_code_of_every_page_is_python(page):
    for block in blocks(page, "python"):
        compile(block, page, "exec")


@pytest.mark.slow
def test_models_of_the_page_on_the_inside_run_as_printed(capsys):
    mechanical, error, writer, layout = blocks("how_it_works.md", "python")
    space = {}
    exec(compile(mechanical, "how_it_works.md", "exec"), space)
    printed = capsys.readouterr().out
    assert "boom 1.045 m" in printed
    assert "[ True  True  True  True  True]" in printed
    crane = space["chain"]
    q = torch.tensor([[0.1, 0.5, 0.2], [-0.3, 0.9, 0.3]], dtype=torch.float64)
    assert torch.autograd.gradcheck(crane, q.requires_grad_())
    exec(compile(error, "how_it_works.md", "exec"), space)
    assert float(capsys.readouterr().out.split()[0]) < 12.5
    waves = space["model"].error_model_.module_
    q = torch.from_numpy(space["data"].q[:2])
    x, J = ForwardModel.forward_and_jacobian(waves, q)
    torch.testing.assert_close(waves.forward_and_jacobian(q), (x, J))
    exec(
        compile(writer + "from hybridkin._core.stored import Layout\n" + layout, "", "exec"), space
    )
    assert space["layout"].write_plan is space["write_plan"]


@pytest.mark.slow
def test_code_of_the_learners_page_runs_as_printed(capsys):
    exec(compile(blocks("elm.md", "python")[0], "elm.md", "exec"), {})
    new_rows, left_out = map(float, capsys.readouterr().out.split()[:2])
    assert new_rows < 0.6  # against the truth without noise
    assert 0.9 < left_out < 1.2  # the noise is 1


@pytest.mark.slow
def test_the_stream_of_the_learners_page_learns_a_folder_of_parquet(tmp_path, monkeypatch):
    pytest.importorskip("pyarrow")
    monkeypatch.chdir(tmp_path)
    Path("night").mkdir()
    rng = np.random.default_rng(0)
    chain = robots.bionic_handling_assistant()

    def log(n_rows):
        q = rng.uniform(0.2, 0.25, (n_rows, 9))
        x = chain(torch.from_numpy(q)).numpy()
        return q, x + np.array([0.01, 0.0, 0.0]) + 0.05 * x * x[:, 2:]

    for number in range(4):
        q, x = log(4000)
        table = pd.DataFrame(np.hstack([q, x]), columns=[*(f"q{i}" for i in range(9)), *"xyz"])
        table.astype(np.float32).to_parquet(f"night/{number}.parquet")
    space = {}
    exec(compile(blocks("elm.md", "python")[1], "elm.md", "exec"), space)
    assert space["network"].n_samples_seen_ == 12000  # the first file is held out
    q, x = log(500)
    loaded = load_model("night.safetensors")
    error = np.linalg.norm(loaded.predict(q) - x, axis=1).mean()
    mechanical = np.linalg.norm(loaded.predict_mechanical(q) - x, axis=1).mean()
    assert error < 0.3 * mechanical
    assert loaded.in_domain(q).mean() > 0.8


@pytest.mark.slow
def test_commands_of_two_minutes_at_the_robot_run(tmp_path, monkeypatch, capsys):
    """Those up to the fit, which is done without auto."""
    pytest.importorskip("mujoco", reason='needs MuJoCo: pip install "hybridkin[sim]"')
    studies = DOCS.parent / "examples" / "studies"
    monkeypatch.setattr(sys, "path", [*sys.path, str(studies)])
    monkeypatch.chdir(tmp_path)
    lines = "".join(blocks("two_minutes.md", "console")).splitlines()
    describe, plan, measure, fit = (shlex.split(line) for line in lines[:4])
    assert main(describe[1:]) == 0
    robot = Path("trunk.toml")
    geometry, _, _ = robot.read_text(encoding="utf-8").partition("[limits]")
    robot.write_text(geometry + blocks("two_minutes.md", "toml")[0], encoding="utf-8")
    assert main(plan[1:]) == 0
    runpy.run_path(str(DOCS.parent / measure[1]))["main"](measure[2:])
    assert main([*fit[1:], "--folds", "2", "--jobs", "1", "--no-auto"]) == 0
    assert "25 rows" in capsys.readouterr().out
    assert Path("model/model.safetensors").is_file()


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
    text = (DOCS / "api.rst").read_text(encoding="utf-8")
    for name, thing in PUBLIC.items():
        if inspect.isclass(thing):
            home = name.split(".")[0]
            listed = re.search(rf"^   (app\.)?{home}(\.\w+)?$", text, re.MULTILINE)
            assert listed, name


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")
