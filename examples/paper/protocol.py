"""The sampling protocol of the paper."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.arrays import random_generator, whole

MOST = 10**9  # rows; 72 GB
RANGE = {"low": 0.19, "high": 0.31, "hold": 0.20, "jitter": 0.005}
"""Working range of lengths, held length and half the range about it [m]."""


def paper_protocol(
    random_state: int | np.random.Generator | None = None,
    *,
    n_segment: int = 500,
    n_random: int = 500,
) -> tuple[NDArray[np.float64], NDArray[np.int8]]:
    """Return the commanded lengths of the paper's sampling protocol and the part of each row.

    First each segment moves alone: its three lengths are uniform from 0.19 to 0.31 m, and the other
    segments are held at 0.20 m +- 5 mm. Then all nine lengths are uniform from 0.19 to 0.31 m.

    Parameters
    ----------
    random_state : int, Generator or None, default=None
        Source of the random lengths.
    n_segment : int, default=500
        Number of rows for each segment that moves alone.
    n_random : int, default=500
        Number of rows in which all lengths are random.

    Returns
    -------
    q_target : ndarray of shape (3 * n_segment + n_random, 9)
        Commanded chamber lengths [m].
    part : ndarray of shape (3 * n_segment + n_random,)
        0, 1 or 2: the segment that moves alone; 3: all segments move.

    References
    ----------
    Reinhart and Steil (2016), section 3.3.

    Examples
    --------
    >>> from paper import paper_protocol
    >>> q_target, part = paper_protocol(random_state=0)
    >>> q_target.shape, (part == 3).sum().item()
    ((2000, 9), 500)
    """
    for name, value in (("n_segment", n_segment), ("n_random", n_random)):
        whole(value, name, 0, MOST)
    rng = random_generator(random_state)
    part = np.repeat(np.arange(4, dtype=np.int8), [n_segment] * 3 + [n_random])
    return draw(rng, part), part


def draw(rng: np.random.Generator, part: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return commanded lengths (n_samples, 9) for rows of the given parts; see paper_protocol."""
    low, high, hold, jitter = RANGE.values()
    moving = (part[:, None] == 3) | (part[:, None] == np.arange(9) // 3)
    unit = rng.random((len(part), 9))
    return np.where(moving, low + (high - low) * unit, hold + jitter * (2 * unit - 1))
