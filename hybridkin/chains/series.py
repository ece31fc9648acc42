"""Operators of hysteresis in series, for example friction before creep."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from hybridkin.chains.hysteresis import HysteresisOperator
from hybridkin.native.hysteresis import Stage, stage_numbers

__all__ = ["HysteresisSeries"]


class HysteresisSeries(HysteresisOperator[tuple]):
    """Operators of hysteresis, each of which gets the effective changes of the one before.

    The state is the tuple of the states of the operators.

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
    >>> y, (play, creep) = hysteresis.apply(np.array([[0.0], [1.0], [1.0]]))
    >>> y.ravel().round(3)
    array([0.   , 0.614, 0.627])
    >>> hysteresis.command(y)[0].ravel()
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

    @property
    def _size(self) -> int | str:
        return self._actuators

    def _start(self, row: NDArray) -> tuple:
        return tuple(operator._start(row) for operator in self.operators)

    def stages(self, n: int) -> list[Stage]:
        """Return the stages of all operators."""
        return [stage for operator in self.operators for stage in operator.stages(n)]

    def _inside(self, q: NDArray, steps: ArrayLike) -> NDArray:
        """Return the inner states (T, R, n) of all operators."""
        states = []
        for operator in self.operators:
            states.append(operator._inside(q, steps))
            q, _ = operator.apply(q, dt=steps)
        return np.concatenate(states, axis=1)

    def packed(self, state: tuple) -> NDArray:
        """Return a state as the kernels keep it: each operator begins with the result before."""
        parts = []
        for operator, part in zip(self.operators, state, strict=True):
            parts.append(operator.packed(part))
        return np.vstack([*(part[:-1] for part in parts[:-1]), parts[-1]])

    def unpacked(self, rows: NDArray) -> tuple:
        """Return the state of rows of `packed`."""
        states = []
        for operator in self.operators:
            n_rows = stage_numbers(operator.stages(rows.shape[1])).code[1]
            states.append(operator.unpacked(rows[:n_rows]))
            rows = rows[n_rows - 1 :]
        return tuple(states)

    def _checked_state(self, state: Any, n: int) -> tuple:
        if not isinstance(state, tuple) or len(state) != len(self.operators):
            raise TypeError(
                f"`state` must be a tuple of the states of {len(self.operators)} operators, got "
                f"{state!r:.80}."
            )
        parts = zip(self.operators, state, strict=True)
        return tuple(operator._checked_state(part, n) for operator, part in parts)

    def _state_for(self, state: tuple, caller: NDArray | Tensor) -> tuple:
        parts = zip(self.operators, state, strict=True)
        return tuple(operator._state_for(part, caller) for operator, part in parts)
