"""C code of a model for a controller: the needed kernels and the numbers, in one file."""

from __future__ import annotations

import copy
import math
import re
import shutil
import subprocess
import tempfile
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, Protocol, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.files import write_files
from hybridkin._core.kernel_numbers import IK_LIMITED, c_header
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.rotations import rotation
from hybridkin._core.stored import Stored
from hybridkin._core.version import __version__

_FOLDER = Path(__file__).parent
ABOUT_Q = "q in metres, or in radians for revolute joints, as in the model."
_REAL = {"float64": "double", "float32": "float"}
# of the test, relative to the largest numbers.
_TOLERANCE = {
    "float64": 1e-8,
    "float32": 2e-3,
}
# Buffers with the middle and the half width of the training rows of a learned part.
_RANGES = (
    ("input_center", "input_scale"),
    ("center", "scale"),
    ("center", "half_width"),
)
_SIZES = dict(N="actuators", S="segments", M="outputs", F="features", P="powers")
_SIZES["R"] = "rows of a task"
_NO_LIMITS = np.array([[-math.inf], [math.inf], [math.inf], [math.inf]])
_MOST_STACK = 56 * 1024  # bytes to compute in; small arrays come on top
# steps per run of the test; memory in periods
_STEPS = 4
_MEMORY = 5.0
_ABOUT_POSES = (
    "desired pose now, a homogeneous (4, 4) matrix, row by row [m]; one that holds no rotation "
    "counts as NaN;"
)
_ABOUT_SPACES = (
    " For the half-spaces of the tip it solves at most 11 times, usually once."
)
# Operations of a node with `a` numbers, n inputs and m outputs, in a model with S segments.
_OPERATIONS = {
    "arcs": lambda a, n, m, S: 8 * a + 210 * S + 25 * S * S,
    "elastic": lambda a, n, m, S: (
        (8 + 2 ** min(n, 12)) * (200 * S + 40 * n) + 25 * (S + 14) * S
    ),
    "rigid": lambda a, n, m, S: 10 * (a - 9) + 15 * n,  # the tip does not turn
    "hybrid": lambda a, n, m, S: (
        a * (25 * (S + 12) * S + 18 * S * n + 10 * m * (n + 2))
    ),
}


@runtime_checkable
class _Controller(Protocol):
    settings: Any

    def stored(self) -> Stored: ...
    def tracker(self, q0: object, *, memory: float | None = None) -> Any: ...


def export_c(
    model: object,
    folder: str | Path,
    *,
    name: str = "model",
    dtype: str = "float64",
    about_q: str = ABOUT_Q,
) -> list[Path]:
    """Write a model or inverse kinematics as C99 code for a controller; return the files.

    The code needs only math.h, allocates no memory, and every loop has a fixed bound.

    Parameters
    ----------
    model : ForwardModel, fitted HybridForwardModel or ELMRegressor, or InverseKinematics
        The model to write. For inverse kinematics the model and one step are written. The play of
        a hybrid is not written: the code takes q after play.
    folder : str or Path
        Output folder. Files of an earlier export are replaced, other files are not.
    name : str, default="model"
        Name of the files and prefix of all functions.
    dtype : {"float64", "float32"}, default="float64"
        Floating-point type of the code.
    about_q : str
        Unit and sign of q in sentences, for README.md and the header.

    Returns
    -------
    list of Path
        The header, source, test, CMakeLists.txt and README.md.

    Raises
    ------
    NoKernel
        If a part of the model cannot be written; the message names it. A ValueError.
    FileExistsError
        If the folder has a file with one of these names that hybridkin did not write.

    Examples
    --------
    >>> import tempfile
    >>> from hybridkin import native, robots
    >>> folder = tempfile.mkdtemp()
    >>> paths = native.export_c(robots.bionic_handling_assistant(), folder, name="trunk")
    >>> [path.name for path in paths]
    ['trunk.h', 'trunk.c', 'trunk_test.c', 'CMakeLists.txt', 'README.md']
    """
    project = c_project(model, name=name, dtype=dtype, about_q=about_q)
    texts = dict(project.texts)
    paths = [Path(folder) / file for file in (*texts, "README.md")]
    for path in paths:
        if path.exists() and "hybridkin" not in path.read_text(errors="replace"):
            raise FileExistsError(
                f"`folder` has a {path.name} of another origin; use another."
            )
    measured = _measured(f"{name}.c", texts)
    texts["README.md"] = filled("README.md", {**project.entries, "MEASURED": measured})
    write_files(
        folder,
        {file: partial(Path.write_text, data=text) for file, text in texts.items()},
    )
    return paths


