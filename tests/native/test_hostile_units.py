"""Functional mock-up units with hostile parameters, steps, sizes and sequences of calls."""

import shutil
import subprocess
import warnings
from contextlib import contextmanager

import numpy as np
import pytest
import systems
from numpy.testing import assert_array_equal

from hybridkin import InverseKinematics, native

pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]
DT = 0.02
SETTINGS = {"q_min": 0.1, "q_max": 0.4, "dq_max": 0.1, "ddq_max": 2.0, "q_pref": 0.25, "dt": DT}
RATES = {"gain": 10.0, "beta": 1.0}
TARGET = np.array([0.05, 0.02, 0.68])
NUMBERS = [np.nan, np.inf, -np.inf, -1.0, 0.0, 5e-324, 0.2, 0.3, 1.0, 50.0, 51.0, 1e300, -1e300]


def made(**changed):
    return InverseKinematics(systems.TRUNK, **{**SETTINGS, **RATES, **changed})


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    return native.export_fmu(made(), tmp_path_factory.mktemp("unit") / "trunk.fmu")


class Unit(systems.Unit):
    """A unit, and what it says."""

    def __init__(self, file, folder):
        super().__init__(file, folder)
        self.unit.freeInstance = lambda: None  # of the first one, which logs nothing
        self.messages = []
        self.again()

    def again(self):
        self.unit.instantiate(logMessage=lambda *words: self.messages.append(words[1:]))
        self.time = 0.0

    @contextmanager
    def refuses(self, text):
        from fmpy.fmi1 import FMICallException

        self.messages.clear()
        with pytest.raises(FMICallException) as raised:
            yield
        assert raised.value.status == 3
        (status, category, message) = self.messages.pop()
        assert (status, category) == (3, b"logStatusError")
        assert text in message.decode()

    def accepts(self, call, *args, **kwargs):
        """Return whether a call is not refused."""
        from fmpy.fmi1 import FMICallException

        try:
            call(*args, **kwargs)
        except FMICallException:
            return False
        return True

    def commands(self, count=5):
        self.set(target=TARGET)
        rows = []
        for _ in range(count):
            self.step(DT)
            rows.append(self.get("command"))
        return np.array(rows)


@pytest.fixture
def unit(file, tmp_path):
    return Unit(file, tmp_path)


def test_the_code_compiles_without_a_warning(file, tmp_path):
    shutil.unpack_archive(file, tmp_path, "zip")
    flags = "-std=c99 -Wall -Wextra -pedantic -Werror -c -o unit.o fmu.c".split()
    done = subprocess.run(["cc", *flags], cwd=tmp_path / "sources", capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("dq_max", [-1.0] * 9, "dq_max must be positive, got -1"),
        ("dq_max", [0.1] * 8 + [np.nan], "dq_max must be positive, got nan"),
        ("ddq_max", [0.0] * 9, "ddq_max must be positive"),
        ("q_max", [np.nan] * 9, "q_max must be numbers, got nan"),
        ("start", [np.nan] * 9, "start must be finite"),
        ("start", [np.inf] * 9, "start must be finite"),
        ("gain", [0.0], "gain must be positive and up to 50 1/s"),
        ("gain", [50.1], "gain must be positive and up to 50 1/s"),
        ("beta", [-1.0], "beta must be zero or up to 50 1/s"),
        ("memory", [np.inf], "memory must be zero or a time"),
        ("dq_max", [0.1] * 8, "dq_max has 9 values, got 8"),
        ("dq_max", [0.1] * 10, "values, got 1"),
        ("command", [0.2] * 9, "command cannot be set"),
    ],
)
def test_a_wrong_value_is_refused_and_leaves_the_unit_as_it_was(unit, name, values, text):
    unit.start()
    before = unit.commands()
    unit.again()
    for mode in ("instantiated", "initializing", "stepping"):
        if mode == "initializing":
            unit.unit.enterInitializationMode()
        if mode == "stepping":
            unit.unit.exitInitializationMode()
        refused = "after the initialization" if (mode, name) == ("stepping", "start") else text
        with unit.refuses(refused):
            unit.unit.setFloat64([unit.references[name]], values)
        with unit.refuses(refused):  # and the target before it is not set either
            places = [unit.references["target"], unit.references[name]]
            unit.unit.setFloat64(places, [9.0, 9.0, 9.0, *values])
    assert_array_equal(unit.commands(), before)


