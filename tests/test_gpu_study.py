"""The prepared study of models on a GPU, which runs here on the CPU; and devices of tensors."""

import csv
import os
import subprocess
import sys
from pathlib import Path

import gpu
import gpu_models
import pytest
import torch
from torch.utils import backend_registration

ROOT = Path(__file__).parents[1]
# What hybridkin can use and the study must do without.
BLOCKED = "pytorch_kinematics lxml rich matplotlib mujoco viser"
TWO = ("tendons with gains", "hybrid, linear")


def run_alone(*arguments, blocked=""):
    """Return a script's exit code and output, in a process without some packages."""
    code = "import runpy, sys; sys.modules.update(dict.fromkeys(sys.argv[1].split()))\n"
    code += "sys.argv = sys.argv[2:]; runpy.run_path(sys.argv[0], run_name='__main__')"
    paths = os.pathsep.join(map(str, (ROOT, ROOT / "tests", ROOT / "examples" / "studies")))
    finished = subprocess.run(
        [sys.executable, "-c", code, blocked, *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": paths},
        capture_output=True,
        text=True,
    )
    return finished.returncode, finished.stdout + finished.stderr


def numbers_of(folder):
    with open(folder / "gpu.csv", newline="", encoding="utf-8") as file:
        return [*csv.DictReader(file)]


@pytest.fixture
def few(monkeypatch):
    """Leave two kinds of models, and nothing that takes long."""
    monkeypatch.setattr(gpu, "KINDS", {name: gpu_models.KINDS[name] for name in TWO})
    for name in ("compare_fits", "speed", "fits_of_many_rows"):
        monkeypatch.setattr(gpu, name, lambda *_: None)


def run(folder, *more):
    return gpu.main(["--device", "cpu", "--quick", "--out", str(folder), *more])


@pytest.mark.slow
def test_all_parts_run_with_the_named_packages_alone(tmp_path):
    script = ROOT / "examples" / "studies" / "gpu.py"
    arguments = ("--device", "cpu", "--quick", "--out", tmp_path)
    code, output = run_alone(script, *arguments, blocked=BLOCKED)
    assert code == 0, output
    report = (tmp_path / "gpu.md").read_text(encoding="utf-8")
    assert report in output
    assert "left out: pytorch_kinematics on the same device: it is not installed" in output

    numbers = numbers_of(tmp_path)
    compared = [row for row in numbers if row["part"] == "correctness"]
    assert {row["verdict"] for row in compared} == {"agrees"}
    assert {*gpu_models.KINDS} <= {row["model"] for row in compared}
    for model in gpu_models.KINDS:
        assert f"\n| {model} | " in report
    # Both precisions of every job are timed, and only positive times are.
    times = [row for row in numbers if row["part"] == "speed"]
    assert {row["dtype"] for row in times} == {"float64", "float32"}
    assert {row["what"] for row in times} == {"FK and J", "pose and J", "solve", "fit by blocks"}
    assert all(float(row["value"]) > 0.0 for row in times)


@pytest.mark.slow
@pytest.mark.parametrize("moved_by", [3e-9, torch.nan])
def test_a_model_that_differs_on_the_device_fails_at_the_end(tmp_path, monkeypatch, few, moved_by):
    """The base moves by 3e-9 m, 3e-8 of the robot: not seen without a tolerance near rounding."""
    moved = gpu.moved

    def wrong(model, device):
        twin = moved(model, device)
        if isinstance(twin, gpu.Chain):
            twin.base[0, 3] += moved_by
        return twin

    monkeypatch.setattr(gpu, "moved", wrong)
    assert run(tmp_path) == 1
    verdicts = {(row["model"], row["what"]): row["verdict"] for row in numbers_of(tmp_path)}
    assert verdicts[TWO[0], "x"] == "DIFFERS"
    assert verdicts[TWO[1], "x"] == "agrees"  # everything else still runs
    report = (tmp_path / "gpu.md").read_text(encoding="utf-8")
    assert f"## Failed\n\n- {TWO[0]}, x: " in report


@pytest.mark.slow
def test_an_exception_ends_no_other_part(tmp_path, monkeypatch, few, capsys):
    def broken(*_):
        raise RuntimeError("no kernel image is available")

    def full(*_):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory.")

    kinds = {"broken": broken, **gpu.KINDS}
    monkeypatch.setattr(gpu, "KINDS", kinds)
    monkeypatch.setattr(gpu, "compare_track", broken)
    monkeypatch.setattr(gpu, "speed", full)
    assert run(tmp_path) == 1
    output = capsys.readouterr().out
    assert "FAILED: broken: RuntimeError in test_gpu_study.py" in output
    assert "no kernel image is available" in output
    assert "left out: speed: out of memory" in output  # no failure
    assert {row["model"] for row in numbers_of(tmp_path)} == {*TWO}


def test_what_no_time_is_left_for_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(gpu, "KINDS", dict.fromkeys(TWO))
    monkeypatch.setattr(gpu, "compare_fits", lambda _: None)
    monkeypatch.setattr(gpu, "jobs", list)
    assert run(tmp_path, "--minutes", "0") == 0
    output = capsys.readouterr().out
    for name in TWO:
        assert f"left out: {name}: no time left" in output
    assert "left out: speed at 100 rows: no time left" in output
    assert "left out: fit of a network to 10000 rows on cpu: no time left" in output
    assert numbers_of(tmp_path) == []


def test_without_a_gpu_it_names_the_way_out(capsys, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with pytest.raises(SystemExit) as error:
        gpu.main([])
    assert error.value.code == 2
    assert "--device cpu --quick" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(
    not hasattr(backend_registration, "_setup_privateuseone_for_python_backend"),
    reason="needs a torch that can pretend a device",
)
def test_models_and_rows_may_be_on_a_device_that_is_not_the_cpu():
    code, output = run_alone(ROOT / "tests" / "pretended_device.py")
    assert code == 0, output
