"""Names of columns in exported code: whatever they hold, the code is that of a harmless name."""

import shutil
import subprocess

import pytest

import hybridkin
from hybridkin import native

EVIL = "static void evil(void){}"
HOSTILE = [
    f"c*\\\n/ {EVIL} /*\\\n*",
    f"c*/ {EVIL} /*",
    f"c*??/\n/ {EVIL} /*??/\n*",
    f"c*\\ \n/ {EVIL} /*",
    "ends in a splice \\",
    "ends in a trigraph ??/",
    "/",
    "*",
    f'\\u002a\\u002f {EVIL}\n#include "evil.h"\n%:include "evil.h"',
]
CHAIN = hybridkin.ConstantCurvatureChain([0.005], lengths=[0.1])
STANDARDS = (["-std=c99"], ["-std=gnu11"], ["-std=gnu11", "-trigraphs"])


def tokens(folder, options):
    found = []
    for file in ("model.c", "model.h", "model_test.c"):
        command = ["cc", "-E", "-P", "-Wall", "-Werror", *options, str(folder / file)]
        found.append(subprocess.check_output(command, text=True).split())
    return found


@pytest.fixture(scope="module")
def harmless(tmp_path_factory):
    if not shutil.which("cc"):
        pytest.skip("needs a C compiler")
    folder = tmp_path_factory.mktemp("harmless")
    native.export_c(CHAIN, folder, about_q="q")
    return {str(options): tokens(folder, options) for options in STANDARDS}


@pytest.mark.slow
@pytest.mark.parametrize("name", [HOSTILE[0], HOSTILE[2], " ".join(HOSTILE), "\n".join(HOSTILE)])
def test_a_hostile_name_leaves_the_tokens_of_the_code(harmless, tmp_path, name):
    native.export_c(CHAIN, tmp_path, about_q=name)
    for options in STANDARDS:
        assert tokens(tmp_path, options) == harmless[str(options)]
    command = ["cc", "-std=c99", "-Wall", "-Werror", "-c", "model.c", "-o", "model.o"]
    subprocess.run(command, cwd=tmp_path, check=True)
    symbols = subprocess.check_output(["nm", "model.o"], cwd=tmp_path, text=True)
    assert "evil" not in symbols
