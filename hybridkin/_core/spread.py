"""Rows spread over a log."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_GOLDEN = 0.5 * (5.0**0.5 - 1.0)  # its multiples, modulo 1, are evenly spread


def spread(n: int, most: int, first: int = 0) -> NDArray[np.intp]:
    """Return the places of at most `most` of n rows, one in each of equal parts.

    Steps between them differ, so that they do not repeat with a periodic motion. Other numbers
    `first` give other places.
    """
    parts = np.arange(min(most, n) + 1) * n // max(1, min(most, n))
    within = (first + np.arange(1, len(parts))) * _GOLDEN % 1.0
    return parts[:-1] + (within * np.diff(parts)).astype(np.intp)
