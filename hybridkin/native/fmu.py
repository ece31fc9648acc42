"""A model or a controller as a functional mock-up unit (FMI 3.0), for Simulink and other tools."""

from __future__ import annotations

import hashlib
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.files import check_outputs, write_file
from hybridkin._core.kernel_numbers import IK_RING
from hybridkin._core.texts import xml_text
from hybridkin._core.version import __version__
from hybridkin.native.export import (
    ABOUT_Q,
    CProject,
    c_project,
    filled,
    keeps_clear,
    leads,
    literals,
)

_FLAGS = "-std=c99 -O2 -fPIC -shared -fvisibility=hidden -fno-math-errno -fno-trapping-math"
_SYSTEMS = {"linux": "linux", "darwin": "darwin", "win32": "windows"}
_PROCESSORS = {"AMD64": "x86_64", "arm64": "aarch64"}
_SUFFIXES = {"linux": ".so", "darwin": ".dylib", "win32": ".dll"}
_LIMITS = {"q_min": "low", "q_max": "high", "dq_max": "speed", "ddq_max": "accel"}
_TIME = 0  # value reference
_WHO_SETS = {"input": "ALWAYS", "output": "NEVER", "parameter": "ALWAYS"}
_LEAST = float(np.nextafter(0.0, 1.0))  # above zero
_MOST = float(np.finfo(float).max)


class Need(NamedTuple):
    """What the numbers of a variable must be: in words, and as their least and largest value."""

    words: str
    low: float
    high: float


_NEEDS = {
    "q_min": Need("numbers", -np.inf, np.inf),
    "q_max": Need("numbers", -np.inf, np.inf),
    "dq_max": Need("positive", _LEAST, np.inf),
    "ddq_max": Need("positive", _LEAST, np.inf),
}
_START = Need("finite", -_MOST, _MOST)
_MEMORY = Need("zero or a time in s", 0.0, _MOST)
_FRACTION = Need("above zero and at most 1", _LEAST, 1.0)


class Variable(NamedTuple):
    """A variable of a unit.

    Attributes
    ----------
    name : str
        Name.
    causality : {"input", "output", "parameter"}
        What it is for the user of the unit.
    about : str
        Meaning and unit.
    shape : tuple of int
        Its dimensions; () for a number.
    start : ndarray or None
        Value before the user sets one; None for outputs.
    need : Need or None
        What its numbers must be; None for inputs, which may be anything.
    variability : {"", "tunable", "fixed"}
        Of a parameter, whether it may change after the initialization.
    """

    name: str
    causality: str
    about: str
    shape: tuple[int, ...]
    start: NDArray | None = None
    need: Need | None = None
    variability: str = ""

    @property
    def size(self) -> int:
        """Numbers in it."""
        return int(np.prod(self.shape))


