"""Controllers as functional mock-up units, in Octave and on microcontrollers, against Python.

    python examples/studies/systems.py

Prints a table of the largest differences of commands over a run of targets, of sizes, and the
time of a step with the call from Python (median) or Octave (mean). Needs fmpy (pip install fmpy),
Octave with mkoctfile, and for the last columns what examples/microcontroller needs; columns
without their program are empty.
"""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from hybridkin import (
    Commands,
    ElasticTendonChain,
    ELMRegressor,
    HybridForwardModel,
    Hysteresis,
    InverseKinematics,
    datasets,
    native,
    obstacles,
    robots,
    tasks,
)

sys.path.append(str(Path(__file__).parents[1] / "microcontroller"))

TRUNK = robots.bionic_handling_assistant()
LIMITS = {"q_min": 0.1, "q_max": 0.4, "q_pref": 0.25, "dt": 0.02}


def fitted(error_model, **options):
    data = datasets.load_trunk()
    rows = datasets.paper_split(data, random_state=0)[0][:300]
    model = HybridForwardModel(TRUNK, error_model, random_state=0, **options)
    return model.fit(Commands(data.q[rows], time=np.arange(300.0)), data.x[rows])


MODELS = {
    "chain": lambda: TRUNK,
    "network": lambda: fitted(ELMRegressor(30, random_state=0)),
    "serial": lambda: fitted("quadratic", coupling="serial"),
}
HYSTERESIS = Hysteresis.friction([0.0, 0.001, 0.003], [0.3, 0.6]) | Hysteresis.creep([0.1], [2.0])
CONTROLLERS = {
    "trunk": lambda: InverseKinematics(TRUNK, dq_max=0.1, ddq_max=2.0, **LIMITS),
    "network": lambda: InverseKinematics(MODELS["network"](), **LIMITS),
    "elastic": lambda: InverseKinematics(
        ElasticTendonChain([0.005] * 2, [0.06] * 2, bending_stiffness=3e-7),
        q_min=-0.004,
        q_max=0.004,
        dt=0.01,
    ),
    "hysteresis": lambda: InverseKinematics(
        fitted("linear", hysteresis=HYSTERESIS), dq_max=0.1, **LIMITS
    ),
    "pose": lambda: InverseKinematics(tasks.PoseTask(TRUNK), **LIMITS),
    "half-space": lambda: InverseKinematics(
        TRUNK, tip_limits=([[0.0, 0.0, 1.0]], [0.72]), **LIMITS
    ),
    "obstacles": lambda: InverseKinematics(
        TRUNK,
        dq_max=0.5,
        obstacles=[
            obstacles.Sphere([0.16, 0.0, 0.7], 0.05),
            obstacles.HalfSpace([0.0, 1.0, 0.0], -0.1),
        ],
        body_points=[(1.0, 0.05), (2.0, 0.05), (3.0, 0.04)],
        **LIMITS,
    ),
}


def rows_near(n, n_rows):
    """Return rows of q (N, n) within the usual range of the robots of this file."""
    rng = np.random.default_rng(0)
    if n == 9:
        return 0.25 + 0.04 * rng.uniform(-1.0, 1.0, (n_rows, 9))
    return 0.002 * rng.uniform(-1.0, 1.0, (n_rows, n))


class Unit:
    """A functional mock-up unit in fmpy."""

    def __init__(self, path, folder):
        import fmpy
        from fmpy.fmi3 import FMU3Slave
        from fmpy.validation import validate_fmu

        assert validate_fmu(str(path)) == []
        description = fmpy.read_model_description(str(path))
        self.references = {v.name: v.valueReference for v in description.modelVariables}
        self.sizes = {
            v.name: int(np.prod([d.start for d in v.dimensions] or [1]))
            for v in description.modelVariables
        }
        self.unit = FMU3Slave(
            guid=description.guid,
            unzipDirectory=fmpy.extract(str(path), str(folder)),
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="tested",
        )
        self.unit.instantiate()
        self.time = 0.0

    def start(self, **values):
        self.unit.enterInitializationMode()
        self.set(**values)
        self.unit.exitInitializationMode()

    def set(self, **values):
        for name, value in values.items():
            self.unit.setFloat64([self.references[name]], np.ravel(value).tolist())

    def get(self, name):
        values = self.unit.getFloat64([self.references[name]], nValues=self.sizes[name])
        return np.array(values)

    def step(self, period):
        self.unit.doStep(currentCommunicationPoint=self.time, communicationStepSize=period)
        self.time += period


