"""Exported C code: it compiles without a warning, and computes what the Python model does."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import rounding
import torch
from operators import operators, with_hysteresis
from painted import LIMIT, painted, stacks
from saved_models import FOLDER, elastic_chain, structural_chain, tendon_chain, trunk

from hybridkin import (
    ConstantCurvatureChain,
    ElasticTendonChain,
    IKStatus,
    InverseKinematics,
    as_forward_model,
    load_model,
    obstacles,
    robots,
)
from hybridkin._core.plan import NoKernel
from hybridkin.hybrid._features import PoseFeatures, Readout
from hybridkin.hybrid._module import HybridModule, InnerCorrection
from hybridkin.ik.tasks import AxisTask, PointsTask, PoseTask, as_task
from hybridkin.native import export_c

LOOP = Path(__file__).parents[2] / "examples" / "c" / "loop.c"
MODELS = ("chain_of_all_parts", "elastic_chain", "rigid", "serial_pose", "blend")
MODELS += ("drift_and_radius", "elm", "adapted")
WARNINGS = "-Wall -Wextra -pedantic -Wconversion -Wdouble-promotion -Werror".split()
CC = shutil.which("cc")
needs_cc = pytest.mark.skipif(CC is None, reason="needs a C compiler")


def limited(model, **settings):
    """Inverse kinematics within limits that suit the small models, 1 kHz."""
    extensible = getattr(as_task(model).models[0].robot, "lengths", 0.1) is None
    low, high = (0.15, 0.35) if extensible else (-0.004, 0.004)
    settings = {"q_min": low, "q_max": high, "dq_max": 1.0, "dt": 1e-3, "ddq_max": 2e3, **settings}
    return InverseKinematics(model, **settings)


def built(folder, *more, compiler=(CC,), sources=("robot.c", "robot_test.c")):
    """Compile files of an export, without optimization unless `more` says so: in less time."""
    program = folder / "program"
    options = [*compiler, "-std=c99", "-O0", *WARNINGS, "-I", folder, *more, "-o", program]
    done = subprocess.run([*options, *sources, "-lm"], cwd=folder, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return program


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", MODELS)
def test_the_code_computes_what_the_model_does(tmp_path, name, dtype):
    model = load_model(FOLDER / f"{name}.safetensors")
    export_c(model if name == "elm" else limited(model), tmp_path, name="robot", dtype=dtype)
    more = ["-O2"] if dtype == "float32" else ["-fsanitize=address,undefined"]
    done = subprocess.run([built(tmp_path, *more)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 failures" in done.stdout


def agrees(folder, model, dtype="float64"):
    """Whether the exported test passes; in single precision also with optimization."""
    export_c(model, folder, name="robot", dtype=dtype)
    more = ["-O2"] if dtype == "float32" else []
    done = subprocess.run([built(folder, *more)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout
    return "0 failures" in done.stdout


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("name", ["chain_of_all_parts", "elastic_hybrid", "elm"])
def test_a_model_in_float32_is_written_as_its_twin_in_float64(tmp_path, name):
    model = as_forward_model(load_model(FOLDER / f"{name}.safetensors")).float()
    assert agrees(tmp_path, model)
    assert torch.float32 in {entry.dtype for entry in model.state_dict().values()}


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_the_code_of_a_correction_on_errors_of_the_structure(tmp_path, dtype):
    chain = elastic_chain()
    rows = torch.linspace(-0.003, 0.003, 28).double().reshape(4, 7)
    features = PoseFeatures.of_range(rows, chain)
    weights = 1e-3 * np.random.default_rng(0).normal(size=(6, 38))
    correction = InnerCorrection(Readout(features, torch.from_numpy(weights)))
    hybrid = HybridModule(structural_chain(chain), [correction], torch.ones(1).double())
    assert agrees(tmp_path, hybrid, dtype=dtype)


TASKS = {
    "pose": (lambda: PoseTask(trunk(), radian=0.1), {}),
    "axis": (lambda: AxisTask(trunk(), [1.0, 0.0, 2.0], length=0.2), {}),
    "points": (lambda: PointsTask(trunk(), [0.5, 1.0]), {}),
    "half-spaces": (trunk, {"tip_limits": (np.eye(3), [0.03, 0.03, 0.29])}),
    "obstacles": (
        trunk,
        {
            "obstacles": [
                obstacles.Sphere([0.1, 0.0, 0.2], 0.04),
                obstacles.Box([0.0, 0.15, 0.2], [0.1, 0.1, 0.3]),
            ],
            "body_points": [(0.5, 0.03), (1.0, 0.03)],
        },
    ),
}


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "dtype"),
    [*((name, "float64") for name in TASKS), ("pose", "float32"), ("obstacles", "float32")],
)
def test_the_code_of_other_tasks(tmp_path, name, dtype):
    make, settings = TASKS[name]
    assert agrees(tmp_path, limited(make(), **settings), dtype=dtype)


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("kind", ["play", "plays, creep"])
def test_the_code_leads_by_the_hysteresis(tmp_path, kind, dtype):
    model = with_hysteresis(trunk(), operators(3, 1e-3)[kind])
    ik = InverseKinematics(model, q_min=0.15, q_max=0.35, dq_max=0.2, dt=0.02)
    assert agrees(tmp_path, ik, dtype=dtype)
    assert "what the actuators do" in (tmp_path / "robot.h").read_text()


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("kind", ["play", "plays", "creep", "plays, creep", "creep, play, plays"])
def test_commands_of_the_code_are_those_of_the_tracker(tmp_path, kind):
    n = trunk().n_actuators
    model = with_hysteresis(trunk(), operators(n, 1e-3)[kind])
    ik = InverseKinematics(model, q_min=0.15, q_max=0.35, dq_max=0.2, dt=0.02)
    start = np.linspace(0.22, 0.26, n)
    target = ik.tracker(start).x + np.array([0.02, -0.01, 0.005])
    export_c(ik, tmp_path, name="robot")
    numbers = [", ".join(map(repr, map(float, row))) for row in (start, target)]
    source = FOLLOWS.replace("[9]", f"[{n}]").replace("9;", f"{n};")
    (tmp_path / "follows.c").write_text(source % tuple(numbers))
    program = built(tmp_path, sources=("robot.c", "follows.c"))
    found = np.loadtxt(subprocess.check_output([program], text=True).splitlines())
    tracker = ik.tracker(start)
    expected = [tracker.step(target) for _ in found]
    close = rounding.of_commands([start, *expected])
    np.testing.assert_allclose(found[:, :n], expected, rtol=0, atol=close)


FOLLOWS = """
#include <stdio.h>
#include "robot.h"
int main(void) {
    const double start[9] = {%s}, target[3] = {%s};
    robot_state state;
    robot_reset(&state, start);
    for (int i = 0; i < 120; i++) {
        robot_step(&state, target, NULL, NULL);
        for (int j = 0; j < 9; j++) printf("%%.17g ", state.q[j]);
        printf("%%.17g\\n", state.error);
    }
    return 0;
}
"""


AMONG = """
#include <stdio.h>
#include "robot.h"
int main(void) {
    const double start[9] = {%s}, target[3] = {%s};
    double ball[19] = {%s};
    robot_state state;
    robot_reset(&state, start);
    for (int i = 0; i < 60; i++) {
        ball[0] -= 0.002;
        robot_obstacle(&state, 0, ball);
        robot_obstacle(&state, 2, ball); /* there is none */
        robot_step(&state, target, NULL, NULL);
        for (int j = 0; j < 9; j++) printf("%%.17g ", state.q[j]);
        printf("%%d\\n", state.blocked);
    }
    return 0;
}
"""


@needs_cc
@pytest.mark.slow
def test_the_code_keeps_clear_of_obstacles_that_move(tmp_path):
    chain = robots.bionic_handling_assistant()
    ball = obstacles.Sphere([0.35, 0.05, 0.65], 0.06)
    wall = obstacles.HalfSpace([0.0, -1.0, 0.0], -0.12)
    points = [(1.0, 0.05), (2.0, 0.05), (3.0, 0.05)]
    options = {"q_min": 0.15, "q_max": 0.35, "dq_max": 0.5, "body_points": points}
    ik = InverseKinematics(chain, obstacles=[ball, wall], **options)
    start = np.full(9, 0.25)
    target = np.array([0.1, 0.15, 0.7])
    export_c(ik, tmp_path, name="robot")
    rows = (start, target, ball.numbers.tolist())
    numbers = [", ".join(map(repr, map(float, row))) for row in rows]
    (tmp_path / "among.c").write_text(AMONG % tuple(numbers))
    sources = ("robot.c", "among.c")
    program = built(tmp_path, "-fsanitize=address,undefined", sources=sources)
    found = np.loadtxt(subprocess.check_output([program], text=True).splitlines())
    tracker = ik.tracker(start)
    expected = []
    blocked = []
    for k in range(len(found)):
        tracker.obstacles = [ball.moved([0.35 - 0.002 * (k + 1), 0.05, 0.65]), wall]
        expected.append(tracker.step(target))
        blocked.append(tracker.status is IKStatus.BLOCKED)
    close = rounding.of_commands([start, *expected])
    np.testing.assert_allclose(found[:, :9], expected, rtol=0, atol=close)
    assert sum(blocked) > 10
    assert (found[:, 9] >= blocked).all()
    readme = (tmp_path / "README.md").read_text()
    assert "3 points of the body keep clear of 2 obstacles" in readme


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize(  # beyond the tip; within reach, but singular
    ("distance", "limits"), [(0.02, {"dq_max": 0.2, "ddq_max": 1.0}), (-0.02, {})]
)
def test_the_code_rests_and_leaves_singular_configurations_as_python_does(
    tmp_path, distance, limits
):
    chain = robots.bionic_handling_assistant()
    ik = InverseKinematics(chain, q_min=0.15, q_max=0.35, beta=0.0, **limits)
    start = np.full(9, 0.35)
    target = ik.tracker(start).x + np.array([0.0, 0.0, distance])
    if distance > 0.0:
        start = np.linspace(0.3, 0.34, 9)
    export_c(ik, tmp_path, name="robot")
    numbers = (", ".join(map(repr, map(float, a))) for a in (start, target))
    (tmp_path / "main.c").write_text(FOLLOWS % tuple(numbers))
    printed = subprocess.check_output([built(tmp_path, sources=("main.c", "robot.c"))], text=True)
    *commands, error = np.array(printed.split(), float).reshape(120, 10).T
    tracker = ik.tracker(start)
    expected = [tracker.step(target) for _ in range(120)]
    np.testing.assert_allclose(np.array(commands).T, expected, rtol=0, atol=1e-9)
    assert abs(error[-1] - max(distance, 0.0)) < 1e-5


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("start", [0.0, 0.005])  # straight; all tendons slack
def test_on_tendons_that_only_pull_it_arrives_as_in_python(tmp_path, start):
    chain = ElasticTendonChain([0.01] * 3, [0.1] * 3)
    ik = InverseKinematics(chain, q_min=-0.01, q_max=0.01, dq_max=0.05, dt=0.02)
    q = np.full(9, start)
    target = chain(torch.from_numpy(np.random.default_rng(0).uniform(-0.01, 0.01, 9))).numpy()
    export_c(ik, tmp_path, name="robot")
    numbers = (", ".join(map(repr, map(float, a))) for a in (q, target))
    (tmp_path / "main.c").write_text(FOLLOWS % tuple(numbers))
    printed = subprocess.check_output([built(tmp_path, sources=("main.c", "robot.c"))], text=True)
    *commands, error = np.array(printed.split(), float).reshape(120, 10).T
    assert error[-20:].max() < 1e-4
    tracker = ik.tracker(q)
    expected = [tracker.step(target) for _ in range(120)]
    close = rounding.of_commands([q, *expected])
    np.testing.assert_allclose(np.array(commands).T, expected, rtol=0, atol=close)


@needs_cc
@pytest.mark.slow
def test_code_for_motors_moves_the_robot_as_in_metres(tmp_path):
    """Some motors turn the other way; limits, rates, weights and the posture are in radians."""
    n = trunk().n_actuators
    gains = np.array([0.02, -0.05, 0.03, 0.04, -0.02, -0.03])[:n]
    radii = trunk().radii.tolist()
    settings = {
        "q_min": np.full(n, 0.15),
        "q_max": np.full(n, 0.3),
        "q_pref": np.linspace(0.2, 0.25, n),
    }
    rates = {"dq_max": np.linspace(0.05, 0.1, n), "ddq_max": np.full(n, 0.8)}
    weights = np.linspace(1.0, 3.0, n)
    plain = InverseKinematics(
        ConstantCurvatureChain(radii), **settings, **rates, weights=weights, beta=5.0, dt=0.02
    )
    ends = np.sort([settings["q_min"] / gains, settings["q_max"] / gains], axis=0)
    motors = InverseKinematics(
        ConstantCurvatureChain(radii, gains=gains),
        q_min=ends[0],
        q_max=ends[1],
        q_pref=settings["q_pref"] / gains,
        dq_max=rates["dq_max"] / np.abs(gains),
        ddq_max=rates["ddq_max"] / np.abs(gains),
        weights=weights * gains**2,
        beta=5.0,
        dt=0.02,
    )
    start = np.linspace(0.22, 0.26, n)
    target = plain.tracker(start).x + np.array([0.03, -0.01, 0.02])
    export_c(motors, tmp_path, name="robot")
    listed = [", ".join(map(repr, map(float, row))) for row in (start / gains, target)]
    source = FOLLOWS.replace("[9]", f"[{n}]").replace("9;", f"{n};")
    (tmp_path / "follows.c").write_text(source % tuple(listed))
    program = built(tmp_path, sources=("robot.c", "follows.c"))
    found = np.loadtxt(subprocess.check_output([program], text=True).splitlines())
    tracker = plain.tracker(start)
    expected = np.array([tracker.step(target) for _ in found])
    # A box-limited step is good to 1e-9 of its size; they add up over the rows.
    np.testing.assert_allclose(found[:, :n] * gains, expected, rtol=0, atol=1e-8)
    assert np.abs(np.diff(expected, axis=0)).max() / 0.02 > 0.04  # the limits were met


def test_the_readme_has_the_period(tmp_path):
    ik = InverseKinematics(trunk(), q_min=0.1, q_max=0.4, dt=0.02)
    export_c(ik, tmp_path, name="robot")
    readme = (tmp_path / "README.md").read_text()
    assert "create_wall_timer(std::chrono::duration<double>(0.02), [this]" in readme


@needs_cc
@pytest.mark.slow
@pytest.mark.parametrize("among", [False, True])
def test_the_readme_bounds_the_stack(tmp_path, among):
    settings = TASKS["obstacles"][1] if among else {}
    model = limited(load_model(FOLDER / "blend.safetensors"), **settings)
    export_c(model, tmp_path, name="robot")
    readme = " ".join((tmp_path / "README.md").read_text().split())
    bound = int(re.search(r"on top\): \d+ and (\d+) bytes", readme)[1])
    program = painted(tmp_path, "-DEXPORTED", "-DSTEPS", "-Os", tmp_path / "robot.c")
    found = stacks(program)
    assert found
    for name, size in found.items():
        assert 0 < size <= bound + 1024, name  # and the functions of math.h
    assert bound <= LIMIT


@needs_cc
@pytest.mark.slow
def test_a_wrong_number_fails_the_test(tmp_path):
    export_c(limited(tendon_chain()), tmp_path, name="robot")
    source = (tmp_path / "robot.c").read_text()
    begin, number, _ = source.partition("static const real data[] = {\n")[2].split(", ", 2)
    wrong = source.replace(f"{begin}, {number}, ", f"{begin}, 1e-3, ", 1)
    assert wrong != source
    (tmp_path / "robot.c").write_text(wrong)
    done = subprocess.run([built(tmp_path)], capture_output=True, text=True)
    assert done.returncode == 1
    assert "forward, row" in done.stdout
    assert "step, row" in done.stdout


@needs_cc
@pytest.mark.slow
def test_the_loop_of_the_docs_runs(tmp_path):
    chain = ConstantCurvatureChain([0.10, 0.093, 0.079])
    export_c(InverseKinematics(chain, q_min=0.15, q_max=0.35, dt=1e-3), tmp_path, name="robot")
    program = built(tmp_path, "-DTICKS=300", sources=[LOOP, "robot.c"])
    *lines, last = subprocess.check_output([program], text=True).splitlines()
    counts = [[int(word) for word in line.split()[1:]] for line in lines]
    assert [sum(column) for column in zip(*counts, strict=True)] == [300, 300]
    assert "worst: command after" in last


def test_only_files_of_an_export_are_replaced(tmp_path):
    rigid = load_model(FOLDER / "rigid.safetensors")
    header, *_, readme = export_c(rigid, tmp_path, name="arm_3")
    assert "arm_3_jacobian" in header.read_text()
    assert "at most about 515 additions" in readme.read_text()  # 470 are counted by valgrind
    text = readme.read_text()
    readme.write_text("hybridkin, an earlier one")
    export_c(rigid, tmp_path, name="arm_3")
    assert readme.read_text() == text
    readme.write_text("mine")
    with pytest.raises(FileExistsError, match=r"has README\.md already, which `hybridkin export`"):
        export_c(rigid, tmp_path, name="arm_3")


def test_code_that_needs_too_much_stack_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("hybridkin.native.export._MOST_STACK", 1000)
    with pytest.raises(NoKernel, match="its sizes need more than 64 KiB of stack"):
        export_c(tendon_chain(), tmp_path / "out")


def test_wrong_arguments(tmp_path):
    for options, message in (
        ({"dtype": "float16"}, r"`dtype` must be .* got 'float16'"),
        ({"name": "3_arm"}, "must be a valid name in C, e.g. trunk_3, got '3_arm'"),
    ):
        with pytest.raises(ValueError, match=message):
            export_c(tendon_chain(), tmp_path / "out", **options)
    with pytest.raises(NoKernel, match=r"cannot be written in C: a FunctionModel .* use it from"):
        export_c(lambda q: q, tmp_path / "out")
    for ik, reason in (
        (limited(tendon_chain(), q_pref=lambda q: 0.0 * q), "a posture that is a function"),
        (limited(PointsTask(tendon_chain(), np.linspace(0.1, 1.0, 9))), "27 rows of a task"),
    ):
        with pytest.raises(NoKernel, match=f"cannot be written in C: {reason}"):
            export_c(ik, tmp_path / "out")
    with pytest.raises(TypeError, match="`model` must be"):
        export_c(3, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def readme_of(tmp_path, **limits):
    chain = robots.bionic_handling_assistant()
    ik = InverseKinematics(chain, dt=0.01, **limits)
    export_c(ik, tmp_path, name="robot", force=True)
    return " ".join((tmp_path / "README.md").read_text().split())


def test_limits_are_told_in_three_digits_and_absent_ones_in_words(tmp_path):
    q_min = np.full(9, 0.1)
    q_min[2] = 0.1234567
    limits = {"q_min": q_min, "q_max": 0.4}
    told = readme_of(tmp_path, **limits)
    low = "(0.1, 0.1, 0.123, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1)"
    assert f"keeps q between {low} and 0.4. It has no limit of its speed and of its" in told
    assert "inf" not in told.partition("It keeps")[2].partition("If no limit")[0]
    assert "0.1234567" in (tmp_path / "robot.c").read_text()  # the code computes with all digits
    told = readme_of(tmp_path, **limits, dq_max=0.123456)
    assert "and its speed below 0.123 per second. It has no limit of its acceleration." in told
    assert "returns at that speed" in told
    told = readme_of(tmp_path)
    assert "It keeps q above 0. It has no limit of its speed and of its acceleration." in told


def test_files_name_what_they_hold_in_words(tmp_path):
    assert readme_of(tmp_path, q_min=0.1, q_max=0.4).startswith(
        "# robot Inverse kinematics with 9 actuators"
    )
    header = (tmp_path / "robot.h").read_text()
    assert header.startswith("/* Inverse kinematics: written by hybridkin")
