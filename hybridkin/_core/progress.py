"""How long work tells its progress."""

from __future__ import annotations


def quiet(done: int, total: int) -> None:
    """Tell nobody that `done` of `total` parts are done."""
