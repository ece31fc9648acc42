"""Hysteresis with the compiled core: what it needs of an operator, and rows through one."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hybridkin._core.kernel_numbers import HK_CREEP_ROUNDING
from hybridkin.native.library import address, opened_library

DOUBLE_ROUNDING = HK_CREEP_ROUNDING * float(np.finfo(np.float64).eps)


class Stage(NamedTuple):
    """A part of an operator: a weighted sum of plays, or creep.

    Attributes
    ----------
    size : int
        Number of plays K; of creep -J, with J time constants.
    numbers : tuple of ndarray
        Half the widths and the slopes, each (K, n), the last slopes 1; or the gains (J, n) and the
        time constants (J,).
    """

    size: int
    numbers: tuple[NDArray, ...]


class Hysteresis(Protocol):
    """What the kernels and inverse kinematics need of an operator of hysteresis."""

    def apply(
        self, q: Any, state: Any = None, dt: ArrayLike | None = None
    ) -> tuple[Any, Any]:
        """Return the effective changes of commands (T, n), and the state at their end."""
        ...

    def command(
        self, y: Any, state: Any = None, dt: ArrayLike | None = None
    ) -> tuple[Any, Any]:
        """Return the commands of effective changes (T, n), and the state at their end."""
        ...

    def stages(self, n: int) -> list[Stage]:
        """Return the operator of n actuators as stages in series."""
        ...


class StageNumbers(NamedTuple):
    """The description of stages as the kernels read it, see hysteresis.h.

    Attributes
    ----------
    code : list of int
        Number of stages and of rows of the state, then the counts.
    numbers : ndarray
        The numbers of all stages.
    """

    code: list[int]
    numbers: NDArray

    @property
    def n_rows(self) -> int:
        """Number of rows of the state."""
        return self.code[1]


def stage_numbers(stages: list[Stage]) -> StageNumbers:
    """Return the description of stages in series."""
    counts = [stage.size for stage in stages]
    rows = 1 + sum(abs(count) + 1 for count in counts)
    numbers = [a.ravel() for stage in stages for a in stage.numbers]
    return StageNumbers([len(stages), rows, *counts], np.concatenate(numbers))


def follow(
    stages: list[Stage],
    rows: NDArray,
    steps: NDArray,
    state: NDArray,
    lead: bool,
    rounding: float = DOUBLE_ROUNDING,
) -> NDArray:
    """Return rows (T, n) after the hysteresis; the state becomes that after the last row.

    Parameters
    ----------
    stages : list of Stage
        The operator.
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
        before creep. Default: that of float64.
    """
    described = stage_numbers(stages)
    code = np.array(described.code, dtype=np.int32)
    results = np.empty_like(rows)
    seconds = np.array(steps)
    arrays = (code, described.numbers, seconds, rows, state, results)
    places = [address(array) for array in arrays]
    opened_library().hk_hysteresis_rows(*rows.shape, lead, rounding, *places)
    return results
