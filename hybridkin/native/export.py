"""C code of a model for a controller: the needed kernels and the numbers, in one file."""

from __future__ import annotations

import copy
import math
import re
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import NamedTuple, Protocol, TypeAlias, runtime_checkable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hybridkin._core.files import check_outputs, write_files
from hybridkin._core.kernel_numbers import (
    IK_AGREEING,
    IK_BODY,
    IK_DOUBTS,
    IK_LIMITED,
    IK_MODEL,
    IK_N_MEETING,
    IK_N_NORMALS,
    IK_N_OBSTACLES,
    IK_N_POINTS,
    IK_N_SPACES,
    IK_OBSTACLE,
    IK_PAIRS_MOST,
    IK_RING,
    IK_STAGES,
    IK_STATE_ROWS,
    c_header,
    stages_header,
)
from hybridkin._core.model import ForwardModel, as_forward_model
from hybridkin._core.named_rows import without_warnings
from hybridkin._core.plan import NoKernel, Plan
from hybridkin._core.texts import c_comment, markdown
from hybridkin._core.version import __version__
from hybridkin.native._words import class_in_words, limits_in_words

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
_SIZES = dict(N="actuators", S="segments", M="outputs", F="features")
_SIZES["R"] = "rows of a task"
_NO_LIMITS = np.array([[-math.inf], [math.inf], [math.inf], [math.inf]])
_MOST_STACK = 56 * 1024  # bytes to compute in; small arrays come on top
# steps per run of the test; memory and delay in periods
_STEPS = 4
_MEMORY = 5.0
_DELAY = 1.5
_STEP_PARTS = {
    "STEP_H": "step.h",
    "STEP_C": "step.c",
    "TICKS": "ticks.c",
    "STEP_README": "step.md",
}
_ABOUT_SPACES = " For the half-spaces of the tip it solves at most 11 times, usually once."
# Operations of a node with `a` numbers, n inputs and m outputs, in a model with S segments.
_OPERATIONS = {
    "arcs": lambda a, n, m, S: 8 * a + 210 * S + 25 * S * S,
    "elastic": lambda a, n, m, S: (8 + 2 ** min(n, 12)) * (200 * S + 40 * n) + 25 * (S + 14) * S,
    "structural": lambda a, n, m, S: 8 * a + 600 * S + 25 * S * S,
    "rigid": lambda a, n, m, S: 10 * (a - 9) + 15 * n,  # the tip does not turn
    "hybrid": lambda a, n, m, S: a * (25 * (S + 12) * S + 18 * S * n + 10 * m * (n + 2)),
}


Entries: TypeAlias = dict[str, object]  # what templates are filled with


class _Task(Protocol):
    of_poses: bool
    about_target: str
    shape: tuple[int, ...]

    @property
    def steered(self) -> tuple[ForwardModel, ...]: ...
    def evaluate(self, q: Tensor) -> tuple[Tensor, Tensor]: ...
    def positions(self, x: Tensor) -> Tensor: ...
    def moved(self, x: Tensor, motion: Tensor, turn: Tensor) -> Tensor: ...


class _Clear(Protocol):
    @property
    def models(self) -> tuple[ForwardModel, ...]: ...
    @property
    def scene(self) -> Tensor: ...


class _Settings(Protocol):
    @property
    def task(self) -> _Task: ...
    @property
    def clear(self) -> _Clear: ...
    @property
    def fraction(self) -> float: ...
    def write_plan(self, plan: Plan) -> int: ...
    def kernel_rates(self) -> list[float]: ...


class _Tracker(Protocol):
    @property
    def x(self) -> NDArray | Tensor: ...
    @property
    def sigma_min(self) -> float: ...
    @property
    def damping(self) -> float: ...
    def step(
        self, x_target: Tensor, dx: Tensor, *, x_measured: Tensor | None
    ) -> NDArray | Tensor: ...


@runtime_checkable
class _Controller(Protocol):
    """Inverse kinematics, with a step to write."""

    @property
    def settings(self) -> _Settings: ...
    def tracker(
        self, q0: NDArray | Tensor, *, delay: float = 0.0, memory: float = math.inf
    ) -> _Tracker: ...


