import ast
import subprocess
import sys
from pathlib import Path

import pytest

import hybridkin

ROOT = Path(hybridkin.__file__).parent
ROOMS = sorted(path for path in ROOT.rglob("*.py"))
# Each room may import from rooms further down only.
ORDER = [
    "__main__",
    "_cli",
    "_cli_text",
    "experiments",
    "persistence",
    "_model_parts",
    "_model_files",
    "hybrid",
    "_auto",
    "_hybrid_settings",
    "_play_of",
    "_couplings",
    "_pose_hybrid",
    "_hybrid_modules",
    "_drift",
    "_error_modules",
    "_radius",
    "guards",
    "_serial_fit",
    "_serial",
    "_linearised",
    "_pose_features",
    "_features",
    "play",
    "calibration",
    "_starts",
    "_open_directions",
    "_least_squares",
    "_parameters",
    "ik",
    "_realtime",
    "_tracking",
    "_implicit",
    "_search",
    "_law",
    "tasks",
    "_box",
    "robots",
    "chain",
    "tendons",
    "rigid",
    "_arm_files",
    "_slack",
    "_arc_chain",
    "_arcs",
    "_geometry",
    "elm_cv",
    "_left_out",
    "elm",
    "_readout",
    "_network",
    "_outcomes",
    "_arrays",
    "_solvers",
    "_numerics",
    "plots",
    "datasets",
    "simulation",
    "trajectories",
]


def room_of(path):
    parts = path.relative_to(ROOT).with_suffix("").parts
    return parts[0]


def imported_rooms(path):
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module:
            parts = node.module.split(".")
            if parts[0] == "hybridkin":
                found |= {parts[1]} if len(parts) > 1 else {alias.name for alias in node.names}
    return found & set(ORDER)


@pytest.mark.parametrize("path", ROOMS, ids=[str(p.relative_to(ROOT)) for p in ROOMS])
def test_imports_run_one_way(path):
    room = room_of(path)
    if room == "__init__":
        return
    assert room in ORDER, f"say where {room} stands"
    lower = ORDER[ORDER.index(room) :]
    assert imported_rooms(path) <= set(lower)


def test_ground_rooms_stand_alone():
    allowed = {"plots": {"plots"}, "trajectories": set(), "elm": {"_network", "_readout"}}
    allowed["chain"] = {"_arc_chain", "_arcs", "_geometry", "_numerics"}
    for room, lower in allowed.items():
        files = [path for path in ROOMS if room_of(path) == room]
        assert files
        assert set().union(*map(imported_rooms, files)) <= lower


def test_only_plots_uses_matplotlib_and_only_the_command_line_prints():
    for path in ROOMS:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                names = [alias.name for alias in node.names]
                names.append(getattr(node, "module", None) or "")
                if any(name.split(".")[0] == "matplotlib" for name in names):
                    assert room_of(path) == "plots"
            if isinstance(node, ast.Call) and getattr(node.func, "id", "") == "print":
                assert room_of(path) == "__main__"


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
