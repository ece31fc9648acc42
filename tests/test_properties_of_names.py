"""Every public function and method is among the entry points that property tests examine."""

import inspect
import re
from pathlib import Path
from types import ModuleType

import pytest

import hybridkin

TEXT = "\n".join(
    path.read_text(encoding="utf-8")
    for path in sorted(Path(__file__).parent.glob("**/*.py"))
    if path.stem.startswith(("test_properties", "mechanical_models")) and path != Path(__file__)
)
# What only holds results, is made for other code than a user's, or is examined elsewhere.
ELSEWHERE = {
    # what saving, calibration and serial coupling call of a chain or a hybrid
    *("coordinates", "from_coordinates", "from_coordinates_and_jacobian", "from_stored", "stored"),
    *(
        "far_messages",
        "unit_messages",
        "plausible_rows",
        "frames_and_moves",
        "up_to_tip",
        "up_to_markers",
        "offsets_to_markers",
        "by_arcs",
        "by_offsets",
        "forces",
        "tips",
        "extra_repr",
    ),
    "with_geometry",
    # threads and rubbish: tests/viewer
    *("view", "follow", "go_to", "close", "wait"),
    # files: hostile ones are an examination of their own
    *("from_urdf", "from_mjcf", "to_urdf", "load_armlab", "load_asl_trunk", "load_ftdcr"),
    *("load_asu_bellows", "load_soromox_tentacle"),
    # arguments go to matplotlib, or are dictionaries and sentences
    *("new_figure", "lines", "caption", "save", "figure", "table", "text", "file", "markdown"),
    *(
        "plain",
        "write",
        "json",
        "verbatim",
        "check_columns",
        "commands",
        "geometry",
        "errors",
        "accepting",
        "summary",
        "to_dict",
        "html_rows",
    ),
    # of numbers that a description has checked; of rows as NumPy indexes them
    *(
        "available",
        "backend",
        "intersect",
        "narrowed",
        "scaled",
        "rows",
        "thinned",
        "check_order",
        "misread",
        "log_format",
    ),
    "load_trunk",
    "tip_transform",
    *("reset", "animate_track", "export_model"),
    "was_fitted",
    # what a solver calls of its task; the rest by tests of its own
    *("check", "difference", "distances", "evaluate", "frozen", "present", "reached"),
    *("longest", "misses"),  # of a robot: bounds of its reach
    *("promised_errors", "plane_in_words"),  # of a file of a fit, in tests of the workflow
    *("predict_and_jacobian", "score", "set_params", "follow"),
    *("export_c", "export_fmu", "export_mex"),
}


def public():
    """Yield every public name, and of classes their methods."""
    for name in hybridkin.__all__:
        value = getattr(hybridkin, name)
        if isinstance(value, ModuleType):
            own = [
                n for n, v in vars(value).items() if getattr(v, "__module__", 0) == value.__name__
            ]
            for inner in getattr(value, "__all__", own):
                yield inner, getattr(value, inner)
        else:
            yield name, value


def examined(word):
    return word in ELSEWHERE or re.search(rf"\b{word}\b", TEXT) is not None


NAMES = [(name, value) for name, value in public() if callable(value) and name[0] != "_"]


@pytest.mark.parametrize(("name", "value"), NAMES, ids=[name for name, _ in NAMES])
def test_a_public_name_is_examined(name, value):
    if inspect.isclass(value):
        methods = inspect.getmembers(value, inspect.isroutine)
        ours = [
            m
            for m, f in methods
            if m[0] != "_" and str(getattr(f, "__module__", "")).startswith("hybridkin")
        ]
        missing = [f"{name}.{method}" for method in ours if not examined(method)]
    else:
        missing = [] if examined(name) else [name]
    assert not missing, "write a property test of these"