class CProject(NamedTuple):
    """A model, or one step of inverse kinematics, in C.

    Attributes
    ----------
    controller : InverseKinematics or None
        What the step is of.
    plan : Plan
        The numbers.
    home : ndarray of shape (n,)
        A typical q, within the limits.
    entries : dict
        What templates are filled with.
    texts : dict
        Header, source, test and CMakeLists.txt by the name of the file.
    """

    controller: _Controller | None
    plan: Plan
    home: NDArray
    entries: dict[str, Any]
    texts: dict[str, str]

    @property
    def limits(self) -> NDArray:
        """Limits q_min, q_max, dq_max and ddq_max of a step, shape (4, n)."""
        return _limits(self.plan)[0]

    @property
    def gains(self) -> tuple[float, float, float]:
        """Gain (negative: 1 / period), beta [1/s] and period [s] of a step."""
        n = self.plan.n_inputs
        (gain, beta, dt) = self.plan.data[self.plan.begin(self.plan.root) + 6 * n :][:3]
        return float(gain), float(beta), float(dt)


def c_project(
    model: object,
    *,
    name: str = "model",
    dtype: str = "float64",
    about_q: str = ABOUT_Q,
) -> CProject:
    """Return a model or inverse kinematics in C, see `export_c`, without writing files."""
    if dtype not in _REAL:
        raise ValueError(f'`dtype` must be "float64" or "float32", got {dtype!r}.')
    if not re.fullmatch(r"[A-Za-z]\w*", name, re.ASCII):
        raise ValueError(
            f"`name` must be a valid name in C, e.g. trunk_3, got {name!r}."
        )
    controller = model if isinstance(model, _Controller) else None
    if controller:
        modules = [*controller.settings.task.steered]
    else:
        modules = [as_forward_model(model)]
    try:
        plan = Plan((controller or modules[0]).stored())
        _check_stack(plan, dtype)
    except (NoKernel, TypeError) as error:
        way = "use it from Python, or a model and a task that have kernels"
        raise NoKernel(f"`model` cannot be written in C: {error}; {way}.") from None
    sources = {
        f"{name}.h": "model.h",
        f"{name}.c": "model.c",
        f"{name}_test.c": "check.c",
    }
    sources["CMakeLists.txt"] = "CMakeLists.txt"
    entries = {
        **dict(
            NAME=name,
            GUARD=name.upper(),
            TITLE=type(model).__name__,
            VERSION=__version__,
        ),
        "ABOUT_Q": about_q.replace("*/", "* /"),
        **dict(REAL=_REAL[dtype], N=plan.n_inputs, TOL=_TOLERANCE[dtype]),
        **_code(plan, controller, dtype),
        **_vectors(modules, plan, controller, dtype),
    }
    parts = dict(
        STEP_H="step.h", STEP_C="step.c", TICKS="ticks.c", STEP_README="step.md"
    )
    for key, template in parts.items():
        entries[key] = "" if controller is None else filled(template, entries)

    texts = {file: filled(template, entries) for file, template in sources.items()}
    home = _middle(modules[0], plan, controller)[0].astype(dtype).astype(float)
    return CProject(controller, plan, home, entries, texts)


def filled(template: str, entries: dict[str, Any]) -> str:
    """Return the text of a template with its entries."""
    text = _with_headers(_FOLDER / "templates" / template)
    return re.sub(r"@(\w+)@", lambda found: str(entries[found[1]]), text)


