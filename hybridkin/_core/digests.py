"""Digests of measured rows, to check whether a row of a log was used in a fit."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

_STEP = 1e-6  # [m]; a log written to a file and read back differs by less, two measurements by more
_ODD = np.uint64(0x9E3779B97F4A7C15)


def row_digests(q: ArrayLike, x: ArrayLike) -> NDArray[np.float64]:
    """Return one number for each pair (q, x), the same on every machine.

    The numbers are integers below 2^53, so float64 arrays hold them exactly. Values are first
    rounded to micrometres; only the position of a pose is used.
    """
    positions = np.atleast_2d(x)[:, :3]
    columns = np.hstack([np.atleast_2d(q), positions]).astype(np.float64)
    # Adding zero turns -0 into 0: the two are equal but have different bits.
    rounded = np.rint(columns / _STEP) + 0.0
    cells = rounded.view(np.uint64)
    digests = np.zeros(len(cells), dtype=np.uint64)
    for column in cells.T:
        # One-to-one on 64 bits: multiply, then shift.
        digests ^= column
        digests *= _ODD
        digests ^= digests >> np.uint64(32)
    digests >>= np.uint64(11)
    return digests.astype(np.float64)