def export_c(
    model: object,
    folder: str | Path,
    *,
    name: str = "model",
    dtype: str = "float64",
    about_q: str = ABOUT_Q,
    force: bool = False,
) -> list[Path]:
    """Write a model or inverse kinematics as C99 code for a controller; return the files.

    The code needs only math.h, allocates no memory, and every loop has a fixed bound.

    Parameters
    ----------
    model : ForwardModel, fitted HybridForwardModel or ELMRegressor, or InverseKinematics
        The model to write. For inverse kinematics the model and one step are written, which with
        hysteresis returns commands. x(q) is that of what the actuators do.
    folder : str or Path
        Output folder. Files of an earlier export are replaced, other files are not.
    name : str, default="model"
        Name of the files and prefix of all functions.
    dtype : {"float64", "float32"}, default="float64"
        Floating-point type of the code.
    about_q : str
        Unit and sign of q in sentences, for README.md and the header.
    force : bool, default=False
        Replace files that hybridkin did not write.

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
    check_outputs(paths, "export", force=force)
    measured = _measured(f"{name}.c", texts)
    entries = {**project.entries, "MEASURED": measured}
    entries["TITLE"] = markdown(project.title)
    entries["ABOUT_Q"] = markdown(project.about_q)
    texts["README.md"] = filled("README.md", entries)
    writers = {file: partial(Path.write_text, data=t) for file, t in texts.items()}
    write_files(folder, writers)
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
    title, about_q : str
        Class of the model, and unit and sign of q, as given.
    entries : dict
        What templates of C code are filled with.
    texts : dict
        Header, source, test and CMakeLists.txt by the name of the file.
    """

    controller: _Controller | None
    plan: Plan
    home: NDArray
    title: str
    about_q: str
    entries: Entries
    texts: dict[str, str]

    @property
    def limits(self) -> NDArray:
        """Limits q_min, q_max, dq_max and ddq_max of a step, shape (4, n)."""
        return _limits(self.plan)[0]


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
        raise ValueError(f"`name` must be a valid name in C, e.g. trunk_3, got {name!r}.")
    # Twins in float64, as C computes: what they derive from a geometry has its precision, too.
    controller = copy.deepcopy(model) if isinstance(model, _Controller) else None
    if controller:
        modules = [*controller.settings.task.steered]
        body = [*controller.settings.clear.models]
    else:
        modules = [copy.deepcopy(as_forward_model(model))]
        body = []
    for module in (*modules, *body):
        module.double()
    try:
        if controller:
            plan = Plan(controller.settings.write_plan)
        else:
            plan = Plan(modules[0].stored())
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
    title = class_in_words(type(model).__name__)
    entries: Entries = {
        "NAME": name,
        "GUARD": name.upper(),
        "TITLE": c_comment(title),
        "VERSION": __version__,
        "ABOUT_Q": c_comment(about_q),
        "REAL": _REAL[dtype],
        "N": plan.n_inputs,
        "TOL": _TOLERANCE[dtype],
    }
    entries |= _code(plan, controller, dtype)
    entries |= _vectors(modules, plan, controller, dtype)
    if controller is not None and leads(plan):
        entries["LEAD_FIELD"] = filled("lead.h", entries)
    if controller is not None and keeps_clear(plan):
        entries["CLEAR_FIELD"] = filled("clear.h", entries)
        entries["CLEAR_FUNCTION"] = filled("clear_function.h", entries)
        entries["CLEAR_C"] = filled("clear.c", entries)
        entries["CLEAR"] = filled("clear.md", entries)
    for key, template in _STEP_PARTS.items():
        entries[key] = "" if controller is None else filled(template, entries)

    texts = {file: filled(template, entries) for file, template in sources.items()}
    home = _middle(modules[0], plan, controller)[0].astype(dtype).astype(float)
    return CProject(controller, plan, home, title, about_q, entries, texts)


def filled(template: str, entries: Mapping[str, object]) -> str:
    """Return the text of a template with its entries."""
    text = _with_headers(_FOLDER / "templates" / template)
    return re.sub(r"@(\w+)@", lambda match: str(entries[match[1]]), text)


