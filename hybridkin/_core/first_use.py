"""Packages that import some public names when they are first used."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from typing import Any


def on_first_use(package: str, names_of: Mapping[str, Sequence[str]]) -> Callable[[str], Any]:
    """Return the `__getattr__` of a package.

    Parameters
    ----------
    package : str
        Its name.
    names_of : mapping of str to sequence of str
        The names that each of its modules defines.
    """
    module_of: dict[str, str] = {}
    for module, names in names_of.items():
        module_of |= dict.fromkeys(names, f"{package}.{module}")

    def open_name(name: str) -> Any:
        if name not in module_of:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        return getattr(import_module(module_of[name]), name)

    return open_name
