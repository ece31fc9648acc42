"""Late, missing and impossible readings in a functional mock-up unit and Octave, as in Python."""

import shutil
import subprocess

import numpy as np
import pytest
import rounding
import systems

from hybridkin import native

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]
HOME, TARGET, DT = np.full(9, 0.22), np.array([0.05, 0.02, 0.68]), 0.02
NOTHING = np.full(3, np.nan)


def run(tracker, count=60):
    """Return readings, commands and whether readings were rejected, of a robot 1 cm off."""
    draw = np.random.default_rng(0)
    tips, readings, commands, rejected = [], [], [tracker.q], []
    for k in range(count):
        tips.append(tracker.x + 0.01 * np.array([1.0, -0.5, 0.2]))
        reading = tips[max(k - 2, 0)] + 1e-3 * draw.standard_normal(3)
        if k % 9 == 5:
            reading = reading + np.array([0.0, 0.3, 0.0])
        if k % 4 == 3:
            reading = NOTHING
        readings.append(reading)
        commands.append(tracker.step(TARGET, x_measured=reading))
        rejected.append(tracker.rejected)
    return readings, np.array(commands), np.array(rejected)


def test_a_unit_uses_readings_as_python(tmp_path):
    pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
    controller = systems.CONTROLLERS["trunk"]()
    readings, commands, rejected = run(controller.tracker(HOME, delay=1.7 * DT, memory=0.5))
    assert 3 < rejected.sum() < 10
    unit = systems.Unit(native.export_fmu(controller, tmp_path / "a.fmu"), tmp_path / "unpacked")
    unit.start(start=HOME, delay=1.7 * DT, memory=0.5)
    close = rounding.of_commands(commands)
    for reading, command, bad in zip(readings, commands[1:], rejected, strict=True):
        unit.set(target=TARGET, measured=reading)
        unit.step(DT)
        np.testing.assert_allclose(unit.get("command"), command, rtol=0, atol=close)
        assert unit.get("rejected")[0] == bad


def test_a_reading_is_that_of_one_period_of_a_step(tmp_path):
    pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
    controller = systems.CONTROLLERS["trunk"]()
    unit = systems.Unit(native.export_fmu(controller, tmp_path / "a.fmu"), tmp_path / "unpacked")
    tracker = controller.tracker(HOME)
    reading = tracker.x + 0.01
    unit.start(start=HOME)
    unit.set(target=TARGET, measured=reading)
    unit.step(3 * DT)
    commands = [tracker.q]
    for k in range(3):
        commands.append(tracker.step(TARGET, x_measured=NOTHING if k else reading))
    close = rounding.of_commands(commands)
    np.testing.assert_allclose(unit.get("command"), commands[-1], rtol=0, atol=close)


@pytest.mark.skipif(
    shutil.which("mkoctfile") is None, reason="needs Octave: apt install octave octave-dev"
)
def test_octave_uses_readings_as_python(tmp_path):
    controller = systems.CONTROLLERS["trunk"]()
    readings, commands, rejected = run(controller.tracker(HOME, delay=1.7 * DT))
    native.export_mex(controller, tmp_path, name="robot")
    np.savetxt(tmp_path / "readings.txt", readings)
    (tmp_path / "run.m").write_text(
        f"""
        readings = load('readings.txt');
        state = robot('reset', repmat(0.22, 9, 1));
        for k = 1:rows(readings)
          tip = readings(k, :);
          [q, state, ~, ~, bad] = robot('step', state, {TARGET.tolist()}, [], tip, {1.7 * DT});
          found(k, :) = [q', bad];
        end
        save('-ascii', '-double', 'found.txt', 'found');
        """
    )
    for command in ("mkoctfile --mex robot.c", "octave-cli --no-gui run.m"):
        subprocess.run(command.split(), cwd=tmp_path, check=True, capture_output=True)
    found = np.loadtxt(tmp_path / "found.txt")
    close = rounding.of_commands(commands)
    np.testing.assert_allclose(found[:, :9], commands[1:], rtol=0, atol=close)
    np.testing.assert_array_equal(found[:, 9], rejected)
