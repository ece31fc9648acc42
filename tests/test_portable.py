"""Tests with other arithmetic, as on other processors; `make portable` runs all quick ones so."""

from collections import Counter

import portable
import pytest

FILES = (
    "tests/calibration/test_choice.py",
    "tests/core/test_directions.py",
    "tests/app/checks/test_check_log.py::test_clean_logs_pass",
    "tests/hybrid/test_guards.py",
    "tests/ik/test_hysteresis.py::test_the_core_commands_what_torch_does[speed-plays, creep]",
    "tests/ik/test_hysteresis.py::test_the_core_commands_what_torch_does[speed-play]",
)
RUNS = (0, 1)  # without the core and with two threads; other instructions of everything


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS)
def test_other_arithmetic_passes(run):
    settings = portable.arithmetic(run, seed=0)
    if portable.lacking(settings):
        pytest.skip("needs another processor: this one has no AVX2")
    done = portable.tested(settings, run, "-m", "not slow", *FILES)
    assert done.returncode == 0, done.stdout[-5000:] + done.stderr[-2000:]


SEEN = """
import os
import threadpoolctl, torch
from hybridkin.native import library

def test_what_computes():
    assert library.library() is not None and "hk_v3" in library.library()._name
    pools = threadpoolctl.threadpool_info()
    kernels = {pool["architecture"] for pool in pools if pool["internal_api"] == "openblas"}
    assert kernels == {"Haswell"}
    assert torch.backends.cpu.get_cpu_capability() == "DEFAULT"
    assert os.environ["MKL_ENABLE_INSTRUCTIONS"] == "AVX2"
    assert torch.get_num_threads() == 2

def test_that_fails():
    assert "hk_v2" in library.library()._name
"""


@pytest.mark.slow
@pytest.mark.needs_core
def test_the_settings_arrive_and_a_failure_is_one(tmp_path):
    settings = dict(
        HYBRIDKIN_NATIVE="v3",
        OPENBLAS_CORETYPE="Haswell",
        ATEN_CPU_CAPABILITY="default",
        MKL_ENABLE_INSTRUCTIONS="AVX2",
        OMP_NUM_THREADS="2",
    )
    if portable.lacking(settings):
        pytest.skip("needs another processor: this one has no AVX2")
    seen = tmp_path / "test_seen.py"
    seen.write_text(SEEN)
    arguments = ["-c", "pyproject.toml", "--confcutdir=tests", "-p", "conftest", str(seen)]
    done = portable.tested(settings, 0, *arguments)
    assert "1 failed, 1 passed" in done.stdout
    assert "test_that_fails" in done.stdout
    assert done.returncode == 1


def test_every_setting_stands_twice_and_every_core_meets_every_blas():
    pairs = set()
    for seed in range(3):
        runs = [portable.arithmetic(run, seed) for run in range(portable.N_RUNS)]
        for name in runs[0]:
            counts = Counter(settings[name] for settings in runs)
            assert min(counts.values()) >= 2
        pairs |= {(s["HYBRIDKIN_NATIVE"], s["OPENBLAS_CORETYPE"]) for s in runs}
    assert len(pairs) == len(portable.CORES) * len(portable.CORETYPES)