def export_fmu(
    model: object,
    path: str | Path,
    *,
    name: str = "model",
    about_q: str = ABOUT_Q,
    force: bool = False,
) -> Path:
    """Write a model or inverse kinematics as a functional mock-up unit, and return the file.

    The unit is one of FMI 3.0 for co-simulation, with a library for this machine and its sources,
    from which others can be compiled. Of a model it has the input q and the outputs x, J and
    domain_distance. Of inverse kinematics it has the inputs target, velocity and measured (NaN:
    no measurement), the outputs command, tip (that of the model), error, status (0 a step without
    limits, 1 limits restricted it, 2 held, because an input is not finite) and rejected (1 if the
    measurement was not used, as it cannot be), with hysteresis effective (what the actuators do),
    with obstacles the input obstacles (their centers now) and the output blocked (1 if they changed
    the step), and as parameters the start, the limits, gain, beta, fraction (of what a measurement
    shows beyond the offset between robot and model, by default 0.2, and 1 with a `gain`), delay
    (age of measurements) and memory (0: the offset stays). A step of the simulation must be a
    multiple of its period; in several periods a measurement is that of the first.

    Parameters are checked as in Python. All but the start may change between steps. A call that is
    refused returns fmi3Error, logs the reason (category logStatusError), and changes nothing.

    Parameters
    ----------
    model : ForwardModel, fitted HybridForwardModel or ELMRegressor, or InverseKinematics
        As for `export_c`.
    path : str or Path
        The file, such as "trunk.fmu".
    name : str, default="model"
        Name of the unit in the other tool.
    about_q : str
        Unit and sign of q in sentences, for the description of the unit.
    force : bool, default=False
        Replace a file that hybridkin did not write. A unit of hybridkin is replaced.

    Returns
    -------
    Path
        The file written.

    Raises
    ------
    NoKernel
        If a part of the model cannot be written in C.
    FileExistsError
        If there is such a file that hybridkin did not write.
    RuntimeError
        Without a C compiler.

    References
    ----------
    Modelica Association, Functional Mock-up Interface 3.0.1 (2023).

    Examples
    --------
    >>> import tempfile
    >>> from hybridkin import native, robots
    >>> file = tempfile.mkdtemp() + "/trunk.fmu"
    >>> native.export_fmu(robots.bionic_handling_assistant(), file, name="trunk").name
    'trunk.fmu'
    """
    path = Path(path)
    check_outputs([path], "export", force=force)
    project = c_project(model, name=name, about_q=about_q)
    variables = _variables(project)
    texts = {f"{name}.c": project.texts[f"{name}.c"]}
    texts[f"{name}.h"] = project.texts[f"{name}.h"]
    token = hashlib.sha256(texts[f"{name}.c"].encode()).hexdigest()[:32]
    entries = {**project.entries, **_entries(variables), "TOKEN": token}
    if project.controller is None:
        entries["INSTANCE"] = ""
        entries["UPDATE"] = filled("fmu_model.c", entries)
    else:
        entries["INSTANCE"] = f"{name}_state state;"
        entries["UPDATE"] = filled("fmu_step.c", entries)
    texts["fmu.c"] = filled("fmu.c", entries)
    description = _description(project, variables, token)
    library = _compiled(texts)
    suffix = _SUFFIXES[sys.platform]

    def write(staging: Path) -> None:
        with zipfile.ZipFile(staging, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.comment = b"Written by hybridkin."
            archive.writestr("modelDescription.xml", description)
            archive.writestr(f"binaries/{_platform()}/{name}{suffix}", library)
            archive.writestr("sources/buildDescription.xml", _build_description(name))
            for file, text in texts.items():
                archive.writestr(f"sources/{file}", text)

    write_file(path, write)
    return path


def _variables(project: CProject) -> list[Variable]:
    """Return the variables of the unit, in the order of their value references."""
    plan = project.plan
    n = plan.n_inputs
    if project.controller is None:
        m = plan.n_outputs
        about_q = project.about_q
        return [
            Variable("q", "input", about_q, (n,), project.home),
            Variable("x", "output", "tip [m]", (m,)),
            Variable("jacobian", "output", "dx/dq, row by row", (m, n)),
            Variable("domain_distance", "output", "at most 1 inside the domain", ()),
        ]
    target = np.ravel(project.controller.tracker(project.home).x)
    width = target.shape
    home = project.home
    rows = (plan.n_outputs,)
    gain, beta, dt, _ = project.controller.settings.kernel_rates()
    rate = 1.0 / dt
    gain = rate if gain < 0.0 else gain
    beta = min(beta, rate)
    most = (1.0 + 1e-9) * rate
    by_rate = f"up to {rate:.6g} 1/s, which is 1 / period"
    need_gain = Need(f"positive and {by_rate}", _LEAST, most)
    need_beta = Need(f"zero or {by_rate}", 0.0, most)
    oldest = (IK_RING - 1) * dt
    need_delay = Need(f"zero or up to {oldest:.6g} s", 0.0, oldest)
    settings = project.controller.settings
    variables = [
        Variable("target", "input", str(project.entries["ABOUT_TARGET"]), width, target),
        Variable("velocity", "input", "of the target [m/s]", rows, np.zeros(rows)),
        Variable("measured", "input", "tip, or NaN", width, np.full(width, np.nan)),
        Variable("start", "parameter", "command at rest", (n,), home, _START, "fixed"),
        _tunable("gain", "of the error [1/s]", gain, need_gain),
        _tunable("beta", "of the posture [1/s]", beta, need_beta),
        _tunable("fraction", "of an innovation", settings.fraction, _FRACTION),
        _tunable("delay", "age of measurements [s]", 0.0, need_delay),
        _tunable("memory", "of measurements [s]; 0: no end", 0.0, _MEMORY),
        Variable("command", "output", project.about_q, (n,)),
        Variable("tip", "output", "of the model at the command, as target", width),
        Variable("error", "output", "distance to the target [m]", ()),
        Variable("status", "output", "0 free, 1 at limits, 2 held", ()),
        Variable("rejected", "output", "1: the measurement is not used", ()),
    ]
    if leads(plan):
        about = "what the actuators do, after hysteresis"
        variables.append(Variable("effective", "output", about, (n,)))
    if keeps_clear(plan):
        variables.append(Variable("blocked", "output", "1: obstacles changed the step", ()))
    centers = settings.clear.scene[:, :3].numpy()
    if len(centers):
        about = "centers of the obstacles [m]"
        variables.append(Variable("obstacles", "input", about, centers.shape, centers))
    for limit, values in zip(_LIMITS, project.limits, strict=True):
        if np.isfinite(values).all():
            about = f"{_LIMITS[limit]} of q, in its unit and s"
            variables.append(_tunable(limit, about, values, _NEEDS[limit]))
    return variables


def _tunable(name: str, about: str, start: NDArray | float, need: Need) -> Variable:
    """Return a parameter that may change between steps."""
    values = np.asarray(start)
    return Variable(name, "parameter", about, values.shape, values, need, "tunable")


def _place(variable: Variable) -> str:
    """Return the name in C of where a variable begins."""
    return f"V_{variable.name.upper()}"


def _in_table(variable: Variable, begin: int) -> str:
    """Return the entry of a variable in the table of the C code."""
    who = "BEFORE" if variable.variability == "fixed" else _WHO_SETS[variable.causality]
    low, high, words = "0.0", "0.0", "NULL"
    if variable.need is not None:
        low, high = literals(np.array(variable.need[1:])).strip(",\n ").split(", ")
        words = f'"{variable.need.words}"'
    numbers = f"{begin}, {variable.size}, {who}, {low}, {high}"
    return f'{{"{variable.name}", {numbers}, {words}}}'


def _entries(variables: list[Variable]) -> dict[str, str]:
    """Return what the C code must know of the variables."""
    offsets = []
    table = []
    starts: list[NDArray] = []
    begin = 0
    for variable in variables:
        offsets.append(f"{_place(variable)} = {begin}")
        table.append(_in_table(variable, begin))
        start = np.zeros(variable.size) if variable.start is None else variable.start
        starts.append(np.ravel(start))
        begin += variable.size
    parameters = []
    for variable in variables:
        if variable.name in _LIMITS:
            field = _LIMITS[variable.name]
            parameters.append(f"    ik.{field} = values + {_place(variable)};")
    return {
        "OFFSETS": f"{', '.join(offsets)}, VALUES = {begin}",
        "VARIABLES": ", ".join(table),
        "STARTS_OF_VALUES": literals(np.concatenate(starts)),
        "PARAMETERS": "\n".join(parameters),
    }


def _description(project: CProject, variables: list[Variable], token: str) -> bytes:
    """Return modelDescription.xml."""
    name = str(project.entries["NAME"])
    root = Element(
        "fmiModelDescription",
        fmiVersion="3.0",
        modelName=name,
        instantiationToken=token,
        description=xml_text(f"{project.title}. {project.about_q}"),
        generationTool=f"hybridkin {__version__}",
    )
    unit = SubElement(
        root,
        "CoSimulation",
        modelIdentifier=name,
        canGetAndSetFMUState="true",
        canHandleVariableCommunicationStepSize="true",
    )
    if project.controller is not None:
        _, _, dt, _ = project.controller.settings.kernel_rates()
        unit.set("fixedInternalStepSize", repr(dt))
    categories = SubElement(root, "LogCategories")
    about = "what was refused, and why"
    SubElement(categories, "Category", name="logStatusError", description=about)
    listed = SubElement(root, "ModelVariables")
    structure = SubElement(root, "ModelStructure")
    SubElement(
        listed,
        "Float64",
        name="time",
        valueReference=str(_TIME),
        causality="independent",
        variability="continuous",
    )
    for reference, variable in enumerate(variables, start=1):
        entry = SubElement(
            listed,
            "Float64",
            name=variable.name,
            valueReference=str(reference),
            causality=variable.causality,
            description=xml_text(variable.about),
        )
        if variable.variability:
            entry.set("variability", variable.variability)
        if variable.start is not None:
            numbers = (repr(float(number)) for number in np.ravel(variable.start))
            entry.set("start", " ".join(numbers).replace("nan", "NaN"))
        for size in variable.shape:
            SubElement(entry, "Dimension", start=str(size))
    for kind in ("Output", "InitialUnknown"):
        for reference, variable in enumerate(variables, start=1):
            if variable.causality == "output":
                SubElement(structure, kind, valueReference=str(reference))
    indent(root)
    return tostring(root, encoding="utf-8", xml_declaration=True)


def _build_description(name: str) -> bytes:
    """Return sources/buildDescription.xml, from which importers compile the unit."""
    root = Element("fmiBuildDescription", fmiVersion="3.0")
    build = SubElement(root, "BuildConfiguration", modelIdentifier=name)
    files = SubElement(build, "SourceFileSet", language="C99")
    SubElement(files, "SourceFile", name="fmu.c")
    return tostring(root, encoding="utf-8", xml_declaration=True)


def _platform() -> str:
    """Return the name of this machine's kind in FMI."""
    processor = platform.machine()
    return f"{_PROCESSORS.get(processor, processor)}-{_SYSTEMS[sys.platform]}"


def _compiled(texts: dict[str, str]) -> bytes:
    """Return the shared library of the unit."""
    compiler = shutil.which("cc")
    if compiler is None:
        raise RuntimeError(
            "a functional mock-up unit holds a compiled library, and there is no C compiler: "
            "install one (apt install gcc), or use `export_c`."
        )
    with tempfile.TemporaryDirectory() as home:
        for file, text in texts.items():
            (Path(home) / file).write_text(text)
        library = Path(home) / "unit.so"
        command = [compiler, *shlex.split(_FLAGS), "fmu.c", "-o", str(library), "-lm"]
        subprocess.run(command, check=True, cwd=home)
        return library.read_bytes()
