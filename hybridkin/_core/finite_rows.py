"""The error for rows of numbers that hold NaN or infinity."""

from __future__ import annotations

from numpy.typing import NDArray

LEAVE_OUT = (
    "leave these rows out (np.isfinite finds them), or read the log with "
    "datasets.load_log(..., drop_invalid=True)"
)


def refuse_rows(bad: NDArray, name: str, advice: str = LEAVE_OUT) -> None:
    """Raise if any of the rows (N,) of an argument is bad: not finite."""
    if bad.any():
        raise ValueError(
            f"`{name}` must be finite, got NaN or infinity in {bad.sum()} of {len(bad)} rows "
            f"(first: row {bad.argmax()}); {advice}."
        )
