"""Against a program of one model, written by hand for AVX-512 in a day: how near the kernels are.

`limit.c` knows one hybrid, with all its numbers as constants, and the chain alone. The kernels
compute any model of their kinds.
"""

import ctypes
import shutil
import subprocess

import numpy as np
import pytest
from numpy.testing import assert_allclose

from hybridkin._core.plan import Plan
from hybridkin.native.library import evaluate, opened_library

pytestmark = [
    pytest.mark.skipif(shutil.which("cc") is None, reason="needs a C compiler"),
    pytest.mark.needs_core,
]
FLAGS = "-std=gnu99 -O3 -march=native -ffp-contract=fast -fno-math-errno -fno-trapping-math".split()


def numbers_of(chain, hybrid):
    """Return the numbers of the robot by name: what can be multiplied out before, is."""
    network = hybrid.corrections[0].module
    weights = network.input_weights / network.input_scale
    bias = network.input_bias - weights @ network.input_center
    output = network.output_weights
    frame = 13 + 3 * chain.n_segments  # numbers of a plan of arcs, and the arcs of q = 0
    arcs = Plan(chain.stored()).data[frame + chain.n_segments :][: 9 * chain.n_segments]
    return {
        "ARCS": arcs,
        "WEIGHTS": -weights / np.log(2.0),
        "BIAS": -bias / np.log(2.0),
        "OUT": output,
        "SLOPES": output[:, :, None] * weights[:, None, :],
        "INTERCEPT": network.intercept,
    }


@pytest.fixture(scope="module")
def limit(tmp_path_factory, request, chain, hybrids):
    """The functions of the program by name: rows (N, 9) to x (N, 3) and J (N, 3, 9)."""
    if opened_library().hk_level() < 4:
        pytest.skip("needs another processor: this one has no AVX-512")
    folder = tmp_path_factory.mktemp("limit")
    lines = []
    for name, array in numbers_of(chain, hybrids[None]).items():
        values = [float(number).hex() for number in np.ravel(array)]
        lines.append(f"static const double {name}[{len(values)}] = {{{', '.join(values)}}};\n")
    (folder / "numbers.h").write_text("".join(lines))
    source = request.path.with_name("limit.c")
    library = folder / "limit.so"
    subprocess.run(
        ["cc", *FLAGS, "-shared", "-fPIC", "-I", folder, "-o", library, source], check=True
    )
    opened = ctypes.CDLL(str(library))
    pointer = ctypes.c_void_p

    def function(name):
        compiled = getattr(opened, name)
        compiled.argtypes = [pointer, ctypes.c_long, pointer, pointer]
        compiled.restype = None

        def call(rows):
            x = np.empty((len(rows), 3))
            J = np.empty((len(rows), 3, 9))
            compiled(rows.ctypes.data, len(rows), x.ctypes.data, J.ctypes.data)
            return x, J

        return call

    return {name: function(f"limit_{name}") for name in ("hybrid", "chain")}


@pytest.mark.parametrize("what", ["hybrid", "chain"])
def test_against_a_program_of_this_model(race, hybrids, chain, draw, batch, limit, what):
    module = {"hybrid": hybrids[None], "chain": chain}[what]
    rows = draw(batch + 3).numpy().copy()  # a last block that is not full
    for ours, theirs in zip(evaluate(module, rows, jacobian=True), limit[what](rows), strict=True):
        assert_allclose(ours, theirs, rtol=0, atol=1e-10)
    rows = rows[:batch].copy()
    race(
        f"{what}: tip + J, NumPy",
        "a C program of this model alone",
        lambda: evaluate(module, rows, jacobian=True),
        lambda: limit[what](rows),
        rows=batch,
        at_least=0.8 if what == "hybrid" else None,
    )
