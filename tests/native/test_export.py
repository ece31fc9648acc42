"""Exported C code: it compiles without a warning, and computes what the Python model does."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from saved_models import FOLDER, tendon_chain

from hybridkin import ConstantCurvatureChain, InverseKinematics, as_forward_model, load_model
from hybridkin.cli.main import main
from hybridkin.native import export_c
from hybridkin.native.plan import NoKernel

LOOP = Path(__file__).parents[2] / "examples" / "c" / "loop.c"
MODELS = ("chain_of_all_parts", "elastic_chain", "rigid", "serial_pose", "blend")
MODELS += ("drift_and_radius", "elm", "adapted")
WARNINGS = "-Wall -Wextra -pedantic -Wconversion -Wdouble-promotion -Werror".split()
CC, ZIG = shutil.which("cc"), importlib.util.find_spec("ziglang")
needs_cc = pytest.mark.skipif(CC is None, reason="no C compiler `cc`")
needs_zig = pytest.mark.skipif(ZIG is None, reason="the package ziglang is not there")


def limited(model, **settings):
    """Inverse kinematics within limits that suit the small models, 1 kHz."""
    extensible = getattr(as_forward_model(model).robot, "lengths", 0.1) is None
    low, high = (0.15, 0.35) if extensible else (-0.004, 0.004)
    settings = {"q_min": low, "q_max": high, "dq_max": 1.0, "dt": 1e-3, "ddq_max": 2e3, **settings}
    return InverseKinematics(model, **settings)


def built(folder, *more, compiler=(CC,), sources=("robot.c", "robot_test.c")):
    """Compile files of an export, and return the program."""
    program = folder / "program"
    options = [*compiler, "-std=c99", "-O2", *WARNINGS, "-I", folder, *more, "-o", program]
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
    more = [] if dtype == "float32" else ["-O1", "-fsanitize=address,undefined"]
    done = subprocess.run([built(tmp_path, *more)], capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "0 failures" in done.stdout


@needs_zig
@pytest.mark.slow
@pytest.mark.parametrize("target", ["x86_64-linux-gnu", "aarch64-linux-gnu"])
def test_clang_compiles_the_code_for_other_processors(tmp_path, target):
    export_c(limited(tendon_chain()), tmp_path, name="robot", dtype="float32")
    compiler = (sys.executable, "-m", "ziglang", "cc", "-target", target)
    assert built(tmp_path, compiler=compiler).read_bytes()[:4] == b"\x7fELF"


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


@needs_cc
def test_the_code_holds_what_the_model_needs_and_no_more(tmp_path):
    source = export_c(load_model(FOLDER / "rigid.safetensors"), tmp_path)[1]
    assert not any(word in source.read_text() for word in ("malloc", "hkv_", "ik_tick", "@"))
    options = ["-std=c99", "-O1", "-fno-inline", "-c", source, "-o", tmp_path / "model.o"]
    subprocess.run([CC, *options], check=True)
    names = (tmp_path / "model.o").read_bytes()
    assert b"hk_rigid" in names
    assert not any(name in names for name in (b"hk_stumpff", b"hk_settle", b"hk_elm"))


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
    with pytest.raises(FileExistsError, match=r"has a README\.md of another origin"):
        export_c(rigid, tmp_path, name="arm_3")


def test_wrong_arguments(tmp_path):
    for options, message in (
        ({"dtype": "float16"}, r"`dtype` must be .* got 'float16'"),
        ({"name": "3_arm"}, "must be a valid name in C, e.g. trunk_3, got '3_arm'"),
    ):
        with pytest.raises(ValueError, match=message):
            export_c(tendon_chain(), tmp_path / "out", **options)
    with pytest.raises(NoKernel, match=r"cannot be written in C: a FunctionModel .* use it from"):
        export_c(lambda q: q, tmp_path / "out")
    with pytest.raises(NoKernel, match=r"cannot be written in C: .* posture"):
        export_c(limited(tendon_chain(), q_pref=lambda q: 0.0 * q), tmp_path / "out")
    with pytest.raises(TypeError, match="`model` must be"):
        export_c(3, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@needs_cc
@pytest.mark.slow
def test_command_line(tmp_path, capsys):
    robot = tmp_path / "robot.toml"
    robot.write_text(
        "[[segment]]\nradius = 0.005\nlength = 0.1\nrepeat = 2\n"
        "[limits]\nq_min = -0.004\nq_max = 0.004\ndq_max = 0.1\nddq_max = 5.0\n"
    )
    out = str(tmp_path / "c")
    options = ["--out", out, "--name", "robot", "--dtype", "float32", "--dt", "0.002"]
    assert main(["export", str(robot), *options]) == 0
    assert "Steps of 0.002 s within limits: robot description." in capsys.readouterr().out
    readme = Path(out, "README.md").read_text()
    assert "every 0.002 s" in readme
    assert "change of\nthat speed below (5, 5, 5, 5, 5, 5) per second" in readme
    assert subprocess.run([built(Path(out))], capture_output=True).returncode == 0


def test_files_are_replaced_once_all_are_written(tmp_path, monkeypatch):
    """Another process may write or read them at the same time."""
    before = {path: path.read_text() for path in export_c(tendon_chain(), tmp_path)}

    def stopped(source):
        raise OSError("stopped")

    monkeypatch.setattr("hybridkin.native.export._measured", stopped)
    with pytest.raises(OSError, match="stopped"):
        export_c(ConstantCurvatureChain([0.05]), tmp_path)
    assert {path: path.read_text() for path in tmp_path.iterdir()} == before
