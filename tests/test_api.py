import ast
import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hybridkin
import hybridkin.app

ROOT = Path(hybridkin.__file__).parent
FILES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT)
# A folder may import from folders further down only; those on one line do not know each other.
FLOORS = [
    {"app.cli"},
    {"app.viewer"},
    {"app.workflow"},
    {"app.checks"},
    {"app"},
    {"arguments", "formats", "rotations"},
    {"saving"},
    {"hybrid"},
    {"hysteresis"},
    {"calibration"},
    {"chains", "learning", "ik"},
    {"native"},
    {"_core", "datasets", "plots"},
]
PUBLIC_FOLDER_OF = {
    name: module.split(".")[0] for module, names in hybridkin._NAMES_OF.items() for name in names
} | {name: folder.strip(".") or name for name, folder in hybridkin._FOLDER_OF.items()}
BESIDE = {
    "app": {"app.workflow", "app.checks", "app.viewer"},
    "datasets": {"_core", "chains"},
    "plots": {"_core", "chains"},
    "_core": set(),
}


def folder_of(path):
    parts = path.relative_to(ROOT).parts
    return ".".join(parts[:2]) if parts[0] == "app" and len(parts) > 2 else parts[0]


def folder_named(module):
    """Return the folder of a module of the package."""
    parts = module.split(".")[1:]
    return ".".join(parts[:2]) if parts[0] == "app" else parts[0]


def imports_of(path):
    """Yield (module, names) of every import, those for type checkers and in functions too."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from ((alias.name, []) for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"{path}: relative imports hide where they lead"
            names = [alias.name for alias in node.names]
            yield node.module, names


def imported_folders(path):
    found = set()
    for module, names in imports_of(path):
        if module == "hybridkin":
            found |= {PUBLIC_FOLDER_OF.get(name, name) for name in names}
        elif module == "hybridkin.app":
            found |= {f"app.{hybridkin.app._MODULE_OF.get(name, name)}" for name in names}
        elif module.startswith("hybridkin."):
            found.add(folder_named(module))
    return found


@pytest.mark.slow
@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_imports_run_one_way(path):
    folder = folder_of(path)
    (floor,) = [k for k, folders in enumerate(FLOORS) if folder in folders]
    allowed = BESIDE.get(folder, set().union(*FLOORS[floor + 1 :])) | {folder, "__version__"}
    assert imported_folders(path) <= allowed


@pytest.mark.parametrize("path", FILES, ids=[str(p.relative_to(ROOT)) for p in FILES])
def test_modules_with_an_underscore_are_their_folders_own(path):
    for module, names in imports_of(path):
        if module.startswith("hybridkin.") and folder_named(module) != folder_of(path):
            names_within = module.split(".")[2:] + names
            assert not any(re.match("_[^_]", name) for name in names_within), module


API = (ROOT.parent / "docs/reference/api.rst").read_text(encoding="utf-8")
DOCUMENTED = {*re.findall(r"^   (\w[\w.]*)$", API, flags=re.MULTILINE)}


def is_public(module, name):
    """Return whether the API page lists a name, or the module that has it in its `__all__`."""
    if module == "hybridkin":
        return name in hybridkin.__all__
    path = module.removeprefix("hybridkin.")
    if not {path, f"{path}.{name}"} & DOCUMENTED:
        return False
    return name in importlib.import_module(module).__all__


@pytest.mark.parametrize(
    "path",
    [path for path in FILES if folder_of(path).startswith("app")],
    ids=lambda path: str(path.relative_to(ROOT)),
)
def test_the_application_imports_public_names_only(path):
    for module, names in imports_of(path):
        if module.split(".")[0] != "hybridkin" or module.startswith("hybridkin.app"):
            continue
        inside = {name for name in names if not is_public(module, name)}
        assert not inside - {"app"}, f"{module}: {inside}"


@pytest.mark.slow
def test_only_plots_uses_matplotlib_and_only_the_command_line_prints():
    for path in FILES:
        assert folder_of(path) == "plots" or not any(
            module.split(".")[0] == "matplotlib" for module, _ in imports_of(path)
        )
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print" or folder_of(path) == "app.cli"


def loaded_by(code):
    """Return the names of all modules that a new process has loaded after this code."""
    code += "; import sys; print(*sys.modules, file=sys.stderr)"
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    return set(done.stderr.split())


ROBOT = Path(__file__).parents[1] / "examples/robots/ftdcr_v4.toml"
HEAVY = {"matplotlib", "pandas", "pytorch_kinematics", "scipy.optimize", "scipy.sparse", "sklearn"}


@pytest.mark.slow
def test_what_needs_no_torch_does_not_load_it():
    assert "torch" not in loaded_by("import hybridkin")
    assert "torch" not in loaded_by("from hybridkin.app.cli._parser import parser; parser()")


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "robot = hybridkin.robots.read_description({robot!r}); robot.chain",
        "hybridkin.ForceTendonChain([0.01], [0.1], 0.02, 100.0)",
        "from hybridkin.app.cli.main import main; main(['describe', {robot!r}])",
    ],
)
def test_a_chain_and_its_description_load_neither_learning_nor_optimisation(code):
    loaded = loaded_by("import hybridkin; " + code.format(robot=str(ROBOT)))
    assert not HEAVY & loaded
    for name in ("hybrid.estimator", "calibration.calibrate", "ik.solver", "app.workflow.compare"):
        assert f"hybridkin.{name}" not in loaded


@pytest.mark.slow
def test_import_is_light():
    code = (
        "import sys, hybridkin; "
        "hybridkin.HybridForwardModel, hybridkin.InverseKinematics, hybridkin.datasets.load_trunk; "
        "heavy = {'matplotlib', 'mujoco', 'pytorch_kinematics'} & set(sys.modules); "
        "sys.exit(str(heavy) if heavy else 0)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_public_names_exist_and_are_documented():
    for name in hybridkin.__all__:
        value = getattr(hybridkin, name)
        if name != "__version__":
            assert value.__doc__, f"{name} has no docstring"
