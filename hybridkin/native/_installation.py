"""How hybridkin was installed, and the command that gives this installation its compiled core."""

from __future__ import annotations

import json
import multiprocessing
import shlex
import sys
import warnings
from importlib import metadata
from pathlib import Path
from typing import Any

_SOURCES = Path(__file__).parents[2]


def compiling_command() -> str:
    """Return the command that compiles the core of this installation, for a shell."""
    script = _SOURCES / "hatch_build.py"
    if script.is_file():  # a clone
        return shlex.join([sys.executable, str(script)])
    installer = "pip"
    origin = "hybridkin"
    for installed in metadata.distributions(name="hybridkin"):
        installer = (installed.read_text("INSTALLER") or installer).strip()
        origin = _origin(json.loads(installed.read_text("direct_url.json") or "{}"))
        break
    command = [sys.executable, "-m", "pip", "install"]
    if installer == "uv":  # whose environments have no pip
        command = ["uv", "pip", "install", "--python", sys.executable]
    # A wheel without kernels may lie in the cache.
    return shlex.join([*command, "--force-reinstall", "--no-deps", "--no-cache-dir", origin])


def _hides_another() -> bool:
    """Return whether this is a clone that was imported in place of an installed package."""
    if not (_SOURCES / "hatch_build.py").is_file():
        return False
    for installed in metadata.distributions(name="hybridkin"):
        folder = Path(str(installed.locate_file("hybridkin")))
        if folder.is_dir() and folder.parent.resolve() != _SOURCES:
            return True
    return False


def without_kernels() -> str:
    """Return the reason where nothing was compiled, and what to do."""
    command = compiling_command()
    if _hides_another():
        return (
            f"it was imported from the source folder {_SOURCES}, which has no compiled kernels; "
            f"run `{command}`, or work in another folder to use the installed package"
        )
    return (
        "hybridkin was installed without compiled kernels; install a C compiler, then run "
        f"`{command}`"
    )


def _origin(direct_url: dict[str, Any]) -> str:
    """Return what to install again, from the record of where a package came from (PEP 610)."""
    url = direct_url.get("url", "hybridkin")
    if url.endswith(".whl"):  # it holds no kernels; the index has wheels that do
        return "hybridkin"
    if "vcs_info" in direct_url:
        return f"{direct_url['vcs_info']['vcs']}+{url}"
    return url


def warn_of_slow_models(reason: str) -> None:
    """Warn that torch computes everything, in the first process alone: workers would repeat it."""
    if multiprocessing.parent_process() is None:
        warnings.warn(
            f"hybridkin computes without its compiled core, which is slower: {reason}. "
            "HYBRIDKIN_NATIVE=off says that this is intended.",
            stacklevel=3,
        )
