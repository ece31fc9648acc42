import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
import saved_models
import torch

import hybridkin
from hybridkin import as_forward_model, load_model
from hybridkin._core.kernel_numbers import write_headers
from hybridkin.native.library import program_of

pytestmark = [pytest.mark.slow, pytest.mark.needs_core]
SOURCES = Path(hybridkin.__file__).parent / "native" / "src"
FLAGS = (
    "-std=c99 -O0 -g -Wall -Wextra -pedantic -Werror -fno-math-errno -fno-trapping-math "
    "-fsanitize=address,undefined -fno-sanitize-recover=all"
).split()


@pytest.fixture(scope="module")
def compiled():
    """Return (name, module, program) of the saved models that have kernels."""
    names = sorted(path.stem for path in saved_models.FOLDER.glob("*.safetensors"))
    files = [saved_models.FOLDER / f"{name}.safetensors" for name in names]
    modules = [as_forward_model(load_model(path)) for path in files]
    found = zip(names, modules, map(program_of, modules), strict=True)
    return [(name, module, program) for name, module, program in found if program is not None]


def rows_of(name):
    """Return rows of a model: inside and outside of its domain, far bends, NaN."""
    rng = np.random.default_rng(0)
    known = np.load(saved_models.FOLDER / "predictions.npz")[f"{name}.q"]
    scale = 1.0 + 10.0 * rng.uniform(0, 1, (18, 1)) ** 4
    q = known[np.arange(18) % len(known)] * scale
    q *= rng.uniform(0.9, 1.1, q.shape)
    q[5] = np.nan
    q[11, 0] = np.nan
    return q


def test_most_kinds_have_kernels(compiled):
    wanted = {"chain", "elastic_chain", "rigid", "elm", "blend", "serial_pose"}
    wanted |= {"structural_chain"}
    assert wanted <= {name for name, _, _ in compiled}


@pytest.mark.parametrize("lanes", ["", "-march=native"])
def test_kernels_stay_within_their_arrays(tmp_path, compiled, lanes):
    compiler, tester, plan = shutil.which("cc"), tmp_path / "test", tmp_path / "plan"
    if compiler is None:
        pytest.skip("needs a C compiler")
    write_headers(tmp_path)
    source = [
        f"-I{SOURCES}",
        f"-I{tmp_path}",
        Path(__file__).with_name("kernels_test.c"),
        "-o",
        tester,
        "-lm",
    ]
    command = [compiler, *FLAGS, *lanes.split(), *source]
    made = subprocess.run(command, capture_output=True, text=True)
    if any(word in made.stderr for word in ("lasan", "unrecognized", "unsupported")):
        pytest.skip("needs a C compiler with sanitizers")
    assert made.returncode == 0, made.stderr
    for name, module, program in compiled:
        q, code, data = rows_of(name), program.plan.code, program.plan.data
        head = np.array([len(code), len(data), program.plan.root, len(q)], dtype=np.int32)
        plan.write_bytes(b"".join(a.tobytes() for a in (head, code, data, q)))
        said = subprocess.run([tester, plan], capture_output=True, text=True)
        assert said.returncode == 0, f"{name}: {said.stderr[-2000:]}"
        assert max(map(float, said.stdout.split())) < 1e-11, f"{name}: {said.stdout}"
        with torch.no_grad():
            x = module(torch.from_numpy(q)).numpy()
        np.testing.assert_allclose(program.evaluate(q)[0], x, rtol=1e-9, atol=1e-11, err_msg=name)
