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
    commands = np.atleast_2d(np.asarray(q, dtype=np.float64))
    positions = np.atleast_2d(np.asarray(x, dtype=np.float64))[:, :3]
    rounded = np.rint(np.hstack([commands, positions]) / _STEP)
    # Adding zero turns -0 into 0: the two are equal but have different bits.
    cells = (rounded + 0.0).view(np.uint64)
    digests = np.zeros(len(cells), dtype=np.uint64)
    for column in cells.T:  # each round is one-to-one on 64 bits: multiply, then shift
        digests = (digests ^ column) * _ODD
        digests ^= digests >> np.uint64(32)
    return (digests >> np.uint64(11)).astype(np.float64)
