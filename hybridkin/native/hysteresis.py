"""Rows through the stages of a hysteresis in the compiled core."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.actuation import StageNumbers
from hybridkin.native.library import address, opened_library


def follow(
    described: StageNumbers,
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float,
) -> NDArray:
    """Return rows (T, n) after the hysteresis; the state becomes that after the last row.

    Parameters
    ----------
    described : StageNumbers
        The stages, at least one.
    rows : ndarray of shape (T, n)
        Commands, or effective changes if `lead`; contiguous float64, at most 1e75 in size.
    steps : ndarray of shape (T,)
        Time since the row before [s]; a negative one begins a run, without hysteresis.
    state : ndarray of shape (R, n)
        The state before the first row, contiguous.
    lead : bool
        Whether to return commands for effective changes instead of the reverse.
    rounding : float
        Rounding of the rows, relative to their size: smaller changes are no reversals of what is
        before creep.
    """
    code = np.array(described.code, dtype=np.int32)
    results = np.empty_like(rows)
    seconds = np.array(steps)
    arrays = (code, described.numbers, seconds, rows, state, results)
    places = [address(array) for array in arrays]
    opened_library().hk_hysteresis_rows(*rows.shape, lead, rounding, *places)
    return results