def _with_headers(path: Path) -> str:
    """Return the text of a file with the kernel headers inserted."""
    if path.name == "kinds.h":
        return c_header()
    return re.sub(
        r'(?m)^#include "(\w+\.h)"$',
        lambda found: _with_headers(_FOLDER / "src" / found[1]),
        path.read_text(),
    )


def _code(plan: Plan, controller: _Controller | None, dtype: str) -> dict[str, Any]:
    """Return sizes and numbers of a plan as C, and the entries of README.md about them."""
    at = plan.root if controller is None else plan.entry(plan.root, 0)
    task = None if controller is None else controller.settings.task
    pose = task is not None and task.shape == (4, 4)
    spaces = 0 if task is None else plan.entry(plan.root, 3)
    # gcc warns about arrays of length 1 if it cannot see that loops over them run at all.
    sizes = {f"MAX_{s}": max(plan.largest[what], 2) for s, what in _SIZES.items()}
    kinds = sum(1 << kind for kind in {*plan.code[plan.places].tolist()})
    lines = [
        f"#define HK_{a} {number}"
        for a, number in {
            **sizes,
            "KINDS": f"{kinds}u",
            "POSES": int(pose),
            "SPACES": int(spaces > 0),
        }.items()
    ]
    fields = {
        "DEFINES": "\n".join(["#define HK_FLOAT"] * (dtype == "float32") + lines),
        "CODE": literals(plan.code),
        "DATA": literals(plan.data.astype(dtype)),
        **dict(M=plan.lengths(at)[1], MODEL=at, ROOT=plan.root, CALL="forward(q, x)"),
        "BYTES": len(plan.data) * (8 if dtype == "float64" else 4) + 4 * len(plan.code),
        "OPERATIONS": f"{_operations(plan):,}",
    }
    if task is not None:
        limits, dt = _limits(plan)
        words = (", ".join(f"{v:.6g}" for v in row) for row in limits)
        fields |= zip(("Q_MIN", "Q_MAX", "DQ_MAX", "DDQ_MAX"), words, strict=True)
        fields |= {"DT": dt, "CALL": "step(&state, target, NULL, NULL)"}
        sentence = "limits.md" if np.isfinite(limits).any() else "no_limits.md"
        fields["LIMITS"] = filled(sentence, fields)
        m = plan.n_outputs
        fields["NEWTON"] = (
            f"{10 * plan.n_inputs**2 + (20 + 7 * m * m) * plan.n_inputs:,}"
        )
        fields |= {"TASK": m, "WIDTH": math.prod(task.shape)}
        fields["NORMALS"] = plan.entry(plan.root, 2)
        fields["ABOUT_TARGET"] = _ABOUT_POSES if pose else "desired x now [m];"
        fields["SPACES"] = _ABOUT_SPACES if spaces else ""
    return fields


def _check_stack(plan: Plan, dtype: str) -> None:
    """Raise if the code would need more than 64 KiB of stack; bounds the HK_MODEL_WORK of src."""
    n, segments, m, features, powers, rows = plan.code[:6].tolist()
    numbers = (
        2 * (features + powers)
        + max(n, 3 * segments, m) * (n + 41)
        + 200 * segments
        + 30
        + (8 * (rows + 1) * (n + 12) if rows else 0)
    )
    if numbers * np.dtype(dtype).itemsize > _MOST_STACK:
        raise NoKernel(
            "its sizes need more than 64 KiB of stack, too much for a controller"
        )


def _operations(plan: Plan) -> int:
    """Return the approximate largest number of operations for x and J."""
    ends = [plan.begin(place) for place in plan.places[1:]]
    work = 0
    for place, end in zip(plan.places, [*ends, len(plan.data)], strict=True):
        n, m = plan.lengths(place)
        count = end - plan.begin(place)
        kind = plan.kind(place)
        if kind in _OPERATIONS:
            work += _OPERATIONS[kind](count, n, m, plan.largest["segments"])
        else:  # learned parts use each number once for x, and at most m times for J
            work += 2 * (m + 1) * count
    return work


