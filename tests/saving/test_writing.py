"""What a save does to the folder: one whole file, equal for equal models, and nothing else."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from saved_models import arm, bent_chain, elastic_chain, tendon_chain, trunk

from hybridkin import load_model, save_model
from hybridkin._core.files import write_files

HERE = Path(__file__).parent
posix = pytest.mark.skipif(sys.platform == "win32", reason="needs POSIX: links, modes, locks")
# What a fit of every kind saves, and its hash, one line each.
FITS = """
import hashlib, sys
sys.path.insert(0, sys.argv[1])
import joblib, numpy as np, torch
from pathlib import Path
from saved_models import bent_chain, trunk, trunk_log
from hybridkin import ELMRegressor, HybridForwardModel, InverseKinematics, calibrate, save_model
q, x, groups = trunk_log(24)
result = calibrate(trunk(), torch.from_numpy(q), torch.from_numpy(x), ("radii", "base"))
models = {"arc": bent_chain(), "calibrated": result.chain, "elm": ELMRegressor(4, random_state=0)}
models["elm"].fit(q, x)
for name in ("linear", "quadratic"):
    model = HybridForwardModel(trunk(), name, calibrate=("radii",), random_state=0)
    models[name] = model.fit(q, x, groups=groups)
for name, model in models.items():
    path = Path(sys.argv[2]) / name
    save_model(model, path)
    print(name, joblib.hash(model), hashlib.sha256(path.read_bytes()).hexdigest())
print(joblib.hash(result), joblib.hash(InverseKinematics(result.chain, q_min=0.1, q_max=0.4)))
"""


def started(code, *arguments, seed="0"):
    command = [sys.executable, "-c", code, str(HERE), *map(str, arguments)]
    settings = {**os.environ, "PYTHONHASHSEED": seed, "SOURCE_DATE_EPOCH": "86400"}
    return subprocess.Popen(command, env=settings, stdout=subprocess.PIPE, text=True)


@pytest.mark.slow
def test_fits_in_two_processes_are_equal_in_hash_and_bytes(tmp_path):
    runs = [started(FITS, tmp_path, seed=seed) for seed in ("1", "2")]
    first, second = (run.communicate()[0].splitlines() for run in runs)
    assert len(first) == 6
    assert first == second


@pytest.mark.parametrize("build", [tendon_chain, bent_chain, elastic_chain, arm])
def test_equal_models_give_equal_bytes(tmp_path, build):
    for k in range(8):
        save_model(build(), tmp_path / f"{k}", training={"b": 1, "a": 2})
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


@posix
@pytest.mark.parametrize("there", [True, False])
def test_links_stay_and_their_targets_are_written(tmp_path, there):
    (tmp_path / "folder").mkdir()
    target, link = tmp_path / "folder" / "model", tmp_path / "link"
    if there:
        save_model(arm(), target)
    link.symlink_to(Path("folder") / "model")
    save_model(trunk(), link)
    assert link.is_symlink()
    assert os.readlink(link) == "folder/model"
    assert not target.is_symlink()
    assert load_model(target).n_actuators == load_model(link).n_actuators == 3
    assert [path.name for path in (tmp_path / "folder").iterdir()] == ["model"]


def test_content_is_on_the_disk_before_the_name_and_the_name_after(tmp_path, monkeypatch):
    steps, replace, fsync = [], os.replace, os.fsync

    def flushed(handle):
        steps.append("folder" if stat.S_ISDIR(os.fstat(handle).st_mode) else "file")
        fsync(handle)

    monkeypatch.setattr(os, "fsync", flushed)
    monkeypatch.setattr(os, "replace", lambda *paths: (steps.append("name"), replace(*paths)))
    save_model(trunk(), tmp_path / "model")
    assert steps == ["file", "name", "folder"][: 3 if sys.platform != "win32" else 2]


def test_a_save_that_fails_leaves_the_earlier_file_and_nothing_else(tmp_path, monkeypatch):
    path = tmp_path / "model"
    save_model(arm(), path)
    before = path.read_bytes()

    def full(_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        save_model(trunk(), path)
    assert path.read_bytes() == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def writers(text):
    return {name: lambda path, name=name: path.write_text(text + name) for name in "abc"}


def read(folder):
    return {path.name: path.read_text()[:-1] for path in folder.glob("[!.]*")}


def test_a_folder_is_written_file_by_file(tmp_path):
    out = tmp_path / "out"
    write_files(out, writers("old"))
    (out / "mine").write_text("kept")
    with pytest.raises(ZeroDivisionError):
        write_files(out, {"a": writers("new")["a"], "b": lambda path: 1 / 0})
    assert read(out) == {"a": "new", "b": "old", "c": "old", "mine": "kep"}
    write_files(out, writers("new"))
    assert read(out) == {**dict.fromkeys("abc", "new"), "mine": "kep"}
    assert len([*out.iterdir()]) == 4
