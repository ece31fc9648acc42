"""Commands of hysteresis of any kind, each path of computation against `apply` and each other.

The motions, the values and what rounding allows are those of test_hostile_commands.
"""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from _line import Line
from numpy.typing import NDArray

import hybridkin
from hybridkin._core.kernel_numbers import write_headers
from hybridkin.hysteresis.follow import stage_numbers
from hybridkin.hysteresis.stage import Stage

sys.path.append(str(Path(__file__).parents[1] / "hysteresis"))
from test_hostile_commands import examined, paths

SOURCES = Path(hybridkin.__file__).parent / "native" / "src"
# As in exported code: the header alone, in either precision.
SHIM = """
#define HK_KINDS 0u
#include "plan.h"
#include "hysteresis.h"
void rows(int rows, int n, int lead, const int32_t *code, const real *numbers, const real *seconds,
          const real *given, real *state, real *results) {
    const hk_hysteresis h = {code, numbers, n, HK_CREEP_ROUNDING * HK_EPS};
    const real *y = state + (code[HK_STATE_ROWS] - 1) * n;
    for (int r = 0; r < rows; r++, given += n, results += n) {
        for (int j = 0; j < n; j++) *(lead ? results + j : state + j) = given[j];
        if (lead) hk_hysteresis_command(&h, seconds[r], results, state);
        else hk_hysteresis_apply(&h, seconds[r], state);
        for (int j = 0; j < n && !lead; j++) results[j] = y[j];
    }
}
"""


def examine(full: bool) -> Iterator[Line]:
    """Yield the claims."""
    n_motions = 20_000 if full else 1000
    with tempfile.TemporaryDirectory() as home:
        ways = {**paths(), **exported(Path(home))}
        rng = np.random.default_rng(0)
        wrong = Counter()
        same = Counter()
        for _ in range(n_motions):
            found, commands = examined(rng, ways)
            wrong.update(text.split(",")[0] for text in found)
            for dtype in ("float64", "float32"):
                of_dtype = [q for path, q in commands.items() if path in paths() and dtype in path]
                same[dtype] += all(np.array_equal(of_dtype[0], q) for q in of_dtype)
    for path in ways:
        kinds = {key: count for key, count in wrong.items() if key.startswith(path)}
        what = f"Commands, {path}: finite, and `apply` of them is what was asked for, to rounding"
        yield Line(
            what,
            f"{n_motions:,} motions of 12 rows, seed 0; {sum(kinds.values())} wrong",
            not kinds,
        )
    for name in ("core", "C"):
        if not any(path.startswith(name) for path in ways):
            yield Line(f"Commands, {name}", "there is none here", None)
    shares = ", ".join(f"{dtype} {100 * count / n_motions:.1f} %" for dtype, count in same.items())
    yield Line(
        "Motions with the same bits with and without the core; others differ by rounding",
        shares,
        True,
    )


def exported(home: Path) -> dict[str, tuple[type, Callable[..., NDArray]]]:
    """Return paths through the code that is exported, see `paths`; none without a compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return {}
    write_headers(home)
    (home / "rows.c").write_text(SHIM)
    made = {}
    for name, dtype, flag in (("double", np.float64, []), ("float", np.float32, ["-DHK_FLOAT"])):
        library = home / f"{name}.so"
        command = [
            compiler,
            "-std=c99",
            "-O2",
            "-shared",
            "-fPIC",
            *flag,
            f"-I{SOURCES}",
            f"-I{home}",
            str(home / "rows.c"),
            "-o",
            str(library),
            "-lm",
        ]
        subprocess.run(command, check=True)
        rows = ctypes.CDLL(str(library)).rows
        made[f"C, {np.dtype(dtype).name}"] = (dtype, partial(in_c, rows, dtype))
    return made


def in_c(
    function: Callable[..., None],
    dtype: type,
    stages: list[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float,
) -> NDArray:
    """Return rows after the hysteresis as `follow.follow_in_core`, in C of a precision."""
    described = stage_numbers(stages, rows.shape[1])
    code = np.array(described.code, np.int32)
    arrays = [np.array(a, dtype) for a in (described.numbers, steps, rows, state, rows)]
    places = [ctypes.c_void_p(a.ctypes.data) for a in (code, *arrays)]
    function(*rows.shape, int(lead), *places)
    state[:] = arrays[-2]
    return arrays[-1].astype(np.float64)
