"""The code of the pages in docs/explanation runs as printed, and does what they say."""

import importlib.util
import os
import runpy
import shutil
import subprocess
import sys

import pytest
import torch
from page_blocks import DOCS, ROOT, blocks_of, read, replaced, written_on

PAGES = written_on("explanation")
# What takes long on a page, and less of it.
SHORTER = {}
needs_compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("cc", "gcc", "clang"))), reason="needs a C compiler"
)


def theory(reader):
    assert "torch.Size([5, 3]) tensor(True)" in reader.printed


def hybrid(reader):
    errors = [line.split()[-4] for line in reader.printed.splitlines() if line.endswith("mm")]
    assert [*map(float, errors)] == pytest.approx([11.3, 10.2, 7.4], abs=0.11)
    assert reader.space["model"].cv_results_["weights"]["structural"] >= 0.5


def domain(reader):
    assert reader.space["model"].in_domain(reader.space["Q"]).tolist() == [True] * 5 + [False]
    assert reader.space["radius"][-1] == float("inf")
    assert (reader.space["radius"][:-1] < 0.05).all()


def elm(reader):
    new, held_out, nominal, learned = map(float, reader.printed.split())
    assert new < 0.3 < 0.9 < held_out < 1.1  # the noise is 1
    assert learned < 0.3 * nominal


def how_it_works(reader):
    assert "boom 1.045 m" in reader.printed
    assert "[ True  True  True  True  True]" in reader.printed
    assert "True torch: " in reader.printed
    crane = reader.space["chain"]
    q = torch.tensor([[0.1, 0.5, 0.2], [-0.3, 0.9, 0.3]], dtype=torch.float64)
    assert torch.autograd.gradcheck(crane, q.requires_grad_())


# What a page says of what its blocks print or write.
CHECKS = {
    "theory": theory,
    "hybrid": hybrid,
    "domain": domain,
    "elm": elm,
    "how_it_works": how_it_works,
}


@pytest.mark.slow
@pytest.mark.parametrize("page", PAGES)
def test_blocks_of_a_page_run(page, lab):
    read("explanation", page, SHORTER, CHECKS)


# The page "How it works inside": its folders, and its kernel.


def test_page_and_picture_show_every_folder():
    package = ROOT / "hybridkin"
    names = {path.parent.name for path in package.glob("*/__init__.py")}
    names |= {path.stem for path in package.glob("*.py") if not path.stem.startswith("__")}
    parts = {path.parent.name for path in package.glob("app/*/__init__.py")}
    drawn = runpy.run_path(str(DOCS / "_ext" / "how_it_works.py"))
    columns = {name for column in drawn["FOLDERS"] for name in column}
    assert columns | {*drawn["BESIDE"], *drawn["TOOLS"]} == names
    assert {*drawn["APP"]} == parts
    page = (DOCS / "explanation" / "how_it_works.md").read_text(encoding="utf-8")
    table = page.partition("\n## The folders\n")[2].partition("\n## ")[0]
    assert {name for name in names | parts if f"`{name}`" in table} == names | parts


AS_TORCH = """
from numpy.testing import assert_allclose
from hybridkin.native.library import evaluate

q = np.random.default_rng(1).uniform(-2.0, 2.0, (50, 4))
waves = CompiledWaves(np.cos(np.arange(28.0)).reshape(7, 4), np.eye(3, 7) + 0.1, np.arange(3.0))
assert native.backend(waves) == "compiled", native.backend(waves)
x, J = waves.forward_and_jacobian(torch.from_numpy(q))
for rows in (slice(None), slice(1, 3), 7):
    x_compiled, J_compiled = evaluate(waves, q[rows], jacobian=True)
    # Sums of seven waves, each below 1.1; the angles are below 8, known to some 1e-15.
    assert_allclose(x_compiled, x[rows], rtol=0.0, atol=1e-13)
    assert_allclose(J_compiled, J[rows], rtol=0.0, atol=1e-13)
print("as torch")
"""


def insert(file, place, text):
    """Insert a text behind a place in a file, which must occur once."""
    old = file.read_text(encoding="utf-8")
    assert old.count(place) == 1, place
    file.write_text(replaced(old, [(place, place + text)]), encoding="utf-8")


def compile_one(folder):
    """Compile one variant of the kernels of a copy of the package, unoptimised; return its name."""
    spec = importlib.util.spec_from_file_location("copied_build", folder / "hatch_build.py")
    assert spec
    assert spec.loader
    build = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(build)
    variant = "v2" if build.host().endswith(("x86_64", "amd64")) else "generic"
    build.X86 = {"v2": "-msse4.2 -O0"}
    build.FLAGS = [flag for flag in build.FLAGS if flag != "-O3"]
    build.compile_into(folder / "hybridkin" / "native" / "lib", build.host(), [variant])
    return variant


@pytest.mark.slow
@needs_compiler
def test_the_kernel_of_the_page_computes_as_torch(tmp_path):
    left_out = shutil.ignore_patterns("__pycache__", "lib", "app", "data")
    shutil.copytree(ROOT / "hybridkin", tmp_path / "hybridkin", ignore=left_out)
    shutil.copy(ROOT / "hatch_build.py", tmp_path)
    blocks = blocks_of(DOCS / "explanation" / "how_it_works.md")
    kernel, call = (block.text for block in blocks if block.language == "c")
    regressors = tmp_path / "hybridkin" / "native" / "src" / "regressors.h"
    insert(
        regressors, "/* Learned models q (n) -> x (m) with their Jacobians J (m, n). */\n", kernel
    )
    insert(regressors, "        HK(readout)(p, at, q, x, J, work);\n", call)
    insert(
        tmp_path / "hybridkin" / "_core" / "kernel_numbers.py", '    "body",\n', '    "waves",\n'
    )
    variant = compile_one(tmp_path)

    _, crane, learned, node = (block.text for block in blocks if block.language == "python")
    imports, classes = crane.partition("\n\n")[0], learned.partition("\nwaves = ")[0]
    code = "\n".join(["import torch", imports, classes, node, AS_TORCH])
    environment = {**os.environ, "PYTHONPATH": str(tmp_path), "HYBRIDKIN_NATIVE": variant}
    command = [sys.executable, "-c", code]
    done = subprocess.run(command, env=environment, cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "as torch\n", done.stderr
