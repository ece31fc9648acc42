"""How long work tells its progress."""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[int, int], None]
"""Gets the number of parts that are done, and the number of all."""


def quiet(*progress: object) -> None:
    """Tell nobody that `done` of `total` parts are done."""
