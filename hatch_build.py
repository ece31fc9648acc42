"""Compile the kernels of hybridkin.native, where there is a C compiler.

hatchling calls `KernelsHook` for wheels and editable installations, and `ReadmeHook` for the page
of the package index. `python hatch_build.py` compiles in place; names of variants, such as v3,
compile these alone.

The variable CC names the compiler with its options. HYBRIDKIN_PLATFORM is the platform tag of the
wheel where the compiler is one for another machine.
"""

from __future__ import annotations

import os
import platform
import re
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from pathlib import Path
from typing import Any

try:
    from hatchling.builders.hooks.plugin.interface import BuildHookInterface
    from hatchling.metadata.plugin.interface import MetadataHookInterface
except ImportError:  # compiling in place needs no hatchling
    BuildHookInterface = MetadataHookInterface = object

ROOT = Path(__file__).parent
PACKAGE = ROOT / "hybridkin"
NATIVE = PACKAGE / "native"
FLAGS = (
    "-std=c99 -O3 -Wall -Wextra -pedantic -fno-math-errno -fno-trapping-math -ffp-contract=fast "
    "-fvisibility=hidden -shared -s"
).split()
# By features: compilers know these for longer than -march=x86-64-v3. hk_level asks for the same.
AVX2 = "-mavx2 -mfma"
X86 = {
    "v2": "-msse4.2 -O2",  # for old processors: compiled in half the time
    "v3": AVX2,
    "v4": AVX2 + " -mavx512f -mavx512cd -mavx512bw -mavx512dq -mavx512vl -mprefer-vector-width=512",
}


def host() -> str:
    """Return the platform tag of wheels for this machine."""
    tag = sysconfig.get_platform().replace("universal2", platform.machine())
    return tag.replace("-", "_").replace(".", "_")


def compiler() -> list[str]:
    """Return the C compiler as a command."""
    given = shlex.split(os.environ.get("CC", ""))
    for command in [given] if given else [["cc"], ["gcc"], ["clang"]]:
        if shutil.which(command[0]):
            return command
    raise OSError(f"no C compiler: {shlex.join(given) or 'cc'} was not found")


def compile_into(folder: Path, target: str, names: list[str]) -> list[Path]:
    """Return the libraries of a platform, at least one.

    What the same compiler has made of the same sources, with the same options, stays. The others
    are compiled side by side.
    """
    windows, apple = target.startswith("win"), target.startswith("macos")
    suffix = ".dll" if windows else ".dylib" if apple else ".so"
    variants = X86 if target.endswith(("x86_64", "amd64")) else {"generic": ""}
    shared = runpy.run_path(str(PACKAGE / "_core" / "kernel_numbers.py"))
    stamp = shared["checksum"](NATIVE / "src")
    command = [
        *compiler(),
        *FLAGS,
        f"-DHK_SOURCES={stamp}u",
        *([] if windows else ["-fPIC"]),
    ]
    compiler_version = version_of(compiler())
    folder.mkdir(parents=True, exist_ok=True)
    libraries = []
    with tempfile.TemporaryDirectory(dir=folder) as work:
        shared["write_headers"](work)
        running = {}
        for name in names or variants:
            options = variants[name].split()
            library = folder / f"hk_{name}{suffix}"
            origin = "\n".join([compiler_version, shlex.join(command + options)])
            if library.exists() and origin_of(library) == origin:
                libraries.append(library)
                continue
            made = Path(work, library.name)
            sources = str(NATIVE / "src")
            process = subprocess.Popen(
                [
                    *command,
                    *("-I", work, "-I", sources),
                    *options,
                    *("-o", str(made), f"{sources}/hk.c", "-lm"),
                ],
                stderr=subprocess.PIPE,
                text=True,
            )
            running[library] = (process, made, origin)
        messages = ""
        for library, (process, made, origin) in running.items():
            message = process.communicate()[1]
            messages += message
            if process.returncode == 0:
                sys.stderr.write(message)
                # Replaced at once: another process may have the old one in use.
                record(library).unlink(missing_ok=True)
                libraries.append(made.replace(library))
                record(library).write_text(origin)
    if not libraries:
        raise OSError(f"the C compiler failed: {messages.strip()[-500:]}")
    return libraries


def version_of(command: list[str]) -> str:
    """Return what a compiler says about its version."""
    done = subprocess.run([*command, "--version"], capture_output=True, text=True)
    return done.stdout


def record(library: Path) -> Path:
    """Return the path of the file that says how a library was made."""
    return library.with_suffix(".origin")


def origin_of(library: Path) -> str:
    """Return compiler and options that made a library, or an empty string."""
    try:
        return record(library).read_text()
    except OSError:
        return ""


class KernelsHook(BuildHookInterface):  # pyright: ignore[reportGeneralTypeIssues]
    """Adds the compiled kernels to a wheel, which then is one for this platform."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile; without a compiler the wheel is pure Python."""
        self.work = tempfile.mkdtemp()
        target = os.environ.get("HYBRIDKIN_PLATFORM") or host()
        folder = NATIVE / "lib"
        if version != "editable":
            folder = Path(self.work, "lib")
            if (NATIVE / "lib").is_dir():
                shutil.copytree(NATIVE / "lib", folder)  # what is up to date stays
        try:
            made = compile_into(folder, target, [])
        except OSError as error:
            sys.stderr.write(f"hybridkin: installed without compiled kernels; {error}\n")
            return
        if version != "editable":
            build_data.update(pure_python=False, tag=f"py3-none-{target}")
            places = {str(path): f"hybridkin/native/lib/{path.name}" for path in made}
            build_data["force_include"].update(places)

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove what was compiled for the wheel alone."""
        shutil.rmtree(self.work)


class ReadmeHook(MetadataHookInterface):  # pyright: ignore[reportGeneralTypeIssues]
    """Gives README.md to the package index, where only absolute links lead somewhere."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Set the readme: its links lead to the files of this version in the repository."""
        readme = (ROOT / "README.md").read_text(encoding="utf-8")
        version = runpy.run_path(str(PACKAGE / "_core" / "version.py"))["__version__"]
        text = with_absolute_links(readme, metadata["urls"]["Repository"], f"v{version}")
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


def with_absolute_links(markdown: str, repository: str, tag: str) -> str:
    """Return a Markdown text of the repository whose links to files are addresses.

    Links in Markdown and in attributes of HTML count; code is left as it is. A picture is linked as
    the file itself, other files as their page.
    """

    def absolute(link: re.Match[str]) -> str:
        is_picture = Path(link["path"]).suffix in (".gif", ".jpg", ".png", ".svg")
        kind = "raw" if is_picture else "blob"
        return f"{link['before']}{repository}/{kind}/{tag}/{link['path']}"

    parts = re.split(r"(```.*?```|`[^`]*`)", markdown, flags=re.DOTALL)
    before = r"(?P<before>\]\(|\b(?:href|src)=\")"
    path = r"(?![a-z]+:|#|/)(?P<path>[^\s)\"#]+)"
    for i in range(0, len(parts), 2):  # the others are code
        parts[i] = re.sub(before + path, absolute, parts[i])
    return "".join(parts)


if __name__ == "__main__":
    try:
        compile_into(NATIVE / "lib", host(), sys.argv[1:])
    except OSError as error:
        sys.exit(f"hybridkin: {error}")