OCTAVE = """
Q = load("Q.txt"); T = load("T.txt"); X = []; C = [];
for k = 1:rows(Q)
  [x, J, far] = robot(Q(k, :));
  X = [X; x' reshape(J', 1, []) far];
end
s = robot('reset', Q(1, :));
for k = 1:rows(T)
  [q, s, e] = robot('step', s, T(k, :));
  C = [C; q' e];
end
s = robot('reset', Q(1, :));
clock = tic;
for k = 1:rows(T)
  [q, s, e] = robot('step', s, T(k, :));
end
seconds = toc(clock) / rows(T);
save("-ascii", "-double", "seconds.txt", "seconds");
save("-ascii", "-double", "X.txt", "X"); save("-ascii", "-double", "C.txt", "C");
function said(varargin)
  try
    robot(varargin{:});
    disp("NO ERROR");
  catch problem
    disp(problem.message);
  end
end
said(1:3); said('step', 5, [1 2 3]); said('go', 5); said(single(1:9)); said();
"""


def in_octave(controller, q, targets, folder):
    """Return what Octave computes: models (N, ...) and steps (T, n + 1), and what errors say.

    The file seconds.txt in the folder gets the mean time of a step.
    """
    native.export_mex(controller, folder, name="robot")
    subprocess.run(["mkoctfile", "--mex", "robot.c"], cwd=folder, check=True)
    np.savetxt(folder / "Q.txt", q, fmt="%.17g")
    np.savetxt(folder / "T.txt", targets, fmt="%.17g")
    (folder / "run.m").write_text("1;\n" + OCTAVE)
    command = ["octave-cli", "--no-gui", "--quiet", "run.m"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)
    messages = done.stdout.strip().splitlines()
    return np.loadtxt(folder / "X.txt"), np.loadtxt(folder / "C.txt"), messages


def run_of_targets(controller, n_steps=60):
    """Return a start (n,), targets in small steps and what Python commands for them (T, n)."""
    n = controller.settings.task.steered[0].n_actuators
    q = rows_near(n, 1)[0]
    tracker = controller.tracker(q)
    goal = np.array(tracker.x, copy=True)
    rng = np.random.default_rng(1)
    targets = []
    for _ in range(n_steps):
        change = 2e-3 * rng.standard_normal(3)
        if goal.ndim == 2:
            goal[:3, 3] += change
        else:
            goal += change
        targets.append(goal.copy())
    return q, targets, np.array([tracker.step(target) for target in targets])


def in_unit(controller, q, targets, folder):
    """Return what a functional mock-up unit gives: commands (T, n), bytes, seconds of a step."""
    path = native.export_fmu(controller, folder / "a.fmu")
    unit = Unit(path, folder / "unpacked")
    unit.start(start=q)
    commands = []
    seconds = []
    for target in targets:
        unit.set(target=target)
        begin = time.perf_counter()
        unit.step(controller.settings.dt)
        seconds.append(time.perf_counter() - begin)
        commands.append(unit.get("command"))
    (library,) = (folder / "unpacked").glob("binaries/*/*")
    return np.array(commands), library.stat().st_size, float(np.median(seconds))


def main():
    """Print the table."""
    import run as microcontroller

    columns = ("controller", "FMU: difference", "library [kB]", "step [us]")
    columns += ("Octave: difference", "step [us]", "Cortex-M4F, float32")
    print(f"| {' | '.join(columns)} |")
    print("| --- " * len(columns) + "|")
    for kind, make in CONTROLLERS.items():
        controller = make()
        q, targets, commands = run_of_targets(controller)
        cells = [kind]
        with tempfile.TemporaryDirectory() as home:
            steps, size, seconds = in_unit(controller, q, targets, Path(home))
            difference = np.abs(steps - commands).max()
            cells += [f"{difference:.0e}", f"{size / 1e3:.0f}", f"{1e6 * seconds:.1f}"]
        if shutil.which("mkoctfile") and np.ndim(targets[0]) == 1:
            with tempfile.TemporaryDirectory() as home:
                _, steps, _ = in_octave(controller, q[None], targets, Path(home))
                seconds = float(np.loadtxt(Path(home) / "seconds.txt"))
            difference = np.abs(steps[:, :-1] - commands).max()
            cells += [f"{difference:.0e}", f"{1e6 * seconds:.0f}"]
        else:
            cells += ["", ""]
        if microcontroller.missing():
            cells.append("")
        else:
            difference = microcontroller.measured(controller)["cortex-m4"][0]
            cells.append(f"{difference:.0e}")
        print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