def _with_headers(path: Path) -> str:
    """Return the text of a file with the kernel headers inserted."""
    if path.name == "kinds.h":
        return c_header()
    text = stages_header() if path.name == "stages.h" else path.read_text()
    return re.sub(
        r'(?m)^#include "(\w+\.h)"$',
        lambda match: _with_headers(_FOLDER / "src" / match[1]),
        text,
    )


def _code(plan: Plan, controller: _Controller | None, dtype: str) -> Entries:
    """Return sizes and numbers of a plan as C, and the entries of README.md about them."""
    model = plan.root
    poses = False
    n_spaces = 0
    step: Entries = {"CALL": "forward(q, x)", "TIMER": "10ms"}
    if controller is not None:
        task = controller.settings.task
        model = plan.entry(plan.root, IK_MODEL)
        n_spaces = plan.entry(plan.root, IK_N_SPACES)
        poses = task.of_poses
        step = _step_code(plan, task, n_spaces)

    # gcc warns about arrays of length 1 if it cannot see that loops over them run at all.
    defines: Entries = {f"MAX_{s}": max(plan.largest[what], 2) for s, what in _SIZES.items()}
    kinds = {*plan.code[plan.places].tolist()}
    defines["KINDS"] = f"{sum(1 << kind for kind in kinds)}u"
    defines["POSES"] = int(poses)
    defines["SPACES"] = int(n_spaces > 0)
    defines["OBSTACLES"] = int(controller is not None and keeps_clear(plan))
    defines["HYSTERESIS"] = int(controller is not None and leads(plan))
    lines = [f"#define HK_{name} {number}" for name, number in defines.items()]
    if dtype == "float32":
        lines.insert(0, "#define HK_FLOAT")

    data = _in_range(plan.data, dtype)
    return {
        "DEFINES": "\n".join(lines),
        "CODE": literals(plan.code),
        "DATA": literals(data),
        "M": plan.lengths(model)[1],
        "MODEL": model,
        "ROOT": plan.root,
        "BYTES": data.nbytes + 4 * len(plan.code),
        "OPERATIONS": f"{_operations(plan, model):,}",
        **step,
    }


def _in_range(values: NDArray, dtype: str) -> NDArray:
    """Return numbers in a dtype; finite ones stay finite, such as widths that never end."""
    largest = float(np.finfo(dtype).max)
    finite = np.isfinite(values)
    return np.where(finite, values.clip(-largest, largest), values).astype(dtype)


def _step_code(plan: Plan, task: _Task, n_spaces: int) -> Entries:
    """Return the entries about a step of inverse kinematics."""
    limits, dt = _limits(plan)
    n = plan.n_inputs
    m = plan.n_outputs
    n_points, n_pairs, n_obstacles = sizes_of_body(plan)
    entries: Entries = {
        "CALL": "step(&state, target, NULL, NULL)",
        "TIMER": f"std::chrono::duration<double>({dt})",
        "DT": dt,
        "TASK": m,
        "WIDTH": math.prod(task.shape),
        "NORMALS": plan.entry(plan.root, IK_N_NORMALS),
        "POINTS": n_points,
        "PAIRS": n_pairs,
        "OBSTACLES": n_obstacles,
        "OBSTACLE_NUMBERS": max(n_obstacles, 1) * IK_OBSTACLE,
        "NEWTON": f"{10 * n**2 + (20 + 7 * m * m) * n:,}",
        "ABOUT_TARGET": task.about_target,
        "SPACES": _ABOUT_SPACES if n_spaces else "",
        "LEAD": n * plan.entry(plan.root, IK_STATE_ROWS),
        "SEEN": IK_DOUBTS + IK_AGREEING * m + IK_RING * (1 + math.prod(task.shape)),
    }
    entries |= {"LEADS": "", "LEAD_FIELD": "", "WITHOUT": ""}
    entries |= {"CLEAR": "", "CLEAR_FIELD": "", "CLEAR_FUNCTION": "", "CLEAR_C": ""}
    if leads(plan):
        entries["LEADS"] = filled("lead.md", entries)
        entries["WITHOUT"] = ", and without hysteresis there"
    entries["LIMITS"] = limits_in_words(limits)
    return entries