def test_limits_are_checked_together_at_the_end_of_the_initialization_and_before_a_step(unit):
    unit.start()
    before = unit.commands()
    unit.again()
    unit.unit.enterInitializationMode()
    unit.set(q_min=np.full(9, 0.5))
    with unit.refuses("q_min must not exceed q_max, got 0.5 and 0.4"):
        unit.unit.exitInitializationMode()
    unit.set(q_min=np.full(9, 0.1))
    unit.unit.exitInitializationMode()
    unit.set(q_max=np.full(9, 0.05))
    with unit.refuses("q_min must not exceed q_max"):
        unit.step(DT)
    unit.set(q_max=np.full(9, 0.4))
    assert_array_equal(unit.commands(), before)


@pytest.mark.parametrize("step", [np.nan, np.inf, -np.inf, -DT, 0.0, 0.5 * DT, 1.5 * DT, 1e300])
def test_a_wrong_step_is_refused_and_leaves_the_unit_as_it_was(unit, step):
    unit.start()
    before = unit.commands()
    unit.again()
    unit.start()
    for time, size in ((0.0, step), (np.nan, DT), (np.inf, DT)):
        with unit.refuses("must be"):
            unit.unit.doStep(time, size)
    assert unit.unit.getFloat64([0]) == [0.0]
    assert_array_equal(unit.commands(), before)


def test_calls_out_of_sequence_are_refused(unit):
    inner = unit.unit
    with unit.refuses("steps follow the initialization"):
        inner.doStep(0.0, DT)
    with unit.refuses("the initialization has not begun"):
        inner.exitInitializationMode()
    for start in (np.nan, np.inf):
        with unit.refuses("must start at a finite time"):
            inner.enterInitializationMode(startTime=start)
    inner.enterInitializationMode()
    with unit.refuses("the simulation has begun"):
        inner.enterInitializationMode()
    inner.exitInitializationMode()
    unit.commands()
    inner.terminate()
    with unit.refuses("steps follow the initialization"):
        inner.doStep(unit.time, DT)
    with unit.refuses("after the end"):
        unit.set(target=TARGET)
    with unit.refuses("no variable with the value reference 99"):
        inner.getFloat64([99])
    with unit.refuses("all variables are Float64, none is Int32"):
        inner.setInt32([1], [1])
    inner.reset()
    unit.time = 0.0
    unit.start()
    assert np.isfinite(unit.commands()).all()


def accepted_by_python(values):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of numbers that look like millimetres
            made(**values)
    except ValueError:
        return False
    return True


def test_random_parameters_are_accepted_as_in_python(unit):
    # 300 draws of one to three parameters, half before and half after the initialization.
    rng = np.random.default_rng(0)
    names = [*SETTINGS, *RATES]
    names.remove("dt")
    names.remove("q_pref")
    counts = {True: 0, False: 0}
    for draw in range(300):
        unit.unit.reset()
        unit.time = 0.0
        values = {}
        for name in rng.choice(names, rng.integers(1, 4), replace=False).tolist():
            values[name] = float(rng.choice(NUMBERS))
        late = draw % 2
        if late:
            unit.start()
        sizes = {name: np.full(unit.sizes[name], value) for name, value in values.items()}
        accepted = all(unit.accepts(unit.set, **{name: value}) for name, value in sizes.items())
        if accepted:
            accepted = unit.accepts(unit.step if late else unit.start, *([DT] if late else []))
        assert accepted == accepted_by_python(values), values
        counts[accepted] += 1
        if not late and not accepted:
            continue
        if late and not accepted:
            unit.set(
                **{name: np.full(unit.sizes[name], {**SETTINGS, **RATES}[name]) for name in values}
            )
        commands = unit.commands()
        assert np.isfinite(commands).all()
        if accepted:
            most = values.get("dq_max", SETTINGS["dq_max"]) * DT
            assert np.abs(np.diff(commands, axis=0)).max() <= most * (1 + 1e-9) + 1e-15
    assert min(counts.values()) > 50
