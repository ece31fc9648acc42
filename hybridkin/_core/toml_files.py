"""TOML files of users: read within limits of size, and every key and value checked."""

from __future__ import annotations

import difflib
import re
import reprlib
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeAlias

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib  # pyright: ignore[reportMissingImports]

# of positive numbers, and of all; others are mistakes
_LEAST = 1e-18
_LARGEST = 1e9
# The time to read hostile TOML grows with the squares of these.
_DOTS = 600  # between two commas
_BYTES = 30_000  # of a file

Test: TypeAlias = Callable[[Any], bool]
"""Whether a value of a key is right."""

Need: TypeAlias = tuple[str, Test]
"""What the value of a key must be, in words and as a test."""


def read_toml(path: Path, what: str) -> dict[str, Any]:
    """Return the content of a TOML file; `what` names the file in errors."""
    if path.stat().st_size > _BYTES:
        raise ValueError(f"{what} must be at most {_BYTES} bytes long.")
    try:
        text = path.read_text(encoding="utf-8")
        if any(part.count(".") > _DOTS for part in re.split(r"[,=\n]", text)):
            raise ValueError(f"a key has more than {_DOTS} dots")
        return tomllib.loads(text)
    except (
        ValueError,
        RecursionError,
    ) as error:  # some numbers raise plain ValueErrors
        raise ValueError(f"this is not a TOML file: {error}.") from error


def check_keys(table: Mapping[str, Any], needs: Mapping[str, Need], where: str) -> None:
    """Raise a ValueError that names a key of a table that is not known, or has a wrong value."""
    for key, value in table.items():
        if key not in needs:
            hint = f"known: {sorted(needs)}."
            if close := difflib.get_close_matches(key, needs, n=1):
                hint = f"did you mean `{close[0]}`?"
            raise ValueError(f"`{key:.40}` in {where} is not known; {hint}")
        words, fits = needs[key]
        if not fits(value):
            got = reprlib.repr(value)  # shortens deep or long values
            raise ValueError(f"`{key}` in {where} must {words}, got {got}.")


def is_number(value: Any) -> bool:
    """Return whether a value is a number of a usual size."""
    return type(value) in (int, float) and abs(value) <= _LARGEST  # not NaN


def is_positive(value: Any) -> bool:
    """Return whether a value is a positive number of a usual size."""
    return is_number(value) and value >= _LEAST


def is_text(value: object) -> bool:
    """Return whether a value is a text that is not blank."""
    return isinstance(value, str) and bool(value.strip())


def is_table(value: object) -> bool:
    """Return whether a value is a table of keys."""
    return isinstance(value, dict)


def many(test: Test, size: int = 0) -> Test:
    """Return the test of a list of `size` such values; 0: of any but none."""
    return lambda v: type(v) is list and len(v) == (size or len(v)) > 0 and all(map(test, v))


def one_or_many(test: Test) -> Test:
    """Return the test of one such value or a list of them."""
    return lambda value: test(value) or many(test)(value)


def among(*values: Any) -> Need:
    """Return the need of one of some values."""
    return f"be one of {values}", lambda v: type(v) is type(values[0]) and v in values
