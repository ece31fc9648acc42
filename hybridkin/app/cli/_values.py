"""The values of options: text in, numbers and names out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hybridkin.formats import METRES


def numbers(text: str) -> Sequence[float]:
    """Return numbers separated by commas."""
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError:
        raise argparse.ArgumentTypeError(f"must be numbers, as in 1.5,2, got {text!r}") from None


def in_millimetres(text: str) -> Sequence[float]:
    """Return positive numbers of millimetres in metres."""
    return tuple(float(f"{1e-3 * size:.9g}") for size in map(positive, text.split(",")))


def length(text: str) -> float:
    """Return a length with its unit, such as 5mm, in metres."""
    for unit in sorted(METRES, key=len, reverse=True):
        size = text.removesuffix(unit).strip()
        if size != text:
            return METRES[unit] * not_negative(size)
    raise argparse.ArgumentTypeError(f"must be a length with its unit, as in 5mm, got {text!r}")


def start(text: str) -> Sequence[float] | str:
    """Return where a robot stands: "rest", "path" or numbers."""
    return text if text in ("rest", "path") else numbers(text)


def not_negative(text: str) -> float:
    """Return a finite number that is zero or more."""
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be zero or more, got {text}")
    return value


def signs(text: str) -> int | Sequence[int]:
    """Return 1 or -1, or several of them separated by commas."""
    parts = [part.strip() for part in text.split(",")]
    if not {*parts} <= {"1", "+1", "-1"}:
        raise argparse.ArgumentTypeError(
            f"must be 1 or -1, or one for each actuator, as in 1,-1,1, got {text!r}"
        )
    numbers = [*map(int, parts)]
    return numbers[0] if len(numbers) == 1 else numbers


def names(text: str) -> Sequence[str]:
    """Return names separated by commas."""
    return tuple(part.strip() for part in text.split(","))


def hysteresis(text: str) -> float | str:
    """Return a width of backlash, "auto" or "detect"."""
    if text in ("auto", "detect"):
        return text
    value = float(text)
    if not 0.0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be auto or a width, zero or more, got {text}")
    return value


def between(low: float, high: float, kind: type = float) -> Callable[[str], Any]:
    """Return a type of options: a number between two others."""

    def number(text: str) -> Any:
        value = kind(text)
        if not low < value < high:
            need = f"must be more than {low:g} and less than {high:g}"
            raise argparse.ArgumentTypeError(f"{need}, got {text}")
        return value

    return number


positive = between(0.0, float("inf"))
share = between(0.0, 1.0)
count = between(0, float("inf"), int)


def existing(text: str) -> Path:
    """Return the path of a file that exists."""
    if not Path(text).is_file():
        raise argparse.ArgumentTypeError(f"there is no file {text!r}")
    return Path(text)


def one_of(*known: Any) -> Callable[[str], Any]:
    """Return a type of options: one of some values."""
    values = {str(value): value for value in known}

    def value(text: str) -> Any:
        if text not in values:
            raise argparse.ArgumentTypeError(f"must be one of {', '.join(values)}, got {text!r}")
        return values[text]

    return value
