"""The error for rows of numbers that hold NaN or infinity."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

LEAVE_OUT = (
    "leave these rows out (np.isfinite finds them), or read the log with "
    "datasets.load_log(..., drop_invalid=True)"
)


def check_entries(finite: NDArray, name: str, advice: str = LEAVE_OUT) -> None:
    """Raise if not all entries (N, k) of an argument are finite."""
    if not finite.all():
        bad = np.flatnonzero(~finite.all(axis=1))
        raise ValueError(
            f"`{name}` must be finite, got NaN or infinity in {len(bad)} of {len(finite)} rows "
            f"(first: row {bad[0]}); {advice}."
        )
