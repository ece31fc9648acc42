"""What error_model="auto" compared."""

from __future__ import annotations

from typing import TypedDict

from numpy.typing import NDArray


class CvResults(TypedDict):
    """The comparison of error models, see `HybridForwardModel.cv_results_`."""

    candidate: list[str]
    mean_distance: NDArray
    expected_distance: float
    std_distance: NDArray
    io_distance: NDArray
    chosen: str
    weights: dict[str, float]
    parameters: str
    mechanical_model: dict[str, dict[str, float]]
    corrected: dict[str, dict[str, float]]
