"""What lies between the commands of a model and the motion of its actuators: by default nothing."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray


class StageNumbers(NamedTuple):
    """The stages of a hysteresis as the kernels read them, see hysteresis.h.

    Attributes
    ----------
    code : list of int
        Number of stages and of rows of the state; then of each stage the number of its kernel, its
        number of rows inside of the state, and its number of numbers.
    numbers : ndarray
        The numbers of all stages.
    """

    code: list[int]
    numbers: NDArray

    @property
    def n_rows(self) -> int:
        """Number of rows of the state."""
        return self.code[1]


class Actuation:
    """Actuators that do what they are commanded. A `Hysteresis` is the kind with stages.

    It has no state and does not change.

    Attributes
    ----------
    stages : tuple
        The stages.
    needs_time : bool
        Whether what actuators do depends on the times of the commands.
    width : ndarray of shape () or (n,)
        Largest distance between two commands with the same effect at rest [unit of q].
    """

    stages: tuple[Any, ...] = ()
    needs_time: bool = False
    width: NDArray = np.broadcast_to(0.0, ())  # read-only

    def __bool__(self) -> bool:
        """Return whether the actuators do something else than they are commanded."""
        return len(self.stages) > 0

    def __eq__(self, other: object) -> bool:
        """Return whether both have equal stages."""
        return isinstance(other, Actuation) and self.stages == other.stages

    def __hash__(self) -> int:
        return hash(self.stages)

    def __repr__(self) -> str:
        return f"{type(self).__name__}()"

    def apply(self, q: Any, state: Any = None, dt: ArrayLike | None = None) -> tuple[Any, Any]:
        """Return the effective changes of commands (T, n), and the state at their end."""
        return q, q[:0]

    def command(self, y: Any, state: Any = None, dt: ArrayLike | None = None) -> tuple[Any, Any]:
        """Return the commands of effective changes (T, n), and the state at their end."""
        return y, y[:0]

    def stage_numbers(self, n: int) -> StageNumbers:
        """Return the stages for n actuators as the kernels read them."""
        return StageNumbers([0, 0], np.empty(0))


DIRECT = Actuation()
