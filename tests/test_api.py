import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import hybridkin

ROOT = Path(hybridkin.__file__).parent
FILES = sorted(path for path in ROOT.rglob("*.py") if path.parent != ROOT)
# A folder may import from folders further down only; those on one line do not know each other.
FLOORS = [
    {"cli"},
    {"viewer"},
    {"workflow"},
    {"saving"},
    {"hybrid"},
    {"calibration"},
    {"chains", "learning", "ik"},
    {"native"},
    {"_core", "causes", "datasets", "plots"},
]
BESIDE = {
    "causes": {"_core", "chains", "native"},
    "datasets": {"_core", "chains", "causes"},
    "plots": {"_core", "chains"},
    "_core": set(),
}


def folder_of(path):
    return path.relative_to(ROOT).parts[0]


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
        parts = module.split(".")
        if parts[0] == "hybridkin":
            found |= (
                {parts[1]}
                if len(parts) > 1
                else {hybridkin._FOLDER_OF.get(n, n).strip(".") for n in names}
            )
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
        parts = module.split(".")
        if parts[0] == "hybridkin" and len(parts) > 1 and parts[1] != folder_of(path):
            assert not any(re.match("_[^_]", name) for name in (*parts[2:], *names)), module


@pytest.mark.slow
def test_only_plots_uses_matplotlib_and_only_the_command_line_prints():
    for path in FILES:
        assert folder_of(path) == "plots" or not any(
            module.split(".")[0] == "matplotlib" for module, _ in imports_of(path)
        )
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.Call) and isinstance(node.func, ast.Name):
                assert node.func.id != "print" or folder_of(path) == "cli"


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
    assert "torch" not in loaded_by("from hybridkin.cli._parser import parser; parser()")


@pytest.mark.slow
@pytest.mark.parametrize(
    "code",
    [
        "robot = hybridkin.robots.read_description({robot!r}); robot.chain",
        "hybridkin.ForceTendonChain([0.01], [0.1], 0.02, 100.0)",
        "from hybridkin.cli.main import main; main(['describe', {robot!r}])",
    ],
)
def test_a_chain_and_its_description_load_neither_learning_nor_optimisation(code):
    loaded = loaded_by("import hybridkin; " + code.format(robot=str(ROBOT)))
    assert not HEAVY & loaded
    for name in ("hybrid.estimator", "calibration.calibrate", "ik.solver", "workflow.compare"):
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
