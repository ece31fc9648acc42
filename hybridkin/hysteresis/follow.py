"""Rows through stages of hysteresis: in the compiled core, or without it in NumPy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.actuation import StageNumbers
from hybridkin._core.kernel_numbers import HK_CREEP_ROUNDING, STAGES
from hybridkin.hysteresis.stage import Stage
from hybridkin.native.hysteresis import follow as follow_stages
from hybridkin.native.library import available

_ROUNDING = float(np.finfo(np.float64).eps)


def stage_numbers(stages: Sequence[Stage], n: int) -> StageNumbers:
    """Return the stages of n actuators as the kernels read them."""
    code = [len(stages), n_state_rows(stages)]
    numbers = [np.empty(0)]
    for stage in stages:
        of_stage = [array.ravel() for array in stage.numbers(n)]
        n_numbers = sum(map(len, of_stage))
        code += [1 + STAGES.index(stage.kernel), stage.n_inside, n_numbers]
        numbers += of_stage
    return StageNumbers(code, np.concatenate(numbers))


def n_state_rows(stages: Sequence[Stage]) -> int:
    """Return the number of rows of the state of stages: none without any."""
    rows = [stage.n_inside + 1 for stage in stages]
    return sum(rows) + bool(rows)


def followed(stages: Sequence[Stage], rows: NDArray, steps: NDArray) -> NDArray:
    """Return the effective changes (N, n) of motions in a row.

    Parameters
    ----------
    stages : sequence of Stage
        The stages.
    rows : ndarray of shape (N, n)
        Commands, finite, in float64.
    steps : ndarray of shape (N,)
        Time since the row before [s]; `BEGINS` where a motion begins.
    """
    state = np.empty((n_state_rows(stages), rows.shape[1]))
    return follow(stages, rows, steps, state)


def follow(
    stages: Sequence[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool = False,
    precision: float = _ROUNDING,
) -> NDArray:
    """Return rows (T, n) after the stages; the state becomes that after the last row.

    The arguments are those of `native.hysteresis.follow`, with the relative `precision` of the
    rows.
    """
    if not len(rows) or not stages:
        return rows
    rounding = HK_CREEP_ROUNDING * precision
    way = follow_in_core if available() else follow_in_numpy
    return way(stages, rows, steps, state, lead, rounding)


def follow_in_core(
    stages: Sequence[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float,
) -> NDArray:
    """Return what `follow` does, computed by the compiled core."""
    described = stage_numbers(stages, rows.shape[1])
    return follow_stages(described, rows, steps, state, lead, rounding)


def follow_in_numpy(
    stages: Sequence[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float,
) -> NDArray:
    """Return what `follow` does, computed by NumPy."""
    parts = []
    first = 0
    for stage in stages:
        last = first + stage.n_inside + 1
        parts.append(stage.follower(state[first : last + 1], rounding))
        first = last
    results = np.empty_like(rows)
    passed = np.maximum(steps, 0.0)
    for t, row in enumerate(rows):
        if steps[t] < 0.0:
            state[:] = row
        if lead:
            for part in parts[::-1]:
                row = part.lead(row, passed[t])
            state[0] = row
            results[t] = row
        else:
            state[0] = row
            for part in parts:
                part.follow(passed[t])
            results[t] = state[-1]
    return results
