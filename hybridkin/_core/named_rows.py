"""Numbers of rows in warnings that come from inside a computation in blocks."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar

import numpy as np
from numpy.typing import NDArray

_MOST = 5  # numbers in a message
_MOST_RANGES = 4
_FIRST: ContextVar[int | None] = ContextVar("_FIRST", default=0)


@contextmanager
def rows_from(first: int) -> Iterator[None]:
    """Say that the rows of the block that follows are numbered from this row on."""
    before = _FIRST.get()
    token = _FIRST.set(None if before is None else before + first)
    try:
        yield
    finally:
        _FIRST.reset(token)


@contextmanager
def without_warnings() -> Iterator[None]:
    """Say that the rows that follow are trials: nobody needs warnings about them."""
    token = _FIRST.set(None)
    try:
        yield
    finally:
        _FIRST.reset(token)


def first_row() -> int | None:
    """Return the number of the first row of the present block, None for trials."""
    return _FIRST.get()


def named_rows(places: Sequence[int]) -> str:
    """Return rows as text: "row 3", "rows 3, 5, 6, 7, 8 and 40 more"."""
    named = ", ".join(map(str, places[:_MOST]))
    more = len(places) - _MOST
    ending = f" and {more} more" if more > 0 else ""
    return f"row{'s' if len(places) > 1 else ''} {named}{ending}"


def named_places(places: NDArray, kind: str) -> str:
    """Return places as text, neighbours as ranges: "lines 3, 8-12 and 40 more"."""
    ordered = np.sort(places)
    ranges = np.split(ordered, np.flatnonzero(np.diff(ordered) > 1) + 1)
    words = []
    n_named = 0
    for neighbours in ranges[:_MOST_RANGES]:
        first = neighbours[0]
        last = neighbours[-1]
        words.append(f"{first}" if first == last else f"{first}-{last}")
        n_named += len(neighbours)
    text = f"{kind}{'s' if len(ordered) > 1 else ''} {', '.join(words)}"
    if n_named < len(ordered):
        text += f" and {len(ordered) - n_named} more"
    return text