def leads(plan: Plan) -> bool:
    """Return whether commands of inverse kinematics lead what the actuators do, by hysteresis."""
    return plan.entry(plan.root, IK_STAGES) > 0


def keeps_clear(plan: Plan) -> bool:
    """Return whether the body of a robot keeps clear of obstacles, or of itself."""
    return plan.entry(plan.root, IK_BODY) > 0


def sizes_of_body(plan: Plan) -> tuple[int, int, int]:
    """Return the numbers of points of the body, of pairs with a gap, and of obstacles."""
    if not keeps_clear(plan):
        return 0, 0, 0
    body = plan.entry(plan.root, IK_BODY)
    n_points = plan.entry(body, IK_N_POINTS)
    n_obstacles = plan.entry(plan.root, IK_N_OBSTACLES)
    return n_points, n_points * n_obstacles + plan.entry(body, IK_N_MEETING), n_obstacles


def _check_stack(plan: Plan, dtype: str) -> None:
    """Raise if the code would need more than 64 KiB of stack; bounds the HK_MODEL_WORK of src."""
    n, segments, m, features, rows = plan.code[:5].tolist()
    numbers = 2 * features
    numbers += max(n, 3 * segments, m) * (n + 41) + 200 * segments + 30
    if "structural" in map(plan.kind, plan.places):
        numbers += 2 * (103 * segments + 51)
    if rows:
        numbers += 8 * (rows + 1) * (n + 12)
        numbers += 2 * n * plan.entry(plan.root, IK_STATE_ROWS)
        n_points, n_pairs, _ = sizes_of_body(plan)
        if n_points:
            numbers += (9 + 3 * n) * n_points + 6 * n_pairs + 2 * (n + 3) * IK_PAIRS_MOST
    if numbers * np.dtype(dtype).itemsize > _MOST_STACK:
        raise NoKernel("its sizes need more than 64 KiB of stack, too much for a controller")


def _operations(plan: Plan, model: int) -> int:
    """Return the approximate largest number of operations for x and J of a model and its parts."""
    ends = [plan.begin(place) for place in plan.places[1:]]
    work = 0
    for place, end in zip(plan.places, [*ends, len(plan.data)], strict=True):
        if place > model:  # parts come first
            break
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
    return usual_range(module, plan.n_inputs)


def _vectors(
    modules: list[ForwardModel], plan: Plan, controller: _Controller | None, dtype: str
) -> Entries:
    """Return the data of the test: inputs, and the outputs that torch computes."""
    rng = np.random.default_rng(0)
    center, half = _middle(modules[0], plan, controller)
    # Eight usual rows, then rows at growing distance from the center; the last one is NaN.
    usual = np.linspace(0.0, 0.7, 8)
    far = np.concatenate([usual, np.linspace(0.8, 5.0, 8), [math.nan]])
    rows = center + half * far[:, None] * rng.uniform(-1.0, 1.0, (17, len(half)))
    rows = rows.astype(dtype)
    with torch.no_grad(), without_warnings():
        at = torch.from_numpy(rows.astype(float))
        pairs = [module.forward_and_jacobian(at) for module in modules]
        x = torch.cat([x for x, _ in pairs], dim=1).numpy()
        J = torch.cat([J for _, J in pairs], dim=1).numpy()
        distances = [module.domain_distance(at).numpy() for module in modules]
    distance = np.max(distances, axis=0)
    arrays = {"Q": rows, "X": x, "J": J, "DISTANCE": distance, "HOME": rows[0]}
    entries: Entries = {"ROWS": len(rows)}
    for name, array in arrays.items():
        entries[f"{name}_SCALE"] = float(np.nanmax(abs(array[:8])))
    if controller is not None:
        runs, entries["COMPARED"] = _runs(controller, plan, rows[:8], dtype)
        arrays |= runs
        entries["STEPS"] = _STEPS
        entries["MEMORY"] = _MEMORY * _limits(plan)[1]
        entries["DELAY"] = _DELAY * _limits(plan)[1]
    for name, array in arrays.items():
        entries[name] = literals(array)
    return entries


