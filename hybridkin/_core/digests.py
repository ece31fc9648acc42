"""Digests of measured rows, to check whether a row of a log was used in a fit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

_STEP = 1e-6  # [m]; a log written to a file and read back differs by less, two measurements by more
_ODD = np.uint64(0x9E3779B97F4A7C15)


def row_digests(q: Any, x: Any) -> NDArray[np.float64]:
    """Return one number for each pair (q, x), the same on every machine.

    The numbers are integers below 2^53, so float64 arrays hold them exactly. Values are first
    rounded to micrometres; only the position of a pose is used.
    """
    q, x = (np.asarray(a, dtype=np.float64).reshape(len(a), -1) for a in (q, x))
    # Adding zero turns -0 into 0: the two are equal but have different bits.
    cells = (np.rint(np.hstack([q, x[:, :3]]) / _STEP) + 0.0).view(np.uint64)
    digests = np.zeros(len(q), dtype=np.uint64)
    for column in cells.T:  # each round is one-to-one on 64 bits: multiply, then shift
        digests = (digests ^ column) * _ODD
        digests ^= digests >> np.uint64(32)
    return (digests >> np.uint64(11)).astype(np.float64)