def _limits(plan: Plan) -> tuple[NDArray, float]:
    """Return q_min, q_max, dq_max, ddq_max, shape (4, n), and the period of inverse kinematics.

    What a step does not keep is infinite.
    """
    n = plan.n_inputs
    numbers = plan.data[plan.begin(plan.root) :]
    limits = numbers[: 4 * n].reshape(4, n)
    if not plan.entry(plan.root, 1) & IK_LIMITED:
        limits = np.repeat(_NO_LIMITS, n, axis=1)
    return limits, float(numbers[6 * n + 2])


def literals(values: NDArray) -> str:
    """Return numbers as the entries of a C array."""
    single = "f" if values.dtype == np.float32 else ""
    cast = "" if single else "(double)"
    special = {
        "inf": f"{cast}INFINITY",
        "-inf": f"-{cast}INFINITY",
        "nan": f"{cast}NAN",
    }
    words = [special.get(word, word + single) for word in map(str, values.ravel())]
    lines = (", ".join(words[i : i + 6]) for i in range(0, len(words), 6))
    return "\n    " + ",\n    ".join(lines) + ",\n"


def _middle(
    module: ForwardModel, plan: Plan, controller: _Controller | None
) -> tuple[NDArray, NDArray]:
    """Return the middle and half the width of usual q: between the limits, or of the model."""
    if controller is not None and np.isfinite(_limits(plan)[0][:2]).all():
        low, high, *_ = _limits(plan)[0]
        return 0.5 * (low + high), 0.5 * (high - low)
    return _usual(module, plan.n_inputs)


def _vectors(
    modules: list[ForwardModel], plan: Plan, controller: _Controller | None, dtype: str
) -> dict[str, Any]:
    """Return the data of the test: inputs, and the outputs that torch computes."""
    doubles = [copy.deepcopy(module).double() for module in modules]
    rng = np.random.default_rng(0)
    center, half = _middle(modules[0], plan, controller)
    # Eight usual rows, then rows at growing distance from the center; the last one is NaN.
    far = np.concatenate(
        [np.linspace(0.0, 0.7, 8), np.linspace(0.8, 5.0, 8), [math.nan]]
    )
    rows = center + half * far[:, None] * rng.uniform(-1.0, 1.0, (17, len(half)))
    rows = rows.astype(dtype)
    with torch.no_grad():
        at = torch.from_numpy(rows.astype(float))
        pairs = [double.forward_and_jacobian(at) for double in doubles]
        x = torch.cat([x for x, _ in pairs], dim=1).numpy()
        J = torch.cat([J for _, J in pairs], dim=1).numpy()
        distances = [double.domain_distance(at).numpy() for double in doubles]
    distance = np.max(distances, axis=0)
    arrays = {"Q": rows, "X": x, "J": J, "DISTANCE": distance, "HOME": rows[0]}
    fields = {f"{key}_SCALE": float(np.nanmax(abs(a[:8]))) for key, a in arrays.items()}
    if controller is not None:
        runs, fields["COMPARED"] = _runs(controller, plan, rows[:8], dtype)
        arrays |= runs
        fields |= {"STEPS": _STEPS, "MEMORY": _MEMORY * _limits(plan)[1]}
    return {
        "ROWS": len(rows),
        **fields,
        **{key: literals(a) for key, a in arrays.items()},
    }


def _usual(module: ForwardModel, n: int) -> tuple[NDArray, NDArray]:
    """Return the middle and half width of q: of the training rows, else from the radii."""
    buffers = {name.rpartition(".")[2]: a.numpy() for name, a in module.named_buffers()}
    for pair in _RANGES:
        center, half = (buffers.get(name, np.empty(0)) for name in pair)
        if center.shape == half.shape == (n,):
            return center, half
    radii = buffers.get("radii", np.full(1, 2.0))
    gains = buffers.get("gains", np.ones(n))
    extensible = "gains" in buffers and "lengths" not in buffers
    middle = (3.0 * radii.mean() if extensible else 0.0) / gains
    return middle + buffers.get("actuator_zeros", 0.0), 0.5 * radii.min() / np.abs(
        gains
    )