def usual_range(module: ForwardModel, n: int) -> tuple[NDArray, NDArray]:
    """Return the middle and half width of q: of the training rows, else from the radii."""
    buffers = {
        name.rpartition(".")[2]: a.numpy(force=True) for name, a in module.state_dict().items()
    }
    for pair in _RANGES:
        center, half = (buffers.get(name, np.empty(0)) for name in pair)
        if center.shape == half.shape == (n,):
            return center, half
    radii = buffers.get("radii", np.full(1, 2.0))
    gains = buffers.get("gains", np.ones(n))
    extensible = "gains" in buffers and "lengths" not in buffers
    middle = buffers.get("actuator_zeros", np.zeros(n))
    if extensible:
        middle = middle + 3.0 * radii.mean() / gains
    half_width = 0.5 * radii.min() / np.abs(gains)
    return middle, half_width


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
        x, _ = task.evaluate(torch.from_numpy(starts.astype(float)))
    size = np.ptp(task.positions(x).numpy(), axis=0)
    target = _beside(task, x, far[0] * size, rng).astype(dtype)
    measured = _beside(task, x, far[2] * size, rng).astype(dtype)
    rows = rng.standard_normal((8, _STEPS, plan.n_outputs))
    dx = (far[1] * size.mean() * rows).astype(dtype)
    measured[:, 2] = math.nan  # no measurement
    commands = []
    squares = []
    healthy = 8 if dtype == "float64" else 4  # runs whose steps are compared
    for k, start in enumerate(_doubles(starts)):
        tracker = controller.tracker(start, delay=_DELAY * dt, memory=_MEMORY * dt)
        tips = [
            *_doubles(measured[k, :-1]),
            None,
        ]  # none at the end, as in the template
        steps = zip(_doubles(target[k]), _doubles(dx[k]), tips, strict=True)
        for goal, speed, tip in steps:
            q = tracker.step(goal, speed, x_measured=tip)
            commands.append(np.asarray(q))
            squares.append(tracker.sigma_min**2)
            if dtype == "float32" and tracker.damping > 0.0:
                healthy = min(healthy, k)  # weak directions
    runs = {
        "STARTS": starts,
        "LOW": low,
        "HIGH": high,
        "COMMAND": np.array(commands),
        "SIGMA_SQ": np.array(squares),
        "TARGET": target,
        "DX": dx,
        "MEASURED_TIPS": measured,
    }
    return runs, healthy


def _doubles(rows: NDArray) -> Tensor:
    """Return rows as a tensor in double precision."""
    return torch.from_numpy(rows.astype(float))


def _beside(task: _Task, x: Tensor, size: NDArray, rng: np.random.Generator) -> NDArray:
    """Return points or poses (N, steps, ...) beside those of a task, turned by up to 0.1 rad."""
    rows = x[:, None].expand(-1, _STEPS, *x.shape[1:])
    change = rng.standard_normal((*rows.shape[:2], *size.shape)) * size
    turns = 0.1 * change / max(np.abs(change).max(), 1e-9)
    return task.moved(rows, torch.from_numpy(change), torch.from_numpy(turns)).numpy()


def _measured(source: str, texts: dict[str, str]) -> str:
    """Return the size of the code and of its stack, measured by the compiler of this machine."""
    if shutil.which("cc") and shutil.which("size"):
        with (
            suppress(OSError),  # the disk may be full
            tempfile.TemporaryDirectory() as home,
        ):
            for name, text in texts.items():
                Path(home, name).write_text(text)
            built = Path(home) / "a.o"
            usage = Path(home) / "a.su"
            compiler = "cc -std=c99 -Os -fstack-usage -c -o".split()
            command = [*compiler, built, Path(home, source)]
            done = subprocess.run(command, capture_output=True)
            if done.returncode == 0 and usage.exists():
                lines = usage.read_text().splitlines()
                stack = sum(int(line.split("\t")[1]) for line in lines)
                sizes = subprocess.check_output(["size", built], text=True)
                code = sizes.split()[6]
                return f"{code} and {stack} bytes on the machine of the export, with `cc -Os`"
    return "not measured: the machine of the export had no C compiler"
