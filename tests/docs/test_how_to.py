"""The code of the pages in docs/how_to runs as printed, and does what they say."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from page_blocks import DOCS, blocks_of, commands_of, read, written_on

from hybridkin import load_model
from hybridkin.app.cli.main import main

NEEDS_COMPILER = pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler")
NEEDS_OCTAVE = pytest.mark.skipif(
    shutil.which("mkoctfile") is None, reason="needs Octave: apt install octave octave-dev"
)
# Pages that need more than Python to run.
MARKS = {"systems": [NEEDS_COMPILER]}
PAGES = [pytest.param(page, marks=MARKS.get(page, [])) for page in written_on("how_to")]
# What takes long on a page, and less of it.
SHORTER = {
    "scikit_learn": [("GroupKFold(4)", "GroupKFold(2)"), ("[1e-3, 0.1]", "[1e-3]")],
    "obstacles": [("--size 80,40", "--size 80,40 --duration 2")],
}


def numbers_after(text, printed):
    """Return the first number after each occurrence of a text."""
    return [float(number) for number in re.findall(rf"{re.escape(text)} *([-\d.e]+)", printed)]


def next_rows(reader):
    rows_of = {"plan": 20, "more": 10}
    for folder, n_rows in rows_of.items():
        header, *rows = (Path(folder) / "next.csv").read_text().splitlines()
        assert len(rows) == n_rows
        assert {"s1", "s6", "expected_error"} <= {*re.split(r"[,\s]", header)}
    expected_error = reader.space["expected_error"]
    assert expected_error.shape == (20,)
    assert expected_error[-1] < 0.5 * expected_error[0]
    assert "lead segment 1 around a circle" in reader.printed
    assert "differ by up to" in reader.printed


def history(reader):
    assert "backlash and creep" in reader.printed
    (with_hysteresis,) = numbers_after("hysteresis:", reader.printed)
    (without,) = numbers_after("none:", reader.printed)
    assert with_hysteresis < 0.1 * without
    (before,) = numbers_after("as it was:", reader.printed)
    (after,) = numbers_after("adapted:", reader.printed)
    assert after < 0.5 * before
    inside = re.search(r"(\d+) % of the rows are in the domain", reader.printed)
    assert inside
    assert int(inside[1]) > 80
    # The commands lead what the actuators do, and stay within their limits.
    track = reader.space["track"]
    assert np.abs(track.q - track.effective).max() > 1e-3
    assert track.q.min() >= 0.17
    assert track.q.max() <= 0.29
    # The morning begins in the state that the night has left.
    tracker = reader.space["tracker"]
    np.testing.assert_array_equal(tracker.state, reader.space["state"])
    np.testing.assert_array_equal(tracker.q, reader.space["q"])
    np.testing.assert_array_equal(tracker.effective, tracker.state[-1])


def slack_tendons(reader):
    assert "ElasticTendonChain(3 segments, 9 actuators" in reader.printed
    assert numbers_after("routing 'base')", reader.printed)[0] < 1.0  # mm, with 0.3 in each axis
    assert reader.space["slack"].any()
    assert reader.space["result"].cv_rmse < 1e-3
    assert (reader.space["tentacle"].n_actuators, reader.space["chain"].n_actuators) == (2, 9)


def markers(reader):
    assert "(2, 9)" in reader.printed
    assert "[ True]" in reader.printed
    assert np.isfinite(reader.space["model"].predict(reader.space["q"])).all()


def obstacles(reader):
    report = Path("track/report.md").read_text()
    assert "BLOCKED: 0 points" in report
    least = re.findall(r"\| (?:table|pipe|obstacle \d) +\| +([\d.]+)", report)
    assert len(least) == 4
    assert min(map(float, least)) >= 4.99  # mm
    assert Path("track.html").is_file()
    assert "BLOCKED [0.014 0.005" in reader.printed
    ik = reader.space["ik"]
    middles, radii = ik.body_balls(np.zeros(6))
    np.testing.assert_allclose(radii, [0.012, 0.012, 0.010, 0.010])
    assert middles.shape == (4, 3)


def realtime(reader):
    status, error = re.search(r"^([A-Z_]+) ([\d.]+) mm$", reader.printed, re.MULTILINE).groups()
    assert status == "CONVERGED"
    assert float(error) < 0.01
    assert not reader.space["tracker"].rejected


def describing(reader):
    assert "4 segments, 7 actuators" in reader.printed
    counts = np.genfromtxt("track/track.csv", delimiter=",", names=True)
    assert all((counts[f"m{k}"] % 1 == 0).all() for k in range(1, 7))
    text = Path("bellows.toml").read_text()
    assert "gain = 0.02\n" in text
    assert "zeros = -5.0\n" in text


def rigid_arms(reader):
    assert "q_max=1.5 to 2 of the model, dq_max=3 to 4 of the model" in reader.printed
    assert "<!-- measured in May -->" in Path("calibrated.urdf").read_text()


def autograd(reader):
    said = reader.printed.splitlines()
    assert said[0] == said[4] == "tensor(True)", said
    assert said[1] == "1.79 mm tensor(True)"
    network, true_lengths = (float(line.split()[-2]) for line in said[2:4])
    assert network < true_lengths + 0.02
    before, after = (int(number) for number in re.findall(r"\d+", said[5])[:2])
    assert before > 3 * after


def scikit_learn(reader):
    rows, motions, *_, own = re.findall(r"^([\d.]+) mm", reader.printed, re.MULTILINE)
    assert float(motions) < 0.8 * float(rows)
    assert float(own) < 0.8 * float(motions)
    assert "'error_model': 'elm'" in reader.printed
    assert "\n0.0\n" in reader.printed


def systems(reader):
    fmpy = pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
    assert np.isfinite(reader.space["result"]["error"][1:]).all()
    page = reader.page.read_text(encoding="utf-8")
    table = page[page.index("| controller |") :].splitlines()[0]
    named = {*re.findall(r"`(\w+)`", table)}
    variables = fmpy.read_model_description("robot.fmu").modelVariables
    causal = [v.name for v in variables if v.causality in ("input", "output", "parameter")]
    present = {re.match(r"\w+", name)[0] for name in causal}
    assert present <= named
    # This robot has no hysteresis and no obstacles, and its description no limit of acceleration.
    assert named - present <= {"effective", "ddq_max", "obstacles", "blocked"}


def troubleshooting(reader):
    assert "no errors and no warnings" in reader.printed
    assert "1 CONVERGED" in reader.printed


def view(reader):
    assert "http://127.0.0.1:" in reader.printed


# What a page says of what its blocks print or write.
CHECKS = {
    "autograd": autograd,
    "scikit_learn": scikit_learn,
    "next_rows": next_rows,
    "history": history,
    "slack_tendons": slack_tendons,
    "markers": markers,
    "obstacles": obstacles,
    "realtime": realtime,
    "rigid_arms": rigid_arms,
    "systems": systems,
    "describing": describing,
    "troubleshooting": troubleshooting,
    "view": view,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    if page == "systems":
        pytest.importorskip("fmpy", reason="needs fmpy: pip install fmpy")
    read("how_to", page, SHORTER, CHECKS)


def block_in(page, language):
    """Return the block of a page in a language that it has once."""
    blocks = blocks_of(DOCS / "how_to" / f"{page}.md")
    (text,) = (block.text for block in blocks if block.language == language)
    return text


def command_in(page, *words):
    """Return the line of the console blocks of a page that holds these words."""
    blocks = blocks_of(DOCS / "how_to" / f"{page}.md")
    lines = "".join(block.text for block in blocks if block.language == "console").splitlines()
    (line,) = (line for line in lines if all(word in line for word in words))
    return line


@pytest.mark.slow
@NEEDS_COMPILER
def test_c_of_the_control_loop_reaches_its_target(lab):
    assert main(commands_of(command_in("realtime", "hybridkin export"))[0][1:]) == 0
    program = block_in("realtime", "c")
    name = re.match(r"/\* (\S+\.c) \*/", program)
    assert name
    Path(name[1]).write_text(program)
    build = command_in("realtime", "cc ").replace("-O2", "-O2 -Wall -Werror")
    done = subprocess.run(["sh", "-c", build], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout == "0.000 mm\n"


@pytest.mark.slow
@NEEDS_OCTAVE
def test_matlab_of_other_systems_reaches_its_target(lab):
    assert main(commands_of(command_in("systems", "hybridkin export", "--mex"))[0][1:]) == 0
    subprocess.run(["mkoctfile", "--mex", "robot.c"], cwd="matlab", check=True)
    ending = 'printf("%.17g ", x, J, error);\n'
    Path("matlab/page.m").write_text(f"1;\n{block_in('systems', 'matlab')}{ending}")
    command = ["octave-cli", "--no-gui", "--quiet", "page.m"]
    done = subprocess.run(command, cwd="matlab", capture_output=True, text=True, check=False)
    *numbers, error = map(float, done.stdout.split())
    assert len(numbers) == 3 + 3 * 6
    model = load_model("model/model.safetensors")
    tip = model.predict(np.zeros((1, 6)))[0]
    np.testing.assert_allclose(numbers[:3], tip, rtol=1e-12, atol=1e-12)
    assert error < 1e-5