def _runs(
    controller: _Controller, plan: Plan, starts: NDArray, dtype: str
) -> tuple[dict[str, NDArray], int]:
    """Return runs of steps that start inside the limits and at them, and how many to compare."""
    rng = np.random.default_rng(1)
    (low, high, *_), dt = _limits(plan)
    low = low.astype(dtype)
    high = high.astype(dtype)
    starts = starts.clip(low, high)
    starts[4:, ::2] = np.where(np.isfinite(high), high, starts[4:])[:, ::2]
    # Short steps in single precision: at limits and in weak directions its steps can differ.
    far = np.array([0.2, 0.1, 0.01] if dtype == "float64" else [1e-4, 1e-3, 1e-4])
    task = controller.settings.task
    with torch.no_grad():
        here = task.evaluate(torch.from_numpy(starts.astype(float)))[0].numpy()
    size = np.ptp(_positions(task, here), axis=0)
    target, measured = (
        _beside(task, here, share * size, rng).astype(dtype) for share in far[[0, 2]]
    )
    rows = rng.standard_normal((8, _STEPS, plan.n_outputs))
    dx = (far[1] * size.mean() * rows).astype(dtype)
    measured[:, 2] = math.nan  # no measurement
    fields = []
    healthy = 8 if dtype == "float64" else 4  # runs whose steps are compared
    for run_number, (q, *run) in enumerate(
        zip(starts, target, dx, measured, strict=True)
    ):
        tracker = controller.tracker(
            torch.from_numpy(q.astype(float)), memory=_MEMORY * dt
        )
        for i, rows in enumerate(zip(*run, strict=True)):
            goal, speed, tip = (torch.from_numpy(a.astype(float)) for a in rows)
            reading = tip if i < _STEPS - 1 else None  # as in the template
            q = tracker.step(goal, speed, x_measured=reading).numpy()
            fields.append([*q, tracker.sigma_min**2])
            if dtype == "float32" and tracker.damping > 0.0:
                healthy = min(healthy, run_number)  # weak directions
    command, squares = np.split(np.array(fields), [plan.n_inputs], axis=1)
    fields = {
        "STARTS": starts,
        "LOW": low,
        "HIGH": high,
        "COMMAND": command,
        "SIGMA_SQ": squares,
    }
    fields |= {"TARGET": target, "DX": dx, "MEASURED_TIPS": measured}
    return fields, healthy


def _positions(task: Any, x: NDArray) -> NDArray:
    """Return the positions (N, ..., 3) in points or poses of a task (N, ...)."""
    return x[:, :3, 3] if task.shape == (4, 4) else x


def _beside(task: Any, x: NDArray, size: NDArray, rng: np.random.Generator) -> NDArray:
    """Return points or poses (N, steps, ...) beside those of a task, turned by up to 0.1 rad."""
    beside = np.repeat(x[:, None], _STEPS, axis=1)
    change = rng.standard_normal((*beside.shape[:2], *size.shape)) * size
    if task.shape != (4, 4):
        return beside + change
    beside[..., :3, 3] += change
    turns = torch.from_numpy(0.1 * change / max(np.abs(change).max(), 1e-9))
    beside[..., :3, :3] = rotation(turns)[0].numpy() @ beside[..., :3, :3]
    return beside


def _measured(source: str, texts: dict[str, str]) -> str:
    """Return the size of the code and of its stack, measured by the compiler of this machine."""
    if shutil.which("cc") and shutil.which("size"):
        with (
            suppress(OSError),
            tempfile.TemporaryDirectory() as home,
        ):  # the disk may be full
            for name, text in texts.items():
                Path(home, name).write_text(text)
            built = Path(home) / "a.o"
            usage = Path(home) / "a.su"
            options = [
                "-std=c99",
                "-Os",
                "-fstack-usage",
                "-c",
                Path(home, source),
                "-o",
                built,
            ]
            done = subprocess.run(["cc", *options], capture_output=True)
            if done.returncode == 0 and usage.exists():
                stack = sum(
                    int(line.split("\t")[1]) for line in usage.read_text().splitlines()
                )
                text = subprocess.check_output(["size", built], text=True).split()[6]
                return f"{text} and {stack} bytes on the machine of the export, with `cc -Os`"
    return "not measured: the machine of the export had no C compiler"
