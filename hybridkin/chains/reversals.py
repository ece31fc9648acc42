"""Where actuators reverse: all that hysteresis without creep depends on."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.runs import RunOrder
from hybridkin.chains.play import PlayOperator


def reversals(q: NDArray, order: RunOrder, sizes: NDArray) -> NDArray[np.bool_]:
    """Return the rows at which actuators reverse by more than some sizes (N, n).

    A backlash of that width follows the command with a constant lag, until the command has gone
    back by more. The row before is then a reversal. Operators that follow only these rows miss the
    commands by less than the sizes.

    Parameters
    ----------
    q : ndarray of shape (N, n)
        Commands, in that order, run after run [unit of q].
    order : RunOrder
        Where runs begin.
    sizes : ndarray of shape (n,)
        Smallest way back that counts, zero or more [unit of q].
    """
    run = np.cumsum(order.first)
    moved = PlayOperator(sizes).apply_by_group(q, run)
    change = np.diff(moved, axis=0, prepend=moved[:1])
    change[order.first] = 0.0
    turns = np.zeros(q.shape, dtype=bool)
    for actuator, of_actuator in enumerate(change.T):
        moving = np.flatnonzero(of_actuator)
        up = of_actuator[moving] > 0.0
        turned = (up[1:] != up[:-1]) & (run[moving][1:] == run[moving][:-1])
        turns[moving[:-1][turned], actuator] = True
    return turns
