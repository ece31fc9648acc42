"""Run the quick tests with other arithmetic, as on other processors, and print a table.

    python tests/portable.py --seed 1

Each of the eight runs is a process of its own, with other instructions of the compiled core, of
NumPy's and SciPy's BLAS, of torch's loops and of its BLAS, with one or two threads, and with other
examples of the property tests. Every setting stands in at least two runs; the seeds 0, 1 and 2
together pair every core with every BLAS. Exit code 1 if a test fails.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import time
from pathlib import Path

import torch

ROOT = Path(__file__).parents[1]
N_RUNS = 8
CORES = ("off", "v2", "v3", "v4")  # of hybridkin.native
CORETYPES = ("", "Haswell", "SkylakeX", "Zen")  # of OpenBLAS; the first one is its own choice
CAPABILITIES = ("default", "avx2")  # of torch's loops
INSTRUCTIONS = ("SSE4_2", "AVX2", "AVX512")  # of MKL, which takes the best that there are below it
NEEDS = {"v4": "AVX512", "SkylakeX": "AVX512", "v3": "AVX2", "Haswell": "AVX2", "Zen": "AVX2"}


def arithmetic(run: int, seed: int) -> dict[str, str]:
    """Return the environment variables of a run; an empty one is not set."""
    half, k = divmod(run, 4)
    two_threads = k == (seed + 2 * half) % 4
    return {
        "HYBRIDKIN_NATIVE": CORES[k],
        "OPENBLAS_CORETYPE": CORETYPES[(k + half + seed) % 4],
        "ATEN_CPU_CAPABILITY": CAPABILITIES[(half + k) % 2],
        "MKL_ENABLE_INSTRUCTIONS": INSTRUCTIONS[(run + seed) % 3],
        "OMP_NUM_THREADS": "2" if two_threads else "1",
    }


def lacking(settings: dict[str, str]) -> set[str]:
    """Return the instructions that settings need and this processor does not have."""
    levels = ["DEFAULT", "AVX2", "AVX512"]
    best = torch.backends.cpu.get_cpu_capability()
    available = levels[: levels.index(best) + 1] if best in levels else []
    return {NEEDS[value] for value in settings.values() if value in NEEDS} - set(available)


def tested(
    settings: dict[str, str], seed: int, *arguments: str
) -> subprocess.CompletedProcess[str]:
    """Run pytest with settings and examples of its own."""
    outer = (*settings, "PYTEST", "HYBRIDKIN_MUST_RUN")  # without the core some tests are skipped
    inherited = {k: value for k, value in os.environ.items() if not k.startswith(outer)}
    command = [sys.executable, "-m", "pytest", "-q", "--no-header"]
    command += ["--hypothesis-profile=portable", f"--hypothesis-seed={seed}", *arguments]
    changed = {name: value for name, value in settings.items() if value}
    # More threads than cores must not wait actively: this makes torch many times slower.
    changed["OMP_WAIT_POLICY"] = "passive"
    return subprocess.run(
        command, cwd=ROOT, env={**inherited, **changed}, capture_output=True, text=True
    )


def main() -> int:
    """Run the tests with all settings of a seed; return 1 if one of them failed."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0, help="of the settings and of the examples")
    parser.add_argument("--runs", type=int, nargs="*", default=[*range(N_RUNS)], help="0 to 7")
    options = parser.parse_args()
    n_failed = 0
    for run in options.runs:
        settings = arithmetic(run, options.seed)
        print(f"run {run}:", *(f"{name}={value}" for name, value in settings.items() if value))
        if lacking(settings):
            print(f"  left out: this processor has no {' or '.join(lacking(settings))}", flush=True)
            continue
        sys.stdout.flush()
        processes = ["-n", "auto", "--maxprocesses", "4", "--dist", "worksteal"]
        start = time.perf_counter()
        seed = N_RUNS * options.seed + run
        done = tested(settings, seed, *processes, "-m", "not slow", "tests")
        seconds = time.perf_counter() - start
        summary = done.stdout.strip().rpartition("\n")[2].strip("= ")
        print(f"  {summary}; exit code {done.returncode}, {seconds:.0f} s", flush=True)
        if done.returncode:
            n_failed += 1
            failures = re.findall(r"^(?:FAILED|ERROR) .*", done.stdout, re.MULTILINE)
            print("\n".join(failures) or done.stdout[-3000:] + done.stderr[-3000:], flush=True)
    print(f"{n_failed} of {len(options.runs)} runs failed.")
    return int(n_failed > 0)


if __name__ == "__main__":
    sys.exit(main())
