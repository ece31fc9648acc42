"""The stack that functions take: they run in threads whose stack was painted before."""

import shutil
import subprocess
from pathlib import Path

from hybridkin._core.kernel_numbers import write_headers
from hybridkin.native import library

LIMIT = 64 * 1024  # bytes
CC = shutil.which("cc")
_SOURCES = Path(library.__file__).parent / "src"


def painted(folder, *options):
    """Return the compiled program that prints the stack of functions."""
    source, program = Path(__file__).parent / "native" / "stack_test.c", folder / "stack_test"
    write_headers(folder)
    flags = ["-std=gnu99", "-O2", "-Wall", "-Werror", f"-I{_SOURCES}", f"-I{folder}"]
    command = [CC, *flags, source, *options, "-o", program, "-lm", "-lpthread", "-ldl"]
    subprocess.run(command, check=True)
    return program


def stacks(*command):
    """Return the bytes of stack by the name of a function."""
    lines = subprocess.check_output(command, text=True).splitlines()
    return {name: int(size) for name, size in (line.rsplit(" ", 1) for line in lines)}
