"""Operators of hysteresis in series, for example friction before creep."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.units import LogUnit
from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.native.hysteresis import Stage

__all__ = ["HysteresisSeries"]


class HysteresisSeries(HysteresisOperator):
    """Operators of hysteresis, each of which gets the effective changes of the one before.

    Parameters
    ----------
    operators : sequence of HysteresisOperator
        The operators; the first one gets the commands.

    Attributes
    ----------
    width : ndarray of shape () or (n,)
        Sum of the widths [unit of q].

    Examples
    --------
    >>> import numpy as np
    >>> from hybridkin import CreepOperator, HysteresisSeries, PlayOperator
    >>> hysteresis = HysteresisSeries([PlayOperator(0.5), CreepOperator([0.2], [10.0])])
    >>> y, state = hysteresis.apply(np.array([[0.0], [1.0], [1.0]]), dt=1.0)
    >>> y.ravel().round(3)
    array([0.   , 0.614, 0.627])
    >>> hysteresis.command(y, dt=1.0)[0].ravel()
    array([0., 1., 1.])
    """

    def __init__(self, operators: Sequence[HysteresisOperator]) -> None:
        self.operators = tuple(operators)
        if not self.operators:
            raise ValueError("`operators` must hold at least one operator, got none.")
        sizes = []
        for operator in self.operators:
            if not isinstance(operator, HysteresisOperator):
                raise TypeError(
                    "`operators` must hold operators such as PlayOperator, got "
                    f"{operator!r:.80}."
                )
            if operator._size != "n":
                sizes.append(operator._size)
        if len(set(sizes)) > 1:
            raise ValueError(
                f"`operators` must be for equally many actuators, got {sizes}."
            )
        self._actuators = sizes[0] if sizes else "n"
        self.creeps = any(operator.creeps for operator in self.operators)
        self.kind = " and ".join(operator.kind for operator in self.operators)
        self.width = np.asarray(sum(operator.width for operator in self.operators))

    def __repr__(self) -> str:
        return f"HysteresisSeries({list(self.operators)})"

    @property
    def parts(self) -> tuple[HysteresisOperator, ...]:
        """The operators."""
        return self.operators

    def in_words(self, unit: LogUnit) -> str:
        """Return what every operator is, with its largest width in the unit of a log."""
        return " and ".join(operator.in_words(unit) for operator in self.operators)

    @property
    def time_constants(self) -> NDArray:
        """Time constants of creep of all operators (J,) [s]."""
        return np.concatenate([part.time_constants for part in self.operators])

    @property
    def _size(self) -> int | str:
        return self._actuators

    def stages(self, n: int) -> list[Stage]:
        """Return the stages of all operators."""
        return [stage for operator in self.operators for stage in operator.stages(n)]

    def _each_inside(self, rows: NDArray, steps: NDArray) -> Iterator[NDArray]:
        """Yield the inner states (N, n) of all operators."""
        for operator in self.operators:
            yield from operator._each_inside(rows, steps)
            rows = operator.followed(rows, steps)
