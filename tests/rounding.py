"""How far rounding takes results apart that are computed with other instructions or libraries."""

import numpy as np

EPS = float(np.finfo(np.float64).eps)
# A step at limits solves eq. (19) with lambda^2 = 1e-6 sigma_max^2 and two proximal rounds. Each of
# the three multiplies the rounding of J dq, about eps |J| |dq|, by sigma_max^2 / lambda^2.
OF_A_STEP = 3.0 * 1e6 * EPS


def of_commands(q):
    """Return how far two loops may be apart that send commands q (T, n), from the same start.

    Nothing corrects a difference along motions that leave the tip at rest: those of the steps add
    up. No step is longer than the way of its actuators.
    """
    ways = np.abs(np.diff(np.asarray(q, dtype=float), axis=0)).max(axis=1)
    return OF_A_STEP * float(ways.sum())
