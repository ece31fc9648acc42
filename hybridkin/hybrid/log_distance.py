"""Distances of actuator vectors from the rows of a log."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin.hybrid._guards import GroupDistance


def held_out_distances(train: NDArray, groups: NDArray, test: NDArray) -> NDArray:
    """Return the distances of held-out rows (N, n) from training rows; an actuator spans 2."""
    measure = GroupDistance.fit(torch.from_numpy(train), groups)
    if measure is None:
        return np.zeros(len(test))
    return measure.distances(torch.from_numpy(test)).numpy()
