"""The sampling protocol and the split of the paper."""

from __future__ import annotations

from types import NoneType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hybridkin._core.arrays import shaped, whole

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
    >>> from hybridkin.datasets import paper_protocol
    >>> q_target, part = paper_protocol(random_state=0)
    >>> q_target.shape, (part == 3).sum().item()
    ((2000, 9), 500)
    """
    for name, value in (("n_segment", n_segment), ("n_random", n_random)):
        whole(value, name, 0, MOST)
    rng = _generator(random_state)
    part = np.repeat(np.arange(4, dtype=np.int8), [n_segment] * 3 + [n_random])
    return draw(rng, part), part


def _generator(random_state: int | np.random.Generator | None) -> np.random.Generator:
    if not isinstance(random_state, (np.random.Generator, NoneType)):
        random_state = whole(random_state, "random_state", 0)
    return np.random.default_rng(random_state)


def draw(rng: np.random.Generator, part: NDArray[np.int8]) -> NDArray[np.float64]:
    """Return commanded lengths (n_samples, 9) for rows of the given parts; see paper_protocol."""
    low, high, hold, jitter = RANGE.values()
    moving = (part[:, None] == 3) | (part[:, None] == np.arange(9) // 3)
    unit = rng.random((len(part), 9))
    return np.where(moving, low + (high - low) * unit, hold + jitter * (2 * unit - 1))


def paper_split(
    data: Any,
    random_state: int | np.random.Generator | None = None,
    *,
    n_test: int = 100,
) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the paper's split: test rows among the fully random ones, all others for training.

    Parameters
    ----------
    data : Bunch or array-like of shape (n_samples,)
        Data with ``part``, or that array itself.
    random_state : int, Generator or None, default=None
        Seed that selects the test rows among the fully random ones.
    n_test : int, default=100
        Number of rows of the test set.

    Returns
    -------
    train_idx : ndarray of shape (n_samples - n_test,)
        Training rows: all rows in which one segment moves alone, and the other random rows.
    test_idx : ndarray of shape (n_test,)
        Test rows.

    References
    ----------
    Reinhart and Steil (2016), section 3.3.

    Examples
    --------
    >>> from hybridkin.datasets import load_trunk, paper_split
    >>> train_idx, test_idx = paper_split(load_trunk(), random_state=0)
    >>> len(train_idx), len(test_idx)
    (1900, 100)
    """
    part = getattr(data, "part", data)
    if part is None:
        raise ValueError("`data` has no parts of the paper's protocol; give data of `load_trunk`.")
    part = shaped(part, "data", ["n_samples"])
    random_rows = np.flatnonzero(part == 3)
    n_test = whole(n_test, "n_test", 1, len(random_rows))
    rng = _generator(random_state)
    test_idx = np.sort(rng.permutation(random_rows)[:n_test])
    return np.setdiff1d(np.arange(len(part)), test_idx), test_idx
