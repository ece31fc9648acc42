"""Distances of actuator vectors from the rows of a log."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.hybrid._guards import GroupDistance


def held_out_distances(train: NDArray, groups: NDArray, test: NDArray) -> NDArray:
    """Return the distances of held-out rows (N, n) from training rows, see `distances`."""
    measure = GroupDistance.fit(torch.from_numpy(train), groups)
    return np.zeros(len(test)) if measure is None else distances(measure, test)


def distances(measure: GroupDistance, q: NDArray) -> NDArray:
    """Return the distances of rows q (N, n) from the log; the range of an actuator is 2."""
    relative = measure.domain_distance(torch.from_numpy(q)).sqrt()
    return (relative * measure.farthest).numpy()
