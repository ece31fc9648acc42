"""Axes of the tip, and cameras of positions alone, in exported code and units, as in Python."""

import shutil
import subprocess

import numpy as np
import pytest
import rounding
import systems
import torch

from hybridkin import InverseKinematics, native, robots
from hybridkin.ik.tasks import AxisTask, PoseTask

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
]
TRUNK = robots.bionic_handling_assistant()
TASKS = {
    "axis": lambda: AxisTask(TRUNK, [0.2, 0.0, 1.0], length=0.2),
    "pose": lambda: PoseTask(TRUNK),
}
OFF = np.array([0.004, -0.003, 0.002])
DT, STEPS = 0.02, 30
MAIN = """
#include <stdio.h>
#include "robot.h"
static const double start[9] = {%s}, targets[] = {%s}, readings[] = {%s};
int main(void) {
    robot_state state;
    robot_reset(&state, start);
    state.memory = INFINITY;
    for (int i = 0; i < %d; i++) {
        robot_step(&state, targets + i * ROBOT_TARGET, NULL, readings + i * ROBOT_TARGET);
        for (int j = 0; j < 9; j++) printf("%%.17g ", state.q[j]);
        printf("%%.17g\\n", state.error);
    }
    return 0;
}
"""


def run(name):
    """Return a controller, and targets, readings, commands and errors of a robot that is off."""
    task = TASKS[name]()
    controller = InverseKinematics(task, q_min=0.1, q_max=0.4, dq_max=0.4, dt=DT)
    places = np.arange(9.0)
    start = 0.25 + 0.01 * np.cos(places)
    with torch.no_grad():
        goals = torch.from_numpy(0.25 + 0.02 * np.cos(places + 0.3 * np.arange(2.0)[:, None]))
        pair = task.evaluate(goals)[0].numpy()
    targets = np.repeat(pair, STEPS // 2, axis=0)
    tracker = controller.tracker(start)
    readings, commands, errors = [], [tracker.q], []
    for k, target in enumerate(targets):
        x = torch.from_numpy(tracker.x)
        seen = task.positions(x) + torch.from_numpy(OFF)
        reading = task.reading(seen).numpy()
        if k % 7 == 5:  # also the rotation
            reading = task.moved(x, torch.from_numpy(OFF), torch.full((3,), 0.02).double()).numpy()
        if k % 7 == 6:
            reading = np.full_like(reading, np.nan)
        readings.append(reading)
        commands.append(tracker.step(target, x_measured=reading))
        errors.append(tracker.error)
    return controller, start, targets, readings, np.array(commands), np.array(errors)


def in_c(rows):
    numbers = (repr(float(a)) for a in np.ravel(rows))
    return ", ".join("NAN" if a == "nan" else a for a in numbers)


@pytest.mark.parametrize("name", TASKS)
def test_the_code_uses_positions_alone_as_python(tmp_path, name):
    controller, start, targets, readings, commands, errors = run(name)
    native.export_c(controller, tmp_path, name="robot")
    source = MAIN % (in_c(start), in_c(targets), in_c(readings), STEPS)
    (tmp_path / "main.c").write_text("#include <math.h>\n" + source)
    build = "cc -std=c99 -O0 main.c robot.c -lm -o main"
    subprocess.run(build.split(), cwd=tmp_path, check=True)
    found = np.loadtxt(subprocess.check_output([tmp_path / "main"], text=True).splitlines())
    close = rounding.of_commands(commands)
    np.testing.assert_allclose(found[:, :9], commands[1:], rtol=0, atol=close)
    np.testing.assert_allclose(found[:, 9], errors, rtol=1e-6, atol=1e-9)


def test_a_unit_uses_positions_alone_as_python(tmp_path):
    pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
    controller, start, targets, readings, commands, _ = run("axis")
    unit = systems.Unit(native.export_fmu(controller, tmp_path / "a.fmu"), tmp_path / "unpacked")
    unit.start(start=start)
    close = rounding.of_commands(commands)
    for target, reading, command in zip(targets, readings, commands[1:], strict=True):
        unit.set(target=target.ravel(), measured=reading.ravel())
        unit.step(DT)
        np.testing.assert_allclose(unit.get("command"), command, rtol=0, atol=close)
