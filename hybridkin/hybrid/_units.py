"""New rows in another unit than those of the fit: which of X and y, and by what factor."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from hybridkin._core.model import ForwardModel
from hybridkin._core.units import other_unit
from hybridkin.hybrid._range import TrainingRange
from hybridkin.hybrid._rows import Rows

_LARGER = 20.0  # times the fit; smaller ratios can be other motions
_SMALLER = 0.01
_POSTURES = 0.05  # span of predicted tips over their largest distance that tells a unit


def check_commands(rows: Rows, seen: TrainingRange, turns: bool) -> None:
    """Raise if actuator vectors are those of the fit in another unit.

    Parameters
    ----------
    rows : Rows
        New rows.
    seen : TrainingRange
        The range of q in the fit.
    turns : bool
        Whether all actuators are angles.
    """
    usual = np.maximum(np.abs(seen.low), np.abs(seen.high))
    # Small numbers are another unit only for lengths that are never near zero.
    lengths = (
        np.minimum(seen.low * np.sign(seen.high), seen.high * np.sign(seen.low)) > 0.0
    )
    moved = usual > 0.0
    if not len(rows) or not moved.any():
        return
    ratio = float(np.median(np.abs(rows.X)[:, moved] / usual[moved]))
    small = ratio < _SMALLER and lengths.all()
    if not small and ratio < _LARGER:
        return
    _refuse("X", "actuator vectors", ratio, "those of the fit", turns)


def check_tips(rows: Rows, model: ForwardModel) -> None:
    """Raise if measured tips are those of a model in another unit; its base may have moved.

    Rows that hold about one posture, or that do not move, tell nothing of the unit.
    """
    with torch.no_grad():
        predicted = model(rows.q).numpy()
    measured = rows.tips[:, : predicted.shape[1]]
    predicted = np.where(np.isnan(measured), np.nan, predicted)
    moved = _span(predicted)
    if len(rows) < 2 or not moved > _POSTURES * np.nanmax(np.abs(predicted)):
        return
    ratio = _span(measured) / moved
    if _SMALLER < ratio < _LARGER:
        return
    _refuse("y", "tips", ratio, "the model predicts", False)


def _refuse(name: str, what: str, ratio: float, than: str, turns: bool) -> None:
    """Raise if the ratio is that of a unit."""
    unit = other_unit(ratio, angle=turns)
    if unit is None:
        return
    raise ValueError(
        f"`{name}` must hold {what} in the unit of the fit, but they are about {ratio:.2g} times "
        f"as large as {than}, which looks like {unit.in_words}."
    )


def _span(tips: NDArray) -> float:
    """Return the largest side of the box around tips (N, m), NaN left out."""
    with np.errstate(all="ignore"):
        sides = np.nanmax(tips, axis=0, initial=-np.inf) - np.nanmin(
            tips, axis=0, initial=np.inf
        )
    return float(np.max(sides, initial=0.0, where=np.isfinite(sides)))
